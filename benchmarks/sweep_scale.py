"""Overhead per run of a sweep: seconds, bytes and files, on this machine and by dask.

    python -m benchmarks.sweep_scale [RUNS]

The runs are tiny, and write only a record and a trajectory. Dask's scheduler and workers, one per process of the sweep,
run on this machine. Nothing else should run meanwhile.
"""

from __future__ import annotations

import json
import shutil
import subprocess
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import psutil
from distributed import Client

from benchmarks.process import OUTPUT
from taichi_msm.sweeps.runs import begin_sweep, run_missing
from taichi_msm.sweeps.spec import Sweep, load_sweep
from taichi_msm.sweeps.sweep import finish_sweep, open_executor
from taichi_msm.system.process import available_threads

FOLDER = OUTPUT / "sweep_scale"

SCENE = """\
sheet: {points: [5, 5], size: [0.3, 0.4], mass: 1.0e-3}
springs: {structural: 20, shear: 10, virtual: 0.5}
damping: 0.01
probes: [{force: [0, 300, -1000], load: [[0, 0], [0.1, 100]]}]
time: {duration: 0.1, frames_per_second: 10}
output: [trajectory]
"""

SWEEP = """\
scene: scene.yaml
samples: {runs}
vary:
  damping: {{uniform: [0.005, 0.02]}}
  springs.shear: {{uniform: [5, 20]}}
  sheet.mass: {{uniform: [1.0e-3, 2.0e-3]}}
"""


class Clock:
    """Stopwatch of wall and CPU time of this process."""

    def __init__(self) -> None:
        self._last = time.perf_counter(), time.process_time()

    def seconds(self) -> dict[str, float]:
        """Return the seconds since the last call."""
        before, self._last = self._last, (time.perf_counter(), time.process_time())
        return {"wall": self._last[0] - before[0], "cpu": self._last[1] - before[1]}


def measure(described: Sweep, directory: Path, executor: str | None) -> dict[str, Any]:
    """Execute all runs, and scan the folder as a next command would."""
    clock, times = Clock(), dict[str, Any]()
    state = begin_sweep(described, directory)
    times["begin"] = clock.seconds()
    with open_executor(executor, available_threads(), state, _ignore) as execution:
        clock.seconds()
        for row in run_missing(state, execution, _ignore):
            assert row.status == "complete", row
        times["run"] = clock.seconds()
        again = begin_sweep(described, directory)
        times["scan"] = clock.seconds()
        finish_sweep(again, execution, _ignore)
        times["finish"] = clock.seconds()
    return times


def sizes(directory: Path, runs: int) -> dict[str, float]:
    """Return files, folders, bytes and disk usage of a sweep, per run."""
    entries = list((directory / "runs").rglob("*"))
    files = [path.stat() for path in entries if path.is_file()]
    return {
        "files": len(files) / runs,
        "folders": (len(entries) - len(files)) / runs,
        "bytes": sum(stat.st_size for stat in files) / runs,
        "disk": sum(path.stat().st_blocks * 512 for path in entries) / runs,
        "sweep.json": (directory / "sweep.json").stat().st_size / runs,
        "table.csv": (directory / "table.csv").stat().st_size / runs,
    }


@contextmanager
def cluster(workers: int) -> Iterator[tuple[str, psutil.Process]]:
    """Start a scheduler and its workers; yields the scheduler's address and process."""
    file = FOLDER / "scheduler.json"
    started = [_dask("dask_scheduler", "--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file))]
    try:
        while not file.exists():
            time.sleep(0.1)
        address = json.loads(file.read_text())["address"]
        started += [_dask("dask_worker", address, "--nthreads", "1", "--no-nanny") for _ in range(workers)]
        with Client(address) as client:
            client.wait_for_workers(workers)
        yield address, psutil.Process(started[0].pid)
    finally:
        for process in started:
            process.kill()
            process.wait()


def _dask(program: str, *words: str) -> subprocess.Popen[bytes]:
    command = [sys.executable, "-m", f"distributed.cli.{program}", "--no-dashboard", *words]
    return subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)


def _ignore(_stage: str, _done: int, _total: int) -> None:
    pass


def main() -> None:
    """Measure, and print the results per run."""
    runs = int(sys.argv[1]) if sys.argv[1:] else 1000
    shutil.rmtree(FOLDER, ignore_errors=True)
    FOLDER.mkdir(parents=True)
    (FOLDER / "scene.yaml").write_text(SCENE)
    (FOLDER / "sweep.yaml").write_text(SWEEP.format(runs=runs))
    described = load_sweep(FOLDER / "sweep.yaml")
    results = {"local": measure(described, FOLDER / "local", None)}
    with cluster(available_threads()) as (address, scheduler):
        before, idle = scheduler.memory_info().rss, scheduler.cpu_times()
        results["dask"] = measure(described, FOLDER / "dask", address)
        after, busy = scheduler.memory_info().rss, scheduler.cpu_times()
    print(f"{runs} runs, {available_threads()} workers; for each run:")
    for where, times in results.items():
        for name, seconds in times.items():
            wall, cpu = (seconds[kind] / runs * 1e3 for kind in ("wall", "cpu"))
            print(f"{where:>5} {name:>6}: {wall:8.2f} ms, {cpu:7.2f} ms of the processor")
    cpu = busy.user + busy.system - idle.user - idle.system
    print(f"scheduler: {cpu / runs * 1e3:.2f} ms of the processor; it grew by {(after - before) / 2**20:.0f} MiB")
    for name, number in sizes(FOLDER / "local", runs).items():
        print(f"{name:>10}: {number:.1f}")


if __name__ == "__main__":
    main()
