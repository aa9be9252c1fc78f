"""Real sensors, late motors and moving targets in lanes, compared with the same runs in Python."""

import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
import test_lanes
import test_task_loops
from many_runs import rolled
from numpy.testing import assert_allclose, assert_array_equal
from numpy_lanes import NumpyLanes

import approxjac as aj
from approxjac.codegen import compiled
from approxjac.codegen.backends.llvm import LlvmLanes
from approxjac.codegen.lanes import OUTCOME, Lanes
from approxjac.codegen.loop_program import TracedLoop
from approxjac.codegen.trace.program import Program
from approxjac.controllers import DifferentiatedVelocity
from approxjac.simulation import Sensing, VelocityServo
from approxjac.stability.rollouts import setting as rollout_setting

SHORT = {"runs": 5, "duration": 0.6, "dt": 2e-3, "accuracy": 0.3}
ROUGH = {
    "q_noise": 1e-4, "q_quantum": 1e-5, "velocity_filter": 0.01, "x_rate": 60.0, "x_delay": 0.03,
    "x_dropout": 0.1, "x_lost": [(0.2, 0.25)], "x_frozen": [(0.1, 0.15)],
}  # fmt: skip
ALL = {"actuator_delay": 0.006, "sensing": Sensing(x_noise=1e-3, **ROUGH)}
PIXELS = {"actuator_delay": 0.004, "sensing": Sensing(x_noise=0.5, x_quantum=0.25, **ROUGH)}


def moves(learns=True, **options):
    return test_lanes.study("panda", learns=learns, **options)


def held(loop, unseen):
    """The loop with a law that goes on with the last x for a while."""
    controller, errors, region = loop
    return aj.HeldMeasurement(controller, unseen), errors, region


def turning():
    """An arm with joints that turn without end, somewhere."""
    errors = aj.Uncertainty(aj.load_robot("kinova"), object_length=(0.0, 0.2))
    robot = errors.belief()
    start = robot.random_configuration(np.random.default_rng(1))
    loop = aj.SetpointController(errors.believed_task()), errors
    return *loop, aj.JointBox.around(robot, start, 3.0)


class Swing:
    """A path of three points: they swing together."""

    def __init__(self, x):
        self.x = x

    def at(self, t):
        way = np.ones(len(self.x))
        return aj.Target(self.x + 20.0 * np.sin(3.0 * t) * way, 60.0 * np.cos(3.0 * t) * way)


