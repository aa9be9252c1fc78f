"""Position and orientation of a tool that is other than believed, in the axes of any tracker."""

from types import SimpleNamespace

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from potentials import V1

import approxjac as aj
from approxjac import law
from approxjac.controllers import AdaptiveKinematics, PredictedMeasurement
from approxjac.errors import InvalidInputError
from approxjac.law import rotation_exp, rotation_log
from approxjac.robots import KinematicRegressor
from approxjac.tasks import PoseTrackerTask

HOME = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
TOOL = np.radians(40.0) * np.array([0.6, 0.48, 0.64])  # of the tool, from what is believed
TURN, OFFSET = np.radians(100.0) * np.array([0.28, 0.0, 0.96]), np.array([0.3, -0.2, 0.1])
SHIFTS = {"panda_joint2": [0.0, 0.02, 0.02], "panda_joint4": [0.02, 0.01, -0.02]}
NOISE = np.repeat([1e-3, 5e-3], 3)
DT = 4e-3


class Path:
    """A slow ellipse about a place beside the start, while the tool tilts to and fro."""

    def __init__(self, sensor, amplitude=1.0, period=8.0):
        self.start, self.amplitude, self.period = sensor.value(HOME), amplitude, period
        self.rotation = getattr(sensor, "rotation", np.zeros(3))

    def at(self, t):
        w, r = 2.0 * np.pi / self.period, min(t, 1.0)
        s = w * (r**3 - 0.5 * r**4 + max(t - 1.0, 0.0))
        ds, dds = w * (3.0 * r**2 - 2.0 * r**3), w * 6.0 * (r - r**2)
        a, b = np.array([0.08, 0.0, 0.0]), np.array([0.0, 0.05, 0.06])
        out, along = np.cos(s) * a + np.sin(s) * b, np.cos(s) * b - np.sin(s) * a
        axis, tilt = np.array([0.0, 0.6, 0.8]), 0.3
        R = rotation_exp(self.rotation)
        turned = pin.exp3(self.amplitude * tilt * np.sin(s) * axis) @ pin.exp3(
            np.array([-0.2, -0.2, -0.2])
        )
        R_0 = pin.Quaternion(self.start[3:]).toRotationMatrix()
        rates = [(ds * along, tilt * np.cos(s) * ds * axis)]
        rates += [(dds * along - ds**2 * out, tilt * (np.cos(s) * dds - np.sin(s) * ds**2) * axis)]
        v, a = (self.amplitude * np.concatenate([R @ p, R @ turn]) for p, turn in rates)
        p = self.start[:3] + R @ ([0.08, -0.12, 0.0] + self.amplitude * out)
        return aj.Target(np.concatenate([p, pin.Quaternion(R @ turned @ R.T @ R_0).coeffs()]), v, a)


def follow(kinematics, sensor, path, *, seconds=3.0, noise=NOISE, rate=60.0, delay=0.03, seed=0,
           spoil=None, look=None, tells_t_x=True):  # fmt: skip
    """Let an arm follow a path by q̇ = Ĵ⁺(feed − α s(z)); x is late and noisy."""
    rng, q, v, state = np.random.default_rng(seed), HOME.copy(), np.zeros(7), None
    frames, taken, errors, arrived = [], -1, [], (sensor.value(HOME), 0.0)
    for k in range(round(seconds / DT)):
        t, x = k * DT, sensor.value(q)
        if int(t * rate + 1e-6) > taken:
            taken = int(t * rate + 1e-6)
            seen = sensor.displaced(x, noise * rng.standard_normal(6))
            frames.append((seen if spoil is None else spoil(t, seen), t))
        while frames and frames[0][1] + delay <= t + 1e-9:
            arrived = frames.pop(0)
        measurement = aj.Measurement(t, q, v, arrived[0], arrived[1] if tells_t_x else None)
        state = kinematics.initial_state(measurement) if state is None else state
        state = kinematics.step(state, measurement, DT)
        target = path.at(t)
        z, J, _, feed, _, _ = kinematics.predict(state, q, v, target)
        wanted = feed - 4.0 * law.saturated(z, z, np.repeat([8.0, 4.0], 3))[0]
        G = J @ J.T + 1e-4 * np.eye(6)
        v = HOME - q + J.T @ np.linalg.solve(G, wanted - J @ (HOME - q))
        if look is not None:
            look(t, q, state)
        q = q + DT * v
        errors.append(sensor.error(x, target.x))
    return SimpleNamespace(state=state, errors=np.array(errors), q=q)


