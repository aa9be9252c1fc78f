"""One reach of any arm: what is believed, what is true, and the verdict."""

import json
import math

import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.studies import reach, reach_report
from approxjac.studies.reach import Settings
from approxjac.tasks import best_axes

HOME = (0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7)


@pytest.fixture(scope="module")
def done():
    settings = Settings(start=HOME, target_offset=(0.05, -0.05, 0.05), duration=6.0, rate=500.0)
    return reach.run(reach.prepare("panda", settings))


def test_truth_and_belief_are_two_robots_that_differ_as_the_settings_say():
    settings = Settings(
        object_length=0.3,
        object_mass=0.4,
        believed_length=0.1,
        believed_mass=0.2,
        joint_shifts={"panda_joint4": (0.0, 0.01, 0.0)},
        joint_rotations={"panda_joint5": (0.02, 0.0, 0.0)},
    )
    ready = reach.prepare("panda", settings)
    arm = aj.load_robot("panda")
    truth, belief = ready.plant.robot, ready.controller.task.robot
    assert truth == arm.with_object(0.3, 0.4)
    assert belief == arm.with_object(0.1, 0.2).with_kinematic_error(
        {"panda_joint4": (0.0, 0.01, 0.0)}, {"panda_joint5": (0.02, 0.0, 0.0)}
    )
    assert ready.controller.gravity.robot == belief


