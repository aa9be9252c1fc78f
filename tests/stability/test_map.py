"""Maps against the rollouts that they are made of."""

import functools
import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from types import SimpleNamespace

import numpy as np
import pytest
from many_runs import rolled, study
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.codegen.lanes import Lanes
from approxjac.stability import Execution
from approxjac.stability.rollouts import setting as rollout_setting
from approxjac.stability.search.map import StabilityMap

SHORT = {"duration": 1.0, "dt": 4e-3, "accuracy": 0.05}
DAMPING, SCALES = (0.2, 2.0), (0.5, 1.0)


@pytest.fixture(scope="module")
def plane():
    """A controller of two links, errors and a region."""
    arm, task = aj.load_robot("two_link"), functools.partial(aj.PositionTask, axes="xz")
    errors = aj.Uncertainty(
        arm, task, object_length=(0.0, 0.4), object_axis="x",
        joint_rotations={"joint1": (0.0, 2.0, 0.0)},
    )  # fmt: skip
    law = aj.SetpointController(errors.believed_task())
    return law, errors, aj.JointBox.around(arm, [0.5, 1.2], 0.4)


def test_over_parameters_each_point_is_what_rollouts_say(plane):
    law, errors, region = plane
    own = study(*plane, **SHORT)
    drawn = own.map({"a": (1.0, 4.0, 8.0), "error": (0.0, 1.0)}, 6)
    assert drawn.share.shape == (2, 3)
    assert [each.n for each in drawn.points.values()] == 6 * [6]
    _, kv, damping = law.diagonals
    other = law.with_gains(aj.Gains(4.0 * kv, kv, damping))
    runs = study(other, errors, region, **SHORT).rollouts(6)
    assert drawn.share[1, 1] == runs.share
    assert tuple(drawn.intervals[1, 1]) == runs.interval
    assert drawn.points[4.0, 1.0].setting.engine == "lanes"
    for name, column in runs.columns.items():
        assert_allclose(drawn.points[4.0, 1.0].columns[name], column, rtol=1e-9, atol=1e-12)
    assert "6 points" in repr(drawn)
    assert "the least and most of 6 points" in str(drawn)
    swapped = own.map({"error": (0.0, 1.0), "a": (1.0, 4.0, 8.0)}, 6)
    assert_array_equal(swapped.share, drawn.share.T)


@pytest.mark.parametrize("names", [("a", "kv"), ("kv", "a"), ("kv", "damping"), ("damping", "a")])
def test_the_gains_of_a_point_are_those_of_both_of_its_parameters(plane, names):
    """a is k_p/k_v of that point, whatever its K_v is; what is not named stays as it is."""
    values = dict.fromkeys(names, (0.5, 3.0))
    drawn = study(*plane, **SHORT | {"duration": 4e-3}).map(
        values, 1, execution=Execution(engine="python")
    )
    kp, kv, damping = plane[0].diagonals
    assert len(drawn.points) == 4
    for point, runs in drawn.points.items():
        at = dict(zip(names, point, strict=True))
        found = runs.setting.controller.diagonals
        times = at.get("kv", 1.0)
        assert_allclose(found.kv, times * kv)
        assert_allclose(found.kp, at["a"] * found.kv if "a" in at else times * kp)
        assert_allclose(found.damping, at.get("damping", 1.0) * damping)


def test_over_one_parameter_it_has_a_line_for_each_value(plane):
    """Points begin alike: they differ by what was changed, and not by what was drawn."""
    drawn = study(*plane, **SHORT).map({"error": SCALES}, 8)
    assert drawn.share.shape == (2,)
    one, other = (drawn.points[scale,].columns for scale in SCALES)
    for name in ("q0", "index"):
        assert_array_equal(one[name], other[name])
    assert_allclose(2.0 * one["values"], other["values"], rtol=1e-12)
    (line,) = (line for line in str(drawn).splitlines() if "error 0.5" in line)
    assert " of 8, with 95 % confidence " in line


