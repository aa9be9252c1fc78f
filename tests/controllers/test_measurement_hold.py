"""`HeldMeasurement`: between images, without them, and with a camera that hangs."""

import copy
import pickle

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac import Status
from approxjac.controllers import Controller, DifferentiatedVelocity
from approxjac.errors import MeasurementError
from approxjac.robots import Dynamics, GravityRegressor
from approxjac.tasks import CombinedTask

DT = 1e-3
START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
V = np.array([0.1, -0.3, 0.2, 0.4, 0.1, -0.2, 0.3])
LOST = np.full(3, np.nan)
GAINS = aj.Gains(100.0, 20.0, 1.0)


@pytest.fixture(scope="module")
def task(panda):
    return aj.PositionTask(panda)


@pytest.fixture(scope="module")
def pair(panda):
    return aj.StackedTask(aj.PositionTask(panda), aj.PositionTask(panda, "panda_link4", axes="z"))


def controllers(task):
    """Everything that may be inside."""
    regressor = GravityRegressor(task.robot)
    law = aj.SetpointController(task)
    limits = aj.Limits(effort=0.5 * task.robot.effort_limits, rate=500.0)
    return {
        "known gravity": law,
        "learnt gravity": aj.SetpointController(task, gravity=aj.AdaptiveGravity(regressor)),
        "law (5)": aj.SetpointController(task, velocity=DifferentiatedVelocity(0.1)),
        "limited": aj.TorqueLimited(law, limits),
        "clipped": aj.TorqueLimited(law, aj.Limits(law.task.robot.effort_limits), proof=False),
    }


PANDA = aj.load_robot("panda")
INSIDE = controllers(aj.PositionTask(PANDA))
LAW = INSIDE["known gravity"]
KINDS = ["known gravity", "learnt gravity", "law (5)", "limited", "clipped"]


class Loop:
    """A controller that is stepped as a robot does, its state carried along.

    At one q, with a q̇ that no guard would believe.
    """

    def __init__(self, held, x, target, q=START, v=V):
        self.held, self.target = held.guarded(None), np.array(target)
        self.q, self.v = q, v
        self.state = self.held.initial_state(self.measured(x))
        self.inner = held.controller.size
        self.before = self.state

    def measured(self, x, t_x=None):
        return aj.Measurement(0.0, self.q, self.v, np.array(x, dtype=float), t_x)

    def step(self, x, t_x=None):
        self.before = self.state
        self.state, answer = self.held.step(self.state, self.measured(x, t_x), self.target, DT)
        assert np.isfinite(answer.torque).all()
        assert np.isfinite(self.state).all()
        return answer

    def alone(self, x):
        """Return what the controller by itself answers in the step that was taken last."""
        inner = self.before[: self.inner]
        after, answer = self.held.controller.step(inner, self.measured(x), self.target, DT)
        assert_array_equal(self.state[: self.inner], after)
        return answer


def assert_same(answer, other):
    """Check that two answers are the same, but for their status."""
    assert_array_equal(answer.torque, other.torque)
    assert_array_equal(answer.e, other.e)
    assert_array_equal(answer.J_hat, other.J_hat)
    assert answer.limit_status is other.limit_status
    assert answer.slack == other.slack


# -- one step -----------------------------------------------------------------------------------


@pytest.mark.parametrize("kind", KINDS)
def test_a_lost_x_is_bridged_by_the_one_seen_last(task, kind):
    x = task.value(START)
    loop = Loop(aj.HeldMeasurement(INSIDE[kind], 0.1), x, x + 0.05)
    assert_same(loop.step(x), loop.alone(x))
    fresh = loop.step(x + 1e-3)
    assert_same(fresh, loop.alone(x + 1e-3))
    assert fresh.status is Status.OK
    for _ in range(5):
        answer = loop.step(LOST)
        assert_same(answer, loop.alone(x + 1e-3))
        assert answer.status is Status.MEASUREMENT_HELD
    back = loop.step(x + 2e-3)
    assert_same(back, loop.alone(x + 2e-3))
    assert back.status is Status.OK


