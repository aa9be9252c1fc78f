"""The table of equations names every equation that a docstring of the law implements."""

import re
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]


@pytest.fixture
def equations(monkeypatch):
    """The extension of Sphinx, which needs no Sphinx but to be called by it."""
    monkeypatch.syspath_prepend(ROOT / "docs" / "_ext")
    yield __import__("equations")
    sys.modules.pop("equations", None)


def text(joint="", gap=" "):
    """A docstring in which one line may break, as it is written nowhere: tables list tests, too."""
    mark = "Implements{0}Eq.{0}({1}){2}"
    first, second = mark.format(" ", 9, ""), mark.format(gap, 30, joint)
    return f"Return A. {first}. Where g is learnt, A is larger. {second}. Departure: a\nsign.\n\nM."


@pytest.mark.parametrize("gap", [" ", "\n", "\n    "])
@pytest.mark.parametrize(("joint", "first"), [("", ""), (", too", "a sign.")])
def test_equations_are_found_with_their_departures_whatever_breaks_a_line(
    equations, joint, first, gap
):
    assert equations.implemented(text(joint, gap)) == [(9, first), (30, "a sign.")]


def test_the_table_has_every_equation_that_the_law_says_it_implements(equations):
    sources = (ROOT / "src" / "approxjac" / "law").glob("*.py")
    said = [re.findall(r"Eq\.\s+\((\d+)\)", path.read_text("utf-8")) for path in sources]
    listed = {number for number, *_ in equations.rows()}
    assert {int(number) for numbers in said for number in numbers} <= listed
    notes = {number: note for number, name, note, _ in equations.rows() if "closed_loop" in name}
    assert notes[9] == ""
    assert "Ṁ" in notes[30]
    assert r"$λ_{\mathrm{min}}$[Ĵᵀ$K_v$Ĵ + B]" in equations.table()  # no underscore is raw
