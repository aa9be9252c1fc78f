"""Progress on a terminal: what is done, how long it has taken, and how long it may take yet."""

from __future__ import annotations

import sys
from collections.abc import Callable, Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tqdm import tqdm


def long_work(texts: Mapping[str, str]) -> Callable[[str, float], None] | bool:
    """Return how to show progress: by bars, or where none are shown by the text of each part."""
    if sys.stderr.isatty():
        return True
    left = dict(texts)

    def tell(what: str, share: float) -> None:
        if what in left:
            print(f"approxjac: {left.pop(what)}", file=sys.stderr, flush=True)

    return tell


def time_bar(total: float, what: str, disable: bool | None = None) -> tqdm[Any]:
    """Return a bar of a simulated time [s]; by default none where the output is no terminal."""
    from tqdm import tqdm

    times = "{percentage:.0f} %|{bar}| {elapsed} so far, {remaining} to go"
    shown = "{desc}{n:.1f} of {total:g} s, " + times
    return tqdm(total=total, desc=f"{what}: ", disable=disable, bar_format=shown)
