"""A scenario that is built and run: what is believed, what is true, and the verdict."""

import dataclasses
import json
import math
import re

import numpy as np
import pytest
from numpy.testing import assert_allclose
from scenarios import HOME, reach

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.errors import InvalidInputError
from approxjac.scenario import Scenario, build_scenario, run_scenario
from approxjac.scenario import outcome as report
from approxjac.scenario.judge import prepare
from approxjac.scenario.starts import floor_below
from approxjac.tasks import TrackerTask
from approxjac.tasks.analysis import place_of

NEAR = {"start": HOME, "target": {"offset": (0.05, -0.05, 0.05)}}
FAR = {"start": HOME, "target": {"offset": (0.3, -0.4, 0.3)}}


@pytest.fixture(scope="module")
def done():
    return run_scenario(reach(run={**NEAR, "duration": 6.0}, controller={"law": "setpoint"}))


def test_truth_and_belief_are_two_robots_that_differ_as_the_scenario_says():
    wrong = {"panda_joint4": (0.0, 0.01, 0.0)}, {"panda_joint5": (0.02, 0.0, 0.0)}
    built = build_scenario(reach(
        true={"object": {"length": 0.3, "mass": 0.4}, "shifts": {"panda_joint2": (0.1, 0.0, 0.0)}},
        believed={
            "object": {"length": 0.1, "mass": 0.2}, "shifts": wrong[0], "rotations": wrong[1],
        },
    ))  # fmt: skip
    arm = aj.load_robot("panda")
    truth, belief = built.plant.robot, built.law.task.robot
    assert truth == arm.with_object(0.3, 0.4).with_kinematic_error(
        {"panda_joint2": (0.1, 0.0, 0.0)}
    )
    assert belief == arm.with_object(0.1, 0.2).with_kinematic_error(*wrong)
    assert built.law.gravity.robot == belief == built.believe(0.1)


