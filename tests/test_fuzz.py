"""Fuzzed input: a finite, bounded torque with a status, or a named error, in every case.

pytest turns warnings into errors, so no RuntimeWarning may escape either.
"""

import functools
from pathlib import Path

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import approxjac as aj
from approxjac.codegen.step import compiled
from approxjac.controllers import (
    DifferentiatedVelocity,
    FrictionCompensation,
    KnownKinematics,
    ModelDynamics,
    Posture,
    RegressorGravity,
)
from approxjac.law import Sine, Tanh
from approxjac.robots import Dynamics, GravityRegressor
from approxjac.simulation import VelocityServo
from approxjac.tasks import NonsingularTask

START = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
CAMERA = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480))
LIMITS = np.array([87.0, 87.0, 87.0, 87.0, 12.0, 12.0, 12.0])

SLIDER = """<robot name="slider">
  <link name="base"/>
  <link name="carriage"><inertial><mass value="2"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="arm"><inertial><origin xyz="0.3 0 0"/><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <link name="tool"><inertial><origin xyz="0.2 0 0"/><mass value="1"/>
    <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="turn" type="revolute"><parent link="base"/><child link="carriage"/>
    <axis xyz="0 1 0"/><limit lower="-3" upper="3" effort="50" velocity="2"/></joint>
  <joint name="slide" type="prismatic"><parent link="carriage"/><child link="arm"/>
    <axis xyz="1 0 0"/><limit lower="0" upper="1" effort="50" velocity="2"/></joint>
  <joint name="swing" type="revolute"><parent link="arm"/><child link="tool"/>
    <origin xyz="0.5 0 0"/><axis xyz="0 0 1"/>
    <limit lower="-3" upper="3" effort="50" velocity="2"/></joint>
</robot>"""


def prismatic_arm():
    return aj.load_robot(SLIDER).with_object(0.5, 0.1, axis="x")


def followed(task, **options):
    return aj.TrackingController(task, kinematics=KnownKinematics(task), **options)


@functools.cache
def controllers():
    """Controllers of every kind, by name."""
    panda, kinova, slider = aj.load_robot("panda"), aj.load_robot("kinova"), prismatic_arm()
    task, gains = aj.PositionTask(panda), aj.Gains(400.0, (80.0, 70.0, 60.0), 1.0)
    regressor = GravityRegressor(panda)
    kinova_task, tool = aj.PositionTask(kinova), aj.PositionTask(slider)
    two = aj.StackedTask(
        aj.PositionTask(panda, axes="xz"), aj.PositionTask(panda, "panda_link4", axes="yz")
    )
    bounded = aj.AdaptiveGravity(regressor, bounds=(regressor.theta - 1.0, regressor.theta + 1.0))
    return {
        "(6)": aj.SetpointController(task, gains),
        "(6), default gains": aj.SetpointController(task),
        "(6), sine": aj.SetpointController(task, gains, saturation=Sine(0.05)),
        "(6), tanh": aj.SetpointController(task, gains, saturation=Tanh((0.05, 0.1, 1e-6))),
        "(6), no gravity": aj.SetpointController(task, gains, gravity=aj.NoGravity(panda)),
        "(6), theta": aj.SetpointController(
            task, gains, gravity=RegressorGravity(regressor, regressor.theta)
        ),
        "(28)": aj.SetpointController(task, gravity=aj.AdaptiveGravity(regressor)),
        "(28), bounds": aj.SetpointController(task, gravity=bounded),
        "(28), unlimited": aj.SetpointController(
            task, gains, gravity=aj.AdaptiveGravity(regressor, 0.1, 1.0, torque_limits=np.inf)
        ),
        "(28), friction": aj.SetpointController(
            task, gravity=bounded, friction=FrictionCompensation()
        ),
        "(5)": aj.SetpointController(task, gains, velocity=DifferentiatedVelocity()),
        "(5), learnt": aj.SetpointController(
            task,
            gains,
            gravity=aj.AdaptiveGravity(regressor, 0.1, 1.0),
            velocity=DifferentiatedVelocity(),
        ),
        "posture": aj.SetpointController(task, gains, posture=Posture(START, 10.0)),
        "nonsingular": aj.SetpointController(NonsingularTask(task, {"panda_joint4": 0.3}), gains),
        "pose": aj.SetpointController(aj.PoseTask(panda)),
        "pose, learnt": aj.SetpointController(
            aj.PoseTask(panda), gravity=aj.AdaptiveGravity(regressor)
        ),
        "stacked": aj.SetpointController(two, aj.Gains(100.0, 20.0, 1.0)),
        "continuous joints": aj.SetpointController(
            kinova_task, gravity=aj.AdaptiveGravity(GravityRegressor(kinova))
        ),
        "continuous joints, pose": aj.SetpointController(
            aj.PoseTask(kinova), aj.Gains(100.0, 20.0)
        ),
        "prismatic": aj.SetpointController(tool, aj.Gains(100.0, 20.0, 1.0)),
        "prismatic, learnt": aj.SetpointController(
            tool,
            aj.Gains(100.0, 20.0, 1.0),
            gravity=aj.AdaptiveGravity(GravityRegressor(slider)),
        ),
        "prismatic, nonsingular": aj.SetpointController(
            NonsingularTask(tool, {"slide": 0.3}), aj.Gains(100.0, 20.0, 1.0)
        ),
        "tracking": followed(task),
        "tracking, pose": followed(aj.PoseTask(kinova), dynamics=ModelDynamics(kinova)),
        "tracking, prismatic": followed(tool),
        "tracking, velocity": followed(kinova_task, command="velocity"),
        "tracking, limited": aj.TorqueLimited(followed(task)),
    }


