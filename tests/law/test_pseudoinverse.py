import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose

from approxjac import law
from approxjac.law.pseudoinverse import SINGULAR_RATIO

entries = st.floats(-1e3, 1e3).map(lambda x: round(x, 6))
wide = st.tuples(st.integers(1, 4), st.integers(0, 4)).flatmap(
    lambda mn: arrays(np.float64, (mn[0], mn[0] + mn[1]), elements=entries)
)


def with_singular_values(values, rng):
    m = len(values)
    U, _ = np.linalg.qr(rng.normal(size=(m, m)))
    Vt, _ = np.linalg.qr(rng.normal(size=(m + 2, m + 2)))
    return U @ np.diag(values) @ Vt[:m]


def test_away_from_singular_poses_it_is_the_pseudoinverse(rng):
    J = with_singular_values([2.0, 1.0, 0.1], rng)
    pinv, sigma_min, damping = law.damped_right_pinv(J)
    assert_allclose(pinv, np.linalg.pinv(J), atol=1e-11)
    assert_allclose(law.right_pinv(J), np.linalg.pinv(J), atol=1e-11)
    assert_allclose(J @ pinv, np.eye(3), atol=1e-12)
    assert_allclose(sigma_min, 0.1)
    assert damping == 0.0


@given(wide)
def test_it_is_always_finite_and_bounded(J):
    pinv, sigma_min, damping = law.damped_right_pinv(J)
    values = np.linalg.svd(J, compute_uv=False)
    assert np.isfinite(pinv).all()
    assert pinv.shape == J.shape[::-1]
    if values[0] > 0:
        assert np.linalg.norm(pinv, 2) <= 1.0 / (SINGULAR_RATIO * values[0]) * (1 + 1e-6)
    assert_allclose(sigma_min, values[-1], atol=1e-6 * max(values[0], 1e-300))
    assert damping >= 0.0


def test_it_is_continuous_through_a_singular_pose(rng):
    U, _ = np.linalg.qr(rng.normal(size=(2, 2)))
    Vt, _ = np.linalg.qr(rng.normal(size=(3, 3)))
    grid = np.linspace(0.05, -0.05, 20001)
    path = [law.damped_right_pinv(U @ np.diag([1.0, x]) @ Vt[:2])[0] for x in grid]
    steps = np.linalg.norm(np.diff(path, axis=0), axis=(1, 2))
    assert steps.max() < 10.0 * (grid[0] - grid[1]) / SINGULAR_RATIO**2


def test_a_zero_jacobian_gives_zero():
    pinv, sigma_min, damping = law.damped_right_pinv(np.zeros((2, 4)))
    assert np.array_equal(pinv, np.zeros((4, 2)))
    assert sigma_min == damping == 0.0


def test_units_do_not_matter(rng):
    J = with_singular_values([1.0, 0.01], rng)
    a, _, damping_a = law.damped_right_pinv(J)
    b, _, damping_b = law.damped_right_pinv(1e-3 * J)
    assert damping_a > 0
    assert_allclose(1e-3 * b, a, rtol=1e-9)
    assert_allclose(damping_b, 1e-3 * damping_a, rtol=1e-9)


def test_rate_by_finite_differences(rng):
    J, J_dot = rng.normal(size=(2, 3, 6))
    h = 1e-6
    expected = (law.right_pinv(J + h * J_dot) - law.right_pinv(J - h * J_dot)) / (2 * h)
    assert_allclose(law.right_pinv_dot(J, J_dot), expected, atol=1e-7)
