"""Peers take turns at the same work, each after its answer was found right."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from typing import Any

from benchmarks.process import FailedError, UnavailableError, call

Progress = Callable[[str], None]


@dataclass
class Entry:
    """One peer at one piece of work.

    Attributes:
        name: of the peer.
        said: why it was not timed; "" if it was.
        answer: how near its answer is, in the unit of the check; None: not known.
        compile: time to set up and compile, up to the first result [s].
        samples: times of the work, one of each round [s].
    """

    name: str
    said: str = ""
    answer: float | None = None
    compile: float | None = None
    samples: list[float] = field(default_factory=list)


def race(
    part: str,
    peers: Mapping[str, str],
    rounds: int,
    progress: Progress,
    threads: int | None = None,
    **work: Any,
) -> list[Entry]:
    """Check every peer, then time those that are right in turn.

    Args:
        part: module with the functions `check` and `clock`.
        peers: name of every peer and its module.
        rounds: how often each is timed.
        progress: told what is going on.
        threads: how many a peer may take; None: every core.
        work: arguments of both functions, besides the peer's module.
    """
    entries = []
    for name, module in peers.items():
        progress(f"{name}: check")
        entry = Entry(name)
        entries.append(entry)
        found = _try(entry, progress, f"{part}:check", {"peer": module, "threads": threads, **work})
        if found is not None:
            entry.answer, entry.compile = found["answer"], found["compile"]
            if not found["right"]:
                entry.said = f"wrong: {found['wanted']}"
    for number in range(rounds):
        for entry in entries:
            if not entry.said:
                progress(f"{entry.name}: round {number + 1} of {rounds}")
                seconds = _try(
                    entry, progress, f"{part}:clock", {"peer": peers[entry.name], "threads": threads, **work}
                )
                if seconds is not None:
                    entry.samples.append(seconds)
    return entries


def _try(entry: Entry, progress: Progress, task: str, arguments: dict[str, Any]) -> Any:
    """Call a task; where that fails, the entry says why."""
    try:
        return call(task, **arguments)
    except UnavailableError as error:
        entry.said = f"skipped: {error}"
    except FailedError as error:
        # The rest may name folders of this machine, which the page must not.
        entry.said = f"failed: {str(error).split(':')[0]}"
        progress(f"{entry.name} failed: {error}")
    return None
