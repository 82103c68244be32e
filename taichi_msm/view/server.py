"""A session in browsers: a server sends pictures and readings, and receives the messages of `events`.

Server and session share a thread, because Taichi holds Python's global lock while a kernel runs.

A picture is a binary message: the length of a header in 4 bytes, the header, and a JPEG, which is missing if the
picture has not changed. The header is JSON: the state of the session (`Server._state`), whether the page steers, asks
to steer or was refused, whether another page asks, and the readings since the last picture. Texts are JSON as well: a
description of the session at the start, notices before the session blocks, errors of messages, and the end.
"""

from __future__ import annotations

import asyncio
import io
import json
import secrets
import time
from collections import deque
from collections.abc import Callable, Iterator
from typing import Any

import numpy as np
from PIL import Image
from tornado.web import HTTPError
from tornado.websocket import WebSocketClosedError, WebSocketHandler

from taichi_msm.errors import FilesError, Pause
from taichi_msm.runs.media import Picture
from taichi_msm.view import events
from taichi_msm.view.material import MATERIAL, MAX_FACTOR
from taichi_msm.view.resolution import Resolution
from taichi_msm.view.session import Session
from taichi_msm.view.tools import PositionControlledTool
from taichi_msm.view.web import Address, Guarded, PageFile, serving

# Largest number of unacknowledged pictures of a page, which limits the lag of a slow connection.
MAX_UNREAD_PICTURES = 3

MAX_PAGES = 16

# Time in which a reloaded page that steered gets the tool back [s].
RETURN_S = 10.0

# Time in which the steering page can refuse to give the tool away [s].
ANSWER_S = 5.0

# Number of readings that the plots of a new page show, a minute at 50 frames per second.
MAX_READINGS = 3000

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

# Number of saved files that pages list.
SHOWN_DOWNLOADS = 4

# Events that save a file.
SAVES = (events.Key("p"), events.Key("w"))


