"""`LiveView`: a live view of a run in the browser, and the server of its page."""

from __future__ import annotations

import asyncio
import contextlib
import json
import math
import re
import secrets
import signal
import socket
import threading
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from approxjac.cameras import PlanarCamera
from approxjac.errors import ApproxJacError, InvalidInputError, package_of
from approxjac.formatting import plain
from approxjac.robots import Robot
from approxjac.simulation.simulate import Loop
from approxjac.simulation.trajectory import Record, scene_of
from approxjac.tasks.analysis import features, image_feature
from approxjac.validation import Array, as_array, as_number
from approxjac.view.browser.frames import RunFrames
from approxjac.view.browser.page import asset, document, open_browser, page_data, policy_of
from approxjac.view.browser.stage import Stage

_FRAME = 1.0 / 30.0  # between pictures [s]
_STALL = 0.5  # behind its time, after which a run does not catch up [s]
_NAP = 0.02  # between looks at what the user wants, while waiting [s]
_KEPT = 3000  # last instants, which a page gets when it is opened late
_SLOWEST = 1e-3  # of real time; slower is a pause
_COMMANDS = "point, pixel, length, speed, pause, go, stop"
_SHOWN = 80  # characters of what a page sent, in errors
_FAR = 2.0  # from the base on each axis, of what the arm reaches: runs diverge at light years

_HOST = "127.0.0.1"  # nobody else on the network gets to move an arm
_HOSTS = r"(127\.0\.0\.1|localhost)"
_PORT = 7007
_ALIVE = {"websocket_ping_interval": 10.0, "websocket_ping_timeout": 10.0}  # or it is left [s]
_LONGEST = 20_000  # of a message from a page [byte]
_SPARE = 0.005  # between messages of one page [s]; a mouse sends one in 50 ms
_KINDS = 32  # of commands that wait; of each kind the latest
_NO_KEY = "Open the address that the program printed: it ends with a key, which this one lacks."
_CLOSING = 2.0  # for what was sent to arrive [s]


