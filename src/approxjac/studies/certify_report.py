"""Tables and summary of `approxjac certify`."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from itertools import pairwise
from typing import Any

from approxjac.studies.certify import TESTS, Outcome
from approxjac.studies.certify_shares import Shares
from approxjac.studies.certify_two_link import RADII

_FAMILIES = TESTS[1:]
_ERROR_BINS = (0.0, 0.25, 0.5, 1.0, 2.0, 4.0, math.inf)
_NAMES = {
    "theorem1": "Theorem 1",
    "paper": "paper's weights",
    "free": "free potential",
    "wide": "widened",
    "local": "local, exact",
}


def table(outcomes: Sequence[Outcome]) -> str:
    """The study's result as Markdown: soundness, then conservatism."""
    return "\n".join([*_soundness(outcomes), "", *_conservatism(outcomes), ""])


def counterexamples(outcomes: Sequence[Outcome]) -> list[str]:
    """Every contradiction between a test and what happened, with its case."""
    return [
        f"{outcome.case.kind}, seed {outcome.case.seed}, case {outcome.case.number}: {text}"
        for outcome in outcomes
        for text in outcome.counterexamples
    ]


def _soundness(outcomes: Sequence[Outcome]) -> list[str]:
    lines = [
        "| test | certified | stayed in the region | of them converged | left the region | of them "
        "converged | largest rise of V | least margin on the way |",
        "|---|---|---|---|---|---|---|---|",
    ]
    for name in TESTS:
        mine = [o for o in outcomes if o.certified[name]]
        stayed = [o for o in mine if o.stayed]
        left = [o for o in mine if not o.stayed]
        rise = max((o.rises[name] for o in mine), default=0.0)
        unseen = min((o.unseen[name] for o in mine), default=math.nan)
        cells = [_NAMES[name], len(mine), len(stayed), _converged(stayed), len(left)]
        cells += [_converged(left), f"{rise:.1g}", f"{unseen:.2g}"]
        lines.append(_row(cells))
    judged = [o for o in outcomes if not math.isnan(o.near_rate)]
    stable = [o for o in judged if o.stable]
    lines += [
        "",
        f"Local test: of {len(outcomes)} targets {len(judged)} were judged, the others are nearer "
        f"than 0.001/s to the border. {sum(o.near_rate > 0.0 for o in stable)} of {len(stable)} "
        "that it calls stable drew a small error in, and "
        f"{sum(o.near_rate < 0.0 for o in judged if not o.stable)} of "
        f"{len(judged) - len(stable)} that it calls unstable drove it away.",
        "",
        f"Counterexamples: {len(counterexamples(outcomes))}.",
    ]
    return lines + [f"- {text}" for text in counterexamples(outcomes)]


def _conservatism(outcomes: Sequence[Outcome]) -> list[str]:
    """Shares of the cases that converge, by kind of case and by size of the error."""
    converging = [o for o in outcomes if o.converged]
    headings = ["Theorem 1", "paper's weights", "free potential", "widened", "any of test 2"]
    headings += ["test 2, damping chosen", "locally stable"]
    lines = [
        "Of the cases that converge, certified by",
        "",
        f"| | cases | converge | {' | '.join(headings)} |",
        f"|---|---|---|{'---|' * len(headings)}",
    ]
    kinds = list(dict.fromkeys(o.case.kind for o in outcomes))
    for kind in kinds:
        mine = [o for o in outcomes if o.case.kind == kind]
        lines.append(_row([kind, len(mine), *_shares(mine)]))
    lines.append(_row(["**all**", len(outcomes), *_shares(outcomes)]))
    lines += [
        "",
        "By the size of the error, p over the least σ_min(Ĵ) of the region",
        "",
        f"| | cases | converge | {' | '.join(headings)} |",
        f"|---|---|---|{'---|' * len(headings)}",
    ]
    for low, high in pairwise(_ERROR_BINS):
        mine = [o for o in outcomes if low <= o.jacobian_error < high and not o.singular]
        name = f"{low:g} to {high:g}" if math.isfinite(high) else f"above {low:g}"
        if mine:
            lines.append(_row([name, len(mine), *_shares(mine)]))
    singular = [o for o in outcomes if o.singular]
    if singular:
        lines.append(_row(["Ĵ loses rank in the region", len(singular), *_shares(singular)]))
    missed = [o for o in converging if o.damping is None]
    singular = [o for o in missed if o.singular]
    wrong_way = [o for o in missed if o.wrong_way and not o.singular]
    left = len(missed) - len(singular) - len(wrong_way)
    lines += [
        "",
        f"Not certified with any damping although they converge: {len(missed)}. In {len(singular)} "
        f"Ĵ loses rank in the region; in {len(wrong_way)} the region holds postures that would "
        f"be unstable targets in the limit of large gains; {left} are left.",
        "",
    ]
    return lines + [f"- {_missed(outcome)}" for outcome in missed]


