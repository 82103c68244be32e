from __future__ import annotations

import json
import math
import os
import shutil
import sys
from pathlib import Path
from typing import Any
from unittest.mock import Mock

import pytest
from PIL import Image

from taichi_msm.accuracy.companions import choose_companion_runs
from taichi_msm.errors import SceneError
from taichi_msm.load import cost
from taichi_msm.load.cost import CALIBRATION_S, FORCE_ROW_BYTES, WORK_UNIT_S, Budget, require_disk, size_problems
from taichi_msm.runs.run import run
from taichi_msm.scene.outputs import ENTRIES
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import START_WORK, count_work
from taichi_msm.system import process
from taichi_msm.system.process import available_memory, available_threads
from taichi_msm.system.runtime import Device
from tests.conftest import Program
from tests.golden import Messages
from tests.scenes import plan_of, speckle

TIME = {"duration": 2, "frames_per_second": 10, "step": 0.025, "precision": "f32"}
PROBE = {"force": [0, 0, 1]}


def scene(**keys: Any) -> Scene:
    """A small sheet without outputs, 20 frames of 4 steps; `keys` replace these defaults."""
    sheet = {"points": [30, 40], "size": [1, 1], "mass": 1}
    defaults = {"image": "none.png", "sheet": sheet, "springs": {}, "output": []}
    return Scene.model_validate({**defaults, **keys, "time": {**TIME, **keys.get("time", {})}})


def estimate(scene: Scene) -> Budget:
    return cost.estimate_budget(plan_of(scene))


def faults(scene: Scene) -> list[str]:
    return [str(problem) for problem in size_problems(plan_of(scene))]


def test_memory_for_the_simulation() -> None:
    """Companion runs are two sheets in f64."""
    need = estimate(scene())
    assert need.frames == 21
    assert need.simulation_bytes == 1200 * (4 + 8 + 8) * 21
    assert estimate(scene(probes=[PROBE, PROBE])).simulation_bytes == 1200 * (4 + 8 + 8) * 23
    assert estimate(scene(time={"precision": "f64"})).simulation_bytes == 1200 * (8 + 8 + 8) * 21
    large = {"points": [2000, 2000], "size": [1, 1], "mass": 1}
    assert estimate(scene(sheet=large, time={"step": 1e-4})).simulation_bytes == 2000**2 * 4 * 21
    tolerance = {"step": "auto", "duration": 100, "tolerance": 1e-3}
    assert estimate(scene(sheet=large, time=tolerance)).simulation_bytes == 2000**2 * (4 + 8 + 8) * 21


def test_memory_for_drawing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    render = {"size": [50, 60], "refine": 2, "supersample": 3}
    need = estimate(scene(render=render, output=["gif"]))
    assert need.drawing_bytes == 1200 * 36 + 2 * 16 * 150 * 48 + 50 * 60 * 36
    assert need.memory_bytes == need.simulation_bytes + need.drawing_bytes
    assert estimate(scene(output=["trajectory"])).drawing_bytes == 0
    Image.new("RGB", (70, 80)).save(tmp_path / "a.png")
    # The whole image is decoded, even for a region of it.
    for region in ({}, {"region": [1, 2, 3, 4]}):
        pictured = scene(image=str(tmp_path / "a.png"), render=render, output=["gif"], **region)
        assert estimate(pictured).drawing_bytes == need.drawing_bytes + 70 * 80 * 20


