"""Rows of a `StabilityReport`: what was tested, the verdict, and the figures it rests on."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import pinocchio as pin

from approxjac.controllers import Latency
from approxjac.formatting import joined
from approxjac.stability.errors.region import JointBox
from approxjac.stability.errors.uncertainty import Uncertainty
from approxjac.stability.loop.linearization import Timing
from approxjac.validation import Array

if TYPE_CHECKING:
    from approxjac.stability.certificates.certificate import MatrixTest
    from approxjac.stability.certificates.limit_cost import LimitCost
    from approxjac.stability.loop.closed_loop import ClosedLoop
    from approxjac.stability.report.report import StabilityReport
    from approxjac.stability.rollouts.rollouts import Rollouts

_TINY = 1e-6
_DRAWN = 400  # starts that tell what is usual
FAMILIES = {
    "paper": "paper's weights",
    "free": "free potential",
    "wide": "widened",
    "full": "coupled",
}


class Row(NamedTuple):
    """A finding of a report.

    Attributes:
        part: Of the report: "verdict", "about", "beware", "sampled", "limits", "continuous",
            "worst" or "rollouts".
        name: What was tested.
        verdict: In a word or two; empty where there is none.
        figures: Name → number, array, flag or name that it rests on.
    """

    part: str
    name: str
    verdict: str
    figures: Mapping[str, Any]


def rows_of(report: StabilityReport) -> list[Row]:
    """Return all rows of a report, the verdict first."""
    rows = [verdict(report), _meaning(report), *_about(report), *_beware(report)]
    rows += _sampled(report)
    if report.limits is not None:
        rows += of_limits(report.limits)
    rows += _continuous(report)
    if report.rollouts is not None:
        rows += of_rollouts(report.rollouts)
    return rows


# -- the verdict --------------------------------------------------------------------------------


def verdict(report: StabilityReport) -> Row:
    """Return whether the sampled loop is certified, and why not."""
    latency = report.latency
    timing = {"period": latency.period, "late": latency.of_position > latency.period}
    if report.certified_by is not None and report.sampled is not None:
        figures = {"margin": report.sampled.margin, "stays": report.has_starts_that_stay}
        return Row("verdict", "certified", "yes", timing | figures)
    if report.passed:
        margin = max(test.margin for test in report.matrix.values())
        return Row("verdict", "certified", "in continuous time only", timing | {"margin": margin})
    return Row("verdict", "certified", "no", timing | _why(report))


def _why(report: StabilityReport) -> dict[str, Any]:
    """Why a loop is not certified, and the figures of that."""
    found: dict[str, Any] = {"reason": report.reason}
    if report.reason == "gravity":
        found |= {"error": report.gravity_error}
    elif report.reason == "unstable":
        found |= {"share": float((report.spectral_radii >= 1.0).mean())}
    elif report.reason == "rollouts diverged" and report.rollouts is not None:
        found |= {"diverged": report.rollouts.n_diverged, "runs": report.rollouts.n}
    elif report.reason == "violated" and report.sampled is not None:
        found |= {"violations": report.sampled.violations, "checked": report.sampled.checked}
    return found


def _meaning(report: StabilityReport) -> Row:
    """Return what follows from the verdict."""
    runs = report.rollouts
    figures: dict[str, Any] = {} if runs is None else {"left": runs.n_left, "runs": runs.n}
    if report.certified_by is not None:
        return Row("verdict", "covers", "certified", figures | _starts(report))
    if report.passed:
        return Row("verdict", "covers", "continuous", figures)
    judged = replace(report, gravity_error=0.0) if report.loop.integral_terms else report
    if judged.contradiction:
        figures |= {"rounded": bool(_rounded(report.latency))}
        return Row("verdict", "covers", "problem", figures)
    return Row("verdict", "covers", "unknown", figures)


def _starts(report: StabilityReport) -> dict[str, Any]:
    """For which starts a certificate holds, and how far the usual ones are away."""
    sampled, stays = report.sampled, report.attraction
    assert sampled is not None
    e, saturation = usual_errors(report), report.loop.controller.saturation
    energies = sampled.weights.at_rest(saturation.S(e), saturation.s(e))
    return {
        "radius": 0.0 if stays is None else stays.radius,
        "error": 0.0 if stays is None else stays.error,
        "any_target": report.loop.target is None,
        "share": float((energies <= sampled.level).mean()),
        "usual": float(np.median(np.linalg.norm(e, axis=1))),
        "unit": joined(report.loop.controller.task.units),
        "joint_unit": _joint_unit(report),
    }


def usual_errors(report: StabilityReport) -> Array:
    """Return errors between configurations of the region, or to its one target, shape (N, m)."""
    loop, rng = report.loop, np.random.default_rng(report.seed)
    truths = np.arange(_DRAWN) % len(loop.corners)
    q, ends = (loop.seen(truths, loop.region.sample(_DRAWN, rng), rng) for _ in range(2))
    if loop.target is None:
        return loop.errors(truths, q, loop.values_at(truths, ends))
    return loop.errors(truths, q, np.tile(np.asarray(loop.target), (_DRAWN, 1)))


def _about(report: StabilityReport) -> Iterator[Row]:
    truth, loop, paper = report.loop.truth, report.loop, report.matrix["paper"]
    latency = report.latency
    names = ("period", "torque_delay", "velocity_filter", "image_period", "image_age")
    errors = truth.describe_box() if isinstance(truth, Uncertainty) else "one true robot"
    yield Row("about", "law", "", {"law": loop.controller.describe()[0]})
    yield Row("about", "timing", "", {name: getattr(latency, name) for name in names})
    yield Row("about", "errors", "", {"errors": errors})
    yield Row("about", "region", "", {"region": str(loop.region)})
    yield Row("about", "assumed", "", {"learns": loop.controller.adaptation is not None})
    drawn = {"chosen": len(paper.margins), "checked": paper.checked, "seed": report.seed}
    yield Row("about", "drawn", "", drawn)
    yield Row("about", "margin", "", {})


# -- what is not as certificates assume, or as one may think ------------------------------------


def _beware(report: StabilityReport) -> Iterator[Row]:
    loop, angles = report.loop, report.loop.plants[0].robot.angles
    if not report.gravity_is_exact:
        yield of_gravity(loop, report.gravity_error)
    if report.singular_q is not None:
        yield Row("beware", "rank", "lost", {"q": angles(report.singular_q)})
    if report.damped_q is not None:
        yield Row("beware", "learning", "damped", {"q": angles(report.damped_q)})
    if beyond := _beyond_limits(report):
        yield Row("beware", "joint limits", "beyond", {"joints": beyond})
    if rounded := _rounded(report.latency):
        yield Row("beware", "timing", "rounded", rounded)


def of_gravity(loop: ClosedLoop, error: float) -> Row:
    """Return the row about a gravity torque that is neither compensated nor learnt [N m]."""
    learns = loop.controller.adaptation is not None
    figures = {"error": error, "learns": learns, "by": loop.integral_terms}
    return Row("beware", "gravity", "not exact", figures)


def _beyond_limits(report: StabilityReport) -> list[str]:
    """Names of joints that the region lets go beyond their limits."""
    region, robot = report.loop.region, report.loop.plants[0].robot
    zero = robot.neutral()
    if isinstance(region, JointBox):
        middle = pin.difference(robot.model, zero, region.center)
        low, high = middle + region.lower, middle + region.upper
    else:
        motions = np.array([pin.difference(robot.model, zero, q) for q in report.samples.q])
        low, high = motions.min(axis=0), motions.max(axis=0)
    least, most = robot.position_limits
    beyond = (low < least - _TINY) | (high > most + _TINY)
    return [name for name, is_so in zip(robot.joint_names, beyond, strict=True) if is_so]


def _rounded(latency: Latency) -> dict[str, dict[str, float]]:
    """How rollouts and the linearisation round times: by whom, what is taken [s]."""
    period, given = latency.period, (latency.torque_delay, latency.image_age)
    dt, _, age, late = latency.in_samples()
    whole = [round(each / period) for each in given]
    found = {}
    for who, step, counts in (("rollouts", period, whole), ("near targets", dt, (late, age))):
        taken: dict[str, float] = {}
        for name, value, n in zip(("torque_delay", "image_age"), given, counts, strict=True):
            if abs(value - n * step) > _TINY * period:
                taken |= {name: n * step, f"given_{name}": value}
        if step > period * (1.0 + _TINY):
            taken["period"] = step
        if taken:
            found[who] = taken
    return found


# -- the tests ----------------------------------------------------------------------------------


def _sampled(report: StabilityReport) -> Iterator[Row]:
    """Rows about the loop that is sampled and late."""
    sampled = report.sampled
    if sampled is not None:
        said = "holds" if sampled.certified else "does not hold"
        if sampled.certified and report.reason:
            said = "withdrawn"
        figures = _figures(report, sampled) | {"family": sampled.family}
        figures |= {name: getattr(sampled, name) for name in ("speed", "level")}
        yield Row("sampled", "matrix form", said, figures)
        if not report.reason:
            units = report.loop.controller.task.units
            covered = {
                "certified_error": sampled.certified_error,
                "units": units,
                "covered": sampled.covered,
            }
            yield Row("sampled", "starts", "", covered)
            stays = report.attraction
            said = "in part" if report.has_starts_that_stay else "assumed"
            figures = _starts(report)
            if stays is not None:
                names = ("travel", "rate", "level")
                figures |= {name: getattr(stays, name) for name in names}
                figures |= stays.weights._asdict()
            yield Row("sampled", "staying", said, figures)
        certified, stable = report.largest_period
        yield Row("sampled", "longest period", "", {"certified": certified, "stable": stable})
        if certified:
            late = {"certified": report.largest_delay, "given": report.latency.torque_delay}
            yield Row("sampled", "longest delay of torques", "", late)
    radii, frame = report.spectral_radii, Timing.of(report.latency).frame
    worst = float(radii.max())
    near = {
        "spectral_radius": worst,
        "frame": frame,
        "targets": len(radii),
        "unstable": int((radii >= 1.0).sum()),
        "decay": -math.log(worst) / frame if worst > 0.0 else math.inf,
        "learns": report.loop.controller.adaptation is not None,
    }
    yield Row("sampled", "near targets", "unstable" if near["unstable"] else "stable", near)


def _figures(report: StabilityReport, test: MatrixTest) -> dict[str, Any]:
    """Figures of a test of the matrix form."""
    names = ("margin", "share", "violations", "checked", "violating_at_most", "certified")
    return {
        **{name: getattr(test, name) for name in names},
        **_case(report, int(report.samples.truth[test.worst]), report.samples.q[test.worst]),
        **test.weights._asdict(),
    }


def _case(report: StabilityReport, truth: int, q: Array) -> dict[str, Any]:
    """Figures of one of the cases: the true robot and the configuration."""
    angles = report.loop.plants[0].robot.angles(q)
    return {"worst_truth": report.describe_truth(truth), "worst_q": angles}


def _continuous(report: StabilityReport) -> Iterator[Row]:
    """Rows about the same loop in continuous time, and the worst cases."""
    first, local, samples = report.theorem1, report.local, report.samples
    passed = "holds" if report.is_as_assumed else "would hold"
    names = ("p", "allowed_p", "alpha", "alpha_max", "margin", "allowed_p_large_gains",
             "alpha_range", "b_J", "lambda_m", "lambda_1", "lambda_2", "c0", "c1")  # fmt: skip
    figures = {name: getattr(first, name) for name in names}
    figures |= {"holds": first.holds, "too_fast": first.is_too_fast}
    said = passed if first.holds else "does not hold"
    yield Row("continuous", "Theorem 1", said, figures)
    for family, test in report.matrix.items():
        said = passed if test.certified else "does not hold"
        yield Row("continuous", FAMILIES[family], said, _figures(report, test))
    near = {
        "targets": len(local.q),
        "unstable": int((local.decay_rates <= 0.0).sum()),
        "decay": float(local.decay_rates.min()),
        "damping_ratio": float(local.damping_ratios.min()),
        "learns": report.loop.controller.adaptation is not None,
    }
    yield Row("continuous", "near targets", "stable" if local.stable else "unstable", near)
    form = report.sampled or list(report.matrix.values())[-1]
    for name, truths, q, k in (
        ("matrix form", samples.truth, samples.q, form.worst),
        ("near targets", local.truth, local.q, local.worst),
        ("Theorem 1", samples.truth, samples.q, first.worst["p"]),
    ):
        yield Row("worst", name, "", _case(report, int(truths[k]), q[k]))


def of_limits(cost: LimitCost) -> list[Row]:
    """Return rows about limits of effort."""
    if not cost.holds:
        return [Row("limits", "where they act", cost.verdict, {"free": cost.free})]
    rows = [Row("limits", "at rest", "", {"free": cost.free, "clipped": cost.clipped})]
    if cost.level:
        rows.append(Row("limits", "certified", "", {"level": cost.level}))
    rows.append(Row("limits", "where they act", cost.verdict, {}))
    return [*rows, Row("limits", "not checked", "", {"uncounted": cost.uncounted})]


def of_rollouts(found: Rollouts) -> list[Row]:
    """Return rows about simulated runs."""
    (low, high), worst, setting, n = found.interval, found.worst, found.setting, found.n
    unit = joined(setting.controller.task.units)
    converged = {
        "runs": n, "converged": found.n_converged, "low": low, "high": high, "unit": unit,
        "accuracy": setting.accuracy, "duration": setting.duration,
    }  # fmt: skip
    rows = [
        Row("rollouts", "converged", f"{found.n_converged} of {n}", converged),
        Row("rollouts", "diverged", f"{found.n_diverged} of {n}", {"diverged": found.n_diverged}),
        Row("rollouts", "left the region", f"{found.n_left} of {n}", {"left": found.n_left}),
    ]
    if found.n_beyond_torque:
        peaks = {
            "beyond": found.n_beyond_torque,
            "most": float(np.nanmax(found.columns["peak_torque"])),
            "unknown": found.n_diverged,
        }
        count = f"{'at least ' if found.n_diverged else ''}{found.n_beyond_torque} of {n}"
        rows.append(Row("rollouts", "torques", count, peaks))
    ended = {
        "diverged": worst.diverged, "error": worst.final_error, "unit": unit,
        "values": setting.uncertainty.describe(worst.values),
    }  # fmt: skip
    return [*rows, Row("rollouts", "worst", f"run {worst.index}", ended)]


def _joint_unit(report: StabilityReport) -> str:
    return "rad" if set(report.loop.plants[0].robot.joint_units) == {"rad"} else "rad or m"