@pytest.mark.parametrize(
    ("over", "text"),
    [
        ({"error": (0.0, 1.0), "b": (0.0, 1.0)}, "parameter 'b' not in the map"),
        ({"a": (0.0, 1.0)}, "values of a must be at least two growing numbers > 0"),
        ({"error": (-1.0, 1.0)}, "values of error must be at least two growing numbers >= 0"),
        ({"error": (1.0, 1.0)}, "values of error must be at least two growing numbers"),
        ({"error": (1.0,)}, "values of error must be at least two growing numbers"),
        ({"object_length": (0.1, 1.0)}, "parameter 'object_length' not in the map"),
        ({}, "over must have one or two parameters"),
        (("a", "kv"), "over must be a dict of one or two parameters"),
    ],
)
def test_refused(plane, over, text):
    with pytest.raises(aj.errors.ApproxJacError, match=text):
        aj.Study(*plane).map(over)


def test_grown_errors_may_have_a_camera_look_elsewhere():
    """Then nothing is told there; of the given ones it is refused."""
    arm = aj.load_robot("two_link")
    task = functools.partial(aj.PositionTask, axes="xz")
    tip = task(arm).value([0.5, 1.2])
    place = np.array([tip[0], 0.0, tip[1]])
    camera = aj.PinholeCamera.looking_at(place, place + [0.0, -2.0, 0.0], 600.0, (640, 480))
    errors = aj.Uncertainty(arm, camera=camera, distance=(-0.9, 0.0))
    law = aj.SetpointController(errors.believed_task(), aj.Gains(2e-4, 4e-4, 1.0))
    region = aj.JointBox.around(arm, [0.5, 1.2], 0.05)
    drawn = study(law, errors, region, **SHORT).map({"error": (0.5, 4.0), "kv": (0.5, 1.0)}, 8)
    assert list(drawn.points) == [(0.5, 0.5), (0.5, 1.0)]
    assert np.isnan(drawn.share[:, 1]).all()
    with pytest.raises(aj.InvalidInputError, match="must hold configurations that the true sensor"):
        study(law, errors.scaled(4.0), region, **SHORT).map({"error": (0.5, 1.0)}, 8)


# -- what carries it out ------------------------------------------------------------------------


def digest(found):
    columns = [each for runs in found.points.values() for each in runs.columns.values()]
    return b"".join(column.tobytes() for column in columns)


@pytest.mark.study
def test_the_same_bits_whatever_carries_it_out(plane, monkeypatch):
    """Threads, processes, portions of other sizes."""
    own = functools.partial(study(*plane, **SHORT).map, {"damping": DAMPING, "error": SCALES}, 40)
    expected, done = digest(own()), []
    with ThreadPoolExecutor(2) as pool:
        in_threads = own(
            execution=Execution(executor=pool), progress=lambda what, share: done.append(share)
        )
        assert digest(in_threads) == expected
    assert done == sorted(done)
    assert done[-1] == 1.0
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert digest(own(execution=Execution(executor=pool))) == expected

    monkeypatch.setattr("approxjac.stability.rollouts.rollouts._PORTION", 16)
    assert digest(own()) == expected


@pytest.mark.study
@pytest.mark.parametrize("learns", [pytest.param(False, marks=pytest.mark.long), True])
def test_one_compiled_loop_for_all_points(plane, learns, monkeypatch):
    """Gains and scales are numbers of it; without errors, too."""
    _, errors, region = plane
    task = errors.believed_task()
    law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(task.robot) if learns else None)
    made = []
    init = Lanes.__init__
    monkeypatch.setattr(
        Lanes, "__init__", lambda *given, **more: (made.append(1), init(*given, **more))[1]
    )
    short = {**SHORT, "duration": 0.2}
    found = study(law, errors, region, **short).map(
        {"kv": (0.5, 1.0, 2.0), "error": (0.0, 0.3, 1.0)}, 6
    )
    assert len(made) == 1
    kp, kv, damping = law.diagonals
    for (times, scale), runs in found.points.items():
        own = law.with_gains(aj.Gains(times * kp, times * kv, damping))
        alone = study(own, errors.scaled(scale), region, **short).rollouts(6)
        for name, column in alone.columns.items():
            assert_allclose(runs.columns[name], column, rtol=1e-9, atol=1e-12, err_msg=name)


