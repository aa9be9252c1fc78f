"""`LiveView`: a run in the browser while it goes on."""

from __future__ import annotations

import json
import math
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from approxjac.controllers.wrapper import with_task
from approxjac.errors import ApproxJacError, InvalidInputError
from approxjac.robots import Robot
from approxjac.simulation.record import Record, scene_of
from approxjac.simulation.sampled_loop import SampledLoop
from approxjac.validation import Array, as_number
from approxjac.view.browser.frames import Frames
from approxjac.view.browser.html import live_page, recorded
from approxjac.view.browser.opening import open_browser
from approxjac.view.browser.server import PageServer
from approxjac.view.browser.stage import Stage
from approxjac.view.browser.wishes import Typed, number, numbers, with_pixel, with_point

_FRAME = 1.0 / 30.0  # between pictures [s]
_STALL = 0.5  # behind its time, after which a run does not catch up [s]
_NAP = 0.02  # between looks at what the user wants, while waiting [s]
_KEPT = 1500  # instants that a page gets when it is opened late
_HELP = "target X Y Z (as the task has it) | length L | speed S | pause | go | stop"


class LiveView:
    """Shows a run in the browser while it goes on, in real time or at another speed.

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
        self._terminal = terminal
        self._typed = Typed()
        self._patience = as_number("patience", patience, unit="s", minimum=0.0)
        self._paused = False
        self._rows: list[str] = []
        self._every = 1  # of the rows that were made, the one that is kept
        self._made = 0
        self._shown = -1  # step that was shown last
        self._kept_last = False
        self._stage: Stage | None = None
        self._text: tuple[Stage | None, str] = (None, "")
        self._changed = False
        self._server: Any = None
        self._closed = self._ended = self._interrupted = False
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
            self._end(loop)

    @property
    def url(self) -> str | None:
        """Where the page is, once the run has begun."""
        return None if self._server is None else str(self._server.url)

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Stop serving the page; pages that are open keep what they have been shown.

        `simulate` does so at the end of a run, however it ends.
        """
        if self._server is not None and not self._closed:
            if not self._ended:
                error = sys.exc_info()[1]  # `simulate` closes while it is being raised
                why = "" if error is None else f" {type(error).__name__}: {error}"
                self._server.send(_message(ended=f"The run was broken off.{why}"))
            self._server.close()
            if self._before is not None:
                signal.signal(signal.SIGINT, self._before)
        self._closed = True

    # -- showing ------------------------------------------------------------------------

    def _start(self, loop: SampledLoop) -> None:
        if self._believe is not None:
            with_task(loop.controller, loop.controller.task)  # or there is no changing the belief
        self._origin, self._next = 0.0, 0.0
        self._look(loop)
        self._record_instant(loop)
        self._server = PageServer(self._page, self._greeting, self._port)
        url = self._server.url
        taken = self._server.taken
        other = "" if taken is None else f" (port {taken} is taken)"
        if open_browser(url):
            print(f"The run is shown at {url}{other}", flush=True)
        else:
            print(f"No browser could be opened here: open {url} on this machine{other}", flush=True)
        if self._terminal:
            if threading.current_thread() is threading.main_thread():
                self._before = signal.signal(signal.SIGINT, self._interrupt)
            print(f"Commands: {_HELP} (Ctrl-C stops, too)", flush=True)
        self._await_page()
        self._begin(loop)

    def _await_page(self) -> None:
        """Wait for somebody to look, but not for ever."""
        until = time.monotonic() + self._patience
        while not self._server.opened.wait(_NAP) and not self._interrupted:
            if time.monotonic() > until:
                if self._patience > 0.0:
                    told = f"Nobody has opened the page in {self._patience:g} s: the run starts"
                    print(told, flush=True)
                return

    def _interrupt(self, *_: Any) -> None:
        """At Ctrl-C, stop the run, and keep what there is of it; a second one breaks it off."""
        self._interrupted = True
        signal.signal(signal.SIGINT, self._before)

    def _look(self, loop: SampledLoop) -> Stage:
        """See anew who takes part."""
        self._scene = scene_of(loop.plant, loop.controller)
        self._frames = Frames(self._scene)
        self._stage = stage = Stage(self._scene, self._stage)
        return stage

    def _page(self) -> str:
        """The page, made when it is asked for: meshes take a second."""
        stage, (made_of, text) = self._stage, self._text
        assert stage is not None  # it is there before the server
        if made_of is not stage:
            text = live_page(stage, self._columns, self._q)
            self._text = stage, text
        return text

    def _controls(self) -> dict[str, Any]:
        """What the user may do, and how it is now."""
        return {
            "speed": self._speed if math.isfinite(self._speed) else None,
            "paused": self._paused,
            "length": self._length if self._believe is not None else None,
        }

    def _greeting(self) -> list[str]:
        """What a page gets first; it may have been made before the belief changed."""
        messages = [f'{{"rows": [{", ".join(self._rows)}]}}', _message(controls=self._controls())]
        stage = self._stage
        if self._changed and stage is not None:
            messages.insert(0, _message(redraw=stage.data("believed")))
        return messages

    def _show(self, loop: SampledLoop) -> None:
        self._next = time.perf_counter() + _FRAME
        row = json.dumps(_row(self._record_instant(loop)))
        self._server.send(f'{{"rows": [{row}]}}')
        if loop.step == self._shown:  # the same instant, with another target
            if self._kept_last:
                self._rows[-1] = row
            return
        self._shown = loop.step
        self._kept_last = self._made % self._every == 0
        if self._kept_last:
            self._rows.append(row)
            if len(self._rows) > _KEPT:
                self._rows, self._every = self._rows[::2], 2 * self._every
                self._kept_last = False  # it may be gone
        self._made += 1

    def _record_instant(self, loop: SampledLoop) -> dict[str, Array]:
        """What the page shows of this step."""
        record = Record(loop.plant)
        record.add(
                loop.truth, loop.measurement.x, loop.state, loop.answer, loop.target,
                loop.controller,
            )  # fmt: skip
        run = record.trajectory()
        self._columns, self._q = self._frames.columns(*recorded(run)), run.q
        return self._columns

    def _end(self, loop: SampledLoop) -> None:
        self._server.send(_message(ended=f"The run has ended at {loop.t:g} s."))
        self._ended = True

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
        asked = False
        if self._interrupted:
            loop.stop()
        for told in self._server.received():
            for wish, value in told.items():
                asked = True
                self._server.send(_message(**self._try(loop, wish, value)))
        for line in self._typed.lines() if self._terminal else ():
            asked = True
            wish, *words = line.split()
            if wish == "help":
                print(f"Commands: {_HELP}", flush=True)
                continue
            said = self._try(loop, wish, words)
            self._server.send(_message(controls=self._controls()))
            print(said.get("note", f"done: {line.strip()}"), flush=True)
        return asked

    def _try(self, loop: SampledLoop, wish: str, value: Any) -> dict[str, Any]:
        """Do something; returns how things are then, and what to say of it."""
        found = {}
        try:
            self._do(loop, wish, value)
        except ApproxJacError as error:
            found["note"] = str(error)
        except Exception as error:  # of the user's own `believe`: it is no reason to lose the run
            found["note"] = f"{wish}: {type(error).__name__}: {error}"
        return {"controls": self._controls(), **found}

    def _do(self, loop: SampledLoop, wish: str, value: Any) -> None:
        if wish == "target":
            loop.aim_at(numbers("target", value))
        elif wish == "point":
            loop.aim_at(with_point(loop, numbers("point", value)))
        elif wish == "pixel":
            loop.aim_at(with_pixel(loop, numbers("pixel", value)))
        elif wish == "length" and self._believe is not None:
            self._change_belief(loop, number("length", value))
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

    def _change_belief(self, loop: SampledLoop, length: float) -> None:
        controller = loop.controller
        assert self._believe is not None  # else there is no such command
        robot = self._believe(as_number("length", length, unit="m", minimum=0.0))
        loop.exchange(with_task(controller, controller.task.on(robot)))
        self._length, self._changed = length, True
        self._server.send(_message(redraw=self._look(loop).data("believed")))


def _row(columns: Mapping[str, Array]) -> dict[str, Any]:
    """One instant as JSON can have it: rounded, and None for what is not known."""
    return {name: _plain(values[-1]) for name, values in columns.items()}


def _plain(value: Any) -> Any:
    if np.ndim(value) > 0:
        return [_plain(entry) for entry in value]
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _message(**parts: Any) -> str:
    return json.dumps(parts)


def _speed(value: float) -> float:
    if value == math.inf:
        return math.inf
    return as_number("speed", value, above=0.0)
