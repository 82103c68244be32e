"""A session in browsers: a server sends pictures and readings, and receives events, on the loopback interface only.

Server and session share a thread, because Taichi holds Python's global lock while a kernel runs. Decision 0032 explains
the choice of Tornado.
"""

from __future__ import annotations

import asyncio
import errno
import hmac
import io
import json
import secrets
import socket
import time
from collections import deque
from collections.abc import Callable, Collection, Iterator
from importlib.resources import files
from typing import Any, cast

import numpy as np
from PIL import Image
from tornado.http1connection import HTTP1ServerConnection
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPServerRequest
from tornado.ioloop import IOLoop
from tornado.iostream import IOStream
from tornado.web import Application, HTTPError, RequestHandler
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from taichi_msm.errors import DeviceError, FilesError, Pause
from taichi_msm.runs.media import Picture
from taichi_msm.view import events
from taichi_msm.view.material import MATERIAL, MAX_FACTOR
from taichi_msm.view.origin import parse_origin
from taichi_msm.view.session import Session
from taichi_msm.view.tools import PositionControlledTool

ADDRESS = "127.0.0.1"

# Media types by the path of a request after the token, which is the name of a file; empty for index.html.
PAGE = {"": "text/html", "style.css": "text/css", "view.js": "text/javascript"}

HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:; "
    "connect-src 'self'; frame-ancestors 'self'",
    "Referrer-Policy": "no-referrer",
    "Server": "taichi-msm",
    "X-Content-Type-Options": "nosniff",
}

# Largest number of unacknowledged pictures of a page, which limits the lag of a slow connection.
MAX_UNREAD_PICTURES = 3

MAX_PAGES = 16

# Largest number of open connections, including pages.
MAX_CONNECTIONS = 64

# Longest duration of a connection that is not a page's [s].
MAX_REQUEST_S = 10.0

# Largest number of events that wait to be handled.
MAX_EVENTS = 500

# Number of invalid messages after which a page is disconnected.
MAX_INVALID_MESSAGES = 20

# Largest number of messages that wait for a page to read; further ones are dropped.
MAX_UNSENT_MESSAGES = 32

# Shortest wait for events between two pictures [s].
MIN_WAIT_S = 0.001

# Longest delay behind real time that the session catches up [s].
MAX_DELAY_S = 0.1

# Longest time of stepping, and of handling events, between two pictures, even if more are due [s].
MAX_STEPPING_S = 0.03

# Events that save a file.
SAVES = (events.Key("p"), events.Key("w"))


def listen(port: int) -> socket.socket:
    """Return a listening, non-blocking socket at a port of the loopback interface; 0 for a free port."""
    try:
        listener = socket.create_server((ADDRESS, port))
    except OSError as error:
        reason = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
        raise DeviceError(f"--port {port}: {reason}; take another, or leave --port out for a free one") from None
    listener.setblocking(False)
    return listener