@pytest.mark.parametrize("size", [(65, 47), (1, 90)])
def test_bound_of_the_size_of_all_files(size: tuple[int, int], device: Device, tmp_path: Path) -> None:
    """For a picture of noise, which compresses worst."""
    (width, height), cameras = size, {"left": "top", "right": {"beside": "left", "baseline": 0.1}}
    Image.fromarray(speckle(height, width)).save(tmp_path / "noise.png")
    made = scene(
        image=str(tmp_path / "noise.png"),
        sheet={"points": [4, 5], "size": [height, width], "mass": 1},
        time={"duration": 1},
        probes=[{"force": [3, 2, 0], "falloff": 0}],
        render={"size": size, "cameras": cameras, "shading": "none", "tracks": 3},
        output=ENTRIES,
    )
    run(made, tmp_path / "out", threads=device.threads)
    sizes = {path: path.stat().st_size for path in (tmp_path / "out").rglob("*") if path.is_file()}
    # Per camera: pictures and four labels of 11 frames, two labels of pairs of frames, four files; three labels of the
    # stereo pair; three files of the run.
    assert len(sizes) == 2 * (5 * 11 + 2 * 10 + 4) + 3 * 11 + 3
    need = estimate(made)
    assert sum(sizes.values()) <= need.disk_bytes
    pictures = sum(size for path, size in sizes.items() if path.parent.name == "frames")
    assert pictures > 2 * 11 * width * height, "noise does not compress"
    # A row of forces has the index of a probe, and seven numbers of up to 24 characters.
    assert len(",".join([repr(-math.pi * 1e-100)] * 7 + ["15"])) < FORCE_ROW_BYTES


@pytest.mark.parametrize(
    ("key", "sections"),
    [
        ("sheet.points", {"sheet": {"points": [4096, 4096], "size": [1, 1], "mass": 1}}),
        ("render.size", {"render": {"refine": 0, "size": [8192, 4096]}, "output": ["gif"]}),
        (
            "render.tracks",
            {"render": {"size": [9, 9], "tracks": 256}, "output": ["tracks"], "time": {"duration": 2000}},
        ),
    ],
    ids=["points", "picture", "tracks"],
)
def test_largest_share_of_memory_is_named(
    monkeypatch: pytest.MonkeyPatch, key: str, sections: dict[str, Any], message: Messages
) -> None:
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    monkeypatch.setattr(cost, "available_memory", lambda: 2**29)
    message(faults(scene(**sections)), key)