def late(errors):
    """Root mean square of position [mm] and orientation [mrad]."""
    p, turn = (np.sqrt(np.mean(np.sum(part**2, axis=1))) for part in np.hsplit(errors, 2))
    return 1e3 * p, 1e3 * turn


def learnt(kinematics, state, name):
    """Return three numbers that were learnt, such as those of "tool.r"."""
    told = dict(zip(kinematics.names, kinematics.learnt(state), strict=True))
    return np.array([told[name + axis] for axis in "xyz"])


@pytest.fixture(scope="module")
def belief(panda):
    return panda.with_object(0.0)


@pytest.fixture(scope="module")
def truth(panda):
    """A tool of 15 cm and 0.5 kg, turned by 40°, on links of other lengths."""
    held = panda.with_object(0.15, 0.5, axis="x")
    return held.with_kinematic_error(SHIFTS, {"object_tip_joint": TOOL})


@pytest.fixture(scope="module")
def sensor(truth):
    return PoseTrackerTask(truth, TURN, OFFSET)


@pytest.fixture(scope="module")
def turned_run(belief, sensor):
    kinematics = AdaptiveKinematics(aj.PoseTask(belief), noise=1e-3)
    return kinematics, follow(kinematics, sensor, Path(sensor))


def test_a_pose_is_followed_with_a_turned_tool_and_tracker(turned_run):
    kinematics, run = turned_run
    position, angle = late(run.errors[round(2.5 / DT) :])
    assert position < 2.0
    assert angle < 10.0
    for name, true in (("tool.r", TOOL), ("camera.r", TURN)):
        found = learnt(kinematics, run.state, name)
        assert np.linalg.norm(rotation_log(rotation_exp(found) @ rotation_exp(true).T)) < 0.03


@pytest.mark.parametrize(
    "unknown",
    [
        ("tool", "origins"),
        pytest.param("tool", marks=pytest.mark.study),
        ("origins", "offset"),
    ],
    ids=str,
)
def test_with_a_known_tracker_the_tool_is_an_average(belief, truth, panda, unknown):
    """A tool that is not unknown is taken as believed, but for an integral of what is left."""
    sensor = aj.PoseTask(truth)
    kinematics = AdaptiveKinematics(aj.PoseTask(belief), unknown, noise=1e-3)
    run = follow(kinematics, sensor, Path(sensor), seconds=1.7)
    position, angle = late(run.errors[round(1.5 / DT) :])
    if "tool" in unknown:
        assert position < (3.0 if "origins" in unknown else 8.0)
        assert angle < 10.0
        assert_allclose(learnt(kinematics, run.state, "tool.r"), TOOL, atol=5e-3)
    else:
        assert not any(name.startswith("tool") for name in kinematics.names)
        assert np.isfinite(run.errors).all()


def test_a_known_tracker_is_theorem_a(belief, truth):
    """V₁ never rises, with nine numbers for the rotation of the tool."""
    sensor = aj.PoseTask(truth)
    kinematics = AdaptiveKinematics(aj.PoseTask(belief), ("tool", "origins", "offset"))
    believed = KinematicRegressor(truth).theta
    true = np.concatenate([believed, rotation_exp(TOOL).T.ravel(), np.zeros(3)])
    P = len(true)
    values = []

    def look(t, q, state):
        sums = state[kinematics._at["sums"]]
        values.append(V1(np.linalg.inv(kinematics._estimator._unpack(sums)), true - sums[-P:]))

    follow(kinematics, sensor, Path(sensor), noise=0.0, delay=0.0, seconds=2.0, look=look)
    assert (np.diff(values) <= 1e-9 * np.array(values[:-1])).all()
    assert values[-1] < 0.75 * values[0]


