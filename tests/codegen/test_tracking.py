"""The tracking law compiled: the same steps as in NumPy, whatever is measured."""

import copy
import itertools
import pickle

import numpy as np
import pinocchio as pin
import pytest
from arm_terms import evaluated
from numpy.testing import assert_allclose, assert_array_equal
from random_trees import random_tree

import approxjac as aj
from approxjac.codegen.arm.rigid_body import Arm, LearntBodies
from approxjac.codegen.lanes import Lanes, LaneStart
from approxjac.codegen.step import compiled
from approxjac.codegen.trace.program import Program
from approxjac.codegen.trace.symbols import inputs
from approxjac.controllers import KnownKinematics, ModelDynamics
from approxjac.robots import KinematicRegressor
from approxjac.robots.dynamics import DynamicsRegressor
from approxjac.tasks import PoseTask, TrackerTask

DT = 1e-3
START = np.array([0.2, -1.2, 1.4, -1.0, -1.0, 0.3])


@pytest.fixture(scope="module")
def ur5():
    return aj.load_robot("ur5")


@pytest.fixture
def asked(monkeypatch):
    """Steps in which a compiled controller asked the ordinary way."""
    steps, ordinary = [], aj.TrackingController.advance

    def counted(controller, *arguments):
        if type(controller) is not aj.TrackingController:
            steps.append(arguments)
        return ordinary(controller, *arguments)

    monkeypatch.setattr(aj.TrackingController, "advance", counted)
    return steps


def pair(task, unknown=("tool", "origins", "camera"), **options):
    """The same law in NumPy and compiled."""
    kinematics = aj.AdaptiveKinematics(task, unknown=unknown, **options)
    plain = aj.TrackingController(task, kinematics=kinematics)
    return plain, compiled(plain)


@pytest.fixture(scope="module")
def of_two_links():
    """The law of a small arm in NumPy and compiled."""
    plain = aj.TrackingController(aj.PositionTask(aj.load_robot("two_link").with_object(0.5)))
    return plain, compiled(plain)


def slow_motion(task, rng, steps, rate=60.0):
    """Measurements of slow motion, with frames of a camera that is elsewhere."""
    robot = task.robot
    middle, ways = robot.random_configuration(rng), rng.uniform(-0.3, 0.3, robot.nv)
    q, x, t_x, frame = middle, None, 0.0, -1
    for step in range(steps):
        t = step * DT
        v = ways * np.cos(1.5 * t)
        if int(t * rate + 1e-6) != frame:
            frame, t_x = int(t * rate + 1e-6), t
            x = task.value(q) + 0.1 + 2e-3 * rng.normal(size=task.n_x)
        yield aj.Measurement(t, q.copy(), v, x, t_x)
        q = pin.integrate(robot.model, q, DT * v)


def assert_same(ours, expected, tolerance=1e-10):
    """Equal to rounding: state and answer."""
    (own, answer), (other, told) = ours, expected
    size = 1.0 + np.abs(other).max(initial=0.0)
    assert_allclose(own, other, rtol=tolerance, atol=tolerance * size)
    for name in ("torque", "e", "J_hat", "gravity", "reference"):
        a, b = getattr(answer, name), getattr(told, name)
        if b is None:  # of velocities there is no gravity
            assert a is None, name
            continue
        assert a.shape == b.shape, name
        size = 1.0 + np.abs(np.nan_to_num(b)).max()
        assert_allclose(a, b, rtol=0, atol=tolerance * size, err_msg=name)
    assert answer.status is told.status
    assert answer.limit_status is told.limit_status
    assert answer.state_rate is None


# -- terms ----------------------------------------------------------------------------------------


def learnt_terms(of, q, v, theta, theta_dot):
    """Return the terms of points and of an orientation that are learnt."""
    moving = q, v, theta, theta_dot
    terms = {f"motion {name}": each for name, each in of.motion(*moving)._asdict().items()}
    terms |= {f"turn {name}": each for name, each in of.turn(*moving)._asdict().items()}
    return terms | dict(zip(("Y", "o"), of.linear(q, theta), strict=True))


def traced_terms(robot, frames):
    """Return the terms that are learnt of, and the functions that have them."""
    links, n = DynamicsRegressor(robot), robot.nv
    points = KinematicRegressor(robot, frames, axes=True)
    program = Program()
    sizes = {"q": robot.nq, "v": n, "v_r": n, "a_r": n, "sigma": n, "theta": points.p}
    sizes |= {"theta_dot": points.p, "a": links.links}
    q, v, v_r, a_r, sigma, theta, theta_dot, a = (
        inputs(program.graph, *each) for each in sizes.items()
    )
    here = Arm(program.given, "arm", robot, points.frames).at(q)
    bodies = LearntBodies(here, v, v_r, a_r)
    terms = dict(learnt_terms(points, q, v, theta, theta_dot))
    terms |= {"powers": bodies.powers(sigma), "torque": bodies.torque(a)}
    return program, {**terms, "gravity": bodies.gravity(a)}, points, links


