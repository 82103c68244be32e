"""What a person reads of a sweep: what it will take, and how it ended."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from taichi_msm.console import rough_time
from taichi_msm.sweeps.cost import Cost, Workers
from taichi_msm.sweeps.outcome import STATUSES, Outcome


def cost_line(runs: int, cost: Cost, workers: Workers) -> str:
    """Say what a sweep takes."""
    if cost.refused:
        return f"{runs} runs; all that were looked at are refused: {cost.refused}"
    guess = "" if cost.measured else " (a guess, as no run has been timed here yet)"
    processes = f"{workers.number} {'process' if workers.number == 1 else 'processes'}"
    return (
        f"{runs} runs: about {rough_time(cost.seconds)}{guess} in {processes} "
        f"({workers.cores} cores; memory for {workers.fitting}), at most {cost.disk_bytes / 2**20:.1f} MiB on disk"
    )


def summary_lines(
    directory: Path, outcomes: Sequence[Outcome], shard: tuple[int, int] | None, files: list[str], notes: list[str]
) -> list[str]:
    """Say in some lines how the runs of a sweep ended, with an example of each failure, and what was written."""
    of = f" of part {shard[0]} of {shard[1]}" if shard else ""
    counts = count(outcomes)
    said = ", ".join(f"{number} {status}" for status, number in counts.items() if number)
    lines = [f"{directory}: {len(outcomes)} runs{of}: {said}"]
    for status in STATUSES:
        example = next((outcome for outcome in outcomes if outcome.status == status), None)
        if example and example.error:
            lines.append(f"{status}, for example run {example.run:06}: {example.error}")
    return [*lines, "without --shard, the same command writes the table" if shard else ", ".join(files), *notes]


def count(outcomes: Sequence[Outcome]) -> dict[str, int]:
    """Count the runs that ended in each way."""
    counts = Counter(outcome.status for outcome in outcomes)
    return {status: counts[status] for status in STATUSES}