class Server:
    """Server of a session to pages in browsers. The page that has been open longest steers; the others watch.

    `origins` are those of pages behind a proxy; origins of the loopback interface are always permitted. `warn` receives
    lines for the user.
    """

    def __init__(
        self,
        session: Session,
        listener: socket.socket,
        title: str,
        origins: Collection[str] = (),
        warn: Callable[[str], None] = lambda line: None,
    ) -> None:
        self._session, self._listener, self._title, self._warn = session, listener, title, warn
        self._origins = {parse_origin(origin) for origin in origins}
        self._port, self._token = listener.getsockname()[1], secrets.token_urlsafe(24)
        self.url = f"http://{ADDRESS}:{self._port}/{self._token}/"
        self.pages: list[_Connection] = []  # the first one steers
        self._events: deque[events.Event] = deque()
        self._handled = 0
        # Last picture, as drawn and as JPEG.
        self._picture: Picture | None = None
        self._jpeg = b""

    async def run(self, pause: Pause) -> None:
        """Serve the session until the page that steers quits; `pause` is called before every picture."""
        handlers: list[Any] = [(r"/[^/]+/socket", _Connection, {"server": self}), (r".*", _Page, {"server": self})]
        application = Application(
            handlers,
            log_function=lambda handler: None,
            websocket_max_message_size=events.MAX_BYTES,
            websocket_ping_interval=20,
        )
        http = _BoundedServer(application, max_body_size=events.MAX_BYTES)
        http.warn = self._warn
        http.add_socket(self._listener)
        try:
            await self._run(pause)
        finally:
            http.stop()
            if dropped := sum(event in SAVES for event in self._events):
                self._warn(f"{dropped} queued saves were dropped")
            for page in self.pages:
                page.send(json.dumps({"ended": True}))
                page.close(1001)
            await asyncio.sleep(0.1)  # The pages receive the message.
            await http.close_all_connections()

    def permits(self, request: HTTPServerRequest) -> bool:
        """Return whether a request has the token, and no origin or a permitted one."""
        token = request.path.lstrip("/").partition("/")[0]
        header = request.headers.get("Origin")
        is_permitted = header is None or self._permits_origin(header, request.host)
        return hmac.compare_digest(token.encode("utf-8", "replace"), self._token.encode()) and is_permitted

    def _permits_origin(self, header: str, host: str) -> bool:
        """Return whether an origin is permitted, this server, or a loopback port that `ssh -L` forwards to it."""
        origin, forwarded = parse_origin(header), parse_origin(f"http://{host}")
        if origin is None:
            return False
        is_loopback = origin.scheme == "http" and origin.host in {ADDRESS, "localhost", "[::1]"}
        return origin in self._origins or (is_loopback and origin.port in (self._port, forwarded and forwarded.port))

    def connect(self, page: _Connection) -> None:
        """Add a page, and send it a description of the session."""
        session = self._session
        material = [
            {"key": key, "name": MATERIAL[key][0], "unit": MATERIAL[key][1], "initial": initial}
            for key, (_, initial) in session.material().items()
        ]
        self.pages.append(page)
        description = {
            "title": self._title,
            "size": session.viewport.render.size,
            "strength_step": events.STRENGTH_STEP,
            "material": material,
            "max_factor": MAX_FACTOR,
            "keys": events.POINTER | events.KEYS,
        }
        page.send(json.dumps(description))

    def disconnect(self, page: _Connection) -> None:
        """Remove a page, if present; if it steered, release the tool and let the next page steer."""
        if page not in self.pages:
            return
        if page is self.pages[0]:
            self._events.append(events.Release())
        self.pages.remove(page)

    def receive(self, page: _Connection, message: str | bytes) -> None:
        """Queue the event of a message if its page steers; reply to an invalid message with its error."""
        try:
            event = events.parse_message(message)
        except (ValueError, RecursionError) as error:
            page.invalid += 1
            if page.invalid < MAX_INVALID_MESSAGES:
                page.send(json.dumps({"error": str(error)}))
            else:
                self._reject(page, "too many invalid messages")
            return
        if event is None:
            page.unread = max(0, page.unread - 1)
        elif page is self.pages[0]:
            if len(self._events) < MAX_EVENTS:
                self._events.append(event)
            else:
                self._reject(page, "too many events")

    def _reject(self, page: _Connection, reason: str) -> None:
        page.close(1008, reason)
        self.disconnect(page)

    async def _run(self, pause: Pause) -> None:
        session = self._session
        pacing = Pacing(session.frame_rate, time.perf_counter)
        while True:
            pause()
            await asyncio.sleep(max(MIN_WAIT_S, pacing.delay_s()) if self.pages else 0.05)
            end = time.perf_counter() + MAX_STEPPING_S
            while self._events and time.perf_counter() < end:
                event = self._events.popleft()
                if event == events.QUIT:
                    return
                if event == events.SWITCH_TOOL:
                    await self._announce(events.COMPILING)
                try:
                    session.handle(event)
                except FilesError as error:
                    # A full disk must not end the session.
                    session.show_notice(str(error))
                self._handled += 1
            if not self.pages:
                continue
            for _ in pacing.due_frames():
                self._advance()
            if not session.viewport.is_compiled:
                await self._announce(events.COMPILING)
            self._show(pacing.status())

    def _advance(self) -> None:
        """Advance the session by a frame, and queue its readings for every page."""
        session, before = self._session, self._session.frame
        session.advance()
        if session.frame != before:
            time_s = session.frame / session.frame_rate
            reading = [float(f"{value:.5g}") for value in (time_s, session.tool_force(), session.depth())]
            for page in self.pages:
                page.readings.append(reading)

    def _show(self, pacing: str) -> None:
        """Send the state, and the picture if it changed, to every page that reads its pictures."""
        ready = [page for page in self.pages if page.unread < MAX_UNREAD_PICTURES and page.unsent == 0]
        if not (ready or self._session.filming):
            return
        picture = self._session.bare_picture()
        if self._picture is None or not np.array_equal(picture, self._picture):
            self._picture, self._jpeg = picture, encode_jpeg(picture)
        state = self._state(pacing)
        for page in ready:
            page_state = {"steers": page is self.pages[0], "readings": list(page.readings)}
            header = json.dumps({**state, **page_state}, allow_nan=False).encode()
            jpeg = b"" if page.jpeg is self._jpeg else self._jpeg
            page.send(len(header).to_bytes(4, "big") + header + jpeg)
            page.jpeg = self._jpeg
            page.unread += 1
            page.readings.clear()

    def _state(self, pacing: str) -> dict[str, Any]:
        session, tool = self._session, self._session.tool
        return {
            "handled": self._handled,
            "time": session.frame / session.frame_rate,
            "watching": len(self.pages) - 1,
            "strength": tool.strength,
            "by_position": isinstance(tool, PositionControlledTool),
            "paused": session.paused,
            "filming": session.filming,
            "light": session.viewport.render.shading != "none",
            "mesh": session.viewport.render.wireframe,
            "notice": session.notice,
            "pacing": pacing,
            "material": {key: current for key, (current, _) in session.material().items()},
        }

    async def _announce(self, notice: str) -> None:
        """Show a notice on all pages before the session blocks."""
        for page in self.pages:
            page.send(json.dumps({"notice": notice}))
        await asyncio.sleep(MIN_WAIT_S)


