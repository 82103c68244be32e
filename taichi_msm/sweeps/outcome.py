"""What is known of a run of a sweep: a row of the table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, Literal, get_args

# How a run ended. Refused: its values are not valid; failed: by an error; died: its process ended twice before it did.
Status = Literal["complete", "diverged", "refused", "failed", "died"]
STATUSES: tuple[Status, ...] = get_args(Status)


@dataclass(frozen=True)
class Outcome:
    """How a run of a sweep ended, and its results; None: it has none."""

    run: int  # its number, from 0
    status: Status
    error: str = ""  # why, if it is not complete
    max_displacement: float | None = None  # [m]
    shortest_spring: float | None = None  # smallest ratio of a spring's length to its rest length
    error_estimate: float | None = None  # as a fraction of the largest displacement
    mesh_error: float | None = None  # likewise
    forces: tuple[float | None, ...] = ()  # the greatest force of every probe at any frame [N]
    notes: tuple[str, ...] = ()  # what to know before trusting the results, besides the errors
    seconds: float | None = field(default=None, compare=False)  # the time that it took [s]


# The columns of the table after those of the keys, in their order; then come the forces of the probes, and seconds.
COLUMNS = ("status", "error", "max_displacement", "shortest_spring", "error_estimate", "mesh_error")


def outcome_of(run: int, record: Mapping[str, Any]) -> Outcome:
    """Take from the record of a run that has ended what the table shows."""
    estimate = record["error_estimate"] or {}
    return Outcome(
        run,
        record["status"],
        record.get("error", ""),
        record["max_displacement"],
        record["shortest_spring"],
        estimate.get("error"),
        estimate.get("mesh_error"),
        tuple(probe.get("greatest_force") for probe in record["probes"]),
        tuple(record["notes"][1:]),  # The first one is of the errors.
        record["timings"]["total"],
    )
