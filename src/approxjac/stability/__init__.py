"""Stability before you run: the paper's conditions for any arm, and sharper tests."""

from approxjac.stability.certificates.lyapunov import LyapunovValue, lyapunov
from approxjac.stability.errors.region import JointBox, Region, RegularPart, SublevelSet, Tube
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.local import LocalStability, local_stability
from approxjac.stability.report.report import StabilityReport, stability_report
from approxjac.stability.rollout.rollout_study import Study
from approxjac.stability.rollout.rollouts import Rollout, Rollouts, rollouts
from approxjac.stability.rollout.sweep import Sweep, sweep
from approxjac.stability.search.map import StabilityMap, stability_map
from approxjac.stability.search.suggestion import (
    Damping,
    Suggestion,
    damping_that_certifies,
    part_that_certifies,
    suggest_gains,
)
from approxjac.stability.search.tolerance import Tolerance, tolerance

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