def test_limits_of_memory_and_steps(monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    time = {"duration": 1e6, "frames_per_second": 10, "step": "auto"}
    assert faults(scene(time=time | {"step": 1e-6})) == []
    message(faults(scene(time=time | {"step": 1e-7})), "time.step", "1e+13 steps")
    # The step limit is 2 / sqrt(8 * 1e14 / 1) s, and the step of `auto` is half of it: 1 / 28284271.2 s.
    message(faults(scene(springs={"structural": 1e14}, time=time)), "time.duration", "2.83e+13 steps")
    need = estimate(scene()).memory_bytes
    monkeypatch.setattr(cost, "available_memory", lambda: need)
    assert faults(scene()) == []
    monkeypatch.setattr(cost, "available_memory", lambda: need - 1)
    assert len(faults(scene())) == 1


@pytest.fixture
def groups(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The folder of all control groups; this process is in outer/inner."""
    root, membership = tmp_path / "cgroup", tmp_path / "membership"
    membership.write_text("4:memory:/v1\n3:cpu,cpuacct:/v1\n2:cpuset:/\n0::/outer/inner\n")
    monkeypatch.setattr(process, "CONTROL_GROUPS", root)
    monkeypatch.setattr(process, "MEMBERSHIP", membership)
    (tmp_path / "meminfo").write_text("MemTotal:  900 kB\nMemFree:  1 kB\nMemAvailable:  300 kB\n")
    assert process._free_memory(tmp_path / "meminfo") == 300 * 1024
    monkeypatch.setattr(process, "_free_memory", lambda _: 2000)
    return root


def group(folder: Path, **files: str) -> None:
    folder.mkdir(parents=True, exist_ok=True)
    for name, text in files.items():
        (folder / name.replace("__", ".")).write_text(text)


def test_memory_limits_of_control_groups(groups: Path) -> None:
    assert available_memory() == 2000
    stat = "anon 7\ninactive_file 100\n"
    group(groups / "outer" / "inner", memory__max="max\n", memory__current="10", memory__stat=stat)
    assert available_memory() == 2000
    group(groups / "outer", memory__max="1000\n", memory__current="300\n", memory__stat=stat)
    assert available_memory() == 800
    group(groups / "outer" / "inner", memory__max="400", memory__current="550", memory__stat=stat)
    assert available_memory() == 0


def test_control_groups_of_version_1(groups: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In a container, the folder of the group is the root, whatever its name outside."""
    stat = "total_inactive_file 7\n"
    group(groups / "memory", memory__limit_in_bytes="512", memory__usage_in_bytes="100", memory__stat=stat)
    assert available_memory() == 419
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    group(groups / "cpu" / "v1", cpu__cfs_quota_us="-1", cpu__cfs_period_us="100000")
    assert available_threads() == 8
    group(groups / "cpu", cpu__cfs_quota_us="250000", cpu__cfs_period_us="100000")
    assert available_threads() == 2


@pytest.mark.parametrize(("outer", "inner", "threads"), [("max", "max", 8), ("350000", "max", 3), ("90000", "max", 1)])
def test_core_quotas_of_control_groups(
    outer: str, inner: str, threads: int, groups: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getaffinity", lambda _: set(range(8)), raising=False)
    group(groups / "outer", cpu__max=f"{outer} 100000\n")
    group(groups / "outer" / "inner", cpu__max=f"{inner} 100000\n")
    assert available_threads() == threads


def test_insufficient_disk_space(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    """The disk holds positions twice while the trajectory is written, and two states of 6 numbers per mass point."""
    made = scene(render={"size": [50, 60]}, output=["png", "trajectory"])
    need = estimate(made)
    needed = need.picture_bytes + 21 * (2 * 1200 * 3 * 4 + 8) + 1024 + need.record_bytes + 2 * 1200 * 6 * 4
    below, disk_usage = tmp_path / "not" / "there", shutil.disk_usage

    def leave(free: int) -> None:
        monkeypatch.setattr(shutil, "disk_usage", lambda path: disk_usage(path)._replace(free=free))

    leave(needed)
    require_disk(plan_of(made), below)
    leave(needed - 1)
    with message.raises(SceneError, "sheet.points", "--out"):
        require_disk(plan_of(made), below)
    with message.raises(SceneError, "render.size", "500 x 600"):
        require_disk(plan_of(scene(render={"size": [500, 600]}, output=["png"])), below)


@pytest.mark.parametrize("cores", [1, 64])
def test_estimated_duration(cores: int, monkeypatch: pytest.MonkeyPatch) -> None:
    assert 0 < cost._calibrate() < 1
    monkeypatch.setattr(cost, "_calibrate", lambda: 2 * CALIBRATION_S)
    monkeypatch.setattr(process, "available_threads", lambda: cores)
    plan = plan_of(scene(image="none.png", output=["gif"]))
    parts = count_work(plan, choose_companion_runs(plan).cost)
    assert min(parts) > 0
    assert cost.estimate_duration(plan) == pytest.approx((2 * WORK_UNIT_S * sum(parts), 2 * WORK_UNIT_S * START_WORK))


def test_estimated_duration_of_check(small: Path, program: Program, message: Messages) -> None:
    def line(*options: str) -> str:
        (estimate,) = (
            line for line in program("check", "small.yaml", *options).stdout.splitlines() if " to run" in line
        )
        return estimate

    message(line(), hide=r"^\D*[\d.]+ \w+")
    message(line("--set", "time.step=auto", "--set", "time.tolerance=0.01"), "time.tolerance", hide=r"^\D*[\d.]+ \w+")
    before = program("check", "small.yaml", "--json").stdout
    assert program("run", "small.yaml", "--quiet").returncode == 0
    after = program("check", "small.yaml", "--json").stdout
    assert json.loads(after)["estimated_seconds"] == json.loads(before)["estimated_seconds"], (
        "the estimate is independent of earlier runs"
    )


def test_memory_of_systems_without_proc(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "_free_memory", Mock(side_effect=FileNotFoundError))
    assert 2**20 < available_memory() < sys.maxsize
    monkeypatch.delattr(os, "sysconf")
    assert available_memory() == sys.maxsize
