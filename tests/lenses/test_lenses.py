"""Lens distortion: against OpenCV, the twin, which tests every triangle at every pixel, and picking."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.cameras.lens import Lens
from taichi_msm.errors import SceneError
from taichi_msm.lenses import MODELS
from taichi_msm.lenses.model import MAX_RADIUS
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import place_instruments
from taichi_msm.render import tracking, uniforms
from taichi_msm.render.camera import calibration, view
from taichi_msm.render.picking import pick
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.reference import labels as twin
from tests.reference.lens import scaramuzza_pixel
from tests.render.test_labels import (
    assert_labels_match_twin,
    assert_tracks_match_twin,
    crumpled,
    draw_labels,
    folded,
)
from tests.render.test_rasterizer import (
    assert_picture_matches_twin,
    assert_same_bits_with_lanes,
    dented,
    drawable,
    with_instruments,
)
from tests.scenes import speckle

Array = NDArray[np.float64]

# Made for a picture of 80 x 60 pixels. The endoscope's coefficients are those of a laparoscope, rounded; `fold` folds
# back within the picture.
INTRINSICS = {"fx": 60, "fy": 62, "cx": 37, "cy": 31}
LENSES: dict[str, dict[str, Any]] = {
    "endoscope": {"distortion": {"k1": -0.34, "k2": 0.12, "p1": 0.001, "p2": -0.002, "k3": -0.01}},
    "fold": {"distortion": {"k1": -0.5}, "outside": "background"},
    "rational": {"distortion": {"k1": 0.3, "k2": 0.1, "k4": 0.8, "k6": 0.02, "p1": -0.004}},
    "fisheye": {"distortion": {"model": "fisheye", "k1": -0.05, "k2": 0.01}},
    "pincushion": {"distortion": {"k1": 0.4}},
    "omnidir": {
        "distortion": {"model": "omnidir", "xi": 0.5, "k1": -0.2, "k2": 0.05, "p1": 0.002, "p2": -0.001},
        "intrinsics": {"fx": 90, "fy": 93, "cx": 37, "cy": 31},
    },
    "scaramuzza": {
        "distortion": {"model": "scaramuzza", "a0": 61, "a2": -4e-3, "a3": 3e-5, "a4": -1e-6, "c": 1.01, "d": 0.02},
        "intrinsics": {"cx": 37, "cy": 31},
    },
    # Ends at 20 degrees, within the picture, where its derivative is infinite.
    "end": {
        "distortion": {"model": "scaramuzza", "a0": 61, "a2": 0.03},
        "intrinsics": {"cx": 37, "cy": 31},
        "outside": "background",
    },
}


def scene_with_lens(lens: str, **render: Any) -> Scene:
    camera = {"eye": [0.05, -0.2, 0.3], "target": [0, 0, 0], "intrinsics": INTRINSICS, **LENSES[lens]}
    return with_instruments(drawable(camera=camera, **render))


def omnidir_points(points: Array, axis: Array, shift: Array, matrix: Array, distortion: Array) -> tuple[Array]:
    """As cv2.omnidir.projectPoints, which only OpenCV's contributed modules have, from its documentation."""
    xi, k1, k2, p1, p2 = distortion
    sphere = points[:, 0] @ cv2.Rodrigues(axis)[0].T + shift
    sphere = sphere / np.linalg.norm(sphere, axis=-1, keepdims=True)
    u, v = sphere[:, :2].T / (sphere[:, 2] + xi)
    q = u**2 + v**2
    radial = 1 + k1 * q + k2 * q**2
    distorted = u * radial + 2 * p1 * u * v + p2 * (q + 2 * u**2), v * radial + p1 * (q + 2 * v**2) + 2 * p2 * u * v
    return ((np.stack([*distorted, np.ones_like(u)], axis=-1) @ matrix.T)[:, None, :2],)


def scaramuzza_points(points: Array, axis: Array, shift: Array, matrix: Array, distortion: Array) -> tuple[Array]:
    x, y, z = (points[:, 0] @ cv2.Rodrigues(axis)[0].T + shift).T
    return ((np.stack(scaramuzza_pixel(distortion.tolist(), x / z, y / z), axis=-1) + matrix[:2, 2])[:, None],)


