"""Compiled steps: the same answers as in NumPy, for every arm, law and argument."""

import copy
import functools
import itertools
import pickle
import subprocess
import sys

import numpy as np
import pytest
from arms import SEVERAL
from numpy.testing import assert_allclose, assert_array_equal
from numpy_lanes import NumpyLanes
from own_parts import Cubic, of_ones_own

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.codegen.step import compiled, step_program
from approxjac.controllers import (
    AwayFromStops,
    DifferentiatedVelocity,
    Posture,
    RegressorGravity,
)
from approxjac.controllers.guard import SampleGuard
from approxjac.errors import InvalidInputError, MeasurementError, MissingPackageError
from approxjac.law import Sine, Tanh, theta_hat_rate
from approxjac.robots import GravityRegressor
from approxjac.simulation.simulate import SampledLoop
from approxjac.tasks import CombinedTask, NonsingularTask

STATUSES = tuple(aj.Status)
CAMERA = aj.PinholeCamera.looking_at((0.4, 0.0, 0.4), (2.0, -1.0, 1.0), 600.0, (640, 480))
NEAR = aj.PinholeCamera.looking_at((0.45, 0.0, 0.4), (1.1, -0.3, 0.9), 300.0, (640, 480))
STUDY = pytest.mark.study
SQUARE = ((0.2, 0.0, 0.05), (-0.1, 0.2, 0.0), (0.0, -0.2, 0.2))
SLIDE = """<link name="l{0}"><inertial><mass value="2"/>
  <inertia ixx="0.1" iyy="0.1" izz="0.1" ixy="0" ixz="0" iyz="0"/></inertial></link>
  <joint name="j{0}" type="prismatic"><parent link="l{1}"/><child link="l{0}"/><axis xyz="{2}"/>
    <limit lower="-1" upper="1" effort="100" velocity="1"/></joint>"""
SLIDES = [SLIDE.format(*each) for each in ((1, 0, "1 0 0"), (2, 1, "0 1 0"), (3, 2, "0.6 0 0.8"))]
GANTRY = f'<robot name="gantry"><link name="l0"/>{"".join(SLIDES)}</robot>'
BENT = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])


def pair(task, gains=None, **options):
    """The same controller in NumPy and compiled."""
    plain = aj.SetpointController(task, gains, **options)
    return plain, compiled(plain)


def measured(task, rng, size=0.1, q=None):
    """A state of the arm, and a target that is as far away as `size`."""
    robot = task.robot
    q = robot.random_configuration(rng) if q is None else q
    x = task.measured.visible(task.value(q))
    near = np.where(np.isfinite(x), x, 0.0)
    if task.units == ("px",) * task.m:
        near = np.clip(near, 100.0, 400.0)  # within the image
    target = task.displaced(near, size * rng.normal(size=task.m))
    return aj.Measurement(0.0, q, 0.3 * rng.normal(size=robot.nv), x), target


def assert_same(ours, expected, rates=1e-11):
    """Equal to rounding."""
    for name, tolerance in (
        ("torque", 1e-12), ("state_rate", rates), ("e", 1e-13), ("J_hat", 1e-12),
        ("gravity", 1e-12),
    ):  # fmt: skip
        own, other = getattr(ours, name), getattr(expected, name)
        finite = np.where(np.isfinite(other), np.abs(other), 0.0)
        scale = 1.0 + finite.max(initial=0.0)
        assert own.shape == other.shape, name
        assert_allclose(own / scale, other / scale, rtol=0, atol=tolerance, err_msg=name)
    assert ours.status is expected.status
    assert ours.limit_status is expected.limit_status
    assert ours.slack == expected.slack


@pytest.fixture
def asked(monkeypatch):
    """Steps in which a compiled controller that is built from here on asked the ordinary way."""
    steps, ordinary = [], aj.SetpointController.evaluate

    def counted(controller, *arguments):
        if type(controller) is not aj.SetpointController:
            steps.append(arguments)
        return ordinary(controller, *arguments)

    monkeypatch.setattr(aj.SetpointController, "evaluate", counted)
    return steps


def learning(robot, **options):
    return aj.AdaptiveGravity(robot, L=0.5, alpha=1.0, torque_limits=np.inf, **options)


LAWS = {
    "(6)": lambda task: {},
    "sine": lambda task: {"saturation": Sine(0.05)},
    "tanh, a γ each": lambda task: {"saturation": Tanh(0.1 * np.arange(1, task.m + 1))},
    "no gravity": lambda task: {"gravity": aj.NoGravity(task.robot)},
    "(5)": lambda task: {"velocity": DifferentiatedVelocity(0.02)},
    "(28)": lambda task: {"gravity": learning(task.robot)},
    "(28), sine": lambda task: {"gravity": learning(task.robot), "saturation": Sine(0.05)},
}


