"""Sweeps over controllers and errors."""

import dataclasses
import functools
import multiprocessing
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor

import numpy as np
import pytest
from numpy.testing import assert_array_equal

import approxjac as aj
from approxjac.codegen.lanes import Lanes
from approxjac.stability import sweep

OPTIONS = {"runs": 40, "duration": 1.0, "dt": 2e-3, "tolerance": 0.02}
DAMPING = (0.2, 2.0)
SCALES = (0.5, 1.0)


@pytest.fixture(scope="module")
def errors():
    arm, task = aj.load_robot("two_link"), functools.partial(aj.PositionTask, axes="xz")
    turn = {"joint1": (0.0, 0.8, 0.0)}
    return aj.Uncertainty(
        arm, task, object_length=(0.0, 0.4), object_axis="x", joint_rotations=turn
    )


@pytest.fixture(scope="module")
def laws(errors):
    law = aj.SetpointController(errors.believed_task())
    kp, kv, damping = law.diagonals
    return {times: law.with_gains(aj.Gains(kp, kv, times * damping)) for times in DAMPING}


@pytest.fixture(scope="module")
def region(errors):
    return aj.JointBox.around(errors.arm, [0.5, 1.2], 0.4)


@pytest.fixture(scope="module")
def scaled(errors):
    return {scale: errors.scaled(scale) for scale in SCALES}


@pytest.fixture(scope="module")
def found(laws, scaled, region):
    return sweep(laws, scaled, region, **OPTIONS)


def digest(found):
    columns = [each for runs in found.points.values() for each in runs.columns.values()]
    return b"".join(column.tobytes() for column in columns)


def test_each_point_is_what_rollouts_say(found, laws, scaled, region):
    assert found.names == ("controller", "uncertainty")
    assert [*found.points] == [(times, scale) for times in DAMPING for scale in SCALES]
    with pytest.raises(aj.errors.UnknownNameError, match=r"point 3 not in the sweep; valid are \("):
        found.points[3]
    runs = found.points[2.0, 0.5]
    alone = aj.rollouts(laws[2.0], scaled[0.5], region, **OPTIONS)
    assert runs.study.engine == "lanes"
    for name, column in alone.columns.items():
        np.testing.assert_allclose(runs.columns[name], column, rtol=1e-9, atol=1e-12, err_msg=name)
    run = runs.replay(3)
    assert run.error_norm[-1] == pytest.approx(runs.runs[3].final_error, abs=1e-9)


def test_points_begin_alike(found):
    own = [runs.columns for runs in found.points.values()]
    for name in ("q0", "values", "target"):
        assert_array_equal(own[0][name], own[2][name])  # the same errors, other gains
    assert_array_equal(own[0]["q0"], own[1]["q0"])
    np.testing.assert_allclose(2.0 * own[0]["values"], own[1]["values"], rtol=1e-12)


def test_its_table_has_a_row_for_each_point(found):
    table = found.table
    assert_array_equal(table["controller"], [0.2, 0.2, 2.0, 2.0])
    assert_array_equal(table["uncertainty"], [0.5, 1.0, 0.5, 1.0])
    for k, runs in enumerate(found.points.values()):
        assert (table["low"][k], table["high"][k]) == runs.interval
        assert table["share"][k] == runs.share
        assert table["final_error"][k] == runs.worst.final_error
        settled = np.nan_to_num(runs.columns["settling_time"], nan=np.inf, posinf=np.inf)
        assert table["settling_time"][k] == np.median(settled)
    assert {column.shape for column in table.values()} == {(4,)}
    assert table["share"][0] > table["share"][1]
    lines = str(found).splitlines()
    assert len(lines) == 4
    assert lines[0].startswith("(0.2, 0.5): ")
    assert "of 40 converged" in lines[0]


def test_labels_may_be_anything(laws, errors, region):
    pairs = {(1, "a"): laws[0.2], (2, "b"): laws[2.0]}
    found = sweep(pairs, errors, region, **OPTIONS | {"runs": 2, "duration": 0.1})
    assert found.names == ("controller",)
    assert found.table["controller"].tolist() == [(1, "a"), (2, "b")]
    assert found.points[2, "b"].n == 2
    assert "half never settle" in str(found)


@pytest.mark.parametrize("failures", [None, 2])
def test_the_same_bits_whatever_carries_it_out(
    laws, scaled, region, failures, tmp_path, monkeypatch
):
    """Threads, processes, portions of other sizes, stopped and gone on with."""
    own = functools.partial(sweep, laws, scaled, region, failures=failures, **OPTIONS)
    alone = own()
    expected = digest(alone)
    if failures is not None:
        assert min(runs.n for runs in alone.points.values()) < 40
    done = []
    with ThreadPoolExecutor(2) as pool:
        assert digest(own(executor=pool, progress=done.append)) == expected
    assert done == sorted(done)
    assert done[-1] == 160
    with ProcessPoolExecutor(1, mp_context=multiprocessing.get_context("spawn")) as pool:
        assert digest(own(executor=pool)) == expected

    def stop(done):
        if done >= 64:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        own(folder=tmp_path, progress=stop)
    kept = {file: file.stat().st_mtime_ns for file in tmp_path.iterdir()}
    assert kept
    assert digest(own(folder=tmp_path)) == expected
    assert kept.items() <= {f: f.stat().st_mtime_ns for f in tmp_path.iterdir()}.items()
    assert len(kept) < len([*tmp_path.iterdir()])
    monkeypatch.setattr("approxjac.stability.rollout.rollout_portions._PORTION", 16)
    assert digest(own()) == expected


