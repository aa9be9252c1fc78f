"""Rollouts over starts and errors."""

import dataclasses
import functools
import math
import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from many_runs import rolled, study
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.formatting import percent
from approxjac.robots import GravityRegressor
from approxjac.stability.errors.region import Region
from approxjac.stability.rollouts.rollouts import Execution, carried_out, clopper_pearson
from approxjac.stability.rollouts.setting import COLUMNS, RolloutSetting
from approxjac.tasks.analysis import fine_error

PLANE = functools.partial(aj.PositionTask, axes="xz")
SHORT = {"runs": 5, "duration": 0.8, "dt": 4e-3, "accuracy": 0.02}


@dataclasses.dataclass(frozen=True)
class Box(Region):
    """Joint positions between two bounds; `margin` is how far beyond them a run may go."""

    low: tuple
    high: tuple
    margin: float = 10.0

    def sample(self, n, rng):
        return rng.uniform(self.low, self.high, (n, len(self.low)))

    def contains(self, q):
        return bool((q >= np.array(self.low) - self.margin).all())


REGION = Box((0.3, 0.8), (0.8, 1.4))


@pytest.fixture(scope="module")
def uncertainty():
    arm = aj.load_robot("two_link")
    shifts = {"joint2": (0.1, 0.0, 0.0)}
    return aj.Uncertainty(
        arm, PLANE, object_length=(0.0, 0.4), object_axis="x", joint_shifts=shifts, friction=0.2
    )


@pytest.fixture(scope="module")
def controller(uncertainty):
    return aj.SetpointController(uncertainty.believed_task())


@pytest.fixture(scope="module")
def serial(controller, uncertainty):
    return rolled(controller, uncertainty, REGION, **SHORT)


def require_same(ours, theirs):
    for name, column in theirs.columns.items():
        assert_array_equal(ours.columns[name], column, err_msg=name)


def test_runs_are_what_a_simulation_by_hand_is(controller, uncertainty, serial):
    run = serial.runs[4]
    rng = np.random.default_rng([0, 4])
    values = uncertainty.sample(rng)
    plant = uncertainty.plant(values)
    q0 = REGION.sample(1, rng)[0]
    target = plant.sensor.value(REGION.sample(1, rng)[0])
    record = aj.simulate(
        plant,
        controller,
        target,
        q0,
        0.8,
        dt=4e-3,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )
    assert_array_equal(run.values, values)
    assert_array_equal(run.q0, q0)
    assert_array_equal(run.target, target)
    assert run.index == 4
    assert run.final_error == record.error_norm[-1]
    assert run.converged == (record.error_norm[record.t >= 0.72 - 1e-9] < 0.02).all()
    assert run.stayed
    assert not run.diverged


def test_joints_as_they_are_roll_as_by_hand_and_get_no_certificate():
    """Springs, rotors and dry friction of the truth, in lanes, too."""
    arm = aj.load_robot("two_link")
    region = aj.JointBox(arm, REGION.low, REGION.high)
    errors = aj.Uncertainty(
        arm, PLANE, object_length=(0.0, 0.2), friction=aj.robots.Friction(0.2, coulomb=0.1),
        drives=aj.robots.Drives(rotor_inertia=0.05, stiffness=500.0),
    )  # fmt: skip
    ideal = aj.Uncertainty(arm, PLANE, object_length=(0.0, 0.2), friction=0.2)
    task, late = errors.believed_task(), aj.Latency(4e-3)
    law = aj.SetpointController(task, latency=late, drives=errors.drives)
    here, lanes = (
        rolled(law, errors, region, engine=engine, **SHORT) for engine in ("python", "lanes")
    )
    ends = here.columns["final_error"]
    assert_allclose(lanes.columns["final_error"], ends, rtol=1e-9)
    differ = ends - rolled(law, ideal, region, **SHORT).columns["final_error"]
    assert (np.abs(differ) > 1e-4).all()
    one = here.runs[1]
    by_hand = aj.simulate(
        errors.plant(one.values), law, one.target, one.q0, 0.8, dt=4e-3,
        computation=aj.simulation.Computation("semi_implicit_euler"),
    )  # fmt: skip
    assert np.abs(by_hand.twist).max() > 1e-3
    assert one.final_error == by_hand.error_norm[-1]
    with pytest.raises(aj.InvalidInputError, match="without dry friction, drives"):
        aj.local_stability(errors.plant(one.values), law, one.q0)
    stiff = aj.SetpointController(task, aj.Gains(400.0, 60.0, 5.0))
    assert rolled(stiff, errors, region, **SHORT).columns["diverged"].all()