def to_compile():
    """Functions that return controllers to compile, by name."""
    panda, kinova, slider = aj.load_robot("panda"), aj.load_robot("kinova"), prismatic_arm()
    task, gains = aj.PositionTask(panda), aj.Gains(400.0, (80.0, 70.0, 60.0), 1.0)
    regressor, sliding = GravityRegressor(panda), GravityRegressor(slider)
    bounded = aj.AdaptiveGravity(regressor, bounds=(regressor.theta - 1.0, regressor.theta + 1.0))
    tool, soft = aj.PositionTask(slider), aj.Gains(100.0, 20.0, 1.0)
    coupled, plain = aj.load_robot("panda", free="all"), controllers()
    law = aj.SetpointController
    return {
        "compiled, tanh": lambda: law(task, gains, saturation=Tanh((0.05, 0.1, 1e-6))),
        "compiled, learnt": lambda: law(task, gravity=bounded),
        "compiled, posture": lambda: law(task, gains, posture=Posture(START, 10.0)),
        "compiled, stacked": lambda: law(
            plain["stacked"].task,
            soft,
            gravity=aj.AdaptiveGravity(regressor, 0.1, 1.0, torque_limits=np.inf),
        ),
        "compiled, pose, learnt": lambda: plain["pose, learnt"],
        "compiled, image": lambda: law(aj.ImageTask(panda, CAMERA)),
        "compiled, continuous joints": lambda: law(aj.PositionTask(kinova)),
        "compiled, continuous joints, pose": lambda: plain["continuous joints, pose"],
        "compiled, prismatic, theta": lambda: law(
            tool, soft, gravity=RegressorGravity(sliding, sliding.theta)
        ),
        "compiled, mimic joints": lambda: law(
            aj.PositionTask(coupled), soft, gravity=aj.AdaptiveGravity(coupled)
        ),
        "compiled, prismatic, nonsingular": lambda: law(
            NonsingularTask(tool, {"slide": 0.3}),
            soft,
            gravity=aj.AdaptiveGravity(GravityRegressor(slider)),
        ),
    }


@functools.cache
def compiled_controller(name):
    return compiled(to_compile()[name]())


