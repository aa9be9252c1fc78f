"""Numbers and records in one line of text, and as JSON."""

import dataclasses
import math
import re
import shutil
import sys
import textwrap
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np


def short(value: Any) -> str:
    """Format numbers to four digits: as one number if all entries are equal, else as a list."""
    entries = [f"{entry:.4g}" for entry in np.ravel(value)]
    return entries[0] if len(set(entries)) == 1 else listed(value)


def shown(value: Any) -> str:
    """Return the repr of a value for an error message, or its type where that fails."""
    try:
        return repr(value)
    except Exception:
        return f"<{type(value).__name__}>"


def listed(values: Any) -> str:
    """Format numbers to four digits as a list; anything else by its repr."""
    try:
        return f"[{', '.join(f'{entry:.4g}' for entry in np.ravel(values))}]"
    except (TypeError, ValueError, OverflowError):
        return shown(values)


def one_line(value: Any) -> str:
    """Return the repr of a value on one line; that of an array has several."""
    return " ".join(shown(value).split())


def numbers(values: Any) -> str:
    """Format numbers to four digits, separated by spaces; as one if all are equal."""
    entries = numbers_of(values).split()
    return entries[0] if len(set(entries)) == 1 else " ".join(entries)


def numbers_of(values: Any) -> str:
    """Format all numbers to four digits, separated by spaces."""
    return " ".join(f"{entry + 0.0:.4g}" for entry in np.ravel(values))


def share(n: int, total: int) -> str:
    """Format n of `total` in percent, to three digits; only all of them are 100 %."""
    return f"{min(100.0 * n / total, 99.9 if n < total else 100.0):.3g} %"


def shares(counts: Mapping[Any, int]) -> str:
    """Return the share of instants with each outcome as text, such as "ok 98 %, …"."""
    total = sum(counts.values())
    return ", ".join(f"{each.label} {share(n, total)}" for each, n in counts.items())


def short_fields(record: Any) -> str:
    """Return a dataclass as text, without fields that have their default."""
    shown = []
    for field in filter(lambda field: field.repr, dataclasses.fields(record)):
        value = getattr(record, field.name)
        if isinstance(value, np.ndarray | float):
            if field.default is dataclasses.MISSING or np.any(value != field.default):
                shown.append(f"{field.name}={short(value)}")
        elif isinstance(value, tuple) and any(isinstance(part, np.ndarray) for part in value):
            shown.append(f"{field.name}=({', '.join(short(part) for part in value)})")
        elif value is not field.default and value != field.default:
            shown.append(f"{field.name}={value!r}")
    return f"{type(record).__name__}({', '.join(shown)})"


def spaced(name: str) -> str:
    """Return the name of a class as words: "PositionTask" as "position task"."""
    return re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name.strip("_")).lower()


def joined(units: Iterable[str]) -> str:
    """Return units as one text, different ones joined by "or"."""
    return " or ".join(dict.fromkeys(units))


def display_unit(unit: str) -> tuple[str, float]:
    """Return the unit that an error is shown in, and the factor from `unit` to it."""
    return {"m": ("mm", 1e3), "rad": ("deg", 180.0 / np.pi)}.get(unit, (unit, 1.0))


def percent(share: float) -> str:
    """Format a share in percent; only a share of 1 gives 100, and only one of 0 gives 0."""
    return f"{min(max(100.0 * share, 0.1), 99.9) if 0.0 < share < 1.0 else 100.0 * share:.1f}"


def plain(value: Any) -> Any:
    """Return a value for JSON: arrays as lists, None for a number that is not finite."""
    if isinstance(value, dict):
        return {name: plain(entry) for name, entry in value.items()}
    if isinstance(value, np.ndarray | np.generic):
        value = value.tolist()
    if isinstance(value, list | tuple):
        return [plain(entry) for entry in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


_WIDTH = 100  # of text that no terminal shows
_INDENT = 6
_UNITS = re.compile(r"(\d) (%|[a-z]+)\b")


def width() -> int:
    """Return the width of text in characters: the terminal's, at least 40; else 100."""
    if not sys.stdout.isatty():
        return _WIDTH
    return max(40, shutil.get_terminal_size((_WIDTH, 24)).columns)


def wrapped(text: str, start: str = "", indent: int | None = None) -> list[str]:
    """Wrap text to the `width`: the first line after `start`, the others indented as far.

    Numbers stay with their units. After a start longer than half the width, the text begins on
    a line of its own.
    """
    if len(start) > width() // 2:
        return [start.rstrip(), *(wrapped(text, " " * _INDENT) if text else ())]
    lines = textwrap.wrap(
        _UNITS.sub("\\1\u00a0\\2", text),
        width(),
        initial_indent=start,
        subsequent_indent=" " * (len(start) if indent is None else indent),
        break_on_hyphens=False,
        break_long_words=False,
    )
    return [line.replace("\u00a0", " ") for line in lines] or [start.rstrip()]


def rows(texts: dict[str, str], indent: int = 0) -> list[str]:
    """Return names with their texts beside them, wrapped."""
    first = max(map(len, texts), default=0)
    return [
        line
        for name, text in texts.items()
        for line in wrapped(text, f"{' ' * indent}{name:<{first}}  ")
    ]


def aligned(lines: Sequence[Sequence[str]]) -> str:
    """Return rows of words as aligned columns, the first row underlined."""
    widths = [max(map(len, column)) for column in zip(*lines, strict=True)]
    lines = [lines[0], ["-" * width for width in widths], *lines[1:]]
    return "\n".join(
        "  ".join(word.ljust(width) for word, width in zip(line, widths, strict=True)).rstrip()
        for line in lines
    )