def test_before_the_first_image_its_time_may_be_that_of_none(task):
    x = task.value(START)
    loop = Loop(aj.HeldMeasurement(INSIDE["known gravity"], 0.1), x, x + 0.05)
    assert loop.step(LOST, t_x=-np.inf).status is Status.MEASUREMENT_LOST
    assert loop.step(x, t_x=0.0).status is Status.OK


def test_a_frame_that_was_overtaken_is_not_used(task):
    """p counts from the later one, and so would not bound what has moved since the earlier one."""
    x = task.value(START)
    loop = Loop(aj.HeldMeasurement(INSIDE["known gravity"], 0.1), x, x + 0.05)
    loop.step(x, t_x=-1.0)  # any clock
    assert_same(loop.step(x + 1e-3, t_x=-0.5), loop.alone(x + 1e-3))
    late = loop.step(x + 2e-3, t_x=-0.8)
    assert_same(late, loop.alone(x + 1e-3))
    assert late.status is Status.MEASUREMENT_HELD
    assert_same(loop.step(x + 3e-3, t_x=-0.4), loop.alone(x + 3e-3))


@pytest.mark.parametrize("kind", KINDS)
def test_a_new_x_in_every_step_changes_nothing(task, kind):
    x = task.value(START)
    loop = Loop(aj.HeldMeasurement(INSIDE[kind], 1e-3), x, x + 0.05)
    for k in range(20):
        answer = loop.step(x + 1e-4 * k)
        alone = loop.alone(x + 1e-4 * k)
        assert_array_equal(answer.torque, alone.torque)
        assert answer.status is alone.status


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("blind", ["lost", "repeated"])
def test_an_x_that_does_not_change_is_too_old_once_the_image_must_have_moved(task, kind, blind):
    """Lost or repeated, it is the same; at a constant Ĵq̇ the step is known."""
    x, unseen = task.value(START), 0.005
    speed = np.abs(task.jacobian(START) @ V).max()
    steps = int(np.floor(unseen / (speed * DT)))
    assert 5 < steps < 50
    loop = Loop(aj.HeldMeasurement(INSIDE[kind], unseen), x, x + 0.05)
    assert loop.step(x).status is Status.OK
    repeated = x if blind == "repeated" else LOST
    for _ in range(steps):
        assert loop.step(repeated).status is Status.MEASUREMENT_HELD
    for _ in range(10):
        answer = loop.step(repeated)
        alone = loop.alone(LOST)
        assert answer.status is Status.MEASUREMENT_LOST
        assert np.isnan(answer.e).all()
        assert_array_equal(answer.torque, alone.torque)
    loop.v = -V  # back to where it was seen: it has not been seen by that
    for _ in range(3 * steps):
        assert loop.step(repeated).status is Status.MEASUREMENT_LOST
    assert loop.step(x + 1e-6).status is Status.OK
    assert loop.step(LOST).status is Status.MEASUREMENT_HELD


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("side", [1.0, -1.0])
def test_each_coordinate_may_move_as_far_to_either_side_and_no_other_counts(task, axis, side):
    x, unseen = task.value(START), np.where(np.arange(3) == axis, 4.25e-3, np.inf)
    J = task.jacobian(START)
    v = np.linalg.pinv(J) @ np.where(np.arange(3) == axis, side * 0.5, 3.0)  # 0.5 mm a step
    loop = Loop(aj.HeldMeasurement(LAW, unseen), x, x + 0.05, v=v)
    said = [loop.step(x).status, *(loop.step(LOST).status for _ in range(9))]
    assert said == [Status.OK] + 8 * [Status.MEASUREMENT_HELD] + [Status.MEASUREMENT_LOST]


def test_what_counts_is_the_net_displacement(task):
    """A tremble of some millimetres a sample adds up to nothing."""
    x = task.value(START)
    loop = Loop(aj.HeldMeasurement(aj.SetpointController(task), 0.01), x, x, v=20.0 * V)
    loop.step(x)
    for _ in range(3000):
        loop.v = -loop.v
        assert loop.step(LOST).status is Status.MEASUREMENT_HELD


