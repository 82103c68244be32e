"""Start of Taichi, its threads and memory, and messages of failed allocations."""

from __future__ import annotations

import json
import os
from pathlib import Path
from typing import Any

import pytest

from taichi_msm.cli.main import main
from taichi_msm.model.sheet import rest_positions
from taichi_msm.render.rasterizer import Rasterizer
from taichi_msm.system import process as process_module
from taichi_msm.system import runtime
from taichi_msm.system.compiler import active_compiler
from tests.golden import Messages
from tests.motion import dynamics_of
from tests.scenes import SHEET, scene, speckle
from tests.system import python

# Start, occupy every thread of the pool, and print the processor time [ticks] and the cores of each thread.
WORK = """
import json, os
from pathlib import Path
from taichi_msm.system import runtime
from taichi_msm.system.runtime import ITERATIONS_PER_THREAD, ti

tasks = runtime.start().threads
sums = ti.field(ti.f64, tasks)
@ti.kernel
def work():
    for i in range(tasks * ITERATIONS_PER_THREAD):
        if i % ITERATIONS_PER_THREAD == 0:
            total = ti.cast(0, ti.f64)
            for j in range(10_000_000):
                total += ti.sin(total + j)
            sums[i // ITERATIONS_PER_THREAD] = total
work()
threads = [int(task.name) for task in Path("/proc/self/task").iterdir()]
ticks = {t: int(Path(f"/proc/self/task/{t}/stat").read_text().rsplit(")", 1)[1].split()[11]) for t in threads}
print(json.dumps([[t == os.getpid(), ticks[t], sorted(os.sched_getaffinity(t))] for t in threads]))
"""


@pytest.mark.skipif(not Path("/proc/self/task").is_dir(), reason="needs /proc")
def test_worker_threads_are_pinned(tmp_path: Path) -> None:
    cores = sorted(os.sched_getaffinity(0))
    if process_module.available_threads() != len(cores):
        pytest.skip("a quota keeps this process from using all of its cores")
    threads = json.loads(python(tmp_path, WORK).stdout)
    workers = sorted((thread for thread in threads if not thread[0]), key=lambda thread: thread[1])[-len(cores) :]
    assert sorted(on for _, _, on in workers) == [[core] for core in cores]
    assert all(on == cores for main, ticks, on in threads if [main, ticks, on] not in workers)


@pytest.mark.slow
def test_memory_is_reused(device: runtime.Device) -> None:
    """Also with more sheets than Taichi's limit of 512 trees of fields."""

    def resident() -> int:
        return int(Path("/proc/self/statm").read_text().split()[1]) * os.sysconf("SC_PAGE_SIZE")

    made = scene(sheet={**SHEET, "points": [60, 60]}, render={"size": [64, 64]})
    texture = speckle(8, 8)
    sheets: list[Any] = []
    sizes = []
    for _ in range(3):
        for _ in range(100):
            sheets.append(dynamics_of(made, device))
            sheets.append(Rasterizer(made, texture))
        sheets[-2].advance(1)
        sheets[-1].draw(rest_positions(made.sheet))
        sheets.clear()
        if Path("/proc/self/statm").exists():
            sizes.append(resident())
    # The memory of the last 200 is reused; Python's pools may grow slightly.
    assert not sizes or sizes[2] - sizes[1] < 4 * 2**20


def test_time_of_waiting_for_a_core(tmp_path: Path) -> None:
    for task, wait_ns in (("7", 250_000_000), ("8", 50_000_000)):
        (tmp_path / task).mkdir()
        (tmp_path / task / "schedstat").write_text(f"1000 {wait_ns} 3\n")
    assert process_module.core_wait_s(tmp_path) == pytest.approx(0.3)
    assert process_module.core_wait_s(tmp_path / "missing") is None


# Use of a simulation in another thread and in a forked process.
THREAD_AND_FORK = """
import os, threading, warnings
from taichi_msm import MsmError, Simulation
from tests.motion import dynamics_of
from tests.scenes import scene

simulation = Simulation(scene())
simulation.advance()
def attempt(work):
    try:
        work()
    except MsmError as error:
        print(error, flush=True)
for work in (simulation.advance, simulation.draw, simulation.close, lambda: Simulation(scene())):
    thread = threading.Thread(target=attempt, args=[work])
    thread.start()
    thread.join()
# Python from 3.12 on warns of forking a process with threads, such as Taichi's.
warnings.filterwarnings("ignore", "This process .* is multi-threaded", DeprecationWarning)
child = os.fork()
if child == 0:
    attempt(simulation.advance)
    attempt(lambda: Simulation(scene()))
    os._exit(0)
assert os.waitpid(child, 0)[1] == 0
simulation.advance()
print(simulation.frame)
"""


@pytest.mark.skipif(not hasattr(os, "fork"), reason="forks")
def test_threads_and_forked_processes_are_refused(tmp_path: Path, message: Messages) -> None:
    """Taichi would fail with another error, or hang."""
    done = python(tmp_path, THREAD_AND_FORK)
    *lines, frame = done.stdout.splitlines()
    assert ([lines.count(line) for line in lines], frame, done.stderr) == ([4] * 4 + [2] * 2, "2", "")
    message(lines[3:5], hide=active_compiler().title)


# Two threads start the compiler at once.
TWO_STARTS = """
import os, threading
from concurrent.futures import ThreadPoolExecutor
from taichi_msm import MsmError
from taichi_msm.system import runtime

def start(barrier):
    barrier.wait()
    try:
        return runtime.start("cpu", 2).threads
    except MsmError as error:
        return str(error)
with ThreadPoolExecutor(2) as pool:
    results = sorted(map(str, pool.map(start, [threading.Barrier(2)] * 2)))
print(*results, runtime.ti.lang.impl.current_cfg().debug, sorted(os.environ.items() & given.items()), sep="|")
"""


def test_start_ignores_environment_and_threads(tmp_path: Path, message: Messages) -> None:
    """Environment variables of the compiler would override arguments of its start."""
    settings = {"ARCH": "opengl", "DEBUG": "1", "CPU_MAX_NUM_THREADS": "1", "LOG_LEVEL": "loud", "OFFLINE_CACHE": "no"}
    given = {f"{active_compiler().prefix}_{name}": value for name, value in settings.items()}
    done = python(tmp_path, f"given = {given}\n{TWO_STARTS}", **given)
    assert (done.returncode, done.stderr) == (0, "")
    threads, refused, debug, variables = done.stdout.removesuffix("\n").split("|")
    assert (threads, debug, variables) == ("2", "False", str(sorted(given.items())))
    message(refused, hide=active_compiler().title)


@pytest.mark.parametrize(
    "error",
    [
        MemoryError("Unable to allocate 256. MiB for an array"),
        MemoryError(),
        RuntimeError("[host_memory_pool.cpp:allocate_raw_memory@62] Virtual memory allocation (24 B) failed."),
        RuntimeError("in the encoder: MemoryError: Unable to allocate 3. MiB"),
        RuntimeError("list index out of range"),
    ],
    ids=["NumPy", "Python", "Taichi", "encoder", "bug"],
)
def test_failed_allocation(error: Exception, small: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    """Other errors are reported as bugs, with exit code 1."""

    def fail(*_: object, **__: object) -> None:
        raise error

    monkeypatch.setattr("taichi_msm.runs.run.run", fail)
    capture = []
    monkeypatch.setattr("taichi_msm.cli.common.report_failure", lambda kind, lines, as_json: capture.extend(lines))
    code = main(["run", "small.yaml"])
    message(capture)
    assert code == (1 if "a bug" in capture[0] else 2)