NAMES = (
    "(6)", "(6), default gains", "(6), sine", "(6), tanh", "(6), no gravity", "(6), theta", "(28)",
    "(28), bounds", "(28), unlimited", "(28), friction", "(5)", "(5), learnt", "posture",
    "nonsingular", "pose",
    "pose, learnt", "stacked", "continuous joints", "continuous joints, pose", "prismatic",
    "prismatic, learnt", "prismatic, nonsingular", "tracking", "tracking, pose",
    "tracking, prismatic", "tracking, velocity", "tracking, limited",
)  # fmt: skip
COMPILED = (
    "compiled, tanh", "compiled, learnt", "compiled, prismatic, nonsingular", "compiled, posture",
    "compiled, stacked", "compiled, pose, learnt", "compiled, image", "compiled, continuous joints",
    "compiled, continuous joints, pose", "compiled, prismatic, theta", "compiled, mimic joints",
)  # fmt: skip
EXTREMES = (
    np.nan, np.inf, -np.inf, 0.0, -0.0, 5e-324, -5e-324, 2.2e-308, 1e-200, 1e16, -1e49, 1e50,
    1e51, 1e77, 1e100, -1e154, 1e155, 1e200, 1e300, -1e308, 1.7976931348623157e308,
)  # fmt: skip
ANYTHING = st.one_of(st.floats(), st.sampled_from(EXTREMES))
USUAL = st.floats(-3.0, 3.0)


def vectors(size):
    """Arrays of a size: usual ones, some with a few absurd entries, some all absurd."""

    def spoilt(drawn):
        entries, places = drawn
        array = np.array(entries, dtype=np.float64)
        for place, value in places:
            array[place] = value
        return array

    usual = st.lists(USUAL, min_size=size, max_size=size)
    if size == 0:
        return usual.map(np.array)
    places = st.lists(st.tuples(st.integers(0, size - 1), ANYTHING), max_size=3)
    absurd = st.lists(ANYTHING, min_size=size, max_size=size)
    one_value = ANYTHING.map(lambda value: np.full(size, value))
    return st.one_of(
        st.tuples(usual, places).map(spoilt),
        absurd.map(lambda entries: np.array(entries, dtype=np.float64)),
        one_value,
    )


def configurations(robot):
    """Configurations, mostly with (cos, sin) pairs on the circle where joints are continuous."""
    if robot.nq == robot.nv:
        return vectors(robot.nq)
    motions = st.lists(USUAL, min_size=robot.nv, max_size=robot.nv)
    on_circle = motions.map(lambda m: pin.integrate(robot.model, robot.neutral(), np.array(m)))
    return st.one_of(on_circle, vectors(robot.nq))


def n_state(controller):
    """Length of a controller's state."""
    task, q = controller.task, controller.task.robot.neutral()
    start = aj.Measurement(0.0, q, np.zeros(task.robot.nv), task.value(q))
    return len(controller.begin(start))


def arguments(controller):
    """State, measurement and target of the right types and shapes, with any numbers."""
    task = controller.task
    return st.tuples(
        vectors(n_state(controller)),
        st.builds(
            aj.Measurement,
            ANYTHING,
            configurations(task.robot),
            vectors(task.robot.nv),
            vectors(task.n_x),
        ),
        vectors(task.n_x),
    )


def checked(controller, state, measurement, target):
    """Return the answer of a step, looked at; None where it is refused with a named error."""
    try:
        after, answer = controller.step(state, measurement, target, 1e-3)
    except aj.errors.ApproxJacError as error:
        assert len(str(error)) > 20  # noqa: PT017
        return None
    assert answer.torque.shape == (controller.task.robot.nv,)
    assert answer.torque.dtype == np.float64
    assert np.isfinite(answer.torque).all()
    assert after.shape == state.shape
    assert np.isfinite(after).all()
    assert isinstance(answer.status, aj.Status)
    return answer


def torque_bound(controller, state, measurement, answer):
    """‖g‖ + ‖Ĵ‖ (k_p ‖s‖ + k_v ‖Ẋ‖) + B ‖q̇‖ from the parts of the law; may be infinite."""
    q, v = measurement.q, measurement.v
    kp, kv, damping = controller.diagonals
    gravity = controller.gravity
    if isinstance(gravity, aj.AdaptiveGravity):
        g = np.linalg.norm(gravity.regressor.Z(q)) * np.linalg.norm(controller.learnt(state))
    elif isinstance(gravity, aj.NoGravity):
        g = 0.0
    else:
        g = np.linalg.norm(Dynamics(gravity.robot).g(q))
    if controller.posture is not None:
        g += 10.0 * np.linalg.norm(START - q)
    J = np.linalg.norm(answer.J_hat)
    lost = answer.status is aj.Status.MEASUREMENT_LOST
    s = 0.0 if lost else np.linalg.norm(controller.saturation.s(answer.e))
    x_dot = J * np.linalg.norm(v)
    if controller.velocity is not None and not lost:
        x_dot = np.linalg.norm(answer.state_rate[-3:])
    return g + J * (kp.max() * s + kv.max() * x_dot) + damping.max() * np.linalg.norm(v)


