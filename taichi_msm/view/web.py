"""Web server on the loopback interface only: its address with a random token, and limits of its connections.

Decision 0032 explains the choice of Tornado.
"""

from __future__ import annotations

import asyncio
import errno
import hmac
import secrets
import socket
from collections.abc import AsyncIterator, Callable, Collection, Sequence
from contextlib import AbstractContextManager, asynccontextmanager
from importlib.resources import files
from typing import Any, cast

from tornado.http1connection import HTTP1Connection, HTTP1ServerConnection
from tornado.httpserver import HTTPServer
from tornado.httputil import HTTPServerRequest
from tornado.ioloop import IOLoop
from tornado.iostream import IOStream
from tornado.web import Application, HTTPError, RequestHandler

from taichi_msm.errors import DeviceError
from taichi_msm.view import events
from taichi_msm.view.origin import parse_origin

LOOPBACK = "127.0.0.1"

HEADERS = {
    "Cache-Control": "no-store",
    "Content-Security-Policy": "default-src 'none'; script-src 'self'; style-src 'self'; img-src data:; "
    "connect-src 'self'; frame-ancestors 'self'",
    "Referrer-Policy": "no-referrer",
    "Server": "taichi-msm",
    "X-Content-Type-Options": "nosniff",
}

# Media types of the files of pages.
FILES = {"index.html": "text/html", "style.css": "text/css", "view.js": "text/javascript"}

# Largest number of open connections, including pages.
MAX_CONNECTIONS = 64

# Longest duration of a connection that is not a page's [s].
MAX_REQUEST_S = 10.0

# Time in which pages receive a last message [s].
CLOSING_S = 0.1


class Address(AbstractContextManager["Address"]):
    """A listening port of the loopback interface, 0 for a free one, with a random token.

    `origins` are those of pages behind a proxy; origins of the loopback interface are always permitted.
    """

    def __init__(self, port: int, origins: Collection[str] = ()) -> None:
        try:
            self.listener = socket.create_server((LOOPBACK, port))
        except OSError as error:
            reason = "is in use" if error.errno == errno.EADDRINUSE else f"cannot be used ({error.strerror})"
            raise DeviceError(f"--port {port}: {reason}; take another, or leave --port out for a free one") from None
        self.listener.setblocking(False)
        self._origins = {parse_origin(origin) for origin in origins}
        self.port, self._token = self.listener.getsockname()[1], secrets.token_urlsafe(24)
        self.url = f"http://{LOOPBACK}:{self.port}/{self._token}/"

    def __exit__(self, *_: object) -> None:
        self.listener.close()

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
        is_loopback = origin.scheme == "http" and origin.host in {LOOPBACK, "localhost", "[::1]"}
        return origin in self._origins or (is_loopback and origin.port in (self.port, forwarded and forwarded.port))


@asynccontextmanager
async def serving(
    address: Address, handlers: Sequence[tuple[Any, ...]], warn: Callable[[str], None], close: Callable[[], None]
) -> AsyncIterator[None]:
    """Serve handlers at an address, whose listener stays open; `close` says goodbye to pages."""
    application = Application(
        list(handlers),
        log_function=lambda handler: None,
        websocket_max_message_size=events.MAX_BYTES,
        websocket_ping_interval=20,
    )
    http = _BoundedServer(application, max_body_size=events.MAX_BYTES)
    http.warn = warn
    application.settings["lift_deadline"] = http.lift_deadline
    # Tornado closes its socket; connections that arrive before the next server wait.
    http.add_socket(address.listener.dup())
    try:
        yield
    finally:
        http.stop()
        close()
        await asyncio.sleep(CLOSING_S)
        await http.close_all_connections()


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

    def lift_deadline(self, request: HTTPServerRequest) -> None:
        """Let a response, which is the last one of its connection, take any time."""
        IOLoop.current().remove_timeout(self._deadlines[cast(HTTP1Connection, request.connection).stream])

    async def close_all_connections(self) -> None:
        """Close all connections, also those of pages."""
        for stream in self._streams:
            stream.close()
        await super().close_all_connections()


class Guarded(RequestHandler):
    """Handler that rejects requests without permission."""

    def initialize(self, address: Address) -> None:
        """Set the address."""
        self.address = address

    def prepare(self) -> None:
        """Reject a request without permission."""
        if not self.address.permits(self.request):
            raise HTTPError(403)

    def set_default_headers(self) -> None:
        """Set the headers of all responses."""
        for name, value in HEADERS.items():
            self.set_header(name, value)


class PageFile(Guarded):
    """Handler of the files of a page; without a name, `index.html`."""

    def get(self) -> None:
        """Send a file, or redirect to the page."""
        token, slash, name = self.request.path.lstrip("/").partition("/")
        if not slash:
            self.redirect(f"{token}/")
            return
        self.send_file(name or "index.html")

    def send_file(self, name: str) -> None:
        """Send a file of `FILES`."""
        if name not in FILES:
            raise HTTPError(404)
        self.set_header("Content-Type", f"{FILES[name]}; charset=utf-8")
        self.write(page_file(name))


def page_file(name: str) -> bytes:
    """Read a file of the page."""
    return (files("taichi_msm.view") / "page" / name).read_bytes()
