"""Table, picture, verdict and summary of `approxjac limiters`."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from approxjac.interface import LimitStatus
from approxjac.studies.limiters import TORQUE_TOLERANCE, Outcome
from approxjac.studies.reach_result import AT_LIMIT
from approxjac.view import COLORS, SERIES, new_figure, style

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

_STATUSES = {
    LimitStatus.FREE: "free",
    LimitStatus.LIMITED: "limited",
    LimitStatus.PROOF_KEPT: "kept",
    LimitStatus.PROOF_GIVEN_UP: "given up",
    LimitStatus.INFEASIBLE: "infeasible",
    LimitStatus.SOLVER_FAILED: "failed",
}
_MARKERS = "os^Dv"
_LATE = "within the tolerance"


class Row(NamedTuple):
    """All runs of one arm at one scale with one limiter.

    Attributes:
        robot: The arm.
        scale: Of its effort limits.
        limiter: The limiter.
        runs: How many.
        refused: How many of them never ran.
        converged: How many did the task.
        within: How many of these kept every joint within its position limits.
        settled: Median of their settling times [s].
        instants: At how many instants V̇ was compared with −W.
        risen: Share of these with V̇ > −W.
        largest_excess: Largest V̇ + W [W].
        breaches: At how many V̇ > −W + σ with the σ that was reported.
        largest_breach: Largest V̇ + W − σ [W].
        error: Largest error of V̇ [W].
        usual_error: Median over the runs of the median over the instants [W].
        singular: Instants near a singular Ĵ, where V̇ was not judged.
        peak_torque: Largest torque, as a share of the limit.
        torque_violation: How far a torque was beyond its limit [N m].
        peak_speed: Largest |q̇|, as a share of the limit.
        median_speed: Median over the runs of the largest |q̇|, as a share of the limit.
        position_excess: How far a joint was beyond its position limits [rad].
        statuses: Share of the steps with each status, by name.
    """

    robot: str
    scale: float
    limiter: str
    runs: int
    refused: int
    converged: int
    within: int
    settled: float
    instants: int
    risen: float
    largest_excess: float
    breaches: int
    largest_breach: float
    error: float
    usual_error: float
    singular: int
    peak_torque: float
    torque_violation: float
    peak_speed: float
    median_speed: float
    position_excess: float
    statuses: dict[str, float]


def rows(outcomes: Sequence[Outcome]) -> list[Row]:
    """Put the outcomes together by arm, scale (the largest first) and limiter."""
    groups: dict[tuple[str, float, str], list[Outcome]] = {}
    for outcome in outcomes:
        case = outcome.case
        groups.setdefault((case.robot, case.scale, outcome.limiter), []).append(outcome)
    robots, limiters = (list(dict.fromkeys(key[i] for key in groups)) for i in (0, 2))
    order = sorted(groups, key=lambda k: (robots.index(k[0]), -k[1], limiters.index(k[2])))
    return [_row(*key, groups[key]) for key in order]


def table(outcomes: Sequence[Outcome]) -> str:
    """The study's result as Markdown: convergence, then all numbers arm by arm, then failures."""
    mine = rows(outcomes)
    lines = [*_convergence(mine), "", *_proof(mine), "", "All numbers, arm by arm:", ""]
    for robot in dict.fromkeys(row.robot for row in mine):
        lines += [*_details(robot, [row for row in mine if row.robot == robot]), ""]
    lines += ["Runs that did not do the task, or did it beyond the joints' limits:", ""]
    return "\n".join([*lines, *failures(outcomes)]) + "\n"