def test_the_state_is_that_of_the_controller_the_last_x_the_displacement_and_what_was_seen(pair):
    law = aj.SetpointController(pair, gravity=aj.AdaptiveGravity(pair.robot))
    x = pair.value(START)
    loop = Loop(aj.HeldMeasurement(law, np.inf), x, x + 0.05)
    p_hat = len(law.adaptation.theta0)
    assert len(loop.state) == p_hat + 4 + 1 + 4 + 2
    assert_array_equal(loop.state[p_hat:], np.zeros(11))
    first = loop.step([*x[:3], np.nan])
    last, _, p, seen = np.split(loop.state[p_hat:], [4, 5, 9])
    moved = DT * first.J_hat @ V
    assert_array_equal(last, [*x[:3], 0.0])
    assert_allclose(p, [*moved[:3], 0.0], rtol=1e-12)  # of what was never seen it is not known
    assert_array_equal(seen, [1.0, 0.0])
    loop.step(x)
    last, _, p, seen = np.split(loop.state[p_hat:], [4, 5, 9])
    assert_array_equal(last, x)
    assert_allclose(p, [*2.0 * moved[:3], moved[3]], rtol=1e-12)
    assert_array_equal(seen, 1.0)
    assert_array_equal(loop.held.learnt(loop.state), loop.state[:p_hat])


@pytest.mark.parametrize("unseen", [0.01, np.inf])
@pytest.mark.parametrize("kind", [k for k in KINDS if k != "law (5)"])
def test_before_anything_is_seen_x_is_lost(task, kind, unseen):
    x = task.value(START)
    loop = Loop(aj.HeldMeasurement(INSIDE[kind], unseen), LOST, x + 0.05)
    for _ in range(5):
        answer = loop.step(LOST)
        assert answer.status is Status.MEASUREMENT_LOST
        assert_array_equal(answer.torque, loop.alone(LOST).torque)
    assert loop.step(x).status is Status.OK
    assert loop.step(LOST).status is Status.MEASUREMENT_HELD


def test_any_first_x_is_one_that_was_seen_even_where_others_are_measured_from(task):
    loop = Loop(aj.HeldMeasurement(aj.SetpointController(task), 0.1), task.origin, task.origin)
    assert loop.step(task.origin).status is Status.OK
    assert loop.step(LOST).status is Status.MEASUREMENT_HELD


def test_without_a_first_x_there_is_nothing_to_differentiate(task):
    held = aj.HeldMeasurement(INSIDE["law (5)"], 0.1)
    with pytest.raises(MeasurementError, match=r"the first x must be finite for law \(5\)"):
        held.initial_state(aj.Measurement(0.0, START, V, LOST))


def test_parts_are_held_one_by_one(pair):
    """The hand is lost, the elbow is seen: only what the hand moves counts, and only it is NaN."""
    x = pair.value(START)
    speed = np.abs(pair.jacobian(START) @ V)
    unseen = np.array([0.005, 0.005, 0.005, 1e-9])  # the elbow's would be passed in one step
    loop = Loop(aj.HeldMeasurement(aj.SetpointController(pair), unseen), x, x + 0.05)
    loop.step(x)
    for k in range(1, int(0.005 / (speed[:3].max() * DT)) + 1):
        measured = np.array([np.nan, *x[1:3], x[3] + 1e-3 * k])  # an entry of it, all of it
        answer = loop.step(measured)
        assert answer.status is Status.OK  # the elbow's is new
        assert_same(answer, loop.alone([*x[:3], measured[3]]))
    answer = loop.step([np.nan, *x[1:3], x[3]])
    assert answer.status is Status.MEASUREMENT_LOST
    assert_array_equal(np.isnan(answer.e), [True, True, True, False])
    assert_same(loop.step(x + 1e-3), loop.alone(x + 1e-3))


