"""Functions that may stall, in a thread that is waited for."""

from __future__ import annotations

import queue
import threading
import weakref
from collections.abc import Callable
from typing import Any

import numpy as np

from approxjac.controllers.quadratic.checking import Checking, absurd, coerced
from approxjac.controllers.quadratic.daqp import Daqp
from approxjac.controllers.quadratic.problem import QuadraticProgram, Verdict
from approxjac.validation import Array

Function = Callable[[QuadraticProgram], Array | None]
_HUGE = 1e100  # below it nothing overflows in a check


class _Job:
    """A problem on its way to a thread, and the answer on its way back."""

    def __init__(self, problem: QuadraticProgram) -> None:
        self.problem = problem
        self.answer: Array | Verdict | None = None
        self.error: BaseException | None = None
        self.done = threading.Lock()
        self.done.acquire()

    def run(self, function: Function) -> None:
        try:
            answer = function(self.problem)
            # here, since looking at what a stranger returns may take long too
            self.answer = None if answer is None else _as_answer(answer, len(self.problem.f))
        except BaseException as error:  # none must end the thread
            self.answer = Verdict.FAILED
            self.error = error
        self.done.release()


def _as_answer(answer: Any, n: int) -> Array | Verdict:
    array = np.asarray(answer)
    if array.dtype.kind not in "iuf" or array.shape != (n,) or not (np.abs(array) < _HUGE).all():
        return Verdict.FAILED
    return array.astype(np.float64)


def _serve(function: Function, jobs: queue.SimpleQueue[_Job | None]) -> None:
    while (job := jobs.get()) is not None:
        job.run(function)
        del job  # not kept until the next one


class InThread(Checking):
    """A function that may stall, in one thread that is waited for no longer than the budget."""

    def __init__(self, name: str, function: Function, budget: float) -> None:
        super().__init__(budget)
        self.name = name
        self._function = function
        self._told = False  # that it raised
        self._judge = Daqp(budget)
        self._start()

    def __reduce__(self) -> tuple[Any, ...]:
        return type(self), (self.name, self._function, self._budget)

    def _start(self) -> None:
        self._stuck: _Job | None = None
        self._jobs: queue.SimpleQueue[_Job | None] = queue.SimpleQueue()
        self._thread = threading.Thread(
            target=_serve, args=(self._function, self._jobs), name=self.name, daemon=True
        )
        self._thread.start()
        weakref.finalize(self, self._jobs.put, None)  # the thread ends with its owner

    def _find(self, problem: QuadraticProgram, low: Array, high: Array) -> Array | Verdict:
        if absurd(low, high):
            return Verdict.FAILED
        if not self._thread.is_alive():  # as in a forked process
            self._start()
        if self._stuck is not None and not self._stuck.done.acquire(blocking=False):
            return Verdict.FAILED
        # copies, since the thread may look at them long after this call
        self._stuck = job = _Job(coerced(problem))
        self._jobs.put(job)
        if not job.done.acquire(timeout=self._budget):
            return Verdict.FAILED
        self._stuck = None
        if job.error is not None and not self._told:
            self._told = True
            import logging

            logging.getLogger(__name__).warning(
                "QP solver %s raised, which is told once", self.name, exc_info=job.error
            )
        return self._judge.verdict(problem, low, high) if job.answer is None else job.answer
