"""Lenses that bend lines: against OpenCV, the twin that tries every triangle at every pixel, and picking."""

from __future__ import annotations

from itertools import product
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.errors import SceneError
from taichi_msm.lenses import MODELS
from taichi_msm.lenses.model import MAX_RADIUS
from taichi_msm.model.sheet import rest_positions
from taichi_msm.model.surface import place_instruments
from taichi_msm.render import tracking, uniforms
from taichi_msm.render.camera import calibration, view
from taichi_msm.render.lens import Lens
from taichi_msm.render.picking import pick
from taichi_msm.render.rasterizer import Rasterizer, drawing_config
from taichi_msm.render.tracking import compute_flow, locate_points
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.reference import labels as twin
from tests.reference.lens import scaramuzza_pixel, scaramuzza_ray
from tests.render.test_labels import crumpled, folded, hidden_as_by_the_twin, look, seen_as_by_the_twin
from tests.render.test_rasterizer import (
    assert_alike_in_other_tiles,
    dented,
    drawable,
    drawn_as_by_the_twin,
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
# Kernels take long to compile, so some lenses are quick.
QUICK = tuple(lens for lens in LENSES if lens != "omnidir")


def cases(*quick: tuple[Any, ...], **values: Any) -> pytest.MarkDecorator:
    """All combinations of parameters, of which only some are quick: kernels take long to compile."""
    every = [pytest.param(*case, marks=() if case in quick else pytest.mark.slow) for case in product(*values.values())]
    return pytest.mark.parametrize(",".join(values), every)


def seen_through(lens: str, points: tuple[int, int] = (9, 11), **render: Any) -> Scene:
    camera = {"eye": [0.05, -0.2, 0.3], "target": [0, 0, 0], "intrinsics": INTRINSICS, **LENSES[lens]}
    return with_instruments(drawable(points, camera=camera, **render))


def omnidir_points(points: Array, axis: Array, shift: Array, matrix: Array, distortion: Array) -> tuple[Array]:
    """As cv2.omnidir.projectPoints, which only OpenCV's contributed modules have, from its documentation."""
    xi, k1, k2, p1, p2 = distortion
    sphere = points[:, 0] @ cv2.Rodrigues(axis)[0].T + shift
    sphere = sphere / np.linalg.norm(sphere, axis=-1, keepdims=True)
    u, v = sphere[:, :2].T / (sphere[:, 2] + xi)
    q = u**2 + v**2
    radial = 1 + k1 * q + k2 * q**2
    bent = u * radial + 2 * p1 * u * v + p2 * (q + 2 * u**2), v * radial + p1 * (q + 2 * v**2) + 2 * p2 * u * v
    return ((np.stack([*bent, np.ones_like(u)], axis=-1) @ matrix.T)[:, None, :2],)


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
        Lens("pinhole", (-0.5, 0, 0, 0, 0, 0, 0, 0)),
        Lens("pinhole", (0.3, 0.1, 1e-3, 1e-3, 0.05, 0.4, 0.1, 0.01)),
        Lens("fisheye", (-0.05, 0.01, -0.003, 0.001)),
        Lens("fisheye", (-0.5, 0, 0, 0)),
        Lens("omnidir", (0.0, -0.1, 0.02, 1e-3, -2e-3)),
        Lens("omnidir", (0.9, -0.3, 0.05, 1e-3, -2e-3)),
        Lens("omnidir", (2.5, 0.4, -0.1, 0, 1e-3)),
        Lens("scaramuzza", C3VD),
        # Without polynomial, and one that folds back at 44 degrees.
        Lens("scaramuzza", (300, 0, 0, 0, 1, 0, 0)),
        Lens("scaramuzza", (400, -5e-4, 2e-6, 0, 1, 0.1, 0.02)),
    ],
    ids=str,
)
def test_places_are_those_of_opencv_and_back(lens: Lens) -> None:
    rng = np.random.default_rng(1)
    away, turn = min(lens.limit * 0.98, 2.5) * rng.uniform(0, 1, 5000), rng.uniform(0, 2 * np.pi, 5000)
    place = np.stack([away * np.cos(turn), away * np.sin(turn)], axis=-1)
    points, none = np.concatenate([place, np.ones((5000, 1))], axis=1)[:, None], np.zeros(3)
    expected = PROJECT[lens.model](points, none, none, np.eye(3), np.array(lens.coefficients))[0][:, 0]
    expected /= lens.coefficients[0] if lens.model == "scaramuzza" else 1
    seen = lens.distort(place)
    np.testing.assert_allclose(seen, expected, atol=1e-13)
    # 1e-6 px where the focal length is 1000 px; nothing is nearer to the axis and seen there too.
    np.testing.assert_allclose(lens.undistort(seen), place, atol=1e-9)
    step = 1e-6 * np.eye(2)
    slope = [(lens.distort(place + way) - lens.distort(place - way)) / 2e-6 for way in step]
    np.testing.assert_allclose(lens.jacobian(place), np.stack(slope, axis=-1), atol=1e-7)