@pytest.mark.parametrize("lost", [0, 1, 2])
def test_a_frame_is_seen_once_whichever_of_its_points_is_lost(panda, lost):
    """By t_x; what comes again, or was overtaken, is held, and so is what is in none."""
    points = {"panda_link4": "y", "panda_link6": "xz", "panda_hand_tcp": "xy"}
    three = aj.StackedTask(*(aj.PositionTask(panda, *each) for each in points.items()))
    x, gone = three.value(START), np.array([0, 1, 1, 2, 2]) == lost
    loop = Loop(aj.HeldMeasurement(aj.SetpointController(three, GAINS), 0.1), x, x + 0.05)
    loop.step(x, 0.0)
    frame = np.where(gone, np.nan, x + 1e-3)
    seen = np.where(gone, x, frame)
    for t_x, status in ((0.1, Status.OK), (0.1, Status.MEASUREMENT_HELD), (0.2, Status.OK)):
        answer = loop.step(frame, t_x)
        assert answer.status is status
        assert_same(answer, loop.alone(seen))
    for t_x in (0.2, 0.15):
        answer = loop.step(x + 2e-3, t_x)
        assert answer.status is Status.MEASUREMENT_HELD
        assert_same(answer, loop.alone(seen))
    assert loop.step(np.full(5, np.nan), 0.3).status is Status.MEASUREMENT_HELD
    assert loop.step(x + 2e-3, 0.25).status is Status.OK  # nothing was seen at 0.3
    assert_same(loop.step(frame, 0.26), loop.alone(np.where(gone, x + 2e-3, frame)))


def test_the_controller_has_the_last_word_on_the_status(panda):
    """What it says of a held x is kept: here, that Ĵ is near singular."""
    straight = np.array([0.0, 0.0, 0.0, -0.0698, 0.0, 0.0, 0.0])
    short = aj.PositionTask(panda, "panda_link4", axes="xyz")
    gains = aj.Gains(100.0, 20.0, 1.0)
    x = short.value(straight)
    loop = Loop(aj.HeldMeasurement(aj.SetpointController(short, gains), 1.0), x, x, q=straight)
    assert loop.step(x).status is Status.NEAR_SINGULAR
    assert loop.step(LOST).status is Status.NEAR_SINGULAR


@pytest.mark.parametrize("says", ["OK", "HOLDING", "NEAR_SINGULAR", "OUT_OF_REACH"])
def test_where_the_controller_says_nothing_worse_a_held_x_is_named(task, says, monkeypatch):
    """Also while its joints stand, which is the rule where no new x comes."""
    advance = aj.SetpointController.advance

    def saying(law, *arguments):
        after, answer = advance(law, *arguments)
        return after, answer._replace(status=Status[says])

    monkeypatch.setattr(aj.SetpointController, "advance", saying)
    x = task.value(START)
    held = Loop(aj.HeldMeasurement(LAW, 10.0), x, x)
    assert held.step(x).status is Status[says]
    named = Status.MEASUREMENT_HELD if says in ("OK", "HOLDING") else Status[says]
    assert held.step(x).status is named
    predicted = Loop(aj.controllers.PredictedMeasurement(LAW, aj.AdaptiveKinematics(task)), x, x)
    assert predicted.step(x).status is Status[says]
    named = Status.PREDICTED if says in ("OK", "HOLDING") else Status[says]
    assert predicted.step(LOST).status is named


def test_poses_and_continuous_joints(rng):
    robot = aj.load_robot("kinova")
    task = aj.PoseTask(robot)
    held = aj.HeldMeasurement(aj.SetpointController(task), 0.1)
    q, v = robot.random_configuration(rng), 0.1 * rng.normal(size=6)
    x = task.value(q)
    loop = Loop(held, x, task.value(robot.random_configuration(rng)), q, v)
    assert_same(loop.step(x), loop.alone(x))
    answer = loop.step(np.full(7, np.nan))
    assert_same(answer, loop.alone(x))
    assert answer.status is Status.MEASUREMENT_HELD
    nowhere = np.concatenate([x[:3], np.zeros(4)])  # finite, but no orientation
    assert loop.step(nowhere).status is Status.MEASUREMENT_HELD
    loop.v = 1e3 * v
    loop.step(np.full(7, np.nan))
    assert loop.step(np.full(7, np.nan)).status is Status.MEASUREMENT_LOST


