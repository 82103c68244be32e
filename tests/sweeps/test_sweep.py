"""Sweeps: runs and table, which do not depend on kills, order, shards or the number of workers."""

from __future__ import annotations

import csv
import hashlib
import io
import json
import math
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import Executor, Future, ProcessPoolExecutor
from multiprocessing import get_context
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from PIL import Image

from taichi_msm import sweep
from taichi_msm.errors import ArgumentError, MsmError, SceneError
from taichi_msm.sweeps import tables
from taichi_msm.sweeps.pool import PARENT_POLL_S, DiedError, Pool
from taichi_msm.sweeps.runs import Outcome, RunTask, SweepState, begin_sweep, execute_run, run_missing
from taichi_msm.sweeps.spec import load_sweep, make_sweep
from taichi_msm.sweeps.sweep import finish_sweep
from tests.conftest import Program
from tests.golden import Messages
from tests.outputs import files, results
from tests.reporting_process import ReportingProcess
from tests.scenes import SMALL, speckle
from tests.sweeps.conftest import CALIBRATION

# The step of 0.01 s is above the stability limit, so some runs are refused.
SWEEP = """\
scene: small.yaml
samples: 4
seed: 1
vary:
  springs.structural: {log_uniform: [5, 50]}
  probes.0.at: {uniform: [[0.3, 0.3], [0.7, 0.7]]}
  time.step: {choice: [0.01, auto]}
set: {output: [png, gif, trajectory, depth], time.duration: 0.2}
"""

# Runs that are long enough to be ended in the middle.
LONG = SWEEP.replace("time.duration: 0.2", "time.duration: 5")


# Parts that depend on the machine or on SciPy: errors and seconds, and the limit of the step.
SECONDS = r"[\d.e-]+(?= \(run)|(?<=median )[\d.e-]+|[\d.]+ s\b"
LIMIT = "(?<=limit ).*(?=, or auto)"


@pytest.fixture
def many(small: Path) -> Path:
    """`small` with a sweep of four runs, some of which are refused."""
    (small / "many.yaml").write_text(SWEEP)
    return small


def table(directory: Path | str) -> list[dict[str, str]]:
    """Return the rows of a table, without the seconds."""
    rows = list(csv.DictReader(io.StringIO((Path(directory) / "table.csv").read_text())))
    return [{name: value for name, value in row.items() if name != "seconds"} for row in rows]


def runs(directory: Path | str) -> dict[str, bytes]:
    """Return the files of the runs without their records, which contain times."""
    return {name: data for name, data in files(Path(directory) / "runs").items() if not name.endswith("run.json")}


def execute_sweep(executor: Executor, directory: str, shard: tuple[int, int] = (1, 1)) -> None:
    """Execute many.yaml, as the command does."""
    state = begin_sweep(load_sweep("many.yaml"), Path(directory), shard)
    assert len(list(run_missing(state, executor, quiet))) == len(state.missing)
    if shard == (1, 1):
        finish_sweep(state, executor, quiet)


def quiet(stage: str, done: int, total: int) -> None:
    """Report nothing."""


