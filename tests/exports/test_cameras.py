"""Exports of a camera by its name, CSV tables of its tracks, and TAPVid-3D.

Requirements of TAPVid-3D's evaluation (google-deepmind/tapnet, tapnet/tapvid3d, at c2cbab8 unless stated otherwise):

- evaluation/evaluate_model.py, lines 191 to 197: an .npz with images_jpeg_bytes, queries_xyt, tracks_XYZ, visibility
  and fx_fy_cx_cy; lines 108 to 112: each image is a JPEG that Pillow opens; lines 237 to 244: visibility is true where
  a point is visible, tracks and visibility have the order t, n, and the columns of queries, reversed, are t, y, x;
- evaluation/metrics.py, lines 23 to 29: the thresholds are the depth, the last column of tracks, over the focal length
  in pixels; lines 205 to 211: tracks are read in the frame of their query;
- annotation_generation/adt_utils.py at 00f244e, lines 109 to 118: a point is in the pixel of row floor(y) and column
  floor(x), with x = fx X / Z + cx, so that pixels count from the picture's corner;
- colab/load_and_visualize_tapvid3d_samples.ipynb, lines 166 to 174: np.load without pickle; optional extrinsics_w2c,
  README.md, line 108: from the world to the camera.
"""

from __future__ import annotations

import csv
import io
import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import ArgumentError, FilesError, export
from tests.conftest import Program
from tests.golden import Messages
from tests.outputs import files


def describe(folder: Path, **changes: Any) -> None:
    """Change keys of camera.json; None removes a key."""
    path = folder / "camera.json"
    camera = {**json.loads(path.read_text()), **changes}
    path.write_text(json.dumps({name: value for name, value in camera.items() if value is not None}))


FRAMES, TRACKS, WIDTH, HEIGHT = 5, 36, 320, 256


def alone(stereo: Path, side: str) -> Path:
    """Return the run with one camera, which has no name."""
    out = stereo.parent / side
    shutil.copytree(stereo, out, ignore=shutil.ignore_patterns("left", "right"))
    shutil.copytree(stereo / side, out, dirs_exist_ok=True)
    record = json.loads((out / "run.json").read_text())
    render = record["scene"]["render"]
    render["camera"] = render.pop("cameras")["left"]
    (out / "run.json").write_text(json.dumps(record))
    return out


@pytest.fixture
def single(stereo: Path) -> Path:
    return alone(stereo, "left")


@pytest.mark.parametrize("name", ["tapvid", "tapvid3d", "csv"])
def test_camera_by_name(name: str, stereo: Path, program: Program) -> None:
    for side in ("left", "right"):
        done = program("export", str(stereo), "--format", name, "--camera", side, "--out", str(stereo.parent / "out"))
        assert (done.returncode, done.stderr) == (0, "")
        got = files(stereo.parent / "out")
        expected = files(export(alone(stereo, side), name).directory)
        for file in set(expected) - {"index.csv"}:
            assert got[file].replace(b"stereo", side.encode()) == expected[file] or file == "tapvid.pkl"
        if name == "tapvid":
            assert len(got["tapvid.pkl"]) == len(expected["tapvid.pkl"]) + len("stereo") - len(side)


def test_invalid_camera(stereo: Path, program: Program, message: Messages) -> None:
    for camera in ([], ["--camera", "lift"]):
        done = program("export", str(stereo), "--format", "tapvid", *camera)
        assert (done.returncode, done.stdout) == (2, "")
        message(done.stderr, "camera")
    for folder, name in ((alone(stereo, "left"), "tapvid"), (stereo, "gltf"), (stereo, "stir")):
        with message.raises(ArgumentError, "camera"):
            export(folder, name, camera="left")
    (stereo / "right" / "tracks.npz").unlink()
    with message.raises(FilesError, "tracks"):
        export(stereo, "tapvid", camera="right")
    # Surfaces are independent of the cameras.
    assert export(stereo, "gltf").files == ["index.csv", "surface.glb"]


@pytest.mark.parametrize(
    ("name", "formats"), [("left", ["tapvid", "tapvid3d", "csv"]), ("", ["obj"])], ids=["camera", "record"]
)
def test_linked_camera_folder_or_record(name: str, formats: list[str], stereo: Path, message: Messages) -> None:
    """Links to the results of another run."""
    second = stereo.with_name("second")
    shutil.copytree(stereo, second)
    link = stereo / (name or "run.json")
    shutil.rmtree(link) if name else link.unlink()
    link.symlink_to(second / link.name)
    for each in formats:
        with message.raises(FilesError, link.name):
            export(stereo, each, camera=name or None)
    with message.raises(FilesError, link.name):
        export(stereo, "stir")


