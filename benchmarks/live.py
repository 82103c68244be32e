"""Measure a live session: how long from an event to its picture, and how many pictures a second; into docs/view.md.

    xvfb-run -a python -m benchmarks.live

Needs a display, which Xvfb gives. Every session is measured in turn, ROUNDS times; medians. Nothing else should run.
"""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from pathlib import Path

from benchmarks.process import ROOT
from taichi_msm import load_scene
from taichi_msm.view.events import Drag, Press, Release
from taichi_msm.view.recording import Captures
from taichi_msm.view.session import Session
from taichi_msm.view.window import Window

SIZES = (512, 1024)
POINTS = (31, 101)
ROUNDS = 9
PICTURES = 40

PAGE = ROOT / "docs" / "view.md"
START, END = "<!-- live: made by benchmarks/live.py -->\n", "<!-- end of live -->\n"


class Case:
    """A session in a window of its own.

    Args:
        size: width and height of the picture [px].
        points: rows and columns of mass points.
    """

    def __init__(self, size: int, points: int) -> None:
        scene = load_scene(
            ROOT / "scenes" / "press.yaml",
            # As many vertices as the paper has at 31 points, whatever the points are.
            {"render.size": [size, size], "sheet.points": [points, points], "render.refine": 300 // (points - 1) - 1},
        )
        self.size, self.points = size, points
        self.session = Session(scene, Captures(Path(tempfile.gettempdir()), "press.yaml"))
        self.window = Window(f"{size} {points}", scene.render.size)
        self.latencies: list[float] = []
        self.periods: list[float] = []
        self.steppings: list[float] = []

    def measure(self) -> None:
        """Press, and drag from picture to picture as fast as they come."""
        middle = self.size / 2
        self.session.handle(Press(middle, middle))
        begun = time.perf_counter()
        for n in range(PICTURES):
            list(self.window.events())
            event = time.perf_counter()
            self.session.handle(Drag(middle + n, middle))
            self.session.advance()
            self.window.show(self.session.picture("00 pictures/s"))
            self.latencies.append(time.perf_counter() - event)
            self.steppings.append(self.session.frame_time_s)
        self.periods.append((time.perf_counter() - begun) / PICTURES)
        self.session.handle(Release())

    def row(self) -> str:
        """Give the line of the table."""
        latency, period = statistics.median(self.latencies), statistics.median(self.periods)
        speed = 1 / self.session.frame_rate / statistics.median(self.steppings)
        what = f"{self.size} × {self.size} | {self.points} × {self.points}"
        return f"| {what} | {1e3 * latency:.1f} ms | {1 / period:.0f} | {speed:.0f} × |"


def main() -> None:
    """Measure and write."""
    if "DISPLAY" not in os.environ:
        raise SystemExit("there is no display; try xvfb-run -a python -m benchmarks.live")
    cases = [Case(size, points) for size in SIZES for points in POINTS]
    for case in cases:
        case.measure()
        case.latencies, case.periods, case.steppings = [], [], []
    for _ in range(ROUNDS):
        for case in cases:
            case.measure()
    head = "| picture | points | from event to picture | pictures a second, at most | simulation, against real time |\n"
    table = head + "|---|---|---:|---:|---:|\n" + "".join(f"{case.row()}\n" for case in cases)
    text = PAGE.read_text(encoding="utf-8")
    before, rest = text.split(START)
    PAGE.write_text(before + START + table + END + rest.split(END)[1], encoding="utf-8")
    print(table)


if __name__ == "__main__":
    main()