@pytest.mark.usefixtures("blank_pictures")
def test_it_converges_and_says_so(done, tmp_path):
    assert done.converged
    assert done.reason == ""
    report.write(done, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert summary["verdict"] == "converged"
    assert summary["final_error_m"] == np.linalg.norm(done.run.error[-1]) < 1e-3
    assert 0.0 < summary["settling_time_s"] < 5.4
    limits = aj.load_robot("panda").effort_limits
    assert_allclose(summary["peak_torque_ratio"], np.abs(done.run.tau / limits).max())
    assert_allclose(summary["start_error_m"], 0.05 * math.sqrt(3.0))
    ends = {"start": done.run.x[0], "end": done.run.x[-1], "target": done.run.x_d[-1]}
    ends |= {"q_start": done.run.q[0], "q_end": done.run.q[-1]}
    for name, values in ends.items():
        assert_allclose(summary[name], values, err_msg=name)
    assert set(summary["limits"]["status_counts"]) == {"FREE"}
    again = aj.Trajectory.load(tmp_path / "run.npz")
    assert np.array_equal(again.q, done.run.q)
    assert {path.name for path in tmp_path.iterdir()} == {
        "run.png", "run.svg", "run.npz", "summary.json", "scenario.toml",
    }  # fmt: skip
    small = done.run.error_norm <= 1e-3
    after = done.run.t >= done.settling_time
    assert small[after].all()
    assert not small[~after].all()
    text = report.text(done)
    assert text.startswith("converged\nerror ")


def test_the_rest_is_learnt_of_a_robot_that_adds_its_own_gravity():
    def made(**controller):
        return reach(
            "ur5", true={"object": {"length": 0.1, "mass": 0.5}},
            believed={"object": {"mass": 0.2}}, controller=controller,
            run={"target": {"offset": (0.05, 0.0, -0.05)}, "duration": 1.0}, loop={"dt": 2e-3},
        )  # fmt: skip

    built = build_scenario(made(gravity="learn_residual"))
    assert built.plant.adds_gravity == built.law.task.robot != built.plant.robot
    done = run_scenario(built)
    assert "with the gravity that the robot adds" in " ".join(report.text(done).split())
    run, own = done.run, aj.robots.Dynamics(built.law.task.robot)
    asked = [tau + own.g(q) for tau, q in zip(run.tau, run.q, strict=True)]  # of the motors
    share = np.abs(asked / built.plant.motor_limits).max()
    assert done.peak_torque_ratio == pytest.approx(share)
    assert share > 1.2 * np.abs(run.tau / built.plant.motor_limits).max()
    drawn = report.draw(done).axes[1].lines[2:8]
    assert np.abs([line.get_ydata() for line in drawn]).max() == pytest.approx(share)
    assert not built.law.learnt(run.state[0]).any()
    last = run.error_norm[-1]
    assert last < 0.2 * run.error_norm[0]
    with pytest.raises(InvalidInputError, match="must be learnt, exact, believed or none in a rep"):
        prepare(made(gravity="learn_residual"))
    with pytest.raises(InvalidInputError, match="must be learnt or believed with the tracking law"):
        build_scenario(made(gravity="learn_residual", law="tracking"))


@pytest.mark.study
def test_a_pose_has_errors_of_two_units():
    result = run_scenario(reach(
        task={"kind": "pose"}, controller={"gravity": "exact"},
        run={
            "start": HOME, "target": {"offset": (0.03, 0.0, 0.0, 0.2, 0.0, 0.0)}, "duration": 15.0,
            "tolerance": 5e-3,
        },
    ))  # fmt: skip
    summary = result.summary()
    assert summary["final_error_m"] < 5e-3
    assert summary["final_error_rad"] < 5e-3
    assert len(summary["target"]) == 7
    assert summary["start_error_m"] == pytest.approx(0.03)
    assert summary["start_error_rad"] == pytest.approx(0.2, rel=1e-3)
    for k in (0, -1):
        error = result.run.error[k]
        sizes = {"m": np.linalg.norm(error[:3]), "rad": np.linalg.norm(error[3:])}
        assert result.errors_at(k) == pytest.approx(sizes)


def test_stacked_frames_and_the_target_of_a_configuration():
    start, goal = HOME, (0.1, -0.4, 0.0, -1.9, 0.0, 1.6, 0.7)
    built = build_scenario(
        reach(
            task={"kind": "stacked", "frames": ("object_tip", "panda_link4"), "axes": "xz"},
            run={"start": start, "target": {"configuration": goal}},
        )
    )
    assert_allclose(built.target, built.plant.sensor.value(np.array(goal)))
    assert len(built.target) == 4


def test_the_same_seed_is_the_same_run_and_another_is_not():
    def made(seed):
        return build_scenario(
            reach("ur3", sensor={"noise": 1e-3}, run={"duration": 0.2, "seed": seed})
        )

    a, b = (run_scenario(made(4)).run for _ in range(2))
    assert np.array_equal(a.q, b.q)
    assert not np.array_equal(made(5).target, a.target)
    assert np.array_equal(made(5).q0, made(5).plant.ready_configuration())  # whichever the seed
    starts = [
        build_scenario(reach("ur3", run={"start": "random", "seed": k})).q0 for k in (4, 4, 5)
    ]
    assert np.array_equal(starts[0], starts[1])
    assert not np.array_equal(starts[0], starts[2])


def test_starts_and_targets_are_regular_and_can_be_held():
    for seed in range(3):
        built = build_scenario(reach("talos_arm", run={"start": "random", "seed": seed}))
        for task in (built.plant.sensor, built.law.task):
            values = np.linalg.svd(task.jacobian(built.q0), compute_uv=False)
            assert values[-1] > 0.1 * values[0]
        hold = np.abs(built.plant.dynamics.g(built.q0)) / built.plant.robot.effort_limits
        assert hold.max() <= 0.7
        low, high = built.plant.robot.position_limits
        assert ((low <= built.q0) & (built.q0 <= high)).all()


@pytest.mark.parametrize(
    ("base", "first", "floor"),
    [
        pytest.param(0.0, 0.3, 0.0, id="stands"),
        pytest.param(0.8, 0.3, 0.0, id="on a table"),
        pytest.param(2.0, -0.3, 0.0, id="under the ceiling of a cell"),
        pytest.param(0.0, -0.3, -math.inf, id="hangs from its root"),
        pytest.param(0.0, 0.0, -math.inf, id="on a wall"),
    ],
)
@pytest.mark.filterwarnings("ignore::approxjac.errors.ImplausibleRobotWarning")
def test_a_floor_is_where_the_mount_of_an_arm_ends(base, first, floor):
    inertia = '<inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/>'
    arm = aj.load_robot(f"""<robot name="arm"><link name="world"/><link name="base"/>
        <link name="upper"><inertial><mass value="1"/>{inertia}</inertial></link>
        <joint name="mount" type="fixed"><parent link="world"/><child link="base"/>
        <origin xyz="0 0 {base}"/></joint>
        <joint name="shoulder" type="revolute"><parent link="base"/><child link="upper"/>
        <origin xyz="0.1 0 {first}"/><axis xyz="0 1 0"/>
        <limit lower="-1" upper="1" effort="5" velocity="1"/></joint></robot>""")
    assert floor_below(arm) == floor


@pytest.mark.parametrize("robot", ["panda", "ur5", "so101"])
def test_a_random_target_is_above_the_floor(robot):
    for seed in range(10):
        assert build_scenario(reach(robot, run={"seed": seed})).target[2] >= 0.0


def test_a_random_target_is_above_the_floor_of_mujoco():
    run = {"start": HOME, "seed": 4}
    built = build_scenario(reach(true={"engine": "mujoco", "floor": 0.4}, run=run))
    assert built.target[2] >= 0.4 > build_scenario(reach(run=run)).target[2]


def test_a_random_target_of_an_arm_without_a_floor_may_be_anywhere():
    targets = [build_scenario(reach("two_link", run={"seed": k})).target for k in range(10)]
    assert min(target[-1] for target in targets) < 0.0


def test_gains_may_be_given_one_by_one():
    gains = {"kp": (100.0, 200.0, 300.0), "kv": 50.0, "damping": 2.0}
    kp, kv, damping = build_scenario(reach(controller=gains)).law.diagonals
    assert kp.tolist() == [100.0, 200.0, 300.0]
    assert kv.tolist() == [50.0] * 3
    assert damping.tolist() == [2.0] * 7


# -- why not ----------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("robot", "parts", "reason"),
    [
        ("panda", {"run": {**FAR, "duration": 0.5}}, "still approaching its target at the end"),
        ("panda",
         {"true": {"object": {"mass": 1.5}}, "controller": {"gravity": "believed"},
          "run": {**NEAR, "duration": 8.0}}, "gravity is not compensated as it is"),
        ("two_link",
         {"controller": {"gravity": "exact"},
          "run": {"start": (-1.0, 0.0), "duration": 0.2,
                  "target": (1.32 * math.cos(1.0), -1.32 * math.sin(1.0))}},
         "stands where the believed Jacobian is singular along the error"),
        ("ur5", {"run": {"target": (3.0, 0.0, 0.5), "duration": 0.5}}, "out of reach: 3.0"),
        ("panda", {"sensor": {"dropout": 1.0}, "run": {**NEAR, "duration": 1.0}},
         "the measurement of x is lost"),
        ("two_link", {"loop": {"dt": 0.1}, "run": {"start": (0.3, 0.8), "duration": 0.1}}, ""),
        ("xarm7",  # motors that clip what a late law asks for
         {"true": {"object": {"mass": 0.5}, "drives": "ideal"}, "controller": {"limits": "none"},
          "sensor": {"noise": 5e-4, "rate": 60.0, "velocity_filter": 5e-3},
          "loop": {"actuator_delay": 2e-3},
          "run": {"start": "random", "duration": 0.6, "seed": 0}}, "stopped by its guard at 0."),
    ],
)  # fmt: skip
def test_what_kept_it_from_its_target_is_named(robot, parts, reason):
    result = run_scenario(reach(robot, **parts))
    assert not result.converged
    assert reason in result.reason
    assert result.reason
    assert math.isnan(result.settling_time)
    summary = result.summary()
    assert summary["settling_time_s"] is None
    json.dumps(summary, allow_nan=False)


