"""What wrong calls are told: what was expected, what was given, what would be valid."""

import error_texts
import pytest

EXPECTED = error_texts.FILE.read_text(encoding="utf-8")


@pytest.fixture(scope="module")
def namespace():
    return error_texts.names()


CALLS = [line for line in error_texts.calls() if line.startswith(error_texts.PROMPT)]


@pytest.mark.parametrize("line", CALLS)
def test_the_error_says_what_it_said(line, namespace):
    """If the new text is better: `python tests/error_texts.py --write`."""
    text = error_texts.told(line.removeprefix(error_texts.PROMPT), namespace)
    assert f"{line}\n{text}\n" in EXPECTED
    assert "object at 0x" not in text
    assert len(text) < 500


def test_many_wrong_calls_are_told():
    assert len(CALLS) == len(set(CALLS)) > 140
