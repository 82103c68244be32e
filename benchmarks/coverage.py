"""Coverage of the 95 % intervals of fits of machine tests.

    python -m benchmarks.coverage [TESTS] [PROCESSES]

Synthetic tests of strips in a clamp and of a ball have random tissue, a random force offset, and noise of 1 % of the
peak force. Measured and fitted forces are of the same mesh, so that mesh errors do not enter. Prints a row per kind of
test: the number of intervals that contain the true value, and the root mean square of the errors in standard errors.
TESTS are 200 by default, and take a quarter of an hour of a core.
"""

from __future__ import annotations

import os
import sys
import tempfile
from concurrent.futures import ProcessPoolExecutor
from itertools import product
from multiprocessing import get_context
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm import Simulation, fit

Array = NDArray[np.float64]

NOISE, OFFSET = 0.01, 0.05  # standard deviations, as shares of the peak force
WAITING = 0.15  # share of the rows before the contact

Result = dict[str, tuple[bool, float]]  # whether the interval contains the true value, and the error, by key


class Kind(NamedTuple):
    """Kind of tests: tool, number of rows, whether the first rows are before the contact, and whether it is free."""

    tool: str
    rows: int
    waits: bool
    free_contact: bool = True

    def __str__(self) -> str:
        suffix = "" if self.free_contact else ", contact found from the noise"
        return f"{self.tool}, {self.rows} rows, {'' if self.waits else 'none '}before contact{suffix}"


KINDS = [Kind(*each) for each in product(("clamp", "ball"), (120, 260), (True, False))]
# Not counted among all: their intervals do not include the error of the contact, and a note reports it.
WITHOUT_CONTACT = [Kind("ball", rows, waits=True, free_contact=False) for rows in (120, 260)]


def scene(tool: str, young: float, lock: float) -> dict[str, Any]:
    """Return a strip of 30 x 10 mm that is pulled along x, or a ball of 10 mm radius on tissue 15 mm thick."""
    common = {"time": {"duration": 1, "motion": "quasistatic"}, "output": []}
    if tool == "clamp":
        return {
            "sheet": {"points": [3, 7], "size": [0.01, 0.03], "fixed": ["left"]},
            "tissue": {"young": young, "thickness": 2e-3, "stiffening": {"lock": lock}},
            "probes": [{"clamp": "right", "path": [[0, 0, 0, 0], [1, 0.012, 0, 0]]}],
            **common,
        }
    foundation = {"young": young, "depth": 0.015, "lock": lock}
    return {
        "sheet": {"points": [17, 17], "size": [0.03, 0.03]},
        "tissue": {"young": 2e4, "thickness": 1e-3, "foundation": foundation, "foundation_active": "always"},
        "probes": [
            {
                "path": [[0, 0.5, 0.5, 0], [1, 0.5, 0.5, -0.003]],
                "instrument": {"radius": 0.01, "shaft": [0, 0, 1], "length": 0.05},
            }
        ],
        **common,
    }


def forces_at(data: dict[str, Any], travel: Array) -> Array:
    """Return the force on the sheet along the tool's motion [N] at travels [m], each of shape (rows,)."""
    is_clamp, zero = "clamp" in data["probes"][0], 0 * travel
    places = [travel, zero, zero] if is_clamp else [zero + 0.5, zero + 0.5, -travel]
    data["probes"][0]["path"] = np.stack([np.arange(len(travel)), *places], axis=1).tolist()
    data["time"] |= {"duration": len(travel) - 1, "frames_per_second": 1}
    forces, direction = [], np.array([1, 0, 0] if is_clamp else [0, 0, -1])
    with Simulation(data) as simulation:
        for frame in range(len(travel)):
            simulation.advance(min(frame, 1))
            forces.append(direction @ np.array(simulation.forces()[0].force))
    return np.array(forces)