def test_a_target_reached_at_the_very_end_is_no_failure(done):
    """Nor is it a success: it is too late to judge."""
    n = 1 + np.searchsorted(done.run.t, done.settling_time / 0.95)
    names = ("t", "q", "v", "x", "x_measured", "x_d", "error", "tau", "state", "status")
    names += ("limit_status", "slack")
    early = {name: getattr(done.run, name)[:n] for name in names}
    late = dataclasses.replace(done, run=dataclasses.replace(done.run, **early))
    assert late.verdict == "converged late"
    assert not late.failed
    assert not late.converged
    assert late.reason.endswith("too late to judge")


@pytest.mark.parametrize(
    ("shrinks", "learns", "reason"),
    [
        (0.9, True, "still learning: the error shrinks as what lacks is learnt"),
        (0.999, True, "came to rest away from its target"),  # such as against a wall
        (0.9, False, "came to rest away from its target"),
    ],
)
def test_a_slow_learner_is_not_called_blocked(done, shrinks, learns, reason):
    run, n = done.run, len(done.run.t)
    share = np.linspace(0.0, 1.0, n)[:, np.newaxis]
    rest = dataclasses.replace(
        run, q=np.tile(run.q[-1], (n, 1)), v=np.zeros((n, 7)), tau=np.zeros((n, 7)),
        x=np.tile(run.x[-1], (n, 1)), error=0.02 * shrinks ** (4.0 * share) * np.ones(3),
        state=run.state[0] + learns * share * (run.state[-1] - run.state[0]),
    )  # fmt: skip
    assert dataclasses.replace(done, run=rest).reason.startswith(reason)