@pytest.mark.parametrize("angle", [0.3, 3.0], ids=["near", "far"])
@pytest.mark.parametrize("kind", ["unknown", "known", "believed", "axes"])
def test_prediction_has_exact_derivatives(turned_run, belief, rng, kind, angle):
    """With a tracker that is learnt, that is the base's axes, or believed elsewhere; with axes."""
    kinematics, run = turned_run
    state, R = run.state.copy(), run.state[kinematics._at["R"]].reshape(3, 3)
    turned = kind == "unknown"
    if not turned:
        turn = TURN if kind == "believed" else np.zeros(3)
        kinds = ("tool", "origins", *(["axes", "delay"] if kind == "axes" else []))
        kinematics = AdaptiveKinematics(PoseTrackerTask(belief, turn), kinds)
        state = kinematics.initial_state(aj.Measurement(0.0, HOME, np.zeros(7), np.arange(7.0)))
        R = rotation_exp(turn)
    at = kinematics._at
    for name in ("u_dot", "b_dot", "R_spin", "T_spin"):
        state[at[name]] = 0.3 * rng.standard_normal(len(state[at[name]]))
    q, v, h = run.q, rng.standard_normal(7), 1e-5
    p, p_dot, p_ddot, w, w_dot, way = rng.standard_normal((6, 3))

    def rotation(part, name, s):
        return rotation_exp(s * state[at[name]]) @ state[at[part]].reshape(3, 3)

    R_f = kinematics._turn(q, state[at["u"]]).R
    R_x = R @ R_f @ rotation("T", "T_spin", 0.0)
    R_d = rotation_exp(angle * way / np.linalg.norm(way)) @ R_x

    def later(s):
        new = state.copy()
        for name in ("u", "b"):
            new[at[name]] += s * state[at[name + "_dot"]]
        if turned:
            new[at["R"]] = rotation("R", "R_spin", s).ravel()
        new[at["T"]] = rotation("T", "T_spin", s).ravel()
        now = rotation_exp(s * w + s * s / 2 * w_dot) @ R_d  # ω = w + s ẇ, to first order
        target = aj.Target(
            np.concatenate([p + s * p_dot + s * s / 2 * p_ddot, pin.Quaternion(now).coeffs()]),
            np.concatenate([p_dot + s * p_ddot, w + s * w_dot]),
            np.concatenate([p_ddot, w_dot]),
        )
        return kinematics.predict(new, q + s * v, v, target)

    now, after, before = later(0.0), later(h), later(-h)
    assert np.linalg.norm(now.z[3:]) == pytest.approx(angle)
    assert_allclose((after.z - before.z) / (2 * h), now.J @ v - now.x_d_dot + now.drift, atol=1e-6)
    assert_allclose((after.J - before.J) / (2 * h), now.J_dot, atol=1e-7)
    assert_allclose((after.x_d_dot - before.x_d_dot) / (2 * h), now.x_d_ddot, atol=1e-7)


def test_with_what_is_believed_z_is_that_of_the_task(belief, rng):
    """And at rest a target that does not move has no feed."""
    task = aj.PoseTask(belief)
    kinematics = AdaptiveKinematics(task, ("tool", "origins"))
    q = HOME + 0.1 * rng.standard_normal(7)
    state = kinematics.initial_state(aj.Measurement(0.0, q, np.zeros(7), task.value(q)))
    target = task.displaced(task.value(HOME), rng.standard_normal(6))
    z, J, J_dot, feed, feed_dot, drift = kinematics.predict(state, q, np.zeros(7), target=(
        aj.Target(target)))  # fmt: skip
    assert_allclose(z, task.error(task.value(q), target), atol=1e-12)
    assert_allclose(J, task.jacobian(q), atol=1e-12)
    for part in (J_dot, feed, feed_dot, drift):
        assert_allclose(part, 0.0, atol=1e-12)


