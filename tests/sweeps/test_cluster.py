"""Sweeps on workers of dask.distributed: real schedulers and workers, in processes of their own."""

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

import pytest

from taichi_msm.errors import MsmError
from taichi_msm.sweeps.runs import begin_sweep
from taichi_msm.sweeps.spec import load_sweep
from tests.conftest import Program
from tests.golden import Messages
from tests.outputs import results

distributed = pytest.importorskip("distributed", reason="needs dask.distributed: pip install distributed")

from taichi_msm.sweeps.cluster import Inputs, cluster_connection  # noqa: E402

SWEEP = """\
scene: small.yaml
samples: 6
vary: {damping: {uniform: [0.005, 0.02]}}
set: {sheet.points: [5, 5], time.duration: 0.1, output: [trajectory], render.camera: {calibration: k.yml, poses: t.txt}}
"""
CALIBRATION = "K: [50, 0, 20, 0, 50, 15, 0, 0, 1]\nD: [0, 0, 0, 0]\nwidth: 40\nheight: 30\n"
POSES = "0 0 0 0.4 1 0 0 0\n999 0 0 0.5 1 0 0 0\n"

# Until something happens that must [s].
SOON = 150.0


class Machines:
    """A scheduler and its workers, whose logs are kept."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.started: list[subprocess.Popen[bytes]] = []

    def schedule(self, **settings: str) -> str:
        """Start a scheduler; returns its address."""
        file = self.folder / f"scheduler-{len(self.started)}.json"
        words = ["--host", "127.0.0.1", "--port", "0", "--scheduler-file", str(file)]
        self.scheduler = self._start("dask_scheduler", *words, **settings)
        # It exists a moment before it holds anything.
        wait_for(lambda: file.exists() and file.read_text().endswith("}"))
        return str(json.loads(file.read_text())["address"])

    def work(self, address: str, *words: str) -> subprocess.Popen[bytes]:
        """Start a worker of one thread, unless told otherwise."""
        return self._start("dask_worker", address, *(words or ("--nthreads", "1", "--no-nanny")))

    def log(self, process: subprocess.Popen[bytes]) -> str:
        return (self.folder / f"{self.started.index(process)}.log").read_text()

    def _start(self, program: str, *words: str, **settings: str) -> subprocess.Popen[bytes]:
        command = [sys.executable, "-m", f"distributed.cli.{program}", "--no-dashboard", *words]
        environment = {**os.environ, "DASK_TEMPORARY_DIRECTORY": str(self.folder), **settings}
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


@pytest.fixture
def lab(small: Path) -> Path:
    """A directory to work in, with a scene, its picture and a sweep in the folder `here`."""
    (small / "here").mkdir()
    for name in ("small.yaml", "speckle.png"):
        (small / name).rename(small / "here" / name)
    for name, text in (("sweep.yaml", SWEEP), ("k.yml", CALIBRATION), ("t.txt", POSES)):
        (small / "here" / name).write_text(text)
    return small


def wait_for(happened: Callable[[], Any]) -> None:
    ends = time.monotonic() + SOON
    while not happened():
        assert time.monotonic() < ends
        time.sleep(0.02)


def start_sweep(out: str, *words: str) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "taichi_msm", "sweep", "here/sweep.yaml", "--out", out, *words]
    return subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)


def rows(out: str) -> list[str]:
    """The table but for the seconds."""
    return [line.rpartition(",")[0] for line in Path(out, "table.csv").read_text().splitlines()]


@pytest.mark.slow
def test_workers_need_no_inputs_and_one_may_die(lab: Path, machines: Machines, program: Program) -> None:
    address = machines.schedule()
    command = start_sweep("far", "--json", "--dask", address)
    wait_for(lambda: "plugin taichi-msm" in machines.log(machines.scheduler))
    # Before there is any worker, all is gone that one could read besides what it is sent.
    (lab / "here").rename(lab / "away")
    doomed = machines.work(address)
    machines.work(address, "--nthreads", "1")
    wait_for(lambda: list(lab.glob("far/runs/*/run.json")))
    doomed.kill()
    assert len(list(lab.glob("far/runs/*/run.json"))) < 6
    printed, said = command.communicate(timeout=SOON)
    assert (command.returncode, json.loads(printed)["complete"], said) == (0, 6, "")

    (lab / "away").rename(lab / "here")
    assert program("sweep", "here/sweep.yaml", "--out", "near").returncode == 0
    assert rows("far") == rows("near")
    # Drawn by the workers, from the trajectories.
    assert (lab / "far" / "contact.jpg").read_bytes() == (lab / "near" / "contact.jpg").read_bytes()
    for run in sorted(lab.glob("near/runs/*")):
        assert results(run) == results(lab / "far" / "runs" / run.name)
    assert program("run", "--again", "far/runs/000003", "--out", "again", "--quiet").returncode == 0
    assert results(lab / "again") == results(lab / "near" / "runs" / "000003")


@pytest.mark.slow
def test_the_same_command_goes_on_after_the_scheduler_was_lost(
    lab: Path, machines: Machines, message: Messages
) -> None:
    address = machines.schedule()
    machines.work(address)
    command = start_sweep("far", "--json", "--dask", address)
    wait_for(lambda: list(lab.glob("far/runs/*/run.json")))
    machines.scheduler.kill()
    printed, _ = command.communicate(timeout=SOON)
    (error,) = json.loads(printed)["errors"]
    ended = int(error.split("; ")[1].split()[0])
    assert address in error
    message(error, "of 6 runs", hide=r"tcp:[^;]*; \d")
    assert command.returncode == 4

    earlier = {path: path.stat().st_mtime_ns for path in sorted(lab.glob("far/runs/*/run.json"))[:ended]}
    address = machines.schedule()
    machines.work(address)
    assert json.loads(start_sweep("far", "--json", "--dask", address).communicate(timeout=SOON)[0])["complete"] == 6
    assert earlier == {path: path.stat().st_mtime_ns for path in earlier}


@pytest.mark.slow
def test_a_run_whose_workers_die_is_a_row(lab: Path, machines: Machines, message: Messages) -> None:
    address = machines.schedule(DASK_DISTRIBUTED__SCHEDULER__ALLOWED_FAILURES="0")
    doomed = machines.work(address)
    command = start_sweep("far", "--json", "--dask", address)
    wait_for(lambda: list(lab.glob("far/runs/*/.partial")))
    doomed.kill()
    wait_for(lambda: "Remove worker" in machines.log(machines.scheduler))
    machines.work(address)
    printed = json.loads(command.communicate(timeout=SOON)[0])
    # Dask cannot tell a run under way from one that the worker was given besides.
    assert printed["died"] in (1, 2)
    assert printed["died"] + printed["complete"] == 6
    (died, *_) = [line for line in rows("far") if ",died," in line]
    message(died.split(",died,")[1].rstrip(","), "died")


@pytest.mark.slow
def test_ctrl_c_frees_the_workers(lab: Path, machines: Machines, message: Messages) -> None:
    address = machines.schedule()
    machines.work(address)
    takes_minutes = SWEEP.replace("[5, 5], time.duration: 0.1", "[99, 99], time.duration: 900")
    (lab / "here" / "sweep.yaml").write_text(takes_minutes)
    command = start_sweep("long", "--dask", address)
    wait_for(lambda: list(lab.glob("long/runs/*/.partial")))
    command.send_signal(signal.SIGINT)
    _, said = command.communicate(timeout=SOON)
    message(said.splitlines()[-1], "interrupted", "0 of 6 runs")
    assert command.returncode == 130

    (lab / "here" / "sweep.yaml").write_text(SWEEP)
    assert json.loads(start_sweep("far", "--json", "--dask", address).communicate(timeout=SOON)[0])["complete"] == 6


@pytest.fixture
def cluster() -> Iterator[Callable[[int], str]]:
    """Start a scheduler with a worker of some threads in this process; gives its address."""
    options = {"n_workers": 1, "processes": False, "protocol": "tcp", "host": "127.0.0.1", "dashboard_address": ":0"}
    with ExitStack() as stack:
        yield lambda threads: str(
            stack.enter_context(distributed.LocalCluster(threads_per_worker=threads, **options)).scheduler_address
        )


def test_a_worker_that_would_lose_results_or_change_them_is_refused(
    lab: Path, cluster: Callable[[int], str], program: Program, message: Messages
) -> None:
    tried = program("sweep", "here/sweep.yaml", "--out", "far", "--dask", cluster(2))
    assert tried.returncode == 2
    message(tried.stderr, "--nthreads 1", hide="about .* on disk|tcp://[^ ]*")
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
def test_a_transport_whose_requirements_are_missing(
    address: str, word: str, lab: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    monkeypatch.setattr("taichi_msm.sweeps.cluster.MAX_WAIT_S", 0.5)
    tried = program("sweep", "here/sweep.yaml", "--out", "far", "--json", "--dask", address)
    assert tried.returncode == 2
    # Dask says what is wrong with an address.
    message(json.loads(tried.stdout)["errors"], address, word, hide="missing port.*(?=; )")


def test_a_command_whose_inputs_another_one_has_removed_ends_well(lab: Path, cluster: Callable[[int], str]) -> None:
    address, described = cluster(1), load_sweep("here/sweep.yaml")
    begin_sweep(described, lab / "out")
    connection = partial(cluster_connection, address, described, lab / "out", lambda stage, done, total: None)
    with connection(), connection():
        pass


def test_dask_with_workers_or_without_distributed(
    lab: Path, program: Program, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    command = ("sweep", "here/sweep.yaml", "--dask", "tcp://127.0.0.1:1")
    tried = program(*command, "--workers", "2")
    assert tried.returncode == 2
    message(tried.stderr, "--dask")
    monkeypatch.delitem(sys.modules, "taichi_msm.sweeps.cluster", raising=False)
    monkeypatch.setitem(sys.modules, "distributed", None)
    tried = program(*command)
    assert tried.returncode == 2
    message(tried.stderr, "pip install distributed", hide="about .* on disk")
