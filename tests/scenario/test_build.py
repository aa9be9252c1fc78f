"""What a scenario says is what is built of it, key by key: plant, law and study."""

from dataclasses import replace

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.controllers import Latency, tuned
from approxjac.robots import Drives
from approxjac.scenario import Scenario, build_scenario, run_scenario
from approxjac.scenario.judge import prepare
from approxjac.scenario.starts import regular_configuration
from approxjac.tasks import FrameKinematics

LATE = {"loop": {"dt": 4e-3, "actuator_delay": 8e-3}}
SEEN = {"rate": 50.0, "delay": 0.03, "velocity_filter": 3e-3}
AROUND = (0.5, 1.2)
UR5 = (0.0, -1.2, 1.4, -1.0, -1.5, 0.0)


# -- the plant --------------------------------------------------------------------------


def test_each_error_of_a_sensor_is_that_of_the_plant():
    of_x = {"noise": 1e-3, "quantum": 2e-4, "delay": 0.02, "dropout": 0.1, "rate": 50.0}
    of_q = {"q_noise": 1e-5, "q_quantum": 3e-5, "velocity_filter": 4e-3}
    times = {"lost": (0.2, 0.4), "frozen": (0.5, 0.7)}
    given = {**of_x, **of_q, **times}
    plant = build_scenario(Scenario("two_link", sensor=given, run={"duration": 1.0})).plant
    expected = aj.Sensing(
        **{f"x_{name}": value for name, value in of_x.items()}, **of_q, x_lost=((0.2, 0.4),),
        x_frozen=((0.5, 0.7),),
    )  # fmt: skip
    assert vars(plant.sensing) == vars(expected)


def test_friction_delay_and_servo_are_those_of_the_plant():
    plant = build_scenario(
        Scenario("two_link", true={"friction": 0.3, "coulomb": 0.2}, **LATE)
    ).plant
    assert_array_equal(plant.friction, [0.3] * 2)
    assert_array_equal(plant.coulomb, [0.2] * 2)
    assert plant.actuator_delay == 8e-3
    assert plant.servo is None
    control = {"law": "tracking", "command": "velocity"}
    moved = Scenario("two_link", true={"servo": {"lag": 0.02}}, controller=control, **LATE)
    plant = build_scenario(moved).plant
    assert plant.servo == aj.simulation.VelocityServo(lag=0.02)
    assert plant.actuator_delay == 8e-3


@pytest.mark.parametrize(
    ("sensor", "compensates"),
    [({}, True), ({"q_noise": 1e-5}, True), ({"rate": 50.0}, False), ({"delay": 0.01}, False)],
)
def test_friction_is_compensated_where_x_is_as_recent_as_q(sensor, compensates):
    law = build_scenario(Scenario("two_link", sensor=sensor)).law
    assert (law.friction is not None) == compensates


@pytest.mark.parametrize(("given", "f"), [({}, 0.05), ({"focal_length": 0.08}, 0.08)])
def test_a_planar_camera_is_believed_with_the_errors_that_are_said(given, f):
    """About the true one: it is rolled by itself."""
    built = build_scenario(Scenario(
        "two_link", task={"kind": "image"},
        true={"camera": {"kind": "planar", "distance": 2.5, "roll": 0.2, **given}},
        believed={"camera": {"roll": 0.3, "focal_factor": 1.5, "depth_factor": 1.2}},
    ))  # fmt: skip
    for task, camera in (
        (built.plant.sensor, PlanarCamera(f, 2.5, 0.2)),
        (built.law.task, PlanarCamera(1.5 * f, 3.0, 0.5)),
    ):
        found = {name: value for name, (value, _) in task.camera.calibration.items()}
        expected = {name: value for name, (value, _) in camera.calibration.items()}
        assert found == pytest.approx(expected)


@pytest.mark.parametrize(("distance", "said"), [(2.5, 0.0), (0.9, 0.0), (0.9, 4e-5)])
def test_where_a_planar_camera_has_no_noise_places_are_known_to_a_tenth_of_a_mm(distance, said):
    """Of what the arm is learnt from; or as its noise says, by the magnification f/(z - f)."""
    built = build_scenario(Scenario(
        "two_link", task={"kind": "image"}, sensor={"noise": said},
        true={"camera": {"kind": "planar", "distance": distance}},
        controller={"unknown": ["tool"], "law": "tracking"},
    ))  # fmt: skip
    magnification = 0.05 / (distance - 0.05)
    assert built.controller.kinematics.noise == pytest.approx(max(1e-4, said / magnification))


