"""The tracking law's equations: each against the derivative of what it is the derivative of."""

import numpy as np
import pytest
from numpy.testing import assert_allclose
from potentials import V2

from approxjac import law


def rate_of(function, h=1e-6):
    """Central difference of a function of time at 0."""
    return (np.asarray(function(h)) - np.asarray(function(-h))) / (2.0 * h)


@pytest.mark.parametrize("speed", [0.5, np.array([0.1, 1.0, np.inf])])
@pytest.mark.parametrize("size", [1e-9, 0.01, 1.0, 100.0])
def test_the_saturated_error_is_bounded_and_has_its_rate(rng, speed, size):
    z, z_dot, k = size * rng.normal(size=3), rng.normal(size=3), 4.0 / speed
    s, s_dot = law.saturated(z, z_dot, k)
    assert (np.abs(4.0 * s) <= speed).all()
    if size < 1e-6:
        assert_allclose(s, z, rtol=1e-9)
    assert s @ z == pytest.approx(np.linalg.norm(s) * np.linalg.norm(z))  # along z
    expected = rate_of(lambda t: law.saturated(z + t * z_dot, z_dot, k)[0])
    assert_allclose(s_dot, expected, atol=1e-8)


def test_the_task_velocity_has_its_rate(rng):
    z, z_dot, feed, feed_dot = rng.normal(size=(4, 3))
    for rate in (None, 2.0):  # of α

        def velocity(t, rate=rate):
            alpha, now = 3.0 + (rate or 0.0) * t, (z + t * z_dot, z_dot, feed + t * feed_dot)
            return law.task_velocity(*now, feed_dot, alpha, 8.0 / 3.0, rate)

        u, u_dot = velocity(0.0)
        assert_allclose(u, feed - 3.0 * law.saturated(z, z_dot, 8.0)[0])
        assert_allclose(u_dot, rate_of(lambda t, u=velocity: u(t)[0]), atol=1e-8)


def motion(rng, m, n, singular=None):
    """Ĵ(t), u(t), n₀(t) that are smooth, and near-singular at t = 0 if asked for."""
    J0, J1, J2 = rng.normal(size=(3, m, n))
    if singular is not None:
        U, values, V = np.linalg.svd(J0, full_matrices=False)
        values[-1] = singular * values[0]
        J0 = (U * values) @ V
    u0, u1, n0, n1 = (rng.normal(size=k) for k in (m, m, n, n))
    return (
        lambda t: J0 + t * J1 + t * t * J2,
        lambda t: u0 + t * u1,
        lambda t: n0 + t * n1,
        J1, u1, n1,
    )  # fmt: skip


@pytest.mark.parametrize("shape", [(1, 4), (2, 2), (2, 5), (3, 6), (3, 7), (6, 7)])
@pytest.mark.parametrize("singular", [None, 0.03, 0.01, 1e-4])
def test_the_reference_acceleration_is_the_derivative_of_the_reference_velocity(
    rng, shape, singular
):
    """Damped as well; the singular ratio is 0.05."""
    J, u, null, J_dot, u_dot, null_dot = motion(rng, *shape, singular)
    arguments = {"singular_ratio": 0.05, "scale": 0.01}

    def velocity(t):
        zeros = np.zeros_like(u_dot), null(t), np.zeros_like(null_dot)
        return law.reference(J(t), np.zeros(shape), u(t), *zeros, **arguments)[0]

    v, a, damped = law.reference(J(0), J_dot, u(0), u_dot, null(0), null_dot, **arguments)
    if shape[0] > 1:  # of one row the scale decides
        assert (damped > 0.0) == (singular is not None)
    expected = rate_of(velocity)
    assert_allclose(a, expected, atol=2e-6 * max(1.0, np.abs(expected).max()))
    if damped == 0.0:
        assert_allclose(J(0) @ v, u(0), atol=1e-10)
        assert_allclose(J_dot @ v + J(0) @ a, u_dot, atol=1e-9)


def test_damping_by_the_scale_has_its_rate_too(rng):
    """Where all singular values are small at once, the threshold is a constant."""
    J, u, null, J_dot, u_dot, null_dot = motion(rng, 3, 7)
    few = {"singular_ratio": 0.05, "scale": 300.0}

    def velocity(t):
        return law.reference(J(t), J_dot, u(t), u_dot, null(t), null_dot, **few)[0]

    _, a, damped = law.reference(J(0), J_dot, u(0), u_dot, null(0), null_dot, **few)
    assert damped > 0.0
    assert_allclose(a, rate_of(velocity), rtol=1e-5, atol=1e-6)


