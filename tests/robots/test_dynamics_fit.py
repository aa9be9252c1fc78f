"""Friction and payload from a recorded motion, by torques that are written down here."""

import re

import numpy as np
import pytest
from numpy.testing import assert_allclose

import approxjac as aj
from approxjac.robots import Dynamics, Friction, fit_dynamics

DT = 2e-3  # [s]


def recorded(name, payload, friction, duration=20.0, seed=1, still=None, pause=(0.0, 0.0)):
    """Return an arm without its payload, q and τ of sums of sines with noise, and (q̇, load).

    In a pause the joints stand, and 0.9 of their friction acts.
    """
    arm, rng = aj.load_robot(name), np.random.default_rng(seed)
    held = arm.with_object(0.2, payload, axis="x")
    dynamics = Dynamics(held)
    low, high = arm.usual_range
    size, t = np.minimum(0.25 * (high - low), 0.6) / 3.0, np.arange(0.0, duration, DT)
    if still is not None:
        size[still] = 1e-4
    q, v, a = np.tile(0.5 * (low + high), (len(t), 1)), 0.0, 0.0
    begun, ended = (np.tanh((t - each) / 0.2)[:, None] for each in pause)
    pace = 1.0 - 0.5 * (begun - ended)  # of the time that passes in the sines
    slows = np.gradient(pace[:, 0], DT)[:, None]
    for k in (1, 2, 3):
        omega = 0.2 * np.pi * k * (1.0 + 0.3 * rng.random(arm.nv))
        angle = np.outer(np.cumsum(pace) * DT, omega) + rng.uniform(0.0, 2.0 * np.pi, arm.nv)
        q = q + size * np.sin(angle)
        v = v + pace * size * omega * np.cos(angle)
        a = a + slows * size * omega * np.cos(angle) - pace**2 * size * omega**2 * np.sin(angle)
    rows = np.array([arm.configuration(each) for each in q])
    load = np.array(
        [dynamics.C(*of) @ of[1] + dynamics.g(of[0]) for of in zip(rows, v, strict=True)]
    )
    inertial = np.array([dynamics.M(of) @ a_of for of, a_of in zip(rows, a, strict=True)])
    slow = 1.0 + (friction.stribeck - 1.0) * np.exp(-np.abs(v) / friction.stribeck_velocity)
    dry = friction.coulomb * slow + friction.load * np.abs(load)
    tau = load + inertial + friction.viscous * v
    tau += np.where(pace > 0.02, dry * np.sign(v), 0.9 * dry)
    tau += 0.02 * np.sqrt(arm.effort_limits) * rng.normal(size=tau.shape)
    seen = q + 2e-5 * rng.normal(size=q.shape)
    return arm, np.array([arm.configuration(each) for each in seen]), tau, (v, np.abs(load))


def share_of_effort(name, share):
    effort = aj.load_robot(name).effort_limits
    return Friction(0.5 * share * effort, share * effort, stribeck=1.2, load=0.06)


@pytest.mark.parametrize(
    ("name", "payload"),
    [
        ("z1", 1.5),
        *(
            pytest.param(name, payload, marks=pytest.mark.study)
            for name, payload in (("kinova", 1.5), ("ur10", 1.5), ("ur10", 0.0), ("panda", 3.0))
        ),
        *(
            pytest.param(name, 1.5, marks=[pytest.mark.study, pytest.mark.long])
            for name in ("xarm7", "baxter_left_arm", "ur3", "tiago_arm")
        ),
    ],
)
def test_a_recording_tells_friction_and_payload(name, payload):
    friction = share_of_effort(name, 0.05)
    *given, (v, load) = recorded(name, payload, friction)
    fit = fit_dynamics(*given, DT)
    if name == "ur10":  # whose links weigh twenty times as much: its deviation says so
        assert abs(fit.payload - payload) < fit.payload_sd < 0.5
    else:
        assert abs(fit.payload - payload) < max(0.1 * payload, fit.payload_sd)
        assert fit.payload_sd < 0.4
    fast = np.abs(v) > 0.1  # where there is no Stribeck friction left
    ours, true = (
        np.where(fast, each.viscous * v + (each.coulomb + each.load * load) * np.sign(v), 0.0)
        for each in (fit.friction, friction)
    )
    assert (np.linalg.norm(ours - true, axis=0) <= 0.1 * np.linalg.norm(true, axis=0)).all()
    assert (fit.friction_sd > 0.0).all()
    assert f"payload {fit.payload:.3g}" in str(fit)


