"""`Brake`: a driver's brake, closed once by the first caller; and a watchdog that may be it."""

from __future__ import annotations

import signal
import threading
import time

from approxjac.realtime.driver import Driver
from approxjac.validation import Array

_LOOKS = 4  # of the watchdog within the time that it allows


class HungError(BaseException):
    """The end of a loop that hung; a BaseException, so that drivers do not catch it."""


class Brake:
    """A driver's brake, closed once, with the time by `time.perf_counter` [s] and its error."""

    def __init__(self, driver: Driver) -> None:
        self.driver, self._lock = driver, threading.Lock()
        self.error: BaseException | None = None
        self.closed_at: float | None = None

    def close(self) -> None:
        """Brake, unless already braked."""
        with self._lock:
            if self.closed_at is not None:
                return
            self.closed_at = time.perf_counter()
            try:
                self.driver.brake()
            except BaseException as error:  # whatever it is, the watchdog and the loop go on
                self.error = error

    def send(self, command: Array) -> None:
        """Send a command; a HungError once the brake is closed, as the watchdog may do."""
        if self.closed_at is not None:
            raise HungError
        self.driver.send(command)


class Watchdog:
    """A thread that brakes if a period takes longer than `longest` [s].

    Then it sets `bit`, and interrupts the hanging call if the loop is in the main thread. It
    cannot run while an extension holds the interpreter's lock.
    """

    def __init__(self, brake: Brake, longest: float) -> None:
        self._brake, self.longest = brake, longest
        self._loop = threading.current_thread()
        self._is_main = self._loop is threading.main_thread()
        self._beat, self._over = time.perf_counter(), threading.Event()
        self._thread = threading.Thread(target=self._watch, name="approxjac watchdog", daemon=True)
        self.bit = False

    def beat(self) -> None:
        """Signal that a period was completed."""
        self._beat = time.perf_counter()

    def __enter__(self) -> Watchdog:
        if self._is_main:
            self._before = signal.signal(signal.SIGALRM, self._interrupt)
        self.beat()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join()  # its alarm would end the process, once nobody waits for it
        if self._is_main:  # None: no handler of Python's
            signal.signal(signal.SIGALRM, self._before or signal.SIG_DFL)

    def _watch(self) -> None:
        while not self._over.wait(self.longest / _LOOKS):
            if time.perf_counter() - self._beat > self.longest:
                self.bit = True
                self._brake.close()
                if self._is_main and self._loop.ident is not None:
                    signal.pthread_kill(self._loop.ident, signal.SIGALRM)
                return

    def _interrupt(self, *_: object) -> None:
        if self.bit and not self._over.is_set():
            raise HungError
