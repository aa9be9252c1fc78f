"""`LiveView`: a run in the browser while it goes on."""

from __future__ import annotations

import json
import math
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from approxjac.errors import ApproxJacError, InvalidInputError
from approxjac.robots import Robot
from approxjac.simulation.loop import Loop
from approxjac.simulation.trajectory import Record, scene_of
from approxjac.validation import as_number
from approxjac.view.browser.commands import LONG, numbers, target_of, with_pixel, with_point
from approxjac.view.browser.document import asset, document, page_data
from approxjac.view.browser.frames import RunFrames
from approxjac.view.browser.page import open_browser
from approxjac.view.browser.server import PageServer
from approxjac.view.browser.stage import Stage

_FRAME = 1.0 / 30.0  # between pictures [s]
_STALL = 0.5  # behind its time, after which a run does not catch up [s]
_NAP = 0.02  # between looks at what the user wants, while waiting [s]
_KEPT = 1500  # instants that a page gets when it is opened late
_SLOWEST = 1e-3  # of real time; slower is a pause
_WISHES = "target, point, pixel, length, speed, pause, go, stop"


class LiveView:
    """A view of a run in the browser while it goes on, in real time or at another speed.

    An observer for `simulate`, for one run: `aj.simulate(..., observer=view.LiveView())`. The
    target is moved in the page (with the mouse, or as numbers); so is the believed length where
    `believe` is given. What is not moved leaves the run as it is without a view, to the last bit.
    Ctrl-C in the terminal stops the run and keeps what there is of it.

    Args:
        speed: Of the run, as a multiple of real time, ≥ 0.001; infinite for as fast as it goes.
        port: Of the page, on this machine only; 7007 by default, or any free one.
        believe: Makes the robot that the controller is to believe from the length of its object
            [m]; without it that stays as it is.
        believed_length: That of the object at first [m].
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
        patience: float = 20.0,
    ) -> None:
        self._speed = _speed(speed)
        self._port = port
        self._believe = believe
        self._length = as_number("believed_length", believed_length, unit="m", minimum=0.0)
        self._patience = as_number("patience", patience, unit="s", minimum=0.0)
        self._rows: dict[int, dict[str, Any]] = {}  # the last one in each so many steps
        self._every = 1
        self._stage: Stage | None = None
        self._server: PageServer | None = None
        self._paused = self._changed = self._interrupted = self._ended = self._closed = False
        self._origin = self._next = 0.0
        self._before: Any = None  # what Ctrl-C did before

    def __call__(self, loop: Loop) -> None:
        """Show a step of a run, do what the user wants, and wait until it is time to go on."""
        if self._closed:
            message = "a LiveView is for one run, and this one has shown its run: make another one"
            raise InvalidInputError(message, given=self)
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
        """Stop serving the page, as `simulate` does at the end of a run, or at an error.

        Pages that are open keep what they have been shown.
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

    def _start(self, loop: Loop) -> None:
        if self._believe is not None:
            loop.controller.with_task(loop.controller.task)  # or there is no changing the belief
        self._look(loop)
        self._row(loop)
        self._server = server = PageServer(self._page, self._greeting, self._port)
        if threading.current_thread() is threading.main_thread():
            self._before = signal.signal(signal.SIGINT, self._interrupt)
        other = "" if server.taken is None else f" (port {server.taken} is taken)"
        message = f"The run is shown at {server.url}{other}"
        if not open_browser(server.url):
            message = f"No browser could be opened here: open {server.url} on this machine{other}"
        print(message, flush=True)
        until = time.monotonic() + self._patience
        while time.monotonic() < until and not self._interrupted and not server.opened.wait(_NAP):
            pass
        if time.monotonic() >= until and self._patience > 0.0:
            print(f"Nobody has opened the page in {self._patience:g} s: the run starts", flush=True)
        self._begin(loop)

    def _interrupt(self, *_: Any) -> None:
        """At Ctrl-C, stop the run; a second one breaks it off."""
        self._interrupted = True
        signal.signal(signal.SIGINT, self._before)

    def _look(self, loop: Loop) -> Stage:
        """See anew who takes part."""
        scene = scene_of(loop.plant, loop.controller)
        scene = replace(scene, knows_truth=loop._knows_truth)
        self._frames = RunFrames(scene)
        self._stage = stage = Stage(scene, self._stage)
        return stage

    def _page(self) -> str:
        assert self._stage is not None  # it is there before the server
        data = page_data(self._stage, self._run, self._columns, self._run.q, live=True)
        return document(data, asset("live.js"))

    def _controls(self) -> dict[str, Any]:
        """Return the page's controls with their present values."""
        return {
            "speed": self._speed if math.isfinite(self._speed) else None,
            "paused": self._paused,
            "length": self._length if self._believe is not None else None,
        }

    def _greeting(self) -> str:
        """Return the first message to a page; it may date from before the belief changed."""
        message: dict[str, Any] = {"rows": list(self._rows.values()), "controls": self._controls()}
        if self._changed and self._stage is not None:
            message["redraw"] = self._stage.data("believed")
        return json.dumps(message)

    def _tell(self, **parts: Any) -> None:
        """Send a message to all pages."""
        assert self._server is not None  # there is no run without it
        self._server.send(json.dumps(parts))

    def _show(self, loop: Loop) -> None:
        self._next = time.perf_counter() + _FRAME
        row = self._row(loop)
        self._tell(rows=[row])
        # the same instant with another target takes the place of the one before
        self._rows[loop.step // self._every] = row
        if len(self._rows) > _KEPT:
            self._every *= 2
            self._rows = {key // 2: kept for key, kept in self._rows.items()}

    def _row(self, loop: Loop) -> dict[str, Any]:
        """Return this step as the page shows it, in types that JSON has."""
        record, x = Record(loop.plant, 1), loop.measurement.x
        answer, controller = loop.answer, loop.controller
        record.add(loop.truth, x, loop.state, answer, loop.tau, loop.target, controller)
        self._run = record.trajectory()
        self._columns = self._frames.columns(self._run)
        return {name: _plain(values[-1]) for name, values in self._columns.items()}

    # -- time ---------------------------------------------------------------------------

    def _begin(self, loop: Loop) -> None:
        """Let the run be where it is now."""
        self._origin = time.perf_counter() - loop.t / self._speed

    def _wait(self, loop: Loop) -> None:
        """Wait until it is the run's time, and while it is to pause."""
        while not loop.ended:
            if self._paused:
                time.sleep(_NAP)
            else:
                early = self._origin + loop.t / self._speed - time.perf_counter()
                if early < -_STALL:  # the machine slept, say: the run does not catch up
                    self._begin(loop)
                time.sleep(min(max(early, 0.0), _NAP))
                if early <= _NAP:
                    return
            if self._obey(loop):
                self._show(loop)

    # -- what the user wants ------------------------------------------------------------

    def _obey(self, loop: Loop) -> bool:
        """Do what pages ask for, say what cannot be done; return whether there was anything."""
        assert self._server is not None  # there is no run without it
        if self._interrupted:
            loop.stop()
        wishes = self._server.received()
        for wish, value in wishes:
            note = {}
            try:
                self._do(loop, wish, value)
            except ApproxJacError as error:
                note = {"note": str(error)}
            except Exception as error:  # of the user's `believe`: no reason to lose the run
                note = {"note": f"{wish}: {type(error).__name__}: {error}"}
            self._tell(controls=self._controls(), **note)
        return bool(wishes)

    def _do(self, loop: Loop, wish: str, value: Any) -> None:
        assert self._stage is not None  # it is there before the server
        size = self._stage.size
        if wish == "target":
            loop.aim_at(target_of(loop, numbers("target", value), size))
        elif wish == "point":
            loop.aim_at(target_of(loop, with_point(loop, numbers("point", value)), size))
        elif wish == "pixel":
            loop.aim_at(target_of(loop, with_pixel(loop, numbers("pixel", value)), size))
        elif wish == "length" and self._believe is not None:
            given = numbers("length", value).item()
            length = as_number("length", given, unit="m", minimum=0.0, most=round(size, 2))
            task = loop.controller.task.on(self._believe(length))
            loop.exchange(loop.controller.with_task(task))
            self._length, self._changed = length, True
            self._tell(redraw=self._look(loop).data("believed"))
        elif wish == "speed":
            self._speed = _speed(numbers("speed", value).item())
            self._begin(loop)
        elif wish in ("pause", "go"):
            self._paused = wish == "pause"
            self._begin(loop)
        elif wish == "stop":
            loop.stop()
        else:
            message = repr(wish)[:LONG]
            raise InvalidInputError(f"commands are: {_WISHES}; got {message}", given=wish)


def _plain(value: Any) -> Any:
    """Return numbers as JSON can have them: rounded, and None for what is not known."""
    if np.ndim(value) > 0:
        return [_plain(entry) for entry in value]
    return float(f"{value:.6g}") if math.isfinite(value) else None


def _speed(value: float) -> float:
    return math.inf if value == math.inf else as_number("speed", value, minimum=_SLOWEST)
