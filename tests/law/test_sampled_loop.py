"""The map from frame to frame against `simulate`, and against the loop sampled each time."""

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.testing import assert_allclose
from scipy.linalg import expm

import approxjac as aj
from approxjac import law
from approxjac.robots import Dynamics, GravityRegressor

DT, Q = 4e-3, np.array([0.4, 1.1])
ARM = aj.load_robot("two_link")
TRUTH, BELIEF = ARM.with_object(0.3, 0.5), ARM.with_object(0.0)
REGRESSOR = GravityRegressor(BELIEF)
GAINS = aj.Gains((40.0, 60.0), (15.0, 10.0), damping=(2.0, 1.0))
FORCE, TORQUE, ALPHA = (30.0, 20.0), (2.0, 3.0), 2.0


def linear():
    """The parts of the map at Q, of a law that learns a task force and joint torques."""
    J, J_hat = (aj.PositionTask(robot, axes="xz").jacobian(Q) for robot in (TRUTH, BELIEF))
    kp, kv, damping = GAINS.diagonals(2, 2)
    parts = (
        Dynamics(TRUTH).M_inv(Q), J, J_hat.T * kp, J_hat.T * kv @ J_hat + np.diag(damping),
        J_hat.T * FORCE @ J_hat + np.diag(TORQUE), ALPHA * np.linalg.inv(J_hat),
    )  # fmt: skip
    return law.LinearLaw(*(part[np.newaxis] for part in parts))


def test_friction_acts_all_the_time():
    """Against the matrix exponential of M q̈ = τ − B_n q̇ with a torque that is held."""
    loop, dt, friction = linear(), 0.3, np.array([0.0, 2.0])
    loop = loop._replace(learning=0.0 * loop.learning)
    [A] = law.frame_map(loop, dt, 1, 0, friction=friction)
    M_inv, n = loop.M_inv[0], 2
    torque = np.hstack([-loop.stiffness[0] @ loop.J[0], -loop.damping[0], np.eye(n)])
    rates = np.zeros((3 * n, 3 * n))
    rates[:n, n : 2 * n] = np.eye(n)
    rates[n : 2 * n, n : 2 * n] = -M_inv * friction
    rates[n : 2 * n, 2 * n :] = M_inv
    over = expm(rates * dt)[: 2 * n]
    expected = over[:, : 2 * n] @ np.eye(2 * n, 3 * n) + over[:, 2 * n :] @ torque
    assert_allclose(A[: 2 * n], expected, atol=1e-9 * np.abs(expected).max())


@settings(max_examples=10)
@given(st.integers(1, 5), st.integers(0, 9), st.integers(0, 3), st.sampled_from([0.0, 3e-3, 0.02]))
def test_it_maps_the_state_as_simulate_does(samples, age, late, T):
    """Frame by frame, from what a run near its target records of each sample."""
    sensor = aj.PositionTask(TRUTH, axes="xz")
    sensing = aj.Sensing(x_rate=1.0 / (samples * DT), x_delay=age * DT, velocity_filter=T or None)
    plant = aj.Plant(TRUTH, sensor, sensing=sensing, actuator_delay=late * DT)
    gravity = aj.AdaptiveGravity(
        REGRESSOR, 0.0, ALPHA, REGRESSOR.fit(TRUTH)[0], torque_limits=np.inf,
        task_force=FORCE, joint_torque=TORQUE,
    )  # fmt: skip
    controller = aj.SetpointController(aj.PositionTask(BELIEF, axes="xz"), GAINS, gravity=gravity)
    waiting = -(-age // samples)
    frames = waiting + 4
    x_d = sensor.value(Q)
    run = aj.simulate(
        plant, controller, x_d, Q + [2e-6, -1e-6], frames * samples * DT, dt=DT, record_every=DT
    )
    J_hat = controller.task.jacobian(Q)
    own = run.state[:, : controller.size]
    learnt = own[:, -4:-2] @ J_hat + own[:, -2:]
    w, a = np.zeros_like(run.q), DT / (T + DT)
    for k in range(1, len(run.t)):  # q̇ is that of differences, filtered, 0 at first
        seen = a / DT * (run.q[k - 1] - Q) + w[k - 1] if k > 1 else np.zeros(2)
        w[k] = (1.0 - a) * seen - a / DT * (run.q[k - 1] - Q)

    def state(frame):
        k = frame * samples
        parts = [run.q[k] - Q, run.v[k], learnt[k], *([w[k]] if T else [])]
        parts += [*(run.tau[k - late : k] - plant.dynamics.g(Q))]
        parts += [run.x[(frame - i) * samples] - x_d for i in range(1, waiting + 1)]
        return np.concatenate(parts)

    gradient = plant.dynamics.g_gradient(Q)[np.newaxis]
    [A] = law.frame_map(linear(), DT, samples, age, late, T or None, gravity=gradient)
    first = max(waiting, -(-late // samples), 1)
    states = np.array([state(frame) for frame in range(first, frames + 1)])
    misses = states[1:] - states[:-1] @ A.T
    assert (np.abs(misses) <= 1e-4 * np.abs(states).max(axis=0)).all()


def test_a_batch_is_each_of_it():
    loop = linear()
    stiffer = loop._replace(stiffness=2.0 * loop.stiffness)
    both = law.LinearLaw(*(np.concatenate(pair) for pair in zip(loop, stiffer, strict=True)))
    for one, of_both in zip((loop, stiffer), law.frame_map(both, DT, 3, 4, 1, 5e-3), strict=True):
        assert_allclose(law.frame_map(one, DT, 3, 4, 1, 5e-3)[0], of_both, rtol=1e-12)
