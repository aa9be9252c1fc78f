"""Cameras that see a part of the region only: no posture or target is drawn that they miss."""

import functools
import math

import numpy as np
import pytest

import approxjac as aj
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.loop.configurations import UnattainedError, VisiblePart, inverse_kinematics
from approxjac.tasks import CombinedTask
from approxjac.tasks.analysis import sees

ARM = aj.load_robot("two_link").with_gravity((0.0, 0.0, 0.0))
CAMERA = aj.PinholeCamera.looking_at((1.0, 0.0, 0.8), (1.0, -2.0, 0.8), 400.0, (320, 240))
BOX = aj.JointBox(ARM, (-1.2, 0.4), (0.2, 2.4))
ELSEWHERE = aj.JointBox.around(ARM, (3.0, 0.5), 0.2)
GAINS = aj.Gains(2e-3, 1e-3, damping=0.5)


def loop(task=None, **ranges):
    errors = aj.Uncertainty(ARM, task, camera=CAMERA, **{"roll": (-0.3, 0.3), **ranges})
    controller = aj.SetpointController(
        errors.believed_task(), GAINS, gravity=aj.NoGravity(errors.belief())
    )
    return controller, errors


def seen(plants, truths, values):
    return all(
        np.isfinite(plants[t].sensor.visible(x)).all() for t, x in zip(truths, values, strict=True)
    )


def test_half_of_the_region_is_out_of_view(rng):
    task = aj.ImageTask(ARM, CAMERA)
    assert 0.3 < np.mean([sees(task, q) for q in BOX.sample(400, rng)]) < 0.7


@pytest.mark.parametrize("target", [None, (0.1, 1.2)])
def test_samples_and_targets_are_seen_by_their_own_true_robot(rng, target):
    controller, errors = loop(distance=(-0.2, 0.2))
    x_d = None if target is None else controller.task.value(np.array(target))
    loops = ClosedLoop(controller, errors, BOX, x_d)
    plants = loops.plants
    drawn = loops.draw(60, rng)
    assert len(loops.corners) == 4
    assert all(BOX.contains(q) for q in drawn.q)
    values = [plants[t].sensor.value(q) for t, q in zip(drawn.truth, drawn.q, strict=True)]
    assert seen(plants, drawn.truth, values)
    assert seen(plants, drawn.truth, drawn.x_d)
    truths, targets = loops.targets(40, rng)
    values = [plants[t].sensor.value(q) for t, q in zip(truths, targets, strict=True)]
    assert seen(plants, truths, values)


def test_what_is_seen_anyway_is_drawn_as_it_was():
    """Not one random number more: everything with a seed stays what it is."""
    part = VisiblePart(BOX, aj.PositionTask(ARM, axes="xz"))
    ours, plain = np.random.default_rng(3), np.random.default_rng(3)
    assert (part.sample(50, ours) == BOX.sample(50, plain)).all()
    assert ours.random() == plain.random()
    some = BOX.sample(50, np.random.default_rng(4))
    task = aj.ImageTask(ARM, CAMERA)
    others = VisiblePart(BOX, task).replace_unseen(some, ours)
    kept = [sees(task, q) for q in some]
    assert ((others == some).all(axis=1) == kept).all()


def test_the_way_to_a_posture_ends_in_view():
    task = aj.ImageTask(ARM, CAMERA)
    start, out = np.array([-0.2, 1.6]), np.array([-1.4, -1.5])
    assert sees(task, start)
    assert not sees(task, out)
    part = VisiblePart(BOX, task)
    for share in (0.0, 0.1, 1.0):
        assert sees(task, part.between(start, out, share))
    assert (part.between(out, out, 1.0) == out).all()  # nothing is seen: it stays where it is


def test_a_target_is_not_attained_where_it_is_not_seen():
    """The image beyond the edge, and a search that gets behind the camera, are no postures."""
    task = aj.ImageTask(ARM, CAMERA)
    start = np.array([-0.2, 1.6])
    assert inverse_kinematics(task, task.value(start + 0.1), start) == pytest.approx(start + 0.1)
    assert inverse_kinematics(task, np.array([-30.0, 100.0]), start) is None
    # carried by the second link, with the point behind it
    eye = aj.PinholeCamera(
        300.0, (320, 240), rotation=((0, 0, 1), (1, 0, 0), (0, 1, 0)), mount="link2"
    )
    eye_task = aj.ImageTask(ARM, eye, points=[(-1.0, 0.3, 0.2)])
    assert np.isnan(eye_task.value(np.zeros(2))).all()
    assert inverse_kinematics(eye_task, np.array([100.0, 100.0]), np.zeros(2)) is None


def test_a_region_out_of_view_is_refused():
    controller, errors = loop()
    for test in (
        lambda: aj.Study(controller, errors, ELSEWHERE).report(20),
        lambda: aj.Study(controller, errors, ELSEWHERE).tolerance(("stable",)),
        lambda: aj.Study(controller, errors, ELSEWHERE).gains(configurations=20),
    ):
        with pytest.raises(
            aj.InvalidInputError,
            match=r"must hold configurations that the true sensor sees: of 1\d+ of Joint",
        ):
            test()
    with pytest.raises(
        aj.InvalidInputError, match=r"sees 0, got ImageTask.* with camera roll 0"
    ) as e:
        aj.Study(controller, errors, ELSEWHERE, seed=1).rollouts(1)
    assert isinstance(e.value, UnattainedError)
    assert e.value.given == pytest.approx(errors.sample(np.random.default_rng([1, 0])))