@pytest.fixture(
    params=[
        *NAMES,
        *COMPILED[:3],
        *(pytest.param(name, marks=pytest.mark.study) for name in COMPILED[3:]),
    ]
)
def controller(request):
    if request.param in COMPILED:
        return compiled_controller(request.param)
    return controllers()[request.param]


# few examples by default, many in CI: pytest --hypothesis-profile=many tests/test_fuzz.py
COUNT = settings.default.max_examples
FUZZ = settings(
    max_examples=COUNT if COUNT > 10 else COUNT // 2,
    deadline=None,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow],
)


def test_every_controller_is_fuzzed():
    assert tuple(controllers()) == NAMES


def test_every_compiled_controller_is_fuzzed():
    assert set(to_compile()) == set(COMPILED)


@FUZZ
@given(data=st.data())
def test_any_numbers_give_a_bounded_torque_or_a_named_error(controller, data):
    state, measurement, target = data.draw(arguments(controller))
    kept = [np.copy(a) for a in (state, *measurement[1:4], target)]
    answer = checked(controller, state, measurement, target)
    for before, after in zip(kept, (state, *measurement[1:4], target), strict=True):
        assert np.array_equal(before, after, equal_nan=True)
    if answer is None:
        return
    assert np.isfinite(np.concatenate([measurement.q, measurement.v, target, state])).all()
    if controller.kinematics is not None:  # it goes on without x
        seen = np.isfinite(measurement.x).all()
        assert seen or answer.status is not aj.Status.OK
        return
    if not np.isfinite(measurement.x).all():
        assert answer.status is aj.Status.MEASUREMENT_LOST
        assert np.array_equal(controller.learnt(answer.state_rate), 0.0 * controller.learnt(state))
    with np.errstate(over="ignore", invalid="ignore"):
        bound = torque_bound(controller, state, measurement, answer)
        if np.isfinite(bound):
            assert np.linalg.norm(answer.torque / (1.0 + bound)) <= 1.0 + 1e-9


def test_whatever_was_learnt_gives_a_bounded_torque_or_a_named_error(controller):
    """What is learnt overflows at other sizes than what is measured, which chance rarely meets."""
    robot, task = controller.task.robot, controller.task
    seen = aj.Measurement(0.0, robot.neutral(), np.zeros(robot.nv), np.full(task.n_x, 0.7))
    for size in 10.0 ** np.arange(0, 309, 7):
        for state in (np.full(n_state(controller), size), np.full(n_state(controller), -size)):
            checked(controller, state, seen, np.zeros(task.n_x))


@FUZZ
@given(data=st.data())
def test_usual_numbers_are_always_answered(controller, data):
    """So that refusing everything would not do."""
    task = controller.task
    robot = task.robot

    def drawn(size):
        return np.array(data.draw(st.lists(USUAL, min_size=size, max_size=size)))

    q = pin.integrate(robot.model, robot.neutral(), drawn(robot.nv))
    # values of the task, so that there is a quaternion in a pose
    x, target = (task.displaced(task.origin, drawn(task.m)) for _ in range(2))
    measurement = aj.Measurement(0.0, q, drawn(robot.nv), x)
    answer = checked(controller, drawn(n_state(controller)), measurement, target)
    assert answer is not None
    assert answer.status is not aj.Status.MEASUREMENT_LOST
    # other strides in memory are no other numbers
    spread = [np.repeat(a, 2)[::2] for a in (q, measurement.v, x, target)]
    state = controller.initial_state(measurement)
    _, again = controller.step(state, aj.Measurement(0.0, *spread[:3]), spread[3], 1e-3)
    _, plain = controller.step(state, measurement, target, 1e-3)
    np.testing.assert_allclose(again.torque, plain.torque, rtol=1e-9, atol=1e-9)