ALIKE = ("ur5", "tiago_arm")  # mimic joints are among the kinds below


@pytest.mark.study
@pytest.mark.parametrize("name", LAWS)
@pytest.mark.parametrize(
    "arm",
    [pytest.param(a.id, marks=pytest.mark.long, id=a.id) if a.id in ALIKE else a for a in SEVERAL],
    indirect=True,
)
def test_on_every_arm_it_is_the_same_law(arm, name, rng, asked):
    task = aj.PositionTask(arm)
    plain, ours = pair(task, **LAWS[name](task))
    usual = 0
    for _ in range(20):
        measurement, target = measured(task, rng)
        state = plain.begin(measurement)
        state *= rng.uniform(0.5, 1.5, len(state))
        expected = plain.evaluate(state, measurement, target)
        assert_same(ours.evaluate(state, measurement, target), expected)
        usual += expected.status is aj.Status.OK
    assert usual >= 5
    assert len(asked) == 20 - usual


@functools.cache
def kinds():
    """Controllers, one for each way through a step."""
    gantry = aj.Robot(GANTRY)
    panda, kinova = aj.load_robot("panda"), aj.load_robot("kinova")
    position, regressor = aj.PositionTask(panda), GravityRegressor(panda)
    square = aj.ImageTask(panda, NEAR, points=SQUARE)
    two = aj.StackedTask(position, aj.PositionTask(panda, "panda_link4", "yz"))
    held = panda.random_configuration(np.random.default_rng(1))
    symmetric = 0.1 * (np.eye(regressor.p) + 0.1)
    firm, soft = aj.Gains(400.0, 80.0, 1.0), aj.Gains(100.0, 20.0, 1.0)
    law = aj.SetpointController
    return {
        "one axis": law(aj.PositionTask(panda, axes="z")),
        "a plane, turned": law(aj.PositionTask(panda, axes="zx")),
        "two frames, m = 5": law(two, soft),
        "two frames, learnt": law(two, soft, gravity=learning(panda)),
        "a pose": law(aj.PoseTask(panda)),
        "a pose, learnt": law(aj.PoseTask(panda), gravity=learning(panda)),
        "a planar image": law(aj.ImageTask(aj.load_robot("two_link"), PlanarCamera(0.016, 0.8))),
        "an image": law(aj.ImageTask(panda, CAMERA)),
        "an image, (5)": law(aj.ImageTask(panda, CAMERA), velocity=DifferentiatedVelocity(0.02)),
        "three points, m = 6": law(square),
        "measured depths": law(aj.ImageTask(panda, NEAR, points=SQUARE, depth="measured")),
        "combined": law(CombinedTask.balanced(square, square.value(BENT))),
        "a nonsingular Jacobian": law(NonsingularTask(position, {"panda_joint4": 0.3}), firm),
        "continuous joints": law(aj.PositionTask(kinova), gravity=learning(kinova)),
        "mimic joints": law(aj.PositionTask(aj.load_robot("panda", free="all")), firm),
        "a posture": law(position, posture=Posture(held, 5.0)),
        "away from stops": law(position, posture=AwayFromStops()),
        "a posture, learnt": law(position, posture=Posture(held, 5.0), gravity=learning(panda)),
        "known θ": law(position, gravity=RegressorGravity(regressor, regressor.theta)),
        "bounds": law(
            position,
            gravity=learning(panda, bounds=(regressor.theta - 0.1, regressor.theta + 0.1)),
        ),
        "a Jacobian that is known": law(
            NonsingularTask(aj.PositionTask(gantry), {"j1": 0.1}), soft
        ),
        "a full L": law(
            position, gravity=aj.AdaptiveGravity(regressor, symmetric, 1.0, torque_limits=np.inf)
        ),
    }


KINDS = (
    "one axis", "a plane, turned", "two frames, m = 5", "two frames, learnt", "a pose",
    "a pose, learnt", "a planar image", "an image", "an image, (5)", "three points, m = 6",
    "measured depths", "combined", "a nonsingular Jacobian", "continuous joints", "mimic joints",
    "a posture", "away from stops", "a posture, learnt", "known θ", "bounds",
    "a Jacobian that is known", "a full L",
)  # fmt: skip
"""Of `kinds`, which takes seconds to build where tests are only collected."""
BY_DEFAULT = (
    "two frames, learnt", "a pose, learnt", "an image, (5)", "measured depths", "combined",
    "a nonsingular Jacobian", "mimic joints", "a posture, learnt", "bounds",
    "a Jacobian that is known",
)  # fmt: skip