@pytest.mark.parametrize(
    ("robot", "parts", "warning"),
    [
        ("panda", {"run": {"target": (3.0, 0.0, 0.5)}}, "is out of reach: 3 m from the first"),
        ("panda", {"run": {"target": {"circle": {"radius": 2.0}}}}, "is out of reach: "),
        ("panda", {"run": NEAR}, ""),
        ("two_link", {}, ""),
    ],
)
def test_what_the_believed_arm_cannot_reach_is_named_before_the_run(robot, parts, warning):
    told = build_scenario(reach(robot, **parts)).warning
    assert warning in told
    assert bool(told) == bool(warning)


@pytest.mark.study
def test_joints_that_touched_their_stops_are_reported():
    target = {"start": HOME, "target": (-0.6, 0.0, 0.4), "duration": 4.0}
    unlimited = {"gravity": "exact", "limits": "none"}
    result = run_scenario(reach(controller=unlimited, run=target))
    assert result.summary()["limits"] is None
    low, high = aj.load_robot("panda").position_limits
    beyond = np.maximum(result.run.q - high, low - result.run.q).max()
    assert result.summary()["joint_limit_excess"] == beyond > 0.0
    touched = result.run.at_stops
    name, seconds = max(touched.items(), key=lambda item: item[1])
    assert 0.5 < seconds < 4.0
    assert result.summary()["at_joint_stops_s"] == touched
    assert f"{name} for {seconds:.3g} s" in report.text(result)
    assert f"up to {beyond:.2g} beyond" in report.text(result)
    assert f"{name} for " in str(result.run)


@pytest.mark.parametrize(
    ("parts", "text"),
    [
        ({"run": {"target": {"at": (0.4, 0, 0.4), "offset": (0.1, 0, 0)}}}, "not both be given"),
        ({"run": {"target": (0.4, 0.0)}}, r"target must have shape \(3,\)"),
        ({"run": {"start": (0.0, 0.0)}}, r"run.start must be 7 numbers"),
        ({"run": {"start": (5.0,) * 7}}, "run.start must be within the joint limits, got 5 for pa"),
        ({"run": {"duration": 1e-4}}, "run.duration must be a finite number >= loop.dt = 0.002"),
        ({"believed": {"camera": {"roll": 0.5}}}, "believed.camera is for task.kind image"),
        ({"task": {"kind": "pose", "axes": "xyz"}}, "task.axes are those of a position"),
        (
            {"sensor": {"delay": 20.0}},
            r"sensor.delay must be shorter than the run, 20 \[s\], got 20",
        ),
        ({"loop": {"dt": "continuous"}, "sensor": {"noise": 0.1}}, "sensor needs a loop.dt in s"),
        ({"true": {"object": {"length": 200.0}}}, r"^true.object.length must be at most 10 \[m"),
        ({"true": {"object": {"mass": 500.0}}}, "that its motors can hold"),
        ({"true": {"floor": 0.0}}, "true.floor needs true.engine mujoco"),
        ({"believed": {"shifts": {"elbow": (0.1, 0.0, 0.0)}}}, "joint 'elbow' not in panda"),
        ({"task": {"axes": "xw"}}, "axis 'w' not in axes"),
        ({"sensor": {"dropout": 2.0}}, "sensor.dropout must be a probability"),
    ],
)
def test_what_does_not_fit_is_refused(parts, text):
    with pytest.raises(aj.errors.ApproxJacError, match=text) as caught:
        build_scenario(reach(**parts))
    assert "\n" not in str(caught.value)


# -- limits -----------------------------------------------------------------------------

LIMITED = {"limits": 0.7, "gravity": "exact", "settling_time": 0.4}


@pytest.fixture(scope="module")
def limited():
    return run_scenario(reach(controller=LIMITED, run={**FAR, "duration": 1.0}))


def test_the_law_is_wrapped_and_the_motors_saturate_at_the_same_limits():
    built = build_scenario(reach(controller={"limits": 0.5}))
    panda = aj.load_robot("panda")
    assert type(built.controller) is aj.TorqueLimited
    assert built.controller.controller is built.law
    assert np.array_equal(built.limits.effort, 0.5 * panda.effort_limits)
    assert np.array_equal(built.plant.torque_limits, 0.5 * panda.effort_limits)
    assert np.array_equal(built.limits.velocity, panda.velocity_limits)
    whole = build_scenario(reach(controller={"limits": "urdf"}))
    assert np.array_equal(whole.plant.torque_limits, panda.effort_limits)


