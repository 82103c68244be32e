"""A session in browsers: access, steering, messages, and the page in Chromium."""

from __future__ import annotations

import asyncio
import json
import logging
import re
import signal
import socket
from collections.abc import AsyncIterator, Callable, Coroutine, Iterator, Sequence
from contextlib import ExitStack, asynccontextmanager, suppress
from functools import partial, wraps
from io import BytesIO
from itertools import product
from pathlib import Path
from time import monotonic
from typing import Any, ClassVar, get_args
from urllib.parse import urlsplit
from zipfile import ZipFile

import numpy as np
import pytest
from PIL import Image
from tornado.httpclient import AsyncHTTPClient, HTTPClientError, HTTPRequest
from tornado.websocket import WebSocketClientConnection, WebSocketClosedError, websocket_connect

from taichi_msm import load_scene
from taichi_msm.cli.main import main
from taichi_msm.errors import Pause
from taichi_msm.runs.media import Picture
from taichi_msm.system.runtime import Device
from taichi_msm.view import server as server_module
from taichi_msm.view import web as web_module
from taichi_msm.view.chooser import choose
from taichi_msm.view.events import KEYS, MAX_BYTES, Event, parse_message
from taichi_msm.view.material import MATERIAL
from taichi_msm.view.recording import Captures
from taichi_msm.view.resolution import LEVELS
from taichi_msm.view.server import (
    MAX_INVALID_MESSAGES,
    MAX_PAGES,
    MAX_UNREAD_PICTURES,
    MAX_UNSENT_MESSAGES,
    Server,
)
from taichi_msm.view.session import Session
from taichi_msm.view.web import FILES, Address
from tests.conftest import Program
from tests.golden import Messages
from tests.view.chromium import PROGRAM, chromium
from tests.view.test_session import TILTED

WAIT_S = 20.0


@pytest.fixture
def session(small: Path, device: Device) -> Iterator[Session]:
    """A session with a picture of 120 x 100 pixels, with tissue at its centre."""
    with ExitStack() as stack:
        scene = load_scene("small.yaml", TILTED)
        yield stack.enter_context(Session(scene, Captures(Path("captures"), "small.yaml"), threads=2))


@asynccontextmanager
async def served(
    session: Session, *origins: str, warn: Callable[[str], None] = lambda line: None
) -> AsyncIterator[Server]:
    with Address(0, origins) as address:
        server = Server(session, address, "small.yaml", warn)
        running = asyncio.create_task(server.run(lambda: None))
        try:
            yield server
        finally:
            running.cancel()
            with pytest.raises(asyncio.CancelledError):
                await running


class Client:
    """A page without a browser, which acknowledges every picture."""

    opened: ClassVar[list[WebSocketClientConnection]] = []

    def __init__(self, connection: WebSocketClientConnection) -> None:
        self.connection = connection
        self.opened.append(connection)
        self.texts: list[dict[str, Any]] = []
        self.jpeg = b""

    async def send(self, *message: Any) -> None:
        await self.connection.write_message(json.dumps(message))

    async def read(self) -> dict[str, Any] | None:
        """Read a message; return its state, or None if it has no state."""
        message = await asyncio.wait_for(self.connection.read_message(), WAIT_S)
        assert message is not None, f"closed: {self.connection.close_code}"
        if isinstance(message, str):
            self.texts.append(json.loads(message))
            return None
        with suppress(WebSocketClosedError):
            await self.send("shown")
        length = int.from_bytes(message[:4], "big")
        self.jpeg = message[4 + length :] or self.jpeg
        state: dict[str, Any] = json.loads(message[4 : 4 + length])
        return state

    async def until(self, met: Callable[[dict[str, Any]], bool], seconds: float = WAIT_S) -> dict[str, Any]:
        """Read until a state meets a condition, for a limited time."""
        deadline = monotonic() + seconds
        while monotonic() < deadline:
            if (state := await self.read()) and met(state):
                return state
        raise TimeoutError


async def connect(server: Server, name: str = "", **headers: str) -> Client:
    url = server.url.replace("http", "ws") + "socket" + (f"?name={name}" if name else "")
    return Client(await websocket_connect(HTTPRequest(url, headers=headers)))


async def status(url: str, **headers: str) -> int:
    try:
        return (await AsyncHTTPClient().fetch(url, headers=headers)).code
    except HTTPClientError as error:
        return error.code


