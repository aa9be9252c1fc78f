"""A joint that stiction holds under a torque is no fault, and one that is led on and stays is."""

import numpy as np
import pytest

import approxjac as aj
from approxjac.realtime import Accuracy, Fault
from approxjac.realtime.watches import FaultWatch

Q = np.array([0.0, -0.5, 0.0, -2.0, 0.0, 1.6, 0.7])
HELD = np.array([4.0, 4.0, 4.0, 4.0, 0.5, 0.5, 0.5])  # N m, of a few percent of the efforts


@pytest.mark.parametrize(
    ("torque", "reference", "fault"),
    [
        (HELD, None, None),
        (HELD, np.full(7, 0.01), None),
        (HELD, np.full(7, 0.5), Fault.COMMAND_UNANSWERED),
    ],
)
def test_a_joint_may_stand_still_under_a_torque(torque, reference, fault):
    panda = aj.load_robot("panda")
    watch = FaultWatch(panda, 1e-3, Accuracy(), panda.velocity_limits, 0.02, False)
    found = None
    for k in range(200):
        t = 1e-3 * k
        found = found or watch.look(aj.Measurement(t, Q, np.zeros(7), np.zeros(3)), t)
        watch.commanded(torque, reference)
    assert found is fault
