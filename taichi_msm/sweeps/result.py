"""A sweep whose runs have ended."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from taichi_msm.outputs.table import RUNS, numbered
from taichi_msm.sweeps.outcome import COLUMNS, Outcome
from taichi_msm.sweeps.sweepfile import Sweep

# The files that a sweep ends with.
FILES = TABLE, PARQUET, DATASET, CONTACT, PLOT, SENSITIVITY = (
    "table.csv",
    "table.parquet",
    "dataset.json",
    "contact.jpg",
    "sweep.png",
    "sensitivity.csv",
)


@dataclass(frozen=True)
class SweepResult:
    """What came out of all runs of a sweep."""

    directory: Path
    sweep: Sweep
    values: list[list[Any]]  # of the varied keys, for each run
    outcomes: list[Outcome]  # one for each run, in the order of their numbers

    def columns(self) -> dict[str, list[Any]]:
        """Give the columns of the table after those of the keys, by their names: a value for each run."""
        runs = self.outcomes
        columns = {name: [getattr(one, name) for one in runs] for name in COLUMNS}
        for n in range(max((len(one.forces) for one in runs), default=0)):
            name = f"probes.{n}.force"
            # Which is a key of a scene, too.
            name += ".greatest" if name in self.sweep.keys else ""
            columns[name] = [one.forces[n] if n < len(one.forces) else None for one in runs]
        return columns | {"seconds": [one.seconds for one in runs]}

    def run_directory(self, run: int) -> Path:
        """Name the folder of a run."""
        return self.directory / RUNS / numbered(run)

    def some(self, most: int) -> list[int]:
        """Give the numbers of at most so many runs, evenly spread over all."""
        total, count = len(self.outcomes), min(len(self.outcomes), most)
        return [(2 * n + 1) * total // (2 * count) for n in range(count)]