CIRCLE = aj.Circle((0.4, 0.0, 0.4), 0.1, 1.0)
POINTS = np.array([310.0, 240.0, 300.0, 250.0, 330.0, 260.0])
STUDIES = {
    "continuous joints": (
        turning,
        ALL | {"sensing": Sensing(x_noise=1e-3, **ROUGH | {"q_quantum": 1e-3})},
    ),
    "a circle": (lambda: moves(False), {"target": CIRCLE}),
    "a circle, (5), limits": (
        lambda: test_lanes.limited(moves(velocity=DifferentiatedVelocity(0.02)), 0.4),
        ALL | {"target": CIRCLE},
    ),
    "points that swing": (
        test_task_loops.STUDIES["balanced"],
        {"sensing": Sensing(x_noise=0.5, x_rate=60.0, x_dropout=0.1), "target": Swing(POINTS)},
    ),
    "a target that only stands": (
        lambda: moves(False),
        {"target": aj.Target(np.array([0.4, 0.0, 0.4]))},
    ),
    "late torque": (moves, {"actuator_delay": 0.006}),
    "late x": (moves, {"sensing": Sensing(x_delay=0.02)}),
    "differences": (moves, {"sensing": Sensing(velocity_filter=0.0)}),
    "noise": (moves, {"sensing": Sensing(x_noise=[1e-3, 0.0, 2e-3], q_noise=1e-4)}),
    "quanta": (moves, {"sensing": Sensing(x_quantum=[1e-3, 0.0, 1e-2], q_quantum=1e-3)}),
    "frames": (moves, {"sensing": Sensing(x_rate=70.0)}),
    "dropouts": (moves, {"sensing": Sensing(x_dropout=0.3)}),
    "lost and frozen": (
        moves,
        {"sensing": Sensing(x_lost=[(0.1, 0.2, 0)], x_frozen=[(0.0, 0.05), (0.3, 0.32)])},
    ),
    "later than the run": (
        lambda: moves(False),
        {"actuator_delay": 10.0, "sensing": Sensing(x_delay=0.598)},
    ),
    "all": (moves, ALL),
    "at bounds that depend on each other": (
        lambda: test_lanes.study("panda", learns=True),
        {"actuator_delay": 10.0, "sensing": Sensing(x_delay=0.598)},
    ),
    "all, (5)": (lambda: moves(False, velocity=DifferentiatedVelocity(0.02)), ALL),
    "all, limits": (lambda: test_lanes.limited(moves(), 0.4), ALL),
    "a turned hand": (
        test_task_loops.STUDIES["pose, learnt"],
        {"sensing": Sensing(x_noise=0.01, x_quantum=0.02, x_rate=100.0, x_dropout=0.1)},
    ),
    "three points, a lens": (test_task_loops.STUDIES["three points, a lens"], PIXELS),
    "measured depth": (test_task_loops.STUDIES["measured depth"], PIXELS),
    "lost at times, (5)": (test_task_loops.STUDIES["lost at times, (5), learnt"], PIXELS),
    "image and position": (
        test_task_loops.STUDIES["image and position"],
        {"sensing": Sensing(x_noise=[1.0, 1.0, 1e-3], x_lost=[(0.1, 0.2, 1)], x_delay=0.01)},
    ),
    "held": (lambda: held(moves(False), 0.01), ALL),
    "held, (5), limits": (
        lambda: held(test_lanes.limited(moves(velocity=DifferentiatedVelocity(0.02)), 0.4), 0.02),
        ALL,
    ),
    "held pose": (
        lambda: held(test_task_loops.STUDIES["pose"](), 0.01),
        {"sensing": Sensing(x_noise=0.001, x_rate=100.0, x_dropout=0.3)},
    ),
    "held points": (
        lambda: held(test_task_loops.STUDIES["three points, a lens"](), 5.0),
        {"sensing": Sensing(x_rate=60.0, x_lost=[(0.1, 0.2, 1), (0.15, 0.3, 0)])},
    ),
    "held depths": (
        lambda: held(test_task_loops.STUDIES["measured depth"](), 5.0),
        {"sensing": Sensing(x_rate=60.0, x_delay=0.02, x_lost=[(0.1, 0.2, 0)])},
    ),
    "held, at the edge of the image": (
        lambda: held(test_task_loops.STUDIES["lost at times"](), 5.0),
        {"sensing": Sensing(x_rate=60.0)},
    ),
    "held, balanced": (
        lambda: held(test_task_loops.STUDIES["balanced"](), 1.0),
        {"sensing": Sensing(x_rate=60.0, x_lost=[(0.1, 0.2, 1), (0.15, 0.3, 0)])},
    ),
}
BY_DEFAULT = ("all, (5)",)
IN_OTHERS = (
    "late torque", "late x", "differences", "noise", "quanta", "frames", "dropouts", "a circle",
    "all, limits", "held", "held, balanced", "measured depth", "three points, a lens",
    "held depths", "held, (5), limits", "held, at the edge of the image",
)  # fmt: skip


@pytest.mark.parametrize(
    "name",
    [
        pytest.param(k, marks=pytest.mark.long if k in IN_OTHERS else pytest.mark.study)
        if k not in BY_DEFAULT
        else k
        for k in STUDIES
    ],
)
def test_runs_are_those_of_python(name):
    loop, options = STUDIES[name]
    ours = rolled(*loop(), engine="lanes", **options, **SHORT)
    python = rolled(*loop(), engine="python", **options, **SHORT)
    test_lanes.require_agreement(ours, python)
    ideal = rolled(*loop(), engine="lanes", **SHORT)
    assert (ours.columns["final_error"] != ideal.columns["final_error"]).all()


def test_each_run_has_noise_of_its_own():
    errors = aj.Uncertainty(aj.load_robot("two_link"))  # none, so that all runs are alike
    task = errors.believed_task()
    loop = aj.SetpointController(task), errors, aj.JointBox.around(task.robot, [0.5, 1.2], 0.0)
    target = task.value(np.array([0.6, 1.0]))
    many = rolled(*loop, target=target, sensing=Sensing(x_noise=0.001), **SHORT)
    assert many.setting.engine == "lanes"
    assert len({*many.columns["final_error"]}) == SHORT["runs"]
    run = many.replay(3)
    assert run.error_norm[-1] == pytest.approx(many.runs[3].final_error, abs=1e-12)
    assert (run.x_measured - run.x).std() == pytest.approx(1e-3, rel=0.1)


