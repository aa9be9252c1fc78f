"""The linearised loop against the loop itself: its flow, and the samples of `simulate`."""

import numpy as np
import pinocchio as pin
import pytest
from numpy.testing import assert_allclose
from scipy.linalg import block_diag
from tests.stability.periods import radii

import approxjac as aj
from approxjac.controllers import RegressorGravity
from approxjac.controllers.gains.gains import Timing
from approxjac.law import Sine
from approxjac.robots import GravityRegressor
from approxjac.stability.loop.closed_loop import ClosedLoop
from approxjac.stability.loop.linearization import (
    continuous_matrix,
    equilibria,
    linear_loop,
    sampled_matrix,
    stabilities,
)

FOLLOWER = """<robot name="coupled"><link name="base"/>{links}
  <joint name="j1" type="revolute"><parent link="base"/><child link="a"/><axis xyz="0 1 0"/>
    <origin xyz="0 0 0.3"/><limit lower="-2" upper="2" effort="90" velocity="1"/></joint>
  <joint name="j2" type="prismatic"><parent link="a"/><child link="b"/><axis xyz="0 0 1"/>
    <origin xyz="0.4 0 0.1"/><limit lower="-1" upper="1" effort="90" velocity="1"/></joint>
  <joint name="j3" type="revolute"><parent link="b"/><child link="c"/><axis xyz="0 1 0"/>
    <origin xyz="0.3 0 0"/><limit lower="-2" upper="2" effort="90" velocity="1"/>
    <mimic joint="j1" multiplier="0.5" offset="0.2"/></joint></robot>"""


def arm_named(name):
    """A named arm, or a planar one with a prismatic joint and a mimic joint."""
    if name != "mimic":
        return aj.load_robot(name)
    link = """<link name="{}"><inertial><origin xyz="0.2 0 0.1"/><mass value="1.5"/>
      <inertia ixx="0.1" ixy="0" ixz="0" iyy="0.2" iyz="0" izz="0.15"/></inertial></link>"""
    return aj.load_robot(FOLLOWER.replace("{links}", "".join(map(link.format, "abc"))))


def loop_of(name, rng, learns=False, **options):
    """A true arm with a tool that is not the believed one, and its gravity known or learnt.

    Returns the plant, the controller, a target posture, and the true θ where it is learnt.
    """
    arm = arm_named(name)
    truth = arm.with_object(0.2, 0.4)
    belief = arm.with_object(0.08, 0.1, axis="x")
    axes = "xz" if arm.nv == 2 else "xyz"
    regressor = GravityRegressor(belief)
    theta, residual = regressor.fit(truth)
    assert residual < 1e-9
    # a light wrist with much friction is too fast for RK4, with much damping for the samples
    friction, damping = (0.003, 0.01) if name == "kinova" else (0.3, 0.5)
    plant = aj.Plant(truth, aj.PositionTask(truth, axes=axes), friction=friction, **options)
    gravity = RegressorGravity(regressor, theta)
    if learns:
        gravity = aj.AdaptiveGravity(regressor, 0.5, 2.0, theta0=theta, torque_limits=np.inf)
    controller = aj.SetpointController(
        aj.PositionTask(belief, axes=axes), aj.Gains(60.0, 30.0, damping), gravity=gravity,
        saturation=Sine(0.5),
    )  # fmt: skip
    return plant, controller, truth.random_configuration(rng), theta if learns else np.zeros(0)


def flow_by_differences(plant, controller, q_target, theta):
    """The closed loop's flow in tangent coordinates, differentiated numerically."""
    n, model = plant.robot.nv, plant.robot.model
    target = plant.sensor.value(q_target)

    def flow(z):
        q, v = pin.integrate(model, q_target, z[:n]), z[n : 2 * n]
        answer = controller.evaluate(theta + z[2 * n :], plant.measure(0.0, q, v), target)
        return np.concatenate([v, plant.acceleration(q, v, answer.torque), answer.state_rate])

    h = 1e-5
    units = np.eye(2 * n + len(theta))
    return np.array([(flow(h * u) - flow(-h * u)) / (2 * h) for u in units]).T


@pytest.mark.parametrize("learns", [False, True], ids=["(6)", "(28)"])
@pytest.mark.parametrize("name", ["two_link", "ur5", "panda", "kinova", "mimic"])
def test_the_continuous_matrix_is_that_of_the_flow(name, learns, rng):
    plant, controller, q, theta = loop_of(name, rng, learns)
    (A,) = continuous_matrix(linear_loop(plant, controller, q))
    expected = flow_by_differences(plant, controller, q, theta)
    assert A.shape == expected.shape
    for row, wanted in zip(A, expected, strict=True):
        assert_allclose(row, wanted, atol=1e-6 * max(1.0, np.abs(wanted).max()))


TIMINGS = {
    "ideal": {},
    "late torque": {"actuator_delay": 0.006},
    "late x": {"sensing": aj.Sensing(x_delay=0.010)},
    "filter": {"sensing": aj.Sensing(velocity_filter=0.004)},
    "differences": {"sensing": aj.Sensing(velocity_filter=0.0)},
    "everything": {
        "actuator_delay": 0.004,
        "sensing": aj.Sensing(x_delay=0.006, velocity_filter=0.003),
    },
}
DT = 0.002


def timing_of(plant):
    sensing = plant.sensing or aj.Sensing()
    late = (round(sensing.x_delay / DT), round(plant.actuator_delay / DT))
    return Timing(DT, 1, *late, sensing.velocity_filter)