def test_what_limits_did_is_told(limited):
    summary = limited.summary()
    limits = summary["limits"]
    assert sum(limits["status_counts"].values()) == len(limited.run.t) == 501
    assert limits["status_counts"]["PROOF_GIVEN_UP"] > 0
    assert limits["largest_slack_W"] == np.nanmax(limited.run.slack) > 0.0
    assert limits["largest_torque_violation"] <= 1e-9
    panda = aj.load_robot("panda")
    speeds = np.abs(limited.run.v) / panda.velocity_limits
    assert limits["peak_speed_ratio"] == speeds.max()
    slow = dataclasses.replace(limited.built.limits, velocity=0.5 * panda.velocity_limits)
    built = dataclasses.replace(limited.built, limits=slow)
    of_slow = dataclasses.replace(limited, built=built).summary()["limits"]
    assert of_slow["peak_speed_ratio"] == pytest.approx(2.0 * speeds.max())
    assert summary["peak_torque_ratio"] == pytest.approx(1.0)
    axes = {ax.get_title(): ax for ax in report.draw(limited).axes}
    assert len(axes) == 4
    torque = axes["Torque of each joint"].get_lines()[2].get_ydata()  # after the limits
    assert torque == pytest.approx(limited.run.tau[:, 0] / (0.7 * 87.0))


@pytest.mark.parametrize("side", [-1.0, 1.0])
@pytest.mark.parametrize("joint", [0, 4])
def test_what_a_run_did_at_most_is_told_of_every_joint_to_both_sides(limited, side, joint):
    """At some instant within the run: torques, speeds, and how far it went beyond its stops."""
    arm, own = aj.load_robot("panda"), dataclasses.replace
    stop = arm.position_limits[int(side > 0.0)][joint]
    middle = len(limited.run.t) // 2

    def told(**changes):
        columns = {name: np.zeros_like(getattr(limited.run, name)) for name in ("tau", "v")}
        columns["q"] = np.tile(HOME, (len(limited.run.t), 1))
        for name, value in changes.items():
            columns[name][middle, joint] = value
        return own(limited, run=own(limited.run, **columns)).summary()

    effort, speed = limited.built.limits.effort[joint], arm.velocity_limits[joint]
    found = told(tau=1.3 * side * effort, v=0.4 * side * speed, q=stop + 0.02 * side)
    assert found["peak_torque_ratio"] == pytest.approx(1.3)
    assert found["limits"]["largest_torque_violation"] == pytest.approx(0.3 * effort)
    assert found["limits"]["peak_speed_ratio"] == pytest.approx(0.4)
    assert found["joint_limit_excess"] == pytest.approx(0.02)
    within = told()
    assert within["joint_limit_excess"] == within["limits"]["largest_torque_violation"] == 0.0


def final(done, status, **changes):
    """Why a run does not converge whose end is as given."""
    n = len(done.run.t)
    still = {"v": np.zeros((n, 7)), "tau": np.zeros((n, 7)), "x": np.tile(done.run.x[-1], (n, 1))}
    still |= {"error": np.full((n, 3), 0.1), "q": np.tile(done.run.q[0], (n, 1))}
    still |= {"limit_status": np.full(n, int(status)), "status": np.zeros(n, dtype=int)}
    return dataclasses.replace(
        done, run=dataclasses.replace(done.run, **{**still, **changes})
    ).reason


def test_reasons_tell_what_limits_did(limited):
    n, status = len(limited.run.t), aj.LimitStatus
    assert final(limited, status.FREE).startswith("came to rest away from its target: out of reach")
    assert final(limited, status.LIMITED) == f"held back: {status.LIMITED.message}"
    q = limited.run.q[0].copy()
    q[1] = aj.load_robot("panda").position_limits[1][1]
    reason = final(limited, status.PROOF_GIVEN_UP, q=np.tile(q, (n, 1)))
    at = "the position limits of panda_joint2"
    assert reason == f"held back at {at}: {status.PROOF_GIVEN_UP.message}"


def test_a_robot_without_limits_keeps_none_and_has_no_share_of_them():
    built = build_scenario(reach("two_link"))
    assert built.limits is None
    assert built.controller is built.law
    with pytest.raises(aj.InvalidInputError, match=r"that of two_link has none, got 0\.5"):
        build_scenario(reach("two_link", controller={"limits": 0.5}))