def assert_terms(robot, frames, rng):
    program, terms, points, links = traced_terms(robot, frames)
    given = {name: rng.normal(size=(1, robot.nv)) for name in ("v", "v_r", "a_r", "sigma")}
    given |= {"q": robot.random_configuration(rng)[np.newaxis]}
    given |= {name: rng.normal(size=(1, points.p)) for name in ("theta", "theta_dot")}
    given["a"] = rng.normal(size=(1, links.links))
    own = evaluated(program, terms, tau=np.zeros((1, robot.nv)), **given)
    q, v, v_r, a_r, sigma, a = (given[name][0] for name in ("q", "v", "v_r", "a_r", "sigma", "a"))
    moved = links.motion(q, v, v_r, a_r)
    theta, theta_dot = given["theta"][0], given["theta_dot"][0]
    expected = learnt_terms(points, q, v, theta, theta_dot)
    expected |= {"powers": moved.powers(sigma), "torque": moved.torque(a)}
    expected["gravity"] = moved.gravity(a)
    for name, value in expected.items():
        size = 1.0 + np.abs(value).max()
        assert_allclose(own[name][0] / size, value / size, rtol=0, atol=1e-13, err_msg=name)


def test_terms_of_every_arm(arm, rng):
    assert_terms(arm, [arm.tip], rng)


@pytest.mark.parametrize(
    "seed", [*range(3), *(pytest.param(k, marks=pytest.mark.study) for k in range(3, 10))]
)
def test_terms_of_random_trees(seed):
    rng = np.random.default_rng(seed)
    text, frames = random_tree(rng)
    assert_terms(aj.Robot(text).with_gravity(rng.normal(size=3) * 6.0), frames, rng)


# -- steps ----------------------------------------------------------------------------------------


def law_of(kind):
    """A law of a kind, and what it may be unknown."""
    panda = aj.load_robot("panda")
    points = aj.StackedTask(
        aj.PositionTask(panda), aj.PositionTask(panda, frame="panda_link6", axes="xz")
    )
    tracked = TrackerTask(panda, rotation=(0.1, 0.2, 1.0), offset=(0.3, 0.0, 0.1))
    kinova = aj.PositionTask(aj.load_robot("kinova"))
    planar = aj.PositionTask(aj.load_robot("two_link"), axes="xz")
    return {
        "camera turned": (aj.PositionTask(panda), ("tool", "origins", "camera")),
        "tool": (aj.PositionTask(panda), ("tool",)),
        "camera known": (tracked, ("tool", "origins")),
        "five rows": (points, ("tool", "origins", "offset")),
        "continuous joints": (kinova, ("tool",)),
        "in the plane": (planar, ("origins", "camera")),
        "mimic joints": (aj.PositionTask(aj.load_robot("panda", free="all")), ("tool",)),
    }[kind]


SOME = ("in the plane",)
# the others have their parts
MARKS = dict.fromkeys(
    ("camera turned", "camera known", "tool", "continuous joints"), pytest.mark.long
)
KINDS = (
    "camera turned", "tool", "camera known", "five rows", "continuous joints",
    "in the plane", "mimic joints",
)  # fmt: skip


@pytest.mark.parametrize(
    "kind",
    [k if k in SOME else pytest.param(k, marks=MARKS.get(k, pytest.mark.study)) for k in KINDS],
)
def test_steps_are_the_same_to_rounding(kind, rng, asked):
    task, unknown = law_of(kind)
    plain, ours = pair(task, unknown)
    state, steps, m = None, 120, task.m
    for step, measurement in enumerate(slow_motion(task, rng, steps)):
        if state is None:
            state = plain.initial_state(measurement)
            assert_array_equal(ours.initial_state(measurement), state)
            target = measurement.x + 0.01
        size = 30.0 if step % 20 == 0 else 0.02  # as fast as joints may be, or slow
        moving = aj.Target(target, *size * rng.normal(size=(2, m))) if step % 3 else target
        expected = plain.step(state, measurement, moving, DT)
        assert_same(ours.step(state, measurement, moving, DT), expected)
        state = expected[0]
    assert [plain.step(*each)[1].status for each in asked].count(aj.Status.OK) == 0


