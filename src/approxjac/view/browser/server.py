"""`PageServer`: one page for browsers on this machine, and messages to and from it."""

from __future__ import annotations

import asyncio
import contextlib
import json
import re
import secrets
import socket
import threading
from collections.abc import Callable
from typing import Any

from approxjac.errors import InvalidInputError
from approxjac.extras import package_of

_HOST = "127.0.0.1"  # nobody else on the network gets to move an arm
_HOSTS = r"(127\.0\.0\.1|localhost)"
_PORT = 7007
_BEHIND = 900  # messages that a page has not taken yet
_LONGEST = 20_000  # of a message from a page [byte]
_SPARE = 0.005  # between messages of one page [s]; a mouse sends one in 50 ms
_KINDS = 32  # of wishes that wait; of each kind the latest
_PAGES = 16  # that are open at once
_NO_KEY = "Open the address that the program printed: it ends with a key, which this one lacks."
_CLOSING = 2.0  # for what was sent to arrive [s]


class PageServer:
    """Serves a page from a thread of its own, to those who know its address.

    The address holds a key, so that no other program or page on this machine finds it. Messages
    of pages are wishes, {"what": value}: of each kind the latest is kept until it is asked for.

    Args:
        page: Makes the page, whenever a browser asks for it.
        greeting: Makes the message that a page gets first, when it is there.
        port: To serve at; 7007 by default, or any free one if that is taken.
    """

    def __init__(
        self, page: Callable[[], str], greeting: Callable[[], str], port: int | None = None
    ) -> None:
        self._web = package_of("view", "tornado.web")
        self._websocket = package_of("view", "tornado.websocket")
        self._page = page
        self._greeting = greeting
        self._socket = _bound(port)
        found = self._socket.getsockname()[1]
        self.taken = _PORT if port is None and found != _PORT else None  # by another program
        self._key = secrets.token_urlsafe(12)
        self.url = f"http://{_HOST}:{found}/{self._key}/"
        self.opened = threading.Event()  # by the first page
        self._wishes: dict[str, tuple[str, Any]] = {}
        self._lock = threading.Lock()
        self._pages: set[Any] = set()
        self._loop = asyncio.new_event_loop()
        self._closing = asyncio.Event()
        self._thread = threading.Thread(target=self._serve, name="approxjac page", daemon=True)
        self._thread.start()

    def send(self, message: str) -> None:
        """Send a message to all pages, without waiting for them."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._broadcast, message)

    def received(self) -> list[tuple[str, Any]]:
        """Return the latest wish of each kind, its name and value, since this was asked last."""
        with self._lock:
            wishes, self._wishes = list(self._wishes.values()), {}
        return wishes

    def _keep(self, wish: str, value: Any) -> None:
        # points of an image are moved one by one
        kind = f"{wish} {value[:1]}" if wish == "pixel" and isinstance(value, list) else wish
        with self._lock:
            self._wishes.pop(kind, None)  # the latest are the last
            self._wishes[kind] = wish, value
            while len(self._wishes) > _KINDS:
                del self._wishes[next(iter(self._wishes))]

    def close(self) -> None:
        """Stop serving, after what was sent has left."""
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._closing.set)
            self._thread.join(_CLOSING)

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
                self.set_header("Cache-Control", "no-store")
                self.finish(outer._page())

        class Socket(self._websocket.WebSocketHandler):  # type: ignore[misc, name-defined]
            def open(self, *_: str) -> None:
                self.waiting = 0
                if len(outer._pages) >= _PAGES:
                    self.close(reason="too many pages are open")
                    return
                outer._send(self, outer._greeting())
                outer._pages.add(self)
                outer.opened.set()

            async def on_message(self, message: str | bytes) -> None:
                with contextlib.suppress(ValueError, RecursionError):
                    given = json.loads(message)
                    for wish, value in given.items() if isinstance(given, dict) else ():
                        outer._keep(wish, value)
                await asyncio.sleep(_SPARE)  # the next one is read then: none can flood a run

            def on_close(self) -> None:
                outer._pages.discard(self)

        application = self._web.Application(websocket_max_message_size=_LONGEST)
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

    def _broadcast(self, message: str) -> None:
        for page in list(self._pages):
            self._send(page, message)

    def _send(self, page: Any, message: str) -> None:
        """Send to one page; leave one that is gone, or that does not keep up."""

        def sent(future: Any) -> None:
            page.waiting -= 1
            if future.exception() is not None:
                self._pages.discard(page)

        try:
            future = asyncio.ensure_future(page.write_message(message))
        except self._websocket.WebSocketClosedError:
            self._pages.discard(page)
            return
        page.waiting += 1
        future.add_done_callback(sent)
        if page.waiting > _BEHIND:
            self._pages.discard(page)
            page.close()


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
    raise InvalidInputError(
        f"port must be free, or left out for any that is, got {port}: {reason}", given=port
    )