@pytest.mark.long
def test_threads_and_processes_give_the_same(controller, uncertainty, serial):
    with ThreadPoolExecutor(3) as pool:
        require_same(rolled(controller, uncertainty, REGION, executor=pool, **SHORT), serial)
    spawn = multiprocessing.get_context("spawn")
    with ProcessPoolExecutor(2, mp_context=spawn) as pool:
        done = []
        many = rolled(controller, uncertainty, REGION, executor=pool, progress=done.append, **SHORT)
        require_same(many, serial)
        assert done == list(range(1, 6))  # portions of one run
        with pytest.raises(aj.InvalidInputError, match=r"duration must be a whole number of dt"):
            aj.Study(
                controller, uncertainty, REGION, duration=1.0, latency=aj.Latency(period=0.3)
            ).rollouts(2, execution=aj.stability.Execution(executor=pool))
        by_lambda = aj.Uncertainty(uncertainty.arm, lambda robot: PLANE(robot))
        with pytest.raises(aj.InvalidInputError, match=r"must be picklable .* a lambda is not\)"):
            rolled(controller, by_lambda, REGION, executor=pool, **SHORT)
    with ThreadPoolExecutor(1) as pool:
        threads = rolled(controller, by_lambda, REGION, executor=pool, **SHORT)
    require_same(threads, rolled(controller, by_lambda, REGION, **SHORT))


def test_learnt_gravity_in_threads(uncertainty):
    task = uncertainty.believed_task()
    learning = aj.SetpointController(task, gravity=aj.AdaptiveGravity(GravityRegressor(task.robot)))
    serial = rolled(learning, uncertainty, REGION, **SHORT)
    with ThreadPoolExecutor(2) as pool:
        require_same(rolled(learning, uncertainty, REGION, executor=pool, **SHORT), serial)


def test_more_runs_begin_with_the_same_ones(controller, uncertainty, serial):
    few = rolled(controller, uncertainty, REGION, **SHORT | {"runs": 3})
    for name, column in few.columns.items():
        assert_array_equal(column, serial.columns[name][:3], err_msg=name)
    other = rolled(controller, uncertainty, REGION, **SHORT | {"runs": 3}, seed=1)
    assert (other.runs[0].q0 != few.runs[0].q0).all()


@pytest.mark.study
def test_portions_hold_every_run_once(controller, uncertainty):
    done = []
    with ThreadPoolExecutor(2) as pool:
        many = rolled(
            controller, uncertainty, REGION, runs=66, duration=0.01, progress=done.append,
            executor=pool,
        )  # fmt: skip
    assert [run.index for run in many.runs] == list(range(66))
    assert len(done) == 33  # portions of two
    assert done[-1] == 66


def test_a_given_target_is_that_of_all(controller, uncertainty):
    target = uncertainty.believed_task().value(np.array([0.5, 1.0]))
    many = rolled(controller, uncertainty, REGION, target=target.tolist(), **SHORT | {"runs": 2})
    for run in many.runs:
        assert_array_equal(run.target, target)


def test_what_became_of_them(controller, uncertainty, serial):
    low, high = serial.interval
    assert 0.0 <= low < serial.share < high <= 1.0 or serial.share in (0.0, 1.0)
    assert serial.n == 5
    assert serial.share == serial.n_converged / 5
    assert serial.worst.final_error == max(run.final_error for run in serial.runs)
    assert str(serial).startswith(f"converged: {serial.n_converged} of 5 runs\n")
    assert "within 0.02 m throughout the last tenth" in str(serial)
    text = " ".join(str(serial).split())
    assert f"run {serial.worst.index} ended" in text
    assert f"with {uncertainty.describe(serial.worst.values)}" in text
    narrow = dataclasses.replace(REGION, margin=-0.1)
    left = rolled(controller, uncertainty, narrow, **SHORT)
    assert left.n_left == sum(not run.stayed for run in left.runs) > 0
    assert [run.final_error for run in left.runs] == [run.final_error for run in serial.runs]


