"""Stability tests before a run: the paper's conditions for any arm, and sharper ones."""

from approxjac.stability.certificates.lyapunov import LyapunovValue, lyapunov
from approxjac.stability.errors.region import JointBox, Region, RegularPart
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.linearization import LocalStability, local_stability
from approxjac.stability.report.other_laws import OtherLawReport
from approxjac.stability.report.report import StabilityReport
from approxjac.stability.rollouts.rollouts import Execution, Rollouts
from approxjac.stability.rollouts.setting import Rollout, RolloutSetting
from approxjac.stability.search.map import StabilityMap
from approxjac.stability.search.suggested_gains import Suggestion
from approxjac.stability.search.tolerance import Tolerance
from approxjac.stability.study import Study

__all__ = [
    "Execution",
    "JointBox",
    "LocalStability",
    "LyapunovValue",
    "OtherLawReport",
    "Region",
    "RegularPart",
    "Rollout",
    "RolloutSetting",
    "Rollouts",
    "StabilityMap",
    "StabilityReport",
    "Study",
    "Suggestion",
    "Tolerance",
    "Uncertainty",
    "local_stability",
    "lyapunov",
]