def test_estimates_move_as_is_said(turned_run, sensor):
    """The rates in a state are those over the step that gave it; x̂ follows at the same pace."""
    kinematics, run = turned_run
    at, x = kinematics._at, sensor.value(run.q)
    after = kinematics.step(run.state, aj.Measurement(9.0, run.q, np.zeros(7), x, 8.99), 1e-3)
    for name, spin in (("R", "R_spin"), ("T", "T_spin")):
        turned = rotation_exp(1e-3 * after[at[spin]]) @ run.state[at[name]].reshape(3, 3)
        assert_allclose(after[at[name]], turned.ravel())
    for k in range(400):  # what is left after half a second is what is learnt meanwhile
        t = 9.01 + 1e-3 * k
        after = kinematics.step(after, aj.Measurement(t, run.q, np.zeros(7), x, 8.99), 1e-3)
    Theta, R = kinematics._estimator.estimate(after[at["sums"]])
    n = kinematics._n_u
    T = law.nearest_rotation(Theta[n - 9 : n].reshape(3, 3).T)
    goal = rotation_exp(after[at["integral"]][3:] / kinematics._length)
    goal = goal @ R @ kinematics._turn(run.q, Theta).R @ T
    z = kinematics.predict(
        after, run.q, np.zeros(7), aj.Target(np.append(x[:3], pin.Quaternion(goal).coeffs()))
    ).z
    assert_allclose(z[3:], 0.0, atol=1e-4)


@pytest.mark.parametrize(("off", "fastest"), [(2.5, 2.0 * np.pi), (0.1, 2.0)])
def test_a_tool_that_is_learnt_to_be_turned_far_turns_once_a_second_at_most(
    turned_run, sensor, off, fastest
):
    """What is controlled follows what is learnt, in 50 ms where that is near; x̂ does not jump."""
    kinematics, run = turned_run
    state, at, x = run.state.copy(), kinematics._at, sensor.value(run.q)
    turned = rotation_exp(off * np.array([0.6, 0.0, 0.8])) @ state[at["T"]].reshape(3, 3)
    state[at["T"]] = turned.ravel()
    after = kinematics.step(state, aj.Measurement(9.0, run.q, np.zeros(7), x, 8.99), 1e-3)
    assert_allclose(np.linalg.norm(after[at["T_spin"]]), fastest, rtol=0.1)


# -- what was learnt ---------------------------------------------------------------------------


def test_rotations_are_told(turned_run):
    kinematics, run = turned_run
    report = kinematics.report(run.state)
    assert [row.name for row in report.rows] == list(kinematics.names)
    rows = {row.name: row for row in report.rows}
    for name, true in (("tool.r", TOOL), ("camera.r", TURN)):
        turn = [rows[name + axis] for axis in "xyz"]
        assert {row.unit for row in turn} == {"rad"}
        assert {row.believed for row in turn} == {0.0}
        assert all(row.is_seen and row.share > 0.99 for row in turn)
        at = kinematics.names.index(name + "x")
        P = report.covariance[at : at + 3, at : at + 3]
        found = rotation_exp(np.array([row.value for row in turn]))
        error = rotation_log(found @ rotation_exp(true).T)
        assert error @ np.linalg.solve(P, error) < 14.0
    assert report.angle == pytest.approx(np.linalg.norm(TURN), abs=0.03)
    assert report.is_explained
    assert report.noise[1] == pytest.approx(1e-3, rel=0.2)
    assert "tool.rz" in str(report)
    assert_allclose(kinematics._sd[kinematics.names.index("tool.rx")], 1.0)


