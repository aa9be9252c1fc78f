"""Tool, origins and camera learnt while an arm follows a circle by its velocities."""

from types import SimpleNamespace

import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac import law
from approxjac.controllers import AdaptiveKinematics
from approxjac.law import rotation_exp, rotation_log

START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
ALPHA, FASTEST, DT = 4.0, 0.5, 2e-3


def wrong_arm(arm, rng, length=0.2, shift=0.03, tilt=0.0):
    """An arm that holds a tool, with its joint origins elsewhere and its axes tilted."""
    shifts, turns = {}, {}
    for joint in arm.joint_names:
        a, b = rng.standard_normal((2, 3))
        shifts[joint] = list(shift * a / np.linalg.norm(a))
        turns[joint] = list(np.radians(tilt) * b / np.linalg.norm(b))
    return arm.with_kinematic_error(shifts, turns).with_object(length, axis="x")


def circle(center, R, t, radius=0.1, period=4.0):
    """A circle that is eased into, turned as the tracker is."""
    w = 2 * np.pi / period
    phase, rate, bend = (w * (t - 0.5), w, 0.0) if t > 1 else (w * t * t / 2, w * t, w)
    a, b = R @ [radius, 0.0, 0.0], R @ [0.0, 0.6 * radius, 0.8 * radius]
    along, inward = -np.sin(phase) * a + np.cos(phase) * b, np.cos(phase) * a + np.sin(phase) * b
    return aj.Target(center + inward, rate * along, bend * along - rate**2 * inward)


def follow(
    kinematics, truth, R=None, b=(0.1, -0.05, 0.05), *, seconds=5.0, rate=60.0, delay=0.03,
    noise=2e-3, seed=0, at_rest=False, spoil=None, tells_t_x=True, state=None, look=None,
):  # fmt: skip
    """Let an arm follow the circle by q̇ = Ĵ⁺(feed − α s(z)), with a lag; x is late and noisy."""
    R = np.eye(3) if R is None else R
    rng, sensor = np.random.default_rng(seed), aj.PositionTask(truth, axes="xyz")
    q, v = START.copy(), np.zeros(7)
    x = R @ sensor.value(q) + b
    center = x + R @ [0.10, -0.15, 0.12]
    frames, arrived, taken, errors = [], (x, 0.0), -1, []
    for k in range(round(seconds / DT)):
        t = k * DT
        x = R @ sensor.value(q) + b
        if int(t * rate + 1e-6) > taken:
            taken += 1
            seen = x + noise * rng.standard_normal(3)
            frames.append((seen if spoil is None else spoil(t, seen), t))
        while frames and frames[0][1] + delay <= t + 1e-9:
            arrived = frames.pop(0)
        measurement = aj.Measurement(t, q, v, arrived[0], arrived[1] if tells_t_x else None)
        if state is None:
            state = kinematics.initial_state(measurement)
        state = kinematics.step(state, measurement, DT)
        target = circle(center, R, t)
        if at_rest:
            target = aj.Target(center, np.zeros(3), np.zeros(3))
        z, J, _, feed, _, _ = kinematics.predict(state, q, v, target)
        wanted = feed - ALPHA * z / np.sqrt(1.0 + (ALPHA * np.linalg.norm(z) / FASTEST) ** 2)
        rest = START - q
        G = J @ J.T + 1e-4 * np.eye(3)
        wanted = rest + J.T @ np.linalg.solve(G, wanted - J @ rest)
        if look is not None:
            look(t, q, v, state, target)
        v = v + DT / 0.015 * (wanted - v)
        q = q + DT * v
        errors.append(np.linalg.norm(x - target.x))
    return SimpleNamespace(state=state, errors=np.array(errors), q=q, x=x)


def late(run, start, end):
    """Root mean square of the error in an interval [m]."""
    return np.sqrt(np.mean(run.errors[int(start / DT) : int(end / DT)] ** 2))


