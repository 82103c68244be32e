"""Measure a session in a browser: time from an event to its picture, and pictures a second; into docs/view.md.

    python -m benchmarks.browser

The session is that of scenes/press.yaml, 61 x 61 points and 512 x 512 pixels. A client in another process presses and
drags; it measures from sending an event to the last byte of the first picture that contains it. The parts of that time
are measured without a client. Nothing else should run.
"""

from __future__ import annotations

import asyncio
import json
import os
import random
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path

from benchmarks.marked import replace_marked
from benchmarks.process import ROOT
from taichi_msm import load_scene
from taichi_msm.view.events import Drag, Press, Release
from taichi_msm.view.recording import Captures
from taichi_msm.view.server import Server, encode_jpeg
from taichi_msm.view.session import Session
from taichi_msm.view.web import Address

EVENTS = 200
PARTS = 60

# Limits of the random intervals between drags [s].
INTERVALS_S = 0.02, 0.12

PAGE = ROOT / "docs" / "view.md"


async def drag(url: str) -> None:
    """Press and drag like the page; print latencies [s] and pictures per second as JSON."""
    from tornado.websocket import websocket_connect

    connection = await websocket_connect(url.replace("http", "ws") + "socket")
    sent: dict[int, float] = {}
    latencies: list[float] = []
    pictures = 0

    async def read(until: int) -> None:
        nonlocal pictures
        while len(latencies) < until:
            message = await connection.read_message()
            assert message is not None
            if isinstance(message, str):
                continue
            now = time.perf_counter()
            state = json.loads(message[4 : 4 + int.from_bytes(message[:4], "big")])
            await connection.write_message('["shown"]')
            pictures += 1
            for number in [number for number in sent if number <= state["handled"]]:
                latencies.append(now - sent.pop(number))

    async def send(number: int, *message: object) -> None:
        sent[number] = time.perf_counter()
        await connection.write_message(json.dumps(message))

    await send(1, "press", 256, 256)
    await read(1)
    begun, pictures = time.perf_counter(), 0
    reading = asyncio.create_task(read(EVENTS))
    for number in range(2, EVENTS + 1):
        await asyncio.sleep(random.uniform(*INTERVALS_S))
        await send(number, "drag", 256 + number % 40, 256)
    await reading
    print(json.dumps([latencies[1:], pictures / (time.perf_counter() - begun)]))
    await connection.write_message('["key", "q"]')
    await asyncio.sleep(0.5)


def measure_parts(session: Session) -> dict[str, str]:
    """Return the parts of a picture's time: medians of elapsed and CPU time of all threads."""
    times: dict[str, list[tuple[float, float]]] = {"step a frame": [], "draw": [], "encode as JPEG": []}
    session.handle(Press(256, 256))
    for n in range(PARTS):
        session.handle(Drag(256 + n % 40, 256))
        moments = [clocks()]
        session.advance()
        moments.append(clocks())
        picture = session.bare_picture()
        moments.append(clocks())
        encode_jpeg(picture)
        moments.append(clocks())
        for part, begin, end in zip(times.values(), moments, moments[1:], strict=False):
            part.append((end[0] - begin[0], end[1] - begin[1]))
    session.handle(Release())
    medians = {
        part: [1e3 * statistics.median(column) for column in zip(*rows, strict=True)] for part, rows in times.items()
    }
    return {part: f"{elapsed:.1f} ms ({cpu:.1f} ms)" for part, (elapsed, cpu) in medians.items()}


def clocks() -> tuple[float, float]:
    """Return wall and CPU time of all threads [s]."""
    return time.perf_counter(), time.process_time()


def main() -> None:
    """Measure and write."""
    scene = load_scene(ROOT / "scenes" / "press.yaml")
    with Session(scene, Captures(Path(tempfile.gettempdir()), "press.yaml")) as session:
        parts = measure_parts(session)
        with Address(0) as address:
            server = Server(session, address, "press.yaml")
            client = subprocess.Popen(
                [sys.executable, "-m", "benchmarks.browser", server.url], cwd=ROOT, stdout=subprocess.PIPE, text=True
            )
            asyncio.run(server.run(lambda: None))
            latencies, rate = json.loads(client.communicate()[0])
            size = len(encode_jpeg(session.bare_picture()))
    quantiles = statistics.quantiles(latencies, n=20)
    rows = {
        **{f"{part} (CPU time)": times for part, times in parts.items()},
        "from an event to the last byte of its picture, median": f"{1e3 * statistics.median(latencies):.0f} ms",
        "the same, nine of ten": f"{1e3 * quantiles[0]:.0f} to {1e3 * quantiles[-1]:.0f} ms",
        "pictures a second": f"{rate:.0f}",
        "size of a picture": f"{size / 1e3:.0f} kB",
        f"load of the machine, on {os.cpu_count()} cores": f"{os.getloadavg()[0]:.1f}",
    }
    table = "| | |\n|---|---:|\n" + "".join(f"| {name} | {value} |\n" for name, value in rows.items())
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replace_marked(page, "browser", "benchmarks/browser.py", table), encoding="utf-8")
    print(table)


if __name__ == "__main__":
    if len(sys.argv) > 1:
        asyncio.run(drag(sys.argv[1]))
    else:
        main()
