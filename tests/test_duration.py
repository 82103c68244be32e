"""How long a run will take: its work, by what earlier runs took; whatever is in the file where that is kept."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from taichi_msm.physics.pilots import choose_pilots
from taichi_msm.physics.workload import Work, work
from taichi_msm.scene import Scene
from taichi_msm.scenefile import duration
from taichi_msm.scenefile.duration import CALIBRATION, UNIT
from taichi_msm.system import resources
from taichi_msm.system.compiler import chosen
from tests.conftest import Program
from tests.scenes import plan_of
from tests.scenes import scene as small_scene

CORES = 3
NAME = "taichi-msm.json"


@pytest.fixture
def made() -> Scene:
    """A scene of which every part takes some work."""
    return small_scene(image="none.png", output=["gif"])


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The empty folder of the cache, on a machine that is half as fast as the one of the constants."""
    (tmp_path / "cache").mkdir()
    monkeypatch.setenv(chosen().folder_variable, str(tmp_path / "cache"))
    monkeypatch.setattr(duration, "_calibrate", lambda: 2 * CALIBRATION)
    monkeypatch.setattr(resources, "processor", lambda: "Abacus")
    monkeypatch.setattr(resources, "available_threads", lambda: CORES)
    return tmp_path / "cache"


def estimate(made: Scene) -> Any:
    found = duration.estimate(plan_of(made))
    return found.seconds, found.measured


def record(**other: Any) -> dict[str, Any]:
    timings = {
        "startup": 2.0,
        "pilot": 4.0,
        "compile": 1.0,
        "simulate": 8.0,
        "render": 9.0,
        "encode": 7.0,
        "total": 31.0,
    }
    known = {"error_estimate": None, "timings": timings}
    return {"status": "complete", "arch": "cpu", "threads": CORES, "resumed": 0, **known, **other}


def parts_of(made: Scene) -> Work:
    plan = plan_of(made)
    return work(plan, choose_pilots(plan).cost)


def guess(made: Scene) -> float:
    return 2 * UNIT * sum(parts_of(made))