class Server:
    """Server of a session to pages in browsers. The page that has been open longest steers; the others watch.

    A page that asks to steer does so after `ANSWER_S`, unless the steering page refuses, which it can once per page.
    `warn` receives lines for the user. With `has_scenes`, pages can leave the session for another scene.
    """

    def __init__(
        self,
        session: Session,
        address: Address,
        title: str,
        warn: Callable[[str], None] = lambda line: None,
        *,
        has_scenes: bool = False,
    ) -> None:
        self._session, self._address, self._title, self._warn = session, address, title, warn
        self._has_scenes, self.url = has_scenes, address.url
        self.pages: list[_Connection] = []  # the first one steers
        # Page that asks to steer, and the end of the time for an answer [s].
        self._asking: _Connection | None = None
        self._answer_end = 0.0
        # Name of the page that steered and was closed, and the end of the time in which it gets the tool back [s].
        self._closed, self._return_end = "", 0.0
        self._events: deque[events.Event | events.Scenes] = deque()
        self._handled = 0
        # Readings since the last reset.
        self._readings: deque[list[float]] = deque(maxlen=MAX_READINGS)
        self._resolution = Resolution(session.viewport.render.size)
        # Last picture, as drawn and as JPEG.
        self._picture: Picture | None = None
        self._jpeg = b""

    async def run(self, pause: Pause) -> bool:
        """Serve the session until the page that steers quits; return whether it wants another scene.

        `pause` is called before every picture.
        """
        address, wants_scenes = {"address": self._address}, False
        handlers = [
            (r"/[^/]+/socket", _Connection, {**address, "server": self}),
            (r"/[^/]+/saved/(.+)", _Download, {**address, "session": self._session}),
            (r".*", PageFile, address),
        ]

        def close() -> None:
            if dropped := sum(event in SAVES for event in self._events):
                self._warn(f"{dropped} queued saves were dropped")
            for page in self.pages:
                page.send(json.dumps({"scenes" if wants_scenes else "ended": True}))
                page.close(1001)

        async with serving(self._address, handlers, self._warn, close):
            wants_scenes = await self._run(pause)
        return wants_scenes

    def connect(self, page: _Connection) -> None:
        """Add a page, and send it a description of the session."""
        session = self._session
        material = [
            {"key": key, "name": MATERIAL[key][0], "unit": MATERIAL[key][1], "initial": initial}
            for key, (_, initial) in session.material().items()
        ]
        if page.name == self._closed and time.perf_counter() < self._return_end:
            self._give(page)
        else:
            self.pages.append(page)
        page.readings.extend(self._readings)
        description = {
            "title": self._title,
            "size": session.viewport.render.size,
            "strength_step": events.STRENGTH_STEP,
            "material": material,
            "max_factor": MAX_FACTOR,
            "keys": events.POINTER | events.KEYS,
            "has_scenes": self._has_scenes,
        }
        page.send(json.dumps(description))

    def disconnect(self, page: _Connection) -> None:
        """Remove a page, if present; if it steered, release the tool and let the next page steer."""
        if page not in self.pages:
            return
        steered = page is self.pages[0]
        self.pages.remove(page)
        if page is self._asking:
            self._asking = None
        if steered and self._asking:
            self._give(self._asking)
        elif steered:
            self._events.append(events.Release())
            self._closed, self._return_end = page.name, time.perf_counter() + RETURN_S

    def _give(self, page: _Connection) -> None:
        """Release the tool, and let a page steer."""
        self._events.append(events.Release())
        self.pages = [page, *(each for each in self.pages if each is not page)]
        self._asking, self._return_end, page.was_refused = None, 0.0, False

    def receive(self, page: _Connection, message: str | bytes) -> None:
        """Handle a message of a page, or queue its event if it steers; reply to an invalid message with its error."""
        try:
            parsed = events.parse_message(message)
        except (ValueError, RecursionError) as error:
            page.invalid += 1
            if page.invalid < MAX_INVALID_MESSAGES:
                page.send(json.dumps({"error": str(error)}))
            else:
                self._reject(page, "too many invalid messages")
            return
        steers = page is self.pages[0]
        match parsed:
            case events.Shown():
                page.unread = max(0, page.unread - 1)
            case events.Width(pixels):
                page.width = pixels
            case events.TakeOver():
                self._ask(page)
            case events.Answer(gives):
                if steers and self._asking:
                    self._answer(self._asking, gives)
            case _ if steers and len(self._events) >= MAX_EVENTS:
                self._reject(page, "too many events")
            case _ if steers:
                self._events.append(parsed)

    def _ask(self, page: _Connection) -> None:
        """Ask the steering page to give the tool to a page; if it has refused before, do not ask."""
        if page.was_refused:
            self._give(page)
        elif self._asking is None and page is not self.pages[0]:
            self._asking, self._answer_end = page, time.perf_counter() + ANSWER_S

    def _answer(self, asking: _Connection, gives: bool) -> None:
        if gives:
            self._give(asking)
        else:
            asking.was_refused, self._asking = True, None

    def _reject(self, page: _Connection, reason: str) -> None:
        page.close(1008, reason)
        self.disconnect(page)

    async def _run(self, pause: Pause) -> bool:
        session = self._session
        pacing = Pacing(session.frame_rate, time.perf_counter)
        while True:
            pause()
            await asyncio.sleep(max(MIN_WAIT_S, pacing.delay_s()) if self.pages else 0.05)
            end = time.perf_counter() + MAX_STEPPING_S
            while self._events and time.perf_counter() < end:
                event = self._events.popleft()
                if isinstance(event, events.Scenes):
                    if self._has_scenes:
                        return True
                    continue
                if event == events.QUIT:
                    return False
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
            if self._asking and time.perf_counter() > self._answer_end:
                self._give(self._asking)
            for _ in pacing.due_frames():
                self._advance()
            if not session.viewport.is_compiled:
                await self._announce(events.COMPILING)
            self._show(*pacing.speed())

    def _advance(self) -> None:
        """Advance the session by a frame, and queue its readings for every page."""
        session, before = self._session, self._session.frame
        session.advance()
        if session.frame != before:
            values = [float(f"{value:.5g}") for value in (session.tool_force(), session.depth())]
            reading = [round(session.frame / session.frame_rate, 6), *values]
            if before == 0:
                self._readings.clear()
            self._readings.append(reading)
            for page in self.pages:
                page.readings.append(reading)

    def _show(self, rate: float, speed: float) -> None:
        """Send the state, and the picture if it changed, to every page that reads its pictures."""
        ready = [page for page in self.pages if page.unread < MAX_UNREAD_PICTURES and page.unsent == 0]
        if not (ready or self._session.filming):
            return
        self._resolution.set_width(self.pages[0].width)
        start = time.perf_counter()
        picture = self._session.bare_picture(self._resolution.size)
        if self._picture is None or not np.array_equal(picture, self._picture):
            self._picture, self._jpeg = picture, encode_jpeg(picture)
            if not self._session.filming:
                self._resolution.measure(time.perf_counter() - start, self._session.load)
        state = {**self._state(), "rate": round(rate), "speed": round(speed, 2)}
        for page in ready:
            steers = page is self.pages[0]
            page_state = {
                "steers": steers,
                "is_asked": steers and self._asking is not None,
                "asks": page is self._asking,
                "was_refused": page.was_refused,
                "readings": list(page.readings),
            }
            header = json.dumps({**state, **page_state}, allow_nan=False).encode()
            jpeg = b"" if page.jpeg is self._jpeg else self._jpeg
            page.send(len(header).to_bytes(4, "big") + header + jpeg)
            page.jpeg = self._jpeg
            page.unread += 1
            page.readings.clear()

    def _state(self) -> dict[str, Any]:
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
            "saved": list(session.captures.downloads)[-SHOWN_DOWNLOADS:],
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

    def speed(self) -> tuple[float, float]:
        """Return pictures per second, and simulated per real time; both are 0 at the start."""
        if len(self._pictures) < 2:
            return 0.0, 0.0
        seconds = self._pictures[-1][0] - self._pictures[0][0]
        # The last picture is excluded, as its duration is not known yet.
        frames = sum(count for _, count in list(self._pictures)[:-1])
        return (len(self._pictures) - 1) / seconds, frames / self._rate / seconds