@pytest.fixture(autouse=True)
def no_log(caplog: pytest.LogCaptureFixture) -> Iterator[None]:
    """Require that nothing is logged, such as a traceback."""
    caplog.set_level(logging.WARNING)
    yield
    assert not caplog.get_records("call")


def run(scenario: Coroutine[Any, Any, None]) -> None:
    """Run a scenario, and close its clients."""

    async def with_clients() -> None:
        try:
            await scenario
        finally:
            while Client.opened:
                connection = Client.opened.pop()
                connection.close()
                # The end of a connection is read only once, by the scenario or here.
                with suppress(TimeoutError):
                    while connection.close_code is None:
                        if await asyncio.wait_for(connection.read_message(), WAIT_S) is None:
                            break

    asyncio.run(with_clients())


def scenario(test: Callable[..., Coroutine[Any, Any, None]]) -> Callable[..., None]:
    """Convert a coroutine function to a test."""

    @wraps(test)
    def synchronous(*arguments: Any, **fixtures: Any) -> None:
        run(test(*arguments, **fixtures))

    return synchronous


@scenario
async def test_requests_need_the_token_and_a_known_origin(session: Session) -> None:
    async with served(session, "https://Hub.example.org:443/") as server:
        root, _, token = server.url.rstrip("/").rpartition("/")
        assert len(token) >= 32
        port = root.rpartition(":")[2]
        for name in ("", *FILES):
            assert await status(f"{server.url}{name}") == 200
        assert await status(server.url.rstrip("/")) == 200, "it is redirected to the page"
        for path in ("x", "socket/", "../view.js", "%2e%2e/server.py", "page/index.html"):
            assert await status(server.url + path) in (403, 404), path
        for path in ("/", f"/{token[:-1]}/", f"/{token}0/", "/socket", "/%ff/", f"/x/{token}/"):
            assert await status(root + path) == 403, path
        with pytest.raises(HTTPClientError, match="403"):
            await websocket_connect(f"ws://127.0.0.1:{port}/{token[1:]}/socket")
        loopback = [f"http://{name}:{port}" for name in ("127.0.0.1", "localhost", "[::1]")]
        for origin in (*loopback, "https://hub.example.org"):
            client = await connect(server, Origin=origin)
            assert await status(server.url, Origin=origin) == 200
            client.connection.close()
        for origin in ("https://evil.example.org", "null", "http://localhost:1", f"https://localhost:{port}", ""):
            assert await status(server.url, Origin=origin) == 403, origin
            with pytest.raises(HTTPClientError, match="403"):
                await connect(server, Origin=origin)
        # The port that ssh -L forwards, and DNS rebinding by an attacker.
        assert await status(server.url, Origin="http://localhost:9", Host="localhost:9") == 200
        assert await status(server.url, Origin="http://evil.org:9", Host="evil.org:9") == 403


def test_page_has_relative_urls() -> None:
    page = Path(main.__code__.co_filename).parents[1] / "view" / "page"
    text = "".join(path.read_text("utf-8") for path in page.iterdir()).replace("http://www.w3.org/2000/svg", "")
    assert not re.search(r"https?://|(src|href)=\"/", text)


@scenario
async def test_one_page_steers(session: Session) -> None:
    async with served(session) as server:
        first, second = await connect(server), await connect(server)
        await second.send("press", 60, 50)
        state = await second.until(lambda state: state["time"] > 0.1)
        assert (state["steers"], state["watching"], session.tool.engaged) == (False, 1, False)
        await first.send("press", 60, 50)
        await first.until(lambda state: any(depth > 2e-3 for _, _, depth in state["readings"]))
        # The full force acts after 0.2 s.
        pressed = session.frame / session.frame_rate
        state = await first.until(lambda state: state["time"] > pressed + 0.3)
        assert state["steers"]
        time, force, _ = state["readings"][-1]
        assert time == pytest.approx(state["time"], rel=1e-4)
        assert force == pytest.approx(session.tool_force(), rel=1e-4)
        assert force > 0
        await second.until(lambda state: any(depth > 2e-3 for _, _, depth in state["readings"]))
        first.connection.close()
        await second.until(lambda state: state["steers"])
        assert not session.tool.engaged, "the tool is released"
        second.connection.close()
        await asyncio.sleep(0.3)
        frame = session.frame
        await asyncio.sleep(0.3)
        assert session.frame == frame, "without a page the session waits"