def test_a_tracker_measures_in_the_axes_that_are_said():
    """x = R p + b; the controller does not know of it."""
    turned, offset = np.array([0.2, -0.4, 1.0]), np.array([0.1, -0.05, 0.05])
    tracker = {"tracker": {"rotation": tuple(turned), "offset": tuple(offset)}}
    for kind, plain in (("position", aj.PositionTask), ("pose", aj.PoseTask)):
        goal = {"start": UR5, "target": {"configuration": UR5}}
        built = build_scenario(Scenario("ur5", true=tracker, task={"kind": kind}, run=goal))
        robot, q = built.plant.robot, np.array([0.1, -1.2, 1.1, -0.8, -1.4, 0.3])
        R, p = pin.exp3(turned), FrameKinematics(robot, robot.tip).placement(q)
        x = built.plant.sensor.value(q)
        assert_allclose(x[:3], R @ p[1] + offset, atol=1e-12)
        if kind == "pose":
            assert_allclose(pin.Quaternion(x[3:]).matrix(), R @ p[0], atol=1e-9)
        assert type(built.law.task) is plain


def test_noise_and_dropouts_are_of_the_seed():
    """Without any a run is the same, whatever its seed is."""

    def run(seed, **sensor):
        goal = {"start": (0.3, 0.8), "target": {"offset": (0.1, 0.0)}, "duration": 0.02}
        return run_scenario(Scenario("two_link", sensor=sensor, run=goal | {"seed": seed})).run

    for errors in ({"noise": 1e-3}, {"dropout": 0.3}, {"q_noise": 1e-3}, {}):
        one, other = (run(seed, **errors) for seed in (3, 4))
        for name in ("x_measured", "tau"):
            pair = getattr(one, name), getattr(other, name)
            assert np.array_equal(*pair, equal_nan=True) == (not errors)


def target(**goal):
    built = build_scenario(Scenario("two_link", run={"target": goal, "duration": 8.0}))
    return built.target, built.plant.sensor.value(built.q0)


def test_a_target_and_a_path_are_where_they_are_said_to_be():
    """A path takes the time, or has the speed, that is said."""
    away = np.array([0.05, -0.1])
    found, start = target(offset=tuple(away))
    assert_allclose(found, start + away)
    assert_allclose(target(at=(0.9, 0.8))[0], [0.9, 0.8])
    line, start = target(line={"offset": tuple(away), "duration": 3.0})
    for t, share in ((0.0, 0.0), (1.5, 0.5), (3.0, 1.0), (9.0, 1.0)):
        assert_allclose(line.at(t).x, start + share * away, atol=1e-12)
    circle, start = target(circle={"radius": 0.07, "period": 5.0})
    around = np.array([circle.at(t).x for t in np.linspace(0.0, 5.0, 41)])
    assert_allclose(around[[0, -1]], [start, start], atol=1e-12)
    middle = 0.5 * (around[0] + around[20])
    assert_allclose(np.linalg.norm(around - middle, axis=1), 0.07)
    center = tuple(start + [0.1, 0.0])
    circle, _ = target(circle={"radius": 0.07, "center": center})
    assert_allclose(0.5 * (circle.at(0.0).x + circle.at(2.0).x), center, atol=1e-12)  # half of 4 s
    points = np.array([start + away, start + away + [0.0, 0.1]])
    given = {"points": tuple(points.ravel()), "speed": 0.1, "acceleration": 0.4}
    way, _ = target(waypoints=given)
    t = np.linspace(0.0, way.duration, 1001)
    x = np.array([way.at(each).x for each in t])
    for point in (start, *points):
        assert np.linalg.norm(x - point, axis=1).min() < 1e-4
    speed = np.linalg.norm(np.diff(x, axis=0), axis=1) / t[1]
    assert speed.max() == pytest.approx(0.1, rel=1e-3)
    assert np.diff(speed).max() / t[1] == pytest.approx(0.4, rel=1e-2)


# -- the law ----------------------------------------------------------------------------


