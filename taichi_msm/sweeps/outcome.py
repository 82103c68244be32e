"""What is known of a run of a sweep: a row of the table."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar, Literal, get_args

from pydantic import ConfigDict, TypeAdapter

# How a run ended. Refused: its values are not valid; failed: by an error; died: its process ended twice before it did.
Status = Literal["complete", "diverged", "refused", "failed", "died"]
STATUSES: tuple[Status, ...] = get_args(Status)


@dataclass(frozen=True)
class Outcome:
    """How a run of a sweep ended, and its results; None: it has none."""

    __pydantic_config__: ClassVar[ConfigDict] = ConfigDict(allow_inf_nan=False)

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


_OUTCOME = TypeAdapter(Outcome)

# The columns of the table after those of the keys, in their order; then come the forces of the probes, and seconds.
COLUMNS = ("status", "error", "max_displacement", "shortest_spring", "error_estimate", "mesh_error")


def outcome_of(run: int, record: Mapping[str, Any]) -> Outcome:
    """Take from the record of a run that has ended what the table shows; ValueError: no run has written that."""
    estimate = record["error_estimate"] or {}
    return _OUTCOME.validate_python(
        {
            "run": run,
            "status": record["status"],
            "error": record.get("error", ""),
            "max_displacement": record["max_displacement"],
            "shortest_spring": record["shortest_spring"],
            "error_estimate": estimate.get("error"),
            "mesh_error": estimate.get("mesh_error"),
            "forces": tuple(probe.get("greatest_force") for probe in record["probes"]),
            "notes": tuple(record["notes"][1:]),  # The first one is of the errors.
            "seconds": record["timings"]["total"],
        }
    )