def test_an_eased_target_follows_one_that_accelerates(rng):
    """Once it is there, with its velocity, it stays there to round-off, in long periods, too."""
    per, start, speed, a = np.array([2.0, 1.0]), *rng.normal(size=(3, 2))
    eased, begin = law.EasedTarget(4.0, per, 0.02), -0.3

    def goal(t):
        return start + speed * t + 0.5 * a * t * t, speed + a * t, a

    memory = eased.start(*goal(begin)[:2])
    for k in range(50):
        t = begin + 0.02 * k
        memory, led = eased.step(memory, goal(t)[0], goal(t), 6.0)
        for own, wanted in zip(led, goal(t), strict=True):
            assert_allclose(own, wanted, atol=1e-12)


@pytest.mark.parametrize("near_stops", [False, True])
@pytest.mark.parametrize("sliding", [False, True])
def test_joints_share_the_motion_that_the_task_needs(rng, near_stops, sliding):
    """Ĵq̇_r = u whatever the shares are, and q̈_r is the derivative along the motion."""
    J, _, null, J_dot, _, null_dot = motion(rng, 3, 7)
    z, drift, feed, v = (rng.normal(size=k) for k in (3, 3, 3, 7))
    q = rng.uniform(0.7, 0.95, 7) * rng.choice([-1.0, 1.0], 7) if near_stops else np.zeros(7)
    ones = np.ones(7)
    stops = law.StopZones.of(-ones, ones, 0.5 * ones, 0.1 * ones)
    shares = np.geomspace(0.02, 1.0, 7) if sliding else None
    gains = law.ReferenceGains(3.0, 1.0 / 0.5, np.full(7, np.inf), 1e-3, 0.0, stops, shares)

    def stepped(t):
        # q̇ is constant, ż = Ĵq̇ − ẋ_d + drift
        z_dot = J(0.0) @ v - feed + drift
        error = law.PredictedError(z + t * z_dot, J(t), J_dot, feed, np.zeros(3), drift)
        return law.reference_step(error, v, (null(t), null_dot), False, gains, q + t * v)

    v_r, a_r, damped, is_known = stepped(0.0)
    assert is_known
    assert not damped
    z_dot = J(0.0) @ v - feed + drift
    u, u_dot = law.task_velocity(z, z_dot, feed, np.zeros(3), 3.0, 2.0)
    assert_allclose(J(0.0) @ v_r, u, atol=1e-9)
    assert_allclose(J(0.0) @ a_r + J_dot @ v_r, u_dot, rtol=1e-7, atol=1e-7)
    expected = rate_of(lambda t: stepped(t)[0])
    assert_allclose(a_r, expected, atol=1e-5 * max(1.0, np.abs(expected).max()))
    if sliding and not near_stops:
        alone = law.reference(J(0.0), J_dot, u, u_dot, null(0.0), null_dot, 1e-3)[0]
        assert np.abs((v_r - null(0.0))[0]) < 0.2 * np.abs((alone - null(0.0))[0])


def test_what_is_far_from_a_stop_is_in_no_zone(rng):
    """Whatever is rounded: also within a few last digits of where a zone begins."""
    low, high = np.sort(rng.uniform(-4.0, 4.0, (2, 7)), axis=0)
    stops = law.StopZones.of(low, high, 0.12 * (high - low), np.ones(7))
    far = 0
    for _ in range(2000):
        edge = np.where(rng.random(7) < 0.5, low + stops.zone, high - stops.zone)
        q, v_r = (
            edge + rng.choice([0.0, 1e-15, 1e-3, 0.1], 7) * rng.normal(size=7),
            rng.normal(size=7),
        )
        near, sides = stops.near(q)
        if stops.are_far(q, v_r):
            far += 1
            assert not ((near > 0.0) & (sides * v_r > 0.0)).any()
    assert far > 20


