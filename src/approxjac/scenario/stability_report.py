"""The stability of a scenario's loop, in words and pictures."""

from __future__ import annotations

import dataclasses
import json
import math
import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from approxjac.formatting import joined
from approxjac.scenario.stability import StabilityResult
from approxjac.scenario.tables import plain
from approxjac.simulation import Plant
from approxjac.stability import StabilityReport
from approxjac.stability.map import PARAMETERS
from approxjac.tasks import FrameKinematics
from approxjac.validation import Array
from approxjac.view import new_figure, plot_allowed_error, plot_map, plot_margins, save_figure

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def verdicts(report: StabilityReport) -> str:
    """Return the table of the four tests."""
    return f"{report.loop.truth!r}\n{report}\n"


def consequences(result: StabilityResult) -> str:
    """Say what each test tolerates, and what to do."""
    lines = []
    if result.tolerances:
        heading = "how far the errors may be scaled (a search, on fewer configurations)"
        lines = [heading, *_tolerated(result), ""]
    return "\n".join([*lines, *advice(result)])


def advice(result: StabilityResult) -> list[str]:
    """Say what follows, as sentences that a person can act on."""
    report, uncertainty = result.report, result.uncertainty
    errors = "the true robot" if isinstance(report.loop.truth, Plant) else "the belief as it is"
    errors = errors if uncertainty is None else uncertainty.describe_box()
    if not report.gravity_is_exact:
        return ["not certified: gravity is neither known nor can it be learnt (wrong joint axes)"]
    if report.singular_q is not None:
        return [
            "not certified: the estimated Jacobian loses rank in the region, where the arm may "
            "stand still away from its target; --sigma-min leaves such configurations out"
        ]
    first = report.theorem1
    sign = "<" if first.holds else ">="
    lines = [
        f"Theorem 1 {'certifies' if first.holds else 'does not certify'} {errors}: "
        f"p = {first.p:.3g} {sign} {max(first.allowed_p, 0.0):.3g}"
    ]
    best = max(report.matrix.values(), key=lambda test: (test.certified, test.margin))
    if not report.local.stable:
        unstable = 100 * (1 - report.local.share)
        lines = [
            f"with all of these errors not stable near {unstable:.3g} % of the targets, so no "
            "test can certify the region: smaller errors, another region or a smaller a = k_p/k_v "
            "may"
        ]
    elif best.certified:
        lines.append(f"the matrix form certifies it with margin {best.margin:.3g}")
    else:
        reason = f"margin {best.margin:.3g}"
        if best.margin > 0.0:
            reason = (
                f"{reason} where it was chosen, but violated in {best.violations} of "
                f"{best.checked} further configurations (more may find a better function)"
            )
        lines.append(f"the matrix form does not certify it: {reason}")
    if result.raised_damping is not None:
        damping = result.raised_damping * result.loop.controller.diagonals.damping
        lines.append(
            f"raise damping to {_short(damping)}, {result.raised_damping:g} times what it is, "
            "to certify it"
        )
    if result.certified_part is not None:
        part = result.certified_part.describe_box()
        lines.append(
            f"as it is, certified are errors of {part} (with all configurations and others to "
            "check it, which the search above has not)"
        )
    return lines


def draw_figure_1(result: StabilityResult) -> Figure:
    """Figure 1 for this arm and its errors."""
    first, controller = result.report.theorem1, result.loop.controller
    kp, kv, _ = controller.diagonals
    figure, (ax,) = new_figure(size=(6.5, 4.8))
    plot_allowed_error(
        first.lambda_2,
        first.p,
        unit=f"{joined(controller.task.units)}/rad",
        p_label="p of the errors, the largest ‖Jᵀ − Ĵᵀ‖",
        own_a=float(kp.max() / kv.max()),
        ax=ax,
    )
    return figure


def draw_workspace(result: StabilityResult) -> Figure:
    """Margin of the matrix form over the workspace, in two planes of the world."""
    report = result.report
    best = max(report.matrix.values(), key=lambda test: test.margin)
    robot = result.loop.controller.task.robot
    tip = FrameKinematics(robot, robot.tip_or(None))
    positions = np.array([tip.position(q) for q in report.samples.q[: len(best.margins)]])
    planes = [name for name in ("xz", "xy") if _spreads(positions, name)] or ["xz"]
    between = " " if len(planes) > 1 else "\n"
    figure, axes = new_figure(
        len(planes),
        size=(5.2 * len(planes), 4.6),
        title=f"{robot.name}: margin of the matrix form{between}where the believed tip is",
    )
    for ax, plane in zip(axes, planes, strict=True):
        plot_margins(positions, best.margins, plane, ax, title=f"{plane[0]}-{plane[1]} plane")
    return figure