class Pacing:
    """Schedule of frames in real time, for a rate [1/s] and a clock that returns the time [s]."""

    def __init__(self, rate: float, clock: Callable[[], float]) -> None:
        self._rate, self._clock, self._next = rate, clock, clock()
        # Start [s] of each recent picture, and number of frames simulated for it.
        self._pictures: deque[tuple[float, int]] = deque()

    def delay_s(self) -> float:
        """Return the time until the next frame is due [s]."""
        return max(0.0, self._next - self._clock())

    def due_frames(self) -> Iterator[int]:
        """Yield the due frames, numbered from 0: the first one, and others within `MAX_STEPPING_S`."""
        start = self._clock()
        self._next = max(self._next, start - MAX_DELAY_S)
        count = 0
        while self._next <= self._clock() and (count == 0 or self._clock() < start + MAX_STEPPING_S):
            self._next += 1 / self._rate
            yield count
            count += 1
        self._pictures.append((start, count))
        # Rate and speed are averages over 1 s.
        while start - self._pictures[0][0] > 1.0:
            self._pictures.popleft()

    def status(self) -> str:
        """Format the rate of pictures, and the speed if it is below 95 % of real time."""
        if len(self._pictures) < 2:
            return ""
        seconds = self._pictures[-1][0] - self._pictures[0][0]
        rate = f"{(len(self._pictures) - 1) / seconds:.0f} pictures/s"
        # The last picture is excluded, as its duration is not known yet.
        speed = sum(count for _, count in list(self._pictures)[:-1]) / self._rate / seconds
        return rate if speed >= 0.95 else f"{rate}  ·  too slow: {speed:.2f} x real time"


def encode_jpeg(picture: Picture) -> bytes:
    """Encode a picture, shape (height, width, 3), as JPEG."""
    file = io.BytesIO()
    # 512 x 512 pixels of tissue take 2 ms and 33 kB.
    Image.fromarray(picture).save(file, "JPEG", quality=85)
    return file.getvalue()


