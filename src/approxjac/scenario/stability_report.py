"""The stability of a scenario's loop in words, pictures and files."""

from __future__ import annotations

import json
import textwrap
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from approxjac.files import together, write_text
from approxjac.formatting import joined, percent, plain, wrapped
from approxjac.scenario.judge import StabilityResult, uncertainty_of
from approxjac.simulation import Plant
from approxjac.stability import Uncertainty
from approxjac.stability.report.report import OF_WRONG_AXES, covered_starts
from approxjac.stability.rollouts.rollouts import clopper_pearson
from approxjac.stability.search.map import PARAMETERS, PLACES, labels
from approxjac.tasks import FrameKinematics
from approxjac.view import (
    new_figure,
    plot_allowed_error,
    plot_margins,
    plot_shares,
    save_figure,
)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

_OF_MAP = ("names", "x", "y", "share", "intervals", "runs")


def consequences(result: StabilityResult) -> str:
    """Return what follows, the verdict first, and how far each test tolerates the errors."""
    verdict, *more = advice(result)
    lines = [*wrapped(verdict), *(line for each in more for line in wrapped(each, "- "))]
    if result.tolerances:
        told = "in continuous time, by a search on fewer configurations; a report may find less:"
        lines += ["", *wrapped(told)]
        lines += [str(each) for each in result.tolerances.values()]
    return "\n".join(lines)


def told_of_map(result: StabilityResult, out: Path) -> list[str]:
    """Return what came of the runs of a map, and where its picture is."""
    found = result.map
    if found is None:
        return []
    lines, made = list[str](), np.flatnonzero(found.runs)
    if made.size:
        share, n = found.share.ravel(), found.runs.ravel()
        good, total = found.converged, int(n.sum())
        sure = ""
        if found.names[0] not in PARAMETERS:  # or points share what is drawn
            low, high = clopper_pearson(good, total)
            sure = f", with 95 % confidence {percent(low)} to {percent(high)} %"
        over = " and ".join(found.names)
        lines.append(f"map: {percent(good / total)} % of {total} runs over {over} converge{sure}")
        for what, k in (
            ("least", made[share[made].argmin()]),
            ("most", made[share[made].argmax()]),
        ):
            j, i = np.unravel_index(k, found.runs.shape)
            low, high = found.intervals[j, i]
            lines.append(
                f"  {what} of all points at {found.names[0]} {found.x[i]:.3g}, {found.names[1]} "
                f"{found.y[j]:.3g}: {percent(share[k])} % of {n[k]}, with 95 % confidence "
                f"{percent(low)} to {percent(high)} %"
            )
    return [*lines, f"The map is {out / 'map.png'}"]


def advice(result: StabilityResult) -> list[str]:
    """Return what follows, as sentences that a person can act on."""
    report, uncertainty = result.report, uncertainty_of(result.study)
    errors = "the true robot" if isinstance(report.loop.truth, Plant) else "the belief as it is"
    errors = errors if uncertainty is None else uncertainty.describe_box()
    if not report.gravity_is_exact:
        why = "gravity is neither known nor learnt"
        if report.loop.controller.adaptation is not None:
            why = f"no learnt gravity parameters explain all of gravity, {OF_WRONG_AXES}"
        return [f"not certified: {why}; controller.gravity exact tells of all else"]
    if report.singular_q is not None:
        return [
            "not certified: the estimated Jacobian loses rank in the region, where the arm may "
            "stand still away from its target; stability.sigma_min leaves such configurations out"
        ]
    if not report.local.stable:
        unstable = 100 * (1 - report.local.share)
        lines = [
            f"with all of these errors unstable near {unstable:.3g} % of the targets, in "
            "continuous time already, so no test can certify the region: smaller errors, another "
            "region or a smaller a = k_p/k_v may"
        ]
    else:
        first = report.theorem1
        best = max(report.matrix.values(), key=lambda test: (test.certified, test.margin))
        lines = [
            f"in continuous time Theorem 1 {_certifies(first.holds)} {errors}: {first}",
            f"in continuous time the matrix form {_certifies(best.certified)} it: margin "
            f"{best.margin:.3g}, violated in {best.violations} of {best.checked} further "
            "configurations",
        ]
        if (report.spectral_radii >= 1.0).any():
            lines.append(
                "sampled, errors grow: a shorter period, shorter delays or less damping of "
                "light joints may help"
            )
    if report.certified_by is not None:
        lines.insert(0, covered_starts(report.rows[1].figures))
    if not report.passed:
        lines.append(_next(result, uncertainty))
    return [report.verdict(), *lines]


def _certifies(does: bool) -> str:
    return "certifies" if does else "does not certify"


def _next(result: StabilityResult, uncertainty: Uncertainty | None) -> str:
    """Return what to do next where nothing is certified."""
    steps = ["a smaller stability.radius around a configuration (stability.around)"]
    if uncertainty is not None:
        learns = result.report.loop.controller.adaptation is not None
        steps.insert(
            0,
            "controller.gravity exact, which tells what is certified as if gravity were known"
            if learns  # of which gains that are found would say nothing
            else "suggest_gains, in place of controller.kp, controller.kv and controller.damping",
        )
        least, most = uncertainty.low, uncertainty.high
        if (abs(least + most - 2.0 * uncertainty.believed) > 0.2 * (most - least)).any():
            middle = dict(zip(uncertainty.names, 0.5 * (least + most), strict=True))
            options = [
                f"believed.object.{what} {middle[f'object_{what}']:.3g}"
                for what in ("length", "mass")
                if f"object_{what}" in middle
            ]
            such = f", such as {' '.join(options)}" if options else ""
            steps.append(f"a belief in the middle of each range{such}")
        scale = result.tolerances["matrix"].scale
        if 0.0 < scale < 1.0:  # of which a report may find a little less
            smaller = uncertainty.scaled(0.8 * scale).describe_box()
            steps.append(f"smaller errors, such as {smaller}")
    return f"next: {'; '.join(steps)}"


