"""Closed loops in lanes, compared with the same runs in Python."""

import functools
import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace

import numpy as np
import pytest
from many_runs import rolled
from numpy.testing import assert_allclose, assert_array_equal
from numpy_lanes import NumpyLanes

import approxjac as aj
from approxjac.codegen.lanes import OUTCOME, Lanes
from approxjac.codegen.step import compiled
from approxjac.controllers import CartesianSpeed, HeldMeasurement
from approxjac.errors import MissingPackageError, UnknownNameError
from approxjac.law import Sine
from approxjac.robots import Dynamics
from approxjac.stability.rollouts import setting as rollout_setting

SHORT = {"runs": 12, "duration": 1.0, "dt": 2e-3}


def study(arm, axes="xyz", *, learns=False, **options):
    """A controller, its errors, and a region that starts next to the joint limits."""
    errors = aj.Uncertainty(
        aj.load_robot(arm),
        functools.partial(aj.PositionTask, axes=axes),
        object_length=(0.0, 0.2),
        object_mass=(0.0, 0.5),
        friction=0.1,
    )
    task = errors.believed_task()
    gravity = aj.AdaptiveGravity(task.robot) if learns else None
    controller = aj.SetpointController(task, gravity=gravity, **options)
    low, high = task.robot.usual_range
    half = 0.48 * (high - low)
    return controller, errors, aj.JointBox(task.robot, -half, half, 0.5 * (low + high))


def limited(loop, share, **options):
    """The loop within limits of effort that are often reached."""
    controller, errors, region = loop
    upper = share * controller.task.robot.effort_limits
    return aj.TorqueLimited(controller, aj.Limits(effort=upper), **options), errors, region


def within_urdf(loop, share, motion=(), **options):
    """The loop within all limits of the URDF, and of motion."""
    controller, errors, region = loop
    limits = replace(aj.Limits.of(controller.task.robot, scale=share), **options)
    dt = SHORT["dt"]
    return aj.TorqueLimited(controller, [limits, *motion], dt=dt), errors, region


STUDIES = {
    "limits of the URDF": lambda: within_urdf(study("panda"), 0.5),
    "limits of the URDF, and learnt gravity": lambda: within_urdf(study("panda", learns=True), 0.5),
    "limits with a rate, accelerations and a speed": lambda: within_urdf(
        study("ur5"), 0.5, [CartesianSpeed(0.3)], rate=3000.0, acceleration=50.0
    ),
    "limits that keep the proof": lambda: limited(study("panda", learns=True), 0.4),
    "limits, known gravity": lambda: limited(study("ur5"), 0.3),
    "limits that clip": lambda: limited(study("panda"), 0.4, proof=False),
    "known gravity": lambda: study("panda"),
    "learnt gravity": lambda: study("panda", learns=True),
    "a plane, sine": lambda: study("ur5", "xz", learns=True, saturation=Sine(0.1)),
    "given gains": lambda: study("ur5", gains=aj.Gains(100.0, 20.0, 1.0)),
}


SOME = ("a plane, sine",)
# learnt gravity within limits: "a circle, (5), limits" of test_sensing.py, with fewer limits
# and limits of the URDF those with a rate; known gravity: "given gains"; gravity that is learnt:
# the same bits in NumPy; limits that keep the proof: "a circle, (5), limits" of test_sensing.py
IN_OTHERS = (
    "limits of the URDF, and learnt gravity", "limits of the URDF", "known gravity",
    "limits, known gravity", "learnt gravity", "limits that keep the proof",
)  # fmt: skip
MARKS = dict.fromkeys(IN_OTHERS, pytest.mark.long)


def require_agreement(ours, python, tolerance=1e-9):
    """Equal but for rounding."""
    for name, expected in python.columns.items():
        found = ours.columns[name]
        if found.dtype == bool:
            assert_array_equal(found, expected, err_msg=name)
        else:
            assert_allclose(found, expected, rtol=tolerance, atol=tolerance, err_msg=name)


