"""Tables, verdict and summary of `approxjac servo-study`."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from approxjac.studies import servo_map
from approxjac.studies.servo_map import LOOPS, Agreement, Cell, Loop, agreement
from approxjac.studies.servo_study import Outcome

WANTED = 0.95  # share of the starts whose path stays in view that has to converge
_LOOP_NAMES: dict[Loop, str] = {
    "ideal": "continuous, ideal camera",
    "late": "1 kHz, camera of 30 Hz, late and noisy",
}


class Result(NamedTuple):
    """All that the study found.

    Attributes:
        starts: How many paths that stay in view were wanted.
        shown: Runs from these starts, and those that left the view.
        compared: Runs of the comparison.
        cells: Of the map.
    """

    starts: int
    shown: Sequence[Outcome]
    compared: Sequence[Outcome]
    cells: Sequence[Cell]


class Row(NamedTuple):
    """All runs of one law somewhere with one noise.

    Attributes:
        scene: Where.
        law: The law.
        noise: Standard deviation of the image's noise [px].
        runs: How many.
        converged: How many reached their target to within the noise.
        settled: Median settling time of the runs, infinite where half do not settle [s].
        error: Median RMS error at the end [px].
        roughness: Median RMS change of torques from record to record at the end, of the runs that
            stayed in view: an arm that sees nothing stands still [N m].
        peak_torque: Median of the largest torque, as a share of its limit.
        too_much: How many asked for more torque than the motors deliver.
        left: How many left the view.
    """

    scene: str
    law: str
    noise: float
    runs: int
    converged: int
    settled: float
    error: float
    roughness: float
    peak_torque: float
    too_much: int
    left: int


def rows(outcomes: Sequence[Outcome]) -> list[Row]:
    """Put the outcomes together by scene, noise and law, in the order in which they come."""
    groups: dict[tuple[str, float, str], list[Outcome]] = {}
    for outcome in outcomes:
        case = outcome.case
        groups.setdefault((case.scene, case.noise, case.law), []).append(outcome)
    return [_row(scene, law, noise, mine) for (scene, noise, law), mine in groups.items()]


def table(result: Result) -> str:
    """The study's result as Markdown."""
    parts = [_shown(result)]
    if result.compared:
        parts.append(_comparison(result.compared))
    if result.cells:
        parts.append(_map(result.cells))
    return "\n".join(line for part in parts for line in [*part, ""])


def shortcomings(result: Result) -> list[str]:
    """What fell short of what must be shown; nothing if nothing did."""
    kept, found = in_view(result.shown), []
    if len(kept) < result.starts:
        found.append(
            f"only {len(kept)} of {len(result.shown)} paths stayed in view, {result.starts} wanted"
        )
    done = sum(outcome.converged for outcome in kept)
    if done < WANTED * len(kept):
        found.append(
            f"{done} of {len(kept)} starts whose path stays in view converged to within the "
            f"noise, at least {100 * WANTED:g} % wanted"
        )
    return found


def in_view(outcomes: Sequence[Outcome]) -> list[Outcome]:
    """Those whose path stayed in view."""
    return [outcome for outcome in outcomes if outcome.in_view]


def summary(result: Result) -> dict[str, Any]:
    """What goes into summary.json."""
    short, kept = shortcomings(result), in_view(result.shown)
    return {
        "verdict": "fell short" if short else "ok",
        "shortcomings": short,
        "starts_in_view": len(kept),
        "converged": sum(outcome.converged for outcome in kept),
        "wanted": WANTED,
        "starts_out_of_view": len(result.shown) - len(kept),
        "shown": [_run(outcome) for outcome in result.shown],
        "rows": [_plain(row._asdict()) for row in rows(result.compared)],
        "compared": [_run(outcome) for outcome in result.compared],
        "agreement": [
            _plain({**entry._asdict(), "share": entry.share}) for entry in agreements(result.cells)
        ],
        "cells": [_plain({**c._asdict(), "predicted": c.predicted}) for c in result.cells],
    }


def agreements(cells: Sequence[Cell]) -> list[Agreement]:
    """How often test and simulation say the same, loop by loop."""
    return [agreement(cells, loop) for loop in LOOPS if any(cell.loop == loop for cell in cells)]


