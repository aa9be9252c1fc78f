"""Joints stop at their limits, softly, and no energy comes of it."""

import numpy as np
import pinocchio as pin
import pytest
from hypothesis import given
from hypothesis import strategies as st
from own_controller import OwnController

import approxjac as aj
from approxjac.robots import Dynamics
from approxjac.simulation.plant import JointStops, _complementary

# mimic and prismatic joints; continuous ones; a wrist of 1e-5 kg m^2 and less; planar
NAMES = ("panda", "tiago_arm", "kinova", "so101", "two_link")
ARMS = {name: aj.load_robot(name).with_gravity((0.0, 0.0, 0.0)) for name in NAMES}
STOPS = {name: JointStops(robot) for name, robot in ARMS.items()}
arms, seeds = st.sampled_from(NAMES), st.integers(0, 2**32 - 1)
INTEGRATORS = ("rk4", "semi_implicit_euler")


class Constant(OwnController):
    """A torque that stays as it is."""

    def __init__(self, task, torque):
        super().__init__(task)
        self.torque = np.broadcast_to(torque, task.robot.nv).astype(float)

    def evaluate(self, state, measurement, target):
        return aj.Evaluation(self.torque, state, aj.Status.OK, measurement.x - target)


def plant_of(robot, **options):
    return aj.Plant(robot, aj.PositionTask(robot, axes="xz" if robot.nv == 2 else "xyz"), **options)


def near_limits(robot, rng):
    """A configuration with every joint within 0.05 of one of its limits, inside or outside."""
    low, high = robot.usual_range
    motion = np.where(rng.random(robot.nv) < 0.5, low, high) + rng.uniform(-0.05, 0.05, robot.nv)
    return np.asarray(pin.integrate(robot.model, robot.neutral(), motion))


def stored(stops, q):
    """Energy in the stops, ½kδ² of those that are touched."""
    return 0.5 * stops.stiffness @ np.maximum(stops.depth(q)[0], 0.0) ** 2


@given(arms, seeds, st.floats(0.0, 30.0))
def test_a_stop_only_pushes_and_takes_more_power_than_it_stores(name, seed, speed):
    robot, stops, rng = ARMS[name], STOPS[name], np.random.default_rng(seed)
    q, v = near_limits(robot, rng), speed * rng.normal(size=robot.nv)
    torque, (depth, side) = stops.torque(q, v), stops.depth(q)
    assert (torque * side <= 0.0).all()
    assert (torque[depth <= 0.0] == 0.0).all()
    storing = stops.stiffness * np.maximum(depth, 0.0) * side * v
    assert (torque * v + storing <= 1e-9 * np.abs(storing)).all()


@given(arms, seeds, st.floats(0.0, 30.0), st.floats(1e-4, 0.02))
def test_over_a_step_of_any_length_stops_add_no_energy(name, seed, speed, dt):
    """Kinetic and stored, against the same step without them."""
    robot, stops, rng = ARMS[name], STOPS[name], np.random.default_rng(seed)
    q, free = near_limits(robot, rng), speed * rng.normal(size=robot.nv)
    M, M_inv = Dynamics(robot).M(q), Dynamics(robot).M_inv(q)
    torque, _ = stops.held_torque(q, free, M_inv, dt)
    v = free + dt * M_inv @ torque
    depth, side = stops.depth(q)
    beyond = depth + dt * side * v  # at the end of the step
    before = 0.5 * free @ M @ free + stored(stops, q)
    after = 0.5 * v @ M @ v + 0.5 * stops.stiffness @ np.maximum(beyond, 0.0) ** 2
    assert (torque * side <= 0.0).all()
    assert after <= before * (1.0 + 1e-9)


@pytest.mark.parametrize(
    "integrator",
    [pytest.param(k, marks=[] if k == "rk4" else pytest.mark.study) for k in INTEGRATORS],
)
@given(arms, seeds)
def test_the_energy_of_a_run_into_stops_never_grows(integrator, name, seed):
    """Of an arm without torque and gravity at dt = 1 ms, 300 steps.

    Semi-implicit Euler adds up to a tenth without stops, too; Runge-Kutta adds nothing.
    """
    robot, stops, rng = ARMS[name], STOPS[name], np.random.default_rng(seed)
    dynamics, plant = Dynamics(robot), plant_of(robot)
    q0, v0 = near_limits(robot, rng), rng.normal(size=robot.nv)
    v0 *= np.sqrt(0.02 * np.trace(dynamics.M(q0)) / dynamics.energy(q0, v0))
    run = aj.simulate(
        plant,
        Constant(plant.sensor, 0.0),
        plant.sensor.value(q0),
        aj.simulation.InitialState(q0, v0=v0),
        0.3,
        computation=aj.simulation.Computation(integrator),
    )
    energy = [dynamics.energy(q, v) + stored(stops, q) for q, v in zip(run.q, run.v, strict=True)]
    assert max(energy) <= energy[0] + (1e-6 if integrator == "rk4" else 0.1) * dynamics.energy(
        q0, v0
    )


