"""Formulas as MathML, which browsers show by themselves: no script, no network."""

from docutils import nodes
from latex2mathml.converter import convert
from lxml import etree

SPACE = "{http://www.w3.org/1998/Math/MathML}"
ACCENTS = frozenset("^~¯˙¨→")  # combining ones are lost at times as Chromium paints
TALL = frozenset("bdfhklβδθλ") | {chr(code) for code in range(ord("A"), ord("Z") + 1)}


def visit_inline(translator, node):
    translator.body.append(formula(node.astext()))
    raise nodes.SkipNode


def visit_block(translator, node):
    shown = formula(node.astext(), display="block")
    translator.body.append(f'<div class="math">{shown}</div>')
    raise nodes.SkipNode


def formula(source, display="inline"):
    """MathML of LaTeX, with accents near their letters and exponents beside these, not above.

    Browsers put a mark above with the gap of a limit, unless they are told that it is an accent,
    and an exponent at the top of all that it belongs to, hat included.
    """
    root = etree.fromstring(convert(source, display=display))
    for over in list(root.iter(f"{SPACE}mover")):
        if len(over) == 2 and (over[1].text or "").strip() in ACCENTS:
            over.set("accent", "true")
    for base in [each[0] for each in root.iter(*(f"{SPACE}{n}" for n in ("msup", "msubsup")))]:
        if base.tag == f"{SPACE}mover" and base.get("accent"):
            letters = "".join(base[0].itertext())
            height = "0.66em" if TALL & set(letters) else "0.45em"
            padded = etree.Element(f"{SPACE}mpadded", height=height)
            base.getparent().replace(base, padded)
            padded.append(base)
    return etree.tostring(root, encoding="unicode")


def setup(app):
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
