"""`LiveView`: a run in the browser while it goes on."""

from __future__ import annotations

import json
import math
import os
import select
import sys
import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from approxjac.checks import Array, as_array, as_number
from approxjac.errors import ApproxJacError, InvalidInputError
from approxjac.robots import Robot
from approxjac.simulation.record import Record, scene_of
from approxjac.simulation.sampled_loop import SampledLoop
from approxjac.simulation.scene import features
from approxjac.view.browser.frames import Frames
from approxjac.view.browser.html import live_page, recorded
from approxjac.view.browser.opening import open_browser
from approxjac.view.browser.server import PageServer
from approxjac.view.browser.stage import Stage

_FRAME = 1.0 / 30.0  # between pictures [s]
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
        self._typed = _Typed()
        self._patience = as_number("patience", patience, unit="s", minimum=0.0)
        self._paused = False
        self._rows: list[str] = []
        self._every = 1  # of the rows that were made, the one that is kept
        self._made = 0
        self._stage: Stage | None = None
        self._server: Any = None

    def __call__(self, loop: SampledLoop) -> None:
        """Show a step of a run, do what the user wants, and wait until it is time to go on."""
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

    def close(self) -> None:
        """Stop serving the page; pages that are open keep what they have been shown."""
        if self._server is not None:
            self._server.close()

    # -- showing ------------------------------------------------------------------------

    def _start(self, loop: SampledLoop) -> None:
        controller: Any = loop.controller
        if self._believe is not None and not hasattr(controller, "with_task"):
            raise InvalidInputError(
                f"controller must be able to take another task for its belief to be changed, "
                f"got {controller!r}",
                given=controller,
            )
        self._record = Record(loop.plant)
        self._origin, self._next = 0.0, 0.0
        self._look(loop)
        self._server = PageServer(self._page, self._greeting, self._port)
        url = self._server.url
        if open_browser(url):
            print(f"The run is shown at {url}", flush=True)
        else:
            print(f"No browser could be opened here: open {url} on this machine", flush=True)
        if self._terminal:
            print(f"Commands: {_HELP}", flush=True)
        if self._patience > 0.0 and not self._server.opened.wait(self._patience):
            print(f"Nobody has opened the page in {self._patience:g} s: the run starts", flush=True)
        self._begin(loop)

    def _look(self, loop: SampledLoop) -> Stage:
        """See anew who takes part."""
        self._scene = scene_of(loop.plant, loop.controller)
        self._frames = Frames(self._scene)
        self._stage = stage = Stage(self._scene, self._stage)
        self._text: str | None = None
        return stage

    def _page(self) -> str:
        """The page, made when it is asked for: meshes take a second."""
        text, stage = self._text, self._stage
        if text is None:
            assert stage is not None  # it is there before the server
            self._text = text = live_page(stage)
        return text

    def _controls(self) -> dict[str, Any]:
        """What the user may do, and how it is now."""
        return {
            "speed": self._speed if math.isfinite(self._speed) else None,
            "paused": self._paused,
            "length": self._length if self._believe is not None else None,
        }

    def _greeting(self) -> list[str]:
        return [
            f'{{"rows": [{", ".join(self._rows)}]}}',
            _message(controls=self._controls()),
        ]

    def _show(self, loop: SampledLoop) -> None:
        self._next = time.perf_counter() + _FRAME
        self._record.add(
            loop.truth, loop.measurement.x, loop.state, loop.answer, loop.target, loop.controller
        )
        instant = recorded(self._record.taken(loop.controller))
        row = json.dumps(_row(self._frames.columns(*instant)))
        self._server.send(f'{{"rows": [{row}]}}')
        if self._made % self._every == 0:
            self._rows.append(row)
            if len(self._rows) > _KEPT:
                self._rows, self._every = self._rows[::2], 2 * self._every
        self._made += 1

    def _end(self, loop: SampledLoop) -> None:
        self._server.send(_message(ended=f"The run has ended at {loop.t:g} s."))
        self.close()

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
                if early <= 0.0 or not math.isfinite(self._speed):
                    return
                time.sleep(min(early, _NAP))
                if early <= _NAP:
                    return
            self._obey(loop)

    # -- what the user wants ------------------------------------------------------------

    def _obey(self, loop: SampledLoop) -> None:
        """Do what pages and the terminal ask for; say what cannot be done."""
        for told in self._server.received():
            for wish, value in told.items():
                self._try(loop, wish, value)
        if self._terminal:
            for line in self._typed.lines():
                wish, *words = line.split() or ["help"]
                self._try(loop, wish, words)

    def _try(self, loop: SampledLoop, wish: str, value: Any) -> None:
        try:
            self._do(loop, wish, value)
        except ApproxJacError as error:
            self._say(str(error))

    def _do(self, loop: SampledLoop, wish: str, value: Any) -> None:
        if wish == "target":
            loop.aim_at(_numbers("target", value))
        elif wish == "point":
            loop.aim_at(_with_point(loop, _numbers("point", value)))
        elif wish == "pixel":
            loop.aim_at(_with_pixel(loop, _numbers("pixel", value)))
        elif wish == "length" and self._believe is not None:
            self._change_belief(loop, _number("length", value))
        elif wish == "speed":
            self._speed = _speed(_number("speed", value))
            self._begin(loop)
        elif wish in ("pause", "go"):
            self._paused = wish == "pause"
            self._begin(loop)
        elif wish == "stop":
            loop.stop()
        else:
            raise InvalidInputError(f"commands are: {_HELP}; got {wish!r}", given=wish)
        self._server.send(_message(controls=self._controls()))

    def _change_belief(self, loop: SampledLoop, length: float) -> None:
        controller: Any = loop.controller
        assert self._believe is not None  # else there is no such command
        robot = self._believe(as_number("length", length, unit="m", minimum=0.0))
        loop.exchange(controller.with_task(controller.task.on(robot)))
        self._length = length
        self._server.send(_message(redraw=self._look(loop).data("believed")))

    def _say(self, text: str) -> None:
        self._server.send(_message(note=text))
        if self._terminal:
            print(text, flush=True)