def test_beyond_the_fold_there_is_nothing() -> None:
    lens = Lens("pinhole", (-0.5, 0, 0, 0, 0, 0, 0, 0))
    # r - r^3 / 2 is largest, sqrt(8 / 27), at r = sqrt(2 / 3).
    assert lens.limit == pytest.approx(np.sqrt(2 / 3))
    rim = np.sqrt(8 / 27)
    found = lens.undistort(np.array([[0.0, 0.0], [0.0, rim * 0.9999], [rim * 1.0001, 0.0]]))
    np.testing.assert_array_equal(np.isnan(found[:, 0]), [False, False, True])
    np.testing.assert_array_equal(found[0], [0, 0])
    # Before a pole, here at r = sqrt(5), everything is seen.
    lens = Lens("pinhole", (-0.2, 0.02, 0, 0, 0, -0.2, 0, 0))
    place = np.array([[0.0, 1e-3], [0.0, 1.0], [2.0, 0.0], [2.2, 0.0]])
    np.testing.assert_allclose(lens.undistort(lens.distort(place)), place, atol=1e-9)
    # t - t^3 / 2 is largest at t = sqrt(2 / 3).
    assert Lens("fisheye", (-0.5, 0, 0, 0)).limit == pytest.approx(np.tan(np.sqrt(2 / 3)))


def test_wide_lenses_end_where_they_fold() -> None:
    # The plane's u - u^3 / 2 is largest at u = sqrt(2 / 3), and with xi = 1, u = tan(t / 2).
    assert Lens("omnidir", (1.0, -0.5, 0, 0, 0)).limit == pytest.approx(np.tan(2 * np.arctan(np.sqrt(2 / 3))))
    # Without xi it is the rational lens.
    flat = Lens("pinhole", (-0.5, 0.02, 1e-3, 2e-3, 0, 0, 0, 0))
    assert Lens("omnidir", (0.0, *flat.coefficients[:4])).limit == pytest.approx(flat.limit)
    # A plane that the sphere does not reach folds nothing, nor does C3VD's polynomial within 88 degrees.
    assert Lens("omnidir", (3.0, -0.5, 0, 0, 0)).limit == Lens("scaramuzza", C3VD).limit == MAX_RADIUS
    # p / (a0 + a2 p^2) is largest at p = sqrt(a0 / a2), sqrt(1 / (4 a0 a2)).
    assert Lens("scaramuzza", (400, 1e-4, 0, 0, 1, 0, 0)).limit == pytest.approx(2.5, rel=1e-5)


def test_rays_of_c3vd_are_those_of_its_polynomial() -> None:
    """A pixel's ray in closed form, within 1e-6 px of a picture of 1350 x 1080 that it does not fill."""
    x, y = np.meshgrid(np.linspace(-680, 670, 90), np.linspace(-544, 536, 72))
    found = Lens("scaramuzza", C3VD).undistort(np.stack([x, y], axis=-1) / C3VD[0])
    a, b = scaramuzza_ray(C3VD, x, y)
    angle = np.degrees(np.arctan(np.hypot(a, b)))
    np.testing.assert_array_equal(np.isnan(found[..., 0]), ~(angle < 88))
    assert 0.9 < (angle < 88).mean() < 1
    # As a pixel moves by dp, the tangent moves by at most dp / a0 / cos^2 of the angle, times 2 for this lens.
    error = np.hypot(found[..., 0] - a, found[..., 1] - b) * np.cos(np.radians(angle)) ** 2 * C3VD[0] / 2
    assert np.nanmax(error) < 1e-6


@pytest.mark.parametrize("lens", ["fisheye", "omnidir", "scaramuzza"])
def test_a_lens_is_recorded_as_it_was_given(lens: str) -> None:
    made = seen_through(lens)
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