class LiveView:
    """A live view of a run in the browser, in real time or at another speed.

    It is an observer for one run of `simulate`: `aj.simulate(..., observer=view.LiveView())`. The
    target can be changed in the page (with the mouse, or as numbers); with `believe` also the
    believed length. Without changes the run is the same as without a view, to the last bit.
    Ctrl-C in the terminal stops the run and keeps its record.

    Args:
        speed: Speed of the run, as a multiple of real time, ≥ 0.001; infinite for no waiting.
        port: Port of the page, on this machine only; 7007 by default, or any free one.
        believe: Function from the length of the object [m] to the robot that the controller
            believes; without it that does not change.
        believed_length: Initial believed length of the object [m].
        patience: Time to wait for the page to be opened before the run starts [s].

    Attributes:
        url: Address of the page; None before the run has begun.

    Raises:
        InvalidInputError: Numbers out of range, or a port that is taken.
    """

    _stage: Stage
    _server: PageServer

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
        self.url: str | None = None
        self._rows: deque[dict[str, Any]] = deque(maxlen=_KEPT)
        self._paused = self._changed = self._interrupted = self._ended = self._closed = False
        self._origin = self._next = 0.0
        self._before: Any = None  # what Ctrl-C did before

    def __call__(self, loop: Loop) -> None:
        """Show a step of a run, carry out the user's commands, and wait until the next is due."""
        if self._closed:
            message = "a LiveView is for one run, and this one has shown its run: make another one"
            raise InvalidInputError(message, given=self)
        if self.url is None:
            self._start(loop)
        self._obey(loop)
        if loop.ended or time.perf_counter() >= self._next:
            self._show(loop)
        self._wait(loop)
        if loop.ended:
            self._ended = True
            self._tell(ended=f"The run has ended at {loop.t:g} s.")

    def __enter__(self) -> LiveView:
        return self

    def __exit__(self, kind: object, error: BaseException | None, trace: object) -> None:
        self.close(error)

    def close(self, error: BaseException | None = None) -> None:
        """Stop serving the page, as `simulate` does at the end of a run, or at an error.

        Pages that are open keep what they have been shown.
        """
        if self.url is not None and not self._closed:
            if not self._ended:
                why = "" if error is None else f" {type(error).__name__}: {error}"
                self._tell(ended=f"The run was broken off.{why}")
            self._server.close()
            if self._before is not None:
                signal.signal(signal.SIGINT, self._before)
        self._closed = True

    def _start(self, loop: Loop) -> None:
        if self._believe is not None:
            loop.controller.with_task(loop.controller.task)  # or there is no changing the belief
        self._look(loop)
        self._row(loop)
        self._server = server = PageServer(self._page, self._greeting, self._port)
        self.url = server.url
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

    def _look(self, loop: Loop) -> None:
        """Rebuild frames and stage for the current plant and controller."""
        scene = replace(scene_of(loop.plant, loop.controller), knows_truth=loop._knows_truth)
        self._frames, self._stage = RunFrames(scene), Stage(scene)

    def _page(self) -> str:
        data = page_data(self._stage, self._run, self._columns, self._run.q, live=True)
        return document(data, asset("live.js"))

    def _controls(self) -> dict[str, Any]:
        return {
            "speed": self._speed if math.isfinite(self._speed) else None,
            "paused": self._paused,
            "length": self._length if self._believe is not None else None,
        }

    def _greeting(self) -> str:
        """Return the first message to a page; it may date from before the belief changed."""
        message: dict[str, Any] = {"rows": list(self._rows), "controls": self._controls()}
        if self._changed:
            message["redraw"] = self._stage.data("believed")
        return json.dumps(message)

    def _tell(self, **parts: Any) -> None:
        self._server.send(json.dumps(parts))

    def _show(self, loop: Loop) -> None:
        self._next = time.perf_counter() + _FRAME
        row = self._row(loop)
        self._tell(rows=[row])
        if self._rows and self._rows[-1]["t"] == row["t"]:  # with another target
            self._rows.pop()
        self._rows.append(row)

    def _row(self, loop: Loop) -> dict[str, Any]:
        """Return this step as the page shows it, in types that JSON has."""
        record = Record(loop.plant, 1)
        record.add(*loop.instant)
        self._run = record.trajectory()
        self._columns = self._frames.columns(self._run)
        return {name: plain(values[-1]) for name, values in self._columns.items()}

    def _begin(self, loop: Loop) -> None:
        """Pace the run from its current time on."""
        self._origin = time.perf_counter() - loop.t / self._speed

    def _wait(self, loop: Loop) -> None:
        """Wait until the step is due, and while the run is paused."""
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

    def _obey(self, loop: Loop) -> bool:
        """Carry out the commands of pages; return True if there were any."""
        if self._interrupted:
            loop.stop()
        commands = self._server.received()
        for command, value in commands:
            note = {}
            try:
                self._do(loop, command, value)
            except ApproxJacError as error:
                note = {"note": str(error)}
            except Exception as error:  # of the user's `believe`: no reason to lose the run
                note = {"note": f"{command}: {type(error).__name__}: {error}"}
            self._tell(controls=self._controls(), **note)
        return bool(commands)

    def _do(self, loop: Loop, command: str, value: Any) -> None:
        size = self._stage.size
        if command in ("point", "pixel"):
            loop.aim_at(_target(loop, command, _numbers(command, value), size))
        elif command == "length" and self._believe is not None:
            given = _numbers("length", value).item()
            length = as_number("length", given, unit="m", minimum=0.0, most=round(size, 2))
            task = loop.controller.task.on(self._believe(length))
            loop.exchange(loop.controller.with_task(task))
            self._length, self._changed = length, True
            self._look(loop)
            self._tell(redraw=self._stage.data("believed"))
        elif command == "speed":
            self._speed = _speed(_numbers("speed", value).item())
            self._begin(loop)
        elif command in ("pause", "go"):
            self._paused = command == "pause"
            self._begin(loop)
        elif command == "stop":
            loop.stop()
        else:
            message = f"commands are: {_COMMANDS}; got {repr(command)[:_SHOWN]}"
            raise InvalidInputError(message, given=command)


def _speed(value: float) -> float:
    return math.inf if value == math.inf else as_number("speed", value, minimum=_SLOWEST)


def _numbers(name: str, value: Any) -> Array:
    """Return the numbers that a page sent; a page cannot be trusted."""
    entries = value if isinstance(value, list) else [value]
    if all(type(entry) in (int, float) for entry in entries):
        with contextlib.suppress(OverflowError):
            return np.array(entries, dtype=float)
    raise InvalidInputError(f"{name} must be numbers, got {repr(value)[:_SHOWN]}", given=value)


def _target(loop: Loop, command: str, given: Array, size: float) -> Array:
    """Return the target with what a page moved, if an arm of this size [m] can be sent to it.

    That is the place (3,) [m] of what is followed, or (i, u, v), the image of point i.
    """
    sensor, target = loop.plant.sensor, np.array(loop.target)
    if command == "point":
        place = as_array("point", given, (3,), "m")
        feature = next((feature for feature in features(sensor) if feature.axes), None)
        if feature is None:
            message = "the target is no position, which a point could be"
            raise InvalidInputError(message, given=given)
        _require_near(place, _FAR * size, "m from the arm's base")
        rows = ["xyz".index(axis) for axis in feature.axes]
        target[feature.entries][: len(rows)] = place[rows]
    else:
        i, u, v = as_array("pixel", given, (3,))
        feature = image_feature(sensor)
        if feature is None or i not in range(len(feature.points)):
            raise InvalidInputError(f"there is no point {i:g} in an image", given=given)
        camera = feature.camera
        if isinstance(camera, PlanarCamera):  # images of others have a border
            far, where = _FAR * size * camera.magnification, "from where the base appears"
            _require_near(np.array([u, v]) - camera.offset, far, f"{camera.unit} {where}")
        target[feature.entries].reshape(len(feature.points), -1)[int(i), :2] = u, v
    return np.asarray(sensor.target(target))


