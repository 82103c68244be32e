"""What a sweep is as a data set: what varied, what the runs have, and which of them are for training.

A tenth of all runs is for testing and a tenth for validation, to the nearest run: the first and the next in the order
of the SHA-256 of "SEED RUN". So the part of a run follows from the seed, its number and the number of runs alone: not
from which runs failed, nor from the version of any library.
"""

from __future__ import annotations

import hashlib
import json
from pathlib import Path
from typing import Any

from taichi_msm.outputs.table import RECORD
from taichi_msm.results.publication import MAX_RECORD
from taichi_msm.results.whole import replacing
from taichi_msm.sweeps.result import DATASET, SweepResult
from taichi_msm.system.files import read_regular
from taichi_msm.system.versions import versions

# Where the keys of a scene are that decide what a run writes.
DECIDING = ("output", "render", "time")


def write_dataset(result: SweepResult) -> tuple[list[str], list[str]]:
    """Write the data set, with a line for every complete run; returns its name, and no notes."""
    sweep, complete = result.sweep, [outcome.run for outcome in result.outcomes if outcome.status == "complete"]
    common = _facts(result.run_directory(complete[0])) if complete else {}
    differ = any(key.split(".")[0] in DECIDING for key in sweep.keys)
    parts = split(len(result.outcomes), sweep.settings.seed)
    head = {"scene": sweep.settings.scene, **sweep.description(), "versions": versions(), **common}
    with replacing(result.directory / DATASET) as file:
        file.write(b"{\n")
        for name, value in head.items():
            file.write(f'"{name}": '.encode() + _json(value) + b",\n")
        file.write(b'"runs": [')
        for run in complete:
            directory = result.run_directory(run)
            folder = directory.relative_to(result.directory).as_posix()
            values = dict(zip(sweep.keys, result.values[run], strict=True))
            own = _facts(directory) if differ else {}
            row = {"run": run, "folder": folder, "part": parts[run], "values": values, **own}
            file.write((b"" if run == complete[0] else b",") + b"\n" + _json(row))
        file.write(b"\n]\n}\n")
    return [DATASET], []


def split(runs: int, seed: int) -> list[str]:
    """Give the part of every run: train, val or test."""
    order = sorted(range(runs), key=lambda run: hashlib.sha256(f"{seed} {run}".encode()).digest())
    tenth = (runs + 5) // 10
    parts = ["train"] * runs
    for name, chosen in (("test", order[:tenth]), ("val", order[tenth : 2 * tenth])):
        for run in chosen:
            parts[run] = name
    return parts


def _facts(directory: Path) -> dict[str, Any]:
    """Give what a loader needs to know of a run: its outputs, the frames, their size [px] and how many a second."""
    record = json.loads(read_regular(directory / RECORD, MAX_RECORD))
    scene = record["scene"]
    return {
        "outputs": record["outputs"],
        "frames": record["frames"],
        "size": scene["render"]["size"],
        "frames_per_second": scene["time"]["frames_per_second"],
    }


def _json(value: Any) -> bytes:
    return json.dumps(value, ensure_ascii=False).encode("utf-8", "backslashreplace")