class Odd:
    """An object that is nothing anyone would pass."""

    shape = (7,)


def junk(size):
    """Things that are no float64 vectors of a size."""
    return st.one_of(
        st.sampled_from(
            [
                None, "text", "", b"bytes", 0, 1.5, True, 1j, [], (), {}, {1, 2}, Odd(), Odd, aj,
                iter([1]), range(size), [0.0] * size, (0.0,) * size, ["0"] * size, [None] * size,
                [[0.0]] * size,
                np.zeros(size, dtype=np.int64), np.zeros(size, dtype=np.uint8),
                np.zeros(size, dtype=np.float32), np.zeros(size, dtype=np.float16),
                np.zeros(size, dtype=np.longdouble), np.zeros(size, dtype=bool),
                np.zeros(size, dtype=complex), np.zeros(size, dtype=object), np.array(["a"] * size),
                np.full(size, None), np.zeros(size, dtype=">f8"), np.zeros(size, dtype="M8[s]"),
                np.zeros((size, 1)), np.zeros((1, size)), np.zeros(size + 1), np.zeros(()),
                np.zeros((size, size)), np.float64(0.0), np.array([[1.0] * (size + 1)]),
                np.zeros(size, dtype=[("a", "f8")]), 10**400, [10**400] * size,
                np.ma.masked_array(np.zeros(size), True), np.ma.masked_array(np.zeros(size)),
                np.ma.masked, [np.ma.masked] * size,
            ]
        ),
        st.binary(max_size=4),
        st.text(max_size=8),
        st.lists(st.one_of(st.none(), st.floats(), st.text(max_size=2)), max_size=8),
    )  # fmt: skip


@FUZZ
@given(data=st.data())
def test_wrong_types_and_shapes_are_named_errors(controller, data):
    task = controller.task
    q = task.robot.neutral()
    good = {
        "state": np.zeros(n_state(controller)),
        "q": q,
        "v": np.zeros(task.robot.nv),
        "x": task.value(q),
        "target": task.value(q),
    }
    sizes = {name: value.size for name, value in good.items()}
    names = st.sampled_from([name for name, size in sizes.items() if size])
    for name in data.draw(st.lists(names, min_size=1, max_size=2)):
        good[name] = data.draw(junk(sizes[name]))
    measurement = aj.Measurement(0.0, good["q"], good["v"], good["x"])
    with pytest.raises(aj.errors.ApproxJacError, match="must be"):
        controller.step(good["state"], measurement, good["target"], 1e-3)


@FUZZ
@given(data=st.data())
def test_what_is_no_measurement_is_a_named_error(controller, data):
    size = data.draw(st.integers(0, 5))
    measurement = data.draw(st.one_of(junk(4), st.tuples(*[junk(7)] * size)))
    target = controller.task.value(controller.task.robot.neutral())
    with pytest.raises(aj.errors.ApproxJacError, match="must be"):
        controller.step(np.zeros(n_state(controller)), measurement, target, 1e-3)
    with pytest.raises(aj.errors.ApproxJacError, match="must be"):
        controller.initial_state(measurement)


# -- a closed loop --------------------------------------------------------------------------


class Corrupted(aj.Controller):
    """A controller that at random steps is told nonsense; it holds its last torque on an error."""

    def __init__(self, controller, seed, hold):
        self.controller, self.rng, self.hold = controller, np.random.default_rng(seed), hold
        self.refused, self.answered = 0, 0

    @property
    def task(self):
        return self.controller.task

    def begin(self, measurement):
        return self.controller.begin(measurement)

    def advance(self, state, measurement, target, dt):
        told = {**measurement._asdict(), "target": target}
        absurd = self.rng.random() < 0.2
        if absurd:
            name = self.rng.choice(["q", "v", "x", "target"])
            value = told[name].copy()
            kind = self.rng.integers(4)
            if kind == 0:
                value[self.rng.integers(len(value))] = self.rng.choice(EXTREMES)
            elif kind == 1:
                value[:] = self.rng.choice(EXTREMES)
            elif kind == 2:
                value += self.rng.normal(size=len(value)) * 10.0 ** self.rng.uniform(-10, 300)
            else:
                value = value[1:]
            told[name] = value
        target = told.pop("target")
        try:
            state, answer = self.controller.advance(state, aj.Measurement(**told), target, dt)
        except aj.errors.ApproxJacError:
            assert absurd
            self.refused += 1
            lost = np.full(self.controller.task.m, np.nan)
            rest = np.zeros_like(state)
            return state, aj.Evaluation(self.hold, rest, aj.Status.MEASUREMENT_LOST, lost)
        self.answered += absurd
        self.hold = answer.torque
        return state, answer