def _with_point(loop: SampledLoop, point: Array) -> Array:
    """The target with the position of what is followed moved to a point of the world (3,) [m]."""
    place = as_array("point", point, (3,), "m")
    for feature in features(loop.plant.sensor):
        if feature.axes:
            target = np.array(loop.target)
            for i, axis in enumerate(feature.axes):
                target[feature.entries.start + i] = place["xyz".index(axis)]
            return target
    raise InvalidInputError("the target is no position, which a point could be", given=point)


def _with_pixel(loop: SampledLoop, pixel: Array) -> Array:
    """The target with the image of point i moved to (u, v); `pixel` is (i, u, v)."""
    i, u, v = as_array("pixel", pixel, (3,))
    for feature in features(loop.plant.sensor):
        if feature.camera is not None:
            stride = (feature.entries.stop - feature.entries.start) // len(feature.points)
            if i != int(i) or not 0 <= i < len(feature.points):
                break
            target = np.array(loop.target)
            start = feature.entries.start + stride * int(i)
            target[start : start + 2] = u, v
            return target
    raise InvalidInputError(f"there is no point {i:g} in an image", given=pixel)


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


def _numbers(name: str, value: Any) -> Array:
    """Numbers that a page or a person gave.

    Raises:
        InvalidInputError: Anything else.
    """
    try:
        return np.array([float(entry) for entry in value])
    except (TypeError, ValueError):
        raise InvalidInputError(f"{name} must be numbers, got {value!r}", given=value) from None


def _number(name: str, value: Any) -> float:
    numbers = _numbers(name, value if isinstance(value, list) else [value])
    if len(numbers) != 1:
        raise InvalidInputError(f"{name} must be one number, got {value!r}", given=value)
    return float(numbers[0])


class _Typed:
    """Lines that a person types, or a program writes, to standard input."""

    def __init__(self) -> None:
        self._text = ""
        try:
            self._file: int | None = sys.stdin.fileno()
        except (AttributeError, OSError, ValueError):  # there is none
            self._file = None

    def lines(self) -> list[str]:
        """Those that were ended since this was asked for last."""
        # not by readline: what it reads ahead, `select` does not see
        while self._file is not None and select.select([self._file], [], [], 0)[0]:
            text = os.read(self._file, 4096).decode(errors="replace")
            if not text:
                self._file = None
            self._text += text
        *lines, self._text = self._text.split("\n")
        return lines