def encode_jpeg(picture: Picture) -> bytes:
    """Encode a picture, shape (height, width, 3), as JPEG."""
    file = io.BytesIO()
    # 512 x 512 pixels of tissue take 2 ms and 33 kB.
    Image.fromarray(picture).save(file, "JPEG", quality=85)
    return file.getvalue()


class _Download(Guarded):
    """Handler of the files that the session has saved."""

    def initialize(self, address: Address, session: Session) -> None:  # type: ignore[override]
        super().initialize(address)
        self.captures = session.captures

    def get(self, name: str) -> None:
        if name not in self.captures.downloads:
            raise HTTPError(404)
        try:
            content = self.captures.read_download(name)
        except FilesError:
            raise HTTPError(404) from None
        self.settings["lift_deadline"](self.request)
        self.set_header("Connection", "close")
        self.set_header("Content-Type", "application/octet-stream")
        self.set_header("Content-Disposition", "attachment")
        self.write(content)


class _Connection(Guarded, WebSocketHandler):
    """Connection of a page.

    Attributes:
        name: random name that a page keeps when it is reloaded.
        width: width of the picture on the page's screen [px].
        was_refused: whether the steering page has refused to give it the tool.
        unread: number of sent pictures that the page has not acknowledged.
        unsent: number of messages that wait for the page to read.
        invalid: number of invalid messages of the page.
        readings: time [s], force [N] and depth [m] of each frame since the last picture.
        jpeg: last picture sent to the page.
    """

    def initialize(self, address: Address, server: Server) -> None:  # type: ignore[override]
        super().initialize(address)
        self.server = server

    def open(self) -> None:
        self.name = self.get_query_argument("name", secrets.token_urlsafe(8))
        self.width, self.was_refused = 0.0, False
        self.unread = self.unsent = self.invalid = 0
        self.readings: deque[list[float]] = deque(maxlen=MAX_READINGS)
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
