"""Progress bars on a terminal: what is done, how long it has taken, and how long it may take yet.

Where the output is no terminal no bar is shown (`disable=None`); long work is announced once.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tqdm import tqdm

_TIMES = "{percentage:.0f} %|{bar}| {elapsed} so far, {remaining} to go"


class ShareBar:
    """A bar of several parts of work one after the other, each from 0 to 1."""

    def __init__(self, long: Mapping[str, str] | None = None) -> None:
        """Take what to announce of parts that take long where no bar is shown."""
        self._bar = _bar(1.0, "{desc}" + _TIMES, "start")
        self._what = ""
        self._long = dict(long or {})

    def __enter__(self) -> ShareBar:
        return self

    def __exit__(self, *error: object) -> None:
        self._bar.close()

    def tell(self, what: str, share: float) -> None:
        """Show which part is done, and the share of it that is."""
        if what != self._what:  # its time counts from here
            self._what = what
            if self._bar.disable and what in self._long:
                print(f"approxjac: {self._long.pop(what)}", file=sys.stderr, flush=True)
            self._bar.reset()
            self._bar.set_description(what, refresh=False)
        self._bar.update(share - self._bar.n)

    def write(self, text: str) -> None:
        """Print a text above the bar."""
        self._bar.write(text)


def time_bar(total: float, what: str, disable: bool | None = None) -> tqdm[Any]:
    """Return a bar of a simulated time [s]."""
    return _bar(total, "{desc}{n:.1f} of {total:g} s, " + _TIMES, what, disable)


def _bar(total: float, shown: str, what: str, disable: bool | None = None) -> tqdm[Any]:
    from tqdm import tqdm

    return tqdm(total=total, desc=f"{what}: ", disable=disable, bar_format=shown)