def _spreads(positions: Array, plane: str) -> bool:
    """Whether positions (N, 3) fill a plane of the world, and are not on a line in it."""
    widths = np.ptp(positions[:, ["xyz".index(axis) for axis in plane]], axis=0)
    return bool(widths.min() > 0.01 * widths.max())


def draw_map(result: StabilityResult) -> Figure | None:
    """The stability map, or None if none was made."""
    found, uncertainty = result.map, result.uncertainty
    if found is None or uncertainty is None:
        return None
    boundaries = [
        ("test 1, Theorem 1", found.x, found.y, found.theorem1),
        (
            "test 2, matrix form (a sketch: 100 configurations)",
            found.coarse_x,
            found.coarse_y,
            found.matrix,
        ),
    ]
    if np.isfinite(found.rollouts).any():
        # half way between all runs and the next smaller share
        share = found.rollouts - 1.0 + 0.5 / max(1, result.scenario.stability.map_runs)
        boundaries.append(
            ("test 4, rollouts reach 1 mm in 10 s", found.coarse_x, found.coarse_y, share)
        )
    figure, (ax,) = new_figure(size=(7.0, 5.8))
    plot_map(
        found.x,
        found.y,
        found.decay_rate,
        boundaries,
        labels=(PARAMETERS[found.names[0]], PARAMETERS[found.names[1]]),
        local=f"test 3, local ({found.targets} targets)",
        own=(_own(result, found.names[0]), _own(result, found.names[1])),
        ax=ax,
        title=textwrap.fill(
            f"{result.loop.controller.task.robot.name}: where each test passes; "
            f"errors of scale 1 are {uncertainty.describe_box()}",
            64,
        ),
    )
    return figure


def summary(result: StabilityResult) -> dict[str, Any]:
    """Return what goes into summary.json."""
    found = result.map
    return {
        **result.report.summary(),
        "rollouts": None
        if result.report.rollouts is None
        else {
            "runs": result.report.rollouts.n,
            "converged": result.report.rollouts.n_converged,
            "interval": list(result.report.rollouts.interval),
        },
        "tolerance": {
            test: {
                "scale": each.scale,
                "fails_at": each.fails_at if math.isfinite(each.fails_at) else None,
                "errors": each.uncertainty.describe_box(),
                "worst": each.worst_text,
            }
            for test, each in result.tolerances.items()
        },
        "raised_damping": result.raised_damping,
        "certified_part": None
        if result.certified_part is None
        else result.certified_part.describe_box(),
        "advice": advice(result),
        "gains": {
            name: value.tolist()
            for name, value in result.loop.controller.diagonals._asdict().items()
        },
        "map": None
        if found is None
        else {
            field.name: _plain(getattr(found, field.name)) for field in dataclasses.fields(found)
        },
        "scenario": plain(result.scenario),
    }


def write(result: StabilityResult, out: Path) -> None:
    """Write the pictures, summary.json and scenario.toml into a folder."""
    save_figure(draw_figure_1(result), out / "figure1")
    save_figure(draw_workspace(result), out / "workspace")
    drawn = draw_map(result)
    if drawn is not None:
        save_figure(drawn, out / "map")
    else:  # no map of another run beside the other files
        for ending in ("png", "svg"):
            (out / f"map.{ending}").unlink(missing_ok=True)
    result.scenario.save(out / "scenario.toml")
    (out / "summary.json").write_text(json.dumps(summary(result), indent=2) + "\n", "utf-8")


def _tolerated(result: StabilityResult) -> list[str]:
    names = {
        "theorem1": "1 Theorem 1",
        "matrix": "2 matrix form",
        "local": "3 local",
    }
    lines = []
    for test, each in result.tolerances.items():
        fails = f"; fails with {each.worst_text}" if each.worst_text else ""
        lines.append(
            f"{names[test]:<14} to {each.scale:<6.3g} {each.uncertainty.describe_box()}{fails}"
        )
    return lines


def _own(result: StabilityResult, name: str) -> float:
    """Where the controller and its errors are on an axis of the map."""
    kp, kv, _ = result.loop.controller.diagonals
    return float(np.mean(kp / kv)) if name == "a" else 1.0


def _plain(value: Any) -> Any:
    """Arrays as lists, with None for what is not finite."""
    if isinstance(value, np.ndarray):
        return [_plain(entry) for entry in value]
    if isinstance(value, float | np.floating):
        return float(value) if math.isfinite(value) else None
    return value


def _short(values: Array) -> str:
    numbers = [f"{value:.3g}" for value in values]
    return numbers[0] if len(set(numbers)) == 1 else f"[{', '.join(numbers)}]"
