"""`undisturbed`: the interpreter and the system asked to leave a loop alone."""

from __future__ import annotations

import gc
import os
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager

from approxjac.errors import InvalidInputError

_SWITCH = 2e-4  # s, between the interpreter's threads; 5 ms by default, many periods
_lock = threading.Lock()
_loops = 0  # that run now: the interpreter is common to the threads of several arms
_usual = (0.0, True, 0)


@contextmanager
def undisturbed(cpu: int | None, priority: int | None) -> Iterator[None]:
    """Run a block without garbage collection, with threads that hand over soon.

    Args:
        cpu: The processor that it is to run on; None leaves that to the system.
        priority: Of SCHED_FIFO, from 1 to 99; None leaves the system's scheduling.

    Raises:
        InvalidInputError: A processor that is not there, or a priority that the system refuses.
    """
    before = _set(cpu, priority)
    _hush()
    try:
        yield
    finally:
        _unhush()
        if before is not None:
            affinity, policy, parameters = before
            os.sched_setscheduler(0, policy, parameters)
            os.sched_setaffinity(0, affinity)


def _hush() -> None:
    """Quieten the interpreter, unless another loop's thread has done it."""
    global _loops, _usual
    with _lock:
        if _loops == 0:
            _usual = sys.getswitchinterval(), gc.isenabled(), gc.get_freeze_count()
            gc.collect()
            gc.freeze()  # what is there now is looked through no more
            gc.disable()
            sys.setswitchinterval(_SWITCH)
        _loops += 1


def _unhush() -> None:
    """Put back what was before, once no loop is left."""
    global _loops
    with _lock:
        _loops -= 1
        if _loops:
            return
        switch, collects, frozen = _usual
        sys.setswitchinterval(switch)
        if not frozen:  # by somebody else, too
            gc.unfreeze()
        if collects:
            gc.enable()


def _set(cpu: int | None, priority: int | None) -> tuple[set[int], int, os.sched_param] | None:
    """Ask the system, and return what was before."""
    if cpu is None and priority is None:
        return None
    if not hasattr(os, "sched_setscheduler"):
        raise InvalidInputError("cpu and priority can be set on Linux only", given=cpu)
    before = os.sched_getaffinity(0), os.sched_getscheduler(0), os.sched_getparam(0)
    if cpu is not None:
        if cpu not in before[0]:
            raise InvalidInputError(
                f"cpu must be one of {sorted(before[0])}, got {cpu!r}", given=cpu
            )
        os.sched_setaffinity(0, {cpu})
    if priority is not None:
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(priority))
        except (OSError, TypeError) as error:
            os.sched_setaffinity(0, before[0])
            raise InvalidInputError(
                "priority must be one of SCHED_FIFO that this user may take (1 to 99, with "
                f"`ulimit -r` or CAP_SYS_NICE), got {priority!r}: {error}",
                given=priority,
            ) from error
    return before
