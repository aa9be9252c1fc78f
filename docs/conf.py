"""Sphinx configuration. Build with `sphinx-build -W docs docs/_build`."""

import enum
import sys
from pathlib import Path

HERE = Path(__file__).parent
sys.path.insert(0, str(HERE / "_ext"))

from docutils import nodes  # noqa: E402

import approxjac  # noqa: E402

project = "approxjac"
author = "the approxjac authors"
copyright = "2026, the approxjac authors"
version = release = approxjac.__version__

extensions = [
    "myst_parser",
    "sphinx.ext.autodoc",
    "sphinx.ext.napoleon",
    "equations",
    "excerpts",
    "mathml",
    "study_figures",
    "gallery",
    "shell_options",
]
myst_enable_extensions = ["dollarmath", "colon_fence"]
myst_heading_anchors = 3
html_math_renderer = "mathml"
html_theme = "furo"
html_title = "approxjac"
html_static_path = ["_static"]
html_extra_path = ["_generated/site"]  # pages of runs
(HERE / "_generated" / "site").mkdir(parents=True, exist_ok=True)
html_css_files = ["page.css", "formulas.css", "gallery.css"]
html_js_files = [("offline_search.js", {"priority": 900})]
html_theme_options = {"footer_icons": []}
html_domain_indices = False  # the list of modules: there is only one
smartquotes = False  # quotes and dashes of commands are in docstrings, too
exclude_patterns = ["_build", "_ext", "_generated/*.md", "tables"]  # included by other pages
nitpicky = False

autodoc_member_order = "bysource"
autodoc_typehints = "signature"
autoclass_content = "class"
napoleon_google_docstring = True
napoleon_numpy_docstring = False
napoleon_use_ivar = True


def short_signature(app, what, name, member, options, signature, returns):
    """A protocol is described, not called; types are named as in the source."""
    if getattr(member, "_is_protocol", False):
        return "", returns
    return tuple(None if text is None else in_short(text) for text in (signature, returns))


def in_short(text):
    """`Array` stands for what it is short for; what a factory makes is left out."""
    text = text.replace("~numpy.", "").replace("numpy.", "").replace("~typing.", "")
    text = text.replace("ndarray[tuple[Any, ...], dtype[float64]]", "Array")
    return text.replace("<factory>", "...")


def shorten_types(app, what, name, member, options, lines):
    """Types that napoleon puts beside the attributes of a class."""
    lines[:] = [in_short(line) if line.startswith(":vartype") else line for line in lines]


def list_outcomes(app, what, name, member, options, lines):
    """Members of an enum by name, each with what it says."""
    if isinstance(member, enum.EnumMeta):
        for each in member:
            lines += ["", f"``{each.name}``", f"    {getattr(each, 'message', each.value)}"]


def write_dashes(app, doctree):
    """What Sphinx puts before the text of a parameter, and leaves to smart quotes."""
    for text in list(doctree.findall(lambda node: node == " -- ")):
        text.parent.replace(text, nodes.Text(" – "))


def link_pictures(app, doctree):
    """A picture leads to its file, which a phone can enlarge."""
    cards = app.env.docname == "gallery"  # which are links as a whole
    for picture in [] if cards else doctree.findall(nodes.image):
        picture.setdefault("scale", 100)


def setup(app):
    app.connect("autodoc-process-signature", short_signature)
    app.connect("autodoc-process-docstring", shorten_types)
    app.connect("autodoc-process-docstring", list_outcomes)
    app.connect("doctree-read", write_dashes)
    app.connect("doctree-read", link_pictures)
