"""Timing of peers in turn, each after a check of its answer."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from benchmarks.process import FailedError, UnavailableError, call

Progress = Callable[[str], None]


@dataclass
class Entry:
    """Result of one peer for one piece of work."""

    name: str
    failure: str = ""  # why it was not timed, or empty
    answer: float | None = None  # accuracy of its answer, in the unit of the check
    compile: float | None = None  # time to set up and compile, until the first result [s]
    samples: list[float] = field(default_factory=list)  # time of the work in each round [s]


def race(
    part: str,
    peers: Mapping[str, str],
    rounds: int,
    progress: Progress,
    threads: int | None = None,
    **work: Any,
) -> list[Entry]:
    """Check every peer, then time the correct ones in turn.

    Args:
        part: module with the functions `check` and `clock`.
        peers: module of each peer by its name.
        rounds: number of samples of each peer.
        progress: receives the current measurement.
        threads: number of threads of a peer, by default one per core.
        work: further arguments of both functions.
    """
    entries = []
    for name, module in peers.items():
        progress(f"{name}: check")
        entry = Entry(name)
        entries.append(entry)
        checked = _try(entry, progress, f"{part}:check", {"peer": module, "threads": threads, **work})
        if checked is not None:
            entry.answer, entry.compile = checked["answer"], checked["compile"]
            if not checked["correct"]:
                entry.failure = f"wrong: {checked['wanted']}"
    for number in range(rounds):
        for entry in entries:
            if not entry.failure:
                progress(f"{entry.name}: round {number + 1} of {rounds}")
                seconds = _try(
                    entry, progress, f"{part}:clock", {"peer": peers[entry.name], "threads": threads, **work}
                )
                if seconds is not None:
                    entry.samples.append(seconds)
    return entries


def _try(entry: Entry, progress: Progress, task: str, arguments: dict[str, Any]) -> Any:
    """Call a task, or note its failure in the entry."""
    try:
        return call(task, **arguments)
    except UnavailableError as error:
        entry.failure = f"skipped: {error}"
    except FailedError as error:
        # The rest may name folders of this machine.
        entry.failure = f"failed: {str(error).split(':')[0]}"
        progress(f"{entry.name} failed: {error}")
    return None