def _require_near(way: Array, far: float, words: str) -> None:
    if not (np.abs(way) <= far).all():
        message = f"target must be at most {far:.3g} {words}, got {way.tolist()}"
        raise InvalidInputError(message, given=way)


class PageServer:
    """A server of a page, in a thread of its own, for clients that know its address.

    The address holds a key, so that no other program or page on this machine finds it. Messages
    of pages are commands, {"what": value}: the latest of each kind is kept until it is read. The
    function for the page is called at each request, the one for the greeting once it is open.
    """

    def __init__(
        self, page: Callable[[], str], greeting: Callable[[], str], port: int | None
    ) -> None:
        self._web = package_of("view", "tornado.web")
        self._websocket = package_of("view", "tornado.websocket")
        self._page, self._greeting = page, greeting
        self._socket = _bound(port)
        bound = self._socket.getsockname()[1]
        self.taken = _PORT if port is None and bound != _PORT else None  # by another program
        self._key = secrets.token_urlsafe(12)
        self.url = f"http://{_HOST}:{bound}/{self._key}/"
        self.opened = threading.Event()  # by the first page
        self._commands: dict[str, tuple[str, Any]] = {}
        self._lock = threading.Lock()
        self._pages: set[Any] = set()
        self._loop = asyncio.new_event_loop()
        self._closing = asyncio.Event()
        self._thread = threading.Thread(target=self._serve, name="approxjac page", daemon=True)
        self._thread.start()

    def send(self, message: str) -> None:
        """Send a message to all pages, without waiting for them."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._send, message)

    def received(self) -> list[tuple[str, Any]]:
        """Return name and value of the latest command of each kind since the last call."""
        with self._lock:
            commands, self._commands = list(self._commands.values()), {}
        return commands

    def close(self) -> None:
        """Stop serving, after all messages were sent."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._closing.set)
            self._thread.join(_CLOSING)

    def _keep(self, command: str, value: Any) -> None:
        # points of an image are moved one by one
        kind = str(value).partition(",")[0] if command == "pixel" else command
        with self._lock:
            self._commands.pop(kind, None)  # the latest are the last
            self._commands[kind] = command, value
            while len(self._commands) > _KINDS:
                del self._commands[next(iter(self._commands))]

    def _serve(self) -> None:
        with contextlib.closing(self._loop):
            self._loop.run_until_complete(self._until_closed())

    async def _until_closed(self) -> None:
        outer = self

        class NoKey(self._web.RequestHandler):  # type: ignore[misc, name-defined]
            def get(self) -> None:
                self.set_status(403)
                self.finish(_NO_KEY)

        class Page(self._web.RequestHandler):  # type: ignore[misc, name-defined]
            def get(self) -> None:
                text = outer._page()
                self.set_header("Cache-Control", "no-store")
                policy = f"{policy_of(text)}; frame-ancestors 'none'"
                self.set_header("Content-Security-Policy", policy)
                self.finish(text)

        class Socket(self._websocket.WebSocketHandler):  # type: ignore[misc, name-defined]
            def open(self, *_: str) -> None:
                outer._send(outer._greeting(), self)
                outer._pages.add(self)
                outer.opened.set()

            async def on_message(self, message: str | bytes) -> None:
                with contextlib.suppress(ValueError, RecursionError):
                    given = json.loads(message)
                    for command, value in given.items() if isinstance(given, dict) else ():
                        outer._keep(command, value)
                await asyncio.sleep(_SPARE)  # the next one is read then: none can flood a run

            def on_close(self) -> None:
                outer._pages.discard(self)

        application = self._web.Application(websocket_max_message_size=_LONGEST, **_ALIVE)
        key = re.escape(self._key)
        # not to pages of other sites that had their name point to this machine
        served = [("/", NoKey), (f"/{key}/", Page), (f"/{key}/socket", Socket)]
        application.add_handlers(_HOSTS, served)
        server = package_of("view", "tornado.httpserver").HTTPServer(application)
        server.add_socket(self._socket)
        await self._closing.wait()
        server.stop()
        for page in list(self._pages):
            page.close()
        await server.close_all_connections()

    def _send(self, message: str, *pages: Any) -> None:
        for page in pages or list(self._pages):
            with contextlib.suppress(self._websocket.WebSocketClosedError):  # it is gone
                page.write_message(message).add_done_callback(lambda sent: sent.exception())


def _bound(port: int | None) -> socket.socket:
    """Return a socket that listens at a port, by default the usual one or else any free one."""
    if port is not None and not (type(port) is int and 0 < port < 65536):
        raise InvalidInputError(f"port must be a number from 1 to 65535, got {port!r}", given=port)
    for wanted in (_PORT, 0) if port is None else (port,):
        try:
            listening = socket.create_server((_HOST, wanted))  # one that may be bound again at once
        except OSError as error:
            reason = error
        else:
            listening.setblocking(False)
            return listening
    message = f"port must be free, or left out for any that is, got {port}: {reason}"
    raise InvalidInputError(message, given=port)