@pytest.mark.parametrize("size", [0.5, math.inf])
def test_the_worst_run_is_the_one_that_ends_farthest_off(serial, size):
    for k in range(5):
        error = np.where(np.arange(5) == k, size, 0.01 * np.arange(5))
        columns = serial.columns | {"final_error": error, "diverged": np.isinf(error)}
        found = dataclasses.replace(serial, columns=columns)
        row = next(row for row in found.rows if row.name == "worst")
        assert (found.worst.index, row.verdict) == (k, f"run {k}")
        assert row.figures["error"] == size
        assert row.figures["diverged"] == math.isinf(size)
        values = serial.columns["values"][k]
        assert row.figures["values"] == serial.setting.uncertainty.describe(values)


def test_torques_that_no_motor_has_are_told(serial):
    def told(*peaks):
        columns = serial.columns | {"peak_torque": np.array(peaks), "diverged": np.isnan(peaks)}
        found = dataclasses.replace(serial, columns=columns)
        return str(found), [row for row in found.rows if row.name == "torques"]

    text, (row,) = told(0.5, math.nan, 1.0, 1.2, 7.41)
    assert "torques at least 2 of 5 beyond motors" in " ".join(text.split())
    assert row.verdict == "at least 2 of 5"
    assert dict(row.figures) == {"beyond": 2, "most": 7.41, "unknown": 1}
    _, (row,) = told(0.5, 0.7, 1.0, 1.2, 7.41)  # none diverged
    assert row.verdict == "2 of 5"
    text, rows = told(0.5, math.nan, 1.0, 1.0 + 1e-9, 0.0)  # as of TorqueLimited
    assert "motors" not in text
    assert not rows


def test_divergence_counts_as_not_converged(uncertainty):
    task = uncertainty.believed_task()
    wild = aj.SetpointController(task, aj.Gains(1e8, 1e6))  # far too stiff for dt
    many = rolled(wild, uncertainty, REGION, **SHORT | {"runs": 3})
    assert many.n_diverged == 3
    assert many.n_converged == many.n_left == 0
    assert many.worst is many.runs[0]
    assert many.worst.final_error == math.inf
    assert math.isnan(many.worst.settling_time)
    assert not many.worst.stayed
    assert "converged: 0 of 3 runs" in str(many)
    text = " ".join(str(many).split())
    assert "diverged 3 of 3 left the region 0 of 3 without diverging worst run 0 diverged, " in text


@pytest.mark.parametrize(
    ("error", "settling", "converged"),
    [
        ([0.1] * 21, 0.0, True),
        ([2.0] * 21, math.nan, False),
        ([2.0] * 18 + [0.1] * 3, 18.0, True),  # the last tenth begins at 18
        ([2.0] * 19 + [0.1] * 2, 19.0, False),
        ([0.1] * 20 + [2.0], math.nan, False),
        ([0.1] * 20 + [1.0], math.nan, False),  # at the tolerance is not below it
        ([0.1] * 5 + [2.0] + [0.1] * 15, 6.0, True),
    ],
)
def test_the_last_tenth_decides(error, settling, converged, controller, uncertainty, monkeypatch):
    setting = study(controller, uncertainty, REGION, dt=1.0, duration=20.0, accuracy=1.0).setting()
    still = np.zeros((21, uncertainty.arm.nv))
    run = SimpleNamespace(error_norm=np.array(error), tau=still, v=still, q=still)
    monkeypatch.setattr(RolloutSetting, "simulated", lambda self, start: run)
    judged = setting.columns(range(1))
    assert_array_equal([*judged["settling_time"], *judged["converged"]], (settling, converged))


def test_a_pose(panda):
    """Any task that a function makes."""
    uncertainty = aj.Uncertainty(panda, aj.PoseTask, object_length=(0.0, 0.1))
    controller = aj.SetpointController(uncertainty.believed_task())
    home = np.array([0.0, -0.3, 0.0, -2.0, 0.0, 1.8, 0.5])
    region = Box(tuple(home - 0.1), tuple(home + 0.1))
    many = aj.Study(controller, uncertainty, region, duration=0.2).rollouts(2)
    assert many.runs[0].target.shape == (7,)
    assert "m or rad off" in str(many)


# -- the interval -----------------------------------------------------------------------


def test_by_default_they_converge_to_what_the_unit_and_the_noise_allow(controller, uncertainty):
    assert fine_error(("px", "px")) == 0.5
    assert aj.Study(controller, uncertainty, REGION).setting().accuracy == 1e-3
    noisy = aj.Sensing(x_noise=2e-3)
    assert aj.Study(controller, uncertainty, REGION, sensing=noisy).setting().accuracy == 6e-3