@pytest.mark.parametrize("key", range(8))
def test_denormal_coefficients_change_nothing(key: int) -> None:
    """A polynomial that one of them leads would have zeros where numbers overflow."""
    assert Lens("pinhole", tuple(5e-324 * (each == key) for each in range(8))).limit == Lens("pinhole", (0,) * 8).limit
    assert (
        Lens("fisheye", tuple(5e-324 * (each == key % 4) for each in range(4))).limit == Lens("fisheye", (0,) * 4).limit
    )


@pytest.mark.parametrize(
    "coefficients",
    [
        (0, 0, 0.05, 0, 0, 0, 0, 0),
        (-0.5, 0, 0.02, 0.01, 0, 0, 0, 0),
        (0.1, 0.2, 0.01, -0.3, 0.1, 0.5, 0, 0.1),
        (0, 0, 2, 1e6, 0, 0, 0, 0),
        (-0.2, 0.1, 0.2, 0, 0, 0.3, 0, -0.4),
    ],
)
def test_tangential_distortion_folds_too(coefficients: tuple[float, ...]) -> None:
    """Where the determinant of the derivatives gets 0, at some angle, and not before."""
    lens = Lens("pinhole", coefficients)
    angle = np.linspace(0, 2 * np.pi, 721)
    circle = np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    least = [np.linalg.det(lens.jacobian(share * lens.limit * circle)).min() for share in np.linspace(0.01, 1.01, 101)]
    assert min(least[:-2]) > 0
    assert least[-1] < 0
    # Of y + 3 p1 y^2, the distorted place below the axis without all else, the derivative is 0 at y = -1 / (6 p1).
    assert Lens("pinhole", (0, 0, 0.05, 0, 0, 0, 0, 0)).limit == pytest.approx(1 / 0.3)


@pytest.mark.parametrize(
    ("lens", "render"),
    [
        pytest.param("endoscope", {}, marks=pytest.mark.slow),
        pytest.param("endoscope", {"wireframe": True, "supersample": 2}, marks=pytest.mark.slow),
        pytest.param("fold", {"shading": "tissue", "light": {"relief": -0.2, "vignette": 0.3}}, marks=pytest.mark.slow),
        ("fisheye", {"shading": "tissue", "wireframe": True}),
        pytest.param("pincushion", {"supersample": 2}, marks=pytest.mark.slow),
    ],
)
def test_pictures_are_like_the_twins(lens: str, render: dict[str, Any], device: Device) -> None:
    made, texture = seen_through(lens, **render), speckle(13, 17)
    for shape in (dented, folded):
        position = shape(made)
        drawn = drawn_as_by_the_twin(made, position, texture, place_instruments(made, position, 0))
        assert 0.2 < (drawn.max(axis=-1) > 0).mean() < 0.95


@pytest.mark.slow
@cases(("fold", 0), ("fisheye", 3), lens=LENSES, refine=(0, 3))
def test_large_cells_are_bent(lens: str, refine: int, device: Device) -> None:
    """Sides of cells 90 pixels long bend by up to 8 px, more than a tile, outward and inward."""
    intrinsics = {"fx": 150, "fy": 150, "cx": 99.5, "cy": 74.5}
    camera = {"eye": [0, 0, 0.33], "intrinsics": intrinsics, "outside": "background", **LENSES[lens]}
    made = drawable((2, 3), camera=camera, size=[200, 150], refine=refine)
    position = rest_positions(made.sheet)
    found, (coordinates, _, _) = look(made, position), twin.labels(made, position)
    np.testing.assert_allclose(found.coordinates, coordinates, atol=1e-5)


@pytest.mark.slow
@cases(("fisheye", 4), lens=LENSES, lanes=(1, 4))
def test_the_shape_of_a_tile_does_not_change_the_bits(lens: str, lanes: int, device: Device) -> None:
    renders: list[dict[str, Any]] = [{"shading": "tissue", "size": [79, 57]}, {"wireframe": True, "supersample": 3}]
    for render in renders:
        made, texture = seen_through(lens, **render), speckle(30, 20)
        assert_alike_in_other_tiles(made, texture, folded(made), lanes)