@pytest.mark.parametrize(
    ("name", "bound"),
    [
        # measured: 0.03 m for positions, 0.08 m stacked, 0.16 (m and rad) for the pose
        ("(6), sine", 0.1),
        ("(28), bounds", 0.1),
        pytest.param("stacked", 0.25, marks=pytest.mark.study),
        pytest.param("pose", 0.5, marks=pytest.mark.study),
        # these remember nonsense, in the differentiator and in θ̂ that nothing stops: only finite
        pytest.param("(5)", np.inf, marks=pytest.mark.study),
        pytest.param("(28), unlimited", np.inf, marks=pytest.mark.study),
        ("tracking", np.inf),
    ],
)
def test_a_run_with_corrupted_input_ends_finite(name, bound):
    """One step in five is nonsense; motors that deliver only so much keep it harmless."""
    controller = controllers()[name]
    robot = controller.task.robot
    plant = aj.Plant(robot, controller.task, friction=2.0, torque_limits=LIMITS)
    corrupted = Corrupted(controller, 0, plant.dynamics.g(START))
    target = controller.task.value(START)
    options = {"dt": 1e-3, "computation": aj.simulation.Computation("semi_implicit_euler")}
    run = aj.simulate(plant, corrupted, target, START, 1.0, **options)
    assert corrupted.refused > 50
    assert corrupted.answered > 50
    for array in (run.q, run.v, run.x, run.tau, run.state):
        assert np.isfinite(array).all()
    assert run.error_norm.max() < bound


# -- building and running -------------------------------------------------------------------

RAGGED = [[1.0], [1.0, 2.0]]
ODD = (
    None, "text", "", b"bytes", -1, 0, 1, 3, 1.5, True, 1j, [], (), {}, {1, 2}, Odd(), Odd, aj, len,
    range(3), RAGGED, [RAGGED], [None] * 3, ["1"] * 3, "1", np.zeros((2, 2)), np.zeros(()),
    np.array([1.0]), np.full((1, 1), 1.0), np.zeros(7, dtype=object), np.array(["a"]), 10**400,
    [10**400], -(10**400), np.nan, np.inf, -np.inf, 5e-324, 1e-300, 1e-155, 1e155, 1e300,
    np.array(1 + 1j), [1 + 1j], np.datetime64("2026-01-01"), np.zeros(3, dtype=bool),
    np.ma.masked_array(np.ones(7), [True] + [False] * 6), np.ma.masked, [np.ma.masked] * 3,
    np.ma.masked_array(np.ones(3), [True] * 3), np.ma.masked_array(1.0, True),
    np.full(7, np.longdouble("1e4000")),
    "\0", "a" * 300, "a/" * 3000, Path("x" * 300), Path("."), "<robot", "<robot/>", object(),
)  # fmt: skip


@functools.cache
def parts():
    panda = aj.load_robot("panda")
    task = aj.PositionTask(panda)
    two_link = aj.load_robot("two_link")
    plane = aj.PositionTask(two_link, axes="xz")
    controller = aj.SetpointController(plane, aj.Gains(60.0, 20.0))
    late = aj.Sensing(x_noise=1e-3, x_delay=0.02, x_dropout=0.1, velocity_filter=0.01)
    return {
        "panda": panda,
        "task": task,
        "gains": aj.Gains(400.0, 80.0, 1.0),
        "regressor": GravityRegressor(panda),
        "plant": aj.Plant(two_link, plane, sensing=late, actuator_delay=0.01),
        "controller": controller,
    }


def _simulate(**changes):
    arguments = {
        "plant": parts()["plant"],
        "controller": parts()["controller"],
        "target": (0.5, 1.2),
        "q0": (0.3, 0.8),
        "duration": 0.1,
        "dt": 0.01,
        **changes,
    }
    return aj.simulate(**arguments)