def first_state(loop, timing, dq):
    """What `simulate` starts from at rest: the first x stands for those before, g(q) holds."""
    w = np.zeros(0)
    if timing.velocity_filter is not None:
        w = -dq / (timing.velocity_filter + DT)
    return np.concatenate(
        [
            dq, np.zeros(2 * len(dq)), w, np.tile(loop.G[0] @ dq, timing.torque_late),
            np.tile(loop.J[0] @ dq, timing.x_late),
        ]
    )  # fmt: skip


@pytest.mark.parametrize("learns", [False, True], ids=["(6)", "(28)"])
@pytest.mark.parametrize("options", TIMINGS.values(), ids=TIMINGS)
@pytest.mark.parametrize(
    "name",
    [pytest.param(name, marks=pytest.mark.every_arm) for name in ("ur5", "panda")]
    + ["two_link", "kinova", "mimic"],
)
def test_the_sampled_matrix_tells_every_sample_of_a_run(name, options, learns, rng):
    plant, controller, q_target, theta = loop_of(name, rng, learns, **options)
    model, n = plant.robot.model, plant.robot.nv
    loop, timing = linear_loop(plant, controller, q_target), timing_of(plant)
    dq, samples = 1e-4 * rng.normal(size=n), 20
    run = aj.simulate(
        plant, controller, plant.sensor.value(q_target), pin.integrate(model, q_target, dq),
        samples * DT, dt=DT,
    )  # fmt: skip
    (A,) = sampled_matrix(loop, timing)
    z = first_state(loop, timing, dq)
    told = [z]
    for _ in range(samples):
        told.append(A @ told[-1])
    told = np.array(told)
    for part, actual in (
        (told[:, :n], np.array([pin.difference(model, q_target, q) for q in run.q])),
        (told[:, n : 2 * n], run.v),
        (told[:, 2 * n : 3 * n], (run.state[:, : len(theta)] - theta) @ loop.Z[0].T),
    ):
        scale = np.abs(actual).max(initial=0.0)
        assert_allclose(part, actual, atol=1e-3 * scale)
        assert scale > 1e-8 or not learns  # there was something to tell


@pytest.mark.parametrize("options", TIMINGS.values(), ids=TIMINGS)
def test_equilibria_stay_where_they_are(options, rng):
    plant, controller, q, _ = loop_of("panda", rng, True, **options)
    loop, timing = linear_loop(plant, controller, q), timing_of(plant)
    unseen = np.linalg.svd(loop.Z)[2][:, 6:].mT  # the first of the Panda's joints is vertical
    still = equilibria(loop, unseen, timing)
    assert still.shape[2] == 4 == np.linalg.matrix_rank(still[0])
    A = sampled_matrix(loop, timing)
    assert_allclose(A @ still, still, atol=1e-11 * np.abs(A).max())
    assert_allclose(continuous_matrix(loop) @ equilibria(loop, unseen), 0.0, atol=1e-10)


def test_gravity_acts_all_the_time_and_its_compensation_does_not(two_link):
    """Without it the sampled loop would be told wrongly: the difference is not lost in noise."""
    plant = aj.Plant(two_link, aj.PositionTask(two_link, axes="xz"))
    controller = aj.SetpointController(plant.sensor, aj.Gains(50.0, 20.0))
    loop = linear_loop(plant, controller, np.array([0.3, 0.8]))
    timing = Timing(0.02)
    floating = loop._replace(G=np.zeros_like(loop.G))
    assert np.abs(sampled_matrix(loop, timing) - sampled_matrix(floating, timing)).max() > 1e-3
    assert_allclose(continuous_matrix(loop), continuous_matrix(floating))


@pytest.mark.parametrize("kp", [20.0, 3000.0])
def test_radii_are_of_the_maps_from_frame_to_frame(two_link, kp):
    task, latency = aj.PositionTask(two_link, axes="xz"), aj.Latency(1e-3, image_period=0.1)
    controller, plant = aj.SetpointController(task, aj.Gains(kp, 30.0)), aj.Plant(two_link, task)
    loop = ClosedLoop(controller, plant, aj.JointBox.around(two_link, (0.4, 1.2), 0.2))
    samples = loop.draw(6, np.random.default_rng(0))
    maps = [
        sampled_matrix(linear_loop(plant, controller, q), latency.in_samples())[0]
        for q in samples.q
    ]
    multipliers = np.linalg.eigvals(maps)  # but for torques that are learnt: there are none
    expected = np.where(np.abs(multipliers - 1.0) < 1e-9, 0.0, np.abs(multipliers)).max(axis=1)
    assert_allclose(radii(loop, samples, latency), expected, rtol=1e-6)
    assert (expected > 1.0).all() == (kp == 3000.0)


def test_slow_modes_are_told_per_second_also_from_frame_to_frame(panda, rng):
    plant, controller, q, _ = loop_of("panda", rng)
    loop = linear_loop(plant, controller, q)
    (continuous,), *sampled = (
        stabilities(loop, 9.81, timing)
        for timing in (
            None,
            Timing(1e-4),
            Timing(1e-4, samples=10),
            Timing(1e-4, samples=10, x_late=10),
        )
    )
    for (found,) in sampled:
        assert_allclose(found.decay_rate, continuous.decay_rate, rtol=0.01)


def test_a_short_dt_is_the_continuous_loop(panda, rng):
    plant, controller, q, _ = loop_of("panda", rng, True)
    loop = linear_loop(plant, controller, q)
    n = loop.M.shape[1]
    torques = block_diag(np.eye(2 * n), loop.Z[0])  # of what is learnt
    flow = torques @ continuous_matrix(loop)
    errors = [
        np.abs((sampled_matrix(loop, Timing(dt)) @ torques - torques) / dt - flow).max()
        for dt in (1e-5, 1e-6)
    ]
    assert_allclose(errors[0] / errors[1], 10.0, rtol=0.05)  # of first order in dt
