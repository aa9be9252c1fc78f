"""Controllers: the laws of the paper put together with a believed robot."""

from approxjac.controllers.gains import Gains
from approxjac.controllers.gravity import (
    AdaptiveGravity,
    Gravity,
    ModelGravity,
    NoGravity,
    RegressorGravity,
)
from approxjac.controllers.setpoint import DifferentiatedVelocity, SetpointController

__all__ = [
    "AdaptiveGravity",
    "DifferentiatedVelocity",
    "Gains",
    "Gravity",
    "ModelGravity",
    "NoGravity",
    "RegressorGravity",
    "SetpointController",
]