PROJECT: dict[str, Any] = {
    "pinhole": cv2.projectPoints,
    "fisheye": cv2.fisheye.projectPoints,
    "omnidir": omnidir_points,
    "scaramuzza": scaramuzza_points,
}

# The calibration of C3VD's colonoscope (Bobrow et al. 2023), in pixels of 1350 x 1080.
C3VD = (769.2436, -8.127706e-4, 6.256742e-7, -1.196622e-9, 0.99998688, 0.00288274, -0.00296316)


@pytest.mark.parametrize(
    "lens",
    [
        Lens("pinhole", (-0.5, 0.2, 1e-3, -2e-3, 0, 0, 0, 0)),
        # Its limit is a pole, at r = sqrt(5).
        Lens("pinhole", (-0.2, 0.02, 0, 0, 0, -0.2, 0, 0)),
        Lens("pinhole", (0.3, 0.1, 1e-3, 1e-3, 0.05, 0.4, 0.1, 0.01)),
        Lens("fisheye", (-0.05, 0.01, -0.003, 0.001)),
        Lens("fisheye", (-0.5, 0, 0, 0)),
        Lens("omnidir", (0.0, -0.1, 0.02, 1e-3, -2e-3)),
        Lens("omnidir", (2.5, 0.4, -0.1, 0, 1e-3)),
        Lens("scaramuzza", C3VD),
        # Without polynomial, and one that folds back at 44 degrees.
        Lens("scaramuzza", (300, 0, 0, 0, 1, 0, 0)),
        Lens("scaramuzza", (400, -5e-4, 2e-6, 0, 1, 0.1, 0.02)),
    ],
    ids=str,
)
def test_distortion_inverse_and_jacobian(lens: Lens) -> None:
    rng = np.random.default_rng(1)
    radius, angle = min(lens.limit * 0.98, 2.5) * rng.uniform(0, 1, 5000), rng.uniform(0, 2 * np.pi, 5000)
    points = np.stack([radius * np.cos(angle), radius * np.sin(angle)], axis=-1)
    rays, zero = np.concatenate([points, np.ones((5000, 1))], axis=1)[:, None], np.zeros(3)
    expected = PROJECT[lens.model](rays, zero, zero, np.eye(3), np.array(lens.coefficients))[0][:, 0]
    expected /= lens.coefficients[0] if lens.model == "scaramuzza" else 1
    distorted = lens.distort(points)
    np.testing.assert_allclose(distorted, expected, atol=1e-13)
    # 1e-6 px where the focal length is 1000 px; no second solution is nearer to the axis.
    np.testing.assert_allclose(lens.undistort(distorted), points, atol=1e-9)
    slope = [(lens.distort(points + step) - lens.distort(points - step)) / 2e-6 for step in 1e-6 * np.eye(2)]
    np.testing.assert_allclose(lens.jacobian(points), np.stack(slope, axis=-1), atol=1e-7)


