"""Short options for common keys of a scenario, what each command shows, and the folder --out."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields
from pathlib import Path
from typing import Any

from approxjac.cli.parser import Option, own_options, record_options
from approxjac.errors import InvalidInputError
from approxjac.files import reason
from approxjac.scenario import Scenario
from approxjac.scenario.convert import Words
from approxjac.scenario.records import Analysis, Goal

# A report is about errors that are given as ranges, and takes gravity as compensated exactly.
_USUAL = {
    "simulate": Scenario(""),
    "export": Scenario(""),
    "stability": Scenario("").with_values(
        {"true": {"object": {"length": 0.0, "mass": 0.0}}, "controller": {"gravity": "exact"}}
    ),
}
_SHORT = {
    "--object-length": "true.object.length",
    "--object-mass": "true.object.mass",
    "--object-axis": "true.object.axis",
    "--believed-length": "believed.object.length",
    "--believed-mass": "believed.object.mass",
    "--gravity": "controller.gravity",
    "--settling-time": "controller.settling_time",
    "--kp": "controller.kp",
    "--kv": "controller.kv",
    "--damping": "controller.damping",
    "--limits": "controller.limits",
    "--start": "run.start",
    "--target": "run.target.at",
    "--target-offset": "run.target.offset",
    "--circle": "run.target.circle.radius",
    "--line": "run.target.line.offset",
    "--waypoints": "run.target.waypoints.points",
    "--duration": "run.duration",
    "--seed": "run.seed",
}
_OF_STUDY = {
    f"--{each.name.replace('_', '-')}": f"stability.{each.name}" for each in fields(Analysis)
}
SHORT: Mapping[str, Mapping[str, str]] = {
    "simulate": _SHORT, "stability": _SHORT | _OF_STUDY, "export": _SHORT,
}  # fmt: skip
"""Command → short option → the key that it stands for; a report's errors are ranges."""
COMMON: Mapping[str, Sequence[str]] = {
    "simulate": (
        "--object-length", "--object-mass", "--object-axis", "--believed-length", "--believed-mass",
        "--gravity", "--settling-time", "--limits", "--start", "--target", "--target-offset",
        "--circle", "--learn-kinematics", "--duration", "--seed", "--task.kind", "--view", "--out",
    ),
    "stability": (
        "--object-length", "--object-mass", "--joint-shifts", "--joint-rotations",
        "--believed-length", "--believed-mass", "--around", "--radius", "--target", "--gravity",
        "--settling-time", "--kp", "--kv", "--damping", "--loop.dt", "--runs", "--map-points",
        "--suggest-gains", "--jobs", "--out",
    ),
    "export": (
        "--object-length", "--believed-length", "--believed-mass", "--gravity", "--settling-time",
        "--kp", "--kv", "--damping", "--limits", "--effort-only", "--folder",
    ),
}  # fmt: skip
"""Command → the options that its help shows."""
_ROBOT = (
    "NAME|FILE",
    "the name of an arm (approxjac robots lists them), a .urdf file, or a .toml file with a "
    "scenario, which options override",
)
POSITIONAL: Mapping[str, tuple[str, str]] = {
    **dict.fromkeys(SHORT, _ROBOT),
    "robots": ("[NAME|FILE]", "the name or the .urdf file of one robot"),
    "view": ("RUN", "the run.npz that simulate, paper or Trajectory.save wrote, or its folder"),
}
"""Command → the word that has no option, in brackets where it may be left out, and what it is."""
_STANDING_FOR_OTHERS = [
    Option(
        ("--no-limits",), "no_limits", bool, "Keep no limits, as --limits none.",
        means={"controller.limits": Words(["none"])},
    ),
    Option(
        ("--learn-kinematics",), "learn_kinematics", bool,
        "Learn tool, joint origins and camera with the tracking law, as --controller.law tracking "
        "--controller.unknown tool origins camera.",
        means={
            "controller.law": Words(["tracking"]),
            "controller.unknown": Words(["tool", "origins", "camera"]),
        },
    ),
]  # fmt: skip


def options_of(command: Callable[..., int]) -> list[Option]:
    """Return all options of a command, with those of its scenario."""
    name = command.__name__
    if name not in SHORT:
        return own_options(command)
    of_scenario = record_options(_USUAL[name], SHORT[name])
    return [*of_scenario, *own_options(command), *_STANDING_FOR_OTHERS]


def scenario_of(command: str, source: str, values: Mapping[str, Words]) -> Scenario:
    """Return the scenario of a file, or the usual one of a command, with what was typed by key."""
    if source.endswith(".toml"):
        scenario = Scenario.load(source)
    else:
        scenario = _USUAL[command].with_values({"robot": source})
    if any(key.startswith("run.target.") for key in values):  # in place of the file's
        scenario = scenario.with_values({"run": {"target": Goal()}})
    table: dict[str, Any] = {}
    for key, words in values.items():
        *parts, name = key.split(".")
        inner = table
        for part in parts:
            inner = inner.setdefault(part, {})
        inner[name] = words
    return scenario.with_values(table)


def require_folder_of(option: str, file: Path | None) -> None:
    """Refuse a file, if one is given, that there is no folder for."""
    if file is not None and not file.parent.is_dir():
        raise InvalidInputError(
            f"{option} must be a file in a folder that there is, got {file}", given=file
        )


def make_folder(out: Path) -> None:
    """Make the folder that a command writes to."""
    try:
        out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise InvalidInputError(
            f"--out must be a folder that can be made, got {out}: {reason(error)}", given=out
        ) from error
