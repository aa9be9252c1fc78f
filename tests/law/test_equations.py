"""Each equation against its text, written out entry by entry."""

import numpy as np
import pytest
from numpy.testing import assert_allclose

from approxjac import law

M, NV, P = 3, 5, 4


@pytest.fixture
def numbers(rng):
    return {
        "J_hat": rng.normal(size=(M, NV)),
        "kp": rng.uniform(1, 2, M),
        "kv": rng.uniform(1, 2, M),
        "s": rng.normal(size=M),
        "v": rng.normal(size=NV),
        "damping": rng.uniform(0, 1, NV),
    }


def force(n, x_dot):
    return n["J_hat"].T @ (np.diag(n["kp"]) @ n["s"] + np.diag(n["kv"]) @ x_dot)


def test_eq_5(numbers, rng):
    x_dot, g = rng.normal(size=M), rng.normal(size=NV)
    tau = law.measured_velocity_torque(**numbers, x_dot=x_dot, g=g)
    assert_allclose(tau, -force(numbers, x_dot) - numbers["damping"] * numbers["v"] + g)


def test_eq_6(numbers, rng):
    g = rng.normal(size=NV)
    tau = law.estimated_velocity_torque(**numbers, g=g)
    x_dot = numbers["J_hat"] @ numbers["v"]
    assert_allclose(tau, -force(numbers, x_dot) - numbers["damping"] * numbers["v"] + g)


def test_eq_27_and_28(numbers, rng):
    Z, theta = rng.normal(size=(NV, P)), rng.normal(size=P)
    assert_allclose(law.gravity(Z, theta), [sum(row * theta) for row in Z])
    tau = law.estimated_velocity_torque(**numbers, g=law.gravity(Z, theta))
    x_dot = numbers["J_hat"] @ numbers["v"]
    assert_allclose(tau, -force(numbers, x_dot) - numbers["damping"] * numbers["v"] + Z @ theta)


def test_eq_10(numbers):
    pinv_s = np.linalg.pinv(numbers["J_hat"]) @ numbers["s"]
    y = law.passive_output(numbers["v"], pinv_s, 0.3)
    assert_allclose(y, numbers["v"] + 0.3 * np.linalg.pinv(numbers["J_hat"]) @ numbers["s"])


def test_eq_29(rng):
    Z, y = rng.normal(size=(NV, P)), rng.normal(size=NV)
    diagonal = rng.uniform(1, 2, P)
    assert_allclose(law.theta_hat_rate(diagonal, Z, y), -np.diag(diagonal) @ Z.T @ y)
    root = rng.normal(size=(P, P))
    matrix = root @ root.T + np.eye(P)
    assert_allclose(law.theta_hat_rate(matrix, Z, y), -matrix @ Z.T @ y)


def test_eq_31(rng):
    theta, diagonal = rng.normal(size=P), rng.uniform(1, 2, P)
    assert_allclose(law.parameter_potential(theta, diagonal), sum(theta**2 / diagonal) / 2)
    root = rng.normal(size=(P, P))
    matrix = root @ root.T + np.eye(P)
    expected = theta @ np.linalg.inv(matrix) @ theta / 2
    assert_allclose(law.parameter_potential(theta, matrix), expected)


def test_eq_7(rng):
    J, J_hat = rng.normal(size=(2, M, NV))
    assert_allclose(law.jacobian_error(J, J_hat), np.linalg.svd((J - J_hat).T, compute_uv=False)[0])


def test_eq_23_to_25():
    J_hat = np.array([[2.0, 0.0], [0.0, 3.0]])
    lambda2 = law.lambda_2(J_hat, np.array([0.5, 0.1]))
    assert_allclose(lambda2, 4.5)
    assert_allclose(law.lambda_2(np.array([[2.0, 0.0]]), np.zeros(2)), 0.0, atol=1e-15)
    for alpha in (0.1, 1.0, 2.1, 7.0):
        crossing = np.array([lambda2 / alpha])
        expected = law.allowed_p_at_crossing(alpha, lambda2)
        assert_allclose(law.allowed_p_velocity(crossing, alpha, lambda2), [expected])
        assert_allclose(law.allowed_p_position(crossing, alpha), [expected])
        assert expected <= law.largest_allowed_p(lambda2) + 1e-15
    best = law.largest_allowed_p(lambda2)
    assert_allclose(law.allowed_p_at_crossing(best, lambda2), best)
    assert_allclose(best, np.sqrt(lambda2))
    a = np.linspace(0.1, 5, 50)
    assert (np.diff(law.allowed_p_velocity(a, 1.0, lambda2)) < 0).all()
    assert (np.diff(law.allowed_p_position(a, 1.0)) > 0).all()


def test_v_of_eq_12(rng):
    pinv, inertia = rng.normal(size=(NV, M)), np.diag(rng.uniform(1, 2, NV))
    v, s, potential = rng.normal(size=NV), rng.normal(size=M), rng.uniform(0, 1, M)
    kp, kv, alpha = rng.uniform(1, 2, M), rng.uniform(1, 2, M), 0.3
    kinetic = 0.5 * v @ inertia @ v
    cross = alpha * v @ inertia @ pinv @ s
    stored = sum((kp[i] + alpha * kv[i]) * potential[i] for i in range(M))
    assert_allclose(law.V(v, s, potential, pinv, inertia, kp, kv, alpha), kinetic + cross + stored)


