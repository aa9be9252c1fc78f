"""Scenarios: one description of robot, belief, task, sensor, controller and run."""

from approxjac.scenario.build import BuiltScenario, build_scenario
from approxjac.scenario.outcome import RunResult, run_scenario
from approxjac.scenario.scenario import Scenario

__all__ = ["BuiltScenario", "RunResult", "Scenario", "build_scenario", "run_scenario"]
