"""What docs/theory.md derives beyond the paper, where no other file checks it by numbers."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac import law
from approxjac.controllers import RegressorGravity
from approxjac.controllers.gains.gains import Timing
from approxjac.robots import Dynamics, GravityRegressor
from approxjac.stability.loop.linearization import LinearLoop, sampled_matrix


@pytest.fixture
def loop(panda):
    """A Panda near a target, with the Jacobian of the bare hand; gravity's gradient left out."""
    truth, belief = panda.with_object(0.2, 0.5, axis="x"), panda.with_object(0.0)
    q = np.array([0.3, -0.3, -0.2, -1.7, 0.2, 1.4, 0.8])
    return LinearLoop(
        M=Dynamics(truth).M(q)[None],
        G=np.zeros((1, 7, 7)),
        J=aj.PositionTask(truth).jacobian(q)[None],
        J_hat=aj.PositionTask(belief).jacobian(q)[None],
        J_hat_pinv=np.zeros((1, 7, 3)),
        kp=np.array([400.0, 300.0, 200.0]),
        kv=np.array([80.0, 60.0, 90.0]),
        friction=np.zeros(7),
        damping=np.linspace(1.0, 3.0, 7),
        Z=np.zeros((1, 7, 0)),
        L=np.zeros(0),
        alpha=0.0,
    )


def damping_rates(loop):
    """Eigenvalues of M⁻¹(ĴᵀK_vĴ + B_c), rising."""
    (M,), (J_hat,) = loop.M, loop.J_hat
    D = (J_hat.T * loop.kv) @ J_hat + np.diag(loop.damping)
    return np.sort(np.linalg.eigvals(np.linalg.solve(M, D)).real)


def test_without_added_damping_an_arm_with_joints_to_spare_drifts_for_ever(loop):
    """δq = t v, q̇ = v solves the linearised loop for Jv = Ĵv = 0."""
    (M,), (J,) = loop.M, loop.J
    v = np.linalg.svd(J)[2][-1]
    at_rest, drifting = np.concatenate([v, 0.0 * v]), np.concatenate([0.0 * v, v])
    A = law.closed_loop_matrix(M, J, J, loop.kp, loop.kv, np.zeros(7))
    assert_allclose(A @ drifting, at_rest, atol=1e-9)
    assert_allclose(A @ at_rest, 0.0, atol=1e-9)
    damped = law.closed_loop_matrix(M, J, J, loop.kp, loop.kv, loop.damping)
    assert v @ M @ (damped @ drifting)[7:] < -0.9  # it is braked


@pytest.mark.parametrize("which", range(7))
@pytest.mark.parametrize("scale", [0.0, 1.0, -5.0])
def test_minus_one_is_an_eigenvalue_where_dt_times_a_damping_rate_is_two(loop, which, scale):
    """Whatever J is."""
    rate = damping_rates(loop)[which]
    other = loop._replace(J=scale * loop.J)

    def nearest(dt):
        return np.abs(np.linalg.eigvals(sampled_matrix(other, Timing(dt))) + 1.0).min()

    assert nearest(2.0 / rate) < 1e-6
    if which < 6:  # between two rates there is none
        between = 4.0 / (rate + damping_rates(loop)[which + 1])
        assert nearest(between) > 1e-3


def test_damping_beyond_two_is_unstable(loop):
    fastest = damping_rates(loop)[-1]

    def largest(share):
        off_manifold = np.linalg.eigvals(sampled_matrix(loop, Timing(share * 2.0 / fastest)))
        return np.abs(off_manifold).max()

    assert largest(0.99) < 1.0 + 1e-7  # four of them are 1: the self-motion
    assert largest(1.01) > 1.0 + 1e-3


