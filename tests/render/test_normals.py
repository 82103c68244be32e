"""The normals of what every pixel shows: against the twin, closed forms, and the gradient of depth."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm import Playback, Simulation, run
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import Solid, place_instruments
from taichi_msm.render.camera import view
from taichi_msm.render.labels import LABELS
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.reference import labels as twin
from tests.render.test_labels import crumpled, folded, look
from tests.render.test_lens import INTRINSICS, LENSES
from tests.render.test_rasterizer import NEAR, dented, drawable, with_instruments
from tests.runs.test_label_files import OBLIQUE, ROD, small_scene

Array = NDArray[np.float64]

PLACE = {"eye": [0.05, -0.2, 0.3], "target": [0, 0, 0], "intrinsics": INTRINSICS}
CAMERAS: dict[str, Any] = {
    "top": "top",
    "pinhole": NEAR,
    "calibrated": PLACE,
    **{lens: {**PLACE, **LENSES[lens]} for lens in ("endoscope", "rational", "fisheye")},
}
EVERY_CAMERA = pytest.mark.parametrize("camera", CAMERAS)


def apart(a: Any, b: Any) -> Array:
    """Angles between unit vectors [rad], if they are small."""
    return np.asarray(np.linalg.norm(np.subtract(a, b, dtype=float), axis=-1))


def points(made: Scene, depth: NDArray[np.float32]) -> Array:
    """The points that pixels show [m], in OpenCV's axes of the camera, shape (height, width, 3)."""
    camera, (width, height) = view(made), made.render.size
    y, x = np.mgrid[:height, :width] + 0.5
    aside = (camera.undistort(np.stack([x, y], axis=-1)) - camera.centre) / camera.scale
    far = depth[..., None].astype(float)
    return np.concatenate([aside * far if camera.pinhole else aside, far], axis=-1)


def axes(made: Scene) -> Array:
    """OpenCV's axes of the camera, as columns."""
    return view(made).axes.T * [1, -1, -1]


@pytest.mark.default_cases("folded-top")
@pytest.mark.parametrize(("shape", "camera"), [(folded, "top"), (dented, "pinhole"), (crumpled, "endoscope")])
def test_normals_are_those_of_the_twin(shape: Any, camera: str, device: Device) -> None:
    made = with_instruments(drawable(camera=CAMERAS[camera]))
    position = shape(made)
    placed = place_instruments(made, position, 0)
    (_, depth, _, found), expected = look(made, position, LABELS), twin.normals(made, position, placed)
    np.testing.assert_array_equal(np.isnan(found), np.isnan(expected))
    seen = ~np.isnan(found[..., 0])
    error = apart(found, expected)[seen]
    # As of other labels, rounding moves an edge past a pixel's centre now and then. Beside it a normal is off by what
    # f32 leaves of a small quad's sides and, where a rod is seen edge-on, of the root that tells where it is.
    assert (error < 3e-4).mean() > 0.998
    assert np.median(error) < 1e-6
    np.testing.assert_allclose(np.linalg.norm(found[seen], axis=-1), 1, atol=1e-6)
    sight = points(made, np.ones_like(depth)) if view(made).pinhole else np.array([0, 0, 1])
    assert ((sight * found).sum(axis=-1)[seen] < 1e-6).all(), "toward the camera"


@pytest.mark.default_cases("top", "calibrated")
@EVERY_CAMERA
def test_a_tilted_sheet_has_one_normal(camera: str, device: Device) -> None:
    made = with_instruments(drawable(camera=CAMERAS[camera]))
    lean, turn = np.radians(30), np.radians(20)
    tilt = np.array([[1, 0, 0], [0, np.cos(lean), -np.sin(lean)], [0, np.sin(lean), np.cos(lean)]])
    tilt = np.array([[np.cos(turn), 0, np.sin(turn)], [0, 1, 0], [-np.sin(turn), 0, np.cos(turn)]]) @ tilt
    for side in (1, -1):  # The front, then the back.
        found = look(made, rest_positions(made.sheet) * [side, 1, 1] @ tilt.T, LABELS, ()).normals
        seen = ~np.isnan(found[..., 0])
        assert seen.mean() > 0.15
        normal = tilt[:, 2] @ axes(made)
        # 2^-24 of a coordinate of the picture, some hundred, over the sides of a small quad, a few pixels long.
        np.testing.assert_allclose(found[seen], np.tile(normal, (seen.sum(), 1)), atol=2e-5)


@EVERY_CAMERA
def test_a_rod_has_the_normals_of_its_side_and_of_its_round_tip(camera: str, device: Device) -> None:
    made = with_instruments(drawable(camera=CAMERAS[camera]))
    shaft = np.array([0.96, 0.0, 0.28])
    rod = Solid(np.array([-0.03, 0.02, 0.03]), shaft, 0.05, 0.03)
    found = look(made, rest_positions(made.sheet), LABELS, [rod])
    tip, along = (rod.tip - view(made).eye) @ axes(made), shaft @ axes(made)
    away = points(made, found.depth) - tip
    place = away @ along
    outward = (away - np.clip(place, 0, rod.length)[..., None] * along) / rod.radius
    seen = found.instrument == 255
    for part in (place < 0, (place > 0) & (place < rod.length), place > rod.length):
        assert (seen & part).sum() > 10
    facing = outward[seen]
    # Seen edge-on, the root that tells where a line of sight meets the rod has half of f32's digits.
    np.testing.assert_allclose(np.linalg.norm(facing, axis=-1), 1, atol=1e-4)
    assert np.median(apart(found.normals[seen], facing)) < 1e-6
    assert apart(found.normals[seen], facing).max() < 1e-4


@pytest.mark.slow
def test_other_labels_keep_their_bits(device: Device) -> None:
    made = with_instruments(drawable(camera=CAMERAS["endoscope"]))
    position = folded(made)
    labels, without = look(made, position, LABELS), look(made, position)
    assert labels.normals.shape == (60, 80, 3)
    assert without.normals.shape == (0, 0, 3)
    for label, other in zip(labels[:3], without[:3], strict=True):
        np.testing.assert_array_equal(label, other)


def test_normals_of_a_run_and_from_python(small: Path, device: Device) -> None:
    scene = small_scene(OBLIQUE, ROD, "output=[normals, trajectory]")
    assert run(scene, "out", threads=device.threads)["outputs"] == [
        *("normals", "trajectory.npz", "camera.json", "run.json")
    ]
    written = [np.load(f"out/normals/{frame:04}.npy") for frame in range(5)]
    assert {(one.dtype, one.shape) for one in written} == {(np.dtype(np.float32), (30, 40, 3))}
    with Playback("out", threads=device.threads) as playback:
        for frame in range(5):
            np.testing.assert_array_equal(playback.labels(frame).normals, written[frame])
    # At rest the sheet faces up.
    with Simulation(scene, threads=device.threads) as simulation:
        labels, up = simulation.labels(), view(scene).axes[:, 2] * [1, -1, -1]
    sheet = ~np.isnan(labels.coordinates[..., 0])
    np.testing.assert_allclose(labels.normals[sheet], np.tile(up, (sheet.sum(), 1)), atol=1e-5)
