"""Stability tests before a run: the paper's conditions for any arm, and sharper ones."""

from approxjac.stability.certificates.rest_error import rest_error as rest_error
from approxjac.stability.errors.region import JointBox as JointBox
from approxjac.stability.errors.region import Region as Region
from approxjac.stability.errors.region import RegularPart as RegularPart
from approxjac.stability.errors.uncertainty import Uncertainty as Uncertainty
from approxjac.stability.loop.linearization import LocalStability as LocalStability
from approxjac.stability.loop.linearization import local_stability as local_stability
from approxjac.stability.report.move_bounds import Move as Move
from approxjac.stability.report.move_bounds import Moves as Moves
from approxjac.stability.report.other_laws import OtherLawReport as OtherLawReport
from approxjac.stability.report.report import StabilityReport as StabilityReport
from approxjac.stability.rollouts.rollouts import Execution as Execution
from approxjac.stability.rollouts.rollouts import Rollouts as Rollouts
from approxjac.stability.rollouts.setting import Rollout as Rollout
from approxjac.stability.rollouts.setting import RolloutSetting as RolloutSetting
from approxjac.stability.search.map import StabilityMap as StabilityMap
from approxjac.stability.search.suggested_gains import Suggestion as Suggestion
from approxjac.stability.search.tolerance import Tolerance as Tolerance
from approxjac.stability.study import Study as Study
