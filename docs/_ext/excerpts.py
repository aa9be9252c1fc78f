"""Texts of all pages as one script, so that the search shows excerpts of a site in a folder, too.

There a page may not read another one, as the search of Sphinx does; `offline_search.js` gives it
these instead.
"""

import json
from pathlib import Path

from lxml import html

DROPPED = "//script | //style | //img | //svg | //a[@class='headerlink']"


def text_of(path):
    """The article of a page as HTML with nothing but its words and its places."""
    root = html.parse(str(path)).getroot()
    for found in root.xpath(DROPPED):
        found.drop_tree()
    for article in root.xpath("//article[@role='main']"):
        for node in article.iter():
            for name in set(node.attrib) - {"id", "role"}:
                del node.attrib[name]
        for node in article.xpath(".//*[not(self::section or self::p or self::li or @id)]"):
            node.drop_tag()
        return html.tostring(article, encoding="unicode")
    return ""


def write(app, error):
    if error is not None or app.builder.name != "html":
        return
    out = Path(app.outdir)
    pages = {f"{name}.html": text_of(out / f"{name}.html") for name in sorted(app.env.found_docs)}
    script = f"window.PAGE_TEXTS = {json.dumps(pages, ensure_ascii=False)};\n"
    (out / "_static" / "page_texts.js").write_text(script, encoding="utf-8")


def setup(app):
    app.connect("build-finished", write)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
