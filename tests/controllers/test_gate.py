"""Which frames of x kinematics learn from, and how sure they say that they are of it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.controllers import AdaptiveKinematics

RATE, REST = 60.0, np.zeros(2)
AT = np.array([0.4, -0.9])
JUMP = np.array([0.3, -0.2])  # of x [m], far beyond its noise


@pytest.fixture(scope="module")
def arm():
    return aj.load_robot("two_link")


@pytest.fixture(scope="module")
def kinematics(arm):
    return AdaptiveKinematics(aj.PositionTask(arm, axes="xz"), ("tool", "offset"))


def shown(kinematics, frames, state=None, start=0, at=AT):
    """Return the state after frames of x at a rest, each of which is taken when it arrives."""
    for k, x in enumerate(frames, start):
        q = at(k) if callable(at) else at
        seen = aj.Measurement(k / RATE, q, REST, np.array(x), k / RATE)
        state = kinematics.initial_state(seen) if state is None else state
        state = kinematics.step(state, seen, 1.0 / RATE)
    return state


@pytest.fixture(scope="module")
def settled(kinematics):
    """A state that has seen the arm at rest for a third of a second, and x there."""
    x = kinematics.task.value(AT)
    return shown(kinematics, [x] * 20), x


def assert_nothing_learnt(kinematics, state, before):
    assert_array_equal(kinematics.learnt(state), kinematics.learnt(before))
    new, old = (kinematics.report(each) for each in (state, before))
    assert (new.seconds, new.restarts) == (old.seconds, old.restarts)
    assert_array_equal(new.covariance, old.covariance)


def test_jumps_that_agree_are_believed_at_the_eighth(kinematics, settled):
    state, x = settled
    assert_nothing_learnt(kinematics, shown(kinematics, [x + JUMP] * 7, state, 20), state)
    after = shown(kinematics, [x + JUMP] * 8, state, 20)
    assert kinematics.report(after).restarts == 1
    assert np.abs(kinematics.learnt(after) - kinematics.learnt(state)).max() > 0.01


def test_jumps_that_disagree_teach_nothing_however_many(kinematics, settled):
    state, x = settled
    away = [x + [0.05 * k, 0.3 * (-1.0) ** k] for k in range(1, 21)]
    assert_nothing_learnt(kinematics, shown(kinematics, away, state, 20), state)


@pytest.mark.parametrize("between", ["another jump", "one that is right"])
def test_what_comes_between_jumps_ends_their_agreement(kinematics, settled, between):
    state, x = settled
    other = x - JUMP if between == "another jump" else x
    after = shown(kinematics, [*[x + JUMP] * 7, other, *[x + JUMP] * 7], state, 20)
    assert kinematics.report(after).restarts == 0
    assert_allclose(kinematics.learnt(after), kinematics.learnt(state), atol=1e-9)


@pytest.mark.parametrize("residual", ["noise", "more noise", "what nothing explains"])
def test_residuals_beyond_what_was_told_widen_the_covariance_as_they_are(arm, residual):
    """Of a known sensor it does not depend on x but for χ² and the noise as it is seen."""
    kinematics = AdaptiveKinematics(aj.PositionTask(arm, axes="xz"), ("tool", "offset"))
    value, k = kinematics.task.value, np.arange(150)
    left = np.random.default_rng(0).standard_normal((150, 2))
    if residual == "what nothing explains":
        left = 0.4 * np.sin(0.05 * k[:, np.newaxis] * [1.0, 1.3])
    left *= kinematics.noise * {"noise": 1.5}.get(residual, 3.0)

    def at(k):
        return AT + 0.3 * np.sin(0.02 * k * np.array([1.0, 1.7]))

    clean, wrong = (
        kinematics.report(
            shown(kinematics, [value(at(i)) + each for i, each in enumerate(off)], at=at)
        )
        for off in (0.0 * left, left)
    )
    told, seen = wrong.noise
    assert clean.chi_squared < 1.0
    assert clean.noise[1] < told
    assert (seen > told) == (residual != "what nothing explains")
    wider = max(wrong.chi_squared, 1.0) * max(seen / told, 1.0) ** 2
    assert wider > 1.5
    assert wrong.restarts == 0
    assert_allclose(wrong.covariance, wider * clean.covariance, rtol=1e-9)
    for wide, narrow in zip(wrong.rows, clean.rows, strict=True):
        assert wide.sd == pytest.approx(np.sqrt(wider) * narrow.sd)
        assert wide.share == pytest.approx(narrow.share)
