"""What TAPVid-3D's own evaluation reads of our files.

Its requirements, restated (google-deepmind/tapnet, tapnet/tapvid3d, at c2cbab8 where nothing else is said):

- evaluation/evaluate_model.py, lines 191 to 197: an .npz with images_jpeg_bytes, queries_xyt, tracks_XYZ, visibility
  and fx_fy_cx_cy; lines 108 to 112: each image is a JPEG that Pillow opens; lines 237 to 244: visibility is true where
  a point is seen, tracks and visibility have the order t, n, and the columns of queries, reversed, are t, y, x;
- evaluation/metrics.py, lines 23 to 29: the thresholds are the depth, the last column of tracks, over the focal length
  in pixels; lines 205 to 211: tracks are read in the frame of their query;
- annotation_generation/adt_utils.py at 00f244e, lines 109 to 118: a point is in the pixel of row floor(y) and column
  floor(x), with x = fx X / Z + cx, so that pixels are counted from the picture's corner;
- colab/load_and_visualize_tapvid3d_samples.ipynb, lines 166 to 174: np.load without pickle; extrinsics_w2c if it is
  there, README.md, line 108: from the world to the camera.
"""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import export
from tests.exports.test_cameras import alone, describe

FRAMES, TRACKS, WIDTH, HEIGHT = 5, 36, 320, 256


@pytest.fixture
def single(stereo: Path) -> Path:
    return alone(stereo, "left")


def read(path: Path) -> dict[str, NDArray[Any]]:
    with path.open("rb") as file:
        return dict(np.load(file))


def tracks(folder: Path) -> dict[str, Any]:
    with np.load(folder / "tracks.npz") as archive:
        return dict(archive)


def test_tracks_come_back_in_the_pixels_of_the_frames(single: Path) -> None:
    done = export(single, "tapvid3d")
    assert (done.files, done.notes) == (["000000.npz", "index.csv"], [])
    found, expected = read(done.directory / "000000.npz"), tracks(single)
    assert found["tracks_XYZ"].shape == (FRAMES, TRACKS, 3)
    assert found["visibility"].shape == (FRAMES, TRACKS)
    assert found["visibility"].dtype == np.bool_
    np.testing.assert_array_equal(~found["visibility"].T, expected["occluded"])
    x, y, depth = np.moveaxis(found["tracks_XYZ"], -1, 0)
    assert (depth > 0.3).all(), "forward is positive"
    fx, fy, cx, cy = found["fx_fy_cx_cy"]
    seen = np.stack([fx * x / depth + cx, fy * y / depth + cy], axis=-1).transpose(1, 0, 2)
    # Places and pixels were rounded to single precision.
    np.testing.assert_allclose(seen, expected["points"], rtol=0, atol=1e-4)


def test_frames_are_nearly_what_was_drawn(single: Path) -> None:
    found = read(export(single, "tapvid3d").directory / "000000.npz")
    assert found["images_jpeg_bytes"].shape == (FRAMES,)
    for frame, data in enumerate(found["images_jpeg_bytes"]):
        with Image.open(io.BytesIO(data)) as image:
            assert (image.format, image.size, image.mode) == ("JPEG", (WIDTH, HEIGHT), "RGB")
            decoded = np.asarray(image).astype(int)
        drawn = np.asarray(Image.open(single / f"frames/{frame:04}.png"))
        assert np.abs(decoded - drawn).mean() < 2, "grey levels"


def test_a_query_is_the_first_sight_of_its_point(single: Path) -> None:
    made = tracks(single)
    made["occluded"][3, :2] = True
    made["occluded"][4] = True
    made["points"][4, 1] = np.nan
    np.savez(single / "tracks.npz", **made)
    done = export(single, "tapvid3d")
    assert done.notes == ["1 of 36 points are left out, as no frame shows them"]
    found = read(done.directory / "000000.npz")
    assert found["tracks_XYZ"].shape == (FRAMES, TRACKS - 1, 3)
    assert found["queries_xyt"].shape == (TRACKS - 1, 3)
    t, y, x = np.round(found["queries_xyt"][:, ::-1]).astype(int).T
    np.testing.assert_array_equal(t, [0, 0, 0, 2, *[0] * 31])
    assert found["visibility"][t, np.arange(TRACKS - 1)].all()
    kept = np.delete(made["points"], 4, axis=0)
    np.testing.assert_array_equal(found["queries_xyt"][:, :2], kept[np.arange(TRACKS - 1), t])
    assert (x < WIDTH).all()
    assert (y < HEIGHT).all()


def test_the_axes_are_those_of_the_camera_in_each_frame(single: Path) -> None:
    angle = 0.1 * np.arange(FRAMES)
    poses = np.tile(np.eye(3, 4), (FRAMES, 1, 1))
    poses[:, 0, 0] = poses[:, 1, 1] = np.cos(angle)
    poses[:, 1, 0], poses[:, 0, 1] = np.sin(angle), -np.sin(angle)
    poses[:, 2, 3] = 1 + angle
    describe(single, poses=poses.tolist())
    found, world = read(export(single, "tapvid3d").directory / "000000.npz"), tracks(single)["position"]
    np.testing.assert_array_equal(found["extrinsics_w2c"][:, :3], poses)
    np.testing.assert_array_equal(found["extrinsics_w2c"][:, 3], [[0, 0, 0, 1]] * FRAMES)
    for frame in range(FRAMES):
        points = np.column_stack([world[:, frame], np.ones(TRACKS)]).astype(float)
        expected = (found["extrinsics_w2c"][frame] @ points.T).T[:, :3]
        np.testing.assert_allclose(found["tracks_XYZ"][frame], expected, rtol=0, atol=1e-15)


def test_every_run_has_a_file_of_its_own(single: Path) -> None:
    done = export([single, single], "tapvid3d", single / "all")
    assert done.files == ["000000.npz", "000001.npz", "index.csv"]
    first, second = (read(done.directory / name)["tracks_XYZ"] for name in done.files[:2])
    np.testing.assert_array_equal(first, second)
