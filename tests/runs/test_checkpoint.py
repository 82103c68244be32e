"""Checkpoints: damaged and forged ones are refused."""

from __future__ import annotations

import io
import json
import math
import zipfile
from collections.abc import Callable
from dataclasses import replace
from operator import methodcaller
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taichi_msm.errors import DamagedError, FilesError
from taichi_msm.runs.checkpoint import FRAMES_FILE, STATE_FILE, Checkpoint, Manifest, read_manifest
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.state import PeakForce, ProbeForces, RunProgress, Snapshot, State, TipForce
from tests.golden import Messages
from tests.outputs import files
from tests.scenes import plan_of, scene

FRAMES = 3
STEPS = 17  # per frame


def small_scene() -> Scene:
    return scene(sheet={"points": [2, 3], "size": [0.3, 0.4], "mass": 1e-3}, output=["trajectory", "forces"])


def checkpoint_in(directory: Path) -> Checkpoint:
    return Checkpoint(directory / ".partial" / "checkpoint", plan_of(small_scene()))


def position(frame: int) -> Any:
    return np.random.default_rng(frame).normal(size=(2, 3, 3))


def forces(frame: int) -> tuple[TipForce, ...]:
    return (TipForce(0, (1.0, 2.0, frame / 3), (4.0, 5.0, 6.0)),)


def manifest() -> Manifest:
    made = small_scene()
    return Manifest(made, made, (), None, None, None, "/", "cpu", {}, {"taichi": "1.7"})


def state(**changes: Any) -> Snapshot:
    """The state of a run at its third frame."""
    steps: dict[str, Any] = {"steps": STEPS * (FRAMES - 1), "displacement": position(8), "difference": position(9)}
    steps["memory"] = np.empty((0, 2, 3))
    progress = RunProgress(frame=FRAMES - 1, energy=1.0, peak=2.0, reach=3.0)
    kept = {key: changes.pop(key) for key in list(changes) if key in steps}
    felt = ProbeForces(forces(8), (PeakForce(0.1, (7.0, 8.0, 9.0)),))
    return Snapshot(State(**{**steps, **kept}), RunProgress(**{**vars(progress), **changes}), felt)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    """A directory with a checkpoint."""
    (tmp_path / ".partial").mkdir()
    checkpoint = checkpoint_in(tmp_path)
    checkpoint.begin(manifest().as_json())
    for frame in range(FRAMES):
        checkpoint.add(position(frame), forces(frame))
    checkpoint.save(state())
    checkpoint.close()
    return tmp_path


def read(out: Path) -> list[Any]:
    """All contents of a checkpoint on which a resumed run depends."""
    checkpoint = checkpoint_in(out)
    try:
        saved = checkpoint.reopen()
        assert saved is not None
        positions = [checkpoint.read_positions(frame).tolist() for frame in range(checkpoint.frames)]
        forces = [checkpoint.read_forces(frame) for frame in range(checkpoint.frames)]
    finally:
        checkpoint.close()
    return [
        read_manifest(out)[0].as_json(),
        positions,
        forces,
        saved.probe_forces,
        saved.state.steps,
        saved.state.displacement.tolist(),
        saved.state.difference.tolist(),
        saved.progress,
    ]


@pytest.mark.parametrize(
    ("name", "harmless", "stride"),
    [
        (FRAMES_FILE, 0.0, 5),
        (STATE_FILE, 0.25, 20),
        pytest.param(STATE_FILE, 0.25, 1, marks=pytest.mark.fuzz),
    ],
)
def test_bit_flips_are_detected(name: str, harmless: float, stride: int, out: Path) -> None:
    """In every `stride`-th byte; some bytes of a zip file are unused, such as its dates."""
    path = out / ".partial" / "checkpoint" / name
    whole, before = path.read_bytes(), read(out)
    assert before[1] == [position(frame).tolist() for frame in range(FRAMES)]
    passed = 0
    for n in range(0, len(whole), stride):
        damaged = bytearray(whole)
        damaged[n] ^= 1 << n % 8
        path.write_bytes(damaged)
        try:
            assert read(out) == before
        except DamagedError:
            continue
        passed += 1
    assert passed <= harmless * len(whole) / stride
    size = len(whole) // FRAMES
    exchanged = whole[size : 2 * size] + whole[:size] + whole[2 * size :]
    for forged in (exchanged, *(whole[:n] for n in range(0, len(whole), 7 * stride))):
        path.write_bytes(forged)
        with pytest.raises(DamagedError):
            read(out)


def test_order_of_cameras_affects_results() -> None:
    """The light is at the first camera."""
    made, cameras = small_scene(), {"a": "top", "b": "oblique"}
    first, second = (
        replace(manifest(), scene=made.model_copy(update={"render": {"cameras": order}}))
        for order in (cameras, dict(reversed(cameras.items())))
    )
    assert first.has_same_bits_as(first)
    assert not first.has_same_bits_as(second)


def repacked(path: Path, change: Callable[[dict[str, Any]], object]) -> None:
    """Change the arrays of a state, with valid checksums."""
    with np.load(path) as archive:
        arrays = dict(archive)
    change(arrays)
    with path.open("wb") as file:
        np.savez(file, **arrays)


