"""A rehearsed arm with a tool that its controller does not know."""

import pytest

import approxjac as aj
from approxjac.codegen import compiled


@pytest.fixture
def plant(panda):
    truth = panda.with_object(0.2, 0.5, axis="x")
    return aj.Plant(truth, aj.PositionTask(truth))


@pytest.fixture(scope="session")
def controller(panda):
    """As machine code: what is tested is the loop."""
    belief = panda.with_object(0.0)
    law = aj.SetpointController(aj.PositionTask(belief), gravity=aj.AdaptiveGravity(belief))
    return compiled(aj.TorqueLimited(law, aj.Limits.of(belief)))


@pytest.fixture
def by_velocities(panda):
    """Plant and controller of an arm that takes joint velocities, each 8 ms."""
    truth = panda.with_object(0.2, 0.5, axis="x")
    servo = aj.simulation.VelocityServo()
    plant = aj.Plant(truth, aj.PositionTask(truth), servo=servo)
    task = aj.PositionTask(panda.with_object(0.0))
    kinematics = aj.AdaptiveKinematics(task, unknown=("tool",), noise=1e-3, dt=8e-3)
    law = aj.TrackingController(task, kinematics=kinematics, dt=8e-3, command="velocity")
    return plant, law
