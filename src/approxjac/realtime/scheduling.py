"""`real_time`: run a loop without interruptions by the interpreter and the system."""

from __future__ import annotations

import gc
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from types import FrameType
from typing import Any

from approxjac.errors import InvalidInputError

_SWITCH = 2e-4  # s, between the interpreter's threads; 5 ms by default, many periods
_lock = threading.Lock()
_loops = 0  # that run now: the interpreter is common to the threads of several arms
_usual = (0.0, True)


@dataclass(frozen=True)
class Scheduling:
    """Processor and priority of a loop's thread.

    Attributes:
        cpu: The processor to run on; None leaves that to the system.
        priority: Priority of SCHED_FIFO, 1 to 99, for which Linux needs a permission; None keeps
            the system's scheduling.
    """

    cpu: int | None = None
    priority: int | None = None


@contextmanager
def real_time(scheduling: Scheduling) -> Iterator[None]:
    """Run a block without garbage collection and with short switching times of threads.

    Raises:
        InvalidInputError: No such processor, or a priority that the system refuses.
    """
    global _loops, _usual
    before = _set(scheduling)
    with _lock:
        if _loops == 0:
            _usual = sys.getswitchinterval(), gc.isenabled()
            gc.collect()
            gc.disable()
            sys.setswitchinterval(_SWITCH)
        _loops += 1
    try:
        yield
    finally:
        with _lock:
            _loops -= 1
            if _loops == 0:
                switch, collects = _usual
                sys.setswitchinterval(switch)
                if collects:
                    gc.enable()
        if before is not None:
            affinity, policy, parameters = before
            os.sched_setscheduler(0, policy, parameters)
            os.sched_setaffinity(0, affinity)


def _set(scheduling: Scheduling) -> tuple[set[int], int, os.sched_param] | None:
    cpu, priority = scheduling.cpu, scheduling.priority
    if cpu is None and priority is None:
        return None
    before = None
    try:
        before = os.sched_getaffinity(0), os.sched_getscheduler(0), os.sched_getparam(0)
        if cpu is not None:
            os.sched_setaffinity(0, {cpu})
        if priority is not None:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
    except (AttributeError, OSError, OverflowError, TypeError, ValueError) as error:
        if before is not None:
            os.sched_setaffinity(0, before[0])
        raise InvalidInputError(
            "scheduling must be what Linux lets this user take, a processor that is there and a "
            f"priority from 1 to 99 (`ulimit -r`, CAP_SYS_NICE), got {scheduling!r}: {error}",
            given=scheduling,
        ) from error
    return before


_SPIN = 1e-4  # s; sleeps end late by about as much


class Pace:
    """A timer of periods, for drivers whose robot does not wait itself.

    Missed periods are skipped, not caught up in a burst.

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


_NAMES = ("SIGINT", "SIGTERM", "SIGHUP", "SIGQUIT")


class StopSignals:
    """A context in which signals that would end the program are stored instead.

    It works in the main thread only and does nothing in others. `name` is the first signal's;
    `looked_at` is True once the loop has read it, else a second signal interrupts.
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