@pytest.mark.parametrize("dt", [1e-3, 3e-3, 7e-3])
def test_by_default_they_last_some_ten_seconds_in_whole_periods(controller, uncertainty, dt):
    setting = study(controller, uncertainty, REGION, dt=dt).setting()
    assert setting.steps * dt == pytest.approx(setting.duration, rel=1e-12)
    assert setting.duration == pytest.approx(10.0, abs=dt)


def test_known_intervals():
    """Of none in ten the upper end is 1 − (α/2)^(1/10)."""
    end = 1.0 - 0.025**0.1
    assert clopper_pearson(0, 10) == pytest.approx((0.0, end), abs=1e-14)
    assert clopper_pearson(10, 10) == pytest.approx((1.0 - end, 1.0), abs=1e-14)
    assert end == pytest.approx(0.3085, abs=1e-4)
    assert clopper_pearson(5, 10) == pytest.approx((0.1871, 0.8129), abs=1e-4)


@settings(max_examples=20)
@given(runs=st.integers(1, 2000), share=st.floats(0.0, 1.0), confidence=st.floats(0.01, 0.999))
def test_the_interval_is_that_of_scipy(runs, share, confidence):
    from scipy.stats import binomtest

    successes = round(share * runs)
    expected = binomtest(successes, runs).proportion_ci(confidence, method="exact")
    low, high = clopper_pearson(successes, runs, confidence)
    assert (low, high) == pytest.approx((expected.low, expected.high), rel=1e-9, abs=1e-12)
    assert low <= successes / runs <= high


# -- what is refused --------------------------------------------------------------------


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"runs": 0}, "n must be an integer >= 1, got 0"),
        ({"runs": 2.0}, "n must be an integer >= 1, got 2.0"),
        ({"seed": -1}, "seed must be an integer >= 0, got -1"),
        ({"dt": 0.0}, "period must be a finite number > 0"),
        ({"duration": 1e-4}, "duration must be a finite number >= 0.001"),
        ({"duration": 0.01, "dt": 0.003}, r"duration must be a whole number of dt = 0.003"),
        ({"accuracy": -1.0}, "accuracy must be a finite number > 0, got -1"),
        ({"target": (0.1, 0.2, 0.3)}, r"target must have shape \(2,\) \[m\]"),
        ({"executor": 2}, "executor must be an executor of concurrent.futures or None, got 2"),
    ],
)
def test_refused_numbers(controller, uncertainty, options, text):
    with pytest.raises(aj.InvalidInputError, match=text):
        rolled(controller, uncertainty, REGION, **options)


def test_refused_parts(controller, uncertainty, panda):
    with pytest.raises(aj.InvalidInputError, match="region must be a Region, such as JointBox"):
        aj.Study(controller, uncertainty, Box)
    with pytest.raises(aj.InvalidInputError, match="progress must be a function of what is done"):
        aj.Study(controller, uncertainty, REGION).rollouts(progress=2)
    for wrong in (aj.SetpointController, uncertainty):
        with pytest.raises(aj.InvalidInputError, match="controller must be a controller, such as"):
            aj.Study(wrong, uncertainty, REGION).rollouts()
    with pytest.raises(aj.InvalidInputError, match="uncertainty must be an Uncertainty, got"):
        aj.Study(controller, panda, REGION).rollouts()
    other = aj.SetpointController(aj.PositionTask(panda))
    with pytest.raises(aj.InvalidInputError, match="robot must have the 2 joints of the plant's"):
        aj.Study(other, uncertainty, REGION).rollouts()
    other = aj.SetpointController(aj.PositionTask(uncertainty.belief(), axes="x"))
    with pytest.raises(aj.InvalidInputError, match="task must have the coordinates of the plant's"):
        aj.Study(other, uncertainty, REGION).rollouts()
    with pytest.raises(aj.InvalidInputError, match=r"q0 must have shape \(2,\)"):
        aj.Study(controller, uncertainty, Box((0.0,) * 3, (1.0,) * 3), target=(1.0, 0.0)).rollouts()


def test_a_region_is_what_has_its_methods():
    assert isinstance(REGION, Region)


# -- until so many do not converge --------------------------------------------------------------


