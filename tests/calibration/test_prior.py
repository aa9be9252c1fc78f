"""Online learning that begins with a calibration: its numbers with their whole covariance."""

import copy
import pickle

import numpy as np
import pytest
from beliefs import belief_of
from numpy.testing import assert_allclose, assert_array_equal
from tests.calibration.test_calibrate import needs_recordings, real, sockets
from tests.controllers.test_learnt_axes import AXES, DT, LATE, Arm

import approxjac as aj
from approxjac import law
from approxjac.calibration import Recording, calibrate
from approxjac.codegen import compiled
from approxjac.controllers import AdaptiveKinematics, PredictedMeasurement
from approxjac.robots import KinematicBelief, KinematicRegressor

SOCKETS = {"noise": 1e-3, "delay": LATE, "dt": DT}


def drawn_arm(name, seed, belief, turn=0.0):
    """Return an arm whose numbers are drawn from a belief, and these."""
    arm = Arm(name, seed, turn)
    L = np.linalg.cholesky(belief.covariance)
    arm.theta = belief.learnt + L @ np.random.default_rng(seed).normal(size=len(L))
    return arm


# -- the numbers, about any drawing of the arm ----------------------------------------------


@pytest.mark.parametrize("name", ["panda", "ur5", "kinova", "xarm7"])
def test_about_drawing_and_learnt_robot_it_is_the_same_arm(name):
    """Positions, and their covariance by finite differences: its angles have other origins."""
    drawing = aj.load_robot(name)
    belief, robot = belief_of(drawing, off=20.0)
    some = [*drawing.configurations(25)]
    each = []
    for of in (drawing, robot):
        regressor = KinematicRegressor(of, axes=True)
        mean, P = belief.about(regressor, belief.names)
        p = np.array([regressor.position(q, mean) for q in some])
        H = np.vstack([_slopes(regressor, q, mean) for q in some])
        each.append((p, H @ P @ H.T))
        assert (np.linalg.eigvalsh(P) > 0.0).all()
    (p, C), (other, other_C) = each
    assert_allclose(other, p, atol=1e-12)
    assert_allclose(other_C, C, rtol=0, atol=1e-6 * np.abs(C).max())


def _slopes(regressor, q, theta, step=1e-6):
    ways = step * np.eye(regressor.p)
    ends = [regressor.position(q, theta + w) - regressor.position(q, theta - w) for w in ways]
    return np.array(ends).T / (2.0 * step)


def test_of_the_learnt_robot_its_own_numbers_are_the_mean():
    belief, robot = belief_of(aj.load_robot("panda"), off=5.0)
    regressor = KinematicRegressor(robot, axes=True)
    mean, P = belief.about(regressor, regressor.names)
    assert_allclose(mean, regressor.theta, atol=1e-12)
    lengths = slice(regressor.n_lengths)
    assert_allclose(P[lengths, lengths], belief.covariance[lengths, lengths], atol=1e-18)


def test_what_is_saved_comes_back(tmp_path):
    belief, _ = belief_of(aj.load_robot("ur5"))
    path = belief.save(tmp_path / "arm.npz")
    again = KinematicBelief.load(path)
    assert [p.name for p in tmp_path.iterdir()] == ["arm.npz"]
    for name, value in vars(belief).items():
        assert_array_equal(getattr(again, name), value)
        assert type(getattr(again, name)) is type(value)
    (tmp_path / "run.npz").write_bytes(path.read_bytes()[:-200])
    np.savez(tmp_path / "other.npz", names=["x"])
    for file in ("none.npz", "run.npz", "other.npz"):
        with pytest.raises(aj.InvalidInputError, match=rf"file of Calibration.save, got .*{file}"):
            KinematicBelief.load(tmp_path / file)
    with pytest.raises(aj.InvalidInputError, match="path must be a file to write, got"):
        belief.save(tmp_path / "no folder" / "arm.npz")


# -- the estimator --------------------------------------------------------------------------