@pytest.mark.parametrize("swapped", [False, True])
@pytest.mark.parametrize("name", ["panda", "ur5"])
def test_neither_arm_is_near_singular_where_a_random_run_begins(name, swapped):
    """Of which the true one holds a long tool that is not believed, or the other way round."""
    lengths = (0.0, 0.4) if swapped else (0.4, 0.0)
    true, believed = (aj.PositionTask(aj.load_robot(name).with_object(each)) for each in lengths)
    for seed in range(40):
        q = regular_configuration(true, believed, np.random.default_rng(seed))
        for task in (true, believed):
            values = np.linalg.svd(task.jacobian(q), compute_uv=False)
            assert values[-1] > 0.1 * values[0]


def test_the_law_is_tuned_for_the_loop_that_it_runs_in():
    def law(**parts):
        return build_scenario(Scenario("two_link").with_values(parts)).law

    own, usual = law(sensor=SEEN, **LATE), law()
    late = Latency(4e-3, 8e-3, velocity_filter=3e-3, image_period=0.02, image_age=0.03)
    assert own.latency == late
    expected = tuned(own.task, late, drives=Drives()).gains.diagonals(2, 2)
    for found, wanted in zip(own.diagonals, expected, strict=True):
        assert_allclose(found, wanted)
    assert (own.diagonals.kp < 0.9 * usual.diagonals.kp).all()
    slow = law(controller={"settling_time": 3.0})
    assert_allclose(slow.diagonals.kp, tuned(slow.task, settling_time=3.0).gains.kp)
    # gains that are given stand beside those of the rule for this loop
    part = law(sensor=SEEN, **LATE, controller={"kp": 5.0})
    assert_array_equal(part.diagonals.kp, [5.0] * 2)
    assert_allclose(part.diagonals.kv, own.diagonals.kv)
    assert_allclose(part.diagonals.damping, own.diagonals.damping)


@pytest.mark.parametrize("law", ["tracking", "setpoint"])
def test_frames_are_outside_of_a_loop_that_learns_its_kinematics(law):
    """What is learnt from late frames predicts: the law itself is not late by them."""
    control = {"law": law, "unknown": ("tool",)}
    sensor = SEEN | {"noise": 2e-3}
    built = build_scenario(Scenario("two_link", sensor=sensor, **LATE, controller=control))
    kinematics = built.law.kinematics if law == "tracking" else built.controller.kinematics
    assert kinematics.delay == 0.03
    assert_array_equal(np.unique(kinematics.noise), [2e-3])
    if law == "setpoint":
        assert built.law.latency == Latency(4e-3, 8e-3, velocity_filter=3e-3)


@pytest.mark.parametrize("integral", [None, False, True])
@pytest.mark.parametrize("gravity", ["learnt", "exact", "believed", "none", "learn_residual"])
def test_gravity_is_compensated_as_it_is_said(gravity, integral, rng):
    """At the start, and what is learnt from there on."""
    true = {"object": {"length": 0.3, "mass": 1.0, "axis": "x"}}
    control = {"gravity": gravity, "integral_action": integral}
    built = build_scenario(
        Scenario("two_link", true=true, believed={"object": {"mass": 0.2}}, controller=control)
    )
    of = {"exact": built.plant.robot, "learnt": built.law.task.robot}
    of["believed"] = of["learnt"]
    law, still = built.law, np.zeros(2)
    for q in rng.uniform(-2.0, 2.0, (3, 2)):
        state = law.initial_state(aj.Measurement(0.0, q, still, built.plant.sensor.value(q)))
        expected = aj.robots.Dynamics(of[gravity]).g(q) if gravity in of else still
        assert_allclose(law.gravity_torque(state, q), expected, atol=1e-9)
    learns = gravity in ("learnt", "learn_residual")
    assert (law.adaptation is not None) == (learns or integral is True)
    if law.adaptation is not None:
        of_links, *integrals = np.split(law.adaptation.L, np.cumsum(law.adaptation.sizes)[:-1])
        assert bool((of_links > 0.0).any()) == learns
        assert all(bool((part > 0.0).any()) == (integral is not False) for part in integrals)
    assert (built.plant.adds_gravity is not None) == (gravity == "learn_residual")


