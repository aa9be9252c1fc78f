"""Stability of a closed loop: the local test and the Lyapunov function."""

from approxjac.stability.local import LocalStability, local_stability
from approxjac.stability.lyapunov import LyapunovValue, lyapunov

__all__ = ["LocalStability", "LyapunovValue", "local_stability", "lyapunov"]