def test_without_an_earlier_run_a_calibration_tells(made: Scene, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    assert estimate(made) == (pytest.approx(guess(made)), False)
    assert [path.name for path in folder.iterdir()] == [NAME]
    monkeypatch.setattr(duration, "_calibrate", lambda: pytest.fail("the calibration is kept"))
    assert estimate(made) == (pytest.approx(guess(made)), False)


def test_the_calibration_is_soon_done() -> None:
    assert 0 < duration._calibrate() < 1


def test_an_earlier_run_tells_how_long_the_next_one_takes(made: Scene, folder: Path) -> None:
    parts = parts_of(made)
    assert min(parts) > 0
    duration.learn(plan_of(made), record())
    assert estimate(made) == (pytest.approx(31), True)
    longer = made.model_copy(update={"time": made.time.model_copy(update={"duration": 10 * made.time.duration})})
    more = [later / now for later, now in zip(parts_of(longer), parts, strict=True)]
    took = Work(start=3.0, stepping=8.0, pilots=4.0, pictures=16.0)
    assert estimate(longer)[0] == pytest.approx(sum(times * part for times, part in zip(more, took, strict=True)))


def test_later_runs_count_more(made: Scene, folder: Path) -> None:
    duration.learn(plan_of(made), record())
    slow = {name: 2 * seconds for name, seconds in record()["timings"].items()}
    duration.learn(plan_of(made), record(timings=slow))
    # A quarter of the first run and the second one, over as much work.
    assert estimate(made)[0] == pytest.approx(31 * (0.25 + 2) / 1.25)


def test_what_a_run_left_out_is_learnt_from_no_other(made: Scene, folder: Path) -> None:
    duration.learn(
        plan_of(made), record(timings={name: s for name, s in record()["timings"].items() if name != "pilot"})
    )
    kept = json.loads((folder / NAME).read_text())["parts"]
    assert set(kept) == {"start", "stepping", "pictures"}
    assert estimate(made)[1]


def test_pilots_are_not_learnt_where_a_finer_one_may_have_followed(made: Scene, folder: Path) -> None:
    duration.learn(plan_of(made), record(error_estimate={"error": 2e-3}))
    assert set(json.loads((folder / NAME).read_text())["parts"]) == {"start", "stepping", "pictures"}


@pytest.mark.parametrize(
    "other",
    [{"status": "diverged"}, {"status": "interrupted"}, {"arch": "cuda"}, {"threads": 1}, {"resumed": 2}],
    ids=str,
)
def test_other_runs_tell_nothing(other: dict[str, Any], made: Scene, folder: Path) -> None:
    duration.learn(plan_of(made), record(**other))
    assert list(folder.iterdir()) == []


def test_a_run_that_looked_for_its_step_tells_nothing(made: Scene, folder: Path) -> None:
    asking = made.model_copy(update={"time": made.time.model_copy(update={"step": "auto", "tolerance": 0.01})})
    duration.learn(plan_of(asking), record())
    assert list(folder.iterdir()) == []


def test_parts_of_a_moment_tell_nothing_of_longer_ones(made: Scene, folder: Path) -> None:
    duration.learn(plan_of(made), record(timings={**record()["timings"], "simulate": 0.04}))
    assert "stepping" not in json.loads((folder / NAME).read_text())["parts"]


def kept(machine: str = "Abacus, 3 cores", **parts: Any) -> str:
    return json.dumps({"machine": machine, "parts": {"start": [1.0, 1e8], **parts}})


@pytest.mark.parametrize(
    "content",
    [
        "",
        "{",
        "3",
        "[]",
        "{}",
        "[" * 4000,
        "\0" * 10**6,
        '{"machine": "Abacus, 3 cores", "parts": 3}',
        '{"machine": "Abacus, 3 cores", "parts": {"start": [1' + "0" * 400 + ", 1]}}",
        kept("Abacus, 2 cores"),
        kept(start=[1.0, 0.0]),
        kept(start=[-1.0, -1e8]),
        kept(start=[float("nan"), 1e8]),
        kept(start=[float("inf"), 1e8]),
        kept(start=[1e300, 1e-300]),
        kept(start=[1e-300, 1e300]),
        kept(start=[1.0]),
        kept(start=[1.0, 2.0, 3.0]),
        kept(start={"seconds": 1}),
        kept(start=None),
        kept(start=["a", "b"]),
    ],
    ids=range(21),
)
def test_a_file_that_no_run_has_written_is_as_none(content: str, made: Scene, folder: Path) -> None:
    (folder / NAME).write_text(content)
    assert estimate(made) == (pytest.approx(guess(made)), False)
    (folder / NAME).write_text(content)
    duration.learn(plan_of(made), record())
    assert estimate(made) == (pytest.approx(31), True)


def test_large_numbers_make_no_infinite_time(made: Scene, folder: Path) -> None:
    parts = {name: [1e303, 1e308] for name in parts_of(made)._asdict()}
    (folder / NAME).write_text(json.dumps({"machine": "Abacus, 3 cores", "parts": parts}))
    assert estimate(made)[0] == pytest.approx(1e-5 * sum(parts_of(made)))


def a_folder(file: Path) -> None:
    file.mkdir()


def a_pipe(file: Path) -> None:
    os.mkfifo(file)


def a_loop(file: Path) -> None:
    file.symlink_to(file)


def nothing_at_all(file: Path) -> None:
    shutil.rmtree(file.parent)


@pytest.mark.skipif(os.name == "nt", reason="has no pipes among its files")
@pytest.mark.parametrize("put", [a_folder, a_pipe, a_loop, nothing_at_all])
def test_where_nothing_can_be_kept_there_is_an_estimate_all_the_same(
    put: Callable[[Path], None], made: Scene, folder: Path
) -> None:
    put(folder / NAME)
    before = sorted(folder.parent.rglob("*"))
    assert estimate(made) == (pytest.approx(guess(made)), False)
    duration.learn(plan_of(made), record())
    assert sorted(folder.parent.rglob("*")) == before, "nothing is left behind"


def test_without_a_home_there_is_an_estimate(made: Scene, folder: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def homeless() -> Path:
        raise RuntimeError("Could not determine home directory.")

    monkeypatch.delenv(chosen().folder_variable)
    monkeypatch.setattr(Path, "home", homeless)
    assert estimate(made)[0] == pytest.approx(guess(made))
    duration.learn(plan_of(made), record())


def test_check_says_how_long_a_run_takes(
    small: Path, folder: Path, program: Program, monkeypatch: pytest.MonkeyPatch
) -> None:
    def check(*options: str) -> str:
        return program("check", "small.yaml", *options).stdout

    assert " to run (a guess, as no run has been timed here yet)\n" in check()
    monkeypatch.setattr(resources, "available_threads", lambda: 2)
    monkeypatch.setattr(duration, "SHORTEST", 0)
    record = json.loads(program("run", "small.yaml", "--json").stdout)
    # A run of the same scene takes what this one took.
    assert json.loads(check("--json"))["estimated_seconds"] == pytest.approx(record["timings"]["total"])
    assert " to run (by earlier runs here)\n" in check()
    said = check("--set", "time.step=auto", "--set", "time.tolerance=0.01")
    assert " to run, or longer, as time.tolerance may ask for more (by earlier runs here)\n" in said
