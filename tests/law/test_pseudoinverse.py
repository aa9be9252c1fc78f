import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from numpy.testing import assert_allclose

from approxjac import law
from approxjac.law.pseudoinverse import SINGULAR_RATIO
from approxjac.law.steps import within_null_space

entries = st.floats(-1e3, 1e3).map(lambda x: round(x, 6))
wide = st.tuples(st.integers(1, 4), st.integers(0, 4)).flatmap(
    lambda mn: arrays(np.float64, (mn[0], mn[0] + mn[1]), elements=entries)
)


def with_singular_values(values, rng):
    m = len(values)
    U, _ = np.linalg.qr(rng.normal(size=(m, m)))
    Vt, _ = np.linalg.qr(rng.normal(size=(m + 2, m + 2)))
    return U @ np.diag(values) @ Vt[:m]


def damped_pinv(J):
    """J⁺ column by column, σ_min and λ."""
    G = J @ J.T
    columns = [law.damped_gram_solve(G, unit) for unit in np.eye(len(J))]
    w = np.array([column for column, _ in columns]).T
    return J.T @ w, columns[0][1]


@pytest.mark.parametrize("locked", [0, 2])
def test_a_weight_is_that_of_joints_in_other_units(locked, rng):
    """With √R q̇ for q̇ all is as without; also of locked joints, as near singular as the whole."""
    J, weight, s = rng.normal(size=(3, 6)), np.geomspace(0.01, 100.0, 6), rng.normal(size=3)
    root, free = np.sqrt(weight), np.where(np.arange(6) < locked, 0.0, J)
    weighted, plain = law.Pseudoinverse(0.4, 0.0, 1.0 / root), law.Pseudoinverse(0.4)
    found = weighted.times(free, s, J)
    assert_allclose(found, plain.times(free / root, s, J / root) / root, rtol=1e-9)
    assert np.linalg.norm(free @ found - s) > 1e-3  # it is damped


@pytest.mark.parametrize("values", [[2.0], [2.0, 0.1], [2.0, 1.0, 0.1], [2.0, 1.0, 0.5, 0.1]])
def test_away_from_singular_poses_it_is_the_pseudoinverse(values, rng):
    J = with_singular_values(values, rng)
    pinv, damping = damped_pinv(J)
    assert_allclose(pinv, np.linalg.pinv(J), atol=1e-11)
    assert_allclose(J @ pinv, np.eye(len(J)), atol=1e-12)
    assert damping == 0.0
    assert not law.is_near_singular(J @ J.T)


@given(wide)
def test_it_is_always_finite_and_bounded(J):
    pinv, damping = damped_pinv(J)
    values = np.linalg.svd(J, compute_uv=False)
    assert np.isfinite(pinv).all()
    if values[0] > 0:
        assert np.linalg.norm(pinv, 2) <= 1.0 / (SINGULAR_RATIO * values[0]) * (1 + 1e-6)
    assert damping >= 0.0
    assert (damping > 0.0) == law.is_near_singular(J @ J.T)
    ratio = values[-1] / max(values[0], 1e-300)
    if values[0] > 0 and abs(ratio - SINGULAR_RATIO) > 1e-6:
        assert law.is_near_singular(J @ J.T) == (ratio < SINGULAR_RATIO)


@pytest.mark.parametrize("largest", [[1.0], [1.0, 0.3]])
def test_it_is_continuous_through_a_singular_pose(largest, rng):
    m = len(largest) + 1
    U, _ = np.linalg.qr(rng.normal(size=(m, m)))
    Vt, _ = np.linalg.qr(rng.normal(size=(m + 1, m + 1)))
    # it is damped between ±0.02: finely there and at 0, where something changes
    windows = [np.linspace(middle - 2e-4, middle + 2e-4, 81) for middle in (-0.02, 0.0, 0.02)]
    grid = np.unique(np.concatenate([np.linspace(-0.022, 0.022, 1101), *windows]).round(9))
    path = [damped_pinv(U @ np.diag([*largest, x]) @ Vt[:m])[0] for x in grid]
    steps = np.linalg.norm(np.diff(path, axis=0), axis=(1, 2))
    assert (steps < 10.0 * np.diff(grid) / SINGULAR_RATIO**2).all()


