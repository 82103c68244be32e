"""Resumed runs: results have the bits of an uninterrupted run."""

from __future__ import annotations

import errno
import json
import os
import re
import shutil
import subprocess
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import FilesError, resume, run
from taichi_msm.load.scene_file import load_scene
from taichi_msm.runs import run as run_module
from taichi_msm.runs.checkpoint import FRAMES_FILE, STATE_FILE, Checkpoint
from taichi_msm.runs.writer import RunRecord
from taichi_msm.scene.scene import Scene
from taichi_msm.solver import dynamics, planning
from taichi_msm.solver.state import TipForce
from taichi_msm.system.compiler import COMPILERS, active_compiler, versions
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.outputs import files, results
from tests.reporting_process import ReportingProcess
from tests.scenes import speckle

# A tool presses while it moves; many steps per frame.
SETTINGS = (
    "probes.0.at=[[0, 0.2, 0.5], [2, 0.8, 0.5]]",
    "probes.0.load=[[0, 0], [0.1, 100], [1.5, 100], [1.5, 0]]",
    "time.duration=2",
    "time.frames_per_second=50",
    "time.step=2.0e-5",
)


def dragged(*overrides: str) -> Scene:
    """The small scene with these settings and others."""
    return load_scene("small.yaml", [*SETTINGS, *overrides])


def checkpoint_in(directory: Path) -> Path:
    return directory / ".partial" / "checkpoint"


def published(directory: Path) -> dict[str, bytes]:
    """All files but the checkpoint."""
    return {name: data for name, data in files(directory).items() if not name.startswith(".partial")}


class Stop:
    """Progress callback that interrupts a run at the n-th report of its frames."""

    def __init__(self, after: int) -> None:
        self._left = after

    def __call__(self, stage: str, done: int, total: int) -> None:
        self._left -= stage in ("start", "redraw", "frames")
        if self._left < 0 and stage != "write":
            raise KeyboardInterrupt


def interrupted(made: Scene, directory: str, device: Device, after: int = 12) -> RunRecord:
    """Record of a run that is interrupted after some frames."""
    record = run(made, directory, threads=device.threads, progress=Stop(after))
    assert record["status"] == "interrupted"
    assert 0 < record["frames"] <= made.time.frames
    return record


# A force-controlled tool, and a position-controlled one that grips.
GRIPPING = (
    "probes=[{force: [0, 300, -1000], falloff: 20, load: [[0, 0], [0.03, 100], [0.06, 0]]}, "
    "{path: [[0, 0.5, 0.5, 0.001], [0.05, 0.5, 0.5, -0.02], [0.12, 0.6, 0.5, 0.03]], grip: [[0.05, 0.11]], "
    "friction: 0.2, instrument: {radius: 0.05, shaft: [0, -0.3, 1], length: 0.2}}]",
)


