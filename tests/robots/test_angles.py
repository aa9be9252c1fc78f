"""Arms with continuous joints: wherever a configuration is taken, angles of the joints are, too."""

import numpy as np
import pytest

import approxjac as aj
from approxjac.controllers import Posture
from approxjac.realtime import SimulatedDriver
from approxjac.realtime.driver import read
from approxjac.robots import Dynamics, GravityRegressor

ARM = aj.load_robot("kinova")  # six joints, of which three are continuous: nq is 9
ANGLES = np.array([0.3, 2.9, 1.3, 4.2, 1.4, 0.3])
Q = ARM.configuration(ANGLES)
TASK = aj.PositionTask(ARM)
LAW = aj.SetpointController(TASK)
PLANT = aj.Plant(ARM, TASK)
TARGET = TASK.value(Q) + 0.01


def test_angles_become_cosines_and_sines():
    assert Q.shape == (9,)
    c, s = np.cos(ANGLES), np.sin(ANGLES)
    expected = [c[0], s[0], 2.9, 1.3, c[3], s[3], 1.4, c[5], s[5]]
    assert Q.tolist() == pytest.approx(expected)
    assert ARM.configuration(Q) is Q
    with pytest.raises(aj.InvalidInputError, match="q must be finite"):
        ARM.configuration([np.nan, *ANGLES[1:]])
    with pytest.raises(
        aj.InvalidInputError, match=r"must have shape \(9,\) \[rad or m\], got shape \(7,\)"
    ):
        ARM.configuration(np.zeros(7))


def simulated(q):
    return aj.simulate(PLANT, LAW, TARGET, q, 0.02, dt=1e-3).tau


def driven(q):
    driver = SimulatedDriver(PLANT, q, pace=np.inf)
    return read(driver, TASK)


def box(q):
    region = aj.JointBox.around(ARM, q, 0.1)
    return np.array([*region.center, region.contains(q), not region.contains(q + 0.0)])


def posture(q):
    plane = aj.PositionTask(ARM, axes="xz")
    law = aj.SetpointController(plane, posture=Posture(q, 10.0))
    seen = aj.Measurement(0.0, ARM.neutral(), np.zeros(6), np.zeros(2))
    return law.evaluate(np.zeros(0), seen, np.zeros(2)).torque


TAKEN = {
    "value": TASK.value,
    "jacobian": TASK.jacobian,
    "jacobian_dot": lambda q: TASK.jacobian_dot(q, np.ones(6)),
    "pose": aj.PoseTask(ARM).value,
    "stacked": aj.StackedTask(TASK, aj.PositionTask(ARM, "j2s6s200_link_4")).value,
    "dynamics": lambda q: Dynamics(ARM).M(q),
    "gravity": lambda q: Dynamics(ARM).g(q),
    "regressor": lambda q: GravityRegressor(ARM).Z(q),
    "plant": lambda q: PLANT.acceleration(q, np.ones(6), np.ones(6)),
    "simulate": simulated,
    "driver": driven,
    "posture": posture,
    "box": box,
    "local": lambda q: aj.local_stability(PLANT, LAW, q).eigenvalues,
    "tracking": lambda q: aj.TrackingController(aj.PositionTask(ARM, axes="xz"), posture=q)._rest.q,
}


@pytest.mark.parametrize("name", TAKEN)
def test_angles_are_taken_as_the_configuration_that_they_are(name):
    taken = TAKEN[name]
    for ours, theirs in zip(taken(ANGLES), taken(Q), strict=True):
        assert np.array_equal(ours, theirs, equal_nan=True)


def test_a_driver_may_read_angles():
    class Angles(SimulatedDriver):
        def read(self):
            return super().read()._replace(q=ANGLES)

    measured = read(Angles(PLANT, Q, pace=np.inf), TASK)
    assert np.array_equal(measured.q, Q)