@pytest.mark.parametrize("camera", [(), ("camera",)])
def test_learning_begins_with_mean_and_covariance(camera):
    drawing = aj.load_robot("panda")
    belief, robot = belief_of(drawing, off=3.0)
    usual = AdaptiveKinematics(drawing, (*AXES, *camera), **SOCKETS)
    for of in (drawing, robot):
        kinematics = AdaptiveKinematics(of, ("tool", *camera), prior=belief, **SOCKETS)
        assert kinematics.names == usual.names
        assert kinematics.n_state == usual.n_state
        q = drawing.neutral()
        still = np.zeros(7)
        seen = aj.Measurement(0.0, q, still, np.full(3, np.nan), -np.inf)
        state, n = kinematics.initial_state(seen), len(belief.names)
        report = kinematics.report(state)
        mean, P = belief.about(kinematics.regressor, belief.names)
        assert_allclose(kinematics.learnt(state)[:n], mean, atol=1e-12)
        assert_allclose(report.covariance[:n, :n], P, rtol=1e-6, atol=1e-6 * P.max())
        assert_allclose([row.share for row in report.rows[:n]], 0.0, atol=1e-6)
        target = aj.Target(aj.PositionTask(robot).value(q))
        assert_allclose(kinematics.predict(state, q, still, target).z, 0.0, atol=1e-12)
        for name in kinematics.names[n:]:  # the tracker's
            i = kinematics.names.index(name)
            assert report.rows[i].sd == pytest.approx(0.2 if "offset" in name else 1.0, rel=1e-6)


def test_with_a_prior_it_is_least_squares_with_that_prior():
    """Of lengths alone all is linear: by one solution for all frames, before any are forgotten."""
    drawing = aj.load_robot("ur5")
    belief, _ = belief_of(drawing, off=4.0, kinds=("tool", "origins"))
    kinematics = AdaptiveKinematics(drawing, ("tool",), noise=1e-3, dt=DT, prior=belief)
    rng, still, state = np.random.default_rng(0), np.zeros(6), None
    N, a = np.linalg.inv(belief.covariance), np.zeros(len(belief.names))
    for k in range(5):
        q, t = rng.uniform(-1.5, 1.5, 6), 0.02 * k
        x = aj.PositionTask(drawing).value(q) + rng.normal(0.0, 5e-3, 3)
        if k:
            H, o = kinematics.regressor.linear(q, kinematics.regressor.theta)
            N, a = N + H.T @ H / 1e-6, a + H.T @ (x - o - H @ belief.learnt) / 1e-6
        seen = aj.Measurement(t, q, still, x, t)
        if state is None:
            state = kinematics.initial_state(seen._replace(x=np.full(3, np.nan), t_x=-np.inf))
            continue
        state = kinematics.step(state, seen, DT)
    assert_allclose(kinematics.learnt(state), belief.learnt + np.linalg.solve(N, a), atol=1e-8)


def test_forgetting_ends_at_a_whole_prior():
    rng = np.random.default_rng(3)
    A = rng.normal(size=(5, 5))
    first = np.linalg.inv(A @ A.T + np.eye(5))  # P₀
    H = rng.normal(size=(2, 5))
    P = first - law.gain(first, H, 0.1) @ H @ first
    after = law.forgotten(P, np.linalg.inv(first), 1e-3)
    exactly = np.linalg.inv(0.999 * np.linalg.inv(P) + 1e-3 * np.linalg.inv(first))
    assert_allclose(after, exactly, atol=1e-5 * P.max())
    assert np.linalg.eigvalsh(after - P)[0] > -1e-12
    assert np.linalg.eigvalsh(first - after)[0] > -1e-12
    assert_allclose(law.forgotten(first, np.linalg.inv(first), 0.5), first, atol=1e-12)