@pytest.mark.default_cases("all")
@pytest.mark.parametrize(
    ("output", "probes"),
    [("png, gif, trajectory", ()), ("png, forces", GRIPPING), ("forces", GRIPPING), ("", GRIPPING)],
    ids=["all", "forces and more", "forces", "none"],
)
def test_repeatedly_interrupted_run(
    output: str, probes: tuple[str, ...], small: Path, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Interruptions between frames, within a frame, and while earlier frames are redrawn."""
    monkeypatch.setattr(dynamics, "MAX_STEPS_PER_LAUNCH", 300)
    made = dragged("time.duration=0.12", f"output=[{output}]", *probes)
    whole = run(made, "whole", threads=device.threads, estimate_error=False)
    record = run(made, "parts", threads=device.threads, estimate_error=False, progress=Stop(5))
    steps = []
    for after in range(4, 40, 4):
        assert record["status"] == "interrupted"
        with np.load(checkpoint_in(small / "parts") / STATE_FILE) as state:
            steps.append(int(state["steps"]))
        before = published(small / "parts")
        try:
            # Paths of the manifest are independent of the current directory.
            monkeypatch.chdir(small / "whole")
            record = resume("../parts", threads=device.threads, progress=Stop(after))
        except KeyboardInterrupt:
            assert published(small / "parts") == before, "no new frame, no lost one"
        if record["status"] == "complete":
            break
    assert record["status"] == "complete"
    assert steps == sorted(steps)
    assert any(step % 1000 for step in steps), "within a frame"
    assert results(small / "parts") == results(small / "whole")
    assert record["probes"] == whole["probes"]
    for key in ("steps", "frames", "max_displacement", "shortest_spring", "notes", "outputs", "scene", "overrides"):
        assert record[key] == whole[key]
    assert not (small / "parts" / ".partial").exists()


def test_progress_of_redrawn_frames(small: Path, device: Device) -> None:
    """They are a stage of their own, because the remaining time is estimated from simulated frames."""
    reports: list[tuple[str, int, int]] = []
    interrupted(dragged("time.duration=0.3", "output=[gif, trajectory]"), "parts", device)
    stored = resume("parts", threads=device.threads, progress=lambda *report: reports.append(report))["resumed"]
    assert stored > 1
    assert sorted({report[1:] for report in reports if report[0] == "redraw"}) == [(n, stored) for n in range(stored)]
    # The total is reported only while pictures are still encoded.
    simulated = {report[1:] for report in reports if report[0] == "frames"} | {(16, 16)}
    assert sorted(simulated) == [(n, 16) for n in range(stored, 17)]


def test_resume_after_a_full_disk(
    small: Path, device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    made = dragged("time.duration=0.2", "output=[trajectory]")
    run(made, "whole", threads=device.threads)
    run(made, "parts", threads=device.threads, overrides=["earlier"])
    earlier = files(small / "parts")
    add = Checkpoint.add

    def full(checkpoint: Checkpoint, position: NDArray[Any], forces: Sequence[TipForce]) -> None:
        if checkpoint.frames == 6:
            # Half of the positions fit.
            assert checkpoint._file
            checkpoint._file.write(position.tobytes()[:500])
            raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
        add(checkpoint, position, forces)

    with monkeypatch.context() as patch:
        patch.setattr(Checkpoint, "add", full)
        with message.raises(FilesError, "--out"):
            run(made, "parts", threads=device.threads)
    left = files(small / "parts")
    assert {name: left[name] for name in earlier} == earlier
    assert sorted(set(left) - set(earlier)) == [f".partial/checkpoint/{name}" for name in (FRAMES_FILE, STATE_FILE)]
    assert 0 < resume("parts", threads=device.threads)["resumed"] <= 6
    assert results(small / "parts") == results(small / "whole")


def test_repeated_command_resumes(small: Path, device: Device, message: Messages) -> None:
    made = dragged("time.duration=0.2", "output=[trajectory]")
    run(made, "whole", threads=device.threads)
    left = interrupted(made, "parts", device)
    assert run(made, "parts", threads=device.threads)["resumed"] == left["frames"]
    assert results(small / "parts") == results(small / "whole")
    assert not (small / "parts" / ".partial").exists()
    with message.raises(FilesError, "parts"):
        resume("parts", threads=device.threads)


def test_changed_scene_restarts(small: Path, device: Device) -> None:
    """The checkpoint of the unfinished run is kept until the new run has a frame."""
    settings = ["time.duration=0.2", "output=[trajectory]"]
    interrupted(dragged(*settings), "parts", device)
    before = files(small / "parts")
    changed = dragged(*settings, "sheet.points=[9,12]")
    with pytest.raises(KeyboardInterrupt):
        run(changed, "parts", threads=device.threads, progress=Stop(0))
    assert files(small / "parts") == before
    assert run(changed, "parts", threads=device.threads)["resumed"] == 0
    assert not (small / "parts" / ".partial").exists()


@pytest.mark.parametrize("requested", [True, None])
def test_run_without_stored_positions(
    requested: bool | None, small: Path, device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    """It restarts if its error is estimated, which needs all frames; `resume` continues without an estimate."""
    monkeypatch.setattr(planning, "MAX_COMPANION_FRACTION", 0.0)
    made = dragged("time.duration=0.2", "output=[]")
    whole = run(made, "whole", threads=device.threads, estimate_error=requested)
    assert (whole["error_estimate"] is None) == (not requested)
    interrupted(made, "parts", device)
    again = run(made, "parts", threads=device.threads, estimate_error=requested)
    assert (again["resumed"] > 0) == (not requested)
    differ = dict.fromkeys(("timings", "resumed"))
    assert {**again, **differ} == {**whole, **differ}
    if requested is None:
        monkeypatch.undo()
        monkeypatch.chdir(small)
        interrupted(made, "parts", device)
        record = resume("parts", threads=device.threads)
        assert record["resumed"] > 0
        message(str(record["error_estimate_reason"]))


DAMAGE: list[tuple[str, Callable[[bytes], bytes]]] = [
    (STATE_FILE, lambda data: data[: len(data) // 2]),
    (STATE_FILE, lambda data: b""),
    (FRAMES_FILE, lambda data: data[:-500]),
]


def test_damaged_checkpoint(small: Path, device: Device, message: Messages) -> None:
    made = dragged("time.duration=0.2", "output=[trajectory]")
    interrupted(made, "whole", device)
    for name, damage in DAMAGE:
        shutil.rmtree("parts", ignore_errors=True)
        shutil.copytree("whole", "parts")
        path = checkpoint_in(Path("parts")) / name
        path.write_bytes(damage(path.read_bytes()))
        before = files(small / "parts")
        with message.raises(FilesError, f"parts/.partial/checkpoint/{name}"):
            resume("parts", threads=device.threads)
        assert files(small / "parts") == before
        # A run of the scene restarts.
        assert run(made, "parts", threads=device.threads, estimate_error=False)["resumed"] == 0


def test_run_with_another_compiler(small: Path, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """It resumes with a tested compiler, and restarts with an untested version."""
    made, current = dragged("time.duration=0.2", "output=[trajectory]"), versions()
    second = next(compiler for compiler in COMPILERS.values() if compiler is not active_compiler())
    rest = {name: version for name, version in current.items() if name != active_compiler().name}
    for compiler, resumes in (({second.name: second.tested_version}, True), ({active_compiler().name: "0.0.1"}, False)):
        interrupted(made, "parts", device)
        with monkeypatch.context() as patch:
            patch.setattr(run_module, "versions", lambda compiler=compiler: {**rest, **compiler})
            record = run(made, "parts", threads=device.threads)
        assert (record["resumed"] > 0) == resumes
        assert record["versions"] == {**(current if resumes else rest), **compiler}


def test_changed_picture_or_version(
    small: Path, device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    interrupted(dragged("time.duration=0.2"), "parts", device)
    before, compiler = files(small / "parts"), active_compiler()
    original = f"{compiler.name} {compiler.version}"
    with monkeypatch.context() as patch:
        patch.setattr(run_module, "versions", lambda: {**versions(), compiler.name: "1.7.99"})
        with message.raises(FilesError, hide=re.escape(original)) as caught:
            resume("parts", threads=device.threads)
        assert original in str(caught.value)
    Image.fromarray(speckle(30, 40, 1)).save(small / "speckle.png")
    with message.raises(FilesError, "speckle.png"):
        resume("parts", threads=device.threads)
    assert files(small / "parts") == before


def test_killed_run(small: Path, device: Device) -> None:
    """Killed at every stage of a run and of its resumption."""
    duration = "time.duration=0.8"
    run(dragged(duration), "whole", threads=device.threads, estimate_error=False)
    settings = [word for setting in (*SETTINGS, duration) for word in ("--set", setting)]
    begin, again = ["small.yaml", *settings, "--out", "parts"], ["--resume", "parts"]
    for arguments, stage, done in (
        (begin, "frames", 12),
        (again, "redraw", 0),
        (again, "write", 0),
    ):
        with ReportingProcess("run", *arguments, "--quiet", stderr=subprocess.PIPE) as process:
            process.until(stage, done)
            process.kill()
            assert process.communicate(timeout=60)[1] == ""  # until its encoder has ended
        assert_readable(small / "parts")
    # The run may have been finished before it was killed.
    if checkpoint_in(small / "parts").exists():
        assert resume("parts", threads=device.threads)["resumed"] > 0
    assert results(small / "parts") == results(small / "whole")
    assert not (small / "parts" / ".partial").exists()


def assert_readable(directory: Path) -> None:
    """Assert that every result can be decoded."""
    for path in directory.glob("frames/*.png"):
        with Image.open(path) as image:
            image.load()
    if (directory / "animation.gif").exists():
        with Image.open(directory / "animation.gif") as image:
            image.seek(getattr(image, "n_frames", 1) - 1)
    if (directory / "trajectory.npz").exists():
        with np.load(directory / "trajectory.npz") as trajectory:
            assert np.isfinite(trajectory["position"]).all()
    if (directory / "run.json").exists():
        json.loads((directory / "run.json").read_text())