@pytest.mark.parametrize(
    "kind",
    [pytest.param(kind, marks=() if kind in BY_DEFAULT else STUDY) for kind in KINDS],
)
def test_every_kind_of_controller(kind, rng, asked):
    assert tuple(kinds()) == KINDS
    plain = kinds()[kind]
    task, ours = plain.task, compiled(plain)
    statuses = []
    for k in range(40):
        q = BENT + 0.3 * rng.normal(size=7) if k % 2 and task.robot.nq == 7 else None
        measurement, target = measured(task, rng, 10.0 if task.units[0] == "px" else 0.05, q)
        first = measurement
        if plain.velocity is not None:  # which begins with a whole x
            first = measurement._replace(x=np.where(np.isfinite(measurement.x), measurement.x, 0.0))
        state = plain.begin(first)
        state += 0.2 * rng.normal(size=len(state))
        expected = plain.evaluate(state, measurement, target)
        assert_same(ours.evaluate(state, measurement, target), expected)
        statuses.append(expected.status)
    usual = statuses.count(aj.Status.OK)
    assert usual > 10
    assert len(asked) == 40 - usual


@pytest.mark.parametrize("name", ["(6)", "(28), sine"])
def test_usual_steps_are_compiled_whatever_the_arrays_are(panda, name, rng, asked):
    """Other strides, read-only, not aligned: one machine code takes them all."""
    task = aj.PositionTask(panda)
    _, ours = pair(task, **LAWS[name](task))
    measurement, target = measured(task, rng, 0.01, BENT)
    state = ours.begin(measurement)
    expected = ours.evaluate(state, measurement, target)
    assert expected.status is aj.Status.OK

    def unaligned(array):
        room = np.zeros(array.nbytes + 1, dtype=np.uint8)
        other = np.frombuffer(room, dtype=np.float64, offset=1, count=len(array))
        other.flags.writeable = True
        other[:] = array
        return other

    def read_only(array):
        other = array.copy()
        other.flags.writeable = False
        return other

    for change in (
        lambda a: np.repeat(a, 3)[::3],
        read_only,
        unaligned,
        lambda a: a[::-1].copy()[::-1],
    ):
        arrays = [change(a) for a in (measurement.q, measurement.v, measurement.x, target, state)]
        answer = ours.evaluate(arrays[4], aj.Measurement(0.0, *arrays[:3]), arrays[3])
        assert_array_equal(answer.torque, expected.torque)
        assert_array_equal(answer.state_rate, expected.state_rate)
    assert asked == []


@pytest.mark.parametrize(
    ("proof", "learns"),
    [
        (True, True),
        (False, False),
        pytest.param(True, False, marks=STUDY),
        pytest.param(False, True, marks=STUDY),
    ],
)
def test_limits_of_effort_are_compiled_with_it(panda, learns, proof, rng):
    """The same torques, statuses, slack and learning, whether the limits bind or not."""
    task = aj.PositionTask(panda)
    law = aj.SetpointController(task, gravity=learning(panda) if learns else None)
    limits = aj.Limits(effort=0.4 * panda.effort_limits)
    plain = aj.TorqueLimited(law, limits, proof=proof)
    ours = compiled(plain)
    assert isinstance(ours, aj.TorqueLimited)
    seen = set()
    for k in range(60):
        spread = 10.0 ** rng.uniform(-3.0, 0.0)
        measurement, target = measured(task, rng, spread, BENT + 0.3 * rng.normal(size=7))
        if k == 7:
            measurement = measurement._replace(x=np.full(3, np.nan))
        state = law.initial_state(measurement)
        state *= rng.uniform(0.9, 1.1, len(state))
        after, answer = ours.step(state, measurement, target, 1e-3)
        expected_after, expected = plain.step(state, measurement, target, 1e-3)
        assert_allclose(answer.slack, expected.slack, rtol=1e-8, atol=1e-10)
        assert_same(answer._replace(slack=0.0), expected._replace(slack=0.0))
        assert_allclose(after, expected_after, rtol=1e-12, atol=1e-12)
        seen.add(answer.limit_status)
    kinds = {"FREE", "PROOF_KEPT", "PROOF_GIVEN_UP"} if proof else {"FREE", "LIMITED"}
    assert kinds <= {each.name for each in seen}
    again = pickle.loads(pickle.dumps(ours))
    assert_array_equal(again.step(state, measurement, target, 1e-3)[1].torque, answer.torque)
    assert type(ours.ordinary) is aj.TorqueLimited


