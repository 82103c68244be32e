"""What a person sees of a run: its progress, and a summary at the end."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taichi_msm.errors import printable
from taichi_msm.load.cost import format_rough_time
from taichi_msm.model.tool_force import in_words
from taichi_msm.system.process import tell

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

STAGES = {
    "start": "starting",
    "pilot": "pilot runs",
    "compile": "compiling the kernels",
    "check": "checking the finished frames",
    "redraw": "drawing finished frames",
    "frames": "simulating",
    "diagnosis": "finding out why it diverged",
    "stepping": "measuring the stepping",
    "dop853": "measuring DOP853",
    "drawing": "measuring the drawing",
    "points": "measuring other numbers of points",
    "terms": "measuring every term",
    "write": "writing",
    "film": "filming",
    "export": "exporting",
    "workers": "waiting for a worker of the cluster",
    "runs": "running",
    "fit": "fitting",
    "contact": "drawing the last frames",
}

# Time between two lines when stderr is not a terminal [s].
LINE_EVERY = 10.0


class Progress:
    """Progress on stderr: a bar on a terminal, else a line every ten seconds; or nothing."""

    def __init__(self, quiet: bool) -> None:
        self._quiet = quiet
        self._bar = None if quiet or not sys.stderr.isatty() else _bar()
        self._next_line = time.monotonic() + LINE_EVERY
        self._pace = _Pace("", 0, 0.0)
        if self._bar is not None:
            self._task = self._bar.add_task(STAGES["start"], total=None, left="")

    def update(self, stage: str, done: int, total: int) -> None:
        """Show the stage, how much of it is done, and the time left."""
        if self._quiet:
            return
        now = time.monotonic()
        if stage != self._pace.stage or done < self._pace.done:
            self._pace = _Pace(stage, done, now)
        left = self._pace.left(done, total, now)
        said = "" if left is None else f"{format_rough_time(left)} left"
        if self._bar is not None:
            self._bar.update(self._task, description=STAGES[stage], completed=done, total=total, left=said)
        elif now >= self._next_line:
            self._next_line = now + LINE_EVERY
            much = f": {done} of {total} done" if total else ""
            tell([f"{STAGES[stage]}{much}{said and f', about {said}'}"])

    def __enter__(self) -> Progress:
        if self._bar is not None:
            self._bar.start()
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()


class _Pace:
    """How fast a stage goes, of which a part was done when it began."""

    def __init__(self, stage: str, done: int, now: float) -> None:
        self.stage, self.done = stage, done
        self._begun, self._before = now, done
        self._last = now

    def left(self, done: int, total: int, now: float) -> float | None:
        """Tell how long the rest will take [s]; None: not known yet, or nothing is left."""
        if done > self.done:
            self._last, self.done = now, done
        if done == self._before or done >= total:
            return None
        each = (self._last - self._begun) / (done - self._before)
        return max(0.0, (total - done) * each - (now - self._last))


def _bar() -> Bar:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = TextColumn("{task.description:24}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    return Progress(*columns, TextColumn("{task.fields[left]}"), console=Console(stderr=True), transient=True)


def summary(record: Mapping[str, Any], directory: Path) -> str:
    """Say in a few lines what a run did, how large its error is, and how long it took."""
    times, (rows, cols) = record["timings"], record["points"]
    stages = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in times.items() if stage != "total")
    beside = times["encode"] > 0 and record["threads"] > 1
    steps = (
        f"at rest to {record['residual']:.1g} of the largest force, {record['evaluations']} evaluations of the forces"
        if record["step"] is None
        else f"{record['steps']} steps of {record['step']:.4g} s in {record['precision']}"
    )
    lines = [
        f"{printable(str(directory))}: {record['frames']} frames, {steps}, {rows} x {cols} points, "
        f"largest displacement {record['max_displacement']:.4g} m",
        *([f"the first {record['resumed']} frames were simulated by an earlier run"] if record["resumed"] else []),
        *(f"probes.{index}: {in_words(probe)}" for index, probe in enumerate(record["probes"])),
        *record["notes"],
        f"{times['total']:.2f} s: {stages}{' (encoding runs in parallel)' if beside else ''}",
    ]
    return "\n".join(lines)
