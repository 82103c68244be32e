"""Sweeps on workers of dask.distributed, with schedulers and workers in separate processes."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest

from taichi_msm.errors import MsmError
from taichi_msm.images import use_copies
from taichi_msm.load.scene_file import plan_file
from taichi_msm.sweeps.runs import begin_sweep
from taichi_msm.sweeps.spec import load_sweep
from tests.conftest import Program
from tests.golden import Messages
from tests.outputs import results
from tests.sweeps.conftest import CALIBRATION, POSES

distributed = pytest.importorskip("distributed", reason="needs dask.distributed: pip install distributed")

from taichi_msm.sweeps import cluster as dask_cluster  # noqa: E402
from taichi_msm.sweeps.cluster import Inputs, cluster_connection  # noqa: E402

SWEEP = """\
scene: small.yaml
samples: 6
vary: {damping: {uniform: [0.005, 0.02]}}
set: {sheet.points: [5, 5], time.duration: 0.1, output: [trajectory], render.camera: {calibration: k.yml, poses: t.txt}}
"""

# Limit of a test that hangs: all waits are for events, which take seconds, or minutes on a loaded machine.
MAX_WAIT_S = 1200.0

# The program, which waits as long for a scheduler.
PROGRAM = f"""
import runpy
from taichi_msm.sweeps import cluster
cluster.MAX_WAIT_S = {MAX_WAIT_S}
runpy.run_module("taichi_msm", run_name="__main__")
"""

# A worker with this module never ends run 3.
GATE = """
import time
from functools import wraps
from taichi_msm.sweeps import cluster

def dask_setup(worker):
    execute = cluster._execute_run

    @wraps(execute)
    def gated(name, run, *arguments):
        while run == 3:
            time.sleep(1)
        return execute(name, run, *arguments)

    cluster._execute_run = gated
