"""Controllers: the laws of the paper put together with a believed robot."""

from approxjac.controllers.bounded import BoundedController
from approxjac.controllers.bounded_gains import BoundedGains, bounded_gains
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
    "BoundedController",
    "BoundedGains",
    "DifferentiatedVelocity",
    "Gains",
    "Gravity",
    "ModelGravity",
    "NoGravity",
    "Posture",
    "RegressorGravity",
    "SetpointController",
    "bounded_gains",
    "default_adaptation",
    "default_gains",
]