@pytest.fixture(scope="module")
def belief(panda):
    return panda.with_object(0.0)


@pytest.fixture(scope="module")
def truth(panda):
    return wrong_arm(panda, np.random.default_rng(0))


@pytest.fixture(scope="module")
def turned_run(belief, truth):
    R = rotation_exp(np.array([0.2, -0.3, 2.4]))
    kinematics = AdaptiveKinematics(belief)
    return kinematics, R, follow(kinematics, truth, R, seconds=6.0)


@pytest.mark.parametrize(
    "turn", [(0, 0, 0.0), (0, 0, np.pi), (0.5, 0, -2.1), (3.0, 0.4, 0)], ids=str
)
def test_a_circle_is_followed_with_an_unknown_tool_and_any_rotation(belief, truth, turn):
    kinematics, R = AdaptiveKinematics(belief), rotation_exp(np.array(turn, dtype=float))
    run = follow(kinematics, truth, R)
    assert late(run, 4.0, 5.0) < 2e-3
    assert run.errors.max() < 1.5 * run.errors[0]
    learnt = dict(zip(kinematics.names, kinematics.learnt(run.state), strict=True))
    found = rotation_exp(np.array([learnt[f"camera.r{axis}"] for axis in "xyz"]))
    assert np.linalg.norm(rotation_log(found @ R.T)) < np.radians(3.0)


def test_what_was_learnt_is_told(turned_run, truth):
    kinematics, R, run = turned_run
    report = kinematics.report(run.state)
    names = [row.name for row in report.rows]
    assert names == list(kinematics.names)
    tool = names.index("tool.x")
    true_tool = aj.robots.KinematicRegressor(truth).theta[-3:]
    P = report.covariance[tool : tool + 3, tool : tool + 3]
    error = np.array([row.value for row in report.rows[tool : tool + 3]]) - true_tool
    assert error @ np.linalg.solve(P, error) < 14.0
    assert report.rows[tool].is_seen
    assert not report.rows[names.index("panda_joint1.z")].is_seen
    assert report.angle == pytest.approx(np.linalg.norm(rotation_log(R)), abs=0.05)
    assert report.is_explained
    for part in ("tool.x", "not seen", "camera turned by", "chi squared a degree of freedom"):
        assert part in str(report)


def test_the_learnt_robot_says_where_x_is(turned_run, truth, rng):
    kinematics, R, run = turned_run
    robot = kinematics.robot(run.state)
    found, sensor = aj.PositionTask(robot, axes="xyz"), aj.PositionTask(truth, axes="xyz")
    learnt = dict(zip(kinematics.names, kinematics.learnt(run.state), strict=True))
    turn = rotation_exp(np.array([learnt[f"camera.r{axis}"] for axis in "xyz"]))
    offset = np.array([learnt[f"offset.{axis}"] for axis in "xyz"])
    for q in run.q + 0.05 * rng.standard_normal((5, 7)):
        x = R @ sensor.value(q) + [0.1, -0.05, 0.05]
        assert_allclose(turn @ found.value(q) + offset, x, atol=8e-3)


def test_a_known_camera_is_theorem_a(belief, truth):
    """V₁ never rises, whatever the motion; and each frame lets it fall by what is said."""
    kinematics = AdaptiveKinematics(belief, ("tool", "origins", "offset"))
    exact = aj.robots.KinematicRegressor(truth).theta
    true = np.concatenate([exact, [0.1, -0.05, 0.05]])
    values = []

    def look(t, q, v, state, target):
        sums, P = state[kinematics._at["sums"]], len(true)
        values.append(law.V1(sums[:-P].reshape(P, P), true - sums[-P:]))

    run = follow(kinematics, truth, noise=0.0, delay=0.0, rate=500.0, look=look, seconds=3.0)
    assert (np.diff(values) <= 1e-9 * np.array(values[:-1])).all()
    assert late(run, 2.5, 3.0) < 2e-3


