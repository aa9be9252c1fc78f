"""Stability of a closed loop: the local test, the Lyapunov function, errors and rollouts."""

from approxjac.stability.local import LocalStability, local_stability
from approxjac.stability.lyapunov import LyapunovValue, lyapunov
from approxjac.stability.rollouts import Rollout, Rollouts, rollouts
from approxjac.stability.uncertainty import Uncertainty

__all__ = [
    "LocalStability",
    "LyapunovValue",
    "Rollout",
    "Rollouts",
    "Uncertainty",
    "local_stability",
    "lyapunov",
    "rollouts",
]
