"""STIR export, decoded as by STIR's loader.

Its requirements (athaddius/STIRLoader, STIRLoader/STIRLoader.py at 7e7f87c):

- lines 39 to 53: the data folder holds a folder for each recording, in it left*, and there seq*;
- lines 69 to 80: the folder of the right camera has the name of the left one with left replaced by right;
- lines 154 to 160: frames/*.mp4 is one video on each side; lines 128 to 134: its name begins with whole milliseconds,
  from and to, each before "ms-";
- lines 180 to 188: calib.json has camera matrices, distortions, translation and rotation; lines 194 to 196: the
  right distortion is 0;
- lines 23 to 36, 197 and 475: positions are (x, y, disparity, 1) times Q, whose last row is -1 over the first number of
  the translation in millimetres: it must be negative for positions in front of the camera;
- lines 204 to 245: segmentation/icgstartseg.png, icgendseg.png, *_icgstart.png and *_icgend.png;
- lines 260 to 281: a track is the centre of the bounding box of a connected region, at whole numbers,
  x + width // 2 and y + height // 2, counted from the first pixel;
- lines 382 to 401: its match in the right picture is within 10 rows, with a disparity of 8 to 105 px;
- lines 582 to 587 and 695 to 706: videos have 1280 x 1024 pixels.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage

from taichi_msm import ArgumentError, FilesError, NotInstalledError, export
from taichi_msm.scene import outputs
from tests.exports.test_cameras import alone, describe, tracks
from tests.golden import Messages

av: Any = pytest.importorskip("av")

FRAMES, WIDTH, HEIGHT, BASELINE = 5, 320, 256, 0.008


def to_the_right(left: Path) -> Path:
    return left.parents[1] / left.parent.name.replace("left", "right", 1) / left.name


def video(sequence: Path) -> list[NDArray[np.uint8]]:
    (path,) = sequence.glob("frames/*.mp4")
    start, end, _ = path.name.split("ms-")
    assert (int(start), int(end)) == (0, 400)
    with av.open(str(path)) as container:
        assert container.streams.video[0].codec_context.name == "h264"
        return [frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)]


def centres(sequence: Path, part: str) -> NDArray[np.int64]:
    """Return x, y of the marked tracks of a picture, in the order of rows."""
    mask = np.asarray(Image.open(sequence / f"segmentation/icg{part}seg.png"))
    assert mask.shape == (HEIGHT, WIDTH)
    assert set(np.unique(mask)) == {0, 255}
    boxes = ndimage.find_objects(ndimage.label(mask, np.ones((3, 3)))[0])
    return np.array([[each.start + (each.stop - each.start) // 2 for each in (box[1], box[0])] for box in boxes])


@pytest.fixture
def left(stereo: Path) -> Path:
    """Export, and return the folder of the left camera."""
    (left,) = export(stereo, "stir").directory.glob("*/left*/seq*")
    return left


def test_videos_and_calibration(stereo: Path, left: Path) -> None:
    assert left == stereo / "export-stir/000000/left/seq00"
    for side in (left, to_the_right(left)):
        frames = video(side)
        assert (len(frames), frames[0].shape) == (FRAMES, (HEIGHT, WIDTH, 3))
        for frame, part in ((0, "start"), (FRAMES - 1, "end")):
            (picture,) = side.glob(f"*_icg{part}.png")
            drawn = np.asarray(Image.open(stereo / side.parent.name / f"frames/{frame:04}.png"))
            np.testing.assert_array_equal(np.asarray(Image.open(picture)), drawn)
            # Luminance, as colours have half the resolution.
            assert np.abs((frames[frame].astype(int) - drawn) @ (0.2126, 0.7152, 0.0722)).mean() < 3, "grey levels"
    calibration = json.loads((left.parents[1] / "calib.json").read_text())
    assert not np.any(calibration["rightdistortioncoeffs"])
    np.testing.assert_array_equal(calibration["rotation"], np.eye(3))
    np.testing.assert_allclose(calibration["translation"], [-BASELINE, 0, 0], rtol=1e-9)
    intrinsics = json.loads((stereo / "left/camera.json").read_text())["intrinsics"]
    for name in ("left", "right"):
        # From pixels that count from the corner to OpenCV's.
        np.testing.assert_allclose(
            np.subtract(intrinsics, calibration[f"{name}cameramat"]), [[0, 0, 0.5]] * 2 + [[0] * 3]
        )


def test_triangulated_positions(stereo: Path, left: Path) -> None:
    """The error of depth [mm] is at most that of a pixel of disparity, z^2 / (f b) / (1 - 1 / d)."""
    calibration = json.loads((left.parents[1] / "calib.json").read_text())
    matrix, baseline = np.array(calibration["leftcameramat"]), calibration["translation"][0] * 1000
    arrays = tracks(stereo / "left")
    pose = np.array(json.loads((stereo / "left/camera.json").read_text())["pose"])
    for frame, part in ((0, "start"), (-1, "end")):
        matches = centres(to_the_right(left), part)
        assert len(matches) == len(centres(left, part)) > 20
        for x, y in centres(left, part):
            (n,) = np.flatnonzero((np.floor(arrays["points"][:, frame]) == (x, y)).all(axis=-1))
            disparity = x - matches[np.abs(matches - (x, y)).sum(axis=-1).argmin(), 0]
            w = -disparity / baseline
            position = np.array([x - matrix[0, 2], y - matrix[1, 2], matrix[0, 0]]) / w
            expected = 1000 * (pose @ np.append(arrays["position"][n, frame], 1))
            assert abs(position[2] - expected[2]) < 1.01 * expected[2] ** 2 / (matrix[0, 0] * -baseline) / (
                1 - 1 / disparity
            )
            assert np.abs(position[:2] / position[2] - expected[:2] / expected[2]).max() < 0.51 / matrix[0, 0]


def test_occluded_tracks_are_not_marked(stereo: Path, left: Path, message: Messages) -> None:
    before = len(centres(left, "start"))
    arrays = tracks(stereo / "right")
    x, y = centres(left, "start")[0]
    (n,) = np.flatnonzero((np.floor(tracks(stereo / "left")["points"][:, 0]) == (x, y)).all(axis=-1))
    arrays["occluded"][n, -1], arrays["points"][n, -1] = True, np.nan
    np.savez(stereo / "right" / "tracks.npz", **arrays)
    done = export(stereo, "stir")
    assert all(
        len(centres(side, part)) == before - 1 for side in (left, to_the_right(left)) for part in ("start", "end")
    )
    message(done.notes, f"{before - 1} of 36", "1280 x 1024", "8 to 105 px")


def test_discs_do_not_touch(stereo: Path) -> None:
    """Touching discs would be one region."""
    for side in ("left", "right"):
        arrays = tracks(stereo / side)
        arrays["points"][1] = arrays["points"][0] + (5, 0)
        arrays["points"][2] = arrays["points"][0] + (6, 0)
        np.savez(stereo / side / "tracks.npz", **arrays)
    marked = centres(export(stereo, "stir").directory / "000000/left/seq00", "start").tolist()
    first = np.floor(tracks(stereo / "left")["points"][:3, 0]).astype(int)
    assert [centre.tolist() in marked for centre in first] == [True, False, True]


def test_cameras_that_are_not_rectified(stereo: Path, message: Messages) -> None:
    pose = np.array(json.loads((stereo / "right/camera.json").read_text())["pose"])
    turned, lower, swapped = pose.copy(), pose.copy(), pose.copy()
    turned[0], turned[1] = pose[1], -pose[0]
    lower[1, 3] += 1e-4
    swapped[0, 3] += 2 * BASELINE
    poses = [{"pose": each.tolist()} for each in (turned, lower, swapped)]
    for changes in (*poses, {"pose": pose.tolist(), "intrinsics": [[100, 0, 160], [0, 100, 128], [0, 0, 1]]}):
        describe(stereo / "right", **changes)
        with message.raises(FilesError):
            export(stereo, "stir")


def test_unsupported_runs(stereo: Path, message: Messages) -> None:
    with message.raises(FilesError, "cameras"):
        export(alone(stereo, "left"), "stir")
    describe(stereo / "right", distortion=[0.1] * 8)
    with message.raises(ArgumentError, "right/camera.json"):
        export(stereo, "stir")
    (stereo / "right/tracks.npz").unlink()
    with message.raises(FilesError, "tracks"):
        export(stereo, "stir")


def test_pyav_is_not_installed(stereo: Path, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    monkeypatch.setattr(outputs, "is_pyav_installed", lambda: False)
    with message.raises(NotInstalledError, "PyAV"):
        export(stereo, "stir")