@pytest.mark.parametrize(
    "name",
    [
        each if each in SOME else pytest.param(each, marks=MARKS.get(each, pytest.mark.study))
        for each in STUDIES
    ],
)
def test_runs_are_those_of_python(name):
    """Also at joint stops, near singular configurations, and outside of the region."""
    loop, short = STUDIES[name](), SHORT | {"runs": 9}  # a vector, and a part of one
    ours = rolled(*loop, **short)
    assert (ours.setting.engine, ours.setting.reason) == ("lanes", "")
    python = rolled(*loop, engine="python", **short)
    assert python.setting.engine == "python"
    # motors that come to their limits and leave them let round-off grow, and so does the distance
    # between DAQP's and the interior minimum
    solves = name.startswith(("limits of the URDF", "limits with"))
    require_agreement(ours, python, 1e-5 if solves else 1e-8 if name.startswith("limits") else 1e-9)
    assert not ours.columns["stayed"].all()
    if name.startswith("limits"):
        assert ours.columns["peak_torque"].max() <= 0.5
    run = ours.replay(5)
    assert run.error_norm[-1] == pytest.approx(ours.runs[5].final_error, abs=1e-9)
    assert run.t[-1] == 1.0


def starts_of(loop, n):
    controller, errors, region = loop
    whole = rollout_setting.RolloutSetting(controller, errors, region, None, 1.0, 1e-3, 1e-3, 0)
    starts = [whole.start(index) for index in range(n)]
    return starts[0].plant, [start.lane_start(controller) for start in starts]


@pytest.mark.study  # and with sensors in another file
@pytest.mark.parametrize(
    "name", [pytest.param("known gravity", marks=pytest.mark.long), "learnt gravity"]
)
def test_the_same_bits_in_numpy(name):
    """The oracle; with what is rare."""
    loop = STUDIES[name]()
    region = loop[2]
    plant, starts = starts_of(loop, 16)
    lanes = Lanes(loop[0], plant, starts, region, 1e-3, 250, 1e-3)
    found = [lanes.run(starts, 10)]
    lanes.compiled = NumpyLanes(lanes.program)
    found.append(lanes.run(starts, 10))
    for name in OUTCOME:
        assert_array_equal(found[0][name], found[1][name], err_msg=name)
    assert found[0]["outside"].any()


def digest(runs):
    return b"".join(column.tobytes() for column in runs.columns.values())


@pytest.mark.long
def test_the_same_bits_whatever_carries_them_out(monkeypatch):
    """Threads, processes, portions of other sizes."""
    loop = study("ur5", learns=True)
    options = {"runs": 70, "duration": 0.2, "dt": 2e-3}
    expected = digest(rolled(*loop, **options))
    done = []
    with ThreadPoolExecutor(2) as pool:
        ours = rolled(*loop, executor=pool, progress=done.append, **options)
        assert digest(ours) == expected
    assert done[-1] == 70
    assert len(done) == 9  # portions of a vector
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert digest(rolled(*loop, executor=pool, **options)) == expected

    monkeypatch.setattr("approxjac.stability.rollouts.rollouts._PORTION", 16)
    assert digest(rolled(*loop, **options)) == expected
    for runs in (9, 1):
        few = rolled(*loop, **options | {"runs": runs})
        for name, column in few.columns.items():
            assert_array_equal(column, ours.columns[name][:runs], err_msg=name)


def test_more_runs_than_a_compiled_loop_was_made_for():
    """A loop that was compiled for one run has all its numbers as constants."""
    loop, options = study("ur5"), {"duration": 0.1, "dt": 2e-3, "seed": 7}
    one = rolled(*loop, runs=1, **options)
    many = rolled(*loop, runs=3, **options)
    assert_array_equal(many.columns["final_error"][:1], one.columns["final_error"])
    require_agreement(many, rolled(*loop, runs=3, engine="python", **options))


def test_divergence():
    loop = study("panda", gains=aj.Gains(1e8, 1e6, 1.0))
    ours, python = (rolled(*loop, engine=engine, **SHORT) for engine in ("lanes", "python"))
    assert ours.n_diverged == python.n_diverged == 12
    require_agreement(ours, python)


@pytest.mark.study
def test_what_lanes_leave_is_run_in_python(monkeypatch):
    """As if the sweeps had not ended."""
    loop = study("panda", learns=True)
    run = Lanes.run

    def leaving(lanes, starts, *options):
        told = run(lanes, starts, *options)
        told["left"][3] = 1.0
        told["error"][3] = 99.0
        return told

    monkeypatch.setattr(Lanes, "run", leaving)
    require_agreement(rolled(*loop, **SHORT), rolled(*loop, engine="python", **SHORT))


