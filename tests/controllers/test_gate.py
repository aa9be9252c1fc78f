"""Which frames of x kinematics learn from, and how sure they say that they are of it."""

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac import law
from approxjac.controllers import AdaptiveKinematics
from approxjac.robots import KinematicRegressor
from approxjac.tasks import TrackerTask

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


# -- which frames --------------------------------------------------------------------------------


def test_jumps_that_agree_are_believed_at_the_eighth(kinematics, settled):
    state, x = settled
    assert_nothing_learnt(kinematics, shown(kinematics, [x + JUMP] * 7, state, 20), state)
    after = shown(kinematics, [x + JUMP] * 8, state, 20)
    assert kinematics.report(after).restarts == 1
    assert np.abs(kinematics.learnt(after) - kinematics.learnt(state)).max() > 5e-3


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


def test_a_state_that_is_gone_on_with_takes_the_first_x_as_it_is(kinematics, settled):
    """Nobody knows how long ago it was, nor what was done to the sensor meanwhile."""
    state, x = settled
    here = aj.Measurement(0.0, AT, REST, x + JUMP, 0.0)
    after = shown(kinematics, [x + JUMP], kinematics.resumed(state, here))
    assert kinematics.report(after).restarts == 0
    assert np.abs(kinematics.learnt(after) - kinematics.learnt(state)).max() > 5e-3


def test_frames_count_for_the_time_since_the_one_before(kinematics, settled):
    state, x = settled
    assert kinematics.report(state).seconds == pytest.approx(19.0 / RATE)
    lost = shown(kinematics, [x * np.nan] * 3, state, 20)
    assert kinematics.report(shown(kinematics, [x], lost, 23)).seconds == pytest.approx(23.0 / RATE)
    much_later = shown(kinematics, [x], lost, 200)
    assert kinematics.report(much_later).seconds == pytest.approx(19.0 / RATE + 0.1)


def test_frames_closer_than_4_ms_count_as_one(kinematics, settled):
    state, x = settled
    seen = aj.Measurement(1.0, AT, REST, x + 1e-3, 1.0)
    once = kinematics.step(state, seen, 1e-3)
    soon, late = (
        kinematics.step(once, seen._replace(t=t, t_x=t, x=x - 1e-3), 1e-3) for t in (1.003, 1.005)
    )
    assert_nothing_learnt(kinematics, soon, once)
    assert kinematics.report(late).seconds > kinematics.report(once).seconds


@pytest.mark.parametrize("age", [0.0, 0.004, 0.013, 0.2])
def test_a_frame_is_of_the_configuration_at_which_it_was_taken(kinematics, arm, age):
    """Between those that are remembered, too: of an arm in motion, whose x is late and exact."""
    dt, speed, state = 2e-3, np.array([1.0, -1.5]), None
    for k in range(400):
        t, taken = k * dt, max(k * dt - age, 0.0)
        x = kinematics.task.value(AT + taken * speed)
        seen = aj.Measurement(t, AT + t * speed, speed, x, taken)
        state = kinematics.initial_state(seen) if state is None else state
        state = kinematics.step(state, seen, dt)
    believed = [row.believed for row in kinematics.report(state).rows]
    assert_allclose(kinematics.learnt(state), believed, atol=1e-5)


@pytest.mark.parametrize(
    ("delay", "age", "is_known"),
    [(0.0, 0.2, True), (0.0, 0.3, False), (0.3, None, True), (0.3, 0.58, True), (0.3, 0.65, False)],
)
def test_frames_are_of_use_up_to_a_quarter_of_a_second_or_twice_the_delay(
    arm, delay, age, is_known
):
    """The age is that of the delay where nobody tells it."""
    task = aj.PositionTask(arm, axes="xz")
    kinematics = AdaptiveKinematics(task, ("tool", "offset"), delay=delay)
    dt, speed, state, late = 0.01, np.array([0.5, -0.7]), None, delay if age is None else age
    for k in range(100):
        t, taken = k * dt, k * dt - late
        x = task.value(AT + max(taken, 0.0) * speed)
        seen = aj.Measurement(t, AT + t * speed, speed, x, None if age is None else taken)
        state = kinematics.initial_state(seen) if state is None else state
        state = kinematics.step(state, seen, dt)
    report = kinematics.report(state)
    assert (report.seconds > 0.2) == is_known
    assert_allclose(kinematics.learnt(state), [row.believed for row in report.rows], atol=1e-5)