def shortcomings(outcomes: Sequence[Outcome]) -> list[str]:
    """What fell short of what the limiter `qp` promises; nothing if it kept all."""
    mine, found = rows(outcomes), []
    violation = _most(row.torque_violation for row in mine if row.limiter.startswith("qp"))
    if violation > TORQUE_TOLERANCE:
        found.append(f"qp went beyond a torque limit by {violation:.2g} N m")
    breaches = sum(row.breaches for row in mine)
    if breaches:
        worst = _most(row.largest_breach for row in mine)
        found.append(
            f"at {breaches} instants V̇ was above −W by more than the slack that was reported, by "
            f"up to {worst:.2g} W"
        )
    weakest = min(row.scale for row in mine)
    kept = {
        name: sum(r.within for r in mine if (r.limiter, r.scale) == (name, weakest))
        for name in ("qp", "clip")
    }
    if kept["qp"] < kept["clip"]:
        found.append(
            f"at {weakest:g} of the limits fewer runs converged within the joints' limits with qp "
            f"({kept['qp']}) than with clip ({kept['clip']})"
        )
    return found


def summary(outcomes: Sequence[Outcome]) -> dict[str, Any]:
    """What goes into summary.json."""
    short = shortcomings(outcomes)
    return {
        "verdict": "fell short" if short else "ok",
        "shortcomings": short,
        "starts": len({outcome.case for outcome in outcomes}),
        "joint_limit_tolerance_rad": AT_LIMIT,
        "rows": [_plain(row._asdict()) for row in rows(outcomes)],
        "runs": [_plain({**outcome.case._asdict(), **_fields(outcome)}) for outcome in outcomes],
    }


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    """Each kind of failure of each limiter: how often, at which scales, and one of them."""
    lines = []
    for limiter in dict.fromkeys(outcome.limiter for outcome in outcomes):
        kinds: dict[str, list[Outcome]] = {}
        for outcome in outcomes:
            if outcome.limiter == limiter and not outcome.within:
                kinds.setdefault(_kind(outcome), []).append(outcome)
        for kind, mine in sorted(kinds.items(), key=lambda item: -len(item[1])):
            scales = Counter(outcome.case.scale for outcome in mine)
            where = ", ".join(f"{n} at {scale:g}" for scale, n in sorted(scales.items())[::-1])
            lines.append(f"- {limiter}, {len(mine)} × {kind} ({where}); {_example(mine[0])}")
    return lines or ["- none"]


def draw(outcomes: Sequence[Outcome]) -> Figure:
    """Convergence, speeds, V̇ > −W against the scale of the limits, an arm a column."""
    mine = [row for row in rows(outcomes) if row.refused < row.runs]
    robots = list(dict.fromkeys(row.robot for row in mine))
    limiters = list(dict.fromkeys(row.limiter for row in mine))
    figure, axes = new_figure(len(robots), 3, size=(4.2 * len(robots), 9.4))
    panels: list[tuple[str, Callable[[Row], float]]] = [
        ("task done within joint limits [%]", lambda r: 100.0 * r.within / r.runs),
        ("largest speed / its limit, median", lambda row: row.median_speed),
        ("instants with V̇ > −W [%]", lambda row: 100.0 * row.risen),
    ]
    for i, (label, value) in enumerate(panels):
        for j, robot in enumerate(robots):
            ax = axes[i * len(robots) + j]
            for k, limiter in enumerate(limiters):
                series = [row for row in mine if (row.robot, row.limiter) == (robot, limiter)]
                _line(ax, series, value, k, limiter)
                if i == 0:
                    _line(ax, series, lambda r: 100.0 * r.converged / r.runs, k, None)
            _finish(ax, label if j == 0 else "", robot if i == 0 else "", mine)
            if i == 1:
                ax.set_yscale("log", base=2)
                ax.yaxis.set_major_formatter("{x:g}")
                ax.axhline(1.0, color=COLORS["neutral"], linewidth=1.0)
            else:
                ax.set_ylim(-4.0, 104.0)
    with style():
        handles, labels = axes[0].get_legend_handles_labels()
        figure.legend(
            handles,
            labels,
            loc="outside lower center",
            ncols=len(labels),
            frameon=False,
            title="dotted: the task was done, wherever the joints went",
        )
    return figure


