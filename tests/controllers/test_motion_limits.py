"""Limits of motion: `Wall`, `CartesianSpeed`, accelerations, and one of the user's own."""

import copy
import re
from dataclasses import replace
from functools import partial

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.controllers import CartesianSpeed, Limit, LimitTerms, Wall
from approxjac.robots import Dynamics
from approxjac.tasks.frame_tasks import FrameKinematics

TOOL = 0.06  # that the belief lacks [m]
STARTS = {
    "panda": [0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7],
    "ur5": [0.0, -1.2, 1.6, -2.0, -1.5, 0.3],
    "kinova": [0.0, 2.6, 1.5, 0.5, 1.0, 0.3],
}


def terms_of(robot, q, v, **options):
    given = {
        "approach": 10.0, "braking": 100.0, "deceleration": np.linspace(1.0, 5.0, robot.nv),
    } | options  # fmt: skip
    return LimitTerms(robot, q, v, partial(FrameKinematics, robot), **given)


class HighElbow(Limit):
    """A frame stays above a height: the limit of the how-to."""

    def __init__(self, frame, height):
        self.frame, self.height = frame, height

    def rows(self, terms, v, dt):
        z = terms.position(self.frame)[2:]
        J = terms.jacobian(self.frame)[2:3]
        return terms.stay_above(z - self.height, J, terms.drift(self.frame)[2:3])


# -- rows ---------------------------------------------------------------------------------------


def largest_fall(h, a):
    """How fast a height h above a limit may fall, with a deceleration a: see `terms_of`."""
    return min(10.0 * h, np.sqrt(2.0 * a * h - (a / 10.0) ** 2) if h > a / 100.0 else np.inf)


@pytest.mark.parametrize(
    ("name", "frame"),
    [("panda", None), ("kinova", None), ("tiago_arm", None), ("panda", "panda_link6")],
)
def test_rows_are_second_derivatives(name, frame, rng):
    """A q̈ + drift is d²h/dt² along q(t), by differences, and the bounds are without the drift."""
    robot = aj.load_robot(name)
    kinematics, frames = FrameKinematics(robot, frame or robot.tip), [frame] if frame else []
    normal = np.array([1.0, 2.0, -2.0]) / 3.0
    for _ in range(5):
        q, v = robot.random_configuration(rng), rng.normal(size=robot.nv)
        a, step = rng.normal(size=robot.nv), 1e-4

        def height(t, q=q, v=v, a=a):
            moved = pin.integrate(robot.model, q, t * v + 0.5 * t * t * a)
            return normal @ kinematics.position(moved)

        def speed(t, q=q, v=v, a=a):
            moved = pin.integrate(robot.model, q, t * v + 0.5 * t * t * a)
            return np.linalg.norm(kinematics.jacobian(moved)[:3] @ (v + t * a))

        terms = terms_of(robot, q, v)
        drift = terms.drift(frame)[:3]
        second = (height(step) - 2.0 * height(0.0) + height(-step)) / step**2
        point = kinematics.position(q) - 0.151 * normal  # 0.1 beyond its margin, and 1 mm
        A, low, high = Wall(point, 5.0 * normal, 0.05, frames).rows(terms, v, 1e-3)
        assert (A @ a + normal @ drift).item() == pytest.approx(second, rel=1e-4, abs=1e-4)
        falls = largest_fall(0.1, np.abs(A * terms.deceleration).max())
        assert low.item() == pytest.approx(-100.0 * (falls + (A @ v).item()) - normal @ drift)
        assert np.isinf(high).all()
        A, low, high = CartesianSpeed(0.3, frame).rows(terms, v, 1e-3)
        along = kinematics.jacobian(q)[:3] @ v
        along /= np.linalg.norm(along)
        rate = (speed(step) - speed(-step)) / (2.0 * step)
        assert (A @ a).item() + along @ drift == pytest.approx(rate, rel=1e-5, abs=1e-5)
        assert high.item() == pytest.approx(100.0 * (0.3 - speed(0.0)) - along @ drift)
        assert np.isinf(low).all()


def test_a_wall_is_come_to_as_a_joints_limit_is(panda):
    """ḧ ≥ r(−min(κh, √(2ah − (a/κ)²)) − ḣ): slowly when near, back when behind."""
    q = np.array(STARTS["panda"])
    p = aj.PositionTask(panda).value(q)
    normal, clear = np.array([0.0, 0.0, 1.0]), 1e-3
    still = np.zeros(7)
    for h in (2e-3, 0.01, 0.3, -0.02):
        terms = terms_of(panda, q, still)
        A, low, _ = Wall(p - (h + clear) * normal, normal).rows(terms, still, 1e-3)
        falls = -0.05 if h < 0.0 else largest_fall(h, np.abs(A * terms.deceleration).max())
        assert low.item() == pytest.approx(-100.0 * falls)
        late = terms_of(panda, q, still, jerk=np.full(7, 50.0))
        _, later, _ = Wall(p - (h + clear) * normal, normal).rows(late, still, 1e-3)
        j = np.abs(A).sum() * 50.0
        assert abs(later.item()) == pytest.approx(min(100.0 * abs(falls), np.sqrt(j * abs(falls))))