def test_columns_and_runs():
    many = aj.Study(*study("ur5"), duration=0.2, latency=aj.Latency(period=0.002)).rollouts(5)
    assert all(len(column) == 5 for column in many.columns.values())
    assert many.columns["q0"][3, 1] == many.runs[3].q0[1]
    assert many.runs[2].index == 2
    with pytest.raises(
        aj.InvalidInputError, match=r"index must be one of the 5 runs, 0 to 4, got 5"
    ):
        many.replay(5)


def test_what_is_not_covered_runs_in_python_and_says_so(panda):
    controller, errors, region = study("panda")

    class Branching(Sine):
        def s(self, e):
            return super().s(e) if np.abs(e).max() > 0.01 else e

    own = aj.SetpointController(controller.task, controller.gains, saturation=Branching(0.1))
    many = aj.Study(own, errors, region, duration=0.01).rollouts(1)
    assert many.setting.engine == "python"
    assert many.setting.reason.startswith("controller must take symbols to make code of it")
    assert many.setting.reason.endswith("which runs in Python")
    with pytest.raises(aj.InvalidInputError, match="controller must take symbols to make code"):
        aj.Study(own, errors, region, duration=0.01).rollouts(
            1, execution=aj.stability.Execution(engine="lanes")
        )
    with pytest.raises(UnknownNameError, match="engine"):
        aj.Study(controller, errors, region).rollouts(
            execution=aj.stability.Execution(engine="cuda")
        )


def test_what_a_derived_uncertainty_does_is_not_taken_for_what_ours_does(panda):
    class Sticky(aj.Uncertainty):
        def plant(self, values):
            plant = super().plant(values)
            return aj.Plant(plant.robot, plant.sensor, 5.0 * values[0])

    controller, _, region = study("panda")
    own = Sticky(panda, object_length=(0.0, 0.2), object_mass=(0.0, 0.5))
    many = aj.Study(controller, own, region, duration=0.01).rollouts(1)
    assert many.setting.engine == "python"
    text = "uncertainty must be one whose plant and robot are those of Uncert"
    assert many.setting.reason.startswith(text)


@pytest.mark.study
def test_what_is_ones_own_runs_in_lanes_as_in_python(panda):
    class Faint(HeldMeasurement):
        def advance(self, *arguments):
            state, answer = super().advance(*arguments)
            return state, answer._replace(torque=0.9 * answer.torque)

    class Weak(aj.TorqueLimited):
        def advance(self, *arguments):
            state, answer = super().advance(*arguments)
            return state, answer._replace(torque=0.5 * answer.torque)

    class Along(aj.PositionTask):
        def jacobian(self, q, x=None):
            return super().jacobian(q) * (1.0 + 0.1 * np.sin(q[0]))

        def on(self, robot):
            return Along(robot, self.frame, self.axes)

    class Springs(aj.Controller):
        def advance(self, state, measurement, target, dt):
            t, q, v, x, _ = measurement
            e = self.task.error(x, target)
            torque = -np.dot(50.0 * np.tanh(e) + 0.1 * t, self.task.jacobian(q)) - 5.0 * v
            return state, aj.Evaluation(torque + Dynamics(panda).g(q), None, aj.Status.OK, e)

    controller, errors, region = study("panda")
    options = {"runs": 4, "duration": 0.2, "dt": 2e-3}
    for own in (
        Faint(controller, 0.1),
        Weak(controller, aj.Limits(effort=panda.effort_limits)),
        aj.SetpointController(Along(controller.task.robot)),
        Springs(controller.task),
    ):
        ours = rolled(own, errors, region, engine="lanes", **options)
        python = rolled(own, errors, region, engine="python", **options)
        for column in ("final_error", "peak_torque", "peak_speed"):
            found, expected = ours.columns[column], python.columns[column]
            np.testing.assert_allclose(found, expected, rtol=1e-10, atol=1e-12, err_msg=column)


@pytest.mark.study
def test_a_compiled_law_runs_in_lanes_as_the_one_that_it_was_made_from():
    for loop in (study("ur5"), limited(study("ur5"), 0.3)):
        options = {"runs": 3, "duration": 0.1, "dt": 2e-3}
        ours = rolled(compiled(loop[0]), *loop[1:], **options)
        assert ours.setting.engine == "lanes"
        assert digest(ours) == digest(rolled(*loop, **options))


