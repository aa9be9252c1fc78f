"""Stability before you run: the paper's conditions for any arm, and sharper tests."""

from approxjac.stability.local import LocalStability, local_stability
from approxjac.stability.lyapunov import LyapunovValue, lyapunov
from approxjac.stability.map import StabilityMap, stability_map
from approxjac.stability.region import JointBox, Region, RegularPart, SublevelSet, Tube
from approxjac.stability.report import StabilityReport, stability_report
from approxjac.stability.rollout_study import Study
from approxjac.stability.rollouts import Rollout, Rollouts, rollouts
from approxjac.stability.suggestion import (
    Damping,
    Suggestion,
    damping_that_certifies,
    part_that_certifies,
    suggest_gains,
)
from approxjac.stability.sweep import Sweep, sweep
from approxjac.stability.tolerance import Tolerance, tolerance
from approxjac.stability.uncertainty import Uncertainty

__all__ = [
    "Damping",
    "JointBox",
    "LocalStability",
    "LyapunovValue",
    "Region",
    "RegularPart",
    "Rollout",
    "Rollouts",
    "StabilityMap",
    "StabilityReport",
    "Study",
    "SublevelSet",
    "Suggestion",
    "Sweep",
    "Tolerance",
    "Tube",
    "Uncertainty",
    "damping_that_certifies",
    "local_stability",
    "lyapunov",
    "part_that_certifies",
    "rollouts",
    "stability_map",
    "stability_report",
    "suggest_gains",
    "sweep",
    "tolerance",
]