@pytest.mark.parametrize("dt", [1e-3, 4e-3, 7e-3])
@pytest.mark.parametrize("age", [0.05, 0.003, 0.0])
def test_a_delay_is_known_as_well_as_the_speed_of_x_tells(arm, dt, age):
    """Of frames of any age, at any period: 1/sd² = 1/sd₀² + Σ ‖Ĵq̇‖²/σ²."""
    kinematics = AdaptiveKinematics(aj.PositionTask(arm, axes="xz"), ("delay",), dt=dt)
    task, speed, state, told = kinematics.task, np.array([0.3, -0.4]), None, 0.02**-2
    frame = 0.028
    for k in range(round(0.6 / dt)):
        number = int(k * dt / frame + 1e-6)
        taken = number * frame - age
        seen = aj.Measurement(
            k * dt, AT + k * dt * speed, speed, task.value(AT + taken * speed), taken
        )
        state = kinematics.initial_state(seen) if state is None else state
        before = kinematics.report(state).rows[0].sd
        state = kinematics.step(state, seen, dt)
        if kinematics.report(state).rows[0].sd < before:
            rate = task.jacobian(AT + taken * speed) @ speed
            told += rate @ rate / kinematics.noise**2
    assert told > 2.0 * 0.02**-2
    assert_allclose(kinematics.report(state).rows[0].sd, told**-0.5, rtol=0.02)


@pytest.mark.parametrize("dt", [1e-3, 0.05, 0.2])
def test_what_is_predicted_follows_what_is_learnt_without_swinging_at_any_period(kinematics, dt):
    x = kinematics.task.value(AT)
    seen, away = aj.Measurement(0.0, AT, REST, x, 0.0), []
    state = kinematics.initial_state(seen)
    for k in range(1, 31 if dt > 0.01 else 401):
        seen = aj.Measurement(k * dt, AT, REST, x + [5e-3, 0.0], k * dt)
        state = kinematics.step(state, seen, dt)
        away.append(kinematics.predict(state, AT, REST, aj.Target(seen.x)).z[0])
    assert away[0] < -2e-3
    assert (np.diff(np.abs(away)) <= 1e-6).all()
    assert abs(away[-1]) < 1e-3


# -- how sure they are ---------------------------------------------------------------------------


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


@pytest.mark.parametrize("kind", ["turned", "turned in the plane", "of a known tracker"])
def test_where_x_was_seen_it_is_known_well_although_no_number_is(arm, panda, kind):
    """The covariance of x̂ = R p + b by that of tool, rotation and offset, which belong together."""
    in_plane = kind == "turned in the plane"
    robot, axes = (arm, "xz") if in_plane else (panda.with_object(0.1), "xyz")
    truth, turns = aj.PositionTask(robot, axes=axes), kind != "of a known tracker"
    task, R, b = truth, law.rotation_exp(np.array([0.7] if in_plane else [0.5, -0.4, 0.9])), 0.1
    if not turns:
        task = TrackerTask(robot, [0.5, -0.4, 0.9], [0.1, 0.1, 0.1])
    kinematics = AdaptiveKinematics(task, ("tool", "camera" if turns else "offset"))
    rng, q_0, state = np.random.default_rng(1), 0.4 * np.arange(1.0, robot.nv + 1.0), None
    for k in range(40):
        q = q_0 + 0.02 * rng.standard_normal(robot.nv)
        seen = aj.Measurement(k / RATE, q, 0.0 * q, R @ truth.value(q) + b, k / RATE)
        state = kinematics.initial_state(seen) if state is None else state
        state = kinematics.step(state, seen, 1.0 / RATE)
    learnt = dict(zip(kinematics.names, kinematics.learnt(state), strict=True))
    report = kinematics.report(state)
    if turns:
        turn = [value for name, value in learnt.items() if name.startswith("camera.")]
        R = law.rotation_exp(np.array(turn))

    def sd_of_x(q):
        rows, d = ["xyz".index(axis) for axis in axes], len(axes)
        p = R @ aj.PositionTask(kinematics.robot(state), axes=axes).value(q)
        of_tool = KinematicRegressor(robot)
        tool = R @ of_tool.linear(q, of_tool.theta)[0][:, -3:][rows]
        J = [tool, np.eye(d)] + ([(law.rotation.generators(d) @ p).T] if turns else [])
        J = np.concatenate(J, axis=1)
        assert J.shape[1] == len(report.covariance)
        return np.sqrt(np.diag(J @ report.covariance @ J.T))

    known = sd_of_x(q_0).max()
    assert known < 1.2 * kinematics.noise / np.sqrt(40)
    assert sd_of_x(-q_0).max() > 5.0 * known
    assert min(row.sd for row in report.rows if "offset" in row.name) > 5.0 * known
