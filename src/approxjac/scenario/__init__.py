"""One description of what is true, believed, measured, who controls and where to."""

import importlib
from typing import TYPE_CHECKING, Any

from approxjac.scenario.scenario import Scenario

if TYPE_CHECKING:
    from approxjac.scenario.build import BuiltScenario, build_scenario
    from approxjac.scenario.outcome import RunResult, run_scenario

__all__ = ["BuiltScenario", "RunResult", "Scenario", "build_scenario", "run_scenario"]
_FROM = {"BuiltScenario": "build", "build_scenario": "build"}


if not TYPE_CHECKING:  # or no name would be unknown to type checkers

    def __getattr__(name: str) -> Any:
        """Load what makes plants and controllers when it is asked for: a help needs none."""
        if name not in __all__:
            raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
        return getattr(importlib.import_module(f"{__name__}.{_FROM.get(name, 'outcome')}"), name)