def test_what_it_refuses(laws, errors, region):
    text = "controller or uncertainty must be a dict that is not empty"
    for law in (laws[2.0], {}):
        with pytest.raises(aj.InvalidInputError, match=text):
            sweep(law, errors, region)
    with pytest.raises(aj.InvalidInputError, match="failures must be an integer >= 1, got 0"):
        sweep(laws, errors, region, failures=0)
    with pytest.raises(aj.InvalidInputError, match="uncertainty must be an Uncertainty"):
        sweep(laws, {1: 2.0}, region)


@pytest.mark.parametrize("learns", [False, True])
def test_one_compiled_loop_for_all_points(errors, region, learns, monkeypatch):
    """Gains and scales are numbers of it; without errors, too."""
    task = errors.believed_task()
    law = aj.SetpointController(task, gravity=aj.AdaptiveGravity(task.robot) if learns else None)
    kp, kv, damping = law.diagonals
    laws = {
        1: law,
        2: law.with_gains(aj.Gains(kp, 2.0 * kv, damping)),
        3: law.with_gains(aj.Gains([100.0, 200.0], kv, 3.0)),
    }
    scaled = {scale: errors.scaled(scale) for scale in (0.0, 0.3, 1.0)}
    made = []
    init = Lanes.__init__
    monkeypatch.setattr(
        Lanes, "__init__", lambda *given, **more: (made.append(1), init(*given, **more))[1]
    )
    options = OPTIONS | {"runs": 6, "duration": 0.2}
    found = sweep(laws, scaled, region, **options)
    assert len(made) == 1
    for (one, scale), runs in found.points.items():
        alone = aj.rollouts(laws[one], scaled[scale], region, **options)
        for name, column in alone.columns.items():
            np.testing.assert_allclose(
                runs.columns[name], column, rtol=1e-9, atol=1e-12, err_msg=name
            )


def test_what_follows_from_gains_has_a_loop_of_its_own(errors, laws, region):
    """Limits, as their proof takes gains."""
    effort = aj.Limits(effort=30.0)
    limited = {times: aj.TorqueLimited(law, effort) for times, law in laws.items()}
    options = OPTIONS | {"runs": 4, "duration": 0.2}
    found = sweep(limited, errors, region, **options)
    for times, runs in found.points.items():
        assert runs.study.engine == "lanes"
        assert runs.study.alike == ()
        alone = aj.rollouts(limited[times], errors, region, **options)
        assert_array_equal(runs.columns["final_error"], alone.columns["final_error"])
    scaled = {scale: errors.scaled(scale) for scale in SCALES}
    for runs in sweep(limited[2.0], scaled, region, **options).points.values():
        assert len(runs.study.alike) == 1


# -- what else simulates ------------------------------------------------------------------------


def test_a_tolerance_by_rollouts(errors, region):
    """All runs converge up to a scale, and one does not beyond it."""
    arm = errors.arm.with_gravity((0.0, 0.0, 0.0))
    own = dataclasses.replace(errors, arm=arm)
    law = aj.SetpointController(own.believed_task())
    options = OPTIONS | {"runs": 20, "tolerance": 0.05, "duration": 2.0}
    found = aj.tolerance(
        law, own, region, tests=("rollouts",), largest=4.0, precision=0.2, **options
    )["rollouts"]
    assert 0.0 < found.scale < found.fails_at < 4.0
    assert aj.rollouts(law, own.scaled(found.scale), region, **options).share == 1.0
    grown = aj.rollouts(law, own.scaled(found.fails_at), region, failures=1, **options)
    assert grown.n_converged == grown.n - 1
    assert_array_equal(found.worst, grown.runs[-1].values)
    with pytest.raises(aj.errors.UnknownNameError, match="test 'rollouts' not in the tests"):
        aj.suggest_gains(own, region, test="rollouts")


def test_the_rollouts_of_a_report_are_in_lanes(errors):
    """Where nothing is said about the region, too."""
    arm = errors.arm.with_gravity((0.0, 0.0, 0.0))
    own = dataclasses.replace(errors.scaled(0.1), arm=arm)
    law = aj.SetpointController(own.believed_task())
    report = aj.stability_report(law, own, configurations=20, runs=8)
    assert isinstance(report.loop.region, aj.stability.RegularPart)
    assert (report.rollouts.study.engine, report.rollouts.study.reason) == ("lanes", "")