def test_a_zero_jacobian_gives_zero():
    for m in (2, 3):
        pinv, damping = damped_pinv(np.zeros((m, 4)))
        assert np.array_equal(pinv, np.zeros((4, m)))
        assert damping == 0.0


def test_units_do_not_matter(rng):
    for values in ([1.0, 0.01], [1.0, 0.5, 0.01]):
        J = with_singular_values(values, rng)
        a, damping_a = damped_pinv(J)
        b, damping_b = damped_pinv(1e-3 * J)
        assert damping_a > 0
        assert_allclose(1e-3 * b, a, rtol=1e-9)
        assert_allclose(damping_b, 1e-3 * damping_a, rtol=1e-9)


@pytest.mark.parametrize("weighted", [False, True])
def test_rate_by_finite_differences(rng, weighted):
    J, J_dot = rng.normal(size=(2, 3, 6))
    weight = rng.uniform(0.1, 10.0, 6) if weighted else None
    root = np.ones(6) if weight is None else np.sqrt(weight)

    def pinv(J):
        return np.linalg.pinv(J / root) / root[:, None]

    h = 1e-6
    expected = (pinv(J + h * J_dot) - pinv(J - h * J_dot)) / (2 * h)
    G, dG = law.cross_weight_pinv(J, J_dot[None], weight)
    assert_allclose(G, pinv(J), atol=1e-11)
    assert_allclose(J @ G, np.eye(3), atol=1e-12)
    assert_allclose(dG[0], expected, rtol=1e-6, atol=1e-6)


# -- the damped solution against its formula ------------------------------------------------


def by_formula(J, b, ratio):
    """J⁺b with dense matrices: (J Jᵀ + λ²I)⁻¹ b, λ² = ε² − σ_min² where σ_min < ε = ratio σ_max."""
    values = np.linalg.svd(J, compute_uv=False)
    epsilon = ratio * values[0]
    squared = max(epsilon**2 - values[-1] ** 2, 0.0)
    return np.linalg.solve(J @ J.T + squared * np.eye(len(J)), b), np.sqrt(squared)


@pytest.mark.parametrize("m", [1, 2, 3, 4, 5, 6])
@pytest.mark.parametrize("smallest", [1.0, 0.3, 0.021, 0.019, 0.005, 1e-4, 0.0])
def test_it_is_the_formula_for_every_number_of_rows(m, smallest, rng):
    for scale in (1e-3, 1.0, 1e3):
        values = np.append(np.sort(rng.uniform(1.0, 1.4, m - 1))[::-1], smallest)[-m:]
        if m == 1:
            values = np.array([max(smallest, 1e-3)])  # one row is never near singular
        J = scale * with_singular_values(values, rng)
        b = rng.normal(size=m)
        for ratio in (SINGULAR_RATIO, 0.1):
            if abs(values[-1] / values[0] - ratio) < 1e-3:
                continue
            w, damping = law.damped_gram_solve(J @ J.T, b, ratio)
            expected, expected_damping = by_formula(J, b, ratio)
            assert_allclose(w, expected, rtol=1e-7, atol=1e-9 * np.abs(expected).max())
            assert_allclose(damping, expected_damping, rtol=1e-7, atol=1e-12 * scale)
            assert law.is_near_singular(J @ J.T, ratio) == (values[-1] < ratio * values[0])
            assert (damping > 0.0) == (m > 1 and values[-1] < ratio * values[0])


@pytest.mark.parametrize("m", [2, 3])
def test_the_quick_way_for_few_rows_is_the_way_by_eigenvalues(m, rng):
    """The same J with rows and columns of their own added takes the other way: to 1e-11."""
    quick = 0
    for _ in range(500):
        values = np.sort(10.0 ** rng.uniform(-2.5, 0.0, m))[::-1]
        J, b = with_singular_values(values, rng), rng.normal(size=m)
        G = J @ J.T
        padded = values[0] * values[-1] * np.eye(4)  # between the extremes
        padded[:m, :m] = G
        w, damping = law.damped_gram_solve(G, b)
        expected, expected_damping = law.damped_gram_solve(padded, np.append(b, np.zeros(4 - m)))
        assert_allclose(w, expected[:m], rtol=1e-9, atol=1e-11 * np.abs(w).max())
        assert_allclose(damping, expected_damping, rtol=1e-9)
        assert law.is_near_singular(G) == law.is_near_singular(padded)
        # det and trace tell surely regular ones; what they do not tell takes the other way
        bound = (m - 1) ** (m - 1) * np.prod(values**2)
        quick += bound > SINGULAR_RATIO**2 * (values**2).sum() ** m
    assert 50 < quick < 450  # both ways were taken


