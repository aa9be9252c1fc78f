"""The linearisation of Eq. (9)."""

import functools
import math
import re

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.cameras import PlanarCamera
from approxjac.controllers import RegressorGravity
from approxjac.law import Sine
from approxjac.robots import GravityRegressor
from approxjac.stability.loop import linearization as targets_module


def linearized_by_differences(plant, controller, q_target):
    """The closed loop's flow in tangent coordinates, differentiated numerically."""
    n, model = plant.robot.nv, plant.robot.model
    target = plant.sensor.value(q_target)

    def flow(z):
        q, v = pin.integrate(model, q_target, z[:n]), z[n:]
        answer = controller.evaluate(np.zeros(0), plant.measure(0.0, q, v), target)
        return np.concatenate([v, plant.acceleration(q, v, answer.torque)])

    h = 1e-5
    return np.array([(flow(h * u) - flow(-h * u)) / (2 * h) for u in np.eye(2 * n)]).T


@pytest.mark.parametrize("name", ["two_link", "ur5", "panda", "kinova"])
def test_eigenvalues_are_those_of_the_flow(name, rng):
    arm = aj.load_robot(name)
    truth, belief = arm.with_object(0.2), arm.with_object(0.05, axis="x")  # massless: g is exact
    axes = "xz" if arm.nv == 2 else "xyz"
    plant = aj.Plant(truth, aj.PositionTask(truth, axes=axes), friction=0.3)
    controller = aj.SetpointController(
        aj.PositionTask(belief, axes=axes), aj.Gains(60.0, 30.0, damping=1.0),
        saturation=Sine(0.1),
    )  # fmt: skip
    q = truth.random_configuration(rng)
    local = aj.local_stability(plant, controller, q)
    redundancy = arm.nv - len(axes)
    assert local.eigenvalues.shape == (2 * arm.nv - redundancy,)
    expected = np.linalg.eigvals(linearized_by_differences(plant, controller, q))
    expected = expected[np.argsort(np.abs(expected))][redundancy:]
    scale = np.abs(expected).max()
    for eigenvalue in local.eigenvalues:
        assert np.abs(expected - eigenvalue).min() < 1e-4 * scale
    assert_allclose(local.max_real_eigenvalue, expected.real.max(), atol=1e-4 * scale)
    assert local.stable == (local.max_real_eigenvalue < 0)
    assert local.self_motion == redundancy
    assert local.unseen_parameters == 0
    assert not local.singular


POINTS = ((0.0, 0.0, 0.0), (0.1, 0.05, 0.0))
ON_VIEW = np.array([0.3, 0.4, -0.2, -1.8, 0.1, 2.0, 0.5])


def panda_before_a_camera(panda, points=1, depth="believed", *, carried=False):
    """Tool, focal length, distance and roll are wrong; gravity is left out of truth and belief."""
    arm = panda.with_gravity((0.0, 0.0, 0.0))
    truth, belief = arm.with_object(0.2), arm.with_object(0.1)
    tip = aj.PositionTask(truth).value(ON_VIEW)
    if carried:  # by the hand, watching points of the world before it
        camera = aj.PinholeCamera((600.0, 580.0), (640, 480), mount="panda_hand_tcp")
        points = tip + 0.5 * np.array(POINTS[:points])
    else:
        camera = aj.PinholeCamera.looking_at(
            tip + [0.02, -0.03, 0.02], tip + [0.9, -0.7, 0.5], (600.0, 580.0), (640, 480),
            distortion=(-0.2, 0.05),
        )  # fmt: skip
        points = POINTS[:points]
    wrong = camera.recalibrated({"focal_length": 660.0, "distance": 0.1, "roll": 0.3})
    plant = aj.Plant(truth, aj.ImageTask(truth, camera, points=points, depth=depth), friction=0.3)
    controller = aj.SetpointController(
        aj.ImageTask(belief, wrong, points=points, depth=depth),
        aj.Gains(1e-3, 4e-4, damping=1.0),
        gravity=aj.NoGravity(belief),
    )
    return plant, controller


VIEWS = [
    (1, "believed", False), (2, "believed", False), (1, 0.8, False), (2, (1.5, 0.9), False),
    (2, "measured", False), (1, "believed", True), (2, 0.3, True), (2, "measured", True),
]  # fmt: skip