def test_the_time_of_an_x_says_whether_it_is_new(task):
    x = task.value(START)
    loop = Loop(aj.HeldMeasurement(LAW, 0.1), x, x + 0.05)
    assert loop.step(x, 0.0).status is Status.OK
    assert loop.step(x, 0.0).status is Status.MEASUREMENT_HELD
    assert loop.step(x, 0.1).status is Status.OK  # the same numbers, and yet a new image
    assert loop.step(x + 1e-3, 0.1).status is Status.MEASUREMENT_HELD


ENTRY = st.sampled_from([0.5, 0.6, 1e-9, -0.0, 1e5, np.nan, np.inf, -np.inf])


@given(
    st.sampled_from(KINDS),
    st.sampled_from([1e-6, 0.01, np.inf]),
    st.lists(st.tuples(ENTRY, ENTRY, ENTRY, st.sampled_from([0.0, 1e-3, 1.0, 50.0])), max_size=12),
)
def test_whatever_is_seen_and_whatever_not_the_torque_is_finite(kind, unseen, sequence):
    held = aj.HeldMeasurement(INSIDE[kind], unseen)
    x = INSIDE[kind].task.value(START)
    loop = Loop(held, x, x + 0.05)
    for *entries, speed in sequence:
        loop.v = speed * V
        kept = loop.state.copy(), np.array(entries)
        answer = loop.step(entries)  # which looks whether all is finite
        assert_array_equal(loop.before, kept[0])
        seen = np.isfinite(answer.e).all()
        assert seen == (answer.status is not Status.MEASUREMENT_LOST)
        if np.isfinite(entries).all() and answer.status is Status.OK:
            assert_array_equal(answer.e, np.array(entries) - loop.target)


# -- in a loop ----------------------------------------------------------------------------------


def reach(controller, sensing, duration=4.0, offset=(0.1, -0.15, 0.16), seed=0, truth=PANDA):
    sensor = controller.task.on(truth)
    plant = aj.Plant(truth, sensor, sensing=sensing)
    target = sensor.displaced(sensor.value(START), np.resize(offset, controller.task.m))
    options = {
        "dt": DT,
        "computation": aj.simulation.Computation("semi_implicit_euler"),
        "seed": seed,
    }
    return aj.simulate(plant, controller, target, START, duration, **options)


@pytest.mark.study
def test_a_camera_that_hangs_in_mid_motion_stops_the_arm_and_it_goes_on_after(task):
    held = aj.HeldMeasurement(aj.SetpointController(task), 0.1)
    camera = {"x_rate": 30.0, "x_delay": 0.03, "x_noise": 1e-4}
    usual = reach(held, aj.Sensing(**camera))
    assert set(usual.status_counts()) == {Status.OK, Status.MEASUREMENT_HELD}
    run = reach(held, aj.Sensing(**camera, x_frozen=[(0.15, 2.0)]), 6.0)
    lost = run.status == Status.MEASUREMENT_LOST
    most = np.linalg.norm(usual.tau, axis=1).max()
    assert np.linalg.norm(run.tau, axis=1).max() <= 1.001 * most
    first, last = np.flatnonzero(lost)[[0, -1]]
    assert lost[first : last + 1].all()
    assert run.t[last] == pytest.approx(2.0 + 1 / 30 + 0.03, abs=0.04)  # the first new image
    arrived = round(0.18 / DT)
    moved = np.abs(run.x[first] - run.x[arrived]).max()
    assert 0.09 < moved < 0.11
    assert np.abs(run.v[last]).max() < 1e-3  # it slows to rest
    assert np.abs(run.x[last] - run.x[first]).max() < 0.1
    kinetic = [0.5 * v @ Dynamics(PANDA).M(q) @ v for q, v in zip(run.q, run.v, strict=True)]
    assert (np.diff(kinetic[first : last + 1]) < 1e-12).all()
    assert run.error_norm[last] > 0.02
    assert run.error_norm[-1] < 1e-3
    assert usual.error_norm[-1] < 1e-3