def test_no_few_rows_near_singular_are_called_regular(rng):
    """Along the edge of the ratio, where the quick test must not be wrong."""
    for second in (1.0, 0.7, 0.3, 0.05, 0.021):
        for smallest, near in ((0.0199, True), (0.0201, False)):
            J = with_singular_values([1.0, second, smallest], rng)
            assert law.is_near_singular(J @ J.T) is near
            _, damping = law.damped_gram_solve(J @ J.T, np.ones(3))
            assert (damping > 0.0) is near
            J = with_singular_values([second, second * smallest], rng)
            assert law.is_near_singular(J @ J.T) is near
            _, damping = law.damped_gram_solve(J @ J.T, np.ones(2))
            assert (damping > 0.0) is near
    # exactly at the bound that the test uses: two equal large values
    assert law.is_near_singular(np.diag([1.0, 1.0, 0.0199**2]))
    assert not law.is_near_singular(np.diag([1.0, 1.0, 0.0201**2]))
    assert not law.is_near_singular(np.eye(3))


def test_a_scale_bounds_it_where_all_singular_values_vanish_together():
    """As the only one of a J with one row does: without a scale 1/J would be unbounded."""
    # finely where it begins to be damped; none is that bound, where rounding decides
    window = np.linspace(SINGULAR_RATIO - 2e-4, SINGULAR_RATIO + 2e-4, 18)
    sizes = np.unique(np.concatenate([np.linspace(0.0, 0.04, 402), window]).round(9))[::-1]
    for m in (1, 2, 3):
        U, _ = np.linalg.qr(np.random.default_rng(m).normal(size=(m, m)))
        path = []
        for size in sizes:
            J = size * U
            w, _ = law.damped_gram_solve(J @ J.T, np.ones(m), scale=1.0)
            path.append(J.T @ w)
            assert np.linalg.norm(path[-1]) <= np.sqrt(m) / SINGULAR_RATIO * (1 + 1e-9)
            assert law.is_near_singular(J @ J.T, scale=1.0) == (size < SINGULAR_RATIO)
        steps = np.linalg.norm(np.diff(path, axis=0), axis=1)
        assert (steps < -10.0 * np.sqrt(m) * np.diff(sizes) / SINGULAR_RATIO**2).all()
        assert np.array_equal(path[-1], np.zeros(m))


@pytest.mark.parametrize("m", [1, 2, 3, 4])
@pytest.mark.parametrize("scale", [0.1, 4.0])
def test_the_scale_is_one_of_singular_values(m, scale):
    """λ² = ε² − σ_min² with ε = ratio · scale, where the scale is more than σ_max."""
    edge = SINGULAR_RATIO * scale
    for smallest in (0.5 * edge, 0.99 * edge, 1.01 * edge):
        G = np.diag([smallest, *np.linspace(2.0, 3.0, m - 1) * edge]) ** 2
        _, damping = law.damped_gram_solve(G, np.ones(m), scale=scale)
        assert_allclose(damping, np.sqrt(max(edge**2 - smallest**2, 0.0)))
        assert law.is_near_singular(G, scale=scale) == (smallest < edge)


@pytest.mark.parametrize("scale", [1.0, 30.0])
def test_what_draws_the_self_motion_fades_where_all_singular_values_vanish_together(scale, rng):
    """By (σ_min/ε)² with ε = ratio · scale; without the scale a J of nothing would turn it."""
    rows, pull = np.linalg.qr(rng.normal(size=(5, 2)))[0].T, rng.normal(size=5)
    own = pull - rows.T @ rows @ pull
    for share, left in ((2.0, 1.0), (1.01, 1.0), (0.5, 0.25), (1e-3, 1e-6), (0.0, 0.0)):
        J = share * SINGULAR_RATIO * scale * rows
        faded = within_null_space(pull, J, J @ J.T, SINGULAR_RATIO, scale)
        assert_allclose(faded, left * own, atol=1e-9)
