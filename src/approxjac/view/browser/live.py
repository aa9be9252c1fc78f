"""`LiveView`: a run in the browser while it goes on."""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections.abc import Callable
from typing import Any

import numpy as np

from approxjac.controllers.wrapper import with_task
from approxjac.errors import ApproxJacError, InvalidInputError
from approxjac.robots import Robot
from approxjac.simulation.record import Record, scene_of
from approxjac.simulation.sampled_loop import SampledLoop
from approxjac.validation import as_number
from approxjac.view.browser.document import live_page
from approxjac.view.browser.frames import Frames
from approxjac.view.browser.page import open_browser
from approxjac.view.browser.server import PageServer
from approxjac.view.browser.stage import Stage
from approxjac.view.browser.wishes import Typed, number, numbers, with_pixel, with_point

_FRAME = 1.0 / 30.0  # between pictures [s]
_STALL = 0.5  # behind its time, after which a run does not catch up [s]
_NAP = 0.02  # between looks at what the user wants, while waiting [s]
_KEPT = 1500  # instants that a page gets when it is opened late
_HELP = "target X Y Z (as the task has it) | length L | speed S | pause | go | stop"
_COMMANDS = f"Commands: {_HELP}"


class LiveView:
    """A view of a run in the browser while it goes on, in real time or at another speed.

    An observer for `simulate`, for one run: `aj.simulate(..., observer=view.LiveView())`. The
    target is moved in the page (with the mouse, or as numbers); so is the believed length where
    `believe` is given. What is not moved leaves the run as it is without a view, to the last bit.

    Args:
        speed: Of the run, as a multiple of real time, > 0; infinite for as fast as it goes.
        port: Of the page, on this machine only; 7007 by default, or any free one.
        believe: Makes the robot that the controller is to believe from the length of its object
            [m]; without it that stays as it is.
        believed_length: That of the object at first [m].
        terminal: Whether to take commands from standard input as well.
        patience: How long to wait for the page to be opened before the run starts [s].

    Raises:
        InvalidInputError: Numbers out of range, or a port that is taken.
    """

    def __init__(
        self,
        *,
        speed: float = 1.0,
        port: int | None = None,
        believe: Callable[[float], Robot] | None = None,
        believed_length: float = 0.0,
        terminal: bool = False,
        patience: float = 20.0,
    ) -> None:
        self._speed = _speed(speed)
        self._port = port
        self._believe = believe
        self._length = as_number("believed_length", believed_length, unit="m", minimum=0.0)
        self._typed = Typed() if terminal else None
        self._patience = as_number("patience", patience, unit="s", minimum=0.0)
        self._rows: dict[int, str] = {}  # the last one in each so many steps
        self._every = 1
        self._stage: Stage | None = None
        self._pages: dict[Stage, str] = {}
        self._server: PageServer | None = None
        self._paused = self._changed = self._interrupted = self._ended = self._closed = False
        self._origin = self._next = 0.0
        self._before: Any = None  # what Ctrl-C did before

    def __call__(self, loop: SampledLoop) -> None:
        """Show a step of a run, do what the user wants, and wait until it is time to go on."""
        if self._closed:
            raise InvalidInputError(
                "a LiveView is for one run, and this one has shown its run: make another one",
                given=self,
            )
        if self._server is None:
            self._start(loop)
        self._obey(loop)
        if loop.ended or time.perf_counter() >= self._next:
            self._show(loop)
        self._wait(loop)
        if loop.ended:
            self._ended = True
            self._tell(ended=f"The run has ended at {loop.t:g} s.")

    @property
    def url(self) -> str | None:
        """Address of the page, once the run has begun."""
        return None if self._server is None else self._server.url

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self.close(error)

    def close(self, error: BaseException | None = None) -> None:
        """Stop serving the page; pages that are open keep what they have been shown.

        `simulate` does so at the end of a run, however it ends.

        Args:
            error: What broke the run off, if anything did.
        """
        if self._server is not None and not self._closed:
            if not self._ended:
                why = "" if error is None else f" {type(error).__name__}: {error}"
                self._tell(ended=f"The run was broken off.{why}")
            self._server.close()
            if self._before is not None:
                signal.signal(signal.SIGINT, self._before)
        self._closed = True

    # -- showing ------------------------------------------------------------------------

    def _start(self, loop: SampledLoop) -> None:
        if self._believe is not None:
            with_task(loop.controller, loop.controller.task)  # or there is no changing the belief
        self._look(loop)
        self._row(loop)
        self._server = server = PageServer(self._page, self._greeting, self._port)
        other = "" if server.taken is None else f" (port {server.taken} is taken)"
        told = f"The run is shown at {server.url}{other}"
        if not open_browser(server.url):
            told = f"No browser could be opened here: open {server.url} on this machine{other}"
        print(told, flush=True)
        if self._typed is not None:
            if threading.current_thread() is threading.main_thread():
                self._before = signal.signal(signal.SIGINT, self._interrupt)
            print(f"{_COMMANDS} (Ctrl-C stops, too)", flush=True)
        until = time.monotonic() + self._patience
        while not server.opened.wait(_NAP) and not self._interrupted:
            if time.monotonic() > until:
                if self._patience > 0.0:
                    told = f"Nobody has opened the page in {self._patience:g} s: the run starts"
                    print(told, flush=True)
                break
        self._begin(loop)

    def _interrupt(self, *_: Any) -> None:
        """At Ctrl-C, stop the run, and keep what there is of it; a second one breaks it off."""
        self._interrupted = True
        signal.signal(signal.SIGINT, self._before)

    def _look(self, loop: SampledLoop) -> Stage:
        """See anew who takes part."""
        scene = scene_of(loop.plant, loop.controller)
        self._frames = Frames(scene)
        self._stage = stage = Stage(scene, self._stage)
        return stage

    def _page(self) -> str:
        """Return the page, made when it is asked for: meshes take a second."""
        stage = self._stage
        assert stage is not None  # it is there before the server
        if stage not in self._pages:
            self._pages = {stage: live_page(stage, self._columns, self._q)}
        return self._pages[stage]

    def _controls(self) -> dict[str, Any]:
        """Return what the user may do, and how it is now."""
        return {
            "speed": self._speed if math.isfinite(self._speed) else None,
            "paused": self._paused,
            "length": self._length if self._believe is not None else None,
        }

    def _greeting(self) -> list[str]:
        """Return what a page gets first; it may have been made before the belief changed."""
        rows = f'{{"rows": [{", ".join(list(self._rows.values()))}]}}'
        messages = [rows, json.dumps({"controls": self._controls()})]
        if self._changed and self._stage is not None:
            messages.insert(0, json.dumps({"redraw": self._stage.data("believed")}))
        return messages

    def _tell(self, **parts: Any) -> None:
        """Send a message to all pages."""
        assert self._server is not None  # there is no run without it
        self._server.send(json.dumps(parts))

    def _show(self, loop: SampledLoop) -> None:
        self._next = time.perf_counter() + _FRAME
        row = self._row(loop)
        self._tell(rows=[row])
        # the same instant with another target takes the place of the one before
        self._rows[loop.step // self._every] = json.dumps(row)
        if len(self._rows) > _KEPT:
            self._every *= 2
            self._rows = {key // 2: kept for key, kept in self._rows.items()}

    def _row(self, loop: SampledLoop) -> dict[str, Any]:
        """Return what the page shows of this step, as JSON can have it."""
        record = Record(loop.plant, 1)
        record.add(
            loop.truth, loop.measurement.x, loop.state, loop.answer, loop.target, loop.controller
        )
        run = record.trajectory()
        self._q, self._columns = run.q, self._frames.columns(run)
        return {name: _plain(values[-1]) for name, values in self._columns.items()}

    # -- time ---------------------------------------------------------------------------

    def _begin(self, loop: SampledLoop) -> None:
        """Let the run be where it is now."""
        share = loop.t / self._speed if math.isfinite(self._speed) else 0.0
        self._origin = time.perf_counter() - share

    def _wait(self, loop: SampledLoop) -> None:
        """Wait until it is the run's time, and while it is to pause."""
        while not loop.ended:
            if self._paused:
                time.sleep(_NAP)
            else:
                early = self._origin + loop.t / self._speed - time.perf_counter()
                if early < -_STALL:  # the machine slept, say: the run does not catch up
                    self._begin(loop)
                if early <= 0.0 or not math.isfinite(self._speed):
                    return
                time.sleep(min(early, _NAP))
                if early <= _NAP:
                    return
            if self._obey(loop):
                self._show(loop)

    # -- what the user wants ------------------------------------------------------------

    def _obey(self, loop: SampledLoop) -> bool:
        """Do what pages and the terminal ask for, say what cannot be done; was there anything?"""
        assert self._server is not None  # there is no run without it
        asked = False
        if self._interrupted:
            loop.stop()
        for told in self._server.received():
            for wish, value in told.items():
                asked = True
                note = self._try(loop, wish, value)
                self._tell(controls=self._controls(), **({"note": note} if note else {}))
        for line in [] if self._typed is None else self._typed.lines():
            asked = True
            wish, *words = line.split()
            note = _COMMANDS if wish == "help" else self._try(loop, wish, words)
            self._tell(controls=self._controls())
            print(note or f"done: {line.strip()}", flush=True)
        return asked

    def _try(self, loop: SampledLoop, wish: str, value: Any) -> str:
        """Do something; return why it cannot be done, or nothing."""
        try:
            self._do(loop, wish, value)
        except ApproxJacError as error:
            return str(error)
        except Exception as error:  # of the user's own `believe`: it is no reason to lose the run
            return f"{wish}: {type(error).__name__}: {error}"
        return ""

    def _do(self, loop: SampledLoop, wish: str, value: Any) -> None:
        if wish == "target":
            loop.aim_at(numbers("target", value))
        elif wish == "point":
            loop.aim_at(with_point(loop, numbers("point", value)))
        elif wish == "pixel":
            loop.aim_at(with_pixel(loop, numbers("pixel", value)))
        elif wish == "length" and self._believe is not None:
            length = as_number("length", number("length", value), unit="m", minimum=0.0)
            task = loop.controller.task.on(self._believe(length))
            loop.exchange(with_task(loop.controller, task))
            self._length, self._changed = length, True
            self._tell(redraw=self._look(loop).data("believed"))
        elif wish == "speed":
            self._speed = _speed(number("speed", value))
            self._begin(loop)
        elif wish in ("pause", "go"):
            self._paused = wish == "pause"
            self._begin(loop)
        elif wish == "stop":
            loop.stop()
        else:
            raise InvalidInputError(f"commands are: {_HELP}; got {wish!r}", given=wish)


def _plain(value: Any) -> Any:
    """Return numbers as JSON can have them: rounded, and None for what is not known."""
    if np.ndim(value) > 0:
        return [_plain(entry) for entry in value]
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _speed(value: float) -> float:
    return math.inf if value == math.inf else as_number("speed", value, above=0.0)
