"""Measure sweeps: short runs against single commands, and the use of cores while a data set is made.

    python -m benchmarks.sweeps

Writes its lines into docs/sweep.md. Nothing else should run.
"""

from __future__ import annotations

import json
import os
import shutil
import statistics
import tempfile
import time
from pathlib import Path
from typing import NamedTuple

import yaml

from benchmarks.marked import replace_marked
from benchmarks.process import ROOT
from benchmarks.whole_run import command
from taichi_msm.system import process
from taichi_msm.system.runtime import vector_bits

ROUNDS = 5
SHORT = {"sheet.points": [31, 31], "output": []}
RUNS, SINGLE = 40, 8

DATA_SET = ROOT / "scenes" / "sweeps" / "tracking.yaml"
FILMED = {"output": ["png", "flow", "occlusion", "depth", "tracks"]}
FILMS, FILM_ROUNDS = 50, 2

PAGE = ROOT / "docs" / "sweep.md"


def short_runs(folder: Path, cache: str) -> tuple[list[float], list[float]]:
    """Return times of a sweep of short runs and of some of them as single commands, measured in turn [s]."""
    file = folder / "short.yaml"
    young = {"tissue.young": {"log_uniform": [1e4, 9e4]}}
    scene = os.path.relpath(ROOT / "scenes" / "press.yaml", folder)
    file.write_text(yaml.safe_dump({"scene": scene, "samples": RUNS, "vary": young, "set": SHORT}))
    settings = [word for key, value in SHORT.items() for word in ("--set", f"{key}={json.dumps(value)}")]
    sweeps, singles = [], []
    for number in range(-1, ROUNDS):
        seconds = command("sweep", str(file), "--out", str(folder / f"short-{number}"), cache=cache)[0]
        start = time.perf_counter()
        for single in range(SINGLE):
            command("run", "scenes/press.yaml", *settings, "--out", str(folder / f"single-{single}"), cache=cache)
        if number >= 0:  # the first round compiles
            sweeps.append(seconds)
            singles.append(time.perf_counter() - start)
    return sweeps, singles


class Timing(NamedTuple):
    """Times of making a data set [s]."""

    seconds: float
    busy: float  # CPU time
    pictures: float  # drawing, labels and encoding, in all processes
    stepping: float  # and the estimates of its error, in all processes
    frames: int


def data_set(folder: Path, cache: str, number: int, films: int) -> Timing:
    """Create a data set of some films."""
    content = yaml.safe_load(DATA_SET.read_text())
    # In the folder of the shipped file, which contains relative paths.
    file, out = DATA_SET.with_name(f"benchmark-{os.getpid()}.yaml"), folder / f"films-{number}"
    file.write_text(yaml.safe_dump({**content, "samples": films, "set": {**content.get("set", {}), **FILMED}}))
    try:
        before = os.times()
        seconds = command("sweep", str(file), "--out", str(out), cache=cache)[0]
        after = os.times()
    finally:
        file.unlink()
    busy = after.children_user + after.children_system - before.children_user - before.children_system
    records = [json.loads(path.read_text()) for path in out.glob("runs/*/run.json")]
    assert [record["status"] for record in records] == ["complete"] * films
    times = [record["timings"] for record in records]
    stepping = sum(run["simulate"] + run.get("pilot", 0.0) for run in times)
    pictures = sum(run["total"] - run["startup"] - run["compile"] for run in times) - stepping
    shutil.rmtree(out)
    return Timing(seconds, busy, pictures, stepping, sum(record["frames"] for record in records))


def main() -> None:
    """Measure, and write the page."""
    cores = process.available_threads()
    with tempfile.TemporaryDirectory() as directory:
        folder, cache = Path(directory), f"{directory}/cache"
        sweeps, singles = short_runs(folder, cache)
        data_set(folder, cache, -1, films=2)  # compiles its kernels
        films = [data_set(folder, cache, number, FILMS) for number in range(FILM_ROUNDS)]
    ratio = statistics.median(sweep / single for sweep, single in zip(sweeps, singles, strict=True))
    made = Timing(*(statistics.median(column) for column in zip(*films, strict=True)))
    all_cores = cores * made.seconds
    text = (
        f"On {cores} cores of an {process.processor_name()} with vectors of {vector_bits()} bits, medians of {ROUNDS} "
        f"and {FILM_ROUNDS} rounds, kernels compiled before:\n\n"
        f"- {RUNS} runs of `press.yaml` with 31 × 31 points and without pictures take "
        f"{statistics.median(sweeps):.1f} s; {SINGLE} of them as single commands, one after another, take "
        f"{statistics.median(singles):.1f} s. That is {ratio:.2f} of the time for {RUNS // SINGLE} times the runs.\n"
        f"- {FILMS} runs of `tracking.yaml` with pictures, flow, occlusion, depth and tracks take "
        f"{made.seconds:.0f} s: {made.frames / made.seconds:.0f} frames a second. The cores are busy for "
        f"{made.busy / all_cores:.0%} of it: "
        f"{made.pictures / all_cores:.0%} of the time of all cores goes to drawing, labels and encoding, "
        f"{made.stepping / all_cores:.0%} to stepping and the estimates of its error.\n"
    )
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replace_marked(page, "speed", "benchmarks/sweeps.py", text), encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
