"""Gains that are certified for the errors of a scenario, found before anything moves."""

from __future__ import annotations

import json
from collections.abc import Callable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from approxjac.errors import InvalidInputError
from approxjac.files import together, write_text
from approxjac.formatting import numbers, plain, rows, wrapped
from approxjac.scenario.build import loaded_arm
from approxjac.scenario.judge import prepare, uncertainty_of
from approxjac.scenario.laws import limits_of
from approxjac.scenario.scenario import Scenario
from approxjac.stability import StabilityReport, Suggestion
from approxjac.stability.search.suggested_gains import SETTLES

_SETTLING_TIME = 1.0  # [s]


@dataclass(frozen=True, eq=False)
class SuggestedGains:
    """Gains found for a scenario, or what to relax."""

    scenario: Scenario  # with the gains that were found and certified
    errors: str
    settling_time: float  # wanted [s]
    found: Suggestion
    report: StabilityReport | None = None  # of the scenario as it is; None without gains
    refused: str = ""  # why a whole report, of known gravity, does not certify what was found

    @property
    def needs_known_gravity(self) -> bool:
        """Return whether the gains are certified when sampled, but not with the scenario's gravity.

        As where it is learnt, of which there are certificates in continuous time only.
        """
        return self.report is not None and self.report.certified_by is None


def suggested(scenario: Scenario, progress: Callable[[str, float], None]) -> SuggestedGains:
    """Return gains of law (6) that a whole report certifies for a scenario's errors.

    Raises:
        InvalidInputError: No ranges of errors, or gains that are given already.
    """
    choice, analysis = scenario.controller, scenario.stability
    for name in ("kp", "kv", "damping"):
        if (given := getattr(choice, name)) is not None:
            raise InvalidInputError(
                f"controller.{name} must be left out where gains are to be found, got "
                f"{numbers(given)}",
                given=given,
            )
    study = prepare(scenario)
    uncertainty = uncertainty_of(study)
    if uncertainty is None:
        raise InvalidInputError(
            "suggest_gains needs ranges of errors, such as stability.object_length 0 0.3, got none",
            given=None,
        )
    arm = loaded_arm(scenario)
    # a report of known gravity leaves it out, but motors have to hold the arm
    heavy = replace(uncertainty, arm=uncertainty.arm.with_gravity(arm.gravity))
    limits = limits_of(scenario, study.controller.task.robot)
    settling_time = choice.settling_time or _SETTLING_TIME
    errors = uncertainty.describe_box()
    found = replace(study, uncertainty=heavy).gains(
        settling_time,
        torque_limits=None if limits is None else limits.effort,
        configurations=min(analysis.configurations, 200),
        progress=progress,
    )
    if found.found is not None:
        kp, kv, damping = study.loop().controller.with_gains(found.found.gains).diagonals
        gains: dict[str, Any] = {"kp": tuple(kp), "kv": tuple(kv), "damping": tuple(damping)}
        gains["settling_time"] = None  # refused beside given gains
        found_scenario = scenario.with_values({"controller": gains})
        # the search is of fewer configurations, and of law (6) with known gravity and no limits
        known = found_scenario.with_values({"controller": {"gravity": "exact"}})
        report = prepare(known).report(analysis.configurations)
        assert isinstance(report, StabilityReport)
        if not report.passed:
            return SuggestedGains(scenario, errors, settling_time, found, refused=report.verdict())
        assert report.sampled is not None
        best = replace(found.found, margin=report.sampled.margin)
        found = replace(found, found=best)
        if choice.gravity != "exact":
            report = prepare(found_scenario).report(analysis.configurations)
            assert isinstance(report, StabilityReport)
        return SuggestedGains(found_scenario, errors, settling_time, found, report)
    return SuggestedGains(scenario, errors, settling_time, found)


def text(result: SuggestedGains) -> str:
    """Return the gains, or what to relax; the verdict first."""
    found, told = result.found.found, {"errors": result.errors}
    control = result.scenario.controller
    if control.gravity != "exact":
        told["gravity"] = f"taken as known exactly; in the scenario it is {control.gravity}"
    if result.refused:
        lines = wrapped("gains: none found that a report of all configurations certifies")
        lines += wrapped(
            f"{result.refused}; a smaller stability.radius or smaller errors may help", "- "
        )
        return "\n".join([*lines, "", *rows(told, 2)])
    if found is None:
        lines = wrapped(result.found.heading)
        for line in result.found.relax:
            lines += wrapped(line, "- ")
        wanted = {"settling time": f"{result.settling_time:g} s"}
        return "\n".join([*lines, "", *rows(told | wanted, 2)])
    lines = wrapped(
        f"{result.found.heading}{' as if gravity were known' if result.needs_known_gravity else ''}"
    )
    if result.report is not None and result.needs_known_gravity:
        lines += wrapped(f"with gravity {control.gravity}: {result.report.verdict()}")
    told |= {
        "settling time": f"{found.settling_time:.3g} s {SETTLES} ({result.settling_time:g} s is "
        "wanted)",
        "torque": f"a start takes at most {100.0 * found.torque_ratio:.2g} % of the limits"
        if found.torque_ratio
        else "no limits known",
        "tried": f"{len(result.found.tried)} gains, gentle ones first",
    }
    options = [
        f"controller.{name} {numbers(getattr(control, name))}" for name in ("kp", "kv", "damping")
    ]
    return "\n".join([*lines, "", *(f"  {option}" for option in options), "", *rows(told, 2)])


def write(result: SuggestedGains, out: Path) -> None:
    """Write summary.json, and scenario.toml if gains were found, into a folder."""
    found = None if result.report is None else result.found.found
    summary = {
        "found": found is not None,
        "errors": result.errors,
        "relax": [result.refused] if result.refused else result.found.relax,
        "tried": len(result.found.tried),
    }
    if found is not None:
        control = result.scenario.controller
        summary |= {name: getattr(control, name) for name in ("kp", "kv", "damping")}
        summary |= {name: getattr(found, name) for name in ("margin", "torque_ratio")}
        summary["settling_time_s"] = found.settling_time
    if result.report is not None:
        summary["verdict"] = result.report.verdict()  # with the scenario's own gravity
    with together(out) as folder:
        if found is not None:
            result.scenario.save(folder / "scenario.toml")
        write_text(folder / "summary.json", json.dumps(plain(summary), indent=2) + "\n")