@pytest.mark.parametrize("turn", [0.0, pytest.param(1.0, marks=pytest.mark.study)])
def test_sockets_then_a_tracker(turn):
    """Errors far from the motion are small at once, and become smaller; without they are not."""
    arm = Arm("panda", 71)
    recordings, apart = sockets(arm, 1)
    found = calibrate(arm.believed, recordings, apart=apart)
    if turn:
        moved = Arm("panda", 71, turn)
        arm.R, arm.b = moved.R, moved.b
    kinds = ("tool", "origins", "camera") if turn else ("tool", "origins")
    left = {}
    for prior in (None, found):
        unknown = (*kinds, "axes") if prior is None else kinds
        kinematics = AdaptiveKinematics(found.robot, unknown, prior=prior, **SOCKETS)
        for seconds in (3.0, 12.0):
            arm.rng = np.random.default_rng(2)
            state = arm.followed(kinematics, seconds)
            left[prior, seconds] = np.median(arm.elsewhere(kinematics, state)[0])
        report = kinematics.report(state)
        assert report.is_explained
        assert report.restarts == 0
    assert left[found, 3.0] < 0.5e-3
    assert left[found, 3.0] < 0.2 * left[None, 3.0]
    assert left[found, 12.0] < min(0.2e-3, left[found, 3.0], left[None, 12.0])


def test_drawn_arms_are_as_far_off_as_the_covariance_says():
    """NEES of all 45 numbers, of twelve arms from the prior, before and after learning."""
    belief, robot = belief_of(aj.load_robot("panda"), off=2.0)
    before, after = [], []
    for seed in range(12):
        arm = drawn_arm("panda", seed, belief)
        kinematics = AdaptiveKinematics(robot, prior=belief, unknown=("tool",), **SOCKETS)
        state = arm.followed(kinematics, 3.0)
        of = kinematics.regressor
        truth = KinematicBelief(
            of.names, of.units, of.theta, arm.theta, np.eye(of.p), belief.rotations,
            belief.frames, belief.kinds,
        ).about(of, of.names)[0]  # fmt: skip
        mean, P = belief.about(of, of.names)
        before.append((truth - mean) @ np.linalg.solve(P, truth - mean) / of.p)
        off, P = kinematics.learnt(state) - truth, kinematics._covariance(state)[0]
        after.append(off @ np.linalg.solve(P, off) / of.p)
        assert np.trace(np.linalg.solve(belief.covariance, P)) < of.p
    # a mean of 540 squares has an sd of 0.06
    assert np.mean(before) == pytest.approx(1.0, abs=0.2)
    assert 0.8 < np.mean(after) < 1.2


def test_a_new_tool_is_learnt_and_the_rest_stays():
    arm = Arm("panda", 71)
    recordings, apart = sockets(arm, 1)
    found = calibrate(arm.believed, recordings, apart=apart)
    arm.theta[arm.tool] += [-0.08, 0.05, 0.06]
    left = {}
    for sd in (None, {"tool": 0.2}):
        kinematics = AdaptiveKinematics(found.robot, ("tool",), sd=sd, prior=found, **SOCKETS)
        arm.rng = np.random.default_rng(4)
        state = arm.followed(kinematics, 10.0)
        left[sd is None] = np.median(arm.elsewhere(kinematics, state)[0])
    assert left[False] < 0.4e-3
    assert left[False] < 0.1 * left[True]
    seen = aj.Measurement(0.0, arm.q0, np.zeros(7), np.full(3, np.nan), -np.inf)
    P = kinematics.report(kinematics.initial_state(seen)).covariance
    tool = arm.tool
    assert_allclose(P[tool, tool], 0.04 * np.eye(3), rtol=1e-9, atol=1e-12)
    rest = np.delete(np.arange(len(P)), tool)
    assert_allclose(P[np.ix_(rest, np.arange(len(P))[tool])], 0.0, atol=1e-12)
    expected = found.about(kinematics.regressor, found.names)[1][np.ix_(rest, rest)]
    assert_allclose(P[np.ix_(rest, rest)], expected, rtol=1e-6, atol=1e-6 * expected.max())


