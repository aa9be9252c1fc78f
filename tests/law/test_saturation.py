import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.law import Linear, Sine, Tanh

gammas = st.floats(1e-3, 1e3)
ratios = st.floats(-20.0, 20.0).filter(lambda u: abs(u) > 1e-3)


def saturations(gamma):
    return [Linear(), Sine(gamma), Tanh(gamma)]


@given(gammas, ratios)
def test_the_constant_of_eq_8_holds(gamma, ratio):
    e = np.array([gamma * ratio])
    for f in saturations(gamma):
        s, S = f.s(e), f.S(e)
        slack = 1.0 + 1e-12
        assert (S * slack >= f.c_bar * s**2).all()
        assert (S > 0).all()


@given(gammas)
def test_c_bar_is_the_largest_that_holds(gamma):
    """Near zero, where every s is e."""
    e = np.array([1e-5 * gamma])
    for f in saturations(gamma):
        s, S = f.s(e), f.S(e)
        assert_allclose(f.c_bar * s**2, S, rtol=1e-9)


@given(gammas, ratios)
def test_s_is_odd_and_its_potential_even(gamma, ratio):
    e = np.array([gamma * ratio])
    for f in saturations(gamma):
        assert_allclose(f.s(-e), -f.s(e))
        assert_allclose(f.S(-e), f.S(e))
        assert_allclose(f.ds(-e), f.ds(e))


@pytest.mark.parametrize("u", [-3.0, -1.6, -1.0, -1e-4, 0.3, 1.0, 1.5, 1.7, 40.0])
def test_derivatives_by_finite_differences(u):
    gamma, h = 0.7, 1e-6
    e = np.array([gamma * u])
    for f in saturations(gamma):
        assert_allclose((f.S(e + h) - f.S(e - h)) / (2 * h), f.s(e), atol=1e-8)
        assert_allclose((f.s(e + h) - f.s(e - h)) / (2 * h), f.ds(e), atol=1e-8)


def test_the_sine_is_the_papers_example():
    gamma = 0.01
    f = Sine(gamma)
    inside, outside = 0.004, 0.5 * np.pi * gamma + 0.003
    assert_allclose(f.s(np.array([inside, outside, -outside])), [
        gamma * np.sin(inside / gamma), gamma, -gamma])  # fmt: skip
    assert_allclose(f.S(np.array([outside])), gamma**2 + gamma * 0.003)
    assert_allclose(f.ds(np.array([0.0, outside])), [1.0, 0.0])


def test_a_large_gamma_is_no_saturation():
    e = np.array([-0.3, 0.0, 2.0])
    for f in (Sine(1e6), Tanh(1e6)):
        assert_allclose(f.s(e), Linear().s(e), rtol=1e-9)
        assert_allclose(f.S(e), Linear().S(e), rtol=1e-6)


def test_gamma_may_differ_from_coordinate_to_coordinate():
    gamma = np.array([0.1, 10.0])
    e = np.array([1.0, 1.0])
    for kind in (Sine, Tanh):
        both = kind(gamma)
        each = [kind(g).s(np.array([1.0]))[0] for g in gamma]
        assert_allclose(both.s(e), each)


@pytest.mark.parametrize("kind", [Sine, Tanh])
@given(st.floats(1e-9, 1e-3), st.floats(1.0, 1e20))
def test_the_potential_keeps_its_digits_near_zero(kind, e, gamma):
    """However large γ is: γ (e/γ) need not be e."""
    assert_allclose(kind(gamma).S(np.array([e])), [e * e / 2], rtol=1e-6)


@pytest.mark.parametrize("gamma", [0.0, -1.0, np.nan, np.inf])
@pytest.mark.parametrize("kind", [Sine, Tanh])
def test_bad_gamma_is_refused(kind, gamma):
    with pytest.raises(
        aj.InvalidInputError, match=r"gamma must be (finite|> 0) \[unit of the task\], got"
    ) as caught:
        kind(gamma)
    assert caught.value.given is gamma


def test_gamma_is_a_copy_and_may_be_a_list():
    gamma = np.array([0.1, 0.2])
    f = Sine(gamma)
    gamma[:] = 9.0
    assert_allclose(f.s(np.array([1.0, 1.0])), [0.1, 0.2])
    for kind in (Sine, Tanh):
        both = kind([0.1, 0.2])
        for call in (both.s, both.S, both.ds):
            assert call(np.array([0.3, 0.4])).shape == (2,)
    with pytest.raises(aj.InvalidInputError, match="gamma must be numbers of shape"):
        Sine("small")


@pytest.mark.parametrize("kind", [Sine, Tanh])
def test_gamma_is_kept_as_it_acts(kind):
    assert type(kind(1).gamma) is float
    assert kind(np.array(0.5)).gamma == 0.5
    assert_allclose(kind([0.1, 0.2]).gamma, [0.1, 0.2], atol=0.0)


@pytest.mark.parametrize("f", [Linear(), Sine(0.1), Tanh(0.1)], ids=repr)
def test_each_entry_is_alone_whatever_the_shape(f):
    e = np.array([[0.01, -0.02, 0.03], [0.1, -0.2, 5.0]])
    for call in (f.s, f.S, f.ds):
        told = call(e)
        assert told.shape == e.shape
        assert_allclose(told, [[call(np.array([x]))[0] for x in row] for row in e], rtol=1e-15)
        assert_allclose(call(np.array(0.1)), call(np.array([0.1]))[0], rtol=1e-15)


def test_where_the_sine_is_at_its_top_it_is_flat():
    """Property (2) of the paper: from γπ/2 on the slope is zero, not nearly so."""
    assert (Sine(1.0).ds(np.array([-0.5 * np.pi, 0.5 * np.pi])) == 0.0).all()


def test_the_sine_is_the_same_where_some_or_no_coordinates_saturate():
    s = Sine(np.array([0.1, 0.2, 0.3]))
    for e in ([0.01, -0.02, 0.03], [0.1, -0.2, 0.3], [0.1, -5.0, 0.3], [9.0, 9.0, -9.0]):
        u = np.clip(np.array(e) / s.gamma, -0.5 * np.pi, 0.5 * np.pi)
        assert_allclose(s.s(np.array(e)), s.gamma * np.sin(u), rtol=1e-15)