WRONG: dict[str, dict[str, Any]] = {
    "distorted": {"distortion": [-0.3, 0.1, 0, 0, 0, 0, 0, 0], "model": "pinhole"},
    "fisheye": {"distortion": [0, 0, 0, 0], "model": "fisheye"},
    "no perspective": {"intrinsics": None, "pose": None},
    "no focal length": {"intrinsics": [[0, 0, 1], [0, 1, 0], [0, 0, 1]]},
    "too few poses": {"poses": [[[1, 0, 0, 0]] * 3]},
}


@pytest.mark.parametrize("name", WRONG)
def test_tapvid3d_rejects_a_camera(name: str, single: Path, message: Messages) -> None:
    describe(single, **WRONG[name])
    with message.raises(ArgumentError if list(WRONG).index(name) < 3 else FilesError, "camera.json"):
        export(single, "tapvid3d")
    assert not (single / "export-tapvid3d").exists()
    # Formats without a calibration export any camera.
    export(single, "tapvid")


def rows(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="ascii") as file:
        return list(csv.DictReader(file))


def column(path: Path, *names: str) -> np.ndarray[Any, Any]:
    return np.array([[float(row[name] or "nan") for name in names] for row in rows(path)])


def test_csv_round_trip(single: Path) -> None:
    arrays = tracks(single)
    arrays["points"][7, 2], arrays["occluded"][7, 2] = np.nan, True
    np.savez(single / "tracks.npz", **arrays)
    done = export(single, "csv")
    assert (done.files, done.notes) == (["forces.csv", "index.csv", "tracks.csv"], [])
    table = done.directory / "tracks.csv"
    assert list(rows(table)[0]) == [
        *("run", "time", "point", "across", "down", "x", "y", "occluded", "position_x", "position_y", "position_z")
    ]
    shape = FRAMES, TRACKS, -1
    np.testing.assert_array_equal(column(table, "point").reshape(shape)[..., 0], [np.arange(TRACKS)] * FRAMES)
    np.testing.assert_array_equal(column(table, "time").reshape(shape)[:, 0, 0], np.arange(FRAMES) / 10)
    for names, expected in (
        (("across", "down"), np.tile(arrays["coordinates"][:, None], (1, FRAMES, 1))),
        (("x", "y"), arrays["points"]),
        (("occluded",), arrays["occluded"][..., None]),
        (("position_x", "position_y", "position_z"), arrays["position"]),
    ):
        values = column(table, *names).reshape(shape).transpose(1, 0, 2)
        np.testing.assert_array_equal(values.astype(np.float32), expected)
    assert rows(table)[2 * TRACKS + 7]["x"] == "", "behind the eye"
    forces = rows(done.directory / "forces.csv")
    assert {row.pop("run") for row in forces} == {"000000"}
    assert forces == rows(single / "forces.csv")


def test_csv_of_several_runs(single: Path, message: Messages) -> None:
    """A run without forces is missing from their table."""
    second = single.parent / "second"
    export(single, "csv", single / "alone")
    shutil.copytree(single, second)
    (second / "forces.csv").unlink()
    done = export([second, single], "csv", single.parent / "all")
    message(done.notes, "forces")
    for name in ("tracks.csv", "forces.csv"):
        exported, expected = rows(done.directory / name), rows(single / "alone" / name)
        for run in ("000000", "000001") if name == "tracks.csv" else ("000001",):
            part = [row for row in exported if row["run"] == run]
            assert [{**row, "run": "000000"} for row in part] == expected


def test_csv_without_forces_or_tracks(stereo: Path, single: Path, message: Messages) -> None:
    (single / "forces.csv").unlink()
    assert export(single, "csv").files == ["index.csv", "tracks.csv"]
    (single / "tracks.npz").unlink()
    with message.raises(FilesError, "forces"):
        export(single, "csv")
    # Forces are independent of the cameras.
    record = json.loads((stereo / "run.json").read_text())
    record["scene"]["output"].remove("tracks")
    (stereo / "run.json").write_text(json.dumps(record))
    for side in ("left", "right"):
        (stereo / side / "tracks.npz").unlink()
    assert export(stereo, "csv").files == ["forces.csv", "index.csv"]