def test_errors_that_turn_the_camera_away_are_errors_that_fail():
    """Grown by ten, the camera stands before or behind the arm; that is no reason to stop."""
    controller, errors = loop(distance=(-0.4, 0.4))
    region = aj.JointBox.around(ARM, (0.1, 1.2), 0.1)
    found = aj.Study(controller, errors, region).tolerance(("stable",), draws=8)["stable"]
    assert 1.0 < found.scale < found.fails_at < 6.0
    assert np.isfinite(found.fails_at)
    assert f"at {found.fails_at:.3g} times, with camera distance" in str(found)
    with pytest.raises(aj.InvalidInputError, match="the region must hold configurations"):
        aj.Study(controller, errors.scaled(5.1), region).tolerance(("stable",), draws=8)


def test_rollouts_start_and_end_in_view():
    controller, errors = loop()
    found = aj.Study(
        controller,
        errors,
        BOX,
        duration=4.0,
        accuracy=1.0,
        seed=2,
        latency=aj.Latency(period=0.004),
    ).rollouts(4)
    for run in found.runs:
        sensor = errors.plant(run.values).sensor
        assert sees(sensor, run.q0)
        assert np.isfinite(sensor.visible(run.target)).all()
        assert run.converged


def test_a_run_that_ends_behind_the_camera_is_the_worst():
    """There is no image, and so no error to compare: it counts as infinite."""

    class Pushed(aj.SetpointController):
        def evaluate(self, state, measurement, target):
            answer = super().evaluate(state, measurement, target)
            return answer._replace(torque=np.array([-8.0, 0.0]))  # the first joint, upwards

    within = aj.PinholeCamera.looking_at((1.5, 0.0, 0.0), (0.3, 0.5, 0.0), 200.0, (640, 480))
    errors = aj.Uncertainty(ARM, camera=within, roll=(0.0, 0.1))
    controller = Pushed(errors.believed_task(), GAINS, gravity=aj.NoGravity(ARM))
    region = aj.JointBox.around(ARM, (-0.3, 0.6), 0.05)
    found = aj.Study(
        controller, errors, region, duration=1.2, latency=aj.Latency(period=0.004)
    ).rollouts(2)
    assert [run.final_error for run in found.runs] == [math.inf, math.inf]
    assert found.n_diverged == found.n_converged == 0


# -- Jacobians that use the measured x ------------------------------------------------------


@pytest.mark.parametrize("depth", [2.0, "measured"])
def test_a_jacobian_that_uses_x_has_the_local_test_and_rollouts(depth):
    controller, errors = loop(functools.partial(aj.ImageTask, depth=depth))
    region = aj.JointBox.around(ARM, (0.1, 1.2), 0.1)
    found = aj.Study(controller, errors, region).tolerance(("stable",), draws=8, largest=6.0)
    assert 3.0 < found["stable"].scale < 0.5 * math.pi / 0.3
    runs = aj.Study(
        controller, errors, region, duration=4.0, accuracy=1.0, latency=aj.Latency(period=0.004)
    ).rollouts(2)
    assert runs.n_converged == 2


def test_the_other_tests_refuse_it():
    controller, errors = loop(functools.partial(aj.ImageTask, depth=2.0))
    study = aj.Study(controller, errors, aj.JointBox.around(ARM, (0.1, 1.2), 0.1))
    for call in (
        lambda: study.report(20),
        lambda: study.tolerance(("certified",), draws=20),
        lambda: study.gains(configurations=20),
    ):
        with pytest.raises(
            aj.InvalidInputError,
            match="the conditions over a region is for a task whose Jacobian depends on q only and",
        ):
            call()


# -- a Panda before a camera ----------------------------------------------------------------


@pytest.mark.long
def test_a_panda_before_a_camera(panda):
    """Certified for small errors of everything; one point lets the roll go to a right angle."""
    arm = panda.with_gravity((0.0, 0.0, 0.0))
    q = np.array([0.3, 0.4, -0.2, -1.8, 0.1, 2.0, 0.5])
    tip = aj.PositionTask(arm).value(q)
    camera = aj.PinholeCamera.looking_at(tip, tip + [0.9, -0.7, 0.5], 600.0, (640, 480))
    box = aj.JointBox.around(arm, q, 0.05)
    small = aj.Uncertainty(
        arm, camera=camera, roll=(-0.1, 0.1), focal_length=(570.0, 630.0), distance=(-0.05, 0.05)
    )
    controller = aj.SetpointController(
        small.believed_task(), aj.Gains(2e-4, 4e-4, damping=1.0), gravity=aj.NoGravity(arm)
    )
    report = aj.Study(controller, small, box).report(24)
    assert report.passed
    assert not report.growth.grows
    assert "camera" in report.describe_truth(0)
    rolled = aj.Uncertainty(arm, camera=camera, roll=(-1.0, 1.0))
    target = controller.task.value(q)
    found = aj.Study(controller, rolled, box, target=target).tolerance(
        ("stable",), draws=4, largest=3.0
    )["stable"]
    assert 85.0 < math.degrees(found.scale) < 90.0
    assert "camera roll" in str(found)


def test_rollouts_take_a_combined_task_with_the_sensor_as_it_is():
    plain, errors = loop()
    task = CombinedTask(plain.task, [[1.0, 0.3], [-0.2, 1.1]])
    controller = aj.SetpointController(task, GAINS, gravity=aj.NoGravity(errors.belief()))
    region = aj.JointBox.around(ARM, (0.1, 1.2), 0.1)
    found = aj.Study(
        controller,
        errors,
        region,
        duration=4.0,
        accuracy=1.0,
        seed=2,
        latency=aj.Latency(period=0.004),
    ).rollouts(2)
    assert found.n_converged == 2
    with pytest.raises(aj.InvalidInputError, match="the coordinates of the plant's sensor"):
        aj.Study(controller, errors, region).report(20)