@pytest.mark.parametrize("every", [1, 10])  # smoothing is in seconds, not in rows
def test_it_is_what_a_law_begins_with(every):
    arm, q, tau, _ = recorded("ur5", 0.0, Friction(0.3, 1.0), 10.0)
    fit = fit_dynamics(arm, q[::every], tau[::every], every * DT)
    law = aj.controllers.FrictionCompensation(fit.friction)
    assert_allclose(law.known.coulomb, 1.0, rtol=0.1)
    assert (fit.friction_sd > 0.0).all()
    assert (fit.residual < 0.3).all()


def test_of_an_arm_four_times_as_heavy_each_has_the_deviation_of_its_unit():
    """With four times the torques; only shares of the load, and theirs, stay as they are."""
    arm, q, tau, _ = recorded("z1", 0.5, share_of_effort("z1", 0.05), 10.0)
    named = r'(<mass value|i[xyz][xyz])="([^"]*)"'
    text = re.sub(named, lambda of: f'{of[1]}="{4.0 * float(of[2])!r}"', arm.urdf)
    heavy = aj.Robot(text, tip=arm.tip)
    assert heavy.mass == pytest.approx(4.0 * arm.mass)
    fits = fit_dynamics(arm, q, tau, DT), fit_dynamics(heavy, q, 4.0 * tau, DT)
    told, other = ([each.friction, each.friction_sd] for each in fits)
    for k, (name, times) in enumerate({"viscous": 4.0, "coulomb": 4.0, "load": 1.0}.items()):
        values = (np.asarray(getattr(each[0], name)) for each in (other, told))
        assert_allclose(next(values), times * next(values), rtol=0.02, atol=1e-6)
        assert_allclose(other[1][k], times * told[1][k], rtol=0.02)


def test_joints_that_pause_tell_nothing_of_their_friction_meanwhile():
    """Friction may be anything then, here 0.9 of what slides, in one direction."""
    arm, q, tau, (v, _) = recorded("ur5", 0.0, Friction(0.3, 1.0), 16.0, pause=(4.0, 12.0))
    assert np.mean(np.abs(v).max(axis=1) < 1e-3) > 0.4
    fit = fit_dynamics(arm, q, tau, DT)
    assert_allclose(fit.friction.coulomb, 1.0, rtol=0.1)


def test_joints_that_stand_or_go_one_way_are_named():
    arm, q, tau, _ = recorded("z1", 0.0, Friction(0.1, 0.5), 4.0, still=2)
    with pytest.raises(aj.InvalidInputError, match="joint joint3 must move to and fro"):
        fit_dynamics(arm, q, tau, DT)
    with pytest.raises(aj.InvalidInputError, match="at least 200 rows, got 50"):
        fit_dynamics(arm, q[:50], tau[:50], DT)
    with pytest.raises(aj.InvalidInputError, match="at least 1002 rows, got 300"):
        fit_dynamics(arm, q[:300], tau[:300], DT, smoothing=1.0)
    for wrong in (1.0, None, "q", np.full_like(q, np.nan)):
        with pytest.raises(aj.InvalidInputError, match="q must"):
            fit_dynamics(arm, wrong, tau, DT)
    with pytest.raises(aj.InvalidInputError, match="tau must have shape"):
        fit_dynamics(arm, q, tau[:, :3], DT)