def test_saturation_and_differentiator_are_those_that_are_said():
    law = build_scenario(Scenario("ur3", controller={"gamma": 0.07})).law
    assert_allclose(law.saturation.s(np.full(3, 9.0)), 0.07)
    five = Scenario("two_link", controller={"differentiator": 0.06})
    assert build_scenario(five).law.velocity.time_constant == 0.06


def test_limits_are_the_share_that_is_said():
    control = {"limits": 0.6}
    built, arm = build_scenario(Scenario("ur3", controller=control)), aj.load_robot("ur3")
    limits = built.limits
    assert_allclose(limits.effort, 0.6 * arm.effort_limits)
    assert_allclose(built.plant.motor_limits, limits.effort)
    assert_array_equal(limits.velocity, arm.velocity_limits)
    alone = build_scenario(Scenario("ur3", controller=control), effort_only=True).limits
    assert_allclose(alone.effort, limits.effort)
    assert not np.isfinite(alone.velocity).any()


# -- the study --------------------------------------------------------------------------


def studied(**parts):
    analysis = {"object_length": (0.0, 0.2), "object_mass": (0.1, 1.0), "around": AROUND}
    scenario = Scenario(
        "two_link", true={"friction": 0.7, "object": {"length": 0.0, "mass": 0.0, "axis": "z"}},
        believed={"object": {"length": 0.1, "mass": 0.3}}, sensor=SEEN, **LATE,
        run={"duration": 1.501, "seed": 7}, stability=analysis | {"radius": 0.07},
        controller={"gravity": "believed"},
    )  # fmt: skip
    return prepare(scenario.with_values(parts))


@pytest.fixture(scope="module")
def study():
    return studied()


def test_a_study_is_of_the_robots_that_may_be_true(study):
    errors, arm = study.uncertainty, aj.load_robot("two_link")
    assert errors.belief() == arm.with_object(0.1, 0.3, axis="z")
    assert study.controller.law.task.robot == errors.belief()
    for values in ([0.0, 0.1], [0.2, 1.0]):
        plant = errors.plant(values)
        assert plant.robot == arm.with_object(*values, axis="z")
        assert_array_equal(plant.friction, [0.7] * 2)
    exact = studied(controller={"gravity": "exact"})  # which is then not felt
    assert not exact.uncertainty.plant([0.2, 1.0]).robot.gravity.any()


def test_a_study_is_about_the_arm_that_is_believed_wrong():
    shifts, rotations = {"joint2": (0.01, 0.0, 0.02)}, {"joint1": (0.0, 0.1, 0.0)}
    for wrong in ({"shifts": shifts}, {"rotations": rotations}):
        own = studied(believed=wrong)
        arm = aj.load_robot("two_link").with_kinematic_error(**wrong)
        assert own.uncertainty.belief() == arm.with_object(0.1, 0.3, axis="z")
        assert own.controller.law.task.robot == own.uncertainty.belief()


def test_a_study_is_of_the_loop_that_runs(study):
    late = Latency(4e-3, 8e-3, velocity_filter=3e-3, image_period=0.02, image_age=0.03)
    assert study.latency == study.controller.law.latency == late
    assert study.seed == 7
    assert study.duration == pytest.approx(375 * 4e-3)  # whole periods
    assert (study.sensing.x_rate, study.sensing.x_delay) == (50.0, 0.03)
    # and so are its rollouts, also where nobody says what the sensors are like
    for sensing in (study.sensing, None):
        setting = replace(study, sensing=sensing).setting()
        assert setting.sensing.x_rate == pytest.approx(50.0)
        assert (setting.sensing.x_delay, setting.sensing.velocity_filter) == (0.03, 3e-3)
        assert (setting.dt, setting.actuator_delay, setting.seed) == (4e-3, 8e-3, 7)


def test_a_study_looks_where_it_is_said(study):
    for joint in range(2):
        for side in (-1.0, 1.0):
            unit = side * np.eye(2)[joint]
            assert study.region.contains(AROUND + 0.0699 * unit)
            assert not study.region.contains(AROUND + 0.0701 * unit)
    assert study.target is None
    target = study.controller.law.task.value(np.array(AROUND))
    other = studied(stability={"target": tuple(target), "sigma_min": 0.123})
    assert_allclose(other.target, target)
    assert other.region.sigma_min == 0.123
    assert other.region.task.robot == study.controller.law.task.robot
