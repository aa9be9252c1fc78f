"""Progress bars on a terminal: what is done, how long it has taken, and how long it may take yet.

Where the output is no terminal no bar is shown (`disable=None`); long work is announced once.
"""

from __future__ import annotations

import sys
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from tqdm import tqdm


class ShareBar:
    """A bar of several parts of work one after the other, each from 0 to 1."""

    def __init__(self, long: Mapping[str, str]) -> None:
        """Take what to announce of parts that take long where no bar is shown."""
        self.bar = _bar(1.0, "", "start")
        self._long = dict(long)
        self._what = ""

    def __enter__(self) -> ShareBar:
        return self

    def __exit__(self, *error: object) -> None:
        self.bar.close()

    def tell(self, what: str, share: float) -> None:
        """Show which part is done, and the share of it that is."""
        if what != self._what:  # its time counts from here
            self._what = what
            if self.bar.disable and what in self._long:
                print(f"approxjac: {self._long.pop(what)}", file=sys.stderr, flush=True)
            self.bar.reset()
            self.bar.set_description(what, refresh=False)
        self.bar.update(share - self.bar.n)


def time_bar(total: float, what: str, disable: bool | None = None) -> tqdm[Any]:
    """Return a bar of a simulated time [s]."""
    return _bar(total, "{n:.1f} of {total:g} s, ", what, disable)


def _bar(total: float, amount: str, what: str, disable: bool | None = None) -> tqdm[Any]:
    from tqdm import tqdm

    shown = f"{{desc}}{amount}{{percentage:.0f}} %|{{bar}}| {{elapsed}} so far, {{remaining}} to go"
    return tqdm(total=total, desc=f"{what}: ", disable=disable, bar_format=shown)