def test_damaged_tables(single: Path, message: Messages) -> None:
    text = (single / "forces.csv").read_text()
    header = text.partition("\n")[0]
    for damaged in ("", f"{header}\n0,0,0\n", f"{header}\n0,0,0,0,0,0,0,=1+1\n"):
        (single / "forces.csv").write_text(damaged)
        with message.raises(FilesError, "forces.csv"):
            export(single, "csv")
    (single / "forces.csv").write_text(text)
    arrays = tracks(single)
    del arrays["position"]
    np.savez(single / "tracks.npz", **arrays)
    with message.raises(FilesError, "tracks.npz"):
        export(single, "csv")
    assert not (single / "export-csv").exists()


def read(path: Path) -> dict[str, NDArray[Any]]:
    with path.open("rb") as file:
        return dict(np.load(file))


def tracks(folder: Path) -> dict[str, Any]:
    with np.load(folder / "tracks.npz") as archive:
        return dict(archive)


def test_tapvid3d_round_trip(single: Path) -> None:
    done = export([single, single], "tapvid3d", single / "all")
    assert (done.files, done.notes) == (["000000.npz", "000001.npz", "index.csv"], [])
    exported, expected = read(done.directory / "000000.npz"), tracks(single)
    assert exported["tracks_XYZ"].shape == (FRAMES, TRACKS, 3)
    np.testing.assert_array_equal(read(done.directory / "000001.npz")["tracks_XYZ"], exported["tracks_XYZ"])
    assert exported["visibility"].shape == (FRAMES, TRACKS)
    assert exported["visibility"].dtype == np.bool_
    np.testing.assert_array_equal(~exported["visibility"].T, expected["occluded"])
    x, y, depth = np.moveaxis(exported["tracks_XYZ"], -1, 0)
    assert (depth > 0.3).all(), "forward is positive"
    fx, fy, cx, cy = exported["fx_fy_cx_cy"]
    pixels = np.stack([fx * x / depth + cx, fy * y / depth + cy], axis=-1).transpose(1, 0, 2)
    # Positions and pixels are rounded to single precision.
    np.testing.assert_allclose(pixels, expected["points"], rtol=0, atol=1e-4)
    assert exported["images_jpeg_bytes"].shape == (FRAMES,)
    for frame, data in enumerate(exported["images_jpeg_bytes"]):
        with Image.open(io.BytesIO(data)) as image:
            assert (image.format, image.size, image.mode) == ("JPEG", (WIDTH, HEIGHT), "RGB")
            drawn = np.asarray(Image.open(single / f"frames/{frame:04}.png"))
            assert np.abs(np.asarray(image).astype(int) - drawn).mean() < 2, "grey levels"


def test_tapvid3d_queries(single: Path, message: Messages) -> None:
    arrays = tracks(single)
    arrays["occluded"][3, :2] = True
    arrays["occluded"][4] = True
    arrays["points"][4, 1] = np.nan
    np.savez(single / "tracks.npz", **arrays)
    done = export(single, "tapvid3d")
    message(done.notes, "1 of 36")
    exported = read(done.directory / "000000.npz")
    assert exported["tracks_XYZ"].shape == (FRAMES, TRACKS - 1, 3)
    assert exported["queries_xyt"].shape == (TRACKS - 1, 3)
    t, y, x = np.round(exported["queries_xyt"][:, ::-1]).astype(int).T
    np.testing.assert_array_equal(t, [0, 0, 0, 2, *[0] * 31])
    assert exported["visibility"][t, np.arange(TRACKS - 1)].all()
    kept = np.delete(arrays["points"], 4, axis=0)
    np.testing.assert_array_equal(exported["queries_xyt"][:, :2], kept[np.arange(TRACKS - 1), t])
    assert (x < WIDTH).all()
    assert (y < HEIGHT).all()


def test_tapvid3d_of_a_moving_camera(single: Path) -> None:
    angle = 0.1 * np.arange(FRAMES)
    poses = np.tile(np.eye(3, 4), (FRAMES, 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angle)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(angle), -np.sin(angle)
    poses[:, 2, 3] = 1 + angle
    # The coefficients of a calibrated camera may all be 0.
    describe(single, poses=poses.tolist(), distortion=[0.0] * 8, model="pinhole")
    exported, world = read(export(single, "tapvid3d").directory / "000000.npz"), tracks(single)["position"]
    np.testing.assert_array_equal(exported["extrinsics_w2c"][:, :3], poses)
    np.testing.assert_array_equal(exported["extrinsics_w2c"][:, 3], [[0, 0, 0, 1]] * FRAMES)
    for frame in range(FRAMES):
        points = np.column_stack([world[:, frame], np.ones(TRACKS)]).astype(float)
        expected = (exported["extrinsics_w2c"][frame] @ points.T).T[:, :3]
        np.testing.assert_allclose(exported["tracks_XYZ"][frame], expected, rtol=0, atol=1e-15)
