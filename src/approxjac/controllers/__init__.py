"""Controllers: the laws of the paper put together with a believed robot."""

from approxjac.controllers.gains import Gains
from approxjac.controllers.gravity import (
    Adaptation,
    AdaptiveGravity,
    Gravity,
    ModelGravity,
    NoGravity,
    RegressorGravity,
)
from approxjac.controllers.posture import Posture
from approxjac.controllers.setpoint import DifferentiatedVelocity, SetpointController
from approxjac.controllers.tuning import default_adaptation, default_gains

__all__ = [
    "Adaptation",
    "AdaptiveGravity",
    "DifferentiatedVelocity",
    "Gains",
    "Gravity",
    "ModelGravity",
    "NoGravity",
    "Posture",
    "RegressorGravity",
    "SetpointController",
    "default_adaptation",
    "default_gains",
]