"""


class Machines:
    """Processes of schedulers and workers, with a log each, and of sweeps."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.started: list[subprocess.Popen[bytes]] = []
        self.sweeps: list[subprocess.Popen[str]] = []

    def schedule(self) -> str:
        """Start a scheduler; return its address."""
        file = self.folder / f"scheduler-{len(self.started)}.json"
        words = ["--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file)]
        self.scheduler = self._start("dask_scheduler", *words)
        # The file is created before it is written.
        wait_for(lambda: file.exists() and file.read_text().endswith("}"), self.scheduler)
        return str(json.loads(file.read_text())["address"])

    def work(self, address: str, *words: str) -> subprocess.Popen[bytes]:
        """Start a worker, by default of one thread."""
        return self._start("dask_worker", address, *(words or ("--nthreads", "1", "--no-nanny")))

    def sweep(self, out: str, address: str, *words: str) -> subprocess.Popen[str]:
        """Start a sweep."""
        command = [sys.executable, "-c", PROGRAM, "sweep", "here/sweep.yaml", "--out", out, "--dask", address]
        self.sweeps.append(
            subprocess.Popen([*command, *words], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
        )
        return self.sweeps[-1]

    def log(self, process: subprocess.Popen[bytes]) -> str:
        return (self.folder / f"{self.started.index(process)}.log").read_text()

    def _start(self, program: str, *words: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.{program}", "--no-dashboard", *words]
        environment = {**os.environ, "DASK_TEMPORARY_DIRECTORY": str(self.folder)}
        with (self.folder / f"{len(self.started)}.log").open("wb") as log:
            process = subprocess.Popen(
                command, cwd=self.folder, env=environment, stdout=log, stderr=log, start_new_session=True
            )
        self.started.append(process)
        return process


@pytest.fixture
def machines(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Machines]:
    machines = Machines(tmp_path_factory.mktemp("machines"))
    yield machines
    for process in machines.started:
        os.killpg(process.pid, signal.SIGKILL)
        process.wait()
    for sweep in machines.sweeps:
        sweep.kill()
        sweep.communicate()


@pytest.fixture
def lab(small: Path) -> Path:
    """The current directory, with a scene, its picture and a sweep in the folder `here`."""
    (small / "here").mkdir()
    for name in ("small.yaml", "speckle.png"):
        (small / name).rename(small / "here" / name)
    for name, text in (("sweep.yaml", SWEEP), ("k.yml", CALIBRATION), ("t.txt", POSES)):
        (small / "here" / name).write_text(text)
    return small


def wait_for(happened: Callable[[], Any], *processes: subprocess.Popen[Any]) -> None:
    """Wait for an event that processes bring about."""
    end = time.monotonic() + MAX_WAIT_S
    while not happened():
        assert time.monotonic() < end
        assert all(process.poll() is None for process in processes)
        time.sleep(0.02)


def rows(out: str) -> list[str]:
    """Return the rows of the table, without the seconds."""
    return [line.rpartition(",")[0] for line in Path(out, "table.csv").read_text().splitlines()]


@pytest.mark.slow
def test_workers_get_the_inputs_and_may_die(lab: Path, machines: Machines, program: Program) -> None:
    address = machines.schedule()
    command = machines.sweep("far", address, "--json")
    wait_for(lambda: "plugin taichi-msm" in machines.log(machines.scheduler), machines.scheduler, command)
    # Workers start after the removal of the inputs, of which they get copies.
    (lab / "here").rename(lab / "away")
    doomed = machines.work(address)
    wait_for(lambda: list(lab.glob("far/runs/*/.partial")), doomed, command)
    doomed.kill()
    machines.work(address, "--nthreads", "1")
    output, errors = command.communicate(timeout=MAX_WAIT_S)
    assert (command.returncode, json.loads(output)["complete"], errors) == (0, 6, "")

    (lab / "away").rename(lab / "here")
    assert program("sweep", "here/sweep.yaml", "--out", "near").returncode == 0
    assert rows("far") == rows("near")
    # The workers draw it from the trajectories.
    assert (lab / "far" / "contact.jpg").read_bytes() == (lab / "near" / "contact.jpg").read_bytes()
    for run in sorted(lab.glob("near/runs/*")):
        assert results(run) == results(lab / "far" / "runs" / run.name)
    assert program("run", "--again", "far/runs/000003", "--out", "again", "--quiet").returncode == 0
    assert results(lab / "again") == results(lab / "near" / "runs" / "000003")


@pytest.mark.slow
def test_sweep_resumes_after_the_loss_of_its_scheduler(lab: Path, machines: Machines, message: Messages) -> None:
    (machines.folder / "gate.py").write_text(GATE)
    address = machines.schedule()
    worker = machines.work(address, "--nthreads", "1", "--no-nanny", "--preload", str(machines.folder / "gate.py"))
    command = machines.sweep("far", address, "--json")
    wait_for(lambda: list(lab.glob("far/runs/*/run.json")), worker, command)
    machines.scheduler.kill()
    output, _ = command.communicate(timeout=MAX_WAIT_S)
    (error,) = json.loads(output)["errors"]
    ended = int(error.split("; ")[1].split()[0])
    assert address in error
    message(error, "of 6 runs", hide=r"tcp:[^;]*; \d+")
    assert command.returncode == 4

    earlier = {path: path.stat().st_mtime_ns for path in sorted(lab.glob("far/runs/*/run.json"))[:ended]}
    address = machines.schedule()
    machines.work(address)
    output, _ = machines.sweep("far", address, "--json").communicate(timeout=MAX_WAIT_S)
    assert json.loads(output)["complete"] == 6
    assert earlier == {path: path.stat().st_mtime_ns for path in earlier}


@pytest.mark.slow
def test_interruption_frees_the_workers(lab: Path, machines: Machines, message: Messages) -> None:
    address = machines.schedule()
    worker = machines.work(address)
    takes_minutes = SWEEP.replace("[5, 5], time.duration: 0.1", "[99, 99], time.duration: 900")
    (lab / "here" / "sweep.yaml").write_text(takes_minutes)
    command = machines.sweep("long", address)
    wait_for(lambda: list(lab.glob("long/runs/*/.partial")), worker, command)
    command.send_signal(signal.SIGINT)
    _, errors = command.communicate(timeout=MAX_WAIT_S)
    message(errors.splitlines()[-1], "interrupted", "0 of 6 runs")
    assert command.returncode == 130

    (lab / "here" / "sweep.yaml").write_text(SWEEP)
    output, _ = machines.sweep("far", address, "--json").communicate(timeout=MAX_WAIT_S)
    assert json.loads(output)["complete"] == 6


def test_missing_files_are_read_from_copies(lab: Path) -> None:
    sweep = load_sweep(lab / "here" / "sweep.yaml")
    copies = {path: lab / "away" / Path(path).name for path in sweep.files}
    (lab / "here").rename(lab / "away")
    with use_copies(copies):
        plan = plan_file(sweep.scene, sweep.overrides(sweep.values()[0]))
    assert len(plan.sha256) == 2, "calibration and trajectory"


@pytest.fixture
def cluster() -> Iterator[Callable[[int], str]]:
    """Start a scheduler with a worker of some threads in this process; return its address."""
    options = {"n_workers": 1, "processes": False, "protocol": "tcp", "host": "127.0.0.1", "dashboard_address": ":0"}
    with ExitStack() as stack:
        yield lambda threads: str(
            stack.enter_context(distributed.LocalCluster(threads_per_worker=threads, **options)).scheduler_address
        )


def test_unsuitable_workers_are_refused(
    lab: Path, cluster: Callable[[int], str], program: Program, message: Messages
) -> None:
    result = program("sweep", "here/sweep.yaml", "--out", "far", "--dask", cluster(2))
    assert result.returncode == 2
    message(result.stderr, "--nthreads 1", hide=r"(?<=about ).*(?= if)|\d[\d.]*(?= MiB)|tcp://[^ ]*")
    worker = SimpleNamespace(address="tcp://far", state=SimpleNamespace(nthreads=1), local_directory=str(lab))
    inputs = Inputs(load_sweep("here/sweep.yaml"), lab / "out")
    with message.raises(MsmError, "tcp://far", "--out"):
        inputs.setup(worker)
    (lab / "out").mkdir()
    (lab / "out" / "sweep.json").touch()
    inputs.versions |= {"numpy": "0.1"}
    with message.raises(MsmError, "tcp://far", "numpy 0.1"):
        inputs.setup(worker)


@pytest.mark.parametrize(
    ("address", "word"),
    [
        ("tcp://127.0.0.1:1", "dask scheduler"),
        ("nowhere", "give the address"),
        ("tls://127.0.0.1:1", "certificates"),
    ],
    ids=["nobody", "no port", "tls"],
)
def test_unreachable_schedulers(
    address: str, word: str, lab: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    monkeypatch.setattr("taichi_msm.sweeps.cluster.MAX_WAIT_S", 0.5)
    result = program("sweep", "here/sweep.yaml", "--out", "far", "--json", "--dask", address)
    assert result.returncode == 2
    # The reason is a text of dask.
    message(json.loads(result.stdout)["errors"], address, word, hide="missing port.*(?=; )")


def test_lost_connections(monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    inputs: Any = None
    with message.raises(MsmError, "packages"):
        register = Mock(side_effect=ImportError("No module named 'numpy'"))
        dask_cluster._register_inputs(inputs, "inputs", Mock(register_plugin=register))
    with message.raises(MsmError):
        dask_cluster._wait_for_worker(Mock(nthreads=Mock(side_effect=OSError)), lambda stage, done, total: None)
    monkeypatch.setattr(dask_cluster, "get_worker", lambda: SimpleNamespace(plugins={}))
    with message.raises(MsmError):
        dask_cluster._inputs("inputs")


def test_inputs_removed_by_another_command(lab: Path, cluster: Callable[[int], str]) -> None:
    address, described = cluster(1), load_sweep("here/sweep.yaml")
    begin_sweep(described, lab / "out")
    connection = partial(cluster_connection, address, described, lab / "out", lambda stage, done, total: None)
    with connection(), connection():
        pass


def test_dask_with_workers_or_without_distributed(
    lab: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    command = ("sweep", "here/sweep.yaml", "--dask", "tcp://127.0.0.1:1")
    result = program(*command, "--workers", "2")
    assert result.returncode == 2
    message(result.stderr, "--dask")
    monkeypatch.delitem(sys.modules, "taichi_msm.sweeps.cluster", raising=False)
    monkeypatch.setitem(sys.modules, "distributed", None)
    result = program(*command)
    assert result.returncode == 2
    message(result.stderr, "pip install distributed", hide="about .* on disk")