FORGED: dict[str, Callable[[dict[str, Any]], object]] = {
    "dtype": lambda a: a.update(displacement=a["displacement"].astype(np.float32)),
    "objects": lambda a: a.update(difference=a["difference"].astype(object)),
    "a shape": lambda a: a.update(displacement=a["displacement"].reshape(3, 2, 3)),
    "steps before the frame": lambda a: a.update(steps=np.int64(1)),
    "steps after the frame": lambda a: a.update(steps=np.int64(10**9)),
    "steps in parts": lambda a: a.update(steps=a["steps"] + 0.5),
    "a frame that is not stored": lambda a: a.update(frame=np.int64(3), steps=np.int64(3 * STEPS)),
    "a frame after the end": lambda a: a.update(frame=np.int64(99), steps=np.int64(99 * STEPS)),
    "displacement not a number": lambda a: a["displacement"].__setitem__((0, 0, 0), math.nan),
    "difference infinite": lambda a: a["difference"].__setitem__((0, 0, 0), math.inf),
    "no energy": lambda a: a.pop("energy"),
    "force not a number": lambda a: a["forces"].__setitem__((0, 0), math.nan),
    "forces of more probes": lambda a: a.update(greatest=np.zeros((2, 4))),
}


@pytest.mark.parametrize("case", FORGED)
def test_forged_state(case: str, out: Path) -> None:
    path = out / ".partial" / "checkpoint" / STATE_FILE
    repacked(path, lambda arrays: None)
    read(out)
    repacked(path, FORGED[case])
    with pytest.raises(DamagedError):
        read(out)


@pytest.mark.parametrize("compression", [zipfile.ZIP_STORED, zipfile.ZIP_BZIP2], ids=["header", "bzip2"])
def test_forged_array_size_takes_no_memory(compression: int, out: Path) -> None:
    """A few bytes of bzip2 may expand to gigabytes, too."""
    path = out / ".partial" / "checkpoint" / STATE_FILE
    with zipfile.ZipFile(path) as archive:
        entries = {name: archive.read(name) for name in archive.namelist()}
    if compression == zipfile.ZIP_STORED:
        header = io.BytesIO()
        shape = (10**5, 10**5, 3)
        np.lib.format.write_array_header_1_0(header, {"descr": "<f8", "fortran_order": False, "shape": shape})
        entries["displacement.npy"] = header.getvalue()
    with zipfile.ZipFile(path, "w", compression) as made:
        for name, data in entries.items():
            made.writestr(name, data)
    with pytest.raises(DamagedError):
        read(out)


@pytest.mark.parametrize("name", [FRAMES_FILE, STATE_FILE])
def test_parts_of_another_run(name: str, out: Path, tmp_path: Path) -> None:
    part = (out / ".partial" / "checkpoint" / name).read_bytes()
    checkpoint = checkpoint_in(tmp_path)
    checkpoint.begin({**manifest().as_json(), "folder": "/elsewhere"})
    for frame in range(FRAMES):
        checkpoint.add(position(frame), forces(frame))
    checkpoint.save(state())
    checkpoint.close()
    (out / ".partial" / "checkpoint" / name).write_bytes(part)
    with pytest.raises(DamagedError):
        read(out)


def test_frames_with_a_second_name(out: Path, message: Messages) -> None:
    """Writing to them would change a file elsewhere."""
    (out / "mine").hardlink_to(out / ".partial" / "checkpoint" / FRAMES_FILE)
    with message.raises(FilesError, FRAMES_FILE):
        read(out)


def test_frame_that_is_not_a_number(out: Path) -> None:
    checkpoint = checkpoint_in(out)
    checkpoint.reopen()
    checkpoint.frames = 1
    checkpoint.add(np.full((2, 3, 3), math.nan), forces(1))  # with a valid checksum
    checkpoint.close()
    with pytest.raises(DamagedError):
        read(out)


FORGED_MANIFESTS: dict[str, dict[str, Any]] = {
    "folder": {"folder": 3},
    "version": {"versions": {"taichi": 1}},
    "incomplete estimate": {"estimate": {"error": 1}},
    "negative error": {"estimate": {"steps_per_frame": 1, "error": -math.inf, "rounding": 0, "in_f64": 0, "order": 2}},
    "unknown arch": {"arch": "toaster"},
    "digest": {"sha256": {"image": 3}},
    "given": {"given": {}},
    "output": {"scene": {**small_scene().model_dump(mode="json"), "output": ["exe"]}},
    "step": {"scene": {**small_scene().model_dump(mode="json"), "time": {"duration": 0.4, "step": 0.2}}},
}


def test_forged_manifest(out: Path, message: Messages) -> None:
    errors = set()
    for change in FORGED_MANIFESTS.values():
        forged = {"manifest": np.frombuffer(json.dumps({**manifest().as_json(), **change}).encode(), np.uint8)}
        repacked(out / ".partial" / "checkpoint" / STATE_FILE, methodcaller("update", forged))
        with pytest.raises(DamagedError, match=STATE_FILE) as caught:
            read_manifest(out)
        errors.add(str(caught.value))
    message(sorted(errors))


def test_checkpoint_of_an_earlier_version(out: Path, message: Messages) -> None:
    folder = out / ".partial" / "checkpoint"
    repacked(folder / STATE_FILE, lambda arrays: arrays.pop("manifest"))
    for name in ("manifest.json", "positions", "forces"):
        (folder / name).touch()
    before = files(out)
    with message.raises(FilesError):
        read_manifest(out)
    assert files(out) == before