def test_joints_at_a_stop_are_hardly_pushed_into_it(rng):
    """Three of seven joints at their ends: neither at first nor for what the others leave."""
    ones, nothing, speeds, shares = np.ones(7), np.zeros(7), [], []
    stops = law.StopZones.of(-ones, ones, 0.5 * ones, 0.1 * ones)
    gains = law.ReferenceGains(6.0, 2.0, np.full(7, np.inf), 1e-3, 0.0, stops)
    for _ in range(200):
        J, z, still = rng.normal(size=(3, 7)), 0.05 * rng.normal(size=3), np.zeros(3)
        q = np.append(rng.choice([-1.0, 1.0], 3), np.zeros(4))
        error = law.PredictedError(z, J, 0.0 * J, still, still, still)
        v_r = law.reference_step(error, nothing, (nothing, nothing), False, gains, q)[0]
        assert_allclose(J @ v_r, law.task_velocity(z, still, still, still, 6.0, 2.0)[0], atol=1e-9)
        speeds.append(max(0.0, (q * v_r).max()))
        shares.append(speeds[-1] / np.linalg.norm(v_r))
    assert np.quantile(shares, 0.97) < 0.1
    assert np.median(speeds) < 0.2 * 0.1  # a fifth of v₀ counts as much at the end


def test_a_jacobian_of_zeros_leaves_the_self_motion():
    null = np.arange(4.0)
    zeros = np.zeros((2, 4)), np.zeros((2, 4)), np.ones(2), np.zeros(2), null, np.zeros(4)
    v, a, _ = law.reference(*zeros)
    assert_allclose(v, null)
    assert_allclose(a, 0.0)


def test_speeds_are_brought_within_their_limits_as_a_whole(rng):
    fastest = np.array([0.5, np.inf, 2.0, 0.3, 1.0])
    for i, share in ((3, -1.5), (3, 4.0), (0, 1.2), (2, -3.0)):
        v0, v1 = 0.1 * rng.normal(size=(2, 5))
        v0[i] = share * fastest[i]  # the one that is farthest beyond
        v, a = law.within_speeds(v0, v1, fastest)
        assert v[i] == pytest.approx(np.sign(share) * fastest[i])
        assert_allclose(v, v0 / abs(share))
        expected = rate_of(lambda t, v0=v0, v1=v1: law.within_speeds(v0 + t * v1, v1, fastest)[0])
        assert_allclose(a, expected, atol=1e-8)
    slow, slowly = law.within_speeds(0.1 * fastest[[0, 2]], v1[:2], fastest[[0, 2]])
    assert_allclose(slow, 0.1 * fastest[[0, 2]])
    assert_allclose(slowly, v1[:2])


def test_v3_of_a_servo_falls_by_a_square_of_sigma(rng):
    """V̇₃ = −σᵀ(I + LD)σ for L q̈ + q̇ = q̇_r + L̂w, q̈_r = w + Dσ and L̂' = −γ wᵀσ."""
    sigma, w = rng.normal(size=(2, 4))
    D, L, estimate, gamma = rng.normal(size=(4, 4)), 0.04, 0.01, 2.0
    sigma_dot = (estimate * w - sigma) / L - (w + D @ sigma)
    rate = law.servo_lag_rate(gamma, w, sigma)

    def V(t):
        off, s = estimate + t * rate - L, sigma + t * sigma_dot
        return 0.5 * L * s @ s + off * off / (2.0 * gamma)

    assert_allclose(rate_of(V), -sigma @ (sigma + L * D @ sigma), rtol=1e-7)


def test_v2_falls_by_what_the_gain_dissipates(rng):
    """V̇₂ = −κσᵀM̂σ for Mσ̇ = −Cσ − κM̂σ + Y_d(â − a), Ṁ − 2C skew, â' = −ΓY_dᵀσ."""
    n, p, kappa = 4, 6, 3.0
    sigma, a_error, Y = rng.normal(size=n), rng.normal(size=p), rng.normal(size=(n, p))
    gamma, skew = rng.uniform(0.1, 2.0, p), rng.normal(size=(n, n))
    M, M_hat = (root @ root.T + np.eye(n) for root in rng.normal(size=(2, n, n)))
    M_dot = rng.normal(size=(n, n))
    M_dot = M_dot + M_dot.T
    C = 0.5 * (M_dot + skew - skew.T)
    # Y_d(â − a), less the motion's
    torque = law.tracking_torque(-Y @ a_error, kappa * M_hat @ sigma)
    sigma_dot = np.linalg.solve(M, torque - C @ sigma)
    a_rate = law.dynamics_rate(gamma, Y.T @ sigma)

    def V(t):
        return V2(sigma + t * sigma_dot, M + t * M_dot, a_error - t * a_rate, gamma)

    assert_allclose(rate_of(V), -kappa * sigma @ M_hat @ sigma, rtol=1e-7)