def test_the_law_of_a_map_is_tried_once_for_all_points(plane, monkeypatch):
    """And not at all, once its loop is compiled."""
    tried = []
    monkeypatch.setattr(
        rollout_setting,
        "Lanes",
        lambda *loop, **path: (tried.append(loop), Lanes(*loop, **path))[1],
    )
    over = {"kv": (0.5, 0.75), "error": (0.0, 0.9)}  # nowhere else, as loops are kept
    for _ in range(2):
        found = study(*plane, **SHORT | {"duration": 4e-3}).map(over, 1)
        assert [runs.setting.engine for runs in found.points.values()] == 4 * ["lanes"]
        assert len(tried) == 1


def test_what_follows_from_gains_has_a_loop_of_its_own(plane):
    """Limits, as their proof takes gains; errors of another scale share one."""
    law, errors, region = plane
    kp, kv, damping = law.diagonals
    limited = [
        aj.TorqueLimited(law.with_gains(aj.Gains(kp, kv, k * damping)), aj.Limits(effort=30.0))
        for k in DAMPING
    ]

    settings = [
        study(law, errors.scaled(scale), region, **SHORT).setting()
        for law in limited
        for scale in SCALES
    ]
    found = rollout_setting.with_engine(settings, None, 4)
    keys = [each.key for each in found]
    assert keys[0] == keys[1] != keys[2] == keys[3]
    ((law, largest),) = found[0].alike
    assert law is limited[0]
    assert largest.factor == max(SCALES)


# -- what else simulates ------------------------------------------------------------------------


def test_a_tolerance_by_rollouts(plane):
    """All runs converge up to a scale, and one does not beyond it."""
    errors = plane[1]
    own = aj.Uncertainty(
        errors.arm.with_gravity((0.0, 0.0, 0.0)), errors.task, object_length=(0.0, 0.4),
        object_axis="x", joint_rotations={"joint1": (0.0, 0.8, 0.0)},
    )  # fmt: skip
    law = aj.SetpointController(own.believed_task())
    loop, short = (law, own, plane[2]), {**SHORT, "duration": 2.0}
    found = study(*loop, **short).tolerance(("rollouts",), largest=4.0, precision=0.2, draws=20)
    found = found["rollouts"]
    assert 0.0 < found.scale < found.fails_at < 4.0
    assert rolled(law, own.scaled(found.scale), plane[2], runs=20, **short).share == 1.0
    grown = rolled(law, own.scaled(found.fails_at), plane[2], runs=20, failures=1, **short)
    assert grown.n_converged == grown.n - 1
    assert_array_equal(found.worst, grown.runs[-1].values)
    with pytest.raises(aj.errors.UnknownNameError, match="test 'rollouts' not in the tests"):
        study(*loop).gains(test="rollouts")


def test_the_rollouts_of_a_report_are_in_lanes(plane):
    """Where nothing is said about the region, too."""
    errors = plane[1]
    own = aj.Uncertainty(
        errors.arm.with_gravity((0.0, 0.0, 0.0)), errors.task, object_length=(0.0, 0.04),
        object_axis="x",
    )  # fmt: skip
    law = aj.SetpointController(own.believed_task())
    report = aj.Study(law, own).report(20, runs=8)
    assert isinstance(report.loop.region, aj.stability.RegularPart)
    assert (report.rollouts.setting.engine, report.rollouts.setting.reason) == ("lanes", "")


def test_each_point_of_a_grid_is_in_its_row_and_column():
    """Those without runs are gaps."""
    x, y = np.array([0.5, 1.0, 2.0]), np.array([0.1, 10.0])
    points = {
        (a, b): SimpleNamespace(share=a * b / 20.0, interval=(a * b / 40.0, a * b / 10.0))
        for a in x
        for b in y
        if (a, b) != (1.0, 0.1)
    }
    found = StabilityMap(("error", "damping"), (x, y), points)
    expected = np.outer(y, x) / 20.0
    expected[0, 1] = np.nan
    np.testing.assert_allclose(found.share, expected)
    np.testing.assert_allclose(found.intervals, np.stack([0.5 * expected, 2.0 * expected], axis=-1))
