"""Console output: progress of all commands, and summary of a run."""

from __future__ import annotations

import sys
import time
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from taichi_msm.errors import printable
from taichi_msm.load.cost import format_rough_time
from taichi_msm.model.tool_force import describe_forces
from taichi_msm.system.process import write_stderr

if TYPE_CHECKING:
    from rich.progress import Progress as Bar

# Stages of computations, and their descriptions.
STAGES = {
    "start": "starting",
    "grid": "spreading mass points",
    "pilot": "companion runs",
    "compile": "compiling the kernels",
    "check": "checking the finished frames",
    "redraw": "drawing finished frames",
    "frames": "simulating",
    "diagnosis": "diagnosing the divergence",
    "stepping": "measuring the stepping",
    "drawing": "measuring the drawing",
    "points": "measuring other meshes",
    "write": "writing",
    "film": "filming",
    "export": "exporting",
    "workers": "waiting for a worker of the cluster",
    "runs": "running",
    "fit": "fitting",
    "map": "mapping",
    "scores": "predicting presses that are left out",
    "contact": "drawing the contact sheet",
}

LINE_INTERVAL_S = 10.0


class ProgressDisplay:
    """Progress on stderr: a bar on a terminal, otherwise a line every `LINE_INTERVAL_S`; nothing if quiet."""

    def __init__(self, quiet: bool) -> None:
        self._quiet = quiet
        self._bar = None if quiet or not sys.stderr.isatty() else _bar()
        self._next_line = time.monotonic() + LINE_INTERVAL_S
        self._pace = _Pace("", 0, 0.0)
        if self._bar is not None:
            self._task = self._bar.add_task(STAGES["start"], total=None, left="")
            self._bar.start()

    def update(self, stage: str, done: int, total: int) -> None:
        """Show the progress of a stage of `STAGES` and its estimated remaining time; a total of 0 is unknown."""
        if self._quiet:
            return
        now = time.monotonic()
        if stage != self._pace.stage or done < self._pace.done:
            self._pace = _Pace(stage, done, now)
        remaining_s = self._pace.remaining_s(done, total, now)
        remaining = "" if remaining_s is None else f"{format_rough_time(remaining_s)} left"
        if self._bar is not None:
            self._bar.update(self._task, description=STAGES[stage], completed=done, total=total, left=remaining)
        elif now >= self._next_line:
            self._next_line = now + LINE_INTERVAL_S
            count = f": {done} of {total} done" if total else ""
            write_stderr([f"{STAGES[stage]}{count}{remaining and f', about {remaining}'}"])

    def close(self) -> None:
        """Remove the bar."""
        if self._bar is not None:
            self._bar.stop()


class _Pace:
    """Rate of progress in a stage."""

    def __init__(self, stage: str, done: int, now: float) -> None:
        self.stage, self.done = stage, done
        self._start, self._initially_done = now, done
        self._last = now

    def remaining_s(self, done: int, total: int, now: float) -> float | None:
        """Record progress at a time [s]; return the estimated remaining time [s], None if unknown or finished."""
        if done > self.done:
            self._last, self.done = now, done
        if done == self._initially_done or done >= total:
            return None
        item_s = (self._last - self._start) / (done - self._initially_done)
        return max(0.0, (total - done) * item_s - (now - self._last))


def _bar() -> Bar:
    from rich.console import Console
    from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn

    columns = TextColumn("{task.description:24}"), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn()
    return Progress(*columns, TextColumn("{task.fields[left]}"), console=Console(stderr=True), transient=True)


def run_summary(record: Mapping[str, Any], directory: Path) -> str:
    """Summarise run.json in a few lines: frames, steps, forces, warnings and timings."""
    times, (rows, cols) = record["timings"], record["points"]
    named = {"companion runs" if stage == "pilot" else stage: seconds for stage, seconds in times.items()}
    stages = ", ".join(f"{stage} {seconds:.2f}" for stage, seconds in named.items() if stage != "total")
    parallel = times["encode"] > 0 and record["threads"] > 1
    steps = (
        f"at rest to {record['residual']:.1g} of the largest force, {record['evaluations']} evaluations of the forces"
        if record["step"] is None
        else f"{record['steps']} steps of {record['step']:.4g} s in {record['precision']}"
    )
    lines = [
        f"{printable(str(directory))}: {record['frames']} frames, {steps}, {rows} x {cols} points, "
        f"largest displacement {record['max_displacement']:.4g} m",
        *([f"the first {record['resumed']} frames were simulated by an earlier run"] if record["resumed"] else []),
        *(f"probes.{index}: {describe_forces(probe)}" for index, probe in enumerate(record["probes"])),
        *record["notes"],
        f"{times['total']:.2f} s: {stages}{' (encoding runs in parallel)' if parallel else ''}",
    ]
    return "\n".join(lines)