def test_at_rest_a_speed_has_no_direction(panda):
    A, _, high = CartesianSpeed(0.3).rows(
        terms_of(panda, np.array(STARTS["panda"]), np.zeros(7)), np.zeros(7), 1e-3
    )
    assert_array_equal(A, 0.0)
    assert high.item() == pytest.approx(30.0)


# -- runs ---------------------------------------------------------------------------------------


def blocked(name, dt, limits=(), direction=(0.6, 0.0, -0.8), inside=0.0, **options):
    """A reach through a wall, and the heights of the true and the believed tip before it."""
    robot = aj.load_robot(name)
    q0 = robot.configuration(np.array(STARTS[name]))
    # the unknown tool points at the wall: the worst case of the margin
    d = np.array(direction)
    R = FrameKinematics(robot, robot.tip).placement(q0)[0]
    axis = "xyz"[int(np.abs(R.T @ d).argmax())]
    truth = robot.with_object(np.sign((R.T @ d)["xyz".index(axis)]) * TOOL, 0.3, axis=axis)
    belief = robot.with_object(0.0, 0.3, axis=axis)
    plant = aj.Plant(truth, sensor=aj.PositionTask(truth))
    believed = aj.PositionTask(belief)
    start = believed.value(q0)
    point = start + (0.08 + TOOL - inside) * d
    law = aj.SetpointController(aj.PositionTask(belief), **options)
    wall = Wall(point, -d, margin=TOOL)
    controller = aj.TorqueLimited(law, [aj.Limits.of(belief), wall, *limits], dt=dt)
    run = aj.simulate(
        plant, controller, plant.sensor.value(q0) + 0.4 * d, q0, duration=1.5, dt=dt,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )  # fmt: skip
    heights = (run.x - point) @ -d
    tips = np.array([believed.value(q) for q in run.q])
    return run, heights, (tips - point) @ -d - TOOL, controller


PERIODS = [
    pytest.param(5e-4, marks=pytest.mark.study),
    *(pytest.param(dt, marks=pytest.mark.long) for dt in (1e-3, 2e-3)),
    5e-3,
]


@pytest.mark.parametrize(
    ("name", "dt"),
    [
        *((name, 5e-3) for name in STARTS),
        pytest.param("kinova", 5e-4, marks=pytest.mark.study),
        *(
            pytest.param(name, dt, marks=pytest.mark.long)
            for name in STARTS
            for dt in (5e-4, 1e-3, 2e-3)
            if (name, dt) != ("kinova", 5e-4)
        ),
    ],
)
def test_the_true_tip_stays_in_front_of_a_wall(name, dt):
    run, true, believed, controller = blocked(name, dt)
    assert (true > 0.0).all()
    assert believed.min() > 0.5e-3  # of the millimetre that is kept besides
    assert believed[-1] < 0.02  # it is there that it stops
    assert (np.abs(run.tau) <= controller.limits.effort).all()
    assert run.error_norm[-1] > 0.05


@pytest.mark.parametrize("dt", PERIODS[1::2])
@pytest.mark.parametrize("name", STARTS)
def test_a_start_behind_a_wall_is_led_back(name, dt):
    run, _, believed, _ = blocked(name, dt, inside=0.11)
    assert believed[0] == pytest.approx(-0.03, abs=1e-6)
    assert believed[-1] > 0.0
    assert np.diff(believed).min() > -1e-3  # and goes no further
    assert aj.LimitStatus.SOLVER_FAILED not in run.limit_status_counts()