def _missed(o: Outcome) -> str:
    why = "Ĵ loses rank in the region" if o.singular else f"p/σ_min = {o.jacobian_error:.2g}"
    if o.wrong_way:
        why += f"; {100 * o.wrong_way:.2g} % of the postures are unstable targets"
    local = "" if o.stable else f"; unstable at the target's posture ({-o.rate:+.2g}/s)"
    left = "" if o.stayed else "; leaves the region"
    return f"{o.case.kind}, case {o.case.number}: {why}, half width {o.radius:.2f} rad{local}{left}"


def _shares(outcomes: Sequence[Outcome]) -> list[object]:
    converging = [o for o in outcomes if o.converged]
    tests: list[Callable[[Outcome], bool]] = [
        *(lambda o, name=name: o.certified[name] for name in TESTS),
        lambda o: any(o.certified[name] for name in _FAMILIES),
        lambda o: o.damping is not None,
        lambda o: o.stable,
    ]
    return [
        len(converging),
        *(_percent(sum(map(test, converging)), len(converging)) for test in tests),
    ]


def _converged(outcomes: Sequence[Outcome]) -> int:
    return sum(o.converged for o in outcomes)


def _percent(part: int, whole: int) -> str:
    return f"{100 * part / whole:.0f} %" if whole else "–"


def _row(cells: Sequence[object]) -> str:
    return f"| {' | '.join(map(str, cells))} |"


def two_link_table(found: dict[str, Any]) -> str:
    """Verdicts on the paper's figures, and the camera roll that each test allows."""
    regions = [f"at the target ± {radius:g} rad" if radius else "at the target" for radius in RADII]
    lines = [
        f"| figure | max Re λ | p | Theorem 1 allows | {' | '.join(regions)} |",
        f"|---|---|---|---|{'---|' * len(RADII)}",
    ]
    for row in found["figures"]:
        cells = [row["figure"], f"{-row['rate']:+.4f}/s", f"{row['p']:.4f}"]
        cells.append(f"{row['allowed_p']:.4f}")
        cells += [
            ", ".join(_NAMES[name] for name in row["certified"][radius]) or "nothing certifies"
            for radius in RADII
        ]
        lines.append(_row(cells))
    lines += ["", "| test | Figure 4's gains | large gains |", "|---|---|---|"]
    for test, roll in found["largest_roll"].items():
        lines.append(
            _row([_NAMES[test], f"{roll['figure_4']:.1f}°", f"{roll['large_gains']:.1f}°"])
        )
    return "\n".join(lines) + "\n"


def summary(
    outcomes: Sequence[Outcome], two_link: dict[str, Any], panda: Sequence[Shares]
) -> dict[str, Any]:
    """What goes into summary.json."""
    converging = [o for o in outcomes if o.converged]
    found = counterexamples(outcomes)
    shares = {name: _share([o.certified[name] for o in converging]) for name in TESTS}
    return {
        "cases": len(outcomes),
        "converged": len(converging),
        "certified_share_of_converging": {
            **shares,
            "test_2": _share([any(o.certified[f] for f in _FAMILIES) for o in converging]),
            "test_2_damping_chosen": _share([o.damping is not None for o in converging]),
            "local": _share([o.stable for o in converging]),
        },
        "counterexamples": found,
        "verdict": "counterexample found" if found else "ok",
        "two_link": two_link,
        "panda": [row._asdict() for row in panda],
        "runs": [_run(outcome) for outcome in outcomes],
    }


def _share(values: Sequence[bool]) -> float | None:
    return sum(values) / len(values) if values else None


def _run(outcome: Outcome) -> dict[str, Any]:
    """One outcome; JSON knows no infinity."""
    fields = {**outcome.case._asdict(), **outcome._asdict()}
    del fields["case"]
    return {name: _plain(value) for name, value in fields.items()}


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(entry) for key, entry in value.items()}
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value