@pytest.mark.parametrize(("points", "depth", "carried"), VIEWS)
def test_eigenvalues_are_those_of_the_flow_with_cameras(panda, points, depth, carried):
    """Also where Ĵ changes with the measured x: at the target its change is multiplied by 0."""
    plant, controller = panda_before_a_camera(panda, points, depth, carried=carried)
    local = aj.local_stability(plant, controller, ON_VIEW)
    expected = np.linalg.eigvals(linearized_by_differences(plant, controller, ON_VIEW))
    expected = expected[np.argsort(np.abs(expected))][7 - 2 * points :]
    assert local.eigenvalues.shape == expected.shape
    scale = np.abs(expected).max()
    for eigenvalue in local.eigenvalues:
        assert np.abs(expected - eigenvalue).min() < 1e-7 * scale
    if depth not in ("believed", "measured"):  # the depth that is taken is no truth
        J = plant.sensor.jacobian(ON_VIEW)
        assert np.abs(plant.sensor.sensor_jacobian(ON_VIEW) - J).max() > 10.0


@pytest.mark.parametrize("view", [VIEWS[0], pytest.param(VIEWS[2], marks=pytest.mark.study)])
def test_runs_before_a_camera_decay_at_the_rate_told(panda, view):
    plant, controller = panda_before_a_camera(panda, *view[:2])
    local = aj.local_stability(plant, controller, ON_VIEW)
    assert local.stable
    measured = measured_rate(plant, controller, ON_VIEW, 12.0, None)
    assert_allclose(measured, local.decay_rate, rtol=0.01)


@pytest.mark.parametrize(
    ("carried", "joint", "turn", "behind"), [(False, 0, -1.5, False), (True, 3, -1.0, True)]
)
def test_a_target_out_of_view_is_refused(panda, carried, joint, turn, behind):
    plant, controller = panda_before_a_camera(panda, carried=carried)
    q = ON_VIEW + turn * np.eye(7)[joint]
    assert np.isnan(plant.sensor.value(q)).all() == behind
    with pytest.raises(
        aj.InvalidInputError, match="q_target must be a configuration that the sensor sees, or"
    ):
        aj.local_stability(plant, controller, q)


def test_an_exact_model_is_stable_and_a_reversed_camera_is_not(two_link):
    camera = PlanarCamera(0.05, 3.0)
    plant = aj.Plant(two_link, aj.ImageTask(two_link, camera))
    for roll, stable in ((0.0, True), (np.pi, False)):
        believed = PlanarCamera(0.05, 3.0, roll=roll)
        controller = aj.SetpointController(
            aj.ImageTask(two_link, believed), aj.Gains(5000.0, 5000.0)
        )
        assert aj.local_stability(plant, controller, np.array([1.5, 1.5])).stable is stable


@pytest.mark.parametrize("q", [(0.3, 0.0), (0.3, np.pi), (-1.0, 0.0), (0.0, 0.0)])
def test_a_singular_target_is_never_stable(two_link, q):
    task = aj.PositionTask(two_link, axes="xz")
    local = aj.local_stability(
        aj.Plant(two_link, task), aj.SetpointController(task, aj.Gains(50.0, 20.0)), q
    )
    assert local.singular
    assert not local.stable


GOAL = np.array([0.6, 1.2])


def two_link_loop(two_link, gravity=None, friction=0.3, **options):
    """A two-link arm with a wrong tool; its gravity is known, or learnt with (L, α)."""
    belief = aj.load_robot("two_link").with_object(0.2, 0.1, radius=0.0, axis="x")
    regressor = GravityRegressor(belief, "x")
    known = RegressorGravity(regressor, regressor.fit(two_link)[0])
    plant = aj.Plant(two_link, aj.PositionTask(two_link, axes="xz"), friction, **options)
    controller = aj.SetpointController(
        aj.PositionTask(belief, axes="xz"), aj.Gains(60.0, 30.0),
        gravity=known if gravity is None
        else aj.AdaptiveGravity(regressor, *gravity, theta0=known.theta),
    )  # fmt: skip
    return plant, controller