@pytest.mark.parametrize("dt", PERIODS)
def test_a_frame_is_no_faster_than_it_may_be(dt):
    run, true, _, controller = blocked("panda", dt, [CartesianSpeed(0.1)])
    kinematics = FrameKinematics(controller.task.robot, controller.task.robot.tip)
    speeds = [
        np.linalg.norm(kinematics.jacobian(q)[:3] @ v) for q, v in zip(run.q, run.v, strict=True)
    ]
    assert max(speeds) < 0.115  # the true arm's inertia is another one
    assert np.median(speeds[len(speeds) // 4 : len(speeds) // 2]) > 0.095
    assert (true > 0.0).all()


def test_accelerations_of_joints_are_no_larger_than_they_may_be(panda):
    task = aj.PositionTask(panda)
    q0 = np.array(STARTS["panda"])
    limits = replace(aj.Limits.of(panda), acceleration=2.0)
    target = task.value(q0) + [0.1, 0.2, -0.2]
    controller = aj.TorqueLimited(aj.SetpointController(task), limits)
    run = aj.simulate(
        aj.Plant(panda), controller, target, q0, duration=1.5, dt=1e-3,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )  # fmt: skip
    free = aj.simulate(
        aj.Plant(panda), aj.TorqueLimited(controller.controller), target, q0,
        duration=1.5, dt=1e-3, computation=aj.simulation.Computation("semi_implicit_euler"),
    )  # fmt: skip
    fastest = [np.abs(np.diff(each.v, axis=0)).max() / 1e-3 for each in (run, free)]
    assert fastest[0] < 2.02
    assert fastest[1] > 4.0
    assert run.error_norm[-1] < 2e-3


def test_walls_that_contradict_each_other_have_a_status_and_brake(panda):
    """No torque leaves both sides of a plane at once."""
    q0, v0 = np.array(STARTS["panda"]), np.full(7, 0.2)
    task = aj.PositionTask(panda)
    p = task.value(q0)
    up = np.array([0.0, 0.0, 1.0])
    walls = [Wall(p + 0.05 * up, up), Wall(p - 0.05 * up, -up)]
    controller = aj.TorqueLimited(aj.SetpointController(task), walls)
    measurement = aj.Measurement(0.0, q0, v0, p)
    state = controller.initial_state(measurement)
    after, answer = controller.step(state, measurement, p, 1e-3)
    assert answer.limit_status is aj.LimitStatus.INFEASIBLE
    assert (np.abs(answer.torque) <= panda.effort_limits).all()
    assert np.isfinite(after).all()
    run = aj.simulate(
        aj.Plant(panda), controller, p + 0.2, q0, duration=0.5, dt=1e-3,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )  # fmt: skip
    assert set(run.limit_status_counts()) == {aj.LimitStatus.INFEASIBLE}
    assert np.abs(run.v).max() < 0.2  # it stands between them


@pytest.mark.study
def test_a_limit_of_ones_own_is_kept(panda):
    task, q0 = aj.PositionTask(panda), np.array(STARTS["panda"])
    elbow = FrameKinematics(panda, "panda_link4")
    lowest = elbow.position(q0)[2] - 0.01
    law = aj.SetpointController(task)
    target = task.value(q0) + [0.25, 0.0, -0.3]
    lows = []
    for limits in (None, HighElbow("panda_link4", lowest)):
        run = aj.simulate(
            aj.Plant(panda), aj.TorqueLimited(law, limits), target, q0, duration=2.0, dt=1e-3,
            computation=aj.simulation.Computation("semi_implicit_euler"),
        )  # fmt: skip
        lows.append(min(elbow.position(q)[2] for q in run.q[::10]) - lowest)
    assert lows[0] < -0.01
    assert lows[1] > -1e-3


# -- arguments ----------------------------------------------------------------------------------


def test_limits_of_the_urdf_are_kept_beside_those_of_motion(panda):
    law = aj.SetpointController(aj.PositionTask(panda))
    wall = Wall([0.0, 0.0, 0.0], [0.0, 0.0, 1.0])
    for limits in (wall, [wall]):
        limiter = aj.TorqueLimited(law, limits)
        assert limiter.motion_limits == (wall,)
        assert_array_equal(limiter.limits.effort, panda.effort_limits)
    limiter = aj.TorqueLimited(law, [aj.Limits(effort=20.0), wall])
    assert_array_equal(limiter.limits.effort, 20.0)
    assert np.isinf(limiter.limits.velocity).all()
    assert limiter.dt == 1e-3  # a wall looks ahead
    again = copy.deepcopy(limiter)
    assert repr(again.motion_limits) == repr(limiter.motion_limits)


@pytest.mark.parametrize("joint", [0, 3])
def test_a_joint_without_a_limit_of_its_torque_rate_is_limited_as_the_others(panda, joint):
    """Also at rest just at its end, and where a wall does not feel it."""
    rate = np.full(panda.nv, 1e4)
    rate[joint] = np.inf
    limits = replace(aj.Limits.of(panda), rate=rate)
    task, q = aj.PositionTask(panda), np.array(STARTS["panda"])
    q[joint] = panda.position_limits[0][joint]
    x = task.value(q)
    limited = aj.TorqueLimited(aj.SetpointController(task), [limits, Wall((0, 0, 0), (0, 0, 1))])
    at_rest = aj.Measurement(0.0, q, np.zeros(panda.nv), x)
    _, answer = limited.step(limited.initial_state(at_rest), at_rest, x + [0.0, 0.0, 0.02], 1e-3)
    assert answer.limit_status in (aj.LimitStatus.FREE, aj.LimitStatus.PROOF_KEPT)
    assert np.isfinite(limited.rows(at_rest).low[: panda.nv]).all()


def test_frames_other_than_the_tip_stay_in_front_of_a_wall(panda, rng):
    q, v = panda.random_configuration(rng), rng.normal(size=7)
    frames = ["panda_link4", "panda_link7"]
    A, low, high = Wall([0.0, 0.0, 0.1], [0.0, 0.0, 1.0], 0.02, frames).rows(
        terms_of(panda, q, v), v, 1e-3
    )
    assert A.shape == (2, 7)
    assert low.shape == high.shape == (2,)
    for row, frame in zip(A, frames, strict=True):
        assert_allclose(row, FrameKinematics(panda, frame).jacobian(q)[2])


class Wrong(Limit):
    def __init__(self, rows):
        self.given = rows

    def rows(self, terms, v, dt):
        return self.given


@pytest.mark.parametrize(
    "rows",
    [
        None, (np.zeros((1, 6)), np.zeros(1), np.zeros(1)), (np.zeros((1, 7)), 0.0, 1.0),
        (np.zeros((1, 7)), np.ones(1), np.zeros(1)), (np.full((1, 7), np.nan), *np.zeros((2, 1))),
    ],
)  # fmt: skip
def test_rows_that_are_none_are_refused(panda, rows):
    law = aj.SetpointController(aj.PositionTask(panda))
    with pytest.raises(aj.InvalidInputError, match=r"shape \(k, 7\)"):
        aj.TorqueLimited(law, Wrong(rows))


@pytest.mark.parametrize(
    ("rows", "text"),
    [
        (
            lambda: (np.zeros((1, 6)), *np.zeros((2, 1))),
            r"rows of Later\(\) must return A of shape \(k, 2\).*got \(",
        ),
        (lambda: None, "rows of .* got None"),
        (lambda: 1.0 / 0.0, ": ZeroDivisionError: float division by zero"),
    ],
)
def test_rows_that_go_wrong_in_a_run_are_named_with_the_time(rows, text):
    class Later(Limit):
        def __repr__(self):
            return "Later()"

        def rows(self, terms, v, dt):
            return rows() if is_late else (np.zeros((1, 2)), -np.ones(1), np.ones(1))

    is_late = False
    task = aj.PositionTask(aj.load_robot("two_link"))
    limiter = aj.TorqueLimited(aj.SetpointController(task), Later())
    q = np.array([0.4, 0.9])
    seen = aj.Measurement(0.05, q, np.zeros(2), task.value(q))
    before = seen._replace(t=0.049)
    state = limiter.step(limiter.initial_state(before), before, seen.x, 1e-3)[0]
    is_late = True
    with pytest.raises(
        aj.errors.ControllerError, match=r"limit Later\(\) failed at t = 0\.05 s"
    ) as caught:
        limiter.step(state, seen, seen.x, 1e-3)
    assert re.search(text, str(caught.value))


def test_what_is_no_limit_is_refused(panda):
    law = aj.SetpointController(aj.PositionTask(panda))
    for limits in (3.0, [aj.Limits(), 3.0], "urdf", [aj.Limits(), aj.Limits()]):
        with pytest.raises(aj.InvalidInputError, match="limits must"):
            aj.TorqueLimited(law, limits)
    for options in ({"normal": [0.0, 0.0, 0.0]}, {"margin": -0.1}, {"point": [0.0, 1.0]}):
        with pytest.raises(aj.InvalidInputError, match=next(iter(options))):
            Wall(**({"point": np.zeros(3), "normal": [0.0, 0.0, 1.0]} | options))
    with pytest.raises(aj.InvalidInputError, match="most"):
        CartesianSpeed(0.0)


def test_numbers_that_are_none_leave_a_torque_that_brakes(panda):
    """A limit of the user's own that fails at some configuration."""

    class Sometimes(Limit):
        def rows(self, terms, v, dt):
            value = np.nan if terms.q[0] > 1.0 else -np.inf
            return np.ones((1, 7)), np.array([value]), np.full(1, np.inf)

    limiter = aj.TorqueLimited(aj.SetpointController(aj.PositionTask(panda)), Sometimes())
    q = np.array(STARTS["panda"])
    for first, statuses in ((0.0, [aj.LimitStatus.FREE]), (1.5, [aj.LimitStatus.SOLVER_FAILED])):
        q[0] = first
        measurement = aj.Measurement(0.0, q, np.full(7, 0.1), limiter.task.value(q))
        state = limiter.initial_state(measurement)
        answer = limiter.step(state, measurement, measurement.x, 1e-3)[1]
        assert answer.limit_status in statuses
        assert (np.abs(answer.torque) <= panda.effort_limits).all()
    q_dd = Dynamics(panda).forward(q, measurement.v, answer.torque)
    assert np.isfinite(q_dd).all()
