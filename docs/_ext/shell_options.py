"""Options of commands stay whole where a line is wrapped: browsers break at each hyphen."""

import re

BOX = re.compile(r'(?<=<div class="highlight-)(?:sh|bash|console|text) .*?</pre>', re.DOTALL)
OPTION = re.compile(r"(<[^>]*>)|(?<![\w-])(--?[A-Za-z][\w.-]*)")
INLINE = re.compile(r'<span class="pre">(--?[A-Za-z][\w.-]*)</span>')


def whole(body):
    """Return HTML whose options, in boxes of commands and within lines, are not broken."""
    body = BOX.sub(lambda box: OPTION.sub(_marked, box[0]), body)
    return INLINE.sub(r'<span class="pre option">\1</span>', body)


def _marked(found):
    return found[1] or f'<span class="option">{found[2]}</span>'


def setup(app):
    app.connect("html-page-context", lambda app, page, template, context, doctree: context.update(
        body=whole(context.get("body", ""))))  # fmt: skip
    return {"parallel_read_safe": True, "parallel_write_safe": True}