def panda_loop(panda, gravity=None, moments="xyz", **options):
    """A Panda that does not know of its tool; gravity known, or learnt with (L, α)."""
    truth = panda.with_object(0.2, 0.5)
    regressor = GravityRegressor(panda, moments)
    theta, _ = regressor.fit(truth)
    known = RegressorGravity(regressor, theta)
    controller = aj.SetpointController(
        aj.PositionTask(panda), aj.Gains(400.0, 80.0, 2.0),
        gravity=known if gravity is None
        else aj.AdaptiveGravity(regressor, *gravity, theta0=theta),
    )  # fmt: skip
    plant = aj.Plant(truth, aj.PositionTask(truth), **options)
    return plant, controller, np.array([0.3, 0.4, -0.2, -1.8, 0.1, 2.0, 0.5])


def measured_rate(plant, controller, q_target, duration, dt, size=1e-6):
    """Rate at which a small error dies out in the last third of a run [1/s].

    Two modes are left by then: e[k + 2r] = a e[k + r] + b e[k] is fitted to all coordinates.
    """
    q0 = pin.integrate(plant.robot.model, q_target, np.full(plant.robot.nv, size))
    run = aj.simulate(plant, controller, plant.sensor.value(q_target), q0, duration, dt=dt)
    e = run.error[2 * len(run.t) // 3 :] / np.abs(run.error).max()
    r = max(1, len(e) // 20)
    pairs = np.column_stack([e[r:-r].ravel(), e[: -2 * r].ravel()])
    a, b = np.linalg.lstsq(pairs, e[2 * r :].ravel(), rcond=None)[0]
    return -np.log(np.abs(np.roots([1.0, -a, -b])).max()) / (r * run.t[1])


def test_a_point_of_the_complex_plane_is_read_as_rate_and_ratio():
    pair = np.array([-3.0 + 4.0j, -3.0 - 4.0j, -50.0])
    local = aj.stability.LocalStability(pair, self_motion=0, unseen_parameters=0, singular=False)
    assert_allclose((local.decay_rate, local.damping_ratio), (3.0, 0.6))
    growing = aj.stability.LocalStability(-pair, 0, 0, False)
    assert_allclose((growing.decay_rate, growing.damping_ratio), (-50.0, -1.0))
    real = aj.stability.LocalStability(pair[2:], 0, 0, False)
    assert_allclose((real.decay_rate, real.damping_ratio), (50.0, 1.0))


def test_modes_that_are_over_before_the_loop_answers_do_not_count_as_oscillation():
    slow, over = -2.0 + 0.5j, -400.0 + 3000.0j
    modes = np.array([slow, over, complex(-np.inf, 0.0)])
    kept = aj.stability.LocalStability(modes, 0, 0, False, dt=1e-3, dead_time=5e-3)
    left_out = aj.stability.LocalStability(modes, 0, 0, False, dt=1e-3, dead_time=6e-3)
    assert_allclose(kept.damping_ratio, 400.0 / abs(over))
    assert_allclose(left_out.damping_ratio, 2.0 / abs(slow))


GANTRY = """<robot name="gantry"><link name="base"/>
  <link name="beam"><inertial><mass value="3"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <link name="hook"><inertial><mass value="2"/>
    <inertia ixx="1" ixy="0" ixz="0" iyy="1" iyz="0" izz="1"/></inertial></link>
  <joint name="along" type="prismatic"><parent link="base"/><child link="beam"/>
    <axis xyz="1 0 0"/><limit lower="-1" upper="1" effort="90" velocity="1"/></joint>
  <joint name="up" type="prismatic"><parent link="beam"/><child link="hook"/>
    <axis xyz="0 0 1"/><limit lower="-1" upper="1" effort="90" velocity="1"/></joint></robot>"""


def test_two_sampled_masses_have_the_eigenvalues_of_their_closed_form():
    """Each moves under a torque held over dt: x += dt v − k dt²/2 x − c dt²/2 v and so on."""
    gantry, dt = aj.load_robot(GANTRY), 0.05
    task = aj.PositionTask(gantry, axes="xz")
    controller = aj.SetpointController(task, aj.Gains(40.0, 5.0))
    expected = []
    for mass in (5.0, 2.0):  # the beam carries the hook
        k, c = 40.0 / mass, 5.0 / mass
        step = [[1.0 - k * dt**2 / 2.0, dt - c * dt**2 / 2.0], [-k * dt, 1.0 - c * dt]]
        expected.extend(np.log(np.linalg.eigvals(step).astype(complex)) / dt)
    local = aj.local_stability(aj.Plant(gantry, task), controller, np.zeros(2), dt)
    assert_allclose(np.sort_complex(local.eigenvalues), np.sort_complex(expected), rtol=1e-9)
    slowest = max(expected, key=lambda value: value.real)
    assert_allclose(local.decay_rate, -slowest.real)


def test_forces_of_joints_that_slide_are_in_newtons():
    """The hook of 2 kg, and the mass that is held, are carried by a slide."""
    gantry = aj.load_robot(GANTRY)
    errors = aj.Uncertainty(
        gantry,
        task=functools.partial(aj.PositionTask, axes="xz"),
        object_mass=(0.0, 1.0),
        object_axis="x",
    )
    law = aj.SetpointController(errors.believed_task(), gravity=aj.NoGravity(errors.belief()))
    study = aj.Study(law, errors, aj.JointBox.around(gantry, (0.0, 0.0), 0.1))
    assert gantry.force_units == ("N", "N")
    assert "gravity is off by up to 29.4 N\n" in str(study.report(20))
    for use in (
        lambda: study.tolerance(["stable"]),
        lambda: aj.local_stability(errors.nominal, law, np.zeros(2)),
    ):
        with pytest.raises(aj.InvalidInputError, match=r"an error of [0-9.]+ N(;| with)"):
            use()


@pytest.mark.parametrize(
    ("gravity", "dt", "options", "duration", "stable"),
    [
        (None, 0.02, {}, 4.0, True),
        (None, 0.1, {}, 1.2, False),
        (None, 0.005, {"actuator_delay": 0.02}, 4.0, True),
        (None, 0.005, {"actuator_delay": 0.1}, 1.5, False),
        (None, 0.01, {"sensing": aj.Sensing(x_delay=0.4)}, 24.0, True),
        pytest.param(
            None, 0.01, {"sensing": aj.Sensing(x_delay=0.8)}, 16.0, False, marks=pytest.mark.study
        ),
        (None, 0.01, {"sensing": aj.Sensing(velocity_filter=0.02)}, 4.0, True),
        pytest.param(
            None,
            0.01,
            {"sensing": aj.Sensing(velocity_filter=3.0)},
            60.0,
            False,
            marks=pytest.mark.study,
        ),
        ((3.0, 3.0), 0.01, {}, 6.0, True),
        ((10.0, 10.0), 0.01, {}, 6.0, False),
    ],
)
def test_runs_decay_or_grow_at_the_rate_told(two_link, gravity, dt, options, duration, stable):
    """Sampled loops become unstable by dt, delays or a filter; the continuous loop is stable."""
    plant, controller = two_link_loop(two_link, gravity, **options)
    local = aj.local_stability(plant, controller, GOAL, dt)
    assert local.stable is stable
    assert (local.decay_rate > 0.0) is stable
    measured = measured_rate(plant, controller, GOAL, duration, dt)
    assert_allclose(measured, local.decay_rate, rtol=0.03)
    if gravity is None:
        ideal, controller = two_link_loop(two_link)
        assert aj.local_stability(ideal, controller, GOAL).stable


@pytest.mark.parametrize(("dt", "stable"), [(0.005, True), (0.01, False)])
def test_a_panda_sampled_too_slowly_is_told(panda, dt, stable):
    plant, controller, q = panda_loop(panda)
    assert aj.local_stability(plant, controller, q).stable
    local = aj.local_stability(plant, controller, q, dt)
    assert local.stable is stable
    assert (local.self_motion, len(local.eigenvalues)) == (4, 10)
    duration = 2.0 if stable else 0.15
    measured = measured_rate(plant, controller, q, duration, dt, 1e-6 if stable else 1e-9)
    assert_allclose(measured, local.decay_rate, rtol=0.1)


def test_the_smooth_loop_is_told_for_learnt_gravity_too(two_link):
    for gains, stable in (((3.0, 3.0), True), ((10.0, 12.0), False)):
        plant, controller = two_link_loop(two_link, gains)
        local = aj.local_stability(plant, controller, GOAL)
        assert local.stable is stable
        assert local.unseen_parameters == 0
        measured = measured_rate(plant, controller, GOAL, 6.0, None, 1e-5)
        assert_allclose(measured, local.decay_rate, rtol=0.03)


def test_a_short_dt_without_delays_is_the_continuous_loop(panda):
    for gravity in (None, (5.0, 2.0)):
        plant, controller, q = panda_loop(panda, gravity)
        continuous = aj.local_stability(plant, controller, q)
        sampled = aj.local_stability(plant, controller, q, 1e-6)
        assert_allclose(sampled.decay_rate, continuous.decay_rate, rtol=1e-4)
        assert_allclose(sampled.damping_ratio, continuous.damping_ratio, rtol=1e-3)
        assert sampled.self_motion == continuous.self_motion == 4
        assert (sampled.dt, continuous.dt) == (1e-6, None)


def test_the_manifold_of_equilibria_is_recognised(panda):
    """7 − 3 of self-motion and p − rank Z of parameters, and no other eigenvalue of zero."""
    plant, controller, q = panda_loop(panda, (5.0, 2.0))
    regressor = controller.adaptation.regressor
    unseen = regressor.p - np.linalg.matrix_rank(regressor.Z(q))
    assert unseen == 6  # of 12: the first joint is vertical and feels nothing
    for dt in (None, 1e-3):
        local = aj.local_stability(plant, controller, q, dt)
        assert (local.self_motion, local.unseen_parameters) == (4, unseen)
        assert len(local.eigenvalues) == 14 + regressor.p - 4 - unseen
        assert (np.diff(local.eigenvalues.real) <= 0.0).all()  # the slowest first
        assert np.abs(local.eigenvalues).min() > 0.1
        assert not local.singular


@pytest.mark.parametrize(
    "wrong",
    [
        lambda still: still[..., 1:],  # one more eigenvalue is zero than was expected
        lambda still: still + 1e-3,  # no equilibria there
    ],
)
@pytest.mark.parametrize("dt", [None, 1e-3])
def test_a_manifold_that_is_none_decides_nothing(panda, monkeypatch, wrong, dt):
    plant, controller, q = panda_loop(panda, (5.0, 2.0))
    assert not aj.local_stability(plant, controller, q, dt).singular
    right = targets_module.equilibria
    monkeypatch.setattr(targets_module, "equilibria", lambda *given: wrong(right(*given)))
    assert aj.local_stability(plant, controller, q, dt).singular


def test_the_dead_time_is_the_hold_and_the_delays(two_link):
    plant, controller = two_link_loop(
        two_link, actuator_delay=0.02, sensing=aj.Sensing(x_delay=0.031)
    )
    assert_allclose(aj.local_stability(plant, controller, GOAL, 0.01).dead_time, 0.06)
    assert aj.local_stability(*two_link_loop(two_link), GOAL).dead_time == 0.0


def test_an_arm_that_hangs_feels_no_parameter_at_all(two_link):
    plant, controller = two_link_loop(two_link, (1.0, 1.0))
    tilted, hanging = np.array([np.pi / 2, 1e-3]), np.array([np.pi / 2, 0.0])
    assert np.abs(plant.dynamics.g(hanging)).max() < 1e-12
    assert aj.local_stability(plant, controller, hanging).unseen_parameters == 2
    assert aj.local_stability(plant, controller, tilted).unseen_parameters == 1


@pytest.mark.parametrize("dt", [None, 1e-3])
def test_a_singular_target_is_undecided_for_every_loop(two_link, dt):
    for gravity in (None, (5.0, 2.0)):
        plant, controller = two_link_loop(two_link, gravity)
        local = aj.local_stability(plant, controller, np.array([0.3, 0.0]), dt)
        assert local.singular
        assert not local.stable
        assert str(local).startswith("undecided: J or Ĵ loses rank at the target")


def test_what_it_says_can_be_acted_on(two_link, panda):
    plant, controller = two_link_loop(two_link, actuator_delay=0.1)
    assert re.fullmatch(
        r"unstable: errors near the target grow at \S+ 1/s, oscillating at \S+ Hz "
        r"\(sampled every 0.005 s\)",
        str(aj.local_stability(plant, controller, GOAL, 0.005)),
    )
    plant, controller, q = panda_loop(panda, (5.0, 2.0))
    assert re.fullmatch(
        r"stable: errors near the target die out at \S+ 1/s or faster \(to 1 % in \S+ s\), "
        r"damping ratio \S+ \(continuous loop\); left out are 4 of self-motion and 6 of learnt "
        r"parameters without effect at the target",
        str(aj.local_stability(plant, controller, q)),
    )


def controllers_without_a_linearization(robot):
    task, gains = aj.PositionTask(robot, axes="xz"), aj.Gains(50.0, 20.0)
    heavier = robot.with_object(0.1, 0.5, name="more")
    image = aj.ImageTask(robot, PlanarCamera(0.05, 3.0))
    return {
        r"gravity must be exact near the target .* with NoGravity": (
            aj.SetpointController(task, gains, gravity=aj.NoGravity(robot))
        ),
        r"gravity must be exact near the target .* with ModelGravity": (
            aj.SetpointController(task, gains, gravity=aj.controllers.ModelGravity(heavier))
        ),
        r"the controller's task must have the coordinates of the plant's sensor": (
            aj.SetpointController(image, gains)
        ),
    }


def test_gravity_that_is_right_at_the_target_alone_is_refused(two_link):
    """An equilibrium has to be one nearby, too: else its slope is another."""
    q, regressor = np.array([0.5, 1.0]), GravityRegressor(two_link)
    free = np.linalg.svd(regressor.Z(q))[2][-1]  # of no torque there
    assert np.abs(regressor.Z(q) @ free).max() < 1e-9
    assert np.abs(regressor.Z(q + 0.1) @ free).max() > 1e-2
    task = aj.PositionTask(two_link, axes="xz")
    gravity = RegressorGravity(regressor, regressor.theta + free)
    law = aj.SetpointController(task, aj.Gains(50.0, 20.0), gravity=gravity)
    with pytest.raises(aj.InvalidInputError, match="gravity must be exact near the target"):
        aj.local_stability(aj.Plant(two_link, task), law, q)


def test_what_has_another_linearization_is_refused(two_link):
    plant = aj.Plant(two_link, aj.PositionTask(two_link, axes="xz"))
    for text, controller in controllers_without_a_linearization(two_link).items():
        with pytest.raises(aj.InvalidInputError, match=text):
            aj.local_stability(plant, controller, np.array([0.5, 1.0]))
    good = aj.SetpointController(aj.PositionTask(two_link, axes="xz"), aj.Gains(50.0, 20.0))
    with pytest.raises(aj.InvalidInputError, match=r"q_target must have shape \(2,\)"):
        aj.local_stability(plant, good, np.zeros(3))


@pytest.mark.parametrize(
    "options",
    [
        {"friction": aj.robots.Friction(coulomb=1.0)},
        {"torque_limits": 20.0},
        {"actuator_delay": 0.01},
        {"sensing": aj.Sensing(x_noise=1e-3)},
    ],
)
def test_what_eq_1_does_not_have_is_refused(two_link, options):
    """By the local test, which knows viscous friction only."""
    task = aj.PositionTask(two_link, axes="xz")
    plant, controller = aj.Plant(two_link, task, **options), aj.SetpointController(task)
    q = np.array([0.3, 0.8])
    with pytest.raises(aj.InvalidInputError, match="the local test is for a plant without dry fr"):
        aj.local_stability(plant, controller, q)


@pytest.mark.parametrize(
    "options",
    [
        {"friction": aj.robots.Friction(coulomb=1.0)},
        {"torque_limits": 20.0},
        {"sensing": aj.Sensing(x_noise=1e-3)},
        {"sensing": aj.Sensing(x_quantum=1e-3)},
        {"sensing": aj.Sensing(x_dropout=0.1)},
        {"sensing": aj.Sensing(q_noise=[0.0, 1e-5])},
        {"sensing": aj.Sensing(q_quantum=1e-5)},
    ],
)
def test_what_no_linearization_has_is_refused_with_dt_too(two_link, options):
    plant, controller = two_link_loop(two_link, **options)
    with pytest.raises(aj.InvalidInputError, match="but for delays and velocity_filter"):
        aj.local_stability(plant, controller, GOAL, 0.01)


@pytest.mark.parametrize("dt", [0.0, -1.0, np.nan, "fast"])
def test_a_dt_that_is_none_is_refused(two_link, dt):
    with pytest.raises(aj.InvalidInputError, match=r"dt must be a finite number > 0 \[s\]"):
        aj.local_stability(*two_link_loop(two_link), GOAL, dt)


def test_a_dt_that_makes_no_sense_is_refused(two_link):
    plant, controller = two_link_loop(two_link)
    with pytest.raises(aj.InvalidInputError, match=r"dt must be a sampling time.*got 1e\+06"):
        aj.local_stability(plant, controller, GOAL, 1e6)  # above its base it falls
    plant, controller = two_link_loop(two_link, actuator_delay=1.0)
    with pytest.raises(aj.InvalidInputError, match=r"delays must be at most some 500 samples"):
        aj.local_stability(plant, controller, GOAL, 1e-3)


def test_gravity_that_is_not_learnt_there_is_refused(two_link, panda):
    regressor = GravityRegressor(two_link, "x")
    plant, controller = two_link_loop(two_link)
    for text, options in {
        r"torque_limits of AdaptiveGravity must hold": {"torque_limits": 5.0},
        r"bounds of AdaptiveGravity must hold \[3.5": {
            "bounds": (0.0, 3.4), "theta0": (1.0, 1.0)
        },
    }.items():  # fmt: skip
        learnt = aj.AdaptiveGravity(regressor, 1.0, 1.0, **options)
        stuck = aj.SetpointController(controller.task, aj.Gains(60.0, 30.0), gravity=learnt)
        with pytest.raises(aj.InvalidInputError, match=text):
            aj.local_stability(plant, stuck, GOAL)
    turned = panda.with_kinematic_error(rotations={"panda_joint4": (0.05, 0.0, 0.05)})
    learnt = aj.AdaptiveGravity(GravityRegressor(turned), 1.0, 1.0)
    wrong = aj.SetpointController(
        aj.PositionTask(turned), aj.Gains(400.0, 80.0, 2.0), gravity=learnt
    )
    plant, _, q = panda_loop(panda)
    with pytest.raises(
        aj.InvalidInputError, match=r"must be learnable near the target .* Adaptive"
    ):
        aj.local_stability(plant, wrong, q)


def test_a_target_that_decides_nothing_is_not_stable():
    """Of many targets one that is singular, or grows, is the worst, and speaks against all."""
    q = np.arange(8.0).reshape(4, 2)
    for worst, share in ((0.0, 0.75), (-0.1, 0.75), (0.1, 1.0)):
        rates = np.array([1.0, 2.0, worst, 3.0])
        found = targets_module.LocalTest(rates, np.ones(4), q, np.arange(4))
        assert (found.share, found.worst, found.stable) == (share, 2, share == 1.0)


@pytest.mark.parametrize("q", [(0.3, 0.4), (math.pi - 0.3, -0.4)], ids=["ahead", "behind"])
def test_learnt_gravity_needs_room_to_both_sides(two_link, q):
    """Motors that hold the weight in front and behind, and bounds above and below θ."""
    regressor = GravityRegressor(two_link, "x")
    plant, controller = two_link_loop(two_link)
    weight = np.abs(plant.dynamics.g(np.array(q)))
    theta = regressor.theta
    for held, options in (
        (True, {"torque_limits": 1.01 * weight}),
        (False, {"torque_limits": 0.99 * weight}),
        (True, {"bounds": (0.9 * theta, 1.1 * theta)}),
        (False, {"bounds": (0.5 * theta, 0.9 * theta), "theta0": 0.7 * theta}),
        (False, {"bounds": (1.1 * theta, 1.5 * theta), "theta0": 1.3 * theta}),
    ):
        learnt = aj.AdaptiveGravity(regressor, 1.0, 1.0, **options)
        law = aj.SetpointController(controller.task, aj.Gains(60.0, 30.0), gravity=learnt)
        if held:
            assert not aj.local_stability(plant, law, q).singular
            continue
        (name, *_) = options
        with pytest.raises(aj.InvalidInputError, match=f"{name} of AdaptiveGravity must hold"):
            aj.local_stability(plant, law, q)


def test_bounds_that_hold_the_parameters_change_nothing(two_link):
    regressor = GravityRegressor(two_link, "x")
    plant, controller = two_link_loop(two_link)
    found = []
    for bounds in (None, (0.0, 4.0)):
        learnt = aj.AdaptiveGravity(regressor, 1.0, 1.0, bounds=bounds, theta0=(1.0, 1.0))
        loop = aj.SetpointController(controller.task, aj.Gains(60.0, 30.0), gravity=learnt)
        found.append(aj.local_stability(plant, loop, GOAL).eigenvalues)
    assert_allclose(found[0], found[1], atol=0.0)
    assert len(found[0]) == 6  # of q, q̇ and two parameters