def test_an_answer_is_the_users_to_keep(panda, rng):
    task = aj.PositionTask(panda)
    _, ours = pair(task, gravity=learning(panda))
    measurement, target = measured(task, rng, 0.01, BENT)
    state = ours.begin(measurement)
    first = ours.evaluate(state, measurement, target)
    kept = copy.deepcopy(first)
    after, _ = ours.step(state, measurement, target, 1e-3)
    ours.evaluate(2.0 * state, measurement, target + 0.01)
    for own, other in zip(first, kept, strict=True):
        assert_array_equal(own, other)
    assert_array_equal(after, state + 1e-3 * first.state_rate)


def test_what_is_not_usual_is_answered_as_in_numpy(rng):
    """Lost, singular, beyond the limits, and enormous: the same status and the same torque."""
    task = aj.PositionTask(aj.load_robot("two_link"))
    learnt = aj.AdaptiveGravity(task.robot, L=0.5, alpha=1.0, torque_limits=100.0)
    seen = set()
    for options in ({}, {"gravity": learnt}, {"saturation": Sine(0.05)}):
        plain, ours = pair(task, aj.Gains(400.0, 80.0), **options)
        measurement, target = measured(task, rng)
        state = plain.begin(measurement)
        for change in (
            {"x": np.full(2, np.nan)},
            {"x": np.array([0.1, np.inf])},
            {"x": np.array([0.1, 1e29])},
            {"x": np.array([0.1, 1e120])},
            {"x": measurement.x + 10.0},
            {"q": np.array([0.3, 0.0])},  # stretched
            {"v": np.full(2, 1e40)},
        ):
            there = measurement._replace(**change)
            expected = plain.evaluate(state, there, target)
            assert_same(ours.evaluate(state, there, target), expected)
            seen.add(expected.status)
    assert seen == {
        aj.Status.OK,
        aj.Status.MEASUREMENT_LOST,
        aj.Status.NEAR_SINGULAR,
        aj.Status.TORQUE_SATURATED,
    }


@pytest.mark.parametrize("is_limited", [False, True])
def test_a_target_that_moves_is_a_usual_step(panda, rng, asked, is_limited):
    plain, ours = pair(aj.PositionTask(panda), gravity=learning(panda))
    measurement, target = measured(plain.task, rng, 0.01, BENT)
    if is_limited:
        plain = aj.TorqueLimited(plain, aj.Limits(effort=panda.effort_limits))
        ours = compiled(plain)
    state = plain.initial_state(measurement)
    for moving in (
        aj.Target(target, np.array([0.1, 0.0, 0.2])),
        aj.Target(target, np.array([0.1, 0.0, 0.2]), np.array([0.0, 1.0, 0.0])),
        aj.Target(target),
    ):
        expected_after, expected = plain.step(state, measurement, moving, 1e-3)
        asked.clear()
        after, answer = ours.step(state, measurement, moving, 1e-3)
        assert asked == []
        assert_same(answer, expected)
        assert_allclose(after, expected_after, rtol=1e-12, atol=1e-12)
        if expected.reference is None:
            assert answer.reference is None
        else:
            assert_allclose(answer.reference, expected.reference, rtol=0, atol=1e-12)
    wrong = aj.Target(target, np.zeros(2))
    with pytest.raises(InvalidInputError, match="v of the target"):
        ours.step(state, measurement, wrong, 1e-3)


@pytest.mark.study
def test_parts_of_an_image_that_are_lost_and_quaternions_that_are_none(panda, rng):
    for task, change in (
        (aj.ImageTask(panda, NEAR, points=SQUARE, depth="measured"), {2: np.nan}),
        (aj.ImageTask(panda, NEAR, points=SQUARE, depth="measured"), {2: -1.0}),
        (aj.PoseTask(panda), {3: 0.0, 4: 0.0, 5: 1e-7, 6: 0.0}),
        (aj.PoseTask(panda), {3: 0.0, 4: 3.0, 5: 1.0, 6: -2.0}),
    ):
        plain, ours = pair(task)
        measurement, target = measured(task, rng, 0.01, BENT)
        for place, value in change.items():
            measurement.x[place] = value
        expected = plain.evaluate(np.zeros(0), measurement, target)
        assert_same(ours.evaluate(np.zeros(0), measurement, target), expected)


