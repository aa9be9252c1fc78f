"""`Row`: a finding of a report, and renderers for text and JSON."""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from approxjac.controllers import Latency
from approxjac.formatting import plain, wrapped

_PARTS = {
    "tests": "tests",
    "beware": "beware",
    "moves": "moves (eased along a line, from rest; certified by a search, not proven)",
    "limits": "torque limits",
    "rollouts": "rollouts (simulated, sampled, with delays)",
    "worst": "worst cases found (what to look at first)",
    "other law": "tests that apply",
    "about": "about",
}


class Row(NamedTuple):
    """A finding of a report."""

    # part of the report: "verdict", "tests", "beware", "moves", "limits", "rollouts", "worst",
    # "other law", or "about"
    part: str
    name: str  # name of the test
    verdict: str  # a word or two; "" if there is none
    figures: Mapping[str, Any]  # name → number, array, flag or name that support it
    text: str = ""  # the figures as a sentence


def ms(seconds: float) -> str:
    """Return a time in ms, such as "1 ms"."""
    return f"{1e3 * seconds:.3g} ms"


def about_timing(latency: Latency) -> Row:
    """Return the row about the delays of a loop."""
    times = {
        "period": "a period of {}",
        "torque_delay": "torques {} late",
        "velocity_filter": "joint velocities filtered over {}",
        "image_period": "x every {}",
        "image_age": "x {} old on arrival",
    }
    given = {name: getattr(latency, name) for name in times}
    texts = (times[name].format(ms(time)) for name, time in given.items() if time)
    return Row("about", "timing", "", given, ", ".join(texts))


def as_text(rows: Sequence[Row]) -> str:
    """Return a report as text: the verdict, its meaning and scope, and the figures."""
    lines = [line for row in rows if row.part == "verdict" for line in wrapped(row.text)]
    for part, title in _PARTS.items():
        if block := [row for row in rows if row.part == part]:
            lines += ["", *wrapped(title), *as_lines(block)]
    return "\n".join(lines)


def as_lines(rows: Sequence[Row]) -> list[str]:
    """Return names, verdicts and texts of rows below each other, wrapped."""
    first, second = (max(len(row[k]) for row in rows) for k in (1, 2))
    lines = []
    for row in rows:
        start = f"  {row.name:<{first}}  " + (f"{row.verdict:<{second}}  " if second else "")
        lines += wrapped(row.text, start)
    return lines


def as_json(rows: Iterable[Row]) -> dict[str, Any]:
    """Return rows for JSON: part → name → verdict and figures."""
    parts: dict[str, Any] = {}
    for row in rows:
        verdict = {"verdict": row.verdict} if row.verdict else {}
        figures = {name: plain(value) for name, value in row.figures.items()}
        parts.setdefault(row.part, {})[row.name] = verdict | figures
    return parts