@pytest.mark.study
def test_it_ends_with_a_failure(controller, uncertainty):
    """As if the runs after it had not been asked for."""
    options = SHORT | {"runs": 30, "seed": 1, "accuracy": 0.01}
    every = rolled(controller, uncertainty, REGION, **options)
    failed = np.flatnonzero(~every.columns["converged"])
    assert 2 <= len(failed) < 30
    assert failed[0] > 0
    for failures in (1, 2, 31):
        few = rolled(controller, uncertainty, REGION, failures=failures, **options)
        ends = failed[failures - 1] + 1 if failures < 31 else 30
        assert few.n == ends
        for name, column in few.columns.items():
            assert_array_equal(column, every.columns[name][:ends])


@pytest.mark.parametrize("failures", [1, 5, 8, 9, 20, 21])
def test_failures_are_counted_over_portions_with_several(failures):
    """As of lanes, which take eight runs at once."""
    passed = np.random.default_rng(0).random(40) < 0.5

    class Setting:
        engine = "lanes"

        def columns(self, indices, drawn=None):
            each = {name: np.array(indices, dtype=float) for name in COLUMNS}
            return each | {"converged": passed[list(indices)]}

    (found,) = carried_out([Setting()], 40, failures, Execution(), lambda share: None)
    ends = np.flatnonzero(~passed)[failures - 1 : failures]
    assert_array_equal(found["index"], np.arange(ends[0] + 1 if len(ends) else 40))


@pytest.mark.parametrize("failures", [1, 3])
@pytest.mark.parametrize("probability", [0.3, 0.8, 0.97, 0.999])
def test_the_interval_holds_where_failures_end_it(failures, probability):
    """Clopper and Pearson's, in at least 95 % of all outcomes, and 97.5 % to either side."""
    runs, p = 60, probability
    outcomes = [  # ends with the last failure, or with all runs
        (
            n,
            n - failures,
            math.comb(n - 1, failures - 1) * (1 - p) ** failures * p ** (n - failures),
        )
        for n in range(failures, runs + 1)
    ] + [
        (runs, runs - k, math.comb(runs, k) * (1 - p) ** k * p ** (runs - k))
        for k in range(failures)
    ]
    assert sum(chance for *_, chance in outcomes) == pytest.approx(1.0)
    ends = [(*clopper_pearson(good, n), chance) for n, good, chance in outcomes]
    assert sum(chance for low, _, chance in ends if low > p) <= 0.025
    assert sum(chance for _, high, chance in ends if high < p) <= 0.025


def test_a_bar(controller, uncertainty, capsys):
    study(controller, uncertainty, REGION, duration=0.4, dt=4e-3).rollouts(5, progress=True)
    assert "rollouts: 100 %" in capsys.readouterr().err


def test_a_share_that_is_not_all_is_not_shown_as_all():
    assert [percent(each) for each in (0.0, 1e-9, 0.5, 0.99995, 1.0)] == [
        "0.0", "0.1", "50.0", "99.9", "100.0",
    ]  # fmt: skip


def test_the_last_instant_counts_beside_every_second_one(controller, uncertainty):
    """Of 803 steps every second one is kept, and the last."""
    box = aj.JointBox.around(controller.task.robot, (0.6, 1.1), 0.2)
    found = rolled(controller, uncertainty, box, runs=2, duration=0.803, dt=1e-3, engine="lanes")
    run = found.replay(1)
    assert run.t[-1] == pytest.approx(0.803)
    assert found.runs[1].final_error == pytest.approx(run.error_norm[-1], rel=1e-9)


def test_points_of_a_map_share_their_starts(controller, uncertainty, monkeypatch):
    """Each has the runs of a study of its own, also beyond what is kept at once."""
    monkeypatch.setattr("approxjac.stability.rollouts.rollouts._SHARED", 4)
    of = aj.Study(controller, uncertainty, duration=0.3, seed=3)
    (_, kv, damping), run = controller.diagonals, Execution(engine="lanes")
    for (scale, a), many in of.map(
        {"error": [0.5, 1.0], "a": [2.0, 5.0]}, 6, execution=run
    ).points.items():
        law = controller.with_gains(aj.Gains(a * kv, kv, damping))
        own = dataclasses.replace(of, controller=law, uncertainty=uncertainty.scaled(scale))
        for name, column in own.rollouts(6, execution=run).columns.items():
            assert_allclose(many.columns[name], column, rtol=1e-6, atol=1e-12)