def test_without_x_kinetic_energy_falls_by_what_damping_takes(panda):
    """At the rate q̇ᵀ(ĴᵀK_vĴ + B)q̇, where the gravity that is believed is right."""
    truth, belief = panda.with_object(0.2, 0.5, axis="x"), panda.with_object(0.0, 0.0)
    regressor = GravityRegressor(belief)
    known = RegressorGravity(regressor, regressor.fit(truth)[0])
    task = aj.PositionTask(belief)
    controller = aj.SetpointController(task, aj.Gains(400.0, 80.0, 1.0), gravity=known)
    sensor, dynamics = aj.PositionTask(truth), Dynamics(truth)
    unseen = aj.Sensing(x_lost=[(0.0, 1.0)])
    plant = aj.Plant(truth, sensor, friction=0.3, sensing=unseen)
    q0 = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
    dt = 1e-5
    run = aj.simulate(
        plant,
        controller,
        sensor.value(q0) + 0.1,
        aj.simulation.InitialState(q0, v0=np.linspace(-1.0, 1.0, 7)),
        20 * dt,
        dt=dt,
    )
    assert run.status_counts() == {aj.Status.MEASUREMENT_LOST: len(run.t)}
    energy = [0.5 * v @ dynamics.M(q) @ v for q, v in zip(run.q, run.v, strict=True)]
    q, v = run.q[10], run.v[10]
    J_hat = task.jacobian(q)
    taken = v @ (1.3 * v) + J_hat @ v @ (80.0 * (J_hat @ v))
    assert (energy[11] - energy[9]) / (2 * dt) == pytest.approx(-taken, rel=1e-3)


def test_a_posture_leaves_an_error_within_its_ultimate_bound():
    """limsup ‖z‖ ≤ √(κ/c) t₀/w, for a unit mass in the plane whose task is its first coordinate.

    z = (q̇, e), V = ½‖q̇‖² + α q̇₁e + ½(k_p + αk_v)e², and N τ₀ acts along the second.
    """
    kp, kv, b, alpha, t0 = 4.0, 3.0, 0.5, 0.4, 2.0
    # V and W as quadratic forms in z = (q̇₁, q̇₂, e), from (12) and (13) with B = b I
    half_P = 0.5 * np.array([[1, 0, alpha], [0, 1, 0], [alpha, 0, kp + alpha * kv]])
    Q = np.array(
        [[kv + b - alpha, 0, 0.5 * alpha * b], [0, b, 0], [0.5 * alpha * b, 0, alpha * kp]]
    )
    c, kappa, w = *np.linalg.eigvalsh(half_P)[[0, -1]], np.linalg.eigvalsh(Q)[0]
    bound = np.sqrt(kappa / c) * t0 / w

    def rate(t, z):
        pull = t0 * np.sign(np.sin(0.7 * t))  # as large as it may be, and not constant
        return np.array([-kp * z[2] - (kv + b) * z[0], -b * z[1] + pull, z[0]])

    z, dt, late = np.array([3.0, -2.0, 5.0]), 1e-2, []
    for k in range(6_000):
        slope = 2 * (half_P @ z) @ rate(k * dt, z)
        push = rate(k * dt, z)[1] + b * z[1]
        assert slope == pytest.approx(-z @ Q @ z + z[1] * push, abs=1e-9)
        z = z + dt * rate(k * dt, z)
        late.append(np.linalg.norm(z))
    assert 0.5 < max(late[4_000:]) <= bound
    assert abs(z[2]) < 1e-6  # N τ₀ does not reach the task


def test_the_rate_of_a_slow_direction():
    """k_p σσ̂ / (k_v σ̂² + b), where damping outweighs inertia."""
    sigma, sigma_hat, kp, kv, b = 0.7, 0.4, 30.0, 50.0, 2.0
    one = np.eye(1)
    A = law.closed_loop_matrix(
        1e-6 * one, sigma * one, sigma_hat * one, np.array([kp]), np.array([kv]), np.array([b])
    )
    slow = np.linalg.eigvals(A).real.max()
    assert slow == pytest.approx(-kp * sigma * sigma_hat / (kv * sigma_hat**2 + b), rel=1e-5)


def test_theorem_1_depends_on_the_unit_of_length_for_given_gains():
    """In another unit λ₂ is multiplied by c² and p by c: (21) may fail then, (25) does not."""
    p, lambda_2, a = 0.9, 1.0, np.ones(1)
    holds, best = {}, {}
    for c in (1.0, 10.0):
        alpha = law.best_alpha(a, np.ones(1), c**2 * lambda_2, 0.0, 0.0, np.inf)
        allowed = law.allowed_p(alpha, a, np.ones(1), c**2 * lambda_2, 0.0, 0.0)
        holds[c] = c * p < min(allowed)
        best[c] = c * p < law.largest_allowed_p(c**2 * lambda_2)
    assert holds == {1.0: True, 10.0: False}
    assert best == {1.0: True, 10.0: True}