@pytest.mark.default_cases("endoscope-folded", "fisheye-folded")
@cases(*((lens, folded) for lens in QUICK), ("fold", crumpled), lens=LENSES, shape=(dented, folded, crumpled))
def test_labels_are_on_the_ray_of_each_pixel(lens: str, shape: Any, device: Device) -> None:
    made = seen_through(lens)
    position = shape(made)
    found = seen_as_by_the_twin(made, position)
    # Nothing moved: no flow, and nothing is hidden.
    still = compute_flow(made, found.coordinates, position, view(made), place_instruments(made, position, 0))
    seen = ~np.isnan(found.coordinates[..., 0])
    assert np.abs(still.flow[seen]).max() < 0.01
    assert (still.occlusion > 0).sum() <= 3
    for x, y in [(40, 30), (15, 20), (66, 44), (30, 50), (2, 2)]:
        place, label = pick(position, made.render.refine, view(made), (x, y)), found.coordinates[y, x]
        # An instrument may be in front of the sheet.
        assert (place is not None) == seen[y, x] or found.instrument[y, x]
        if place is not None and seen[y, x]:
            np.testing.assert_allclose(place, label, atol=1e-5)


@cases(
    *((lens, folded, None) for lens in QUICK if lens not in ("scaramuzza", "end")),
    *((lens, crumpled, 1) for lens in ("fold", "fisheye")),
    lens=LENSES,
    shape=(dented, folded, crumpled),
    lanes=(None, 1),
)
def test_points_are_found_and_hidden_as_the_twin_says(
    lens: str, shape: Any, lanes: int | None, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = seen_through(lens)
    if lanes:
        monkeypatch.setattr(tracking, "lanes", lambda precision: lanes)
    hidden_as_by_the_twin(made, shape(made))


def test_what_is_beyond_the_limit_is_outside_the_picture(device: Device) -> None:
    camera = {"eye": [0, 0, 0.1], "intrinsics": INTRINSICS, **LENSES["fold"]}
    made = drawable(camera=camera, background=[10, 20, 30])
    position = rest_positions(made.sheet)
    # 0.0816 m of the sheet are seen up to 0.816 from the axis, and with distortion sqrt(8 / 27).
    labels = look(made, position)
    y, x = np.mgrid[:60, :80]
    away = np.hypot((x - 37) / 60, (y - 31) / 62)
    rim = np.sqrt(8 / 27)
    assert not np.isnan(labels.coordinates[away < rim - 0.01]).any()
    assert np.isnan(labels.coordinates[away > rim]).all()
    assert (labels.depth[away > rim] == 0).all()
    drawn = Rasterizer(made, speckle(9, 9)).draw(position)
    assert (drawn[away > rim] == [10, 20, 30]).all()
    # Nor is there a second picture of what folds back.
    moved = compute_flow(made, labels.coordinates, position + np.array([0.05, 0, 0]), view(made))
    gone: NDArray[np.bool_] = np.all(moved.flow > 1e9, axis=-1)
    assert (moved.occlusion[gone & ~np.isnan(labels.coordinates[..., 0])] == 255).all()
    assert gone[31, 68]
    found = locate_points(made, np.array([[0.5, 0.5], [0.99, 0.5]]), position, view(made))
    np.testing.assert_array_equal(np.isnan(found.pixels[:, 0]), [False, True])
    np.testing.assert_array_equal(found.hidden, [False, True])


def test_a_lens_without_coefficients_has_the_bits_of_none(device: Device) -> None:
    camera = {"eye": [0.05, -0.2, 0.3], "intrinsics": INTRINSICS}
    plain, zero = drawable(camera=camera), drawable(camera={**camera, "distortion": {"k1": 0.0}})
    position, texture = dented(plain), speckle(13, 17)
    assert drawing_config(plain) == drawing_config(zero)
    np.testing.assert_array_equal(Rasterizer(plain, texture).draw(position), Rasterizer(zero, texture).draw(position))


@pytest.mark.parametrize(
    "camera",
    [
        {"distortion": {"k1": -0.5}},
        {"distortion": {"model": "fisheye", "k1": 3.0}, "intrinsics": {**INTRINSICS, "fx": 4, "fy": 4}},
    ],
    ids=["pinhole", "fisheye"],
)
def test_a_lens_that_does_not_reach_the_corners_is_refused(camera: dict[str, Any], message: Messages) -> None:
    made = drawable(camera={"eye": [0, 0, 0.3], "intrinsics": INTRINSICS, **camera})
    with message.raises(SceneError, "render.camera.distortion", "53 px"):
        view(made)
