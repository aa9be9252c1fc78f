"""Joints whose friction gives way before it slides (LuGre), in a plant of this test's own."""

import numpy as np
import pinocchio as pin
import pytest

import approxjac as aj
from approxjac.controllers import FrictionCompensation
from approxjac.robots import Drives

DT, SUBSTEPS, PRESLIDING, STRIBECK = 1e-3, 10, 1e-3, 0.02  # s, rad, rad/s
TOOL = 0.15, 1.0  # m, kg, unknown


def held(name, law_of, dry, seconds, seed):
    """Return errors [mm] and speeds of a reach, by the model of Canudas de Wit et al., 1995.

    z' = v - s0 |v|/g(v) z, friction s0 z + s1(v) z' + B v, s0 z at most F_s, with s1 that vanishes
    where the joint slides.
    """
    robot = aj.load_robot(name)
    truth, belief = robot.with_object(*TOOL, axis="z"), robot.with_object(0.0)
    model, nv = truth.model.copy(), robot.nv
    model.armature = rotors = np.asarray(Drives.usual(robot).rotor_inertia)
    data, sensor = model.createData(), aj.PositionTask(truth)
    law, F = law_of(aj.PositionTask(belief)), dry * robot.effort_limits
    q = aj.Plant(truth).ready_configuration()
    rng = np.random.default_rng(seed)
    goal = sensor.value(pin.integrate(model, q, rng.normal(0.0, 0.25, nv)))
    v, z, s0 = np.zeros(nv), np.zeros(nv), F / PRESLIDING
    s1, h, state = 0.2 * np.sqrt(s0 * rotors), DT / SUBSTEPS, None
    errors, speeds = [], []
    for k in range(round(seconds / DT)):
        now = aj.Measurement(k * DT, q, v, sensor.value(q))
        state = law.initial_state(now) if state is None else state
        state, answer = law.step(state, now, goal, DT)
        for _ in range(SUBSTEPS):
            slow = np.exp(-((v / STRIBECK) ** 2))
            rate = s0 * np.abs(v) / (F * (1.0 + 0.3 * slow))
            before = z
            z = (z + h * v) / (1.0 + h * rate)
            friction = s0 * z + s1 * slow * (z - before) / h + 0.5 * F * v
            v = v + h * pin.aba(model, data, q, v, answer.torque - friction)
            q = pin.integrate(model, q, h * v)
        errors.append(1e3 * np.linalg.norm(now.x - goal))
        speeds.append(v)
    return np.array(errors), np.array(speeds)


def turns(speeds):
    """How often joints turn that move."""
    count = 0
    for speed in speeds.T:
        signs = np.sign(speed[np.abs(speed) > 1e-3])
        count += int((signs[1:] != signs[:-1]).sum())
    return count


def tracking(task):
    return aj.TrackingController(task, latency=aj.Latency())


def compensated(task):
    gravity = aj.AdaptiveGravity(task.robot)
    return aj.SetpointController(
        task, gravity=gravity, friction=FrictionCompensation(), latency=aj.Latency()
    )


@pytest.mark.study
@pytest.mark.parametrize(
    ("name", "law_of", "seconds", "seed"),
    [
        ("xarm7", tracking, 6.0, 3),
        pytest.param("ur10", tracking, 8.0, 11, marks=pytest.mark.long),
        pytest.param("kinova", tracking, 8.0, 12, marks=pytest.mark.long),
        pytest.param("ur5", compensated, 12.0, 3, marks=pytest.mark.long),
    ],
)  # fmt: skip
def test_joints_with_presliding_hold_still(name, law_of, seconds, seed):
    errors, speeds = held(name, law_of, 0.1, seconds, seed)
    late = round(0.7 * len(errors))
    assert np.sqrt((errors[late:] ** 2).mean()) < 0.5
    assert turns(speeds[late:]) == 0