def _row(robot: str, scale: float, limiter: str, mine: Sequence[Outcome]) -> Row:
    proofs = [outcome.proof for outcome in mine if outcome.proof is not None]
    instants = sum(proof.instants for proof in proofs)
    steps = sum(sum(outcome.statuses.values()) for outcome in mine)
    counts: Counter[str] = Counter()
    for outcome in mine:
        counts.update(outcome.statuses)
    times = [outcome.settling_time for outcome in mine if outcome.converged]
    speeds = [o.peak_speed for o in mine if math.isfinite(o.peak_speed)]
    return Row(
        robot,
        scale,
        limiter,
        runs=len(mine),
        refused=sum(not outcome.statuses for outcome in mine),
        converged=sum(outcome.converged for outcome in mine),
        within=sum(outcome.within for outcome in mine),
        settled=_median(times),
        instants=instants,
        risen=sum(proof.risen for proof in proofs) / instants if instants else math.nan,
        largest_excess=_most(proof.largest_excess for proof in proofs),
        breaches=sum(proof.breaches for proof in proofs),
        largest_breach=_most(proof.largest_breach for proof in proofs),
        error=_most(proof.error for proof in proofs),
        usual_error=_median([proof.usual_error for proof in proofs]),
        singular=sum(proof.singular for proof in proofs),
        peak_torque=_most(outcome.peak_torque for outcome in mine),
        torque_violation=_most(outcome.torque_violation for outcome in mine),
        peak_speed=_most(speeds),
        median_speed=_median(speeds),
        position_excess=_most(outcome.position_excess for outcome in mine),
        statuses={name: count / steps for name, count in counts.items()},
    )


def _convergence(mine: Sequence[Row]) -> list[str]:
    limiters = list(dict.fromkeys(row.limiter for row in mine))
    lines = [
        f"| arm | limits | runs | {' | '.join(limiters)} |",
        f"|---|---|---|{'---|' * len(limiters)}",
    ]
    for robot, scale in dict.fromkeys((row.robot, row.scale) for row in mine):
        here = {row.limiter: row for row in mine if (row.robot, row.scale) == (robot, scale)}
        cells = [_outcome_cell(here.get(name)) for name in limiters]
        runs = max(row.runs for row in here.values())
        lines.append(_line_of(robot, f"× {scale:g}", runs, *cells))
    return lines + _totals(mine, limiters)


def _totals(mine: Sequence[Row], limiters: Sequence[str]) -> list[str]:
    """The same of all arms together, where there are several."""
    if len({row.robot for row in mine}) == 1:
        return []
    lines = []
    for scale in dict.fromkeys(row.scale for row in mine):
        here = [row for row in mine if row.scale == scale]
        groups = [[row for row in here if row.limiter == name] for name in limiters]
        cells = [f"{sum(r.within for r in g)} ({sum(r.converged for r in g)})" for g in groups]
        runs = max(sum(row.runs for row in group) for group in groups)
        lines.append(_line_of("**all**", f"× {scale:g}", runs, *cells))
    return lines


def _outcome_cell(row: Row | None) -> str:
    """How many runs did the task within the joints' limits, and how many wherever they went."""
    if row is None:
        return "–"
    return "refused" if row.refused == row.runs else f"{row.within} ({row.converged})"


def _proof(mine: Sequence[Row]) -> list[str]:
    judged = sum(row.instants for row in mine)
    if not judged:
        return ["V̇ was compared with −W nowhere."]
    return [
        f"V̇ was compared with −W at {judged} instants, by differences with an error of "
        f"{_median([row.usual_error for row in mine]):.1g} W usually and "
        f"{_most(row.error for row in mine):.1g} W at most; {sum(row.singular for row in mine)} "
        "near a singular Ĵ are left out. V̇ was above −W by more than the slack that was reported "
        f"(and the error) at {sum(row.breaches for row in mine)} of them; the largest V̇ + W − σ is "
        f"{_most(row.largest_breach for row in mine):.1g} W.",
    ]


