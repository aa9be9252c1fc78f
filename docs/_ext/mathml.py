"""Formulas as MathML, which browsers show by themselves: no script, no network."""

import re

from docutils import nodes
from latex2mathml.converter import convert
from lxml import etree

SPACE = "{http://www.w3.org/1998/Math/MathML}"
ACCENTS = frozenset("^~¯˙¨→")  # combining ones are lost at times as Chromium paints
NUMBER = re.compile(r"\\qquad\s*(\(\d+\))\s*\Z")  # of an equation
THIN = "0.17em"
TALL = frozenset("bdfhklβδθϑλΓΔΘΛΞΠΣΦΨΩ") | {chr(code) for code in range(ord("A"), ord("Z") + 1)}
RELATIONS = frozenset("⪰⪯")  # which latex2mathml takes for names


def visit_inline(translator, node):
    translator.body.append(formula(node.astext()))
    raise nodes.SkipNode


def visit_block(translator, node):
    source, number = node.astext(), ""
    if found := NUMBER.search(source):
        source, number = source[: found.start()], f'<span class="eqno">{found[1]}</span>'
    shown = formula(source, display="block")
    translator.body.append(f'<div class="math">{shown}{number}</div>')
    raise nodes.SkipNode


def formula(source, display="inline"):
    """MathML of LaTeX, with accents near their letters and exponents beside these, not above.

    Browsers put a mark above with the gap of a limit, unless they are told that it is an accent;
    then it touches the letter, unless that is said to be higher. An exponent they put at the top
    of all that it belongs to, hat included, and between sin and x no space.
    """
    root = etree.fromstring(convert(source, display=display))
    for over in list(root.iter(f"{SPACE}mover")):
        if len(over) == 2 and (over[1].text or "").strip() in ACCENTS:
            over.set("accent", "true")
            if over[1].text == "^":
                over[1].text = "ˆ"  # as wide as a letter
            if over[0].tag == f"{SPACE}mi":
                height = "0.8em" if TALL & set(over[0].text) else "0.6em"
                padded = etree.Element(f"{SPACE}mpadded", height=height)
                letter = over[0]
                over.replace(letter, padded)
                padded.append(letter)
    for base in [each[0] for each in root.iter(*(f"{SPACE}{n}" for n in ("msup", "msubsup")))]:
        if base.tag == f"{SPACE}mover" and base.get("accent"):
            letters = "".join(base[0].itertext())
            height = "0.66em" if TALL & set(letters) else "0.45em"
            padded = etree.Element(f"{SPACE}mpadded", height=height)
            base.getparent().replace(base, padded)
            padded.append(base)
    for name in root.iter(f"{SPACE}mi"):
        if name.get("mathvariant") == "script" and name.text == "R":
            name.text = "ℛ"  # browsers know no other variant than normal
        if name.text in RELATIONS:
            name.tag = f"{SPACE}mo"
    for bar in root.iter(f"{SPACE}mo"):
        if bar.text in ("|", "‖"):
            bar.set("lspace", "0")
            bar.set("rspace", "0")
    for name in root.iter(f"{SPACE}mi", f"{SPACE}mo"):
        if len(name.text or "") > 1 and name.text.isalpha():
            before, after = name.getprevious(), name.getnext()
            name.tag = f"{SPACE}mo"
            name.set("lspace", "0" if before is None or before.tag == f"{SPACE}mo" else THIN)
            name.set("rspace", "0" if after is None or after.tag == f"{SPACE}mo" else THIN)
    return etree.tostring(root, encoding="unicode")


def setup(app):
    app.add_html_math_renderer("mathml", (visit_inline, None), (visit_block, None))
    return {"parallel_read_safe": True, "parallel_write_safe": True}