def test_without_llvmlite(monkeypatch):
    loop = study("ur5")
    monkeypatch.setattr("importlib.util.find_spec", lambda name: None)
    found = aj.Study(*loop, duration=0.01).rollouts(1)
    assert found.setting.reason == "llvmlite is not installed"
    told = " ".join(str(found).split())
    assert told.endswith("engine in Python as llvmlite is not installed")

    with pytest.warns(UserWarning, match=r"20000 runs .* 10 min .*approxjac\[fast\]"):
        rollout_setting.with_engine([aj.Study(*loop, duration=0.5).setting()], None, 20_000)

    def missing(extra, name):
        raise MissingPackageError("no", given=name)

    monkeypatch.setattr(rollout_setting, "package_of", missing)
    with pytest.raises(MissingPackageError):
        aj.Study(*loop, duration=0.01).rollouts(1, execution=aj.stability.Execution(engine="lanes"))


REGIONS = {
    "regular part": lambda loop: aj.stability.RegularPart(loop[2], loop[0].task, 0.12),
    "regular part, joints left over": lambda loop: aj.stability.RegularPart(
        loop[2], aj.PoseTask(loop[0].task.robot), 0.05
    ),
}


@pytest.mark.study
@pytest.mark.parametrize("name", REGIONS)
def test_regular_parts_of_a_box(name):
    """Left by some runs, as Python says."""
    loop = study("ur5")
    region = REGIONS[name](loop)
    ours, python = (
        rolled(*loop[:2], region, engine=engine, **SHORT) for engine in (None, "python")
    )
    assert ours.setting.engine == "lanes"
    require_agreement(ours, python)
    assert 0 < ours.columns["stayed"].sum() < 12
    plain = rolled(*loop, **SHORT)
    assert ours.n_left != plain.n_left


@pytest.mark.study
def test_a_region_that_is_regular_where_the_task_is():
    """What is rare in the step is needed again where it is recorded, beyond that block."""
    arm = aj.load_robot("ur5")
    bent = functools.partial(_nonsingular, bend={arm.joint_names[2]: 0.3})
    errors = aj.Uncertainty(arm, bent, object_length=(0.0, 0.2), object_axis="z")
    task = errors.believed_task()
    loop = aj.SetpointController(task), errors
    box = aj.JointBox.around(arm, [0.0, -1.0, 1.0, 0.5, 0.5, 0.0], 1.0)
    part, options = (
        aj.stability.RegularPart(box, task, 0.2),
        {"runs": 10, "duration": 0.1, "dt": 2e-3},
    )
    ours = rolled(*loop, part, engine="lanes", **options)
    require_agreement(ours, rolled(*loop, part, engine="python", **options))


def _nonsingular(robot, bend):
    return aj.tasks.NonsingularTask(aj.PositionTask(robot), bend, 0.3)


def test_a_box_of_two_continuous_joints_is_left_as_in_python():
    turning = aj.load_robot("two_link").urdf.replace('"revolute"', '"continuous"')
    plane = functools.partial(aj.PositionTask, axes="xz")
    errors = aj.Uncertainty(aj.Robot(turning), plane, object_length=(0.0, 0.2))
    region = aj.JointBox.around(errors.belief(), errors.belief().configuration((2.2, 1.1)), 0.5)
    falls = aj.controllers.NoGravity(errors.belief())
    loop = aj.SetpointController(errors.believed_task(), gravity=falls), errors, region
    short = {"runs": 9, "duration": 0.6, "dt": 1e-2}
    ours, python = (rolled(*loop, engine=engine, **short) for engine in ("lanes", "python"))
    require_agreement(ours, python)
    assert 0 < ours.n_left < 9


@pytest.mark.study
def test_boxes_of_continuous_joints():
    errors = aj.Uncertainty(aj.load_robot("kinova"), object_length=(0.0, 0.2))
    robot = errors.belief()
    assert robot.nq > robot.nv
    start = robot.random_configuration(np.random.default_rng(1))
    loop = aj.SetpointController(errors.believed_task()), errors
    stayed = []
    for radius in (0.5, 4.0):  # which is all around
        region = aj.JointBox.around(robot, start, radius)
        ours, python = (
            rolled(*loop, region, engine=engine, **SHORT) for engine in (None, "python")
        )
        assert ours.setting.engine == "lanes"
        require_agreement(ours, python)
        stayed.append(ours.columns["stayed"].sum())
    assert 0 < stayed[0] < stayed[1]
