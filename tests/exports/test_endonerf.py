"""EndoNeRF export, decoded as by the loaders of EndoNeRF and EndoGaussian.

Their requirements (med-air/EndoNeRF at 5201b1e, yifliu3/EndoGaussian at d7aad82):

- load_llff.py, lines 97 to 200, and endo_loader.py, lines 170 to 204: poses_bounds.npy has 17 numbers a frame, a
  matrix 3 x 5 whose last column is height, width and focal length, and two bounds; images, depth and masks have a .png
  a frame, in the order of their names;
- load_llff.py, line 178: masks are 1 - value / 255, 0 on tools; endo_loader.py, `format_infos`, leaves depth 0 out;
- run_endonerf_helpers.py, lines 379 to 388: the ray of pixel (i, j), counted from 0, goes along ((i - W / 2) / focal,
  -(j - H / 2) / focal, -1), turned by the first three columns, from the fourth; depth is that along the axis;
- endo_loader.py, line 180: the columns are x, -y, -z and the eye, from camera to world; lines 562 to 572: a point is
  ((i - W / 2) Z / focal, (j - H / 2) Z / focal, Z) in that camera.
"""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import ArgumentError, FilesError, export, run
from tests.exports.test_cameras import describe
from tests.golden import Messages
from tests.scenes import scene

FRAMES, WIDTH, HEIGHT, UNIT = 3, 40, 32, 1e-5

Array = NDArray[np.float64]


def load(folder: Path) -> tuple[Array, Array, list[Array], list[Array], list[Array]]:
    """Load poses, bounds, images, masks and depths as both loaders do."""
    rows = np.load(folder / "poses_bounds.npy")
    poses, bounds = rows[:, :-2].reshape(-1, 3, 5), rows[:, -2:]
    pictures = {
        name: [np.array(Image.open(path)) for path in sorted((folder / name).glob("*.png"))]
        for name in ("images", "depth", "masks")
    }
    assert {len(each) for each in pictures.values()} == {len(poses)}
    images = [each[..., :3] / 255.0 for each in pictures["images"]]
    masks = [1 - each / 255.0 for each in pictures["masks"]]
    return poses, bounds, images, masks, [each.astype(float) for each in pictures["depth"]]


def test_loaders_of_endonerf_and_endogaussian(labelled_in_motion: Path, tmp_path: Path, message: Messages) -> None:
    run = labelled_in_motion
    done = export(run, "endonerf", tmp_path / "out")
    poses, bounds, images, masks, depths = load(done.directory)
    assert poses.shape == (FRAMES, 3, 5)
    np.testing.assert_array_equal(poses[:, :, 4], [[HEIGHT, WIDTH, 45]] * FRAMES)
    np.testing.assert_array_equal(poses[0, :, :4], np.eye(3, 4))
    assert np.linalg.norm(poses[-1, :, 3]) * UNIT == pytest.approx(np.hypot(0.02, 0.05) / 2, rel=1e-6)
    tracks, camera = np.load(run / "tracks.npz"), json.loads((run / "camera.json").read_text())
    first = np.array(camera["poses"][0])
    j, i = np.mgrid[:HEIGHT, :WIDTH]
    for frame in range(FRAMES):
        np.testing.assert_array_equal(images[frame] * 255, np.array(Image.open(run / f"frames/{frame:04}.png")))
        instrument = np.array(Image.open(run / f"instrument/{frame:04}.png"))
        np.testing.assert_array_equal(masks[frame], instrument == 0)
        depth = np.array(Image.open(run / f"depth/{frame:04}.tiff"))
        np.testing.assert_allclose(depths[frame] * UNIT, depth, atol=UNIT * 0.501)
        on_sheet = depth[depth > 0]
        np.testing.assert_allclose(bounds[frame] * UNIT, [on_sheet.min(), on_sheet.max()], rtol=1e-6)
        assert 0.02 < (masks[frame] == 0).mean() < 0.5
        # Tracked points, in the world of the loaders: the first camera's, right, up and backward.
        points = tracks["position"][:, frame].astype(float) @ first[:, :3].T + first[:, 3]
        points *= np.array([1, -1, -1]) / UNIT
        # EndoGaussian's camera.
        pose = poses[frame]
        to_world = np.stack([pose[:, 0], -pose[:, 1], -pose[:, 2], pose[:, 3]], axis=-1)
        x, y, z = np.linalg.solve(to_world[:, :3], (points - to_world[:, 3]).T)
        pixels = np.stack([45 * x / z + WIDTH / 2, 45 * y / z + HEIGHT / 2], axis=-1)
        np.testing.assert_allclose(pixels, tracks["points"][:, frame] - 0.5, atol=2e-3)
        # EndoNeRF's rays end on the same points.
        rays = np.stack([(i - WIDTH / 2) / 45, -(j - HEIGHT / 2) / 45, -np.ones_like(i)], axis=-1)
        ends = pose[:, 3] + depths[frame][..., None] * (rays @ pose[:, :3].T)
        visible = ~tracks["occluded"][:, frame]
        column, row = np.rint(pixels[visible]).astype(int).T
        # A pixel's middle is up to 0.71 px from the point, 0.011 of its depth of 0.5 m; the sheet is tilted.
        assert visible.sum() > 5
        assert np.linalg.norm(ends[row, column] - points[visible], axis=-1).max() * UNIT < 0.02
    message(done.notes, "0.01 mm", "640 x 512")


