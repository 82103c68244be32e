"""Runs that end early, and go on: the result has the bits of a run that was left alone."""

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

# Pressed while the tool moves, in many steps a frame.
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
    """Progress that interrupts a run when it tells of its frames for the n-th time."""

    def __init__(self, after: int) -> None:
        self._left = after

    def __call__(self, stage: str, done: int, total: int) -> None:
        self._left -= stage in ("redraw", "frames")
        if self._left < 0 and stage != "write":
            raise KeyboardInterrupt


def interrupted(made: Scene, directory: str, device: Device, after: int = 12) -> RunRecord:
    """The record of a run that is interrupted after some of its frames."""
    record = run(made, directory, threads=device.threads, progress=Stop(after))
    assert record["status"] == "interrupted"
    assert 0 < record["frames"] <= made.time.frames
    return record


# A tool that is moved, and pulls what it has gripped, besides one with a force.
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
def test_a_run_that_is_interrupted_goes_on_to_the_same_bits(
    output: str, probes: tuple[str, ...], small: Path, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Again and again, at a frame's end and within one, and while earlier frames are drawn anew."""
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
            # From another directory: what the manifest names is found all the same.
            monkeypatch.chdir(small / "whole")
            record = resume("../parts", threads=device.threads, progress=Stop(after))
        except KeyboardInterrupt:
            assert published(small / "parts") == before, "no frame more, and nothing lost"
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


def test_frames_that_are_drawn_anew_are_not_told_as_simulated(small: Path, device: Device) -> None:
    """So that the time which is left is reckoned from those that are simulated."""
    told: list[tuple[str, int, int]] = []
    interrupted(dragged("time.duration=0.3", "output=[gif, trajectory]"), "parts", device)
    stored = resume("parts", threads=device.threads, progress=lambda *said: told.append(said))["resumed"]
    assert stored > 1
    stages = {stage: [(done, total) for of, done, total in told if of == stage] for stage in ("redraw", "frames")}
    assert sorted(set(stages["redraw"])) == [(frame, stored) for frame in range(stored)]
    # That all are done is told only while pictures are still being encoded.
    assert sorted({*stages["frames"], (16, 16)}) == [(frame, 16) for frame in range(stored, 17)]


def test_a_run_that_finds_the_disk_full_goes_on_when_it_is_not(
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


def test_the_same_run_typed_again_goes_on(small: Path, device: Device, message: Messages) -> None:
    """Who did not see that a run was unfinished loses nothing of it."""
    made = dragged("time.duration=0.2", "output=[trajectory]")
    run(made, "whole", threads=device.threads)
    left = interrupted(made, "parts", device)
    assert run(made, "parts", threads=device.threads)["resumed"] == left["frames"]
    assert results(small / "parts") == results(small / "whole")
    assert not (small / "parts" / ".partial").exists()
    with message.raises(FilesError, "parts"):
        resume("parts", threads=device.threads)


@pytest.mark.parametrize("change", ["damping=0.02", "sheet.points=[9,12]"])
def test_another_run_begins_anew_and_keeps_what_was_there_until_it_has_a_frame(
    change: str, small: Path, device: Device
) -> None:
    settings = ["time.duration=0.2", "output=[trajectory]"]
    interrupted(dragged(*settings), "parts", device)
    before = files(small / "parts")
    other = dragged(*settings, change)
    with pytest.raises(KeyboardInterrupt):
        run(other, "parts", threads=device.threads, progress=Stop(0))
    assert files(small / "parts") == before
    assert run(other, "parts", threads=device.threads)["resumed"] == 0
    assert not (small / "parts" / ".partial").exists()


@pytest.mark.parametrize("asked", [True, None, False])
def test_a_run_that_kept_no_positions_goes_on_where_no_pilot_needs_them(
    asked: bool | None, small: Path, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Else it begins anew, so that what is known of its error does not depend on the interruption."""
    monkeypatch.setattr(planning, "MAX_COMPANION_SHARE", 0.0)
    made = dragged("time.duration=0.2", "output=[]")
    whole = run(made, "whole", threads=device.threads, estimate_error=asked)
    assert (whole["error_estimate"] is None) == (not asked)
    interrupted(made, "parts", device)
    again = run(made, "parts", threads=device.threads, estimate_error=asked)
    assert (again["resumed"] > 0) == (not asked)
    differ = dict.fromkeys(("timings", "resumed"))
    assert {**again, **differ} == {**whole, **differ}


def test_a_run_that_kept_no_positions_is_resumed_without_pilots(small: Path, device: Device, message: Messages) -> None:
    interrupted(dragged("time.duration=0.2", "output=[]"), "parts", device)
    record = resume("parts", threads=device.threads)
    assert record["resumed"] > 0
    message(str(record["error_estimate_reason"]))


DAMAGE: list[tuple[str, Callable[[bytes], bytes]]] = [
    (STATE_FILE, lambda data: data[: len(data) // 2]),
    (STATE_FILE, lambda data: b""),
    (FRAMES_FILE, lambda data: data[:-500]),
]


def test_what_is_damaged_is_not_gone_on_with(small: Path, device: Device, message: Messages) -> None:
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
        # The scene itself is run as if nothing were there, or what there is were another's.
        assert run(made, "parts", threads=device.threads, estimate_error=False)["resumed"] == 0


def test_a_run_begins_anew_unless_its_compiler_has_the_same_bits(
    small: Path, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    made, mine = dragged("time.duration=0.2", "output=[trajectory]"), versions()
    other = next(one for one in COMPILERS.values() if one is not active_compiler())
    rest = {name: version for name, version in mine.items() if name != active_compiler().name}
    for there, goes_on in (({other.name: other.tested_version}, True), ({active_compiler().name: "0.0.1"}, False)):
        interrupted(made, "parts", device)
        with monkeypatch.context() as patch:
            patch.setattr(run_module, "versions", lambda there=there: {**rest, **there})
            record = run(made, "parts", threads=device.threads)
        assert (record["resumed"] > 0) == goes_on
        assert record["versions"] == {**(mine if goes_on else rest), **there}


def test_another_picture_or_version_is_not_gone_on_with(
    small: Path, device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    interrupted(dragged("time.duration=0.2"), "parts", device)
    before, compiler = files(small / "parts"), active_compiler()
    mine = f"{compiler.name} {compiler.version}"
    with monkeypatch.context() as patch:
        patch.setattr(run_module, "versions", lambda: {**versions(), compiler.name: "1.7.99"})
        with message.raises(FilesError, hide=re.escape(mine)) as caught:
            resume("parts", threads=device.threads)
        assert mine in str(caught.value)
    Image.fromarray(speckle(30, 40, 1)).save(small / "speckle.png")
    with message.raises(FilesError, "speckle.png"):
        resume("parts", threads=device.threads)
    assert files(small / "parts") == before


def test_a_run_that_is_killed_goes_on_to_the_same_bits(small: Path, device: Device) -> None:
    """At every stage of a run and of one that goes on."""
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
            assert process.communicate(timeout=60)[1] == ""  # until its encoder has ended too
        assert_readable(small / "parts")
    # It may have been done before it was killed.
    if checkpoint_in(small / "parts").exists():
        assert resume("parts", threads=device.threads)["resumed"] > 0
    assert results(small / "parts") == results(small / "whole")
    assert not (small / "parts" / ".partial").exists()


def assert_readable(directory: Path) -> None:
    """Every file under a final name is whole."""
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