def draw_allowed_error(result: StabilityResult) -> Figure:
    """Draw Figure 1 of the paper for this arm and its errors."""
    first, controller = result.report.theorem1, result.report.loop.controller
    kp, kv, _ = controller.diagonals
    figure, (ax,) = new_figure(size=(6.5, 4.8))
    plot_allowed_error(
        first.lambda_2,
        first.p,
        unit=f"{joined(controller.task.units)}/rad",
        p_label=r"$p$ of the errors, the largest $\|J^T - \hat{J}^T\|$",
        own_a=float(kp.max() / kv.max()),
        ax=ax,
    )
    return figure


def draw_workspace(result: StabilityResult) -> Figure:
    """Draw the margin of the matrix form over the workspace, in two planes of the world."""
    report = result.report
    best = max(report.matrix.values(), key=lambda test: test.margin)
    robot = report.loop.controller.task.robot
    tip = FrameKinematics(robot, robot.tip_or(None))
    positions = np.array([tip.position(q) for q in report.samples.q[: len(best.margins)]])
    widths = np.ptp(positions, axis=0)
    pairs = {"xz": widths[[0, 2]], "xy": widths[:2]}  # on a line in a plane nothing is to be seen
    planes = [plane for plane, two in pairs.items() if two.min() > 0.01 * two.max()] or ["xz"]
    between = " " if len(planes) > 1 else "\n"
    figure, axes = new_figure(
        len(planes),
        size=(5.2 * len(planes), 4.6),
        title=f"{robot.name}: margin of the matrix form in continuous time,{between}"
        "where the believed tip is",
    )
    for ax, plane in zip(axes, planes, strict=True):
        plot_margins(positions, best.margins, plane, ax, title=f"{plane[0]}-{plane[1]} plane")
    return figure


def _own(result: StabilityResult, uncertainty: Uncertainty) -> tuple[float, float] | None:
    """Return where on the map the controller and its errors are, or the belief."""
    assert result.map is not None
    kp, kv, _ = result.report.loop.controller.diagonals
    at = {"a": float(np.mean(kp / kv))}  # the errors and all other gains are themselves, times 1
    at |= dict(zip(uncertainty.names, uncertainty.believed.tolist(), strict=True))
    first, second = result.map.names
    return None if {first, second} & {*PLACES} else (at.get(first, 1.0), at.get(second, 1.0))


def draw_map(result: StabilityResult) -> Figure | None:
    """Draw the share of runs that converge, between its interval's ends; None of no map."""
    found, uncertainty = result.map, uncertainty_of(result.study)
    if found is None or uncertainty is None:
        return None
    name = result.report.loop.controller.task.robot.name
    figure, axes = new_figure(
        3,
        size=(14.0, 4.6),
        title=textwrap.fill(
            f"{name}: share of {found.runs.sum()} runs that converge, each with 95 % confidence; "
            f"errors are {uncertainty.describe_box()}",
            130,
        ),
    )
    named = labels(uncertainty)
    low, high = found.intervals[..., 0], found.intervals[..., 1]
    none = np.isnan(found.share)
    for ax, shares, title in zip(
        axes, (low, found.share, high), ("at least", "of the runs", "at most"), strict=True
    ):
        plot_shares(
            found.x,
            found.y,
            np.where(none, np.nan, shares),
            labels=(named[found.names[0]], named[found.names[1]]),
            own=_own(result, uncertainty),
            own_name="as given" if found.names[0] in PARAMETERS else "as believed",
            ax=ax,
            title=title,
        )
        if found.names[0] in PLACES and found.names[1] in PLACES:
            ax.set_aspect("equal", adjustable="datalim")
    return figure


def summary(result: StabilityResult) -> dict[str, Any]:
    """Return what goes into summary.json."""
    map_ = result.map
    found = {
        **result.report.summary(),
        "tolerance": {
            test: {
                "scale": each.scale,
                "fails_at": each.fails_at,
                "is_tested": each.is_tested,
                "errors": each.uncertainty.describe_box(),
                "worst": each.worst_text,
            }
            for test, each in result.tolerances.items()
        },
        "advice": advice(result),
        "gains": result.report.loop.controller.diagonals._asdict(),
        "map": map_
        and {
            name: getattr(map_, name) for name in ("names", "x", "y", "share", "intervals", "runs")
        },
        "scenario": asdict(result.scenario),
    }
    return {name: plain(value) for name, value in found.items()}


def write(result: StabilityResult, out: Path) -> None:
    """Write the pictures, summary.json and scenario.toml into a folder."""
    drawn = draw_map(result)
    with together(out) as folder:
        save_figure(draw_allowed_error(result), folder / "figure1")
        save_figure(draw_workspace(result), folder / "workspace")
        if drawn is not None:
            save_figure(drawn, folder / "map")
        result.scenario.save(folder / "scenario.toml")
        write_text(folder / "summary.json", json.dumps(summary(result), indent=2) + "\n")
        for ending in ("png", "svg") if drawn is None else ():
            # no map of another run beside the other files
            (out / f"map.{ending}").unlink(missing_ok=True)