def test_numbers_it_does_not_hold_keep_their_usual_prior():
    drawing = aj.load_robot("panda")
    belief, _ = belief_of(drawing, kinds=("tool", "axes"))
    kinematics = AdaptiveKinematics(drawing, ("origins", "delay"), prior=belief, **SOCKETS)
    assert kinematics.unknown == ("origins", "delay", "tool", "axes")
    seen = aj.Measurement(0.0, drawing.neutral(), np.zeros(7), np.full(3, np.nan), -np.inf)
    report = kinematics.report(kinematics.initial_state(seen))
    sd = {row.name: row.sd for row in report.rows}
    own = dict(zip(belief.names, np.sqrt(belief.covariance.diagonal()), strict=True))
    for name, value in sd.items():
        usual = 0.02  # of origins, and of a delay
        assert value == pytest.approx(own.get(name, usual), rel=1e-6)


def test_a_tool_on_a_moving_link_is_one_of_drawing_and_learnt_robot():
    """The drawing's tip is the link, that of the learnt robot the end of an object on it."""
    drawing, rng = aj.load_robot("panda", tip="panda_link7"), np.random.default_rng(3)
    truth = drawing.with_object(0.15, axis="z").with_kinematic_error(
        None, {"panda_joint4": (3e-3, 2e-3, 1e-2)}
    )
    q = [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7] + rng.uniform(-0.8, 0.8, (40, 7))
    tip, still = aj.PositionTask(truth), np.zeros(7)
    x = np.array([tip.value(each) for each in q]) + 1e-4 * rng.normal(size=(40, 3))
    found = calibrate(drawing, Recording(q, x=x, place="cell"))
    assert found.frames == ("panda_link7", found.robot.tip)
    assert found.robot.tip != "panda_link7"
    for robot in (drawing, found.robot):
        kinematics = AdaptiveKinematics(robot, ("tool",), prior=found)
        lost = aj.Measurement(0.0, q[0], still, np.full(3, np.nan), -np.inf)
        state = kinematics.initial_state(lost)
        predicted = kinematics.predict(state, q[0], still, aj.Target(x[0]))
        assert np.linalg.norm(predicted.z) < 0.5e-3
    errors = aj.Uncertainty(found.robot, covariance=found)
    assert errors.d == 45
    assert np.linalg.norm(errors.plant(errors.sample(rng)).sensor.value(q[0]) - x[0]) < 5e-3


def test_frames_of_several_points_share_the_joints():
    drawing = aj.load_robot("panda")
    belief, _ = belief_of(drawing)
    task = aj.StackedTask(
        aj.PositionTask(drawing, "panda_hand_tcp"), aj.PositionTask(drawing, "panda_link5")
    )
    kinematics = AdaptiveKinematics(task, ("tool",), prior=belief, **SOCKETS)
    seen = aj.Measurement(0.0, drawing.neutral(), np.zeros(7), np.full(6, np.nan), -np.inf)
    sd = {r.name: r.sd for r in kinematics.report(kinematics.initial_state(seen)).rows}
    at = belief.names.index("panda_joint4.y")
    assert sd["panda_joint4.y"] == pytest.approx(np.sqrt(belief.covariance[at, at]))
    assert sd["panda_hand_tcp.x"] == sd["panda_link5.x"] == pytest.approx(0.2)


def test_wrong_priors_are_refused():
    panda, ur5 = aj.load_robot("panda"), aj.load_robot("ur5")
    belief, robot = belief_of(panda)
    with pytest.raises(aj.InvalidInputError, match=r"a Calibration, or None, got 0\.2"):
        AdaptiveKinematics(panda, prior=0.2)
    with pytest.raises(
        aj.InvalidInputError, match=r"calibration must be of ur5 and its frame .*, got"
    ):
        AdaptiveKinematics(ur5, prior=belief)
    hand = aj.PositionTask(panda, "panda_link7")
    with pytest.raises(
        aj.InvalidInputError,
        match=r"frame panda_link7, got one of panda_hand_tcp, whose tool differs; sd\['tool'\]",
    ):
        AdaptiveKinematics(hand, prior=belief)
    assert AdaptiveKinematics(hand, sd={"tool": 0.2}, prior=belief).names
    stretched = panda.with_kinematic_error({"panda_joint4": (0.0, 0.2, 0.0)})
    with pytest.raises(aj.InvalidInputError, match=r"whose panda_joint4\.\w differs"):
        AdaptiveKinematics(stretched, prior=belief)
    turned = robot.with_kinematic_error(None, {"panda_joint2": (0.5, 0.0, 0.0)})
    with pytest.raises(aj.InvalidInputError, match=r"whose panda_joint2\.tilt1 differs"):
        AdaptiveKinematics(turned, prior=belief)