def _details(robot: str, mine: Sequence[Row]) -> list[str]:
    lines = [
        f"| {robot} | limiter | settled | V̇ > −W | by at most | peak torque | beyond torque limits "
        f"| speed, median (largest) | beyond position limits | {' / '.join(_STATUSES.values())} |",
        f"|{'---|' * 10}",
    ]
    for row in mine:
        if row.refused == row.runs:
            lines.append(_line_of(f"× {row.scale:g}", row.limiter, *["–"] * 8))
            continue
        judged = row.instants > 0
        shares = [row.statuses.get(status.name, 0.0) for status in _STATUSES]
        lines.append(
            _line_of(
                f"× {row.scale:g}",
                row.limiter,
                _number(row.settled, "{:.1f} s"),
                f"{100.0 * row.risen:.0f} %" if judged else "–",
                f"{max(0.0, row.largest_excess):.3g} W" if judged else "–",
                f"{row.peak_torque:.2f}",
                f"{row.torque_violation:.0e} N m" if row.torque_violation else "0",
                f"{row.median_speed:.2f} ({row.peak_speed:.1f})",
                f"{row.position_excess:.3f} rad",
                _percentages(shares) if any(shares) else "–",
            )
        )
    return lines


def _percentages(shares: Sequence[float]) -> str:
    """Shares in per cent; what is there but less than a half of one is not shown as nothing."""
    return (
        " / ".join("<1" if 0.0 < share < 0.005 else f"{100.0 * share:.0f}" for share in shares)
        + " %"
    )


def _kind(outcome: Outcome) -> str:
    """What went wrong, without the names and numbers of the run."""
    if outcome.converged:
        return f"done, but with a joint more than {AT_LIMIT:g} rad beyond its position limits"
    if outcome.reason.startswith(_LATE):
        return f"{_LATE} too late to judge"
    return outcome.reason.split(":")[0]


def _example(outcome: Outcome) -> str:
    case = outcome.case
    text = f"such as {case.robot}, seed {case.seed}"
    if not outcome.statuses:
        return text
    errors = f"{1e3 * outcome.start_error:.0f} -> {1e3 * outcome.final_error:.2g} mm"
    if outcome.position_excess > AT_LIMIT:
        errors += f", a joint {outcome.position_excess:.2g} rad beyond its limits"
    detail = "" if outcome.reason in ("", _kind(outcome)) else f", {outcome.reason}"
    return f"{text}: {errors}{detail}"


def _line(
    ax: Axes, series: Sequence[Row], value: Callable[[Row], float], k: int, label: str | None
) -> None:
    """Draw one limiter; without a label, dotted."""
    points = [(row.scale, value(row)) for row in series]
    points = [(x, y) for x, y in points if math.isfinite(y)]
    if not points:
        return
    options: dict[str, Any] = {"linestyle": ":"} if label is None else {"label": label}
    if label is not None:
        options |= {"marker": _MARKERS[k % len(_MARKERS)], "ms": 5}
    with style():
        ax.plot(*zip(*points, strict=True), color=SERIES[k % len(SERIES)], **options)


def _finish(ax: Axes, label: str, title: str, mine: Sequence[Row]) -> None:
    scales = sorted({row.scale for row in mine})
    with style():
        ax.set_xscale("log")
        ax.set_xticks(scales, [f"{scale:g}" for scale in scales])
        ax.minorticks_off()
        ax.set(xlabel="effort limits, share of the full ones", ylabel=label, title=title)


def _line_of(*cells: object) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def _number(value: float, form: str) -> str:
    return form.format(value) if math.isfinite(value) else "–"


def _median(values: Sequence[float]) -> float:
    """Median of the finite numbers; NaN of none."""
    finite = [value for value in values if math.isfinite(value)]
    return float(np.median(finite)) if finite else math.nan


def _most(values: Any) -> float:
    """Largest of the finite numbers; −∞ of none."""
    return max((float(value) for value in values if math.isfinite(value)), default=-math.inf)


def _fields(outcome: Outcome) -> dict[str, Any]:
    fields = outcome._asdict()
    del fields["case"]
    return {**fields, "proof": None if outcome.proof is None else outcome.proof._asdict()}


def _plain(value: Any) -> Any:
    """What JSON can hold: it knows no NaN."""
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value.item() if isinstance(value, np.generic) else value
