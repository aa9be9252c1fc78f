"""What a `StabilityReport` says: the verdict, what it covers, and the tests it rests on."""

from __future__ import annotations

from typing import TYPE_CHECKING

from approxjac.controllers import Latency
from approxjac.stability.limit_cost import LimitCost
from approxjac.stability.local import LocalTest
from approxjac.stability.samples import Samples
from approxjac.stability.uncertainty import Uncertainty

if TYPE_CHECKING:
    from approxjac.stability.report import StabilityReport

Row = tuple[str, str, str]
"""Of the table: test, verdict, and the figures it rests on."""

_FAMILIES = {
    "paper": "paper's weights",
    "free": "free potential",
    "wide": "widened",
    "full": "coupled",
}


def verdict(report: StabilityReport) -> str:
    """Return in one line whether the loop as it runs is certified, and why not."""
    runs = _timed(report.latency)
    if report.certified_by is not None and report.sampled is not None:
        return f"certified: yes, margin {report.sampled.margin:.2g}, as it runs at {runs}"
    if report.passed:
        margin = max(test.margin for test in report.matrix.values())
        return (
            f"certified: in continuous time only, margin {margin:.2g}; gravity is learnt, and for "
            f"that there is no certificate of the loop as it runs at {runs}"
        )
    return f"certified: no, as it runs at {runs}: {report.reason}"


def text(report: StabilityReport) -> str:
    """Return all of it."""
    rows, paper = table(report), report.matrix["paper"]
    first, second = (max(len(row[k]) for row in rows) for k in range(2))
    lines = [f"{test:<{first}}  {said:<{second}}  {figures}" for test, said, figures in rows]
    drawn = (
        f"{len(paper.margins)} configurations, {paper.checked} further ones to check, seed "
        f"{report.seed}"
    )
    return "\n".join([verdict(report), *_covers(report), drawn, *lines])


def table(report: StabilityReport) -> list[Row]:
    """Return a row for each test."""
    return [
        *_assumptions(report),
        *_as_it_runs(report),
        *([] if report.limits is None else [_limits(report.limits)]),
        *_in_continuous_time(report),
        *([] if report.rollouts is None else [("rollouts", "", str(report.rollouts))]),
    ]


def _covers(report: StabilityReport) -> list[str]:
    """What the verdict is about: timing, law, errors, region."""
    truth, latency = report.loop.truth, report.latency
    errors = truth.describe_box() if isinstance(truth, Uncertainty) else "one true robot"
    late = [f"torques {1e3 * latency.torque_delay:.3g} ms late"] if latency.torque_delay else []
    if latency.velocity_filter:
        late.append(f"joint velocities filtered over {1e3 * latency.velocity_filter:.3g} ms")
    if latency.image_period or latency.image_age:
        late.append(
            f"x every {1e3 * latency.image_period:.3g} ms, {1e3 * latency.image_age:.3g} ms old"
        )
    timing = ", ".join([f"a period of {1e3 * latency.period:.3g} ms", *late])
    return [
        f"  for {report.loop.controller!r}, no torque limit in reach, viscous friction",
        f"  with {timing}",
        f"  errors: {errors}",
        f"  region: {report.loop.region!r}",
    ]


def _assumptions(report: StabilityReport) -> list[Row]:
    rows = []
    if not report.gravity_is_exact:
        figures = (
            f"off by up to {report.gravity_error:.3g} N m: the error does not go to 0 but to "
            "where K_p makes up for it, unless gravity is learnt (AdaptiveGravity); if it is "
            "known exactly, leave it out (Robot.with_gravity((0, 0, 0)), NoGravity)"
        )
        rows.append(("gravity", "not exact", figures))
    if report.singular_q is not None:
        figures = (
            "the estimated Jacobian loses rank in the region, where the arm may stand still "
            f"away from its target: at q = {report.singular_q.round(3).tolist()}; nothing below "
            "holds there; RegularPart leaves such configurations out"
        )
        rows.append(("rank", "not regular", figures))
    if report.damped_q is not None:
        figures = (
            "learning uses a damped pseudo-inverse near singular configurations, such as q = "
            f"{report.damped_q.round(3).tolist()}, which nothing below covers; RegularPart leaves "
            "them out"
        )
        rows.append(("learning", "damped", figures))
    return rows