def test_it_converges_and_says_so(done, tmp_path):
    assert done.converged
    assert done.reason == ""
    reach_report.write(done, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["verdict"] == "converged"
    assert summary["final_error_m"] == np.linalg.norm(done.run.error[-1]) < 1e-3
    assert 0.0 < summary["settling_time_s"] < 5.4
    limits = aj.load_robot("panda").effort_limits
    assert_allclose(summary["peak_torque_ratio"], np.abs(done.run.tau / limits).max())
    assert_allclose(summary["start_error_m"], 0.05 * math.sqrt(3.0))
    assert summary["settings"]["duration"] == 6.0
    again = aj.Trajectory.load(tmp_path / "run.npz")
    assert np.array_equal(again.q, done.run.q)
    assert {path.name for path in tmp_path.iterdir()} == {
        "run.png", "run.svg", "run.npz", "summary.json",
    }  # fmt: skip


def test_settling_is_the_first_time_from_which_the_error_stays_small(done):
    small = done.run.error_norm <= 1e-3
    after = done.run.t >= done.settling_time
    assert small[after].all()
    assert not small[~after].all()


def test_the_text_says_where_it_started_went_and_ended(done):
    text = reach_report.text(done)
    for word in ("start ", "target ", "end ", "error ", "settled ", "torque ", "verdict "):
        assert f"\n{word}" in text
    assert "verdict     converged" in text


def test_a_run_that_is_too_short_is_not_converged_and_says_why(tmp_path):
    settings = Settings(start=HOME, target_offset=(0.2, -0.2, 0.1), duration=0.5, rate=500.0)
    result = reach.run(reach.prepare("panda", settings))
    assert not result.converged
    assert math.isnan(result.settling_time)
    summary = result.summary()
    assert summary["verdict"] == "not converged"
    assert summary["settling_time_s"] is None
    assert result.reason == "still approaching its target at the end"
    json.dumps(summary, allow_nan=False)


def test_wrong_gravity_that_is_not_learnt_is_named_as_the_reason():
    settings = Settings(
        start=HOME,
        target_offset=(0.05, 0.0, 0.0),
        gravity="believed",
        object_mass=1.5,
        duration=8.0,
        rate=500.0,
    )
    result = reach.run(reach.prepare("panda", settings))
    assert not result.converged
    assert "gravity is not compensated as it is" in result.reason


def test_a_singular_believed_jacobian_is_named_as_the_reason():
    settings = Settings(
        start=(-1.0, 0.0),
        target=tuple(0.6 * np.array([2.2 * math.cos(1.0), -2.2 * math.sin(1.0)])),
        gravity="exact",
        duration=3.0,
        rate=500.0,
    )
    result = reach.run(reach.prepare("two_link", settings))
    assert result.reason == "stands where the believed Jacobian is singular along the error"


def test_a_pose_has_errors_of_two_units():
    settings = Settings(
        task="pose", start=HOME, target_offset=(0.03, 0.0, 0.0, 0.2, 0.0, 0.0), gravity="exact",
        duration=15.0, rate=500.0, tolerance=5e-3,
    )  # fmt: skip
    result = reach.run(reach.prepare("panda", settings))
    summary = result.summary()
    assert summary["final_error_m"] < 5e-3
    assert summary["final_error_rad"] < 5e-3
    assert len(summary["target"]) == 7


def test_the_same_seed_is_the_same_run_and_another_is_not():
    settings = Settings(duration=0.2, rate=500.0, x_noise=1e-3, seed=4)
    a, b = (reach.run(reach.prepare("ur3", settings)).run for _ in range(2))
    assert np.array_equal(a.q, b.q)
    other = reach.prepare("ur3", Settings(duration=0.2, rate=500.0, x_noise=1e-3, seed=5))
    assert not np.array_equal(other.target, a.target)
    assert np.array_equal(other.q0, other.plant.ready_posture())  # whichever the seed


def test_a_random_start_is_one_of_the_seed():
    starts = [
        reach.prepare("ur3", Settings(start="random", seed=seed)).q0.tolist() for seed in (4, 4, 5)
    ]
    assert starts[0] == starts[1] != starts[2]


def test_starts_and_targets_are_regular_and_can_be_held():
    for seed in range(5):
        ready = reach.prepare("talos_arm", Settings(start="random", seed=seed))
        sensor, task = ready.plant.sensor, ready.controller.task
        for jacobian in (sensor.jacobian(ready.q0), task.jacobian(ready.q0)):
            values = np.linalg.svd(jacobian, compute_uv=False)
            assert values[-1] > 0.1 * values[0]
        hold = np.abs(ready.plant.dynamics.g(ready.q0)) / ready.plant.robot.effort_limits
        assert hold.max() <= 0.7
        low, high = ready.plant.robot.position_limits
        assert ((low <= ready.q0) & (ready.q0 <= high)).all()


def test_of_two_joints_the_axes_that_they_command_are_taken():
    assert best_axes(aj.load_robot("two_link")) == "xz"
    assert best_axes(aj.load_robot("panda")) == "xyz"


@pytest.mark.parametrize(
    ("options", "text"),
    [
        ({"target": (0.4, 0.0, 0.4), "target_offset": (0.1, 0.0, 0.0)}, "must not both be given"),
        ({"target": (0.4, 0.0)}, r"target must have shape \(3,\)"),
        ({"start": (0.0, 0.0)}, r"start must have shape \(7,\)"),
        ({"object_length": -1.0}, "length must be a finite number >= 0"),
        ({"object_length": 200.0}, r"at most 10 \[m\], got 200 and 0.01; 200 mm are 0.2"),
        ({"object_mass": 500.0}, "that its motors can hold"),
        ({"joint_shifts": {"elbow": (0.0, 0.0, 0.0)}}, "joint 'elbow' not in panda"),
        ({"axes": "xw"}, "axis 'w' not in axes"),
        ({"task": "pose", "axes": "xyz"}, "axes are those of a position"),
        ({"start": (9.0,) * 7}, "start must be within the joint limits, got 9 for panda_joint1"),
        ({"seed": -1}, "seed must be >= 0, got -1"),
        ({"duration": float("inf")}, "duration must be a finite number"),
        ({"duration": 1e-4}, r"duration must be a finite number >= 0.001"),
        ({"rate": 0.0}, "rate must be a finite number > 0"),
        ({"tolerance": 0.0}, "tolerance must be a finite number > 0"),
        ({"gamma": -1.0}, "gamma must be > 0"),
        ({"kp": (-1.0,)}, "kp must be > 0"),
        ({"x_dropout": 2.0}, "x_dropout must be a probability"),
        ({"floor": 0.0}, "a floor needs the engine mujoco"),
    ],
)
def test_bad_settings_are_refused(options, text):
    with pytest.raises(aj.ApproxJacError, match=text):
        reach.prepare("panda", Settings(**options))


def test_a_target_out_of_reach_is_named_as_the_reason():
    settings = Settings(target=(3.0, 0.0, 0.5), duration=0.5, rate=500.0)
    result = reach.run(reach.prepare("ur5", settings))
    assert result.reason.startswith("out of reach: 3.0")
    within = Settings(target=(0.5, 0.1, 0.5), duration=0.1, rate=500.0)
    assert "out of reach" not in reach.run(reach.prepare("ur5", within)).reason


def test_a_run_of_one_step_is_judged():
    settings = Settings(duration=0.1, rate=10.0, start=(0.3, 0.8))
    result = reach.run(reach.prepare("two_link", settings))
    assert not result.converged
    assert result.reason


def test_a_given_start_asks_for_no_random_one():
    settings = Settings(start=HOME, target_offset=(0.1, 0.0, 0.0), object_mass=300.0)
    assert np.array_equal(reach.prepare("panda", settings).q0, HOME)


def test_a_lost_measurement_is_named_as_the_reason():
    settings = Settings(start=HOME, target_offset=(0.1, 0, 0), x_dropout=1.0, duration=1.0)
    assert reach.run(reach.prepare("panda", settings)).reason == "the measurement of x is lost"


def test_joints_beyond_their_limits_are_reported():
    settings = Settings(
        start=HOME, target=(-0.9, -0.3, 0.3), gravity="exact", duration=3.0, rate=500.0
    )
    result = reach.run(reach.prepare("panda", settings))
    low, high = aj.load_robot("panda").position_limits
    beyond = np.maximum(result.run.q - high, low - result.run.q).max()
    assert beyond > 0.0
    assert result.summary()["joint_limit_excess"] == beyond
    assert f"panda_joint6 was {beyond:.2g} rad beyond its position limits" in reach_report.text(
        result
    )


def test_gains_may_be_given_one_by_one():
    settings = Settings(kp=(100.0, 200.0, 300.0), kv=(50.0,), damping=(2.0,))
    kp, kv, damping = reach.prepare("panda", settings).controller.diagonals
    assert kp.tolist() == [100.0, 200.0, 300.0]
    assert kv.tolist() == [50.0] * 3
    assert damping.tolist() == [2.0] * 7
