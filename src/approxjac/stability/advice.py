"""Advice for a loop that is not certified: more damping, or smaller errors."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from approxjac.controllers import Gains, SetpointController
from approxjac.stability.region import Region
from approxjac.stability.report import stability_report
from approxjac.stability.uncertainty import Uncertainty

_RAISED = (1.5, 2.0, 3.0, 5.0, 10.0, 20.0)  # times the damping
_SHARES = (1.0, 0.9, 0.8, 0.65, 0.5)  # of the largest scale


def damping_that_certifies(
    controller: SetpointController,
    uncertainty: Uncertainty,
    region: Region | None = None,
    *,
    progress: Callable[[float], None] | None = None,
    **options: Any,
) -> float | None:
    """Return the smallest factor of the added damping, of six tried, that a report certifies.

    Args:
        controller: The controller.
        uncertainty: The errors.
        region: Where to look; see `stability_report`.
        progress: Called with the share of the factors that were tried.
        options: `target`, `configurations` and `seed` of each `stability_report`.

    Returns:
        The factor, 1.5 to 20; None if none of them does.

    Raises:
        InvalidInputError: What `stability_report` refuses.
    """
    kp, kv, damping = controller.diagonals
    for k, factor in enumerate(_RAISED):
        if progress is not None:
            progress(k / len(_RAISED))
        raised = controller.with_gains(Gains(kp, kv, factor * damping))
        if stability_report(raised, uncertainty, region, **options).certified_by is not None:
            return factor
    return None


def part_that_certifies(
    controller: SetpointController,
    uncertainty: Uncertainty,
    region: Region | None = None,
    *,
    largest: float = 1.0,
    progress: Callable[[float], None] | None = None,
    **options: Any,
) -> Uncertainty | None:
    """Return the largest part of the errors, of five tried, that a report certifies.

    A report asks for more than `tolerance` does: it draws more configurations, and checks on others
    what it chose. Arguments are as of `damping_that_certifies`.

    Args:
        controller: The controller.
        uncertainty: The errors at scale 1.
        region: Where to look.
        largest: Scale to begin with, such as what `tolerance` tells; half of it is the last tried.
        progress: Called with the share of the scales that were tried.
        options: Of each report.

    Returns:
        The errors, scaled down; None if no part tried is certified, or `largest` is 0.
    """
    for k, share in enumerate(_SHARES if largest > 0.0 else ()):
        if progress is not None:
            progress(k / len(_SHARES))
        part = uncertainty.scaled(share * largest)
        if stability_report(controller, part, region, **options).certified_by is not None:
            return part
    return None
