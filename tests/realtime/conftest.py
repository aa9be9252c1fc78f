"""A rehearsed arm with a tool that its controller does not know."""

import pytest

import approxjac as aj


@pytest.fixture
def plant(panda):
    truth = panda.with_object(0.2, 0.5, axis="x")
    return aj.Plant(truth, aj.PositionTask(truth))


@pytest.fixture
def controller(panda):
    belief = panda.with_object(0.0)
    law = aj.SetpointController(aj.PositionTask(belief), gravity=aj.AdaptiveGravity(belief))
    return aj.TorqueLimited(law, aj.Limits.of(belief))