def test_speeds_and_positions_are_kept_without_efforts(tmp_path):
    path, urdf = tmp_path / "arm.urdf", aj.load_robot("panda").urdf
    path.write_text(re.sub('effort="[^"]*"', 'effort="0"', urdf), encoding="utf-8")
    far = {**FAR, "duration": 0.3}
    built = build_scenario(Scenario(str(path), tip="panda_hand_tcp", run=far))
    assert not np.isfinite(built.limits.effort).any()
    assert_allclose(built.limits.velocity, aj.load_robot("panda").velocity_limits)
    assert_allclose(built.limits.position, aj.load_robot("panda").position_limits)
    slow = dataclasses.replace(built.limits, velocity=0.1 * np.asarray(built.limits.velocity))
    controller = aj.TorqueLimited(built.law, slow)
    run = aj.simulate(built.plant, controller, built.target, built.q0, 0.1, dt=1e-3)
    assert 0.9 < (np.abs(run.v) / slow.velocity).max() <= 1.05


def test_limits_are_kept_unless_told_otherwise():
    assert type(build_scenario(reach()).controller) is aj.TorqueLimited
    unlimited = build_scenario(reach(controller={"limits": "none"}))
    assert unlimited.controller is unlimited.law
    assert build_scenario(reach(loop={"dt": "continuous"})).limits is None


def test_a_slack_that_is_not_known_is_none(limited):
    unknown = dataclasses.replace(limited.run, slack=np.full(len(limited.run.t), np.nan))
    summary = dataclasses.replace(limited, run=unknown).summary()
    assert summary["limits"]["largest_slack_W"] is None
    json.dumps(summary, allow_nan=False)


# -- paths ------------------------------------------------------------------------------

PATHS = {
    "circle": {"radius": 0.1, "period": 4.0},
    "line": {"offset": (0.1, 0.0, 0.1), "duration": 1.0},
    "waypoints": {"points": (0.5, 0.0, 0.4, 0.5, 0.1, 0.4)},
}


def following(path, duration, **parts):
    goal = {"start": HOME, "target": {path: PATHS[path]}, "duration": duration}
    return build_scenario(reach(run=goal, **parts))


@pytest.mark.parametrize(
    ("path", "half", "leads"),
    [
        ("circle", {"center": (0.4, 0.0, 0.4)}, "radius"),
        ("line", {"duration": 1.0}, "offset"),
        ("waypoints", {"speed": 0.1}, "points"),
    ],
)
def test_half_a_path_is_refused(path, half, leads):
    with pytest.raises(aj.InvalidInputError, match=rf"run\.target\.{path} must have its {leads}"):
        build_scenario(reach(run={"start": HOME, "target": {path: half}}))