def _shown(result: Result) -> list[str]:
    kept = in_view(result.shown)
    left = [outcome for outcome in result.shown if not outcome.in_view]
    done = sum(outcome.converged for outcome in kept)
    lines = [
        f"**{done} of {len(kept)}** starts whose path stays in view converged to within the noise; "
        f"{len(left)} more left the view.",
        "",
        "| gravity | in view | converged | settled, median (slowest) | error at the end, median "
        "(largest) | peak torque, median (largest) | asked for too much torque |",
        "|---|---|---|---|---|---|---|",
    ]
    for gravity in ("exact", "learnt"):
        mine = [outcome for outcome in kept if outcome.case.gravity == gravity]
        if not mine:
            continue
        times = [outcome.settling_time for outcome in mine if outcome.converged]
        lines.append(
            _line(
                gravity,
                len(mine),
                sum(outcome.converged for outcome in mine),
                _both(times, "{:.1f}", " s"),
                _both([outcome.final_error for outcome in mine], "{:.2f}", " px"),
                _both([outcome.peak_torque for outcome in mine], "{:.2f}", ""),
                sum(outcome.peak_torque > 1.0 for outcome in mine),
            )
        )
    failed = [outcome for outcome in kept if not outcome.converged]
    lines += ["", "Failures with the path in view:", ""]
    lines += [f"- {_named(outcome)}" for outcome in failed] or ["- none"]
    lines += ["", "Not counted, as they left the view:", ""]
    lines += [
        f"- {_named(outcome)}, out of view from {outcome.left_at:.2f} s" for outcome in left
    ] or ["- none"]
    return lines


def _named(outcome: Outcome) -> str:
    """A run by its seed, and what became of it."""
    case = outcome.case
    errors = ""
    if math.isfinite(outcome.final_error):
        errors = f"{outcome.start_error:.0f} -> {outcome.final_error:.2g} px; "
    return f"seed {case.seed}, gravity {case.gravity}: {errors}{outcome.reason or 'converged'}"


def _comparison(outcomes: Sequence[Outcome]) -> list[str]:
    lines = []
    mine = rows(outcomes)
    for scene in dict.fromkeys(row.scene for row in mine):
        lines += [
            f"Comparison, {scene}:",
            "",
            "| noise | law | converged | settled, median | error at the end, median | roughness of "
            "the torque, median | peak torque, median | asked for too much torque | left the view "
            "|",
            "|---|---|---|---|---|---|---|---|---|",
        ]
        lines += [
            _line(
                f"{row.noise:g} px",
                row.law,
                f"{row.converged} of {row.runs}",
                _number(row.settled, "{:.1f} s"),
                _number(row.error, "{:.2g} px"),
                _number(row.roughness, "{:.2g} N m"),
                _number(row.peak_torque, "{:.2f}"),
                row.too_much,
                row.left,
            )
            for row in mine
            if row.scene == scene
        ]
        lines += ["", f"What did not converge, {scene}:", ""]
        lines += [*_kinds([o for o in outcomes if o.case.scene == scene]), ""]
    return lines[:-1]


def _kinds(outcomes: Sequence[Outcome]) -> list[str]:
    """Every kind of failure of each law, with the noises and seeds."""
    kinds: dict[tuple[str, str], list[Outcome]] = {}
    for outcome in outcomes:
        if not outcome.converged:
            kinds.setdefault((outcome.case.law, outcome.reason), []).append(outcome)
    lines = []
    for (law, reason), mine in kinds.items():
        by_noise: dict[float, list[int]] = {}
        for outcome in mine:
            by_noise.setdefault(outcome.case.noise, []).append(outcome.case.seed)
        where = "; ".join(
            f"{noise:g} px: seeds {', '.join(map(str, seeds))}" for noise, seeds in by_noise.items()
        )
        lines.append(f"- {law}, {len(mine)} × {reason} ({where})")
    return lines or ["- none"]


def _map(cells: Sequence[Cell]) -> list[str]:
    lines = [
        "The local test beside simulation:",
        "",
        "| loop | cells | agree | test says stable, simulation not | test says unstable, "
        "simulation not | simulation undecided | test undecided |",
        "|---|---|---|---|---|---|---|",
    ]
    for entry in agreements(cells):
        share = f"{entry.agreeing} ({100.0 * entry.share:.1f} %)"
        lines.append(
            _line(
                _LOOP_NAMES[entry.loop], entry.cells, share, entry.optimistic,
                entry.pessimistic, entry.undecided, entry.refused,
            )
        )  # fmt: skip
    loops = [entry.loop for entry in agreements(cells)]
    names = [f"{_LOOP_NAMES[loop]}: {what}" for loop in loops for what in ("test", "simulation")]
    lines += [
        "",
        "Tolerated roll in degrees, the smallest and the largest over the goals:",
        "",
        _line("a = k_p / k_v", *names),
        f"|{'---|' * (1 + len(names))}",
    ]
    for ratio in sorted({cell.ratio for cell in cells}):
        cells_of = [[c for c in cells if (c.loop, c.ratio) == (loop, ratio)] for loop in loops]
        lines.append(
            _line(f"{ratio:g} 1/s", *[text for mine in cells_of for text in tolerated(mine)])
        )
    lines += ["", "Where they differ:", ""]
    return lines + differences(cells)


