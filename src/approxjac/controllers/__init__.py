"""Controllers: the laws of the paper put together with a believed robot."""

from approxjac.controllers.adaptive_dynamics import (
    AdaptiveDynamics,
    ModelDynamics,
    MotionDynamics,
)
from approxjac.controllers.controller import Controller
from approxjac.controllers.gains.default_gains import default_gains
from approxjac.controllers.gains.gains import Gains
from approxjac.controllers.gains.latency import Latency
from approxjac.controllers.gains.tuning import Learning, Tuning, tuned
from approxjac.controllers.gravity import (
    Adaptation,
    AdaptiveGravity,
    Gravity,
    ModelGravity,
    NoGravity,
    RegressorGravity,
)
from approxjac.controllers.hold import HeldMeasurement
from approxjac.controllers.learning.estimator import Kinematics, KnownKinematics
from approxjac.controllers.learning.kinematic_report import (
    KinematicReport,
    LearntNumber,
    TiltedAxes,
)
from approxjac.controllers.learning.learnt_camera import AdaptiveCamera
from approxjac.controllers.learning.positions import AdaptiveKinematics, AdaptivePlanarCamera
from approxjac.controllers.limits.cross_weight import CrossWeight
from approxjac.controllers.limits.limit import CartesianSpeed, Limit, LimitTerms, Wall
from approxjac.controllers.limits.limits import Limits
from approxjac.controllers.limits.torque_limited import TorqueLimited
from approxjac.controllers.posture import AwayFromStops, Posture
from approxjac.controllers.predicted_measurement import PredictedMeasurement
from approxjac.controllers.setpoint import DifferentiatedVelocity, SetpointController
from approxjac.controllers.tracking import TrackingController, TrackingGains
from approxjac.controllers.wrapper import ControllerWrapper
from approxjac.law import PredictedError

__all__ = [
    "Adaptation",
    "AdaptiveCamera",
    "AdaptiveDynamics",
    "AdaptiveGravity",
    "AdaptiveKinematics",
    "AdaptivePlanarCamera",
    "AwayFromStops",
    "CartesianSpeed",
    "Controller",
    "ControllerWrapper",
    "CrossWeight",
    "DifferentiatedVelocity",
    "Gains",
    "Gravity",
    "HeldMeasurement",
    "KinematicReport",
    "Kinematics",
    "KnownKinematics",
    "Latency",
    "Learning",
    "LearntNumber",
    "Limit",
    "LimitTerms",
    "Limits",
    "ModelDynamics",
    "ModelGravity",
    "MotionDynamics",
    "NoGravity",
    "Posture",
    "PredictedError",
    "PredictedMeasurement",
    "RegressorGravity",
    "SetpointController",
    "TiltedAxes",
    "TorqueLimited",
    "TrackingController",
    "TrackingGains",
    "Tuning",
    "Wall",
    "default_gains",
    "tuned",
]