@pytest.mark.study
@pytest.mark.parametrize(
    ("name", "share", "friction", "integrator"),
    [("panda", 1.0, 0.1, "rk4"), ("so101", 0.01, 1e-3, "semi_implicit_euler")],
)
def test_a_motor_presses_a_joint_a_hundredth_beyond_its_limit_at_most(
    name, share, friction, integrator
):
    """In proportion to its torque; with all of it the bare wrist would turn at 1000 rad/s."""
    robot = ARMS[name]
    torque = share * robot.effort_limits
    plant = plant_of(robot, friction=friction)
    q0 = plant.ready_configuration()
    run = aj.simulate(
        plant,
        Constant(plant.sensor, torque),
        np.zeros(3),
        q0,
        3.0,
        computation=aj.simulation.Computation(integrator),
    )
    assert np.abs(run.v[-1]).max() < 1e-3
    beyond = robot.beyond_limits(run.q[-1:])[0]
    assert (beyond > 0.0).all()
    assert beyond.max() <= 0.01 * share + 1e-6


def test_sampled_steps_converge_to_the_continuous_law():
    robot, rng = ARMS["panda"], np.random.default_rng(1)
    plant, q0, v0 = plant_of(robot), near_limits(robot, rng), rng.normal(size=robot.nv)
    start = aj.simulation.InitialState(q0, v0)
    arguments = plant, Constant(plant.sensor, 1.0), np.zeros(3), start, 0.1
    exact = aj.simulate(*arguments, dt=None, record_every=0.01)
    assert (robot.beyond_limits(exact.q).max(axis=0) > 1e-3).sum() > 3
    errors = [
        np.abs(aj.simulate(*arguments, dt=dt).q[-1] - exact.q[-1]).max() for dt in (1e-3, 1e-4)
    ]
    assert errors[1] < min(0.2 * errors[0], 5e-3)


@pytest.mark.parametrize("dt", [1e-3, 0.02])
def test_a_long_step_at_a_stop_stays_stable(dt):
    """A stiff spring that is stepped explicitly would throw the light wrist away."""
    robot = ARMS["so101"]
    plant = plant_of(robot, friction=1e-3)
    q0 = near_limits(robot, np.random.default_rng(3))
    run = aj.simulate(plant, Constant(plant.sensor, 0.0), np.zeros(3), q0, 1.0, dt=dt)
    assert np.abs(run.v).max() <= 0.05 * 200.0  # δ / T, of a joint that is let go at δ
    assert robot.beyond_limits(run.q[-1:]).max() < 1e-4


@given(arms, seeds)
def test_within_the_limits_nothing_changes(name, seed):
    robot, rng = ARMS[name], np.random.default_rng(seed)
    q, v, tau = (
        robot.random_configuration(rng),
        rng.normal(size=robot.nv),
        rng.normal(size=robot.nv),
    )
    free = plant_of(robot, joint_limits=False)
    assert np.array_equal(plant_of(robot).acceleration(q, v, tau), free.acceleration(q, v, tau))


def test_joints_without_limits_have_no_stops():
    robot = ARMS["kinova"]
    unlimited = ~np.isfinite(robot.position_limits[0])
    assert unlimited.any()
    q = near_limits(robot, np.random.default_rng(0))
    assert (JointStops(robot).torque(q, 10.0 * np.ones(robot.nv))[unlimited] == 0.0).all()
    middle = 0.5 * np.sum(robot.usual_range, axis=0)
    wound = np.where(unlimited, 100.0, middle)
    assert not JointStops(robot).touched(pin.integrate(robot.model, robot.neutral(), wound))


def test_a_plant_without_stops_says_so():
    assert "joint_limits=False" in repr(plant_of(ARMS["panda"], joint_limits=False))
    assert "joint_limits" not in repr(plant_of(ARMS["panda"]))


def test_pushes_end_where_rounding_decides_who_is_held():
    """Numbers of a run that diverges, for which pivoting goes round in a circle."""
    A = np.array([
        [4723368538089741.0, -1575121343.121469, 396640500957657.75],
        [-1575121343.121469, 525.2774755533669, -132269356.83012931],
        [396640500957657.75, -132269356.83012931, 33307518930878.867],
    ])  # fmt: skip
    b = [1.3599486791494726, 91615.71563256241, 439087.7523436748]
    push = _complementary(A, np.array(b))
    assert np.isfinite(push).all()
    assert (push >= 0.0).all()


@pytest.mark.parametrize("name", ["panda", "tiago_arm", "so101"])
def test_what_is_guessed_without_branches_is_right_or_says_so(name):
    """The pushes p ≥ 0 with A p ≥ b, one of both an equality at each stop that is touched."""
    robot, stops, right = ARMS[name], STOPS[name], 0
    for seed in range(40):
        rng, dt = np.random.default_rng(seed), 0.003
        q, v = near_limits(robot, rng), 4.0 * rng.normal(size=robot.nv)
        M_inv = np.linalg.inv(Dynamics(robot).M(q))
        (exact, _), (depth, side) = stops.held_torque(q, v, M_inv, dt), stops.depth(q)
        slowed = dt * side[:, None] * M_inv * side
        per_speed = stops.stiffness * dt + stops.damping
        push, wrong = stops._guessed(depth, side * v, slowed, per_speed, dt)
        is_right = np.allclose(-side * push, exact, rtol=1e-8, atol=1e-8 * np.abs(exact).max())
        assert wrong == (0.0 if is_right else 1.0)
        right += is_right
    assert right >= 30