@pytest.mark.study
def test_a_whole_circle_is_the_same(ur5):
    true = ur5.with_object(0.2, mass=1.0)
    sensor = TrackerTask(true, rotation=(0.0, 0.0, 1.0), offset=(0.1, 0.0, 0.0))
    plant = aj.Plant(true, sensor, sensing=aj.Sensing(x_noise=1e-3, x_rate=60.0, x_delay=0.03))
    path = aj.Circle(sensor.value(START) + [0.05, 0.0, 0.0], 0.05, 1.5)
    plain, ours = (
        aj.simulate(plant, each, path, START, 1.5) for each in pair(aj.PositionTask(ur5))
    )
    assert_allclose(ours.q, plain.q, rtol=0, atol=1e-9)
    assert_allclose(ours.tau, plain.tau, rtol=0, atol=1e-9 * np.abs(plain.tau).max())
    assert_array_equal(ours.status, plain.status)


@pytest.mark.study
def test_what_is_seldom_is_answered_as_in_numpy(ur5, rng, asked):
    task = aj.PositionTask(ur5)
    plain, ours = (each.guarded(None) for each in pair(task))  # no motion is like these
    measurements = list(slow_motion(task, rng, 40))
    state = plain.initial_state(measurements[0])
    for each in measurements[:-1]:
        state, _ = plain.step(state, each, each.x, DT)
    usual = measurements[-1]
    target = usual.x + 0.01
    assert asked == []
    ours.step(state, usual, target, DT)
    assert asked == []
    lost = usual._replace(x=np.full(3, np.nan))
    many = np.array([ur5.random_configuration(rng) for _ in range(500)])
    ratios = [1.0 / np.linalg.cond(task.jacobian(q)) for q in many]
    straight = usual._replace(q=many[int(np.argmin(ratios))])
    late, _ = plain.step(state, usual._replace(t=9.0), target, DT)
    cases = {
        "x lost": (lost, target, aj.Status.PREDICTED),
        "x lost in part": (usual._replace(x=usual.x * [1, np.nan, 1]), target, None),
        "x old": (usual._replace(t=9.001), target, aj.Status.PREDICTED),
        "singular": (straight, target, aj.Status.NEAR_SINGULAR),
    }
    for name, (measurement, moving, status) in cases.items():
        before, begun = len(asked), late if name == "x old" else state
        expected = plain.step(begun, measurement, moving, DT)
        assert status in (None, expected[1].status), name
        own, told = ours.step(begun, measurement, moving, DT)
        assert len(asked) == before, name
        assert_same((own, told), expected, 1e-9)
    first = usual._replace(x=np.full(3, np.nan))
    fresh = plain.initial_state(first)
    assert ours.step(fresh, first, target, DT)[1].status is aj.Status.MEASUREMENT_LOST


@pytest.mark.study
def test_what_is_wrong_is_refused_with_the_same_words(ur5, rng):
    task = aj.PositionTask(ur5)
    plain, ours = pair(task)
    (usual,) = slow_motion(task, rng, 1)
    state, target = plain.initial_state(usual), usual.x
    wrong = [
        (state, usual, target, 2e-3),
        (state[1:], usual, target, DT),
        (np.where(np.arange(len(state)) == 5, np.nan, state), usual, target, DT),
        (np.where(np.arange(len(state)) == plain.size - 1, np.inf, state), usual, target, DT),
        (state, usual._replace(q=np.full(6, np.nan)), target, DT),
        (state, usual._replace(v=[0.0] * 6), target, DT),
        (state, usual._replace(x=usual.x.astype(np.float32)), target, DT),
        (state, usual._replace(t_x="now"), target, DT),
        (state, usual._replace(t_x=usual.t + 2.0), target, DT),  # two clocks
        (state, usual, target * np.nan, DT),
        (state, usual, aj.Target(target, np.zeros(2)), DT),
        (state, usual, aj.Target(target, None, np.full(3, np.inf)), DT),
        (state, usual._replace(v=np.full(6, 1e200)), target, DT),
        (state, tuple(usual)[:4], target, DT),
    ]
    for arguments in wrong:
        with pytest.raises((aj.InvalidInputError, aj.errors.MeasurementError)) as expected:
            plain.step(*arguments)
        with pytest.raises(type(expected.value)) as found:
            ours.step(*arguments)
        assert str(found.value) == str(expected.value)


@pytest.mark.study
def test_made_from_one_it_is_compiled_too(two_link, rng, asked):
    task = aj.PositionTask(two_link)
    plain = aj.TrackingController(task)
    ours = compiled(plain)
    assert isinstance(ours, aj.TrackingController)
    assert compiled(ours) is ours
    (measurement,) = slow_motion(task, rng, 1)
    state = plain.initial_state(measurement)
    expected = plain.step(state, measurement, measurement.x, DT)
    belief = two_link.with_kinematic_error()
    for made in (
        ours.with_task(aj.PositionTask(belief)),
        copy.copy(ours),
        copy.deepcopy(ours),
        pickle.loads(pickle.dumps(ours)),
    ):
        assert type(made) is type(ours)
        assert_same(made.step(state, measurement, measurement.x, DT), expected)
    assert asked == []
    assert type(ours.ordinary) is aj.TrackingController
    with pytest.raises(TypeError, match=r"^Mine cannot be derived from a law that is compiled"):
        type("Mine", (type(ours),), {})
    limited = aj.TorqueLimited(ours, aj.Limits.of(two_link))
    own = limited.step(limited.initial_state(measurement), measurement, measurement.x, DT)
    other = aj.TorqueLimited(plain, aj.Limits.of(two_link))
    expected = other.step(other.initial_state(measurement), measurement, measurement.x, DT)
    assert_allclose(own[1].torque, expected[1].torque, rtol=0, atol=1e-10)