@pytest.mark.parametrize("tip", ["object_tip", "panda_hand", "panda_link7"])
def test_the_learnt_robot_has_the_pose_that_was_measured(panda, belief, tip, rng):
    """Whether the tool is a link of its own, or the frame is one that moves."""
    robot = belief if tip == "object_tip" else panda
    task = aj.PoseTask(robot, tip)
    kinematics = AdaptiveKinematics(task, ("tool", "origins"))
    state = kinematics.initial_state(aj.Measurement(0.0, HOME, np.zeros(7), task.value(HOME)))
    told = state[kinematics._at["learnt"]]
    told[:] += 0.1 * rng.standard_normal(len(told))
    found = kinematics.robot(state)
    q = panda.random_configuration(rng)
    theta = kinematics.regressor.theta * 0.0 + told[:-3]
    frame = found.tip if tip != "panda_hand" else tip
    pose = aj.PoseTask(found, frame).value(q)
    assert_allclose(pose[:3], kinematics.regressor.position(q, theta), atol=1e-9)
    R = task._frame.placement(q)[0] @ rotation_exp(told[-3:])
    assert_allclose(pin.Quaternion(pose[3:]).toRotationMatrix(), R, atol=1e-9)


def test_what_was_learnt_is_the_next_belief(turned_run, sensor):
    """A tracker that is believed where it is, and a state that is gone on with."""
    kinematics, run = turned_run
    turn, offset = (learnt(kinematics, run.state, name) for name in ("camera.r", "offset."))
    task = PoseTrackerTask(kinematics.robot(run.state), turn, offset)
    again = AdaptiveKinematics(task, "tool", {"tool": 0.02, "orientation": 0.02}, noise=1e-3)
    position, angle = late(follow(again, sensor, Path(sensor), seconds=1.6).errors[-40:])
    assert position < 6.0
    assert angle < 10.0
    start = aj.Measurement(0.0, run.q, np.zeros(7), sensor.value(run.q), 0.0)
    resumed = kinematics.resumed(run.state, start)
    target = aj.Target(sensor.value(HOME))
    z, before = (kinematics.predict(s, HOME, np.zeros(7), target).z for s in (resumed, run.state))
    assert_allclose(z, before, atol=1e-12)


@pytest.mark.long
def test_the_covariance_of_rotations_is_honest(panda, belief):
    """Any tool and tracker, over twelve seeds; normalised errors are χ² with 3 d.o.f."""
    found = {"tool.r": [], "camera.r": []}
    for seed in range(12):
        rng = np.random.default_rng(100 + seed)
        axes = rng.standard_normal((2, 3))
        tool, turn = (rng.uniform(0.0, 3.0) * axis / np.linalg.norm(axis) for axis in axes)
        shifts = {joint: list(0.012 * rng.standard_normal(3)) for joint in panda.joint_names}
        held = panda.with_object(0.15, axis="x")
        arm = held.with_kinematic_error(shifts, {"object_tip_joint": tool})
        sensor = PoseTrackerTask(arm, turn, OFFSET)
        kinematics = AdaptiveKinematics(aj.PoseTask(belief), noise=1e-3)
        run = follow(kinematics, sensor, Path(sensor), seconds=6.0, seed=seed)
        position, angle = late(run.errors[round(5.0 / DT) :])
        assert position < 2.0
        assert angle < 5.0
        P = kinematics.report(run.state).covariance
        for name, true in (("tool.r", tool), ("camera.r", turn)):
            at = kinematics.names.index(name + "x")
            R = rotation_exp(learnt(kinematics, run.state, name))
            error = rotation_log(R @ rotation_exp(true).T)
            found[name].append(error @ np.linalg.solve(P[at : at + 3, at : at + 3], error))
    for values in found.values():
        assert 0.216 < np.median(values) < 9.35
        assert np.sum(np.array(values) > 7.8) <= 3


# -- sensors as they are -------------------------------------------------------------------------