def try_test(kind: Kind, seed: int) -> Result:
    """Simulate a test, fit it, and compare the estimates with the true values."""
    random = np.random.default_rng(seed)
    is_clamp, waiting = kind.tool == "clamp", round(WAITING * kind.rows) * kind.waits
    young = (3e5 if is_clamp else 2e4) * 2 ** random.uniform(-1, 1)
    lock = (0.7 if is_clamp else 5e-3) * 1.4 ** random.uniform(-1, 1)
    reach = 0.012 if is_clamp else 0.003
    # The contact is between two rows.
    travel = reach * (np.arange(kind.rows) - waiting + random.uniform() * (waiting > 0)) / (kind.rows - 1 - waiting)
    force = forces_at(scene(kind.tool, young, lock), np.maximum(travel, 0))
    force += force.max() * (OFFSET * random.normal() + NOISE * random.normal(size=kind.rows))
    # A clamp waits; a ball approaches. Depths of the table begin with 0.
    depth = np.maximum(travel, 0) if is_clamp else travel - travel[0]
    lines = ["time [s],depth [mm],force [N]"]
    lines += [f"{n / 20:.3f},{1000 * d:.6f},{f:.8f}" for n, (d, f) in enumerate(zip(depth, force, strict=True))]
    truth = {"tissue.young": young, "tissue.stiffening.lock": lock}
    options: dict[str, Any] = {}
    if not is_clamp:
        truth = {"tissue.foundation.young": young, "tissue.foundation.lock": lock}
        if kind.waits and kind.free_contact:
            truth["contact"] = depth[0] - travel[0]
        elif not kind.waits:
            options["contact"] = [0.0]
    start = scene(kind.tool, *(value * 1.5 ** random.uniform(-1, 1) for value in (young, lock)))
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "test.csv"
        table.write_text("\n".join(lines) + "\n")
        result = fit(start, str(table), list(truth), workers=1, **options)
    compared = {}
    for key, value in truth.items():
        estimate = result.parameters[key]
        low, high = estimate.interval
        covered = (low is None or low <= value) and (high is None or value <= high)
        compared[key.rpartition(".")[2]] = (covered, (estimate.value - value) / estimate.standard_error)
    # Not intervals: whether the right model is rejected, and whether a note reports the error of the contact.
    is_noted = any("found from the noise" in note for note in result.notes)
    return compared | {"rejected": (result.model_rejected, np.nan), "noted": (is_noted, np.nan)}


def use_one_core() -> None:
    """Restrict a worker process to a core."""
    os.sched_setaffinity(0, [sorted(os.sched_getaffinity(0))[os.getpid() % len(os.sched_getaffinity(0))]])


def main(tests: int = 200, processes: int = 2) -> None:
    """Print the table of coverage."""
    jobs = [(KINDS[n % len(KINDS)], n) for n in range(tests)]
    jobs += [(kind, n) for kind in WITHOUT_CONTACT for n in range(tests // len(KINDS))]
    with ProcessPoolExecutor(processes, get_context("spawn"), use_one_core) as pool:
        results = list(pool.map(try_test, *zip(*jobs, strict=True)))
    rows = {str(kind): [kind] for kind in KINDS} | {"all": KINDS} | {str(kind): [kind] for kind in WITHOUT_CONTACT}
    print("| tests | young | lock | contact | rms errors of young, lock | rejected | noted |")
    print("|---" * 7 + "|")
    for title, kinds in rows.items():
        part = [result for (kind, _), result in zip(jobs, results, strict=True) if kind in kinds]
        cells = []
        for name in ("young", "lock", "contact"):
            inside = [result[name][0] for result in part if name in result]
            cells.append(f"{sum(inside)} of {len(inside)} ({100 * np.mean(inside):.1f} %)" if inside else "")
        rms = [np.sqrt(np.mean([result[name][1] ** 2 for result in part])) for name in ("young", "lock")]
        counts = [sum(result[name][0] for result in part) for name in ("rejected", "noted")]
        print(f"| {title} | {' | '.join(cells)} | {rms[0]:.2f}, {rms[1]:.2f} | {counts[0]} | {counts[1]} |")


if __name__ == "__main__":
    main(*map(int, sys.argv[1:]))