def test_unit_of_large_depths(labelled_in_motion: Path, tmp_path: Path) -> None:
    run = Path(shutil.copytree(labelled_in_motion, tmp_path / "run"))
    deep = np.array(Image.open(run / "depth/0001.tiff"))
    deep[0, :2] = 1.0, 2e-5
    Image.fromarray(deep).save(run / "depth/0001.tiff")
    done = export(run, "endonerf")
    _, bounds, _, _, depths = load(done.directory)
    assert depths[1][0, :2].tolist() == [10000, 1]
    np.testing.assert_allclose(bounds[1], [0.2, 10000])
    assert any("0.1 mm" in note for note in done.notes)


def test_unsupported_cameras(labelled_in_motion: Path, tmp_path: Path, message: Messages) -> None:
    run = Path(shutil.copytree(labelled_in_motion, tmp_path / "run"))
    describe(run, intrinsics=[[45, 0, 22], [0, 46, 16.5], [0, 0, 1]])
    with message.raises(ArgumentError):
        export(run, "endonerf")
    describe(run, intrinsics=[[45, 0, 20.5], [0, 45, 16.5], [0, 0, 1]], distortion=[0.1])
    with message.raises(ArgumentError):
        export(run, "endonerf")
    describe(run, distortion=[])
    Image.fromarray(np.zeros((HEIGHT, WIDTH), np.float32)).save(run / "depth/0001.tiff")
    with message.raises(FilesError):
        export(run, "endonerf")


@pytest.mark.parametrize("name", ["endonerf", "tapvid3d", "stir"])
def test_camera_is_refused_before_outputs_are_asked_for(name: str, tmp_path: Path, message: Messages) -> None:
    """A run without the outputs of the format, whose camera it cannot describe, is refused for the camera."""
    intrinsics = {"fx": 45, "fy": 45, "cx": 22, "cy": 16.5}
    cameras: dict[str, dict[str, object]] = {"distortion": {"intrinsics": intrinsics, "distortion": {"k1": 0.01}}}
    if name == "endonerf":
        cameras["principal point"] = {"intrinsics": intrinsics}
    for word, optics in cameras.items():
        left = {"eye": [0, 0, 0.5], **optics}
        pair = {"cameras": {"left": left, "right": {"beside": "left", "baseline": 0.01}}}
        render = {"size": (WIDTH, HEIGHT), **(pair if name == "stir" else {"camera": left})}
        run(scene(output=["trajectory"], render=render, time={"duration": 0.04}), tmp_path / word)
        with message.raises(ArgumentError, word):
            export(tmp_path / word, name)