def test_each_run_is_that_of_run_with_set(many: Path, program: Program, message: Messages) -> None:
    done = program("sweep", "many.yaml", "--out", "out")
    assert done.returncode == 0, done.stderr
    rows = table("out")
    assert list(rows[0]) == [
        *("run", "springs.structural", "probes.0.at", "time.step", "status", "error"),
        *("max_displacement", "shortest_spring", "error_estimate", "mesh_error", "probes.0.force"),
    ]
    statuses = [row["status"] for row in rows]
    assert sorted(set(statuses)) == ["complete", "refused"]
    message(rows[statuses.index("refused")]["error"], "--set time.step=0.01", hide=LIMIT)
    worst = max((row for row in rows if row["error_estimate"]), key=lambda row: float(row["error_estimate"]))
    assert f"largest {float(worst['error_estimate']):.2g} (run {int(worst['run']):06})" in done.stdout
    assert f"4 runs: {statuses.count('complete')} complete, {statuses.count('refused')} refused" in done.stdout
    message(done.stdout, "4 runs", hide=rf"{LIMIT}|\d (?=complete|refused)|(?<=run )\d+|{SECONDS}")
    assert not Path(f"out/runs/{int(rows[statuses.index('refused')]['run']):06}").exists()
    directory = Path("out/runs") / f"{int(worst['run']):06}"
    keys = ("springs.structural", "probes.0.at", "time.step")
    settings = ["output=[png, gif, trajectory, depth]", "time.duration=0.2", *(f"{key}={worst[key]}" for key in keys)]
    words = [word for setting in settings for word in ("--set", setting)]
    assert program("run", "small.yaml", "--out", "single", *words).returncode == 0
    assert results(directory) == results(Path("single"))
    record, single = (json.loads((folder / "run.json").read_text()) for folder in (directory, Path("single")))
    assert worst["max_displacement"] == repr(record["max_displacement"])
    assert worst["error_estimate"] == repr(record["error_estimate"]["error"])
    assert worst["probes.0.force"] == repr(record["probes"][0]["greatest_force"])
    for key in ("status", "scene", "step", "max_displacement", "error_estimate", "sha256", "notes", "outputs"):
        assert record[key] == single[key]