def _simulate_from(**changes):
    return _simulate(q0=aj.simulation.InitialState(**{"q0": (0.3, 0.8), **changes}))


def _simulate_by(**changes):
    return _simulate(computation=aj.simulation.Computation(**changes))


def _plant(**changes):
    return aj.Plant(**{"robot": parts()["panda"], "sensor": parts()["task"], **changes})


def _run_with(**changes):
    """A short run of the panda's plant with some option."""
    plant = _plant(**changes)
    controller = aj.SetpointController(parts()["task"], parts()["gains"])
    return aj.simulate(plant, controller, (0.4, 0.1, 0.5), START, 3e-3, dt=1e-3)


def _rough(**changes):
    return _run_with(friction=aj.robots.Friction(**changes))


def _driven(**changes):
    usual = {"rotor_inertia": 0.1, "stiffness": 1e4}
    return _run_with(drives=aj.robots.Drives(**{**usual, **changes}))


class Still(aj.Controller):
    """A controller that commands no velocity."""

    command = "velocity"

    def advance(self, state, measurement, target, dt):
        e = measurement.x - target
        return state, aj.Evaluation(np.zeros(7), None, aj.Status.OK, e)


def _servoed(**changes):
    """A short run of the panda by velocities, with some option of its servo."""
    plant = _plant(servo=VelocityServo(**changes))
    return aj.simulate(plant, Still(parts()["task"]), (0.4, 0.1, 0.5), START, 3e-3, dt=1e-3)


def _controller(**changes):
    arguments = {"task": parts()["task"], "gains": parts()["gains"], **changes}
    return aj.SetpointController(**arguments)


def _sensed(**changes):
    return _run_with(sensing=aj.Sensing(**changes))


ENTRANCES = {
    _simulate: (
        "plant", "controller", "target", "q0", "duration", "dt", "record_every", "seed",
        "computation",
    ),
    _simulate_from: ("q0", "v0", "state"),
    _simulate_by: ("integrator", "engine", "progress"),
    _rough: ("viscous", "coulomb", "stribeck", "stribeck_velocity", "load"),
    _driven: (
        "rotor_inertia", "stiffness", "damping_ratio", "backlash", "ripple", "ripple_count",
        "encoders",
    ),
    _run_with: (
        "robot", "sensor", "friction", "sensing", "actuator_delay", "torque_limits", "servo",
        "drives",
    ),
    _servoed: ("lag", "delay", "period"),
    _sensed: (
        "x_noise", "x_quantum", "x_delay", "x_dropout", "q_noise", "q_quantum", "velocity_filter",
    ),
    _controller: ("task", "gains", "gravity", "saturation", "velocity", "posture"),
    lambda **k: aj.default_gains(**{"task": parts()["task"], **k}): ("task", "settling_time"),
    lambda **k: aj.Gains(**{"kp": 1.0, "kv": 1.0, **k}): ("kp", "kv", "damping"),
    lambda **k: Posture(**{"q": START, "stiffness": 1.0, **k}): ("q", "stiffness"),
    lambda **k: aj.AdaptiveGravity(parts()["regressor"], **k): (
        "L", "alpha", "theta0", "bounds", "torque_limits",
    ),
    lambda **k: Sine(**k): ("gamma",),
    lambda **k: Tanh(**k): ("gamma",),
    lambda **k: DifferentiatedVelocity(**k): ("time_constant",),
    lambda **k: aj.load_robot(**{"source": "two_link", **k}): (
        "source", "gravity", "tip", "base", "free",
    ),
}  # fmt: skip


@pytest.mark.parametrize(
    ("build", "name"), [(build, name) for build, names in ENTRANCES.items() for name in names]
)
def test_odd_arguments_are_taken_or_named_errors(build, name):
    refused = 0
    for odd in ODD:
        if name == "progress" and callable(odd):
            continue  # what a user's function raises is the user's
        try:
            build(**{name: odd})
        except aj.errors.ApproxJacError as error:
            assert len(str(error)) > 20  # noqa: PT017
            refused += 1
    assert refused > len(ODD) // 2
