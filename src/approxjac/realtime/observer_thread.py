"""`ObserverThread`: an observer of a robot's loop, in a thread that the loop does not wait for."""

from __future__ import annotations

import copy
import queue
import threading
import time
from concurrent.futures import Future
from contextlib import AbstractContextManager, nullcontext
from typing import Any

from approxjac.realtime.robot_loop import RobotLoop
from approxjac.simulation.loop import Loop
from approxjac.simulation.simulate import Observer

_PERIOD = 1.0 / 30.0  # s
_PATIENCE = 30.0  # s, for which the observer may prepare before the arm moves
_ANSWER = 1.0  # s, within which the loop carries out what is asked for


class ObserverThread:
    """A thread that shows copies of a loop to an observer, and asks the loop for what that wants.

    Args:
        loop: The loop.
        observer: Called with a `Loop` some 30 times a second; None for nobody.
    """

    def __init__(self, loop: RobotLoop, observer: Observer | None) -> None:
        self._loop, self._observer = loop, observer
        self._wishes: queue.SimpleQueue[tuple[Future[None], Any, tuple[Any, ...]]]
        self._wishes = queue.SimpleQueue()
        self._ready, self._over = threading.Event(), threading.Event()
        self._thread: threading.Thread | None = None
        self.error: BaseException | None = None

    def __enter__(self) -> ObserverThread:
        if self._observer is not None:
            self._seen = Seen(self._loop, self)
            self._thread = threading.Thread(
                target=self._show, name="approxjac observer", daemon=True
            )
            self._thread.start()
            end = time.perf_counter() + _PATIENCE
            while not self._ready.wait(_PERIOD) and time.perf_counter() < end:
                self.serve()  # its first call may ask for something, too
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        if self._thread is not None:
            self._thread.join(_ANSWER)

    def serve(self) -> None:
        """Carry out what the observer asked for, in the thread of the loop."""
        if self._thread is None:
            return
        while not self._wishes.empty():
            answer, wish, arguments = self._wishes.get()
            try:
                wish(*arguments)
                answer.set_result(None)
            except Exception as error:  # the observer's to deal with
                answer.set_exception(error)

    def ask(self, wish: Any, *arguments: Any) -> None:
        """Have the loop do something, and wait for it."""
        answer: Future[None] = Future()
        self._wishes.put((answer, wish, arguments))
        answer.result(_ANSWER)

    def _show(self) -> None:
        observer = self._observer
        assert observer is not None
        scope = observer if isinstance(observer, AbstractContextManager) else nullcontext()
        try:
            with scope:
                while True:
                    over = self._over.is_set()
                    self._seen.look(over)
                    observer(self._seen)
                    self._ready.set()
                    if over:
                        return
                    self._over.wait(_PERIOD)
        except Exception as error:  # of whoever looks on: no reason to stop an arm
            self.error = error
        finally:
            self._ready.set()


class Seen(Loop):
    """Copy of a robot's loop that an observer sees, whose wishes go to the loop itself."""

    _knows_truth = False

    def __init__(self, loop: RobotLoop, thread: ObserverThread) -> None:
        # controllers and plants have scratch memory: one instance a thread
        super().__init__(
            copy.deepcopy(loop.plant), copy.deepcopy(loop.controller), loop.path, loop.dt,
            loop.steps,
        )  # fmt: skip
        self._loop, self._thread = loop, thread

    def look(self, over: bool) -> None:
        """See how the loop is now."""
        loop = self._loop
        self.path, self.step, self.target = loop.path, loop.step, loop.target
        self.truth, self.measurement, self.answer = loop.truth, loop.measurement, loop.answer
        self.state, self.tau, self.stopped = loop.state, loop.tau, over

    def aim_at(self, target: Any) -> None:
        """Have the loop move its target."""
        self._thread.ask(self._loop.aim_at, target)

    def exchange(self, controller: Any) -> None:
        """Have the loop go on with another controller."""
        self._thread.ask(self._loop.exchange, copy.deepcopy(controller))
        self.controller = controller

    def stop(self) -> None:
        """Have the loop come to rest."""
        self._thread.ask(self._loop.stop)