def test_what_is_wrong_is_refused_with_the_same_words(panda, rng):
    kinova = aj.load_robot("kinova")
    cases = 0
    firm = aj.Gains(400.0, 80.0, 1.0)
    for robot, gravity in ((panda, learning(panda)), (kinova, None)):
        task = aj.PositionTask(robot)
        plain, ours = pair(task, firm, gravity=gravity)
        good, target = measured(task, rng)
        state = plain.begin(good)
        n, p = robot.nv, len(state)
        for arguments in (
            (state, good._replace(q=good.q[:-1]), target),
            (state, good._replace(q=good.q.tolist()), target),
            (state, good._replace(q=np.full(robot.nq, np.nan)), target),
            (state, good._replace(q=np.full(robot.nq, 3.0) if robot is kinova else "q"), target),
            (state, good._replace(v=np.zeros(n + 1)), target),
            (state, good._replace(v=np.zeros(n, dtype=int)), target),
            (state, good._replace(v=np.full(n, np.inf)), target),
            (state, good._replace(x=good.x[:-1]), target),
            (state, good._replace(x=good.x.astype(np.float32)), target),
            (state, good._replace(x=None), target),
            (state, good, target[:-1]),
            (state, good, target.tolist()),
            (state, good, np.full(3, np.nan)),
            (np.zeros(p + 1), good, target),
            (np.zeros(p, dtype=np.float32), good, target),
            (state.tolist(), good, target),
            (state, None, target),
            (state, (good.q, good.v, good.x), target),
        ):
            with pytest.raises(aj.errors.ApproxJacError) as expected:
                plain.evaluate(*arguments)
            with pytest.raises(type(expected.value)) as refused:
                ours.evaluate(*arguments)
            assert str(refused.value) == str(expected.value)
            cases += 1
        states = state, plain.initial_state(good)  # without a guard, and with one
        for begun, dt in itertools.product(states, (0.0, -1.0, np.nan, "1", None)):
            with pytest.raises(aj.InvalidInputError) as expected:
                plain.step(begun, good, target, dt)
            with pytest.raises(aj.InvalidInputError) as refused:
                ours.step(begun, good, target, dt)
            assert str(refused.value) == str(expected.value)
    assert cases == 36


def outcome(controller, *arguments):
    """The torque and the status, or what was raised."""
    try:
        answer = controller.evaluate(*arguments)
    except (IndexError, TypeError, ValueError) as error:
        return type(error), str(error)
    return np.round(np.asarray(answer.torque), 9).tolist(), answer.status


def test_arrays_of_other_classes_are_answered_as_in_numpy(panda, rng):
    """What a mask hides is not measured."""
    task = aj.PositionTask(panda)

    class Tagged(np.ndarray):
        pass

    for gravity in (None, learning(panda)):
        plain, ours = pair(task, gravity=gravity)
        measurement, target = measured(task, rng)
        state = plain.initial_state(measurement)
        for view in (
            lambda a: a.view(Tagged),
            np.ma.masked_array,
            lambda a: np.ma.masked_array(a, [True] + [False] * (len(a) - 1)),
        ):
            for name in ("v", "x", "q"):
                there = measurement._replace(**{name: view(getattr(measurement, name))})
                arguments = (state, there, target)
                assert outcome(ours, *arguments) == outcome(plain, *arguments)


def test_a_rate_that_overflows_is_a_named_error(panda):
    task = aj.PositionTask(panda)
    gravity = aj.AdaptiveGravity(panda, L=1e60, alpha=1.0, torque_limits=np.inf)
    measurement = aj.Measurement(0.0, BENT, np.full(7, 1e300), task.value(BENT))
    for controller in pair(task, aj.Gains(1.0, 1e-290, 1e-290), gravity=gravity):
        with pytest.raises(MeasurementError, match="the torque overflows or is no number"):
            controller.evaluate(controller.begin(measurement), measurement, measurement.x)


@pytest.mark.parametrize(
    "dtype", [">f8", *(pytest.param(each, marks=STUDY) for each in (np.float32, np.int64, object))]
)
def test_numbers_of_other_types_are_refused(panda, dtype, asked):
    task = aj.PositionTask(panda)
    for gravity in (None, learning(panda)):
        _, ours = pair(task, gravity=gravity)
        good = {"q": np.zeros(7), "v": np.zeros(7), "x": np.zeros(3), "target": np.ones(3)}
        good["state"] = np.zeros(0 if gravity is None else gravity.regressor.p)
        for name in good:
            given = good | {name: good[name].astype(dtype)}
            measurement = aj.Measurement(0.0, given["q"], given["v"], given["x"])
            with pytest.raises(
                aj.InvalidInputError, match=f"^{name} must be an array of .*float64"
            ):
                ours.evaluate(given["state"], measurement, given["target"])
    assert len(asked) == 10


def test_nothing_is_derived_from_it(panda):
    _, ours = pair(aj.PositionTask(panda))
    with pytest.raises(TypeError, match=r"^Mine cannot be derived from a law that is compiled"):
        type("Mine", (type(ours),), {})