@pytest.mark.study
def test_without_holding_an_arm_cannot_tell_a_camera_that_hangs(task):
    """What it is for: the law goes on pulling towards a target that it has long passed."""
    sensing = aj.Sensing(x_rate=30.0, x_delay=0.03, x_noise=1e-4, x_frozen=[(0.15, 2.0)])
    run = reach(aj.SetpointController(task), sensing, 2.0)
    assert run.error_norm[-1] > 0.2
    assert set(run.status_counts()) == {Status.OK}
    held = reach(aj.HeldMeasurement(aj.SetpointController(task), 0.1), sensing, 2.0)
    assert held.error_norm[-1] < 0.15


def test_one_feature_is_hidden_for_a_second(panda):
    """The height is hidden in mid-motion: the arm waits for it, and reaches the target."""
    apart = aj.StackedTask(aj.PositionTask(panda, axes="xy"), aj.PositionTask(panda, axes="z"))
    sensing = aj.Sensing(x_rate=60.0, x_noise=1e-5, x_lost=[(0.2, 1.2, 1)])
    held = aj.HeldMeasurement(aj.SetpointController(apart), 0.05)
    run = reach(held, sensing, 3.5)
    lost = run.status == Status.MEASUREMENT_LOST
    assert 0.2 < run.t[lost][0] < 0.6
    assert run.t[lost][-1] == pytest.approx(1.2, abs=0.02)
    hidden = np.isnan(run.x_measured)
    assert_array_equal(hidden.any(axis=0), [False, False, True])
    counts = run.status_counts()
    assert counts[Status.OK] + counts[Status.MEASUREMENT_HELD] + lost.sum() == len(run.t)
    assert run.error_norm[-1] < 1e-3
    unheld = reach(held.controller, sensing, 0.5)
    assert (unheld.status == Status.MEASUREMENT_LOST).sum() == hidden[:501].any(axis=1).sum()


def test_at_rest_an_image_that_does_not_change_is_no_fault(task):
    """Gravity that is not known leaves an error, and the arm rests with it, or nearly so.

    A force that no longer follows x lets it creep, here by less than 1 mm/s: that counts.
    """
    held = aj.HeldMeasurement(aj.SetpointController(task, aj.default_gains(task)), 0.02)
    frozen = aj.Sensing(x_rate=30.0, x_frozen=[(4.0, 9.0)])
    run = reach(held, frozen, 5.0, (0.02, 0.02, 0.02), truth=PANDA.with_gravity((0.2, 0.0, -9.5)))
    at_rest = run.t > 4.0
    assert run.error_norm[-1] > 3e-3
    assert set(run.status[at_rest]) == {Status.MEASUREMENT_HELD}
    assert np.ptp(run.x[at_rest], axis=0).max() < 2e-3
    assert Status.MEASUREMENT_LOST not in run.status_counts()


@pytest.mark.study
def test_noise_of_encoders_does_not_add_up(task):
    """q̇ from differences of q with 0.1 mrad of noise, for 4 s in front of a frozen image.

    Its absolute value would add up to half a metre.
    """
    held = aj.HeldMeasurement(aj.SetpointController(task), 2e-3)
    sensing = aj.Sensing(q_noise=1e-4, velocity_filter=5e-3, x_frozen=[(0.0, 30.0)])
    run = reach(held, sensing, 4.0, (0.0, 0.0, 0.0))
    assert set(run.status[1:]) == {Status.MEASUREMENT_HELD}
    assert np.abs(run.state[:, 4:7]).max() < 1e-3


