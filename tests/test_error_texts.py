"""What wrong calls raise: the argument, the value that was given, and what would be valid."""

import error_texts
import pytest

import approxjac as aj

CASES = list(error_texts.cases())


@pytest.fixture(scope="module")
def namespace():
    return error_texts.names()


@pytest.mark.parametrize(("call", "error", "parts"), CASES, ids=[case[0] for case in CASES])
def test_the_error_names_argument_value_and_what_is_valid(call, error, parts, namespace):
    with pytest.raises(aj.errors.ApproxJacError) as caught:
        eval(call, dict(namespace))
    message = str(caught.value)
    assert type(caught.value).__name__ == error
    assert [part for part in parts if part not in message] == [], message
    assert "object at 0x" not in message
    assert "\n" not in message
    assert len(message) < 500


def test_many_wrong_calls_are_tried():
    assert len(CASES) == len({call for call, *_ in CASES}) > 140