class _BoundedServer(HTTPServer):
    """HTTP server with at most `MAX_CONNECTIONS`, which closes those without a page after `MAX_REQUEST_S`."""

    # Called with a line when the first connection is refused.
    warn: Callable[[str], None]

    def __init__(self, *arguments: Any, **options: Any) -> None:
        super().__init__(*arguments, **options)
        # All connections, some closed, and the deadlines of those that are not a page's.
        self._streams: list[IOStream] = []
        self._deadlines: dict[IOStream, object] = {}
        self._has_warned = False

    def handle_stream(self, stream: IOStream, address: tuple[Any, ...]) -> None:
        """Serve a connection, or close it at once."""
        self._streams = [each for each in self._streams if not each.closed()]
        if len(self._streams) < MAX_CONNECTIONS:
            self._streams.append(stream)
            self._deadlines[stream] = IOLoop.current().call_later(MAX_REQUEST_S, stream.close)
            super().handle_stream(stream, address)
            return
        stream.close()
        if not self._has_warned:
            self._has_warned = True
            limit = f"further ones are refused; those without a page end after {MAX_REQUEST_S:g} s"
            self.warn(f"{MAX_CONNECTIONS} connections are open, {limit}")

    def on_close(self, server_conn: object) -> None:
        """Remove the deadline of a connection that has closed or become a page's."""
        super().on_close(server_conn)
        IOLoop.current().remove_timeout(self._deadlines.pop(cast(HTTP1ServerConnection, server_conn).stream))

    async def close_all_connections(self) -> None:
        """Close all connections, also those of pages."""
        for stream in self._streams:
            stream.close()
        await super().close_all_connections()


class _Guarded(RequestHandler):
    """Handler that rejects requests without permission."""

    def initialize(self, server: Server) -> None:
        self.server = server

    def prepare(self) -> None:
        if not self.server.permits(self.request):
            raise HTTPError(403)

    def set_default_headers(self) -> None:
        for name, value in HEADERS.items():
            self.set_header(name, value)


class _Page(_Guarded):
    """Handler of the page's files."""

    def get(self) -> None:
        token, slash, name = self.request.path.lstrip("/").partition("/")
        if not slash:
            self.redirect(f"{token}/")
            return
        if name not in PAGE:
            raise HTTPError(404)
        self.set_header("Content-Type", f"{PAGE[name]}; charset=utf-8")
        self.write((files("taichi_msm.view") / "page" / (name or "index.html")).read_bytes())


class _Connection(_Guarded, WebSocketHandler):
    """Connection of a page.

    Attributes:
        unread: number of sent pictures that the page has not acknowledged.
        unsent: number of messages that wait for the page to read.
        invalid: number of invalid messages of the page.
        readings: time [s], force [N] and depth [m] of each frame since the last picture.
        jpeg: last picture sent to the page.
    """

    def open(self) -> None:
        self.unread = self.unsent = self.invalid = 0
        self.readings: deque[list[float]] = deque(maxlen=1000)
        self.jpeg = b""
        self.set_nodelay(True)
        if len(self.server.pages) < MAX_PAGES:
            self.server.connect(self)
        else:
            self.close(1013, "too many pages")

    def on_message(self, message: str | bytes) -> None:
        if self in self.server.pages:
            self.server.receive(self, message)

    def on_close(self) -> None:
        self.server.disconnect(self)

    def check_origin(self, origin: str) -> bool:  # noqa: ARG002
        """Permit the origins that `prepare` has checked."""
        return True

    def send(self, message: str | bytes) -> None:
        """Send a message; ignore a page that has left, or does not read."""
        if self.unsent >= MAX_UNSENT_MESSAGES:
            return
        try:
            sent = self.write_message(message, binary=isinstance(message, bytes))
        except WebSocketClosedError:
            return
        self.unsent += 1
        sent.add_done_callback(self._count_sent)

    def _count_sent(self, sent: asyncio.Future[None]) -> None:
        self.unsent -= 1
        # Without this call asyncio logs the exception.
        if not sent.cancelled():
            sent.exception()