def _as_it_runs(report: StabilityReport) -> list[Row]:
    """Rows about the loop that is sampled and late."""
    sampled, unstable = report.sampled, report.growth >= 1.0
    figures = (
        f"at {100.0 * (1.0 - unstable.mean()):.4g} % of {len(unstable)} targets; errors are "
        f"multiplied by at most {report.growth.max():.6g} from frame to frame"
    )
    near = ("as it runs, near targets", "unstable" if unstable.any() else "stable", figures)
    if sampled is None:
        return [near]
    said = "holds" if sampled.certified else "does not hold"
    if sampled.certified and report.reason:
        said = "withdrawn"
    figures = f"margin {sampled.margin:.3g}, {_FAMILIES[sampled.family]}"
    if sampled.certified:
        figures += f"; {_starts(report)}"
    rows = [("as it runs, matrix form", said, figures)]
    if not report.reason:
        is_proven = report.attraction is not None and report.attraction.radius > 0.0
        rows.append(("staying in the region", "proven" if is_proven else "assumed", _stays(report)))
    return [*rows, ("largest period and delay", "", _timing(report)), near]


def _starts(report: StabilityReport) -> str:
    """Which starts the form covers."""
    sampled = report.sampled
    assert sampled is not None
    units = report.loop.controller.task.units
    reach = ", ".join(f"{r:.2g} {unit}" for r, unit in zip(sampled.reach, units, strict=True))
    return (
        f"for starts at rest with errors of at most {reach} in one coordinate alone, "
        f"{100.0 * sampled.covered:.3g} % of those drawn"
    )


def _limits(cost: LimitCost) -> Row:
    return "torque limits", cost.verdict, str(cost)


def _timing(report: StabilityReport) -> str:
    certified, exact = report.largest_period
    near = f"near targets stable up to a period of {1e3 * exact:.3g} ms"
    if not certified:
        return f"{near}; this function certifies none"
    late = f"certified up to torques {1e3 * report.largest_delay:.3g} ms late"
    return f"certified up to a period of {1e3 * certified:.3g} ms, {near}; {late}"


def _stays(report: StabilityReport) -> str:
    found = report.attraction
    if found is None or not found.radius:
        return "rollouts test it (those that went outside)"
    unit = "rad" if set(report.loop.plants[0].robot.joint_units) == {"rad"} else "rad or m"
    return (
        f"from rest within {found.radius:.2g} {unit} of its middle in every joint, to targets of "
        f"configurations as near (errors of up to {found.error:.2g} "
        f"{report.loop.controller.task.units[0]}); from elsewhere it is assumed"
    )


def _in_continuous_time(report: StabilityReport) -> list[Row]:
    first = report.theorem1
    passed = "holds" if report.is_as_assumed else "would hold"
    figures = (
        f"p = {first.p:.3g} {'<' if first.holds else '>='} {max(first.allowed_p, 0.0):.3g} "
        f"allowed at alpha = {first.alpha:.3g}/s; worst p with "
        f"{_case(report, report.samples, first.worst['p'])}"
    )
    said = passed if first.holds else "does not hold"
    rows = [("in continuous time, Theorem 1", said, figures)]
    for family, test in report.matrix.items():
        if test.certified:
            told = f"none of {test.checked} further ones violates it"
            if test.independent:
                told += f", at most {100 * test.violating_at_most:.2g} % of all do (95 %)"
        elif test.margin > 0.0:
            told = f"violated in {test.violations} of {test.checked} further configurations"
        else:
            told = f"holds in {100 * test.share:.3g} % of the configurations"
        said = passed if test.certified else "does not hold"
        figures = (
            f"margin {test.margin:.3g}; {told}; worst with "
            f"{_case(report, report.samples, test.worst)}"
        )
        rows.append((f"in continuous time, {_FAMILIES[family]}", said, figures))
    local = report.local
    learns = report.loop.controller.adaptation is not None
    learnt = " (learnt parameters, often slow, included)" if learns else ""
    figures = (
        f"at {100 * local.share:.4g} % of {len(local.q)} configurations; slowest decay "
        f"{local.decay_rates.min():.3g}/s{learnt}, damping ratio "
        f"{local.damping_ratios.min():.2g}; worst with {_case(report, local, local.worst)}"
    )
    said = "stable" if local.stable else "not stable"
    return [*rows, ("in continuous time, near targets", said, figures)]


def _case(report: StabilityReport, among: Samples | LocalTest, index: int) -> str:
    """One of the cases: the true robot and the configuration."""
    q = ", ".join(f"{value + 0.0:.2f}" for value in among.q[index])
    return f"{report.describe_truth(int(among.truth[index]))} at q = [{q}]"


def _timed(latency: Latency) -> str:
    rate = 1.0 / latency.period
    runs = f"{1e-3 * rate:.3g} kHz" if rate >= 1e3 else f"{rate:.3g} Hz"
    return f"{runs} with its delays" if latency.of_position > latency.period else runs