def test_prediction_has_exact_derivatives(turned_run):
    kinematics, _, run = turned_run
    rng = np.random.default_rng(3)
    state = run.state + 0.0
    at = kinematics._at
    state[at["u_dot"]] = 0.1 * rng.standard_normal(len(kinematics._unknowns.Theta) - 3)
    state[at["b_dot"]], state[at["spin"]] = 0.1 * rng.standard_normal((2, 3))
    q, v = run.q, rng.standard_normal(7)
    x, x_dot, x_ddot = rng.standard_normal((3, 3))
    h = 1e-5

    def later(s):
        new = state.copy()
        new[at["u"]] += s * state[at["u_dot"]]
        new[at["b"]] += s * state[at["b_dot"]]
        turned = rotation_exp(s * state[at["spin"]]) @ state[at["R"]].reshape(3, 3)
        new[at["R"]] = turned.ravel()
        target = aj.Target(x + s * x_dot + s * s / 2 * x_ddot, x_dot + s * x_ddot, x_ddot)
        return kinematics.predict(new, q + s * v, v, target)

    now, after, before = later(0.0), later(h), later(-h)
    z_dot = now.J @ v - now.feed + now.drift
    assert_allclose((after.z - before.z) / (2 * h), z_dot, atol=1e-7)
    assert_allclose((after.J - before.J) / (2 * h), now.J_dot, atol=1e-7)
    assert_allclose((after.feed - before.feed) / (2 * h), now.feed_dot, atol=1e-7)


def test_a_state_goes_in_and_another_comes_out(turned_run):
    kinematics, _, run = turned_run
    state = run.state.copy()
    measurement = aj.Measurement(9.0, run.q, np.zeros(7), run.x, 8.99)
    once, again = (kinematics.step(state, measurement, DT) for _ in range(2))
    assert np.array_equal(once, again)
    assert np.array_equal(state, run.state)
    assert once.shape == (kinematics.n_state,)
    series = np.stack([state, once])
    assert kinematics.learnt(series).shape == (2, len(kinematics.names))


def test_a_tracker_that_jumps_does_not_spoil_what_was_learnt(belief, truth):
    def spoil(t, x):
        return x + [0.3, -0.2, 0.1] if 3.0 < t < 3.049 else x

    R = rotation_exp(np.array([0.0, 0.0, 1.0]))
    clean, spoilt = (
        follow(AdaptiveKinematics(belief), truth, R, spoil=each) for each in (None, spoil)
    )
    assert late(spoilt, 3.0, 3.5) < late(clean, 3.0, 3.5) + 1e-3


def test_a_tracker_that_was_moved_is_learnt_anew(belief, truth):
    def spoil(t, x):
        return x + [0.3, -0.2, 0.1] if t > 3.0 else x

    R = rotation_exp(np.array([0.0, 0.0, 1.0]))
    seen = []
    kinematics = AdaptiveKinematics(belief)

    def look(t, q, v, state, target):
        if t > 4.0:
            at = kinematics._at
            p = kinematics.regressor.Y(q) @ (kinematics._unknowns.S @ state[at["u"]])
            predicted = state[at["R"]].reshape(3, 3) @ p + state[at["b"]]
            true = R @ aj.PositionTask(truth, axes="xyz").value(q) + [0.4, -0.25, 0.15]
            seen.append(np.linalg.norm(predicted - true))

    follow(kinematics, truth, R, spoil=spoil, look=look)
    assert np.mean(seen) < 6e-3


def test_without_x_control_goes_on(belief, truth):
    def spoil(t, x):
        return np.full(3, np.nan) if 3.0 < t < 4.5 else x

    R = rotation_exp(np.array([0.0, 0.0, 1.0]))
    run = follow(AdaptiveKinematics(belief), truth, R, spoil=spoil, seconds=5.5)
    assert np.isfinite(run.state).all()
    assert run.errors[int(3.0 / DT) :].max() < 15e-3