def test_control_goes_on_where_x_is_lost_or_no_pose(turned_run, belief, sensor):
    """Lost as a whole, only the orientation, no rotation at all, of another sign; or a jump."""
    kinematics, _ = turned_run

    def spoil(t, x):
        if 2.0 < t < 2.6:
            return np.full(7, np.nan)
        if 2.6 < t < 2.7:
            return np.append(x[:3], [np.nan, 0.0, 0.0, 1.0])
        if 2.7 < t < 2.75:
            return np.append(x[:3], np.zeros(4))
        if 2.8 < t < 2.85:  # three frames that are turned by 90°
            return sensor.displaced(x, np.array([0.0, 0.0, 0.0, 1.6, 0.0, 0.0]))
        return x * np.where(np.arange(7) < 3, 1.0, -3.0)

    run = follow(kinematics, sensor, Path(sensor), spoil=spoil)
    assert np.isfinite(run.state).all()
    blind = run.errors[round(2.0 / DT) :]
    assert np.linalg.norm(blind[:, :3], axis=1).max() < 8e-3
    assert np.linalg.norm(blind[:, 3:], axis=1).max() < 15e-3
    assert kinematics.report(run.state).restarts == 0


@pytest.mark.parametrize("x", [np.full(7, np.nan), np.full(7, 1e30), np.zeros(7)], ids=str)
def test_nothing_that_is_measured_makes_a_state_that_is_not_finite(belief, x):
    for unknown in (("tool", "origins", "camera"), "origins"):
        kinematics = AdaptiveKinematics(aj.PoseTask(belief), unknown)
        state = kinematics.initial_state(aj.Measurement(0.0, HOME, np.zeros(7), x))
        for k in range(20):
            x_k = x if k % 3 else np.array([0.3, 0.1, 0.5, 0.0, 0.6, 0.0, 0.8])
            for t_x in (None, 0.02 * k):
                measurement = aj.Measurement(0.02 * k, HOME, np.zeros(7), x_k, t_x)
                state = kinematics.step(state, measurement, 0.02)
        assert np.isfinite(state).all()
        assert np.abs(kinematics.learnt(state)).max() < 10.0


@pytest.mark.parametrize(
    "unknown",
    [pytest.param(("tool", "origins", "camera"), marks=pytest.mark.study), "origins"],
    ids=str,
)
def test_nonsense_is_answered_finitely_or_refused(panda, unknown):
    """One number in half of the steps is absurd; the state goes on from what came before."""
    task, rng, refused = aj.PoseTask(panda), np.random.default_rng(3), 0
    law = aj.TrackingController(task, kinematics=AdaptiveKinematics(task, unknown))
    controller = law.guarded(None)  # which would refuse most of it
    state = controller.initial_state(aj.Measurement(0.0, HOME, np.zeros(7), task.value(HOME)))
    for k in range(200):
        q, v = HOME + 0.1 * rng.normal(size=7), 0.3 * rng.normal(size=7)
        told = {"q": q, "v": v, "x": task.displaced(task.value(q), 0.01 * rng.normal(size=6))}
        if rng.random() < 0.5:
            spoilt = told[rng.choice(list(told))]
            spoilt[rng.integers(7)] = rng.choice([np.nan, np.inf, 5e-324, 1e16, -1e31, 1e154])
        target = task.displaced(task.value(HOME), 3.0 * rng.normal(size=6))
        try:
            after, answer = controller.step(state, aj.Measurement(5e-3 * k, **told), target, 1e-3)
        except aj.errors.ApproxJacError:
            refused += 1
        else:
            assert np.isfinite(answer.torque).all()
            assert np.isfinite(after).all()
            state = after
    assert 10 < refused < 90


# -- laws ----------------------------------------------------------------------------------------


def plant_of(sensor, **sensing):
    noisy = {"x_noise": NOISE, "x_rate": 60.0, "x_delay": 0.03} | sensing
    truth = sensor.robot
    return aj.Plant(
        truth, sensor, sensing=aj.Sensing(**noisy), torque_limits=truth.effort_limits
    )  # fmt: skip


def simulated(plant, controller, target, seconds, dt=2e-3):
    return aj.simulate(
        plant, controller, target, HOME, seconds, dt=dt, record_every=0.01,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )  # fmt: skip


