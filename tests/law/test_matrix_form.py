"""V̇ = −zᵀQz with free weights, against finite differences along the closed loop."""

import numpy as np
import pinocchio as pin
import pytest
from lyapunov_decrease import lyapunov
from numpy.testing import assert_allclose
from wrong_loop import closed_loop, terms

from approxjac import law
from approxjac.law import Sine, Tanh


def cross_weight(plant, controller, q, A1, A2):
    _, kv, damping = controller.diagonals
    _, _, _, J_hat, dJ_hat = terms(plant, controller, q)
    D = law.dissipation(J_hat, kv, plant.friction + damping)
    (G1, dG1), (G2, dG2) = (
        law.cross_weight_pinv(J_hat, dJ_hat),
        law.cross_weight_damped(D, J_hat, dJ_hat, kv),
    )
    return D, G1 @ A1 + G2 @ A2, dG1 @ A1 + dG2 @ A2


def symmetric(rng, m, size):
    """Return a coupling: symmetric, with a diagonal of zeros."""
    half = np.triu(rng.uniform(-size, size, (m, m)), 1)
    return half + half.T


def V(plant, controller, x_d, q, v, A1, A2, w, coupling):
    e = plant.sensor.value(q) - x_d
    _, G, _ = cross_weight(plant, controller, q, A1, A2)
    M, s = plant.dynamics.M(q), controller.saturation.s(e)
    at_rest = law.potential(controller.saturation.S(e), s, w, coupling)
    return 0.5 * v @ M @ v + v @ M @ G @ s + at_rest


def V_dot(plant, controller, x_d, q, v, A1, A2, w, coupling):
    M, dM, J, J_hat, _ = terms(plant, controller, q)
    e = plant.sensor.value(q) - x_d
    s, slope = controller.saturation.s(e), controller.saturation.ds(e)
    D, G, dG = cross_weight(plant, controller, q, A1, A2)
    N = law.inertial_block(M, dM, J, G, dG, s, slope)
    Q = law.decrease_matrix(D, N, J, J_hat, G, controller.diagonals.kp, w, coupling, slope)
    z = np.concatenate([v, s])
    return -z @ Q @ z


@pytest.mark.parametrize("name", ["two_link", "ur5", "panda", "xarm7", "kinova"])
@pytest.mark.parametrize("saturation", [None, Sine(0.3), Tanh(0.2)], ids=repr)
def test_decrease_is_that_of_v_along_the_closed_loop(name, saturation):
    plant, controller, rng = closed_loop(name, saturation)
    m, n = controller.task.m, plant.robot.nv
    for _ in range(3):
        q = plant.robot.random_configuration(rng)
        v = rng.normal(size=n)
        x_d = plant.sensor.value(q) + rng.uniform(-0.4, 0.4, m)
        A1, A2 = rng.normal(size=(2, m, m))
        w = rng.uniform(100.0, 600.0, m)
        coupling = symmetric(rng, m, 300.0)
        torque = controller.evaluate(np.zeros(0), plant.measure(0.0, q, v), x_d).torque
        a = plant.acceleration(q, v, torque)

        def along(h, q=q, v=v, a=a, x_d=x_d, A1=A1, A2=A2, w=w, coupling=coupling):
            moved = pin.integrate(plant.robot.model, q, h * v + 0.5 * h * h * a)
            return V(plant, controller, x_d, moved, v + h * a, A1, A2, w, coupling)

        h = 2e-5 / max(1.0, float(np.abs(a).max()) ** 0.5)
        measured = (
            8.0 * (along(h) - along(-h)) - (along(2.0 * h) - along(-2.0 * h))
        ) / (12.0 * h)  # fmt: skip
        told = V_dot(plant, controller, x_d, q, v, A1, A2, w, coupling)
        assert_allclose(told, measured, rtol=2e-5, atol=1e-4)


def test_the_papers_weights_give_the_papers_v_and_w(panda):
    plant, controller, rng = closed_loop("panda", Sine(0.3))
    kp, kv, _ = controller.diagonals
    for _ in range(5):
        q, v = plant.robot.random_configuration(rng), rng.normal(size=7)
        x_d = plant.sensor.value(q) + rng.uniform(-0.4, 0.4, 3)
        alpha = rng.uniform(0.1, 5.0)
        known = lyapunov(plant, controller, q, v, x_d, alpha)
        weights = (alpha * np.eye(3), np.zeros((3, 3)), kp + alpha * kv, np.zeros((3, 3)))
        assert_allclose(V(plant, controller, x_d, q, v, *weights), known.V, rtol=1e-12)
        assert_allclose(V_dot(plant, controller, x_d, q, v, *weights), -known.W, rtol=1e-9)