@pytest.mark.parametrize(
    "kind",
    [*(pytest.param(k, marks=pytest.mark.study) for k in ("learnt gravity", "law (5)")), "limited"],
)
def test_targets_are_reached_with_a_camera_at_30_hz(task, kind):
    controller = INSIDE[kind]
    held = aj.HeldMeasurement(controller, 0.1)
    sensing = aj.Sensing(x_rate=30.0, x_delay=0.03, x_noise=2e-4, x_dropout=0.1)
    run = reach(held, sensing, 4.0, seed=1)
    assert run.error_norm[run.t > 3.5].max() < 2e-3
    assert np.isnan(run.x_measured).any(axis=1).mean() == pytest.approx(0.1, abs=0.06)
    assert np.isfinite(run.state).all()
    counts = run.status_counts()
    assert counts[Status.MEASUREMENT_HELD] > 10 * counts[Status.OK] > 0
    if kind == "limited":
        assert (np.abs(run.tau) <= 0.5 * PANDA.effort_limits + 1e-9).all()
        assert (np.abs(np.diff(run.tau, axis=0)) <= 500.0 * DT + 1e-9).all()
        assert set(run.limit_status_counts()) - {aj.LimitStatus.UNLIMITED}
    if kind == "learnt gravity":  # what is learnt is where it was
        assert np.abs(held.learnt(run.state)[-1]).max() > 0.1


def test_nothing_is_learnt_from_what_is_too_old(task):
    law = INSIDE["learnt gravity"]
    sensing = aj.Sensing(x_rate=30.0, x_noise=1e-4, x_lost=[(0.3, 1.0)])
    run = reach(aj.HeldMeasurement(law, 0.02), sensing, 1.0)
    lost = np.flatnonzero(run.status == Status.MEASUREMENT_LOST)
    assert len(lost) > 100
    theta = law.learnt(run.state[lost, : len(law.adaptation.theta0)])
    gaps = np.flatnonzero(np.diff(lost) > 1)
    for stretch in np.split(theta, gaps + 1):
        assert_array_equal(stretch, np.tile(stretch[0], (len(stretch), 1)))


# -- copies and errors --------------------------------------------------------------------------


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda held: pickle.loads(pickle.dumps(held))])
@pytest.mark.parametrize("kind", KINDS)
def test_copies(task, kind, copied):
    held = aj.HeldMeasurement(INSIDE[kind], (0.1, 0.2, np.inf))
    other = copied(held)
    assert repr(other) == repr(held)
    assert other.controller is not held.controller
    x = task.value(START)
    loops = [Loop(each, x, x + 0.05) for each in (held, other)]
    for measured in (x, LOST, x + 1e-3):
        first, second = (loop.step(measured) for loop in loops)
        assert_array_equal(first.torque, second.torque)
        assert_array_equal(loops[0].state, loops[1].state)
        assert first.status is second.status


class Alone(Controller):
    """A controller without a Jacobian."""

    def evaluate(self, state, measurement, target):
        return aj.Evaluation(np.zeros(7), np.zeros(0), Status.OK, measurement.x - target)


@pytest.mark.parametrize(
    "arguments",
    [
        (None, 0.1),
        (aj.SetpointController, 0.1),
        (aj.TorqueLimited, 0.1),
        (aj.PositionTask(PANDA), 0.1),
        *((LAW, unseen) for unseen in (0.0, (1.0, -1.0, 1.0), (1.0, 1.0), np.nan, None)),
    ],
)
def test_bad_arguments_are_refused(arguments):
    with pytest.raises(aj.InvalidInputError):
        aj.HeldMeasurement(*arguments)


@pytest.mark.parametrize(
    "changes",
    [
        *({"x": x} for x in (np.zeros(2), [0.0, 0.0, 0.0], np.zeros(3, int))),
        *({"t_x": t_x} for t_x in ("now", np.nan, np.inf, np.zeros(1))),
        {"q": np.zeros(6)},
    ],
)
def test_a_bad_measurement_is_refused(task, changes):
    loop = Loop(aj.HeldMeasurement(LAW, 0.1), np.zeros(3), np.zeros(3))
    measurement = loop.measured(np.zeros(3))._replace(**changes)
    with pytest.raises(aj.InvalidInputError):
        loop.held.step(loop.state, measurement, loop.target, DT)
    held = aj.HeldMeasurement(LAW, 0.1)
    with pytest.raises(aj.InvalidInputError):
        held.step(held.initial_state(loop.measured(np.zeros(3))), measurement, loop.target, DT)


