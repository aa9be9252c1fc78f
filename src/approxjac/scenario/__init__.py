"""One description of what is true, believed, measured, who controls and where to."""

from approxjac.scenario.scenario import Scenario

__all__ = ["Scenario"]
