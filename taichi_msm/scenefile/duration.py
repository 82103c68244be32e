"""How long a run will take: its work, times how long earlier runs on this machine took for theirs.

What earlier runs took is kept beside the compiled kernels, as a few numbers; where there are none yet, a
short calibration tells how fast the machine is. A file that cannot be read or written, or that another machine has
written, is as none.
"""

from __future__ import annotations

import json
import math
import os
import time
from collections.abc import Mapping
from contextlib import suppress
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from taichi_msm.errors import MsmError
from taichi_msm.physics.pilots import ENOUGH, choose_pilots
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.workload import work
from taichi_msm.system import resources
from taichi_msm.system.compiler import chosen

# Time of a unit of work [s], and of the calibration, on two cores of an AMD EPYC of 2024.
UNIT, CALIBRATION = 1.5e-9, 1e-4

# How much of what was kept before stays when another run is added, so that it follows the machine.
KEPT = 0.25

# A unit of work takes no less and no more than this [s]; other numbers were not measured.
FASTEST, SLOWEST = 1e-12, 1e-3

# A part of a run that took less than this tells nothing of longer ones [s].
SHORTEST = 0.05

MAX_BYTES = 4096

# For each part of a run: the seconds that it took, and its work.
Kept = dict[str, tuple[float, float]]


class Duration(NamedTuple):
    """How long a run will take."""

    seconds: float  # from start to end [s]
    start: float  # the part of it before the first step [s]
    measured: bool  # whether that is known from earlier runs, and not only from the calibration


def estimate(plan: Plan) -> Duration:
    """Estimate how long a run takes on a CPU, with every core; computing it takes milliseconds."""
    kept = _read()
    parts = work(plan, choose_pilots(plan).cost)._asdict()
    if missing := [name for name in parts if name not in kept]:
        if "calibration" not in kept:
            kept["calibration"] = _calibrate(), CALIBRATION / UNIT
            _write(kept)
        kept |= dict.fromkeys(missing, kept["calibration"])
    seconds = {name: amount * (kept[name][0] / kept[name][1]) for name, amount in parts.items()}
    return Duration(sum(seconds.values()), seconds["start"], "start" not in missing)


def learn(plan: Plan, record: Mapping[str, Any]) -> None:
    """Keep what a run took, by its run.json, if it is one that `estimate` means: complete, on a CPU with every core."""
    tolerances = plan.scene.sheet.tolerance, plan.scene.time.tolerance
    plain = record["arch"] == "cpu" and record["threads"] == resources.available_threads() and not record["resumed"]
    if record["status"] != "complete" or not plain or tolerances != (None, None):
        return
    times, kept = record["timings"], _read()
    took = {
        "start": times["startup"] + times["compile"],
        "stepping": times["simulate"],
        "pilots": times.get("pilot", 0.0),
    }
    took["pictures"] = times["total"] - sum(took.values())
    if ((record["error_estimate"] or {}).get("error") or 0.0) >= ENOUGH:
        took["pilots"] = 0.0  # A finer one may have followed.
    for name, amount in work(plan, choose_pilots(plan).cost)._asdict().items():
        if amount > 0 and took[name] > SHORTEST:
            seconds, before = kept.get(name, (0.0, 0.0))
            kept[name] = KEPT * seconds + took[name], KEPT * before + amount
    _write(kept)


def _calibrate() -> float:
    """Time a step of a small sheet in NumPy [s]: the fastest of some, which other programs disturb least."""
    field, fastest = np.zeros((256, 256), np.float32), math.inf
    for _ in range(20):
        start = time.perf_counter()
        around = field[:-2, 1:-1] + field[2:, 1:-1] + field[1:-1, :-2] + field[1:-1, 2:]
        field[1:-1, 1:-1] += 0.1 * (around - 4 * field[1:-1, 1:-1])
        fastest = min(fastest, time.perf_counter() - start)
    return fastest


def _file() -> Path:
    """Name the file, in the folder of compiled kernels; RuntimeError: there is no home; MsmError: no compiler."""
    return chosen().folder() / "taichi-msm.json"


def _machine() -> str:
    return f"{resources.processor()}, {resources.available_threads()} cores"


def _read() -> Kept:
    """Read what this machine has kept: only what can have been measured."""
    try:
        file = _file()
        # Opening a pipe would block until its other end is opened.
        if not file.is_file():
            return {}
        with file.open("rb") as opened:
            content = json.loads(opened.read(MAX_BYTES))
        parts = content["parts"] if content["machine"] == _machine() else {}
        pairs = {str(name): (float(seconds), float(amount)) for name, (seconds, amount) in parts.items()}
    except (OSError, ValueError, TypeError, LookupError, AttributeError, ArithmeticError, RuntimeError, MsmError):
        return {}
    return {name: pair for name, pair in pairs.items() if pair[1] > 0 and FASTEST <= pair[0] / pair[1] <= SLOWEST}


def _write(kept: Kept) -> None:
    """Replace what is kept, whole or not at all, if there is a folder of compiled kernels."""
    with suppress(OSError, RuntimeError, MsmError):
        file = _file()
        staged = file.with_name(f".taichi-msm-{os.getpid()}")
        with staged.open("x") as new:
            try:
                new.write(json.dumps({"machine": _machine(), "parts": kept}))
                new.close()
                staged.replace(file)
            finally:
                staged.unlink(missing_ok=True)