@pytest.mark.study
def test_known_kinematics_dynamics_poses_and_velocities_are_covered(two_link, ur5, rng, asked):
    position = aj.PositionTask(two_link)
    T = aj.TrackingController
    kinematics = KnownKinematics(position)
    pose = PoseTask(ur5)
    for plain in (
        T(position, kinematics=kinematics, dynamics=ModelDynamics(two_link)),
        T(position, kinematics=kinematics, command="velocity"),
        T(pose),
    ):
        ours, state = compiled(plain), None
        for measurement in slow_motion(plain.task, rng, 40):
            state = plain.initial_state(measurement) if state is None else state
            expected = plain.step(state, measurement, measurement.x, DT)
            assert_same(ours.step(state, measurement, measurement.x, DT), expected, 1e-9)
            state = expected[0]
    assert asked == []


def test_the_rates_of_a_target_are_those_of_its_own_step(of_two_links, rng):
    """Whatever rates the target of the step before had, ẋ_d or ẍ_d alone, or none."""
    plain, ours = of_two_links
    m = plain.task.m
    (measurement,) = slow_motion(plain.task, rng, 1)
    state, x = plain.initial_state(measurement), measurement.x
    kinds = [(None, None), (1, None), (None, 1), (1, 1)]
    torques = []
    for before, rates in itertools.product(kinds, kinds):
        for kind in (before, rates):
            target = aj.Target(x, *(each and 0.3 * np.arange(1.0, m + 1.0) for each in kind))
            expected = plain.step(state, measurement, target, DT)
            assert_same(ours.step(state, measurement, target, DT), expected)
        torques.append(expected[1].torque.tobytes())
    assert len(set(torques)) == len(kinds)


def test_an_answer_is_the_users_to_keep(of_two_links, rng):
    _, ours = of_two_links
    measurements = list(slow_motion(ours.task, rng, 3))
    state = ours.initial_state(measurements[0])
    given = state.copy()
    after, answer = ours.step(state, measurements[0], measurements[0].x, DT)
    kept = after.copy(), answer.torque.copy(), answer.J_hat.copy()
    ours.step(after, measurements[1], measurements[1].x + 0.1, DT)
    assert_array_equal(state, given)
    for own, other in zip((after, answer.torque, answer.J_hat), kept, strict=True):
        assert_array_equal(own, other)


# -- loops ----------------------------------------------------------------------------------------


@pytest.mark.study
@pytest.mark.parametrize("unknown", [("tool", "offset"), ("origins", "camera")])
def test_many_runs_at_once_are_those_of_simulate(two_link, unknown):
    """With noise, seldom and late frames, lost ones, and a first one that comes late."""
    task = aj.PositionTask(two_link, axes="xz")
    kinematics = aj.AdaptiveKinematics(task, unknown=unknown, delay=0.03)
    law, start = aj.TrackingController(task, kinematics=kinematics), np.array([0.5, 1.2])
    sensing = aj.Sensing(x_noise=1e-3, x_rate=60.0, x_delay=0.03, x_dropout=0.2)
    truths = [two_link.with_object(length, mass=0.2, name="held") for length in (0.1, 0.15, 0.2)]
    plants = [aj.Plant(each, task.on(each), sensing=sensing) for each in truths]
    targets = [each.sensor.value(start) + [0.05, 0.02] for each in plants]
    starts = [
        LaneStart.of(law, plant, start, target, seed=k)
        for k, (plant, target) in enumerate(zip(plants, targets, strict=True))
    ]
    region = aj.JointBox.around(two_link, start, 9.0)
    lanes = Lanes(law, plants[0], starts, region, DT, 400, 1e-3)
    found = lanes.run(starts, 400)
    assert not found["left"].any()
    for k, (plant, target) in enumerate(zip(plants, targets, strict=True)):
        run = aj.simulate(
            plant,
            law,
            target,
            start,
            0.4,
            dt=DT,
            computation=aj.simulation.Computation("semi_implicit_euler"),
            seed=k,
        )
        assert_allclose(found["error"][k], run.error_norm[-1], rtol=0, atol=1e-10)
