"""`StopSignals`: signals that ask a run to end, kept until the loop looks."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any

_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")


class StopSignals:
    """While it is entered, signals that would end the program are noted instead.

    Only the main thread of a program can take signals; elsewhere this does nothing.

    Attributes:
        name: The first signal that came, such as "SIGTERM"; "" before.
        count: How many came.
        looked_at: Whether somebody looks; else a second one interrupts, once.
    """

    def __init__(self) -> None:
        self.name, self.count, self.looked_at = "", 0, False
        self._before: dict[signal.Signals, Any] = {}

    def __enter__(self) -> StopSignals:
        if threading.current_thread() is threading.main_thread():
            for name in _NAMES:
                number = getattr(signal, name, None)  # not every system has all of them
                if number is not None:
                    self._before[number] = signal.signal(number, self._note)
        return self

    def __exit__(self, *_: object) -> None:
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)

    def _note(self, number: int, _: FrameType | None) -> None:
        self.name = self.name or signal.Signals(number).name
        self.count += 1
        if self.count == 2 and not self.looked_at:
            raise KeyboardInterrupt
