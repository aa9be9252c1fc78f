"""Scenarios: one description of robot, belief, task, sensor, controller and run."""

from approxjac.scenario.build import BuiltScenario as BuiltScenario
from approxjac.scenario.build import build_scenario as build_scenario
from approxjac.scenario.build import recommended as recommended
from approxjac.scenario.outcome import RunResult as RunResult
from approxjac.scenario.outcome import run_scenario as run_scenario
from approxjac.scenario.scenario import Scenario as Scenario
