"""Measure sweeps here: short runs beside single commands, and how busy the cores are while a data set is made.

    python -m benchmarks.sweeps

Writes its lines into docs/sweep.md. Nothing else should run.
"""

from __future__ import annotations

import json
import os
import statistics
import tempfile
import time
from pathlib import Path

import yaml

from benchmarks.process import ROOT
from benchmarks.whole_run import command
from taichi_msm.system import resources
from taichi_msm.system.runtime import vector_bits

ROUNDS = 5
SHORT = {"sheet.points": [31, 31], "output": []}
RUNS, SINGLE = 40, 8

DATA_SET = ROOT / "scenes" / "sweeps" / "tracking.yaml"
FILMED = {"output": ["png", "flow", "occlusion", "depth", "tracks"]}
FILMS, FILM_ROUNDS = 50, 3

PAGE = ROOT / "docs" / "sweep.md"
START, END = "<!-- speed: made by benchmarks/sweeps.py -->\n", "<!-- end of speed -->\n"


def short_runs(folder: Path, cache: str) -> tuple[list[float], list[float]]:
    """Time a sweep of short runs and some of them as single commands, in turn; two times of each round [s]."""
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
        if number >= 0:  # In the first round kernels are compiled.
            sweeps.append(seconds)
            singles.append(time.perf_counter() - start)
    return sweeps, singles


def data_set(folder: Path, cache: str, number: int) -> tuple[float, float, float, int]:
    """Make a data set; gives its time, the processor time, that of drawing, labels and encoding [s], and the frames."""
    content = yaml.safe_load(DATA_SET.read_text())
    # In the folder of the shipped one, as it names files beside it.
    file, out = DATA_SET.with_name(f"benchmark-{os.getpid()}.yaml"), folder / f"films-{number}"
    file.write_text(yaml.safe_dump({**content, "samples": FILMS, "set": {**content.get("set", {}), **FILMED}}))
    try:
        before = os.times()
        seconds = command("sweep", str(file), "--out", str(out), cache=cache)[0]
        after = os.times()
    finally:
        file.unlink()
    busy = after.children_user + after.children_system - before.children_user - before.children_system
    records = [json.loads(path.read_text()) for path in out.glob("runs/*/run.json")]
    assert [record["status"] for record in records] == ["complete"] * FILMS
    others = ("startup", "pilot", "compile", "simulate")
    times = [record["timings"] for record in records]
    pictures = sum(one["total"] - sum(one.get(stage, 0.0) for stage in others) for one in times)
    return seconds, busy, pictures, sum(record["frames"] for record in records)


def main() -> None:
    """Measure, and write the page."""
    cores = resources.available_threads()
    with tempfile.TemporaryDirectory() as directory:
        cache = f"{directory}/cache"
        sweeps, singles = short_runs(Path(directory), cache)
        films = [data_set(Path(directory), cache, number) for number in range(-1, FILM_ROUNDS)][1:]
    ratio = statistics.median(one / other for one, other in zip(sweeps, singles, strict=True))
    seconds, busy, pictures, frames = (statistics.median(column) for column in zip(*films, strict=True))
    text = (
        f"On {cores} cores of an {resources.processor()}, vectors of {vector_bits()} bits, medians of {ROUNDS} and "
        f"{FILM_ROUNDS} rounds with compiled kernels:\n\n"
        f"- {RUNS} runs of `press.yaml` with 31 × 31 points and without pictures take "
        f"{statistics.median(sweeps):.1f} s, {SINGLE} of them as single commands "
        f"{statistics.median(singles):.1f} s: {ratio:.2f} of that for {RUNS // SINGLE} times the runs.\n"
        f"- {FILMS} runs of `tracking.yaml` with pictures, flow, occlusion, depth and tracks take {seconds:.0f} s, "
        f"{frames / seconds:.0f} frames a second. The cores are busy for {busy / cores / seconds:.0%} of it. It is "
        f"{seconds * cores / pictures:.2f} times what drawing, labels and encoding alone take on these cores.\n"
    )
    before, rest = PAGE.read_text(encoding="utf-8").split(START)
    PAGE.write_text(before + START + text + END + rest.split(END)[1], encoding="utf-8")
    print(text)


if __name__ == "__main__":
    main()
