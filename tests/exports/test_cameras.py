"""Which camera an export is of, and which cameras a format can describe."""

from __future__ import annotations

import json
import pickle
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from taichi_msm import ArgumentError, FilesError, export
from taichi_msm.exports.inputs import read_pinhole
from taichi_msm.runs.finished import read_run
from tests.conftest import Program
from tests.outputs import files


def describe(folder: Path, **changes: Any) -> None:
    """Change what a run has written of its camera; None removes a key."""
    path = folder / "camera.json"
    described = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({name: value for name, value in described.items() if value is not None}))


def alone(stereo: Path, side: str) -> Path:
    """The same run with one camera, as one without a name."""
    out = stereo.parent / side
    shutil.copytree(stereo, out, ignore=shutil.ignore_patterns("left", "right"))
    shutil.copytree(stereo / side, out, dirs_exist_ok=True)
    record = json.loads((out / "run.json").read_text())
    render = record["scene"]["render"]
    render["camera"] = render.pop("cameras")["left"]
    (out / "run.json").write_text(json.dumps(record))
    return out


@pytest.mark.parametrize("name", ["tapvid", "tapvid3d", "csv"])
def test_a_camera_is_chosen_by_its_name(name: str, stereo: Path, program: Program) -> None:
    for side in ("left", "right"):
        done = program("export", str(stereo), "--format", name, "--camera", side, "--out", str(stereo.parent / "out"))
        assert (done.returncode, done.stderr) == (0, "")
        got = files(stereo.parent / "out")
        expected = files(export(alone(stereo, side), name).directory)
        for file in set(expected) - {"index.csv"}:
            assert got[file].replace(b"stereo", side.encode()) == expected[file] or file == "tapvid.pkl"
        if name == "tapvid":
            assert len(got["tapvid.pkl"]) == len(expected["tapvid.pkl"]) + len("stereo") - len(side)


def test_a_choice_that_is_none_is_told_of(stereo: Path, program: Program) -> None:
    wrong = {
        (): f"camera: none is chosen; take one of those of {stereo}: left, right",
        ("--camera", "lift"): f"camera: 'lift'; take one of those of {stereo}: left, right; did you mean 'left'?",
    }
    for options, said in wrong.items():
        done = program("export", str(stereo), "--format", "tapvid", *options)
        assert (done.returncode, done.stdout, done.stderr) == (2, "", f"{said}\n")
    single = alone(stereo, "left")
    done = program("export", str(single), "--format", "tapvid", "--camera", "left")
    said = f"camera: 'left'; {single} has one camera, without a name; leave it out"
    assert (done.returncode, done.stderr) == (2, f"{said}\n")
    done = program("export", str(stereo), "--format", "gltf", "--camera", "left")
    said = "camera: 'left'; gltf has no choice of a camera; leave it out"
    assert (done.returncode, done.stderr) == (2, f"{said}\n")
    with pytest.raises(ArgumentError, match="stir has no choice of a camera"):
        export(stereo, "stir", camera="left")


def test_of_runs_with_one_camera_that_is_taken(stereo: Path) -> None:
    """A choice concerns only those that have several."""
    single = alone(stereo, "left")
    done = export([single, stereo], "tapvid", camera="left")
    videos = pickle.loads((done.directory / "tapvid.pkl").read_bytes())
    assert len(videos) == 2
    points = [video["points"] for video in videos.values()]
    np.testing.assert_array_equal(*points)


def test_what_a_camera_lacks_is_named(stereo: Path) -> None:
    (stereo / "right" / "tracks.npz").unlink()
    with pytest.raises(FilesError, match=r"/stereo/right: tapvid needs tracks; run the scene again with --set"):
        export(stereo, "tapvid", camera="right")
    export(stereo, "tapvid", camera="left")


def test_surfaces_have_no_camera_to_choose(stereo: Path) -> None:
    assert export(stereo, "gltf").files == ["index.csv", "surface.glb"]


@pytest.mark.parametrize(("name", "formats"), [("left", ["tapvid", "tapvid3d", "csv"]), ("", ["obj"])])
def test_a_link_on_the_way_is_not_followed(name: str, formats: list[str], stereo: Path) -> None:
    """Be it the folder of a camera or the record: both may lead to the results of another run."""
    other = stereo.with_name("other")
    shutil.copytree(stereo, other)
    link = stereo / (name or "run.json")
    shutil.rmtree(link) if name else link.unlink()
    link.symlink_to(other / link.name)
    for each in formats:
        with pytest.raises(FilesError, match=rf"/stereo/{link.name}: a symbolic link, which no run writes; "):
            export(stereo, each, camera=name or None)
    with pytest.raises(FilesError, match="a symbolic link, which no run writes"):
        export(stereo, "stir")


def test_another_folder_is_no_camera(stereo: Path) -> None:
    shutil.copytree(stereo / "left", stereo / "again")
    assert read_run(stereo).camera_names() == ["left", "right"]


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        (
            {"distortion": [-0.3, 0.1, 0, 0, 0, 0, 0, 0], "model": "pinhole"},
            "the camera has a distortion, which tapvid3d cannot describe; choose another camera by "
            "--camera, or run the scene without it",
        ),
        (
            {"distortion": [0, 0, 0, 0], "model": "fisheye"},
            "the camera has a distortion, which tapvid3d cannot describe; choose another camera by "
            "--camera, or run the scene without it",
        ),
        ({"intrinsics": [[1, 0], [0, 1]]}, "damaged, or not of this run; run the scene again"),
        ({"intrinsics": [[0, 0, 1], [0, 1, 0], [0, 0, 1]]}, "damaged, or not of this run; run the scene again"),
        ({"poses": [[[1, 0, 0, 0]] * 3]}, "damaged, or not of this run; run the scene again"),
        ({"pose": "here"}, "damaged, or not of this run; run the scene again"),
    ],
    ids=["distorted", "fisheye", "2 x 2", "no focal length", "too few poses", "no pose"],
)
def test_cameras_that_cannot_be_described_are_refused(changes: dict[str, Any], said: str, stereo: Path) -> None:
    single = alone(stereo, "left")
    describe(single, **changes)
    with pytest.raises(ArgumentError if "distortion" in changes else FilesError) as caught:
        export(single, "tapvid3d")
    assert str(caught.value) == f"{single}/camera.json: {said}"
    assert not (single / "export-tapvid3d").exists()
    # What has no calibration takes any camera.
    export(single, "tapvid")


def test_a_camera_without_perspective_is_refused(stereo: Path) -> None:
    single = alone(stereo, "left")
    describe(single, intrinsics=None, pose=None)
    with pytest.raises(
        ArgumentError,
        match=r"^tapvid3d needs a pinhole, and .*/camera\.json has none; choose another camera by --camera, or",
    ):
        export(single, "tapvid3d")


def test_no_distortion_is_none(stereo: Path) -> None:
    """Of a calibrated camera all coefficients may be written, and be 0."""
    single = alone(stereo, "left")
    describe(single, distortion=[0.0] * 8, model="pinhole")
    camera = read_pinhole(read_run(single), "tapvid3d")
    assert camera.poses.shape == (5, 3, 4)
    np.testing.assert_array_equal(camera.centre, [160, 128])


def test_a_camera_that_moves_has_a_pose_for_every_frame(stereo: Path) -> None:
    single = alone(stereo, "left")
    poses = np.tile(np.eye(3, 4), (7, 1, 1))
    poses[:, 0, 3] = np.arange(7)
    describe(single, poses=poses.tolist())
    np.testing.assert_array_equal(read_pinhole(read_run(single), "tapvid3d").poses, poses[:5])