@pytest.mark.study
def test_law_t_reaches_a_pose_and_goes_on_without_x(belief, sensor):
    plant = plant_of(sensor, x_lost=((1.7, 1.95),))
    task, dt = aj.PoseTask(belief), 2e-3
    kinematics = AdaptiveKinematics(task, noise=1e-3, delay=0.03, dt=dt)
    controller = aj.TrackingController(task, kinematics=kinematics, dt=dt)
    run = simulated(plant, controller, Path(sensor, amplitude=0.0), 2.0)
    position, angle = late(run.error[run.t > 1.7])
    assert position < 2.0
    assert angle < 10.0
    lost = run.status[(run.t > 1.75) & (run.t < 1.95)]
    assert set(lost) == {aj.Status.PREDICTED}


def test_a_set_point_law_on_what_is_predicted_is_the_law_itself(belief):
    """Where x is as the believed arm would measure it."""
    task = aj.PoseTask(belief)
    law_ = aj.SetpointController(task, gravity=aj.AdaptiveGravity(belief))
    predicted = PredictedMeasurement(law_, AdaptiveKinematics(task, ("tool", "origins")))
    measurement = aj.Measurement(0.0, HOME, np.full(7, 0.1), task.value(HOME), 0.0)
    target = task.displaced(measurement.x, np.full(6, 0.1))
    _, wanted = law_.step(law_.initial_state(measurement), measurement, target, 1e-3)
    _, found = predicted.step(predicted.initial_state(measurement), measurement, target, 1e-3)
    assert_allclose(found.torque, wanted.torque, atol=1e-9)
    assert_allclose(found.e, wanted.e, atol=1e-12)


@pytest.mark.long  # in short: scenario/test_run.py
@pytest.mark.parametrize("kind", ["set-point", "path", "set-point law"])
def test_a_pose_is_reached_and_followed_to_a_millimetre(belief, sensor, kind):
    """In 8 s: after 6 s 0.12 mm and 0.8 mrad rms at rest, 0.46 mm and 1.0 mrad on the path."""
    task, dt = aj.PoseTask(belief), 2e-3
    kinematics = AdaptiveKinematics(task, noise=1e-3, delay=0.03, dt=dt)
    controller = aj.TrackingController(task, kinematics=kinematics, dt=dt)
    path = Path(sensor, amplitude=float(kind == "path"))
    if kind == "set-point law":
        law_ = aj.SetpointController(task, gravity=aj.AdaptiveGravity(belief))
        controller, path = PredictedMeasurement(law_, kinematics), path.at(0.0).x
    run = simulated(plant_of(sensor), controller, path, 6.0)
    position, angle = late(run.error[run.t > 4.5])
    assert position < 1.0
    assert angle < 2.5
    assert (np.abs(run.v) <= 1.05 * belief.velocity_limits).all()


def test_the_torque_does_not_depend_on_the_true_robot(belief, truth, panda):
    """The same measurement of another arm, and of x at the same step, gives the same bits."""
    task = aj.PoseTask(belief)
    controller = aj.TrackingController(task)
    assert controller.kinematics.unknown == ("tool", "origins", "axes")
    x = aj.PoseTask(truth).value(HOME)
    target, torques = task.displaced(x, np.full(6, 0.1)), []
    for arm in (truth, panda):
        plant = aj.Plant(arm, aj.PoseTask(arm))
        assert plant.robot is arm
        measurement = aj.Measurement(0.0, HOME, np.zeros(7), x, 0.0)
        state, _ = controller.step(controller.initial_state(measurement), measurement, target, 1e-3)
        after, answer = controller.step(state, measurement._replace(t=1e-3), target, 1e-3)
        _, other = controller.step(
            state, measurement._replace(t=1e-3, x=task.displaced(x, np.full(6, 0.01))), target, 1e-3
        )
        assert_array_equal(answer.torque, other.torque)
        torques.append((answer.torque, after))
    assert_array_equal(torques[0][0], torques[1][0])
    assert_array_equal(torques[0][1], torques[1][1])


def test_what_makes_no_sense_is_refused(belief):
    """As tests/error_texts.txt has it, and"""
    task = aj.PoseTask(belief)
    with pytest.raises(InvalidInputError, match="sd of orientation must be a finite number > 0"):
        AdaptiveKinematics(task, sd={"orientation": -1.0})