@pytest.mark.study
def test_made_from_one_it_is_compiled_too(panda, rng, asked):
    task = aj.PositionTask(panda)
    plain, ours = pair(task, posture=Posture(np.zeros(7), 1.0))
    assert isinstance(ours, aj.SetpointController)
    assert compiled(ours) is ours
    belief = panda.with_object(0.1, 0.5)
    longer = aj.Uncertainty(panda, joint_shifts={"panda_joint3": (0.1, 0.1, 0.1)})
    longer = longer.robot(longer.high)
    made = (
        (ours.with_task(aj.PositionTask(belief)), plain.with_task(aj.PositionTask(belief))),
        (
            compiled(plain.with_gravity(learning(panda)).with_task(aj.PositionTask(longer))),
            plain.with_gravity(learning(panda)).with_task(aj.PositionTask(longer)),
        ),
        (ours.with_gravity(aj.NoGravity(panda)), plain.with_gravity(aj.NoGravity(panda))),
        (copy.copy(ours), plain),
        (copy.deepcopy(ours), plain),
        (pickle.loads(pickle.dumps(ours)), plain),
    )
    measurement, target = measured(task, rng, 0.01, BENT)
    for own, other in made:
        state = other.begin(measurement)
        expected = other.evaluate(state, measurement, target)
        assert_same(own.evaluate(state, measurement, target), expected)
    assert asked == []
    with pytest.raises(aj.InvalidInputError, match="cannot be changed once it is built"):
        ours.evaluate = None