@pytest.mark.study
def test_the_same_bits_in_numpy():
    """And on vectors of any width."""
    controller, errors, region = test_lanes.study("two_link", "xz")
    whole = rollout_setting.RolloutSetting(
        controller, errors, region, None, 0.3, 1e-3, 1e-3, 0, ALL["sensing"], 0.006
    )
    starts = [whole.start(index) for index in range(9)]
    begun = [each.lane_start(controller) for each in starts]
    engines = (NumpyLanes, LlvmLanes, lambda p: LlvmLanes(p, 2, "+sse2"))
    lanes, found = Lanes(controller, starts[0].plant, begun, region, 1e-3, 300, 0.3), []
    for engine in engines:
        lanes.compiled = engine(lanes.program)
        found.append(lanes.run(begun, 10))
    expected, *found = found
    for name in OUTCOME:
        for each in found:
            assert_array_equal(each[name], expected[name], err_msg=name)
    assert np.isfinite(expected["error"]).all()


MANY = test_lanes.study("two_link", "xz"), {"runs": 70, "duration": 0.2, "dt": 2e-3} | ALL


@pytest.mark.study
def test_the_same_bits_in_processes():
    loop, options = MANY
    expected = test_lanes.digest(rolled(*loop, **options))
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert test_lanes.digest(rolled(*loop, executor=pool, **options)) == expected


def test_the_same_bits_whatever_carries_them_out(monkeypatch):
    """Threads, portions and blocks of other sizes."""
    loop, options = MANY
    expected = test_lanes.digest(rolled(*loop, **options))
    with ThreadPoolExecutor(2) as pool:
        assert test_lanes.digest(rolled(*loop, executor=pool, **options)) == expected

    monkeypatch.setattr("approxjac.stability.rollouts.rollouts._PORTION", 16)
    monkeypatch.setattr("approxjac.codegen.lanes._BLOCK", 7)
    assert test_lanes.digest(rolled(*loop, **options)) == expected


@pytest.mark.study
def test_a_compiled_law_runs_in_python_with_real_sensors(two_link):
    controller = aj.SetpointController(aj.PositionTask(two_link))
    plant = aj.Plant(two_link, controller.task, sensing=Sensing(x_noise=1e-3), actuator_delay=2e-3)
    target, options = controller.task.value(np.array([0.6, 1.0])), {"duration": 2.0, "seed": 3}
    quick, plain = (
        aj.simulate(plant, law, target, [0.5, 1.2], **options)
        for law in (compiled(controller), controller)
    )
    assert_allclose(quick.x_measured, plain.x_measured, rtol=0, atol=1e-9)
    assert (quick.x_measured != quick.x).any()


def test_a_run_on_a_path_again():
    many = rolled(*test_lanes.study("panda"), target=CIRCLE, **SHORT)
    assert many.setting.engine == "lanes"
    assert_array_equal(many.columns["target"], np.tile(CIRCLE.at(0.0).x, (SHORT["runs"], 1)))
    run = many.replay(2)
    assert_allclose(run.x_d[-1], CIRCLE.at(SHORT["duration"]).x, atol=1e-12)
    assert run.error_norm[-1] == pytest.approx(many.runs[2].final_error, abs=1e-9)


def test_what_is_refused(two_link):
    controller = aj.SetpointController(aj.PositionTask(two_link))
    for options in ({"servo": VelocityServo()}, {"adds_gravity": two_link}):
        plant = aj.Plant(two_link, controller.task, **options)
        with pytest.raises(aj.InvalidInputError, match="without a servo and adds_gravity"):
            TracedLoop(Program(), controller, plant, None, None, 1e-3, "rk4")
    loop = test_lanes.study("ur5")
    with pytest.raises(aj.InvalidInputError, match="x_noise"):
        aj.Study(*loop, sensing=Sensing(x_noise=[1.0, 2.0])).rollouts(1)
    with pytest.raises(aj.InvalidInputError, match="torque_delay"):
        aj.Study(*loop, latency=aj.Latency(torque_delay=-1.0)).rollouts(1)