@pytest.mark.parametrize(
    ("model", "coefficients", "limit"),
    [
        # r - r^3 / 2 is largest at r = sqrt(2 / 3), as t - t^3 / 2 of the fisheye at t = atan(r).
        ("pinhole", (-0.5, 0, 0, 0, 0, 0, 0, 0), np.sqrt(2 / 3)),
        ("fisheye", (-0.5, 0, 0, 0), np.tan(np.sqrt(2 / 3))),
        # Of y + 3 p1 y^2, the distorted point below the axis with p1 only, the derivative is 0 at y = -1 / (6 p1).
        ("pinhole", (0, 0, 0.05, 0, 0, 0, 0, 0), 1 / 0.3),
        # The plane's u - u^3 / 2 is largest at u = sqrt(2 / 3), and with xi = 1, u = tan(t / 2).
        ("omnidir", (1.0, -0.5, 0, 0, 0), np.tan(2 * np.arctan(np.sqrt(2 / 3)))),
        # Without xi it is the rational lens.
        ("omnidir", (0.0, -0.5, 0, 0, 0), np.sqrt(2 / 3)),
        # Of a plane that the sphere does not reach nothing folds, nor of C3VD's polynomial within 88 degrees.
        ("omnidir", (3.0, -0.5, 0, 0, 0), MAX_RADIUS),
        ("scaramuzza", C3VD, MAX_RADIUS),
        # p / (a0 + a2 p^2) is largest at p = sqrt(a0 / a2), sqrt(1 / (4 a0 a2)).
        ("scaramuzza", (400, 1e-4, 0, 0, 1, 0, 0), 2.5),
        # A polynomial that a denormal coefficient leads would have zeros where numbers overflow.
        ("pinhole", (0, 0, 0, 0, 0, 0, 0, 5e-324), MAX_RADIUS),
        ("fisheye", (0, 0, 0, 5e-324), MAX_RADIUS),
    ],
)
def test_limit_of_a_lens(model: str, coefficients: tuple[float, ...], limit: float) -> None:
    assert Lens(model, coefficients).limit == pytest.approx(limit, rel=1e-5 if model == "scaramuzza" else 1e-6)


def test_no_line_of_sight_beyond_the_limit() -> None:
    rim = np.sqrt(8 / 27)  # r - r^3 / 2 at r = sqrt(2 / 3)
    points = Lens("pinhole", (-0.5, 0, 0, 0, 0, 0, 0, 0)).undistort(
        np.array([[0.0, 0.0], [0.0, rim * 0.9999], [rim * 1.0001, 0.0]])
    )
    np.testing.assert_array_equal(np.isnan(points[:, 0]), [False, False, True])
    np.testing.assert_array_equal(points[0], [0, 0])


@pytest.mark.parametrize(
    "coefficients",
    [(-0.5, 0, 0.02, 0.01, 0, 0, 0, 0), (0.1, 0.2, 0.01, -0.3, 0.1, 0.5, 0, 0.1), (0, 0, 2, 1e6, 0, 0, 0, 0)],
)
def test_limit_of_tangential_distortion(coefficients: tuple[float, ...]) -> None:
    """There the determinant of the Jacobian becomes 0, at some angle, and not before."""
    lens = Lens("pinhole", coefficients)
    angle = np.linspace(0, 2 * np.pi, 721)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    least = [np.linalg.det(lens.jacobian(share * lens.limit * circle)).min() for share in np.linspace(0.01, 1.01, 101)]
    assert min(least[:-2]) > 0 > least[-1]


@pytest.mark.parametrize("lens", ["fisheye", "omnidir", "scaramuzza"])
def test_record_and_calibration_of_a_lens(lens: str) -> None:
    made = scene_with_lens(lens)
    recorded = made.model_dump(mode="json")
    assert recorded["render"]["camera"]["distortion"].keys() == {"model", *MODELS[lens].coefficients}
    assert Scene.model_validate(recorded) == made
    written, given = calibration(view(made)), LENSES[lens]["distortion"]
    assert written["model"] == lens
    default = {name: row.default for name, row in MODELS[lens].coefficients.items()}
    assert written["distortion"] == [{**default, **given}[name] for name in default]
    if lens == "scaramuzza":
        assert np.diag(written["calibration"]).tolist() == [61, 61, 1]


def test_every_lens_fits_into_the_uniforms() -> None:
    assert max(len(model.coefficients) for model in MODELS.values()) <= uniforms.LENS_RADIUS - uniforms.LENS


@pytest.mark.parametrize(
    ("lens", "render"),
    [
        ("fisheye", {"shading": "tissue", "wireframe": True}),
        pytest.param("endoscope", {"wireframe": True, "supersample": 2}, marks=pytest.mark.slow),
        pytest.param("fold", {"shading": "tissue", "light": {"relief": -0.2, "vignette": 0.3}}, marks=pytest.mark.slow),
    ],
)
def test_pictures_match_the_twin(lens: str, render: dict[str, Any], device: Device) -> None:
    made, texture = scene_with_lens(lens, **render), speckle(13, 17)
    for shape in (dented, folded):
        position = shape(made)
        picture = assert_picture_matches_twin(made, position, texture, place_instruments(made, position, 0))
        assert 0.2 < (picture.max(axis=-1) > 0).mean() < 0.95


