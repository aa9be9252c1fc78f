"""Moves: V̇, the torque's rate and the own path, against derivatives along a simulated step."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from wrong_loop import closed_loop, terms

import approxjac as aj
from approxjac import law
from approxjac.law import moves, sampled_form

SPEED, RATE = 0.4, 1.3  # of the target, and its acceleration
LOOPS = [("two_link", law.Linear(), 0), ("panda", law.Tanh(0.05), 1), ("ur5", law.Sine(0.2), 5)]


class Moving:
    """A wrong loop on its way along a line, with all terms at states near one."""

    def __init__(self, name, saturation, seed):
        plant, self.law, rng = closed_loop(name, saturation, seed)
        n = plant.robot.nv
        # unequal, as T takes none of Ĵᵀ's range, where equal friction of r = Ĵ⁺d lies
        self.plant = aj.Plant(plant.robot, plant.sensor, friction=rng.uniform(0.1, 0.9, n))
        self.q, self.v = rng.uniform(0.3, 1.2, n), rng.normal(size=n)
        self.d = rng.normal(size=self.plant.sensor.m)
        self.x_d = self.plant.sensor.value(self.q) + rng.uniform(-0.1, 0.1, len(self.d))
        self.w, self.weights = rng.normal(size=n), rng.uniform(100.0, 500.0, len(self.d))
        self.alpha = 2.0
        acting = self.torque(self.q, self.v, 0.0) + self.w
        friction = self.plant.friction
        self.v_dot = self.plant.dynamics.forward(
            self.q, self.v, acting - friction * self.v + self.plant.dynamics.g(self.q)
        )

    def at(self, q, t):
        """Terms at q and a time near 0."""
        M, dM, J, J_hat, dJ_hat = terms(self.plant, self.law, q)
        e = self.plant.sensor.value(q) - self.x_d - (SPEED * t + 0.5 * RATE * t**2) * self.d
        dJ = [self.plant.sensor.jacobian_dot(q, unit) for unit in np.eye(len(q))]
        pinv = law.cross_weight_pinv(J_hat, dJ_hat)
        return M, dM, J, np.array(dJ), J_hat, dJ_hat, pinv, e

    def motion(self):
        *gains, damping = self.law.diagonals
        *inertia, J, _, J_hat, dJ_hat, pinv, e = self.at(self.q, 0.0)
        saturated = self.law.saturation.s(e), self.law.saturation.ds(e)
        D_c, dg = law.dissipation(J_hat, gains[1], damping), np.zeros_like(inertia[0])
        estimated, friction = (J_hat, dJ_hat), self.plant.friction
        return moves.motion(
            inertia, D_c, J, estimated, pinv, self.d, saturated, dg, gains, friction
        )

    def torque(self, q, v, t):
        """The law of a moving target but for gravity, which is exact."""
        kp, kv, damping = self.law.diagonals
        *_, J_hat, _, pinv, e = self.at(q, t)
        nu = v - (SPEED + RATE * t) * pinv[0] @ self.d
        return -J_hat.T @ (kp * self.law.saturation.s(e) + kv * (J_hat @ nu)) - damping * nu

    def rate_of(self, function):
        """The derivative along the loop, by a central difference of second order in q."""

        def there(t):
            return function(
                self.q + t * self.v + 0.5 * t**2 * self.v_dot, self.v + t * self.v_dot, t
            )

        return (there(1e-5) - there(-1e-5)) / 2e-5


@pytest.mark.parametrize(("name", "saturation", "seed"), LOOPS)
def test_v_of_a_move_changes_as_lemma_1_says(name, saturation, seed):
    loop = Moving(name, saturation, seed)
    kp, kv, damping = loop.law.diagonals

    def V(q, v, t):
        M, *_, pinv, e = loop.at(q, t)
        nu, G = v - (SPEED + RATE * t) * pinv[0] @ loop.d, loop.alpha * pinv[0]
        rest = loop.weights @ saturation.S(e)
        return 0.5 * nu @ M @ nu + nu @ M @ G @ saturation.s(e) + rest

    M, dM, J, _, J_hat, _, pinv, e = loop.at(loop.q, 0.0)
    at, (G, dG) = loop.motion(), (loop.alpha * each for each in pinv)
    s, slope, nu = saturation.s(e), saturation.ds(e), loop.v - SPEED * at.r
    D = law.dissipation(J_hat, kv, damping + loop.plant.friction)
    N = law.inertial_block(M, dM, J, G, dG, s, slope)
    Q = law.decrease_matrix(D, N, J, J_hat, G, kp, loop.weights)
    z, f = np.append(nu, s), SPEED**2 * at.f[0] + RATE * at.f[1] + SPEED * at.f[2]
    wanted = -z @ (Q - SPEED * moves.moving_part(at, M, G, dG)) @ z
    wanted += (nu + G @ s) @ (loop.w - f)
    wanted += SPEED * at.delta @ (loop.weights * s + slope * (G.T @ M @ nu))
    assert_allclose(loop.rate_of(V), wanted, rtol=1e-6)


@pytest.mark.parametrize(("name", "saturation", "seed"), LOOPS)
def test_the_torque_of_a_move_gains_psi_and_what_is_linear_in_nu(name, saturation, seed):
    loop = Moving(name, saturation, seed)
    kp, kv, damping = loop.law.diagonals
    M, dM, J, _, J_hat, dJ_hat, _, e = loop.at(loop.q, 0.0)
    at = loop.motion()
    s, slope, nu = saturation.s(e), saturation.ds(e), loop.v - SPEED * at.r
    D_c = law.dissipation(J_hat, kv, damping)
    D = D_c + np.diag(loop.plant.friction)
    rate = sampled_form.torque_rate(M, D, D_c, J_hat, dJ_hat, J, s, slope, kp)
    half = np.einsum("kij,k->ij", dJ_hat, nu).T @ (kv[:, None] * J_hat)
    quadratic = D_c @ np.linalg.solve(M, np.einsum("aij,i,j->a", moves.christoffel(dM), nu, nu))
    wanted = rate.T @ np.append(nu, s) + rate.U @ loop.w
    wanted += quadratic - (half + half.T) @ nu + SPEED * at.turning @ nu
    wanted += SPEED**2 * at.psi[0] + RATE * at.psi[1] + SPEED * at.psi[2]
    found = loop.rate_of(loop.torque)
    assert_allclose(found, wanted, atol=1e-6 * np.abs(found).max())


@pytest.mark.parametrize(("name", "saturation", "seed"), LOOPS)
def test_the_own_path_is_left_by_quadratic_terms_alone(name, saturation, seed):
    loop = Moving(name, saturation, seed)
    friction = loop.plant.friction
    B = loop.law.diagonals.damping + friction

    def own(q, t):
        _, _, J, dJ, J_hat, dJ_hat, pinv, e = loop.at(q, t)
        return moves.own_path(J, dJ, J_hat, dJ_hat, pinv, loop.d, B, friction), e

    def chi(q, v, t):
        (path, e), M = own(q, t), loop.at(q, t)[0]
        return q - path.H @ e + path.T @ M @ v

    M, dM, J, _, J_hat, *_ = loop.at(loop.q, 0.0)
    (path, e), v = own(loop.q, 0.0), loop.v
    H_dot, T_dot = (np.einsum("kij,k->ij", each, v) for each in (path.dH, path.dT))
    C = np.einsum("aij,i->aj", moves.christoffel(dM), v)
    wanted = SPEED * path.h - H_dot @ e + (T_dot @ M + path.T @ C.T) @ v + path.T @ loop.w
    assert_allclose(loop.rate_of(chi), wanted, atol=1e-6 * np.abs(wanted).max())
    assert_allclose(path.T @ J_hat.T, 0.0, atol=1e-12)
    assert_allclose(J @ path.h, loop.d, atol=1e-12)
    h, H = moves.path_rate(J, J_hat, loop.d, B, friction)
    assert_allclose(h, path.h, atol=1e-12)
    assert_allclose(H, path.H, atol=1e-12)
    for k, unit in enumerate(np.eye(len(v))):
        ahead, behind = (own(loop.q + t * unit, 0.0)[0] for t in (1e-6, -1e-6))
        assert_allclose((ahead.h - behind.h) / 2e-6, path.dh[:, k], atol=1e-6)
        assert_allclose((ahead.H - behind.H) / 2e-6, path.dH[k], atol=1e-6)
        assert_allclose((ahead.T - behind.T) / 2e-6, path.dT[k], atol=1e-6)


def test_the_hold_leaves_half_a_period_and_quadratic_terms_as_lemma_5_says():
    loop = Moving("panda", law.Tanh(0.05), 1)
    B_n, B_c = loop.plant.friction, loop.law.diagonals.damping
    B, dynamics, h, steps = B_n + B_c, loop.plant.dynamics, 4e-3, 40
    dt = h / steps

    def terms_at(q, v, t, u, tau):
        """Tw, a = TB_cν, the integrand of R, and what |T||w| would be."""
        M, dM, J, dJ, J_hat, dJ_hat, pinv, _ = loop.at(q, t)
        path = moves.own_path(J, dJ, J_hat, dJ_hat, pinv, loop.d, B, B_n)
        speed, r, inverse = SPEED + RATE * t, pinv[0] @ loop.d, np.linalg.inv(M)
        w, theta = tau - loop.torque(q, v, t) - dynamics.g(q), path.T * B_c @ inverse
        dT, dM_v = np.einsum("kij,k->ij", path.dT, v), np.einsum("kij,k->ij", dM, v)
        dtheta, nu = (dT * B_c - theta @ dM_v) @ inverse, v - speed * r
        C = np.einsum("aij,i->aj", moves.christoffel(dM), v)
        r_dot = RATE * r + speed * np.einsum("kim,k->im", pinv[1], v) @ loop.d
        root = np.linalg.cholesky(law.dissipation(J_hat, loop.law.diagonals.kv, B))
        fallen = np.linalg.norm(np.linalg.solve(root, dynamics.g_gradient(q) @ v))
        T_D, theta_D = (np.linalg.norm(each @ root, axis=1) for each in (path.T, theta))
        rest = 0.5 * h * np.abs(dT @ (B_c * nu)) + h * np.abs(dT @ u)
        rest += (
            h * h / 8.0 * np.abs(dtheta @ u) + 1.01 * (h * T_D + 0.25 * h * h * theta_D) * fallen
        )
        rest += 0.5 * h * np.abs(theta @ (C @ v + B_n * v) + path.T @ (B_c * r_dot))
        plain = T_D * np.linalg.norm(np.linalg.solve(root, w))
        return path.T @ w, path.T @ (B_c * nu), rest, plain

    q, v = loop.q, SPEED * loop.at(loop.q, 0.0)[-2][0] @ loop.d
    whole, rests, plains, largest, R, varied = (np.zeros(7) for _ in range(6))
    for k in range(15):
        u = loop.torque(q, v, k * h)
        tau, before = u + dynamics.g(q), None
        for j in range(steps + 1):
            t = k * h + j * dt
            Tw, a, rest, plain = terms_at(q, v, t, u, tau)
            if before is None:
                a_k = a
            else:
                whole, rests, plains = (
                    total + 0.5 * dt * (one + other)
                    for total, one, other in zip(
                        (whole, rests, plains), (Tw, rest, plain), before, strict=True
                    )
                )
                R_before, R = R, whole - 0.5 * ((h - j * dt) * a_k + j * dt * a)
                varied = varied + np.abs(R - R_before)
                largest = np.maximum(largest, varied / rests)
            before = (Tw, rest, plain)
            if j < steps:
                there = q + 0.5 * dt * v, v + 0.5 * dt * forward(loop, q, v, tau)
                q, v = q + dt * there[1], v + dt * forward(loop, *there, tau)
    assert (largest <= 1.0).all()
    assert largest.max() > 0.1  # and it is no empty bound
    assert (rests < 0.5 * plains).all()  # of |T||w| far less is left


def forward(loop, q, v, tau):
    return loop.plant.dynamics.forward(q, v, tau - loop.plant.friction * v)