@pytest.fixture(scope="module")
def whole(pool: Pool, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The finished sweep of `many`, which must not be changed."""
    folder = tmp_path_factory.mktemp("whole")
    Image.fromarray(speckle(30, 40)).save(folder / "speckle.png")
    (folder / "small.yaml").write_text(SMALL)
    (folder / "many.yaml").write_text(SWEEP)
    with pytest.MonkeyPatch.context() as patch:
        patch.chdir(folder)
        execute_sweep(pool, "out")
    return folder / "out"


def test_sweep_resumes_with_missing_runs(many: Path, pool: Pool, whole: Path) -> None:
    shutil.copytree(whole, "out")
    first, second = [Path("out/runs") / f"{int(row['run']):06}" for row in table("out") if row["status"] == "complete"]
    shutil.rmtree(first)
    record = (second / "run.json").read_bytes()
    execute_sweep(pool, "out")
    assert (table("out"), runs("out")) == (table(whole), runs(whole))
    assert (second / "run.json").read_bytes() == record, "the run was repeated"


def test_command_of_a_finished_sweep(many: Path, whole: Path, program: Program, message: Messages) -> None:
    shutil.copytree(whole, "out")
    done = program("sweep", "many.yaml", "--out", "out")
    message(done.stderr.splitlines()[0], "2 of 4")
    assert table("out") == table(whole)


def test_shards_change_nothing(many: Path, pool: Pool, whole: Path) -> None:
    for part in (2, 1, 3):
        execute_sweep(pool, "parts", (part, 3))
    assert runs("parts") == runs(whole)
    assert not Path("parts/table.csv").exists()
    execute_sweep(pool, "parts")
    assert (table("parts"), runs("parts")) == (table(whole), runs(whole))


@pytest.mark.slow
def test_kill_changes_nothing(many: Path, pool: Pool) -> None:
    (many / "many.yaml").write_text(LONG)
    execute_sweep(pool, "whole")
    with ReportingProcess(
        "sweep", "many.yaml", "--workers", "1", "--out", "killed", stderr=subprocess.DEVNULL
    ) as process:
        process.until("runs", 2)
        process.kill()
    # Its worker, which executes the last run, ends by itself.
    time.sleep(2 * PARENT_POLL_S)
    assert not Path("killed/runs/000003/run.json").exists()
    execute_sweep(pool, "killed")
    assert (table("killed"), runs("killed")) == (table("whole"), runs("whole"))


def test_interruption_of_a_sweep(many: Path, message: Messages) -> None:
    (many / "many.yaml").write_text(LONG)
    with ReportingProcess("sweep", "many.yaml", "--workers", "1", "--out", "out", stderr=subprocess.PIPE) as process:
        process.until("runs", 2)
        process.send_signal(signal.SIGINT)
        _, errors = process.communicate()
    assert process.returncode == 130
    message(errors.splitlines()[-1], "of 4 runs", hide=r"\d(?= of)")
    assert not Path("out/table.csv").exists()


def test_command_with_a_shard_writes_no_table(many: Path, program: Program) -> None:
    done = program("sweep", "many.yaml", "--shard", "2/4", "--out", "out")
    assert done.returncode == 0
    assert sorted(str(path.relative_to("out")) for path in Path("out").glob("*/*")) == ["runs/000001"]
    assert [path.name for path in Path("out").glob("*.*")] == ["sweep.json"]


def test_another_sweep_in_the_directory_is_refused(many: Path, program: Program, message: Messages) -> None:
    text = SWEEP.replace("set: {", "set: {render.camera: {eye: [0, 0, 1], calibration: camera.yml}, ")
    originals = {"many.yaml": text, "small.yaml": SMALL, "camera.yml": CALIBRATION}
    for name, content in originals.items():
        (many / name).write_text(content)
    begin_sweep(load_sweep("many.yaml"), Path("out"))
    before = files(Path("out"))
    sha256 = hashlib.sha256(CALIBRATION.encode()).hexdigest()
    assert json.loads(before["sweep.json"])["files"]["camera.yml"] == sha256
    for name, original, changed, word in (
        ("many.yaml", "seed: 1", "seed: 2", "seed"),
        # The number of keys differs, too.
        ("many.yaml", text, "scene: small.yaml\nvary: {damping: {grid: [0.01, 0.02]}}\n", "samples"),
        ("small.yaml", "falloff: 20", "falloff: 21", "scene"),
        ("camera.yml", "50", "51", "camera.yml"),
    ):
        (many / name).write_text(originals[name].replace(original, changed))
        done = program("sweep", "many.yaml", "--out", "out")
        (many / name).write_text(originals[name])
        assert done.returncode == 2
        message(done.stderr, "out", word)
    Image.fromarray(speckle(31, 40)).save("speckle.png")
    message(program("sweep", "many.yaml", "--out", "out").stderr, "out", "speckle.png")
    assert files(Path("out")) == before


def test_forged_records_of_sweeps_are_refused(many: Path, program: Program, message: Messages) -> None:
    begin_sweep(load_sweep("many.yaml"), Path("out"))
    record = json.loads(Path("out/sweep.json").read_text())
    values = record["values"]
    forged = [
        3,
        values[::-1],
        *([[value, *values[0][1:]], *values[1:]] for value in (math.nan, values[0][0] * (1 + 2**-52))),
    ]
    errors = []
    for content in ("[" * 4000, "{}", *(json.dumps({**record, "values": value}) for value in forged)):
        Path("out/sweep.json").write_text(content)
        done = program("sweep", "many.yaml", "--out", "out")
        assert done.returncode == 4
        errors.append(done.stderr)
    (damaged,), (changed,) = set(errors[:2]), set(errors[2:])
    message(damaged, "out/sweep.json", "--out")
    message(changed, "out/sweep.json", "values")


@pytest.mark.parametrize("name", ["sweep.json", "runs", "runs/000002"], ids=["record", "runs", "run"])
def test_links_are_refused(many: Path, program: Program, name: str, message: Messages) -> None:
    (many / "target").mkdir()
    link = many / "out" / name
    link.parent.mkdir(parents=True)
    if name == "runs/000002":
        begin_sweep(load_sweep("many.yaml"), Path("out2"))
        shutil.copy("out2/sweep.json", "out")
    link.symlink_to(many / "target")
    done = program("sweep", "many.yaml", "--out", "out")
    assert done.returncode == 4
    message(done.stderr, f"out/{name}", "link")
    assert not list((many / "target").iterdir())


def test_record_of_another_run_is_ignored(many: Path, whole: Path) -> None:
    def begin() -> SweepState:
        return begin_sweep(load_sweep("many.yaml"), Path("out"))

    number = next(task.run for task in begin().missing if (whole / "runs" / f"{task.run:06}").exists())
    record = json.loads((whole / "runs" / f"{number:06}" / "run.json").read_text())
    file = Path("out/runs") / f"{number:06}" / "run.json"
    file.parent.mkdir(parents=True)
    changes: list[dict[str, Any]] = [
        {"overrides": ["time.duration=0.2"]},
        {"overrides": None},
        {"sha256": {"image": "0" * 64}},
        {"max_displacement": math.nan},
    ]
    for content in (*(json.dumps({**record, **change}) for change in changes), "[" * 4000):
        file.write_text(content)
        assert len(begin().missing) == 4, content
    file.write_text(json.dumps({**record, "status": "diverged", "error": "at 0.1 s"}))
    (outcome,) = begin().outcomes
    assert (outcome.run, outcome.status, outcome.error) == (number, "diverged", "at 0.1 s")
    assert outcome.forces == (record["probes"][0]["greatest_force"],)
    file.rename("record.json")
    file.symlink_to(Path("record.json").absolute())
    assert len(begin().missing) == 4


@pytest.mark.slow
def test_two_commands_write_one_table(many: Path, whole: Path) -> None:
    command = [sys.executable, "-m", "taichi_msm", "sweep", "many.yaml", "--workers", "1", "--out", "both", "--json"]
    processes = [subprocess.Popen(command, stdout=subprocess.PIPE) for _ in range(2)]
    records = [json.loads(process.communicate()[0]) for process in processes]
    assert not [note for record in records for note in record["notes"] if "could not be written" in note]
    assert (table("both"), runs("both")) == (table(whole), runs(whole))


def test_dry_run(many: Path, program: Program) -> None:
    command = ("sweep", "many.yaml", "--dry-run")
    lines, shard = (program(*command, *more).stdout.splitlines() for more in ((), ("--shard", "2/3")))
    assert lines[0] == "run,springs.structural,probes.0.at,time.step"
    assert [line.split(",")[0] for line in lines[1:5]] == ["0", "1", "2", "3"]
    assert lines[5].startswith("4 runs: about ")
    assert shard[:2] == [lines[0], lines[2]]
    assert shard[2].startswith("1 run: about ")
    every, third = (json.loads(program(*command, "--json", *more).stdout) for more in ((), ("--shard", "1/3")))
    assert (every["keys"], len(every["values"])) == (["springs.structural", "probes.0.at", "time.step"], 4)
    assert (third["runs"], len(third["values"])) == ([0, 3], 2)
    assert third["disk_bytes"] == every["disk_bytes"] // 2
    assert not Path("output").exists()


def test_many_runs_need_confirmation(many: Path, program: Program, message: Messages) -> None:
    (many / "many.yaml").write_text(SWEEP.replace("samples: 4", "samples: 1000000"))
    done = program("sweep", "many.yaml")
    assert done.returncode == 2
    message(done.stderr, "1000000 runs", "--yes", hide=rf"about .* on disk|\d+(?= will)|{LIMIT}")
    assert not Path("output").exists()


def test_invalid_shards(many: Path, program: Program, message: Messages) -> None:
    for part in ("0/3", "4/3", "a/b"):
        done = program("sweep", "many.yaml", "--shard", part)
        assert done.returncode == 2
        message(done.stderr, part)


def test_surfaces_vary(small: Path, pool: Pool) -> None:
    """A radius that is too small is a refused run; files are a choice, by a pattern, with digests in the records."""
    (small / "tube.yaml").write_text(SMALL.replace("mass:", "surface: {tube: {radius: 1}}, mass:"))
    (small / "wall.yaml").write_text(SMALL.replace("size: [0.3, 0.4]", "surface: {points: {file: 0.npy, unit: mm}}"))
    across, down = np.meshgrid(np.linspace(0, 400, 11), np.linspace(0, 300, 9))
    for number in range(2):
        np.save(f"{number}.npy", np.stack([across, -down, number * across**2 / 1000], axis=-1))

    def sweep_over(kind: str, key: str, values: list[float] | str) -> list[Outcome]:
        vary = {f"sheet.surface.{key}": {"choice": values}}
        return list(sweep(f"{kind}.yaml", vary, kind, samples=2, overrides={"output": []}, executor=pool))

    rows = sorted(sweep_over("tube", "tube.radius", [0.05, 0.1]), key=lambda row: row.status)
    assert [row.status for row in rows] == ["complete", "refused"]
    assert "take at least 0.06369 m" in str(rows[1].error)
    assert [row.status for row in sweep_over("wall", "points.file", "?.npy")] == ["complete"] * 2
    digests = {json.loads(path.read_text())["surface"]["sha256"] for path in Path("wall/runs").glob("*/run.json")}
    assert digests == {hashlib.sha256(Path(f"{number}.npy").read_bytes()).hexdigest() for number in range(2)}


@pytest.mark.slow
def test_python_interface_and_its_executors(many: Path, pool: Pool, message: Messages) -> None:
    vary = {"damping": {"grid": [0.01, 0.02]}}
    with ProcessPoolExecutor(1, get_context("spawn")) as executor:
        rows = sorted(sweep("small.yaml", vary, "out", overrides={"output": []}, executor=executor), key=number)
    assert [(row.run, row.status) for row in rows] == [(0, "complete"), (1, "complete")]
    assert [row["damping"] for row in table("out")] == ["0.01", "0.02"]
    assert sorted(sweep("small.yaml", vary, "workers", overrides={"output": []}, workers=1), key=number) == rows
    variables, overrides = {"n": {"grid": [1, 2]}}, {"time.duration": "=n / 10", "output": []}
    list(sweep("small.yaml", {}, "variables", variables=variables, overrides=overrides, executor=pool))
    assert [(row["n"], row["status"]) for row in table("variables")] == [("1", "complete"), ("2", "complete")]
    with message.raises(SceneError, "vary.dampign"):
        sweep("small.yaml", {"dampign": {"grid": [1]}}, "wrong")
    wrong: list[dict[str, Any]] = [{"scene": 3}, {"workers": 0}, {"vary": {"damping": 1j}}]
    for argument in wrong:
        with message.raises(ArgumentError, *argument):
            sweep(**{"scene": "small.yaml", "vary": vary, "directory": "wrong", **argument})
    assert not Path("wrong").exists()


def number(row: Outcome) -> int:
    return row.run


def test_refused_runs_are_final_and_failed_ones_are_repeated(many: Path, pool: Pool, message: Messages) -> None:
    content = (many / "speckle.png").read_bytes()
    (many / "damaged.png").write_bytes(content[: len(content) // 2])
    settings = {"vary": {"image": {"grid": ["speckle.png", "damaged.png"]}}, "set": {"time.duration": 0.1}}
    described = make_sweep("small.yaml", settings)
    begin_sweep(described, Path("out"))
    (many / "out/runs/000000").mkdir(parents=True)
    (many / "out/runs/000000/frames").write_text("in the way")

    def outcomes() -> list[Outcome]:
        state = begin_sweep(described, Path("out"))
        list(run_missing(state, pool, quiet))
        return sorted(state.outcomes, key=number)

    first, second = outcomes()
    assert (first.status, second.status) == ("failed", "refused")
    message(first.error, "000000/frames")
    message(second.error, "image", "damaged.png", hide=r"\(.*\)")
    (many / "out/runs/000000/frames").unlink()
    assert [row.status for row in outcomes()] == ["complete", "refused"]


def test_expression_without_a_value_is_a_row(small: Path, pool: Pool, message: Messages) -> None:
    variables, overrides = {"x": {"grid": [0, 0.01]}}, {"damping": "=exp(log(x))", "output": []}
    for _ in range(2):  # A refused run is checked again.
        rows = sweep("small.yaml", {}, "out", variables=variables, overrides=overrides, executor=pool)
        refused, complete = sorted(rows, key=lambda row: row.run)
        assert (refused.status, complete.status) == ("refused", "complete")
        assert table("out")[0]["error"] == refused.error
    message(refused.error, "set.damping", "log(x)")


def test_versions_of_another_machine(many: Path, program: Program, message: Messages) -> None:
    begin_sweep(load_sweep("many.yaml"), Path("out"))
    record = json.loads(Path("out/sweep.json").read_text())
    Path("out/sweep.json").write_text(json.dumps({**record, "versions": {**record["versions"], "numpy": "0.1"}}))
    done = program("sweep", "many.yaml", "--out", "out")
    assert done.returncode == 2
    message(done.stderr, "numpy 0.1")


def test_bug_in_a_run(many: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    monkeypatch.setattr("taichi_msm.sweeps.runs._run_scene", Mock(side_effect=RuntimeError("reason")))
    (task, *_) = begin_sweep(load_sweep("many.yaml"), Path("out")).missing
    message(execute_run(task, quiet).error, "RuntimeError")


def kill_own_process() -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def test_pool_replaces_a_killed_process(message: Messages) -> None:
    pool = Pool(2)
    with message.raises(DiedError, "SIGKILL"):
        pool.submit(kill_own_process).result()
    with message.raises(DiedError):
        pool.submit(os._exit, 3).result()
    assert os.getpid() != pool.submit(os.getpid).result()
    with pytest.raises(ValueError, match="invalid literal"):
        pool.submit(int, "a").result()
    start = time.monotonic()
    waiting = [pool.submit(time.sleep, 30) for _ in range(3)]
    pool.shutdown(cancel_futures=True)
    assert waiting[2].cancelled()
    assert time.monotonic() - start < 20, "it waited for a call"
    # As a thread does that took its call before the end.
    with message.raises(DiedError):
        pool._call(os.getpid)


def test_processes_of_a_pool_end_with_their_parent(tmp_path: Path) -> None:
    code = (
        "import os, time; from taichi_msm.sweeps.pool import Pool; pool = Pool(1); "
        "print(pool.submit(os.getpid).result(), flush=True); pool.submit(time.sleep, 60); time.sleep(60)"
    )
    with subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True) as owner:
        assert owner.stdout
        worker = int(owner.stdout.readline())
        owner.kill()
    for _ in range(100):
        if not Path(f"/proc/{worker}").exists():
            return
        time.sleep(0.1)
    raise AssertionError("the process is alive")


def state_of(runs: int) -> SweepState:
    """Return a sweep whose runs are only numbers."""
    none: Any = None
    return SweepState(Path(), none, [], [], [RunTask(run, none, (), Path(), Path()) for run in range(runs)])


class Dying(Executor):
    """An executor whose workers die of run 1 a number of times."""

    def __init__(self, times: int) -> None:
        self.times = times

    def submit(self, function: Callable[..., Any], /, *arguments: Any, **named: Any) -> Future[Any]:
        future: Future[Any] = Future()
        (task,) = arguments
        if task.run == 1 and self.times:
            self.times -= 1
            future.set_exception(DiedError("its process was ended by SIGKILL"))
        else:
            future.set_result(Outcome(task.run, "complete"))
        return future


@pytest.mark.parametrize(("times", "status"), [(1, "complete"), (2, "died")])
def test_run_whose_worker_died_is_repeated_once(times: int, status: str) -> None:
    rows = {row.run: row for row in run_missing(state_of(3), Dying(times), quiet)}
    assert [rows[run].status for run in range(3)] == ["complete", status, "complete"]
    assert rows[1].error == ("its process was ended by SIGKILL, twice" if times == 2 else "")


def test_broken_executor(message: Messages) -> None:
    executor = ProcessPoolExecutor(1, get_context("spawn"))
    with pytest.raises(Exception, match="terminated abruptly"):
        executor.submit(kill_own_process).result()
    with message.raises(MsmError, "ProcessPoolExecutor", hide=r"(?<=runs: ).*(?=; )"):
        list(run_missing(state_of(1), executor, quiet))


def test_number_of_workers(monkeypatch: pytest.MonkeyPatch) -> None:
    cost = tables.SweepCost(1.0, 0, 1 << 30, 1, 0, "")
    monkeypatch.setattr(tables, "available_threads", lambda: 8)
    for free, runs_, number in ((100 << 30, 1000, 8), (3 << 30, 1000, 3), (1 << 20, 1000, 1), (100 << 30, 5, 5)):
        monkeypatch.setattr(tables, "available_memory", lambda free=free: free)
        assert tables.choose_worker_count(cost, runs_).number == number
    assert tables.choose_worker_count(cost, 1, requested=7).number == 7