def test_bad_states_and_things_that_are_no_measurement_are_refused(task):
    held, target = aj.HeldMeasurement(LAW, 0.1), np.zeros(3)
    good = aj.Measurement(0.0, START, V, np.zeros(3))
    for state in (np.zeros(3), None, np.full(8, np.nan)):
        with pytest.raises(aj.InvalidInputError, match="state must"):
            held.step(state, good, target, DT)
    for each in (held, held.guarded(None)):
        state = each.initial_state(good)
        with pytest.raises(
            aj.InvalidInputError, match=r"measurement must be Measurement\(t, q, v, x"
        ):
            each.step(state, None, target, DT)
        with pytest.raises(MeasurementError, match="q must be finite"):
            each.step(state, good._replace(q=np.full(7, np.nan)), target, DT)


@pytest.mark.parametrize("dt", [0.0, -1e-3, np.nan, np.inf, "1e-3"])
def test_a_law_of_ones_own_steps_forward_in_time(task, dt):
    seen = aj.Measurement(0.0, START, V, np.zeros(3))
    with pytest.raises(aj.InvalidInputError, match=r"dt must be a finite number > 0 \[s\], got"):
        Alone(task).step(np.zeros(0), seen, np.zeros(3), dt)


def test_a_controller_without_a_jacobian_is_refused_when_it_answers(task):
    loop = Loop(aj.HeldMeasurement(Alone(task), 0.1), np.zeros(3), np.zeros(3))
    with pytest.raises(aj.InvalidInputError, match="J_hat"):
        loop.step(np.zeros(3))


def two_points(panda, **options):
    camera = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (1.6, -0.8, 0.9), 600.0, (640, 480))
    points = [[0.0, 0.0, 0.0], [0.1, 0.0, 0.0]]
    return aj.ImageTask(panda, camera, points=points, **options)


def test_of_combined_points_one_is_new_while_the_other_is_lost(panda, rng):
    image = two_points(panda)
    task = CombinedTask(image, rng.normal(size=(4, 4)))
    held = aj.HeldMeasurement(aj.SetpointController(task), unseen=40.0)
    x = image.value(START)
    first = aj.Measurement(0.0, START, np.zeros(7), x)
    state, _ = held.step(held.initial_state(first), first, x, DT)
    later = x + [np.nan, np.nan, 10.0, 5.0]
    _, answer = held.step(state, aj.Measurement(DT, START, np.zeros(7), later), x, DT)
    assert_allclose(answer.e, task.error(x + [0.0, 0.0, 10.0, 5.0], x), rtol=1e-9)
    assert answer.status is not Status.MEASUREMENT_HELD


@pytest.mark.parametrize("combined", [False, True])
@pytest.mark.parametrize("x", [np.inf, 1e300, -1e306, 1e308])
def test_absurd_images_have_a_finite_answer_or_a_named_error(panda, rng, combined, x):
    image = two_points(panda)
    task = CombinedTask(image, 1e9 * rng.normal(size=(4, 4))) if combined else image
    gains = aj.Gains(kp=1e-4, kv=1e-4, damping=1.0)
    held = aj.HeldMeasurement(aj.SetpointController(task, gains), unseen=40.0)
    seen = image.value(START)
    measurement = aj.Measurement(0.0, START, V, np.array([x, -x, x, seen[3]]))
    state = held.initial_state(measurement)
    try:
        state, answer = held.step(state, measurement, seen, DT)
    except MeasurementError:
        return
    assert np.isfinite(answer.torque).all()
    assert np.isfinite(state).all()