@scenario
async def test_reloaded_page_steers_again(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    async with served(session) as server:
        first, watching = await connect(server, "first"), await connect(server, "second")
        await watching.until(lambda state: not state["steers"])
        first.connection.close()
        await watching.until(lambda state: state["steers"])
        reloaded = await connect(server, "first")
        await reloaded.until(lambda state: state["steers"])
        await watching.until(lambda state: not state["steers"])
        monkeypatch.setattr(server_module, "RETURN_S", -1.0)
        reloaded.connection.close()
        await watching.until(lambda state: state["steers"])
        late = await connect(server, "first")
        await late.until(lambda state: not state["steers"])


@scenario
async def test_watching_page_takes_over_and_can_be_refused_once(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    async with served(session) as server:
        first, second = await connect(server), await connect(server)
        await first.send("press", 60, 50)
        await first.until(lambda state: state["handled"] == 1)
        await second.send("answer", True)
        await second.send("takeover")
        await second.until(lambda state: state["asks"] and not state["steers"])
        await first.until(lambda state: state["is_asked"])
        await first.send("answer", False)
        await second.until(lambda state: state["was_refused"])
        await second.send("takeover")
        await second.until(lambda state: state["steers"])
        await first.until(lambda state: not state["steers"])
        assert not session.tool.engaged, "the tool is released"
        # Without an answer, the page that asks steers.
        monkeypatch.setattr(server_module, "ANSWER_S", 0.0)
        await first.send("takeover")
        await first.until(lambda state: state["steers"])
        monkeypatch.undo()
        await second.send("takeover")
        state = await second.until(lambda state: state["asks"])
        assert not state["steers"], "a page that has steered can be refused again"


@scenario
async def test_new_page_gets_the_readings_of_every_frame(session: Session) -> None:
    async with served(session) as server:
        first = await connect(server)
        await first.until(lambda state: state["time"] > 0.5)
        watching = await connect(server)
        readings: list[list[float]] = []
        while len(readings) < 40:
            state = await watching.until(lambda state: True)
            readings += state["readings"]
        times = np.array([reading[0] for reading in readings])
        assert times * session.frame_rate == pytest.approx(1 + np.arange(len(times)), abs=1e-3)


@scenario
async def test_saved_files_are_downloaded(session: Session) -> None:
    async with served(session) as server:
        client = await connect(server)
        for key in "pw":
            await client.send("key", key)
        names = (await client.until(lambda state: len(state["saved"]) == 2))["saved"]
        assert names == ["picture-1.png", "session-1.zip"]
        picture, packed = [(await AsyncHTTPClient().fetch(f"{server.url}saved/{name}")).body for name in names]
        assert picture == Path("captures/picture-1.png").read_bytes()
        with ZipFile(BytesIO(packed)) as archive:
            assert sorted(archive.namelist()) == ["session-1.yaml", "speckle.png"]
            assert archive.read("session-1.yaml") == Path("captures/session-1.yaml").read_bytes()
        for name in ("session-1.yaml", "../small.yaml", "..%2Fsmall.yaml", "%2Fetc%2Fpasswd"):
            assert await status(f"{server.url}saved/{name}") == 404, name
        assert await status(f"{server.url}saved/picture-1.png", Origin="https://evil.example.org") == 403
        Path("captures/picture-1.png").unlink()
        assert await status(f"{server.url}saved/picture-1.png") == 404


@scenario
async def test_picture_has_the_pixels_of_the_steering_page(session: Session) -> None:
    async with served(session) as server:
        client, watching = await connect(server), await connect(server)
        await watching.send("width", 1000)
        await client.send("width", 240)
        server._resolution.measure = lambda seconds, load: None  # type: ignore[method-assign]
        server._resolution._level = LEVELS
        sizes = set()
        for _ in range(20):
            await client.until(lambda state: True)
            with Image.open(BytesIO(client.jpeg)) as picture:
                sizes.add(picture.size)
        assert (240, 200) in sizes
        assert sizes <= {(120, 100), (240, 200)}
        await client.send("press", 60, 50)
        await client.until(lambda state: state["handled"] == 1)
        assert np.array(session.tool.position) == pytest.approx([0.5, 0.5], abs=0.03)


def test_pages_choose_a_scene_and_return(small: Path) -> None:
    async def steps() -> None:
        with Address(0) as address:
            choosing = asyncio.create_task(
                choose(address, {"press": "A <b>tool</b>."}, lambda: None, lambda line: None, "cannot & must")
            )
            while True:
                with suppress(HTTPClientError, ConnectionError):
                    page = (await AsyncHTTPClient().fetch(address.url)).body.decode()
                    break
            assert "A &lt;b&gt;tool" in page
            assert "cannot &amp; must" in page
            assert await status(address.url[:-2] + "/?scene=press") == 403
            assert await status(address.url + "?scene=none") == 200
            assert await status(address.url + "style.css") == 200
            assert not choosing.done()
            assert await status(address.url + "?scene=press") == 200
            assert await choosing == "press"
            # The next server at the same address.
            waiting = asyncio.create_task(status(address.url + "style.css"))
            again = asyncio.create_task(choose(address, {"press": ""}, lambda: None, lambda line: None))
            assert await waiting == 200
            again.cancel()
            await asyncio.wait([again])

    asyncio.run(steps())


@scenario
async def test_page_leaves_for_the_scenes(session: Session) -> None:
    for has_scenes in (False, True):
        with Address(0) as address:
            server = Server(session, address, "small.yaml", has_scenes=has_scenes)
            running = asyncio.create_task(server.run(lambda: None))
            client = await connect(server)
            await client.send("scenes")
            await client.send("key", "q")
            assert await asyncio.wait_for(running, WAIT_S) == has_scenes


def shows(notice: str, state: dict[str, Any]) -> bool:
    return notice in state["notice"]


@scenario
async def test_page_changes_the_material(session: Session) -> None:
    async with served(session) as server:
        client = await connect(server)
        await client.send("press", 60, 50)
        soft = (await client.until(lambda state: state["time"] > 0.8))["readings"][-1][2]
        (width, height), *_ = [text["size"] for text in client.texts]
        with Image.open(BytesIO(client.jpeg)) as picture:
            assert picture.size == (width, height) == (120, 100)
        entry = next(entry for entry in client.texts[0]["material"] if entry["key"] == "springs.structural")
        await client.send("material", entry["key"], 8 * entry["initial"])
        state = await client.until(lambda state: state["material"][entry["key"]] == 160)
        stiff = (await client.until(lambda after: after["time"] > state["time"] + 0.8))["readings"][-1][2]
        assert 0 < stiff < 0.9 * soft
        for message, notice in (
            (("key", "w"), "changed material"),
            (("material", "springs.structural", 1e9), "springs.structural"),
            (("key", "r"), ""),
            (("key", "w"), "session-1"),
        ):
            await client.send(*message)
            await client.until(partial(shows, notice))
        springs = load_scene("captures/session-1.yaml").springs
        assert springs is not None
        assert springs.structural == 160


MALFORMED = [
    *("{", "[]", "[[]]", "{}", '"press"', '["jump"]', '["press"]', '["press", 1, NaN]', '["press", 1e999, 1]'),
    *('["press", "1", 2]', '["press", 1, 2, true, 4]', '["press", true, 1]', '["release", 1]'),
    *('["key", "x"]', '["material", "sheet.size", 1]', '["turn", 1e13, 0]', "[" * MAX_BYTES),
    f'["turn", {"9" * 400}, 1]',
]


@pytest.mark.parametrize(
    "text",
    ['["jump"]', '["press", 1, NaN]', '["key", "x"]', '["material", "sheet.size", 1]'],
    ids=lambda text: text[2:5],
)
def test_faults_of_messages(text: str, message: Messages) -> None:
    with message.raises(ValueError):
        parse_message(text)


@scenario
async def test_malformed_messages_and_floods_are_refused(
    session: Session, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    async with served(session) as server:
        client = await connect(server)
        messages: list[str | bytes] = [*MALFORMED, b"\xff\xfe\x00"]
        for text in messages:
            await client.connection.write_message(text, binary=isinstance(text, bytes))
        while len(client.texts) < 1 + len(messages):
            await client.read()
        assert all("error" in text for text in client.texts[1:])
        for _ in range(MAX_INVALID_MESSAGES - len(messages)):
            client.connection.write_message("x")
        with pytest.raises(AssertionError, match="closed: 1008"):
            await client.until(lambda state: False)
        message(client.connection.close_reason or "")
        client = await connect(server)
        await client.connection.write_message("[" + " " * MAX_BYTES + "]")
        with pytest.raises(AssertionError, match="closed: 1009"):
            await client.until(lambda state: False)
        client = await connect(server)
        monkeypatch.setattr(server_module, "MAX_EVENTS", 5)
        for _ in range(50):
            client.connection.write_message('["hover", 1, 1]')
        with pytest.raises(AssertionError, match="closed: 1008"):
            await client.until(lambda state: False)
        crowd = [await connect(server) for _ in range(MAX_PAGES + 1)]
        with pytest.raises(AssertionError, match="closed: 1013"):
            await crowd[-1].read()
        assert await crowd[0].until(lambda state: state["steers"])


# Arguments of events: of other types, out of range, and of other events.
ODD: list[Any] = [0, -60.5, 1e12, -1e12, 1e-300, 1e13, float("nan"), True, None, "x", [], {"x": 1}]
EVENTS = [kind.__name__.lower() for kind in get_args(Event)]


def odd_messages() -> list[str | bytes]:
    """Messages with valid and invalid names of events, and up to three arguments; none quits."""
    arguments = [(), *product(ODD, repeat=1), *product(ODD, repeat=2), *((60, 50, pull) for pull in ODD)]
    lists = [[name, *values] for name in EVENTS for values in arguments]
    lists += [["material", key, value] for key in MATERIAL for value in (*ODD, 15, 25)]
    lists += [[name, key] for name in EVENTS for key in (*KEYS, *MATERIAL) if key != "q"]
    texts: list[str | bytes] = [json.dumps(values) for values in lists]
    return [*texts, *(text.encode() for text in texts[::40] if isinstance(text, str)), *MALFORMED, b"\xff\xfe\x00", b""]


@scenario
async def test_no_message_ends_the_session(
    session: Session, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    messages = odd_messages()
    monkeypatch.setattr(server_module, "MAX_INVALID_MESSAGES", len(messages))
    monkeypatch.setattr(server_module, "MAX_EVENTS", len(messages))
    async with served(session) as server:
        client = await connect(server)
        await client.until(lambda state: True)
        page, count = server.pages[0], 0
        for text in messages:
            client.connection.write_message(text, binary=isinstance(text, bytes))
            count += 1
            if count % 100 == 0:
                await client.read()
        await client.until(lambda state: state["handled"] + page.invalid == count, 120)
        assert 0.5 * count < page.invalid < count
        await client.send("material", "tissue.young", 0)
        message((await client.until(partial(shows, "tissue.young: missing or 0")))["notice"])


async def end(reader: asyncio.StreamReader) -> None:
    """Read until the server closes the connection."""
    with suppress(ConnectionError):
        while await asyncio.wait_for(reader.read(10_000), WAIT_S):
            pass


# Beginnings of requests: nothing, parts of the header and of two bodies, and a finished one on a connection kept alive.
HOST = b" / HTTP/1.1\r\nHost: a\r\n"
UNFINISHED = [
    *(b"", b"GET /", b"GET" + HOST, b"POST" + HOST + b"Content-Length: 400\r\n\r\na"),
    *(b"POST" + HOST + b"Transfer-Encoding: chunked\r\n\r\n5\r\nab", b"GET" + HOST + b"\r\n"),
]


@scenario
async def test_connections_are_bounded_in_number_and_time(
    session: Session, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    async def begin(texts: Sequence[bytes]) -> list[asyncio.StreamWriter]:
        """Open connections with texts; `ends` has a task for the end of each."""
        opened = [await asyncio.open_connection(url.hostname, url.port) for _ in texts]
        ends.extend(asyncio.create_task(end(reader)) for reader, _ in opened)
        for (_, writer), text in zip(opened, texts, strict=True):
            writer.write(text)
        return [writer for _, writer in opened]

    lines: list[str] = []
    ends: list[asyncio.Task[None]] = []
    async with served(session, warn=lines.append) as server:
        url = urlsplit(server.url)
        monkeypatch.setattr(web_module, "MAX_REQUEST_S", 2.0)
        page, opened = await connect(server), monotonic()
        monkeypatch.setattr(web_module, "MAX_REQUEST_S", WAIT_S)
        monkeypatch.setattr(web_module, "MAX_CONNECTIONS", 1 + len(UNFINISHED))
        writers = await begin(2 * UNFINISHED)
        await asyncio.wait_for(asyncio.gather(*ends[len(UNFINISHED) :]), WAIT_S)
        await page.until(lambda state: True)
        assert not any(task.done() for task in ends[: len(UNFINISHED)])
        monkeypatch.setattr(web_module, "MAX_CONNECTIONS", 64)
        monkeypatch.setattr(web_module, "MAX_REQUEST_S", 0.3)
        ends.clear()
        slow = await begin(UNFINISHED)
        deadline = monotonic() + WAIT_S
        while not all(task.done() for task in ends):
            # The header and the body continue slowly.
            for task, writer in list(zip(ends, slow, strict=True))[2:4]:
                if not task.done():
                    writer.write(b"a")
            await page.read()
            assert monotonic() < deadline
        monkeypatch.setattr(web_module, "MAX_REQUEST_S", WAIT_S)
        assert await status(server.url) == 200
        while monotonic() < opened + 2.5:
            await page.read()
        await page.send("key", "m")
        await page.until(lambda state: state["handled"] == 1)
        for writer in (*writers, *slow):
            writer.close()
    message(lines, f"{1 + len(UNFINISHED)} connections", hide=r"\d+(?= s$)")


@scenario
async def test_page_that_does_not_read_gets_no_more_messages(session: Session, monkeypatch: pytest.MonkeyPatch) -> None:
    async with served(session) as server:
        with socket.socket() as silent:
            # Small buffers of the kernel, at both ends.
            silent.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 2048)
            silent.setblocking(False)
            url = urlsplit(server.url)
            await asyncio.get_running_loop().sock_connect(silent, (url.hostname, url.port))
            silent.send(
                f"GET {url.path}socket HTTP/1.1\r\nHost: {url.netloc}\r\nUpgrade: websocket\r\nConnection: Upgrade\r\n"
                "Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\nSec-WebSocket-Version: 13\r\n\r\n".encode()
            )
            while not server.pages:
                await asyncio.sleep(0.01)
            page, write, sizes = server.pages[0], server.pages[0].write_message, []
            assert page.ws_connection is not None
            assert page.ws_connection.stream is not None
            page.ws_connection.stream.socket.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, 2048)

            def write_message(message: str | bytes, binary: bool) -> Any:
                sizes.append(len(message))
                return write(message, binary)

            monkeypatch.setattr(page, "write_message", write_message)
            watching = await connect(server)
            # Acknowledgements of pictures that were not read, and events with a notice; unmasked texts are permitted.
            for _ in range(50):
                for text in (b'["shown"]', b'["key", "f"]'):
                    silent.send(b"\x81" + bytes([len(text)]) + text)
                await watching.until(lambda state: True)
            # A notice has 35 bytes. The buffers of the kernel hold few states and pictures.
            assert sum(size > 100 for size in sizes) < 10
            assert len(sizes) < 10 + MAX_UNSENT_MESSAGES


@scenario
async def test_slow_page_gets_few_pictures(session: Session) -> None:
    async with served(session) as server:
        slow, fast = await connect(server), await connect(server)
        await fast.until(lambda state: state["time"] > 1)
        await slow.read()
        states = 0
        while True:
            try:
                await asyncio.wait_for(slow.connection.read_message(), 0.5)
                states += 1
            except TimeoutError:
                break
        assert states == MAX_UNREAD_PICTURES


def test_interruption_reaches_the_pages_and_saves_the_film(session: Session) -> None:
    interrupted = asyncio.Event()

    def pause() -> None:
        if interrupted.is_set():
            raise KeyboardInterrupt

    async def steps() -> None:
        with Address(0) as address:
            server = Server(session, address, "small.yaml")
            session.start_film(Path("live.mp4"))
            running = asyncio.create_task(server.run(pause))
            client = await connect(server)
            await client.until(lambda state: state["filming"] and state["time"] > 0.2)
            interrupted.set()
            while {"ended": True} not in client.texts:
                await client.read()
            await running

    with pytest.raises(KeyboardInterrupt):
        run(steps())
    session.close()
    assert Path("live.mp4").stat().st_size > 1000
    assert [path.name for path in Path().glob(".*")] == []


def test_interruption_drops_queued_saves(session: Session, message: Messages, monkeypatch: pytest.MonkeyPatch) -> None:
    count, interrupted = 400, asyncio.Event()
    lines: list[str] = []
    save = Captures.save_picture

    def save_picture(captures: Captures, picture: Picture) -> Path:
        interrupted.set()
        return save(captures, picture)

    def pause() -> None:
        if interrupted.is_set():
            raise KeyboardInterrupt

    async def steps() -> None:
        with Address(0) as address:
            server = Server(session, address, "small.yaml", warn=lines.append)
            running = asyncio.create_task(server.run(pause))
            client = await connect(server)
            await client.until(lambda state: True)
            monkeypatch.setattr(Captures, "save_picture", save_picture)
            for _ in range(count):
                server.receive(server.pages[0], '["key", "p"]')
            while {"ended": True} not in client.texts:
                await client.read()
            await running

    with pytest.raises(KeyboardInterrupt):
        run(steps())
    pictures = list(Path("captures").iterdir())
    for path in pictures:
        with Image.open(path) as picture:
            assert picture.size == (120, 100)
    (line,) = lines
    assert line.startswith(f"{count - len(pictures)} ")
    message(line, hide=r"\d+")


@scenario
async def test_page_quits(session: Session) -> None:
    with Address(0) as address:
        server = Server(session, address, "small.yaml")
        running = asyncio.create_task(server.run(lambda: None))
        client = await connect(server)
        await client.send("key", "q")
        await asyncio.wait_for(running, WAIT_S)


def test_port_in_use(small: Path, capsys: pytest.CaptureFixture[str], message: Messages) -> None:
    with Address(0) as taken:
        assert main(["view", "small.yaml", "--browser", "--port", str(taken.port)]) == 2
    message(capsys.readouterr().err, hide=r"\d{4,}")


def test_interruption_of_the_command(
    small: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    serve = Server.run

    async def interrupt(server: Server, pause: Pause) -> None:
        signal.raise_signal(signal.SIGINT)
        await serve(server, pause)

    monkeypatch.setattr(Server, "run", interrupt)
    done = program("view", "small.yaml", "--browser", "--record", "live.gif")
    url, film = done.stdout.splitlines()
    assert (done.returncode, film) == (130, "live.gif")
    assert re.fullmatch(r"http://127\.0\.0\.1:\d+/[\w-]{32}/", url)
    message(done.stderr.splitlines()[-2:], "interrupted")
    assert Path("live.gif").exists()


@pytest.mark.skipif(PROGRAM is None, reason="needs Chromium")
@scenario
async def test_page_in_chromium(session: Session, tmp_path: Path) -> None:
    async with served(session) as server, chromium(tmp_path / "profile") as tab:
        await tab.open(server.url, 1280, 800)
        await tab.until("state !== null && readings.length > 5")
        left, top, width = await tab.value("(box => [box.left, box.top, box.width])(canvas.getBoundingClientRect())")
        before = await tab.value("element('by-depth').toDataURL()")
        x, y = left + 0.5 * width, top + 0.5 * width * 100 / 120
        await tab.mouse("Moved", x, y)
        await tab.mouse("Pressed", x, y, button="left", buttons=1, clickCount=1)
        await tab.until("readings.at(-1)[2] > 2e-3")
        assert session.depth() > 2e-3
        assert np.array(session.tool.position) == pytest.approx([0.5, 0.5], abs=0.03)
        await tab.mouse("Moved", x + 0.1 * width, y, button="left", buttons=1)
        await tab.until("state.handled >= 3")
        assert session.tool.target[0] > 0.52
        await tab.until(f"element('by-depth').toDataURL() !== {json.dumps(before)}")
        await tab.mouse("Released", x, y, button="left")
        await tab.mouse("Wheel", x, y, deltaX=0, deltaY=200)
        await tab.until("state.strength === 90 && element('strength').value === '90'")
        await tab.key("m")
        await tab.until("state.mesh && element('mesh').ariaPressed === 'true'")
        await tab.key(" ")
        await tab.until("state.paused")
        # `h` closes the list that it has opened.
        for is_open in ("true", "false"):
            await tab.key("h")
            await tab.until(f"element('help').open === {is_open}")
        await tab.key("p")
        await tab.until("document.querySelector('#saved a')?.textContent === 'picture-1.png'")
        # A reloaded page steers at once.
        await tab.call("Page.reload")
        await tab.until("typeof state !== 'undefined' && state?.steers && session !== null")
        # The layout of a telephone, and touch.
        await tab.resize(400, 800, touch=True)
        handled = await tab.value("state.handled")
        assert await tab.value("document.documentElement.scrollWidth") == 400
        await tab.call("Input.dispatchTouchEvent", type="touchStart", touchPoints=[{"x": 200, "y": 150}])
        await tab.until(f"state.handled > {handled}")
        assert session.tool.engaged
        await tab.call("Input.dispatchTouchEvent", type="touchEnd", touchPoints=[])
        assert tab.faults == []