def test_w_of_eq_13_term_by_term(numbers, rng):
    J, J_hat, s, v = rng.normal(size=(M, NV)), numbers["J_hat"], numbers["s"], numbers["v"]
    kp, kv, B, alpha = numbers["kp"], numbers["kv"], numbers["damping"], 0.3
    pinv, pinv_dot = rng.normal(size=(2, NV, M))
    inertia, inertia_dot = rng.normal(size=(2, NV, NV))
    inertia = inertia + inertia.T
    s_dot, coriolis = rng.normal(size=M), rng.normal(size=NV)
    moving = inertia, inertia_dot, coriolis
    W = law.W(v, (s, s_dot), J, J_hat, (pinv, pinv_dot), moving, B, kp, kv, alpha)
    Kp, Kv = np.diag(kp), np.diag(kv)
    expected = (
        v @ (J_hat.T @ Kv @ J_hat + np.diag(B)) @ v
        + alpha * s @ Kp @ s
        - v @ (J - J_hat).T @ (Kp + alpha * Kv) @ s
        + alpha * s @ pinv.T @ (B * v + coriolis - inertia_dot @ v)
        - alpha * s_dot @ pinv.T @ inertia @ v
        - alpha * s @ pinv_dot.T @ inertia @ v
    )
    assert_allclose(W, expected)


def test_w_of_eq_13_without_alpha_is_damping_less_the_mismatch(rng):
    J, J_hat = rng.normal(size=(2, M, NV))
    v, s = rng.normal(size=NV), rng.normal(size=M)
    kp, kv, B = rng.uniform(1, 2, M), rng.uniform(1, 2, M), rng.uniform(0, 1, NV)
    zeros = np.zeros((NV, M))
    inertia = np.eye(NV), np.zeros((NV, NV)), np.zeros(NV)
    W = law.W(v, (s, np.zeros(M)), J, J_hat, (zeros, zeros), inertia, B, kp, kv, 0.0)
    expected = v @ (J_hat.T @ np.diag(kv) @ J_hat + np.diag(B)) @ v - v @ (J - J_hat).T @ (kp * s)
    assert_allclose(W, expected)


def test_linearization_of_eq_9_for_a_point_mass():
    # m ẍ = −k_p x − (k_v + b) ẋ: the roots of a damped oscillator
    A = law.closed_loop_matrix(
        np.array([[2.0]]), np.eye(1), np.eye(1), np.array([8.0]), np.array([1.5]), np.array([0.5])
    )
    assert_allclose(np.sort_complex(np.linalg.eigvals(A)), np.roots([2.0, 2.0, 8.0])[::-1])


def test_linearization_of_many_postures_is_that_of_each(rng):
    many, one = (2, 3), (1, 2)
    J, J_hat = rng.normal(size=(2, *many, M, NV))
    root = rng.normal(size=(*many, NV, NV))
    inertia = root @ np.swapaxes(root, -1, -2) + np.eye(NV)
    kp, kv, B = rng.uniform(1, 2, M), rng.uniform(1, 2, M), rng.uniform(0, 1, NV)
    A = law.closed_loop_matrix(inertia, J, J_hat, kp, kv, B)
    assert A.shape == (*many, 2 * NV, 2 * NV)
    alone = law.closed_loop_matrix(inertia[one], J[one], J_hat[one], kp, kv, B)
    assert_allclose(A[one], alone)


def test_linearization_of_eqs_28_and_29_entry_by_entry(numbers, rng):
    J, Z, alpha = rng.normal(size=(M, NV)), rng.normal(size=(NV, P)), 0.3
    root = rng.normal(size=(NV, NV))
    inertia, B = root @ root.T + np.eye(NV), rng.uniform(0, 1, NV)
    pinv = np.linalg.pinv(numbers["J_hat"])
    diagonal, root = rng.uniform(1, 2, P), rng.normal(size=(P, P))
    v, dq, dtheta = rng.normal(size=NV), rng.normal(size=NV), rng.normal(size=P)
    for L in (diagonal, root @ root.T + np.eye(P)):
        A = law.closed_loop_matrix(
            inertia, J, numbers["J_hat"], numbers["kp"], numbers["kv"], B, (Z, L, alpha * pinv)
        )
        s = J @ dq  # s'(0) = 1
        damping = np.zeros(NV)
        torque = law.estimated_velocity_torque(
            numbers["J_hat"], numbers["kp"], numbers["kv"], s, v, damping, Z @ dtheta
        )
        acceleration = np.linalg.solve(inertia, torque - B * v)
        rate = law.theta_hat_rate(L, Z, law.passive_output(v, pinv @ s, alpha))
        assert_allclose(
            A @ np.concatenate([dq, v, dtheta]), np.concatenate([v, acceleration, rate])
        )
