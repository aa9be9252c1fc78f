"""Starts that a `StabilityReport` certifies, against the usual ones of its region, in words."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from approxjac.formatting import joined, percent
from approxjac.validation import Array

if TYPE_CHECKING:
    from approxjac.stability.report.report import StabilityReport

_DRAWN = 400  # starts that tell what is usual
IF_IT_STAYS = "as long as the arm stays in the region"


def are_any(report: StabilityReport) -> bool:
    """Return whether there are starts from which it is proven that the region is not left."""
    return report.attraction is not None and bool(report.attraction.radius)


def told(report: StabilityReport) -> str:
    """Return for which starts a certificate holds, and how far the usual ones are away."""
    sampled, stays, unit = report.sampled, report.attraction, _unit(report)
    assert sampled is not None
    e = usual_errors(report)
    saturation = report.loop.controller.saturation
    share = (sampled.weights.at_rest(saturation.S(e), saturation.s(e)) <= sampled.level).mean()
    of_these = "all" if share == 1.0 else f"{percent(share)} %" if share else "none"
    goes = f"the error goes to zero {IF_IT_STAYS}" if share else "is anything proven"
    away = f"{np.median(np.linalg.norm(e, axis=1)):.2g} {unit} from their target in the median"
    if stays is not None and stays.radius:
        begins = (
            f"Covers starts at rest up to {stays.error:.2g} {unit} from their target "
            f"({_within(report)} of the region's middle)"
        )
    else:
        begins = "From no start is it proven that the arm stays in the region"
    return f"{begins}. From {of_these} of the usual starts ({away}) {goes}."


def usual_errors(report: StabilityReport) -> Array:
    """Return errors between configurations of the region, or to its one target, shape (N, m)."""
    loop, rng = report.loop, np.random.default_rng(report.seed)
    truths = np.arange(_DRAWN) % len(loop.corners)
    q, ends = (loop._seen(truths, loop.region.sample(_DRAWN, rng), rng) for _ in range(2))
    if loop.target is None:
        return loop.errors(truths, q, loop._values(truths, ends))
    return loop.errors(truths, q, np.tile(np.asarray(loop.target), (_DRAWN, 1)))


def covered(report: StabilityReport) -> str:
    """Return which starts the form covers while the arm stays in the region."""
    sampled = report.sampled
    assert sampled is not None
    units, reach = report.loop.controller.task.units, sampled.reach
    each = ", ".join(f"{r:.2g} {unit}" for r, unit in zip(reach, units, strict=True))
    if len(set(units)) == 1:
        each = f"{', '.join(f'{r:.2g}' for r in reach)} {units[0]}"
    return (
        f"at rest, with an error of up to {each} in one coordinate, none in the others; "
        f"{100.0 * sampled.covered:.3g} % of the starts drawn, about half near their targets"
    )


def staying(report: StabilityReport) -> tuple[str, str, str]:
    """Return the row about starts from which the region is not left."""
    name, found = "as it runs, staying", report.attraction
    if found is None or not are_any(report):
        return name, "assumed", "from no start is it proven that the arm stays in the region"
    figures = (
        f"holds from rest, {_within(report)} of the region's middle in every joint (errors of up "
        f"to {found.error:.2g} {_unit(report)}); assumed elsewhere"
    )
    return name, "in part", figures


def _within(report: StabilityReport) -> str:
    """Return what must be near the region's middle: the start, and a target that is not fixed."""
    assert report.attraction is not None
    both = "start and target" if report.loop.target is None else "start"
    return f"{both} within {report.attraction.radius:.2g} {_joint_unit(report)}"


def _unit(report: StabilityReport) -> str:
    return joined(report.loop.controller.task.units)


def _joint_unit(report: StabilityReport) -> str:
    return "rad" if set(report.loop.plants[0].robot.joint_units) == {"rad"} else "rad or m"