@pytest.mark.slow
@pytest.mark.parametrize(("lens", "refine"), [("fold", 0), ("fisheye", 3), ("pincushion", 0)])
def test_curved_sides_of_large_cells(lens: str, refine: int, device: Device) -> None:
    """Sides of cells 90 pixels long have sagittas of up to 8 px, more than a tile, outward and inward."""
    intrinsics = {"fx": 150, "fy": 150, "cx": 99.5, "cy": 74.5}
    camera = {"eye": [0, 0, 0.33], "intrinsics": intrinsics, "outside": "background", **LENSES[lens]}
    made = drawable((2, 3), camera=camera, size=[200, 150], refine=refine)
    position = rest_positions(made.sheet)
    np.testing.assert_allclose(draw_labels(made, position).coordinates, twin.labels(made, position)[0], atol=1e-5)


@pytest.mark.slow
@pytest.mark.parametrize(("lens", "lanes"), [("fisheye", 4), ("fold", 1)])
def test_lanes_do_not_change_the_bits(lens: str, lanes: int, device: Device) -> None:
    renders: list[dict[str, Any]] = [{"shading": "tissue", "size": [79, 57]}, {"wireframe": True, "supersample": 3}]
    for render in renders:
        made, texture = scene_with_lens(lens, **render), speckle(30, 20)
        assert_same_bits_with_lanes(made, texture, folded(made), lanes)


# Kernels take seconds to compile.
@pytest.mark.default_cases("endoscope-folded", "fold-crumpled", "fisheye-folded")
@pytest.mark.parametrize(("lens", "shape"), [*((lens, folded) for lens in LENSES), ("fold", crumpled)])
def test_labels_match_the_twin_and_picking(lens: str, shape: Any, device: Device) -> None:
    made = scene_with_lens(lens)
    position = shape(made)
    labels = assert_labels_match_twin(made, position)
    for x, y in [(40, 30), (15, 20), (66, 44), (30, 50), (2, 2)]:
        picked, coordinates = pick(position, made.render.refine, view(made), (x, y)), labels.coordinates[y, x]
        # An instrument may be in front of the sheet.
        assert (picked is None) == np.isnan(coordinates[0]) or labels.instrument[y, x]
        if picked is not None and not np.isnan(coordinates[0]):
            np.testing.assert_allclose(picked, coordinates, atol=1e-5)


@pytest.mark.default_cases(*(f"{lens}-False" for lens in ("endoscope", "fold", "rational", "fisheye")), "fisheye-True")
@pytest.mark.parametrize("gpu_kernels", [False, True])
@pytest.mark.parametrize("lens", LENSES)
def test_tracks_match_the_twin(lens: str, gpu_kernels: bool, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    if gpu_kernels:
        monkeypatch.setattr(tracking, "lanes", lambda precision: 1)
    made = scene_with_lens(lens)
    for shape in (folded, crumpled):
        assert_tracks_match_twin(made, shape(made))


def test_lens_with_zero_coefficients_is_ignored() -> None:
    camera = {"eye": [0.05, -0.2, 0.3], "intrinsics": INTRINSICS}
    plain, zero = (view(drawable(camera={**camera, **lens})) for lens in ({}, {"distortion": {"k1": 0.0}}))
    assert zero.lens is plain.lens is None
    np.testing.assert_array_equal(zero.matrix, plain.matrix)


@pytest.mark.parametrize(
    "camera",
    [
        {"distortion": {"k1": -0.5}},
        {"distortion": {"model": "fisheye", "k1": 3.0}, "intrinsics": {**INTRINSICS, "fx": 4, "fy": 4}},
    ],
    ids=["pinhole", "fisheye"],
)
def test_limit_within_the_picture(camera: dict[str, Any], message: Messages) -> None:
    made = drawable(camera={"eye": [0, 0, 0.3], "intrinsics": INTRINSICS, **camera})
    with message.raises(SceneError, "render.camera.distortion", "53 px"):
        view(made)
