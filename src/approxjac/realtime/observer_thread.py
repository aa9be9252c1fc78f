"""`ObserverThread`: an observer of a robot's loop, in a thread that the loop does not wait for."""

from __future__ import annotations

import contextlib
import copy
import queue
import threading
import time
from concurrent.futures import Future
from typing import Any

from approxjac.realtime.robot_loop import RobotLoop
from approxjac.simulation.loop import Loop
from approxjac.simulation.simulate import Observer

_PERIOD = 1.0 / 30.0  # s
_PATIENCE = 30.0  # s, for which the observer may prepare before the arm moves
_ANSWER = 1.0  # s, within which the loop carries out what is asked for


class ObserverThread(Loop):
    """Copy of a robot's loop for an observer, and the thread in which that is called.

    What the observer asks of it is done by the loop itself.

    Args:
        loop: The loop.
        observer: Called with this some 30 times a second.
    """

    _knows_truth = False

    def __init__(self, loop: RobotLoop, observer: Observer) -> None:
        # controllers and plants have scratch memory: one instance a thread
        plant, controller = copy.deepcopy((loop.plant, loop.controller))
        super().__init__(plant, controller, loop.path, loop.dt, loop.steps)
        self._loop, self._observer = loop, observer
        self._commands: queue.SimpleQueue[tuple[Future[None], Any, Any]] = queue.SimpleQueue()
        self._ready, self._over = threading.Event(), threading.Event()
        self._thread = threading.Thread(target=self._show, name="approxjac observer", daemon=True)

    def __enter__(self) -> ObserverThread:
        self._thread.start()
        end = time.perf_counter() + _PATIENCE
        while not self._ready.wait(_PERIOD) and time.perf_counter() < end:
            self.serve()  # its first call may ask for something, too
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(_ANSWER)

    def serve(self) -> None:
        """Carry out what the observer asked for, in the thread of the loop."""
        while not self._commands.empty():
            answer, command, argument = self._commands.get()
            try:
                command(*argument)
                answer.set_result(None)
            except Exception as error:  # the observer's to deal with
                answer.set_exception(error)

    def aim_at(self, target: Any) -> None:
        """Have the loop move its target."""
        self._ask(self._loop.aim_at, target)

    def exchange(self, controller: Any) -> None:
        """Have the loop go on with another controller."""
        self._ask(self._loop.exchange, copy.deepcopy(controller))
        self.controller = controller

    def stop(self) -> None:
        """Have the loop come to rest."""
        self._ask(self._loop.stop)

    def _ask(self, command: Any, *argument: Any) -> None:
        answer: Future[None] = Future()
        self._commands.put((answer, command, argument))
        answer.result(_ANSWER)

    def _show(self) -> None:
        observer: Any = self._observer
        scope = observer if hasattr(observer, "__exit__") else contextlib.nullcontext()
        # an error of whoever looks on is no reason to stop an arm
        with contextlib.suppress(Exception), scope:
            while True:
                self.stopped = self._over.is_set()
                self._look()
                observer(self)
                self._ready.set()
                if self.stopped:
                    break
                self._over.wait(_PERIOD)
        self._ready.set()

    def _look(self) -> None:
        """See how the loop is now."""
        loop = self._loop
        self.path, self.step, self.target = loop.path, loop.step, loop.target
        self.truth, self.measurement, self.answer = loop.truth, loop.measurement, loop.answer
        self.state, self.tau = loop.state, loop.tau