# -- in laws ----------------------------------------------------------------------------------


@pytest.mark.study
@pytest.mark.parametrize("turn", [0.0, 1.0])
@pytest.mark.parametrize("kind", ["tracking", "set-point"])
def test_compiled_laws_learn_the_same_from_a_prior(kind, turn):
    belief, robot = belief_of(aj.load_robot("ur5"))
    arm, task = drawn_arm("ur5", 5, belief, turn), aj.PositionTask(robot)
    kinds = ("tool", "camera") if turn else ("tool",)
    kinematics = AdaptiveKinematics(task, kinds, noise=1e-3, dt=DT, prior=belief)
    if kind == "tracking":
        plain = aj.TrackingController(task, kinematics=kinematics, dt=DT)
    else:
        plain = PredictedMeasurement(aj.SetpointController(task), kinematics)
    goal, ends = arm.place(arm.q0) + 0.02, []
    for controller in (plain, compiled(plain)):
        state = None
        for k in range(120):
            t, q = k * DT, arm.q(k * DT)
            v = (arm.q(t + 1e-6) - q) / 1e-6
            frame = k // 4 * 4 * DT
            seen = aj.Measurement(t, q, v, arm.place(arm.q(frame)), frame)
            state = controller.initial_state(seen) if state is None else state
            state, answer = controller.step(state, seen, goal, DT)
        ends.append((controller.learnt(state), answer.torque))
    (learnt, torque), (other, other_torque) = ends
    assert_allclose(other, learnt, rtol=1e-6, atol=1e-8)
    assert_allclose(other_torque, torque, rtol=1e-6, atol=1e-6)


@needs_recordings
def test_a_real_arm_goes_on_from_its_calibration(panda):
    """Sockets of one place as recordings, those of another one as what a tracker sees."""
    recordings, apart = real("panda_6")
    found = calibrate(panda, recordings, apart=apart)
    front = [each for each in recordings if each.place[0] == "front"]
    first = calibrate(panda, front, apart={k: v for k, v in apart.items() if "front" in k[0]})
    others = [each for each in recordings if each.place[0] == "left"]
    q = np.concatenate([each.of(panda).q for each in others])
    task, left = aj.PositionTask(found.robot), {}
    for prior in (None, first):
        kinematics = AdaptiveKinematics(panda, AXES, noise=3e-4, dt=DT, prior=prior)
        still, state = np.zeros(7), None
        for k, each in enumerate(q[:20]):  # a frame each, far apart in time
            for step in range(4):
                t = 0.4 * k + 0.1 * step
                seen = aj.Measurement(t, each, still, task.value(each), t)
                state = kinematics.initial_state(seen) if state is None else state
                state = kinematics.step(state, seen, 0.1)
        robot = kinematics.robot(state)
        off = [task.value(each) - aj.PositionTask(robot).value(each) for each in q[20:]]
        left[prior is None] = np.median(np.linalg.norm(off, axis=1))
    assert left[False] < 0.5e-3
    assert left[False] < left[True]


def test_kinematics_with_a_prior_go_to_other_processes():
    belief, robot = belief_of(aj.load_robot("ur5"))
    kinematics = AdaptiveKinematics(robot, ("tool",), prior=belief)
    seen = aj.Measurement(0.0, robot.neutral(), np.zeros(6), np.full(3, 0.3), 0.0)
    state = kinematics.initial_state(seen)
    for other in (pickle.loads(pickle.dumps(kinematics)), copy.deepcopy(kinematics)):
        assert_array_equal(other.initial_state(seen), state)