@pytest.mark.parametrize("path", PATHS)
def test_a_path_begins_where_the_task_starts_and_is_followed(path):
    built = following(path, 1.2)
    assert_allclose(built.target.at(0.0).x, built.plant.sensor.value(built.q0), atol=1e-12)
    result = run_scenario(built)
    assert not (result.run.x_d == result.run.x_d[0]).all()
    away = np.linalg.norm(result.run.x_d - result.run.x_d[0], axis=1).max()
    assert result.tolerance == pytest.approx(0.05 * away)
    assert result.run.error_norm.max() > 1e-3  # at rest it would not be done
    assert (result.verdict, result.reason) == ("followed", "")
    summary = result.summary()
    assert summary["largest_error_m"] == result.run.error_norm.max()
    assert 0.0 < summary["rms_error_m"] < summary["largest_error_m"]
    last = result.run.error_norm[-(len(result.run.t) // 4) :]
    assert summary["last_quarter_rms_error_m"] == pytest.approx(np.sqrt(np.mean(last**2)))
    told = report.text(result)
    assert "\nerror " not in told  # which begins with 0: the path begins where the arm is
    strayed = f"up to {1e3 * summary['largest_error_m']:.3g} mm from the path, "
    assert told.startswith(f"followed\n{strayed}")
    assert "the target was moved" not in told


@pytest.mark.parametrize(
    ("duration", "parts", "reason"),
    [
        pytest.param(
            4.0,
            {"controller": {"gravity": "none", "limits": "none"}},
            "stands at the joint stops of",
            marks=pytest.mark.study,
        ),
        (0.5, {"sensor": {"dropout": 1.0}}, "the measurement of x is lost"),
        (
            1.0,
            {"controller": {"gravity": "exact", "kp": 1.0, "kv": 1.0, "damping": 0.1}},
            " m is following it",
        ),
    ],
)
def test_what_kept_it_from_following_is_named(duration, parts, reason):
    result = run_scenario(following("circle", duration, **parts))
    assert result.verdict == "not followed"
    assert reason in result.reason
    assert report.text(result).startswith("not followed: ")


@pytest.mark.study
def test_a_path_is_followed_as_closely_as_wanted_and_only_within_reach():
    near = run_scenario(following("circle", 2.0, controller={"gravity": "exact"}))
    for tolerance, verdict in ((0.01, "followed"), (0.001, "not followed")):
        wanted = near.built.scenario.with_values({"run": {"tolerance": tolerance}})
        built = dataclasses.replace(near.built, scenario=wanted)
        assert dataclasses.replace(near, built=built).verdict == verdict
    away = {"line": {"offset": (1.0, 0.0, 0.1), "duration": 0.5}}
    far = run_scenario(reach(run={"start": HOME, "target": away, "duration": 1.0}))
    assert far.reason.startswith("out of reach: 1.43 m from the first joint")


LEARNS = {
    "true": {
        "object": {"length": 0.2, "mass": 0.5, "axis": "x"},
        "tracker": {"rotation": (0.0, 0.0, 1.7), "offset": (0.1, -0.05, 0.05)},
    },
    "sensor": {"noise": 1e-3, "rate": 60.0, "delay": 0.03},
    "run": {"start": HOME, "target": {"circle": {"radius": 0.08}}, "duration": 4.0},
}
PARTS = ("tool", "origins", "camera")


@pytest.mark.study
@pytest.mark.usefixtures("blank_pictures")
@pytest.mark.parametrize(
    "controller",
    [
        pytest.param(  # as the example of docs/learning_kinematics.md
            {"law": "tracking", "unknown": PARTS}, id="tracking law", marks=pytest.mark.long
        ),
        pytest.param({"unknown": PARTS}, id="set-point law"),
        pytest.param(  # as in test_velocity_servo.py, and in test_tracking.py
            {"law": "tracking", "unknown": PARTS, "command": "velocity"},
            id="velocities",
            marks=pytest.mark.long,
        ),
    ],
)
def test_kinematics_that_are_learnt_follow_a_circle(tmp_path, controller):
    """A tool and a tracker turned by 97° that nobody told of; and what was learnt is written."""
    result = run_scenario(Scenario("panda", controller=controller, **LEARNS))
    last = result.run.error_norm[result.run.t > 3.0]
    assert np.sqrt(np.mean(last**2)) < 5e-3
    assert not result.failed
    report.write(result, tmp_path)
    summary = json.loads((tmp_path / "summary.json").read_text(encoding="utf-8"))
    assert abs(summary["kinematics"]["camera.rz"]["value"] - 1.7) < 0.05
    assert "camera turned by 1.7" in (tmp_path / "kinematics.txt").read_text(encoding="utf-8")
    told = " ".join(report.text(result).split())
    assert "kinematics tool at " in told
    assert " per degree of freedom: kinematics.txt" in told
    assert len(report.draw(result).axes) == 3  # nothing was limited: there is no such panel
    again = Scenario.load(tmp_path / "scenario.toml")
    assert again == result.built.scenario
    with pytest.raises(InvalidInputError, match="unknown must be left out of a report"):
        prepare(again)


def test_a_path_that_is_left_by_an_eighth_of_its_size_is_not_followed():
    """5 mm beside a circle of 4 cm is within a tolerance of half of it, and no good."""
    near = run_scenario(following("circle", 1.0, controller={"gravity": "exact"}))
    size = np.linalg.norm(near.run.x_d - near.run.x_d[0], axis=1).max()
    for beside, verdict in ((0.125, "not followed"), (0.04, "followed")):
        error = np.zeros_like(near.run.error)
        error[:, 0] = beside * size
        result = dataclasses.replace(near, run=dataclasses.replace(near.run, error=error))
        assert result.verdict == verdict


def test_what_does_not_explain_an_image_is_said_to_be_its_center_or_distortion(panda):
    camera = aj.PinholeCamera.looking_at(
        (0.45, 0.0, 0.4), (1.5, -0.8, 0.9), focal_length=600.0, size=(640, 480)
    )
    kinematics = aj.controllers.AdaptiveCamera(aj.ImageTask(panda, camera))
    q = np.array(HOME)
    state = kinematics.initial_state(aj.Measurement(0.0, q, 0.0 * q, kinematics.task.value(q)))
    learnt = kinematics.report(state)._replace(chi_squared=5.3, angle=2.0, seconds=3.0)
    assert "do not explain x: others are (of a camera\nalso center and lens)" in str(learnt)


@pytest.mark.study
def test_a_pose_is_learnt_from_a_tracker():
    """The tool's orientation with its position, and one rotation of the tracker for both."""
    target = {"offset": (0.05, -0.1, 0.1, 0.2, 0.0, 0.3)}
    result = run_scenario(
        Scenario(
            "panda",
            **LEARNS | {"run": {"start": HOME, "target": target, "duration": 2.2}},
            task={"kind": "pose"},
            loop={"dt": 2e-3},
            controller={"law": "tracking", "unknown": PARTS},
        )
    )
    assert np.linalg.norm(result.run.error[result.run.t > 2.0], axis=1).max() < 5e-3
    learnt = result.summary()["kinematics"]
    assert learnt["camera.rz"]["value"] == pytest.approx(1.7, abs=0.05)
    assert abs(learnt["tool.rx"]["value"]) < 0.05


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"controller": {"law": "tracking", "kp": (9.0,)}}, "controller.kp is of the law setpoint"),
        ({"controller": {"command": "velocity"}}, "needs controller.law tracking, got velocity"),
        ({"controller": {"law": "tracking", "gravity": "exact"}}, "gravity must be learnt or"),
        ({"controller": {"unknown": ("tool",), "unseen": 0.1}}, "unseen is of no use where x is"),
        ({"controller": {"unknown": ("tol",)}}, "unknown must be one or more of"),
        ({"controller": {"unknown": ("offset",)}, "task": {"kind": "image"}}, "origins, axes, c"),
        ({"true": {"servo": {"lag": 0.1}}}, "true.servo needs controller.command velocity"),
        ({"true": {"tracker": {"offset": (1, 0, 0)}}, "task": {"axes": "xz"}}, "must be xyz with"),
        ({"true": {"tracker": {"offset": (1, 0, 0)}}, "task": {"kind": "stacked"}}, "is for task."),
    ],
)  # fmt: skip
def test_what_does_nothing_for_a_law_is_refused(changes, message):
    with pytest.raises(InvalidInputError, match=message):
        build_scenario(Scenario("panda", **changes))


