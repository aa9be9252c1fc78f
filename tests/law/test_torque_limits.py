"""`limited_torque`: the minimum, by its optimality conditions and against a QP solver."""

import numpy as np
import pytest
import qpsolvers
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

from approxjac import law
from approxjac.law.limits import Rows

ENTRY = st.floats(-10.0, 10.0, allow_subnormal=False)


@st.composite
def problems(draw):
    n = draw(st.integers(1, 7))
    entries = st.lists(ENTRY, min_size=n, max_size=n).map(np.array)
    torque, y, one, other = (draw(entries) for _ in range(4))
    weight = 10.0 ** draw(st.lists(st.floats(-2.0, 2.0), min_size=n, max_size=n).map(np.array))
    rho = draw(st.sampled_from([0.0, 0.1, 1.0, 30.0, 1e4]))
    return torque, y, np.minimum(one, other), np.maximum(one, other), weight, rho


def cost(tau, torque, y, weight, rho):
    change = tau - torque
    return 0.5 * change @ (weight * change) + rho * max(0.0, y @ change)


@given(problems())
def test_it_is_within_limits_and_of_the_form_that_optimality_asks_for(problem):
    """τ = [τ* − λR⁻¹y] within limits, with 0 ≤ λ ≤ ρ, and σ > 0 only for λ = ρ."""
    torque, y, lower, upper, weight, rho = problem
    tau, slack = law.limited_torque(*problem)
    assert ((lower <= tau) & (tau <= upper)).all()
    power = y @ (tau - torque)
    assert slack == pytest.approx(max(power, 0.0), abs=1e-9 * (1.0 + np.abs(y) @ np.abs(torque)))
    scale = np.abs(y) @ (np.abs(torque) + np.abs(tau)) + 1.0

    def within(multiplier):
        return np.clip(torque - multiplier * y / weight, lower, upper)

    if power > 1e-9 * scale:
        assert_allclose(tau, within(rho), atol=1e-9)
    elif y @ (within(0.0) - torque) <= 0.0:
        assert_allclose(tau, within(0.0), atol=1e-12)
    else:  # the row is active: the multiplier follows from any joint that is off its limits
        assert abs(power) <= 1e-9 * scale
        off = (tau > lower) & (tau < upper) & (np.abs(y) > 1e-6)
        multipliers = (weight * (torque - tau))[off] / y[off]
        if len(multipliers):
            assert_allclose(tau, within(multipliers[0]), atol=1e-6)
            assert -1e-9 <= multipliers[0] <= rho * (1.0 + 1e-9) + 1e-9


@given(problems(), st.integers(0, 2**32 - 1))
def test_no_other_torque_costs_less(problem, seed):
    torque, y, lower, upper, weight, rho = problem
    tau, _ = law.limited_torque(*problem)
    best = cost(tau, torque, y, weight, rho)
    rng = np.random.default_rng(seed)
    for size in (1e-3, 0.1, 3.0):
        for _ in range(20):
            other = np.clip(tau + size * rng.normal(size=len(tau)), lower, upper)
            assert cost(other, torque, y, weight, rho) >= best - 1e-9 * (1.0 + best)


def test_against_a_solver(rng):
    """The same problem with a slack variable, by DAQP."""
    kept = 0
    for _ in range(200):
        n = int(rng.integers(1, 8))
        torque, y = 3.0 * rng.normal(size=n), rng.normal(size=n)
        lower, upper = -np.abs(rng.normal(size=n)), np.abs(rng.normal(size=n))
        weight, rho = np.exp(rng.normal(size=n)), float(np.exp(rng.normal()))
        tau, slack = law.limited_torque(torque, y, lower, upper, weight, rho)
        # a little of σ² makes the Hessian definite, too little to show
        H = np.diag([*weight, 1e-8])
        f = np.array([*(-weight * torque), rho])
        z = qpsolvers.solve_qp(
            H,
            f,
            np.array([[*y, -1.0]]),
            np.array([y @ torque]),
            lb=np.array([*lower, 0.0]),
            ub=np.array([*upper, np.inf]),
            solver="daqp",
            primal_tol=1e-10,
        )
        assert_allclose(tau, z[:n], atol=1e-5)
        assert slack == pytest.approx(z[n], abs=1e-5)
        kept += (y @ (np.clip(torque, lower, upper) - torque) > 0) and z[-1] < 1e-9
    assert kept > 10


@pytest.mark.parametrize("rho", [0.0, 5.0])
def test_no_speed_and_no_error_means_clipping(rho):
    tau, slack = law.limited_torque(
        np.array([3.0, -0.5]), np.zeros(2), -np.ones(2), np.ones(2), np.ones(2), rho
    )
    assert_allclose(tau, [1.0, -0.5], atol=0.0)
    assert slack == 0.0


def test_a_clipped_brake_is_made_up_for_by_the_other_joint():
    """Joint 0 may brake with 1 of 3 N m, so joint 1 brakes with 2 more."""
    tau, slack = law.limited_torque(
        np.array([-3.0, 0.0]), np.ones(2), -np.array([1.0, 9.0]), np.full(2, 9.0), np.ones(2), 10.0
    )
    assert_allclose(tau, [-1.0, -2.0])
    assert slack == 0.0


def test_more_than_rho_is_not_paid():
    arguments = np.array([-3.0, 0.0]), np.ones(2), -np.array([1.0, 9.0]), np.full(2, 9.0)
    tau, slack = law.limited_torque(*arguments, np.ones(2), 0.5)
    assert_allclose(tau, [-1.0, -0.5])
    assert slack == 1.5


