"""`Pace`: periods by the clock on the wall."""

from __future__ import annotations

import math
import time

_SPIN = 1e-4  # s; sleeps end late by about as much


class Pace:
    """Waits for one period after the other; for drivers of robots that do not wait themselves.

    Periods that were missed are left out, not made up for in a burst.

    Args:
        dt: Period [s].
    """

    def __init__(self, dt: float) -> None:
        self._dt = dt
        self._due: float | None = None

    def wait(self) -> int:
        """Wait until the next period begins; return how many have begun since the last call."""
        now = time.perf_counter()
        if self._due is None:
            self._due = now
        missed = max(0, math.floor((now - self._due) / self._dt))
        self._due += (1 + missed) * self._dt
        while (left := self._due - time.perf_counter()) > 0.0:
            time.sleep(max(0.0, left - _SPIN))
        return 1 + missed