def test_the_target_is_drawn_where_the_tracker_means_it(panda):
    """In the world, not in the tracker's axes; nothing of an image."""
    tracker = TrackerTask(panda, (0.0, 0.1, 1.7), (0.1, -0.05, 0.05))
    q = np.array(HOME)
    place = aj.PositionTask(panda).value(q)
    for sensor in (aj.PositionTask(panda), tracker, aj.PoseTask(panda)):
        assert_allclose(place_of(sensor, sensor.value(q)), place, atol=1e-12)
    for sensor in (aj.PositionTask(panda, axes="xz"), aj.ImageTask(panda, PlanarCamera(0.05, 3.0))):
        assert place_of(sensor, sensor.value(q)) is None


def test_a_target_that_only_the_true_arm_cannot_reach_is_told_before_the_run():
    far = {"run": {"start": HOME, "target": (1.1, 0.0, 0.4), "duration": 0.01}}
    short = {"true": {"object": {"length": 0.0}}, "believed": {"object": {"length": 0.6}}}
    told = build_scenario(Scenario("panda", **far, **short)).warning
    assert told.startswith("for the true arm the target is out of reach: ")
    long = {"true": {"object": {"length": 0.6}}, "believed": {"object": {"length": 0.6}}}
    assert build_scenario(Scenario("panda", **far, **long)).warning == ""


def test_configurations_are_told_as_angles():
    """Of an arm with continuous joints one number a joint, and no cosines and sines."""
    q = [0.1, 2.9, 1.3, -4.0, 1.4, 0.2]
    scenario = Scenario("kinova", run={"start": q, "target": {"offset": (0.0, 0.0, 0.01)}})
    result = run_scenario(scenario.with_values({"run": {"duration": 0.01}}))
    told = next(
        line for line in report.text(result).splitlines() if line.startswith("  q at start")
    )
    assert told.endswith(" rad")
    wrapped = np.remainder(np.array(q) + np.pi, 2.0 * np.pi) - np.pi
    angles = np.array([float(word) for word in told.split()[3:-1]])
    np.testing.assert_allclose(np.cos(angles - wrapped), 1.0, atol=1e-6)
    assert len(result.summary()["q_start"]) == len(result.summary()["q_end"]) == len(q)


@pytest.mark.parametrize("offset", [(0.0, 0.0, 0.0), (0.05, 0.0, 0.0)])
def test_a_run_that_never_began_has_no_verdict(offset):
    """As with --view and Ctrl-C before the page is opened; neither at its target nor away from."""
    run = {"start": HOME, "target": {"offset": offset}, "duration": 1.0}
    result = run_scenario(reach(run=run), observer=lambda loop: loop.stop())
    assert result.run.t[-1] == 0.0
    assert report.text(result).startswith("stopped after 0 s: nothing was simulated")
    assert result.failed
    assert result.summary()["verdict"] == "stopped after 0 s"
