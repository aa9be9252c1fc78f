"""Formulas of the site: accents near their letters, exponents beside them, a font for formulas."""

import sys
from pathlib import Path
from types import SimpleNamespace

import pytest

ROOT = Path(__file__).parents[2]
nodes = pytest.importorskip("docutils.nodes")
pytestmark = pytest.mark.site  # with what builds the site


@pytest.fixture
def formula(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs" / "_ext")
    yield __import__("mathml").formula
    sys.modules.pop("mathml", None)


@pytest.mark.parametrize("accent", [r"\hat", r"\dot", r"\ddot", r"\bar", r"\tilde"])
def test_marks_above_a_letter_are_accents(formula, accent):
    assert '<mover accent="true"><mpadded height="0.8em"><mi>J</mi>' in formula(rf"{accent} J")
    assert '<mover accent="true"><mpadded height="0.6em"><mi>q</mi>' in formula(rf"{accent} q")
    assert '<mpadded height="0.8em"><mi>Λ</mi>' in formula(r"\dot\Lambda")
    assert '<mpadded height="0.8em"><mi>ϑ</mi>' in formula(r"\dot\vartheta")
    assert 'accent="true"' not in formula(r"\overset{!}{=}")


def test_relations_bars_and_script_letters_are_what_they_are(formula):
    assert "<mo>⪰</mo>" in formula(r"Q\succeq\mu")
    assert formula("|a|").count('lspace="0" rspace="0">|</mo>') == 2
    assert ">ℛ</mi>" in formula(r"\mathcal R")


def test_an_exponent_does_not_stand_above_the_hat(formula):
    for source in (r"\hat J^T", r"\hat J_c^+"):
        assert '<mpadded height="0.66em"><mover' in formula(source)
    assert '<mpadded height="0.45em"><mover' in formula(r"\dot q^T")
    assert formula(r"J^T + \hat J").count("mpadded height") == 1  # that of the hat


def test_options_of_commands_are_not_broken(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs" / "_ext")
    whole = __import__("shell_options").whole
    box = '<div class="highlight-sh notranslate"><pre>a<span class="w"> </span>--dry-run 1-2</pre>'
    assert whole(box).count('<span class="option">--dry-run</span>') == 1
    assert whole(box).count("option") == 1
    assert whole('<span class="pre">--out</span>') == '<span class="pre option">--out</span>'
    python = '<div class="highlight-python notranslate"><pre>a --b</pre>'
    assert whole(python) == python


def test_names_of_functions_stand_apart(formula):
    assert '<mo lspace="0.17em" rspace="0">tanh</mo>' in formula(r"\gamma\tanh(e)")
    assert '<mo lspace="0" rspace="0.17em">sin</mo><mi>q</mi>' in formula(r"\sin q")


def test_the_number_of_an_equation_stands_beside_it(formula):
    translator = SimpleNamespace(body=[])
    with pytest.raises(nodes.SkipNode):
        sys.modules["mathml"].visit_block(translator, nodes.math_block("", r"a=b\qquad(28)"))
    assert translator.body[0].endswith('</math><span class="eqno">(28)</span></div>')
    assert "28" not in translator.body[0].split("</math>")[0]


@pytest.mark.browser
def test_the_bundled_font_is_used_and_has_what_formulas_need(formula, open_page, tmp_path):
    for name in ("formulas.css", "stix_two_math.woff2"):
        (tmp_path / name).write_bytes((ROOT / "docs" / "_static" / name).read_bytes())
    assert (tmp_path / "stix_two_math.woff2").stat().st_size < 150_000
    text = formula(r"\hat J^T J^T \sum_{i} \left( \frac{a}{b} \right)", display="block")
    path = tmp_path / "page.html"
    path.write_text(
        f'<!doctype html><meta charset="utf-8"><link rel="stylesheet" href="formulas.css">{text}',
        encoding="utf-8",
    )
    page = open_page(path)
    assert page.evaluate("document.fonts.load('16px Formulas').then((all) => all.length)") == 1
    page.wait_for_timeout(200)
    hat, plain = page.evaluate(
        "[...document.querySelectorAll('msup')].map((m) => m.children[1].getBoundingClientRect().y)"
    )
    assert abs(hat - plain) < 3.0  # px: both exponents stand at one height