def tolerated(cells: Sequence[Cell]) -> tuple[str, str]:
    """Tolerated roll of the cells with one gain ratio, by the test and by simulation.

    The test's is where its decay rate first passes through zero, between two rolls in proportion;
    that of simulation is the last roll before the first with which a run does not converge.
    """
    tested, simulated = [], []
    for goal in sorted({cell.goal for cell in cells}):
        mine = sorted((c for c in cells if c.goal == goal), key=lambda cell: cell.roll)
        tested.append(boundary([c.roll for c in mine], [c.decay_rate for c in mine]))
        failing = [i for i, cell in enumerate(mine) if cell.verdict != "converges"]
        last = failing[0] - 1 if failing else len(mine) - 1
        simulated.append(mine[last].roll if last >= 0 else math.nan)
    return _range(tested), _range(simulated)


def boundary(rolls: Sequence[float], rates: Sequence[float]) -> float:
    """Where a decay rate first passes through zero: NaN at no roll, infinite at none of them."""
    if rates[0] <= 0.0:
        return math.nan
    for k in range(1, len(rates)):
        if rates[k] <= 0.0:
            share = rates[k - 1] / (rates[k - 1] - rates[k])
            return rolls[k - 1] + share * (rolls[k] - rolls[k - 1])
    return math.inf


def differences(cells: Sequence[Cell]) -> list[str]:
    """Every cell where test and simulation do not say the same, or one of them nothing."""
    found = [cell for cell in cells if "undecided" in (cell.predicted, cell.verdict)]
    found += [cell for cell in cells if cell not in found and cell.predicted != cell.verdict]
    found.sort(key=lambda c: (LOOPS.index(c.loop), c.ratio, c.roll, c.goal))
    return [_difference(cell) for cell in found] or ["- nowhere"]


def _difference(cell: Cell) -> str:
    elsewhere = ""
    if cell.verdict == "converges":
        elsewhere = (
            f", at a posture {cell.moved:.2g} rad from the goal's, where the test says "
            f"{cell.end_rate:.3g} 1/s"
        )
    return (
        f"- {_LOOP_NAMES[cell.loop]}, roll {cell.roll:g}°, a = {cell.ratio:g} 1/s, goal "
        f"{cell.goal}: the test says {cell.predicted} ({cell.decay_rate:.3g} 1/s), simulation "
        f"{cell.verdict} (from {servo_map.START[cell.loop]:g} px to {cell.end:.2g} times that "
        f"after {cell.duration:.1f} s{elsewhere})"
    )


def _row(scene: str, law: str, noise: float, mine: Sequence[Outcome]) -> Row:
    # what does not settle takes longer than what does, however long
    times = [o.settling_time if math.isfinite(o.settling_time) else math.inf for o in mine]
    return Row(
        scene,
        law,
        noise,
        runs=len(mine),
        converged=sum(outcome.converged for outcome in mine),
        settled=float(np.median(times)),
        error=float(np.median([outcome.final_error for outcome in mine])),
        roughness=_median([outcome.roughness for outcome in in_view(mine)]),
        peak_torque=_median([outcome.peak_torque for outcome in mine]),
        too_much=sum(outcome.peak_torque > 1.0 for outcome in mine),
        left=sum(not outcome.in_view for outcome in mine),
    )


def _median(values: Sequence[float]) -> float:
    """Median of the finite numbers; NaN of none."""
    finite = [value for value in values if math.isfinite(value)]
    return float(np.median(finite)) if finite else math.nan


def _both(values: Sequence[float], form: str, unit: str) -> str:
    finite = [value for value in values if math.isfinite(value)]
    if not finite:
        return "–"
    return f"{form.format(np.median(finite))} ({form.format(max(finite))}){unit}"


def _range(values: Sequence[float]) -> str:
    texts = [
        "none" if math.isnan(v) else "all" if math.isinf(v) else f"{v:.0f}"
        for v in sorted(values, key=lambda v: -1.0 if math.isnan(v) else v)
    ]
    return texts[0] if texts[0] == texts[-1] else f"{texts[0]} to {texts[-1]}"


def _line(*cells: object) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def _number(value: float, form: str) -> str:
    return form.format(value) if math.isfinite(value) else "–"


def _run(outcome: Outcome) -> dict[str, Any]:
    fields = outcome._asdict()
    del fields["case"]
    return _plain({**outcome.case._asdict(), **fields})


def _plain(fields: dict[str, Any]) -> dict[str, Any]:
    """What JSON can hold: it knows no NaN."""
    return {
        key: None if isinstance(value, float) and not math.isfinite(value) else value
        for key, value in fields.items()
    }
