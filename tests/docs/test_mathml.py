"""Formulas of the site: accents near their letters, exponents beside them, a font for formulas."""

import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.site  # with what builds the site


@pytest.fixture
def formula(monkeypatch):
    monkeypatch.syspath_prepend(ROOT / "docs" / "_ext")
    yield __import__("mathml").formula
    sys.modules.pop("mathml", None)


@pytest.mark.parametrize("accent", [r"\hat", r"\dot", r"\ddot", r"\bar", r"\tilde"])
def test_marks_above_a_letter_are_accents(formula, accent):
    assert '<mover accent="true"><mi>J</mi>' in formula(rf"{accent} J")
    assert 'accent="true"' not in formula(r"\overset{!}{=}")


def test_an_exponent_does_not_stand_above_the_hat(formula):
    for source in (r"\hat J^T", r"\hat J_c^+"):
        assert '<mpadded height="0.66em"><mover' in formula(source)
    assert '<mpadded height="0.45em"><mover' in formula(r"\dot q^T")
    assert "mpadded" not in formula(r"J^T + \hat J")


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
