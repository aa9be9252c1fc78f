"""Commands as a reader has them: an option or a number is not broken, nor coloured in part."""

import re

from pygments.lexers.shell import BashLexer
from pygments.token import Number, Text

BOX = re.compile(r'(?<=<div class="highlight-)(?:sh|bash|console|text) .*?</pre>', re.DOTALL)
OPTION = re.compile(r"(<[^>]*>)|(?<![\w-])(--?[A-Za-z][\w.-]*)")
INLINE = re.compile(r'<span class="pre">(--?[A-Za-z][\w.-]*)</span>')


class Commands(BashLexer):
    """Lines to type; of 0.3 the usual lexer takes the 3 for a number."""

    def get_tokens_unprocessed(self, text):
        """Yield tokens of which none is a number."""
        for at, kind, value in super().get_tokens_unprocessed(text):
            yield at, Text if kind in Number else kind, value


def whole(body):
    """Return HTML whose options, in boxes of commands and within lines, are not broken."""
    body = BOX.sub(lambda box: OPTION.sub(_marked, box[0]), body)
    return INLINE.sub(r'<span class="pre option">\1</span>', body)


def _marked(found):
    return found[1] or f'<span class="option">{found[2]}</span>'


def setup(app):
    for name in ("sh", "console"):
        app.add_lexer(name, Commands)
    app.connect("html-page-context", lambda app, page, template, context, doctree: context.update(
        body=whole(context.get("body", ""))))  # fmt: skip
    return {"parallel_read_safe": True, "parallel_write_safe": True}