@pytest.mark.parametrize("size", [1e200, np.inf])
def test_a_power_that_overflows_is_clipped_and_no_proof_is_claimed(size):
    """At an overflow there is no telling which torque would keep the proof."""
    torque, y = np.array([-size, 0.5]), np.array([1e200, 1.0])
    with np.errstate(over="ignore"):
        tau, slack = law.limited_torque(torque, y, -np.ones(2), np.ones(2), np.ones(2), 5.0)
    assert_allclose(tau, [-1.0, 0.5], atol=0.0)
    assert slack == np.inf


def test_a_power_of_zero_is_left_alone():
    """What clipping adds at one joint it takes away at the other, so nothing is to be made up."""
    torque = np.array([3.0, -3.0])
    tau, slack = law.limited_torque(torque, np.ones(2), -np.ones(2), np.ones(2), np.ones(2), 5.0)
    assert_allclose(tau, [1.0, -1.0], atol=0.0)
    assert slack == 0.0


def test_a_proof_that_is_short_by_a_billionth_is_not_claimed():
    """Joint 1 would have to brake with 2, and may with a billionth less."""
    lower = np.array([-1.0, -2.0 + 1e-9])
    torque, weight = np.array([-3.0, 0.0]), np.ones(2)
    tau, slack = law.limited_torque(torque, np.ones(2), lower, np.full(2, 9.0), weight, 10.0)
    assert_allclose(tau, lower, atol=0.0)
    assert slack == pytest.approx(1e-9, rel=1e-6)


def test_a_joint_that_stands_still_takes_no_part():
    """Joint 1 has y = 0. The others reach and leave limits on the way, so one guess is not enough.

    By how much less than at λ = 0 the power is: joint 3 gives 1 by λ = 1, where its limit is;
    joint 0 is let off its limit at λ = 1.5 and gives the other 1.5 of 2.5 by λ = 3.
    """
    torque, y = np.array([4.5, 0.7, -6.0, 0.0]), np.array([1.0, 0.0, 1.0, 1.0])
    limit = np.array([3.0, 1.0, 2.0, 1.0])
    tau, slack = law.limited_torque(torque, y, -limit, limit, np.ones(4), 10.0)
    assert_allclose(tau, [1.5, 0.7, -2.0, -1.0])
    assert slack == 0.0


def test_units_do_not_matter_and_a_proof_that_is_kept_costs_nothing(rng):
    """τ and y a billion times smaller, the same R: λ is the same. σ is 0, not nearly so."""
    walked = 0
    for _ in range(300):
        torque, y = 3.0 * rng.normal(size=5), rng.normal(size=5)
        limit, weight = np.abs(rng.normal(size=5)), np.exp(rng.normal(size=5))
        tau, slack = law.limited_torque(torque, y, -limit, limit, weight, 50.0)
        for c in (1e-9, 1e9):
            other, small = law.limited_torque(
                c * torque, c * y, -c * limit, c * limit, weight, 50.0
            )
            assert_allclose(other, c * tau, rtol=1e-9, atol=1e-12 * c)
            assert small == pytest.approx(c * c * slack, rel=1e-9, abs=0.0)
        clipped = np.clip(torque, -limit, limit)
        if abs(y @ (tau - torque)) < 1e-12 < y @ (clipped - torque):
            assert slack == 0.0
            walked += ((clipped == torque) != (np.abs(tau) < limit)).any()
    assert walked > 20  # some joints reached or left a limit on the way


@pytest.mark.parametrize("further", [0, 2])
def test_bounds_of_a_share_of_the_acceleration_are_those_of_all_of_it(rng, further):
    """Of q̈ = ρa: a keeps the rows per ρ by as much as q̈ keeps the rows, also further ones."""
    low, high = -np.abs(rng.normal(size=(2, 3 + further))) * [[1.0], [-1.0]]
    rows = Rows(low, high, rng.normal(size=(further, 3)) if further else None)
    rho, a = np.array([1.0, 0.3, 0.01]), rng.normal(size=3)
    unit = np.concatenate([rho, np.ones(further)])
    per = rows.per(rho)
    assert_allclose(unit * (per.of(a) - per.low), rows.of(rho * a) - rows.low)
    assert_allclose(unit * (per.high - per.of(a)), rows.high - rows.of(rho * a))


@pytest.mark.parametrize(("inertia", "g", "wanted"), [(0.4, 2.5, 20.0), (3.0, -0.7, 9.0)])
def test_a_row_that_is_given_up_weighs_ten_times_what_braking_does(inertia, g, wanted):
    """Of one joint: q̈ is the mean of the braking q̈ and of that with E q̈ as wanted, 1 to 10."""
    M_inv, brake = np.array([[1.0 / inertia]]), -1.5

    def minimum(problem, *_):
        """The exact minimum along a line."""
        ends = np.stack([problem.row_lower, problem.row_upper]) / problem.A[:, 0]
        low, high = np.sort(ends, axis=0)
        low, high = low.max(initial=problem.lower[0]), high.min(initial=problem.upper[0])
        free = -problem.f[0] / problem.H[0, 0]
        return np.clip([free], low, high), 0 if low <= high else 1

    rows = Rows(np.array([-60.0, wanted]), np.array([60.0, np.inf]), np.array([[g]]))
    most, rest = np.full(1, 500.0), np.zeros(1)
    torque = law.limits.braked(M_inv, rows, rest, -most, most, np.array([brake]), rest, minimum)
    assert_allclose(torque / inertia, (brake + 10.0 * wanted / g) / 11.0, rtol=1e-12)