def test_cross_weights_have_their_derivatives():
    plant, controller, rng = closed_loop("panda", None)
    q = plant.robot.random_configuration(rng)
    for A1, A2 in ((np.eye(3), np.zeros((3, 3))), (np.zeros((3, 3)), np.eye(3))):
        _, _, dG = cross_weight(plant, controller, q, A1, A2)
        for k, unit in enumerate(np.eye(7)):
            h = 1e-5
            there, back = (
                cross_weight(
                    plant, controller, pin.integrate(plant.robot.model, q, d * unit), A1, A2
                )[1]
                for d in (h, -h)
            )
            assert_allclose(dG[k], (there - back) / (2.0 * h), atol=1e-6 * np.abs(dG).max())


def test_damped_cross_weight_is_the_pseudo_inverse_without_damping():
    plant, controller, rng = closed_loop("two_link", None)
    q = plant.robot.random_configuration(rng)
    _, _, _, J_hat, dJ_hat = terms(plant, controller, q)
    kv = controller.diagonals.kv
    D = law.dissipation(J_hat, kv, np.zeros(2))
    pinv, damped = law.cross_weight_pinv(J_hat, dJ_hat), law.cross_weight_damped(
        D, J_hat, dJ_hat, kv
    )  # fmt: skip
    assert_allclose(damped[0], pinv[0], rtol=1e-9)
    assert_allclose(damped[1], pinv[1], rtol=1e-7)


def test_damped_cross_weight_takes_damping_out_of_the_cross_block():
    """D G = ĴᵀK_v, so with an exact Ĵ, A₂ = αI and w = k_p + αk_v the cross block vanishes."""
    plant, controller, rng = closed_loop("panda", None)
    q = plant.robot.random_configuration(rng)
    kp, kv, _ = controller.diagonals
    alpha = 0.7
    D, G, _ = cross_weight(plant, controller, q, np.zeros((3, 3)), alpha * np.eye(3))
    J_hat = controller.task.jacobian(q)
    Q = law.decrease_matrix(D, np.zeros((7, 7)), J_hat, J_hat, G, kp, kp + alpha * kv)
    assert_allclose(Q[:7, 7:], 0.0, atol=1e-10 * np.abs(Q).max())
    assert_allclose(Q[7:, 7:], law.stiffness_block(J_hat, G, kp))
    assert_allclose(Q[:7, :7], D)


def test_potential_matrix_bounds_v_from_below(rng):
    """½zᵀPz is V with the smallest S of (8), S = c̄s², in place of S(e)."""
    root, G = rng.normal(size=(5, 5)), rng.normal(size=(5, 3))
    M, w, c_bar = root @ root.T, rng.uniform(1.0, 2.0, 3), 0.4
    coupling = symmetric(rng, 3, 1.0)
    P = law.potential_matrix(M, G, law.potential_block(w, coupling, c_bar))
    v, s = rng.normal(size=5), rng.normal(size=3)
    z = np.concatenate([v, s])
    least = law.potential(c_bar * s**2, s, w, coupling)
    assert_allclose(0.5 * z @ P @ z, 0.5 * v @ M @ v + v @ M @ G @ s + least)
    assert_allclose(P, P.T)


def test_stacks_are_evaluated_one_by_one():
    plant, controller, rng = closed_loop("ur5", None)
    _, kv, damping = controller.diagonals
    many = [terms(plant, controller, plant.robot.random_configuration(rng)) for _ in range(3)]
    M, dM, J, J_hat, dJ_hat = (np.stack(parts) for parts in zip(*many, strict=True))
    s, slope = rng.normal(size=(2, 3, 3))
    D = law.dissipation(J_hat, kv, damping)
    G, dG = law.cross_weight_damped(D, J_hat, dJ_hat, kv)
    N = law.inertial_block(M, dM, J, G, dG, s, slope)
    for i in range(3):
        G_i, dG_i = law.cross_weight_damped(
            law.dissipation(J_hat[i], kv, damping), J_hat[i], dJ_hat[i], kv
        )
        N_i = law.inertial_block(M[i], dM[i], J[i], G_i, dG_i, s[i], slope[i])
        assert_allclose(N[i], N_i, rtol=1e-10, atol=1e-12)
        assert_allclose(
            law.potential_matrix(M, G, np.diag(kv))[i],
            law.potential_matrix(M[i], G_i, np.diag(kv)),
        )
