"""What a person reads of a sweep: what it will take, and how it ended."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from statistics import median

from taichi_msm.console import rough_time
from taichi_msm.sweeps.cost import Cost, Workers
from taichi_msm.sweeps.outcome import STATUSES, Outcome

# The errors that runs estimate, and what makes them.
ERRORS = {"error_estimate": "the time step", "mesh_error": "the number of points"}

# The most kinds of notes that are shown.
MOST_NOTES = 5


def cost_line(runs: int, cost: Cost, workers: Workers | None) -> str:
    """Say what a sweep takes; None: its workers are elsewhere."""
    if workers is None:
        where = "if they were run here"
    else:
        processes = f"{workers.number} {'process' if workers.number == 1 else 'processes'}"
        where = f"in {processes} ({workers.cores} cores; memory for {workers.fitting})"
    disk = f"at most {cost.disk_bytes / 2**20:.1f} MiB on disk"
    refused = f"; of {cost.looked_at} that were checked, {cost.refused} will be refused, for example: {cost.example}"
    return f"{_runs(runs)}: about {rough_time(cost.seconds)} {where}, {disk}{refused if cost.refused else ''}"


def summary_lines(
    directory: Path, outcomes: Sequence[Outcome], shard: tuple[int, int] | None, files: list[str], notes: list[str]
) -> list[str]:
    """Say in some lines how the runs of a sweep ended, with an example of each failure, and what was written."""
    of = f" of part {shard[0]} of {shard[1]}" if shard else ""
    counts = count(outcomes)
    said = ", ".join(f"{number} {status}" for status, number in counts.items() if number)
    lines = [f"{directory}: {_runs(len(outcomes))}{of}: {said}"]
    for status in STATUSES:
        example = next((outcome for outcome in outcomes if outcome.status == status), None)
        if example and example.error:
            lines.append(f"{status}, for example run {example.run:06}: {example.error}")
    for name, what in ERRORS.items():
        errors = [(getattr(outcome, name), outcome.run) for outcome in outcomes if getattr(outcome, name) is not None]
        if errors:
            largest, run = max(errors)
            said = f"median {median(error for error, _ in errors):.2g}, largest {largest:.2g} (run {run:06})"
            lines.append(f"error, as a fraction of the largest displacement, due to {what}: {said}")
    lines += _noted(outcomes)
    return [*lines, "without --shard, the same command writes the table" if shard else ", ".join(files), *notes]


def _noted(outcomes: Sequence[Outcome]) -> Iterator[str]:
    """Give an example of each note that some runs have, whatever its numbers are."""
    alike: dict[str, list[str]] = {}
    for outcome in outcomes:
        for note in outcome.notes:
            alike.setdefault(re.sub(r"[0-9.e+-]+", "", note), []).append(f"run {outcome.run:06}: {note}")
    for notes in sorted(alike.values(), key=len, reverse=True)[:MOST_NOTES]:
        yield f"{_runs(len(notes))} with a note, for example {notes[0]}"


def _runs(number: int) -> str:
    return "1 run" if number == 1 else f"{number} runs"


def count(outcomes: Sequence[Outcome]) -> dict[str, int]:
    """Count the runs that ended in each way."""
    counts = Counter(outcome.status for outcome in outcomes)
    return {status: counts[status] for status in STATUSES}