@pytest.mark.parametrize("k", [*(pytest.param(k, marks=STUDY) for k in (0, 4, 6)), 1, 2, 3, 5, 7])
def test_what_is_ones_own_is_compiled_as_it_is(panda, k, rng):
    plain = of_ones_own(panda)[k]
    ours = compiled(plain)
    assert isinstance(ours, type(plain))
    measurement, target = measured(plain.task, rng, 0.05, BENT)
    state = plain.initial_state(measurement)
    usual, x = 0, measurement.x
    for step in range(200):
        t = step * 1e-3
        q = BENT + 0.1 * np.sin(t + np.arange(7.0))
        measurement, _ = measured(plain.task, rng, 0.0, q)
        measurement = measurement._replace(t=t, t_x=0.03 * (step // 30))
        x = x if step % 30 else measurement.x
        measurement = measurement._replace(x=x)
        after, expected = plain.step(state, measurement, target, 1e-3)
        found, answer = ours.step(state, measurement, target, 1e-3)
        size = 1.0 + np.abs(after).max(initial=0.0)
        assert_allclose(found / size, after / size, rtol=0, atol=1e-12)
        scale = 1.0 + np.abs(expected.torque).max()
        assert_allclose(answer.torque / scale, expected.torque / scale, rtol=0, atol=1e-12)
        assert answer.status is expected.status
        assert answer.limit_status is expected.limit_status
        assert (answer.J_hat is None) == (expected.J_hat is None)
        usual += expected.status in (aj.Status.OK, aj.Status.MEASUREMENT_HELD)
        state = after
    assert usual > 150
    assert pickle.loads(pickle.dumps(ours)).ordinary.task.labels == plain.task.labels


def test_an_x_without_its_time_is_held_as_in_python(panda, rng):
    """Then it is new where it differs from the one before."""
    plain = aj.HeldMeasurement(aj.SetpointController(aj.PositionTask(panda)), 0.05)
    measurement, target = measured(plain.task, rng, 0.05, BENT)
    state, statuses = plain.initial_state(measurement), []
    for k in range(4):
        moved = measurement._replace(
            t=1e-3 * k, q=measurement.q + 1e-3 * k * measurement.v,
            x=measurement.x + 1e-3 * (k // 2),
        )  # fmt: skip
        after, expected = plain.step(state, moved, target, 1e-3)
        found, answer = compiled(plain).step(state, moved, target, 1e-3)
        assert_allclose(found, after, rtol=0, atol=1e-12)
        assert answer.status is expected.status
        state, statuses = after, [*statuses, answer.status.name]
    assert statuses == ["OK", "MEASUREMENT_HELD"] * 2


@pytest.mark.parametrize("bad", [np.nan, np.inf])
def test_a_state_that_no_step_returned_is_looked_at(panda, bad):
    """Also where it is remembered for later only."""
    law = aj.TrackingController(aj.PositionTask(panda)).guarded(None)
    seen = aj.Plant(panda).measure(0.0, aj.Plant(panda).ready_configuration(), np.zeros(7))
    seen, fast = seen._replace(t_x=0.0), compiled(law)
    state = law.initial_state(seen)
    for i in range(0, len(state), 97):
        wrong = state.copy()
        wrong[i] = bad
        with pytest.raises(aj.errors.ApproxJacError):
            fast.step(wrong, seen, seen.x, 1e-3)


def test_what_cannot_be_traced_is_named(panda):
    class Clipped(Cubic):
        def s(self, e):
            return super().s(e) if e.ndim > 1 or e[0] < 1e300 else e

    class Arctangent(Cubic):
        def s(self, e):
            return super().s(e) + 0.0 * np.arctan(e)

    task = aj.PositionTask(panda)
    law = aj.SetpointController(task)
    for controller, text in (
        (aj.TorqueLimited(law, solver=min), "solver must be None to make code of a limiter"),
        (
            aj.SetpointController(task, saturation=Clipped()),
            "controller must take symbols to make code of it, with choices by numpy.where or "
            "law.choose and no branch on a value, which Clipped.s does not: TypeError: no branch",
        ),
        (
            aj.SetpointController(task, saturation=Arctangent()),
            "controller must take symbols to make code of it, with choices by numpy.where or "
            "law.choose and no branch on a value, which Arctangent.s does not: numpy.arctan is",
        ),
        (task, "controller must be a controller, such as SetpointController(task), got"),
    ):
        with pytest.raises(aj.InvalidInputError) as refused:
            compiled(controller)
        assert str(refused.value).startswith(text)


def test_without_llvmlite_it_says_what_to_install(panda, monkeypatch):
    monkeypatch.setitem(sys.modules, "llvmlite", None)
    monkeypatch.setitem(sys.modules, "llvmlite.binding", None)
    with pytest.raises(MissingPackageError, match=r"pip install 'approxjac\[fast\]'$"):
        compiled(aj.SetpointController(aj.PositionTask(panda)))


def test_nothing_else_loads_llvmlite():
    code = (
        "import sys, approxjac as aj\n"
        "aj.SetpointController(aj.PositionTask(aj.load_robot('two_link')))\n"
        "assert not {'numba', 'llvmlite', 'approxjac.codegen'} & set(sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


def test_a_program_that_may_lose_x_knows_it(panda):
    """As C code needs it, which cannot ask Python."""
    plain = aj.SetpointController(aj.ImageTask(panda, NEAR, points=SQUARE), gravity=learning(panda))
    program = step_program(plain.guarded(None), may_lose=True)
    buffer = np.zeros((4, program.n_rows, 1))
    place = {name: slice(at, at + size) for name, (at, size) in program.rows.items()}
    x = plain.task.value(BENT)
    measurement = aj.Measurement(0.0, BENT, np.full(7, 0.1), x)
    state = plain.begin(measurement)
    target, lost = x + 0.1, np.where(np.arange(6) == 2, np.nan, x)
    for name, each in (("q", BENT), ("v", measurement.v), ("target", target), ("state", state)):
        buffer[:, place[name], 0] = each
    buffer[:, place["x"], 0] = [x, lost, x, np.full(6, np.nan)]
    NumpyLanes(program).run(buffer, np.zeros((4, 1, 1)))
    for k, given in enumerate([x, lost, x, np.full(6, np.nan)]):
        expected = plain.evaluate(state, measurement._replace(x=given), target)
        torque, rate, (status,) = (
            buffer[k, place[name], 0] for name in ("torque", "rate", "status")
        )
        assert STATUSES[int(status)] is expected.status
        assert_allclose(torque, expected.torque, rtol=0, atol=1e-10)
        assert_allclose(rate, expected.state_rate, rtol=0, atol=1e-10)


@pytest.mark.parametrize("learns", [False, pytest.param(True, marks=pytest.mark.long)])
def test_a_whole_run_within_limits_of_effort_is_that_of_python(panda, learns, monkeypatch):
    truth, belief = panda.with_object(0.2, 0.5), panda.with_object(0.0)
    plant, task = aj.Plant(truth), aj.PositionTask(belief)
    gravity = aj.AdaptiveGravity(belief) if learns else aj.controllers.ModelGravity(truth)
    target = plant.sensor.value(plant.ready_configuration()) + [0.15, -0.15, 0.1]
    law = aj.SetpointController(task, gravity=gravity)
    limited = aj.TorqueLimited(law, aj.Limits(effort=0.45 * belief.effort_limits))
    options = {
        "duration": 2.0,
        "dt": 1e-3,
        "computation": aj.simulation.Computation("semi_implicit_euler"),
    }
    plain = aj.simulate(plant, limited, target, **options)
    monkeypatch.delattr(SampledLoop, "advance")
    quick = aj.simulate(plant, compiled(limited), target, **options)
    assert len(set(plain.limit_status)) > 1
    assert_array_equal(quick.limit_status, plain.limit_status)
    assert_array_equal(quick.status, plain.status)
    for part in ("q", "v", "tau", "slack", "V"):
        found, expected = getattr(quick, part), getattr(plain, part)
        assert_allclose(found, expected, rtol=1e-8, atol=1e-8, err_msg=part)


def test_what_python_does_again_is_told_once(panda):
    law = compiled(aj.SetpointController(aj.PositionTask(panda), aj.Gains(400.0, 80.0, 50.0)))
    assert repr(law) == f"compiled({law.ordinary!r})"
    told, target = [], np.array([0.5, 0.1, 0.5])
    with pytest.raises(aj.errors.SimulationError):
        aj.simulate(
            aj.Plant(panda),
            law,
            target,
            duration=2.0,
            dt=1e-3,
            computation=aj.simulation.Computation(progress=told.append),
        )
    assert len(told) > 3
    assert (np.diff(told) > 0.0).all()


def test_a_plant_that_moves_otherwise_is_not_taken_for_a_plant(panda):
    """Such as one of MuJoCo, which has a floor."""

    class Slow(aj.Plant):
        def _forward(self, q, v, tau):
            return 0.5 * super()._forward(q, v, tau)

    plant, task = Slow(panda), aj.PositionTask(panda)
    target = plant.sensor.value(plant.ready_configuration()) + 0.05
    plain, quick = pair(task)
    runs = [aj.simulate(plant, law, target, duration=2.1, dt=1e-3) for law in (plain, quick)]
    assert_allclose(runs[1].q, runs[0].q, rtol=0, atol=1e-9)


@pytest.mark.long
def test_a_whole_run_with_limits_ends_at_the_same_place(panda):
    truth, belief = panda.with_object(0.2, 0.5), panda.with_object(0.0)
    plant, task = aj.Plant(truth), aj.PositionTask(belief)
    target = plant.sensor.value(plant.ready_configuration()) + [0.1, -0.1, 0.1]
    ends = []
    for controller in pair(task, gravity=aj.AdaptiveGravity(belief)):
        limited = aj.TorqueLimited(controller, aj.Limits.of(belief))
        run = aj.simulate(plant, limited, target, duration=2.0, dt=1e-3)
        assert run.error_norm[-1] < 0.1 * run.error_norm[0]
        ends.append(run.q[-1])
    assert_allclose(ends[1], ends[0], atol=1e-9)


def test_learning_stops_at_the_motors_as_that_of_the_ordinary_law(panda, rng):
    """Where |Yθ̂| is beyond what θ̂ may ask for, and the torque of the law is not."""
    task = aj.PositionTask(panda)
    low = 10.0  # N m
    gravity = aj.AdaptiveGravity(panda, bounds=(-100.0, 100.0), torque_limits=low)
    given = aj.SetpointController(task, gravity=gravity).adaptation
    given = given._replace(torque_limits=np.full(7, np.inf))
    plain, quick = pair(task, gravity=given)
    seen = 0
    for _ in range(30):
        measurement, target = measured(task, rng)
        state = plain.begin(measurement)
        expected = plain.evaluate(state, measurement, target)
        # within the bounds by a few sweeps, which end where nothing is beyond them by 1e-12
        assert_same(quick.evaluate(state, measurement, target), expected, rates=1e-9)
        g = expected.gravity
        unbounded = theta_hat_rate(
            given.L, given.Y(measurement.q, expected.J_hat),
            plain.passive_output(expected, measurement.v, given.alpha),
        )  # fmt: skip
        seen += not np.allclose(expected.state_rate, unbounded) and (np.abs(g) > low).any()
    assert seen > 5


@pytest.mark.parametrize("t_x", [None, 0.0])
def test_good_samples_of_a_motion_are_usual_steps_with_the_guard(panda, t_x, monkeypatch, rng):
    plain, ours = pair(aj.PositionTask(panda), gravity=learning(panda))
    (_, q, v, x, _), target = measured(plain.task, rng, 0.01, BENT)
    state, asked = plain.initial_state(aj.Measurement(0.0, q, v, x)), []
    ordinary = SampleGuard.step

    def counted(guard, controller, *arguments):
        asked.append(controller)
        return ordinary(guard, controller, *arguments)

    monkeypatch.setattr(SampleGuard, "step", counted)
    for k in range(20):
        there = q + 1e-3 * k * v
        now = aj.Measurement(1e-3 * k, there, v + 1e-4 * k, plain.task.value(there), t_x)
        after, expected = plain.step(state, now, target, 1e-3)
        found, answer = ours.step(state, now, target, 1e-3)
        assert_same(answer, expected)
        assert_allclose(found, after, rtol=1e-12, atol=1e-12)
        state = after
    assert asked == [plain] * 20
