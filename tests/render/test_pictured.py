"""Sheets with a picture by a camera: at rest, the frame of that camera is the picture; elsewhere it is the twin's."""

from __future__ import annotations

from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.arithmetic import Array
from taichi_msm.cameras.extrinsics import extrinsics
from taichi_msm.cameras.view import View, pinhole_view
from taichi_msm.model.pictured import PicturedRest
from taichi_msm.model.rest import rest_of
from taichi_msm.model.surface import refine_surface, surface_positions, surface_weights
from taichi_msm.render import uniforms
from taichi_msm.render.camera import Shot, picture_view, view, view_at
from taichi_msm.render.labels import LABELS, Labels, track_grid
from taichi_msm.render.picking import pick_at_rest
from taichi_msm.render.rasterizer import Rasterizer, drawing_config
from taichi_msm.render.renderer import Renderer
from taichi_msm.render.texture import load_texture
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.framing import POSE_AT_ORIGIN
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests.lenses.test_lenses import LENSES
from tests.reference.drawing import GBuffer, present, rasterise, refine
from tests.reference.shading import headlight, minified, normals, normals_at, sample, tissue
from tests.render.test_rasterizer import assert_same_bits_with_lanes
from tests.scenes import scene, speckle

SIZE = WIDTH, HEIGHT = 96, 72
PINHOLE = {"intrinsics": {"fx": 80, "fy": 78, "cx": 49.2, "cy": 34.3}}
CAMERAS: dict[str, dict[str, Any]] = {
    "pinhole": PINHOLE,
    "rational": {**PINHOLE, "distortion": {"k1": -0.1, "k2": 0.02, "p1": 0.004, "p2": -0.003}},
    "fisheye": {**PINHOLE, **LENSES["fisheye"]},
    "omnidir": {**LENSES["omnidir"], "intrinsics": {"fx": 150, "fy": 148, "cx": 49.2, "cy": 34.3}},
    "scaramuzza": {**LENSES["scaramuzza"], "intrinsics": {"cx": 49.2, "cy": 34.3}},
}
# Looks at the surface from the side; the picture's camera is at the origin.
ASIDE = {"eye": [0.05, 0.03, -0.005], "fov": 50, "target": [0, 0, -0.06]}


def posed(camera: dict[str, Any]) -> View:
    """View of a camera at the origin."""
    at_origin = Camera(**camera, pose=POSE_AT_ORIGIN)
    return pinhole_view(at_origin, SIZE, extrinsics(at_origin, 0.0), 0.0)


def depth_map(camera: dict[str, Any]) -> Array:
    """Depth [m] of a tilted plane with waves at all pixels of a camera, shape (height, width)."""
    sight = posed(camera)
    pixels = np.stack(np.meshgrid(np.arange(WIDTH) + 0.5, np.arange(HEIGHT) + 0.5), axis=-1)
    x, y = np.moveaxis((sight.undistort(pixels) - sight.centre) / sight.scale, -1, 0)
    depth = np.full(x.shape, 0.06)
    for _ in range(60):
        depth = 0.06 + 0.3 * x * depth - 0.2 * y * depth + 0.002 * np.cos(150 * x * depth) * np.cos(120 * y * depth)
    return depth


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Working directory with the picture."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    Image.fromarray(speckle(HEIGHT, WIDTH)).save("image.png")
    return tmp_path


def pictured(camera: dict[str, Any] = PINHOLE, *, grid: str = "given", **sections: Any) -> Scene:
    """A sheet by the depth map of a camera, by default the main one."""
    np.save("depth.npy", depth_map(camera))
    surface = {"depth": {"file": "depth.npy", "unit": "m"}, "grid": grid}
    sheet = {"points": [10, 13], "mass": 1e-3, "surface": surface}
    render = {"camera": camera, "shading": "none", "refine": 4, **sections.pop("render", {})}
    return scene(image="image.png", sheet=sheet, render=render, **sections)


def seen_aside(camera: dict[str, Any] = PINHOLE, **render: Any) -> Scene:
    """The sheet as the main camera sees it from the side; the picture is by another camera."""
    np.save("depth.npy", depth_map(camera))
    surface = {"depth": {"file": "depth.npy", "unit": "m", "camera": "scope"}, "grid": "given"}
    cameras = {"aside": ASIDE, "scope": camera}
    render = {"cameras": cameras, "shading": "none", "refine": 3, **render}
    return scene(image="image.png", sheet={"points": [10, 13], "mass": 1e-3, "surface": surface}, render=render)


def dented(made: Scene) -> Array:
    """Positions with a dent and a ridge along the normals."""
    rest = rest_of(made.sheet)
    assert isinstance(rest, PicturedRest)
    press, pull = (
        np.exp(-((np.linalg.norm(rest.position - rest.place(np.array([at])), axis=-1) / 0.01) ** 2))
        for at in ([0.35, 0.4], [0.65, 0.6])
    )
    return rest.position + (0.006 * pull - 0.008 * press)[..., None] * rest.point_normals


def draw_at_rest(made: Scene, camera: View | None = None, **config: Any) -> NDArray[np.uint8]:
    drawing = drawing_config(made)._replace(**config)
    return Rasterizer(made, load_texture(made), drawing).draw(rest_of(made.sheet).position, camera)


def assert_is_picture(made: Scene, least_share: float = 1.0, **config: Any) -> None:
    """Equal but for one level: a texel is off by 1e-3 px, and neighbours differ by 255 levels at most."""
    frame, picture = draw_at_rest(made, **config), load_texture(made)
    covered = (frame > 0).any(axis=-1)
    assert covered.mean() >= least_share
    assert np.abs(frame.astype(int) - picture)[covered].max() <= 1


# Sides of cells are straight, those of a picture by a lens are not: at its border, pixels may show no sheet.
@pytest.mark.default_cases("pinhole-none", "fisheye-tissue", "scaramuzza-headlight")
@pytest.mark.parametrize("shading", ["none", "headlight", "tissue"])
@pytest.mark.parametrize("lens", CAMERAS)
def test_frame_at_rest_is_the_picture(lens: str, shading: str, device: Device) -> None:
    made = pictured(CAMERAS[lens], render={"shading": shading, "light": {"relief": 0.5}})
    assert made.render.size == SIZE
    assert_is_picture(made, 1.0 if lens == "pinhole" else 0.99)


def test_frame_at_rest_with_an_even_grid_or_points_is_the_picture(device: Device) -> None:
    even = pictured(grid="even")
    assert_is_picture(even)
    np.save("points.npy", rest_of(even.sheet).position)
    surface = {"points": {"file": "points.npy", "unit": "m"}, "picture": "main"}
    camera = {**PINHOLE, "pose": POSE_AT_ORIGIN}
    made = scene(image="image.png", sheet={"mass": 1e-3, "surface": surface}, render={"camera": camera})
    assert_is_picture(made)
    assert_is_picture(made, lanes=1)


def test_frame_at_rest_is_the_region_of_the_picture(device: Device) -> None:
    x, y, width, height = region = [20, 10, 50, 40]
    made = pictured(CAMERAS["fisheye"], region=region)
    frame, picture = draw_at_rest(made), speckle(HEIGHT, WIDTH)
    # Pixels at the region's edge may show no sheet.
    np.testing.assert_allclose(
        frame[y + 1 : y + height - 1, x + 1 : x + width - 1].astype(int),
        picture[y + 1 : y + height - 1, x + 1 : x + width - 1],
        rtol=0,
        atol=1,
    )
    frame[y - 1 : y + height + 1, x - 1 : x + width + 1] = 0
    assert not frame.any()


def test_frame_at_rest_of_half_the_size_is_the_reduced_picture(device: Device) -> None:
    """With two samples per pixel and axis, each at a pixel's centre, it is the mean of four pixels."""
    made = pictured(render={"shading": "tissue", "size": [WIDTH // 2, HEIGHT // 2], "supersample": 2})
    mean = speckle(HEIGHT, WIDTH).reshape(HEIGHT // 2, 2, WIDTH // 2, 2, 3).mean(axis=(1, 3))
    np.testing.assert_allclose(draw_at_rest(made), mean, rtol=0, atol=1)


@pytest.mark.parametrize("focal", [(20, 78), (80, 19.5)], ids=["across", "down"])
def test_mipmaps_follow_the_longer_side_of_a_sample(focal: tuple[float, float], device: Device) -> None:
    """A camera at the same place with a quarter of a focal length has samples of four texels."""
    fx, fy = focal
    np.save("depth.npy", depth_map(PINHOLE))
    narrow = {"intrinsics": {"fx": fx, "fy": fy, "cx": 47.5, "cy": 35.5}, "pose": POSE_AT_ORIGIN}
    surface = {"depth": {"file": "depth.npy", "unit": "m", "camera": "scope"}, "grid": "given"}
    render = {"cameras": {"narrow": narrow, "scope": PINHOLE}, "shading": "tissue", "refine": 4}
    made = scene(image="image.png", sheet={"points": [10, 13], "mass": 1e-3, "surface": surface}, render=render)
    frame = draw_at_rest(made)
    covered = (frame > 0).any(axis=-1)
    x, y = (np.arange(WIDTH) + 0.5 - 48) / fx * 80 + 49.7, (np.arange(HEIGHT) + 0.5 - 36) / fy * 78 + 34.8
    u, v = np.meshgrid(x / WIDTH, y / HEIGHT)
    colour, _ = minified(load_texture(made), u, v, np.full(u.shape, 4 / uniforms.FULL_RESOLUTION_TEXELS))
    assert 0.15 < covered.mean() < 0.35
    # The light of the picture is interpolated between pixels, and the level of the mipmap blends in from 4 texels on.
    assert np.quantile(np.abs(frame - colour)[covered], 0.99) < 2


def test_small_motion_with_a_relief_changes_little(device: Device) -> None:
    """By 0.005 px the bilinear picture changes by at most a level or two; the slope of the relief must not jump."""
    made, shift = pictured(render={"shading": "tissue", "light": {"relief": 1}}), np.array([5e-3 / 80 * 0.06, 0, 0])
    rasterizer = Rasterizer(made, load_texture(made))
    moved = rasterizer.draw(rest_of(made.sheet).position + shift)
    assert np.abs(moved.astype(int) - load_texture(made))[1:-1, 1:-1].max() <= 3


def test_gloss_is_in_the_picture() -> None:
    assert pictured().render.light.gloss == 0
    assert pictured(render={"light": {"gloss": 0.3}}).render.light.gloss == 0.3
    assert pictured().model_copy(update={"output": ["png"]}).render.light.gloss == 0


def twin_fractions(made: Scene, buffer: GBuffer) -> tuple[Array, Array]:
    """Fractions of the picture at samples: h of the corners at rest, linear in the refined triangles."""
    rest = rest_of(made.sheet)
    assert isinstance(rest, PicturedRest)
    h = refine(rest.picture.project(rest.position), made.render.refine)
    rows, cols = h.shape[:2]
    at = np.nan_to_num(np.stack([buffer.v * (rows - 1), buffer.u * (cols - 1)]))
    i, j = (np.clip(np.floor(values).astype(int), 0, count - 2) for values, count in zip(at, (rows, cols), strict=True))
    t, s = at[0] - i, at[1] - j
    corner = h[i + (t > s), j + (t <= s)]
    lower, higher = np.minimum(s, t)[..., None], np.maximum(s, t)[..., None]
    values = h[i, j] + higher * (corner - h[i, j]) + lower * (h[i + 1, j + 1] - corner)
    across, down = np.moveaxis(rest.picture.fractions(values), -1, 0)
    return across, down


def twin_light(made: Scene, buffer: GBuffer, position: Array, camera: View) -> Array:
    """Factor of the texture's colours, shape (height, width)."""
    u, v = np.nan_to_num(buffer.u), np.nan_to_num(buffer.v)
    normal = normals_at(normals(position, present(made)), u, v) * buffer.front[..., None]
    if made.render.shading == "headlight":
        return headlight(normal, (camera.light_view or camera).axes[2])
    one = np.ones((1, 1, 3), np.uint8)
    return tissue(made, camera, one, normal, buffer.depth, (u, v, 0 * u), ())[..., 0]


@pytest.mark.default_cases("pinhole-headlight", "rational-tissue")
@pytest.mark.parametrize("shading", ["none", "headlight", "tissue"])
@pytest.mark.parametrize("lens", CAMERAS)
def test_deformed_sheet_from_another_camera_matches_the_twin(lens: str, shading: str, device: Device) -> None:
    made = seen_aside(CAMERAS[lens], shading=shading, size=[112, 84])
    position, camera, texture = dented(made), view(made), np.full((HEIGHT, WIDTH, 3), 240, np.uint8)
    if shading == "none":
        texture = load_texture(made)
    frame = Rasterizer(made, texture).draw(position)
    buffer = rasterise(made, position)
    covered = np.isfinite(buffer.depth)
    across, down = twin_fractions(made, buffer)
    colour = sample(texture, *(np.nan_to_num(each) for each in (across, down)))
    if shading != "none":
        source = picture_view(made, SIZE)
        at_size = made.model_copy(update={"render": made.render.model_copy(update={"size": SIZE})})
        at_rest = rasterise(at_size, rest_of(made.sheet).position, camera=source)
        lit = twin_light(at_size, at_rest, rest_of(made.sheet).position, source)
        reference = _bilinear(lit, np.nan_to_num(across), np.nan_to_num(down))
        ratio = np.minimum(twin_light(made, buffer, position, camera) / reference, 4)
        colour = np.minimum(colour * ratio[..., None], 255)
        assert (colour[covered] == 255).any()
        assert ratio[covered].min() < 0.9
    difference = np.abs(frame - np.floor(colour + 0.5))[covered].max(axis=-1)
    # The silhouette moves past few pixel centres, as in `assert_picture_matches_twin`.
    assert (difference > 1).mean() < 0.01
    assert covered.mean() > 0.3
    assert ((frame > 0).any(axis=-1) != covered).mean() < 0.005


def _bilinear(values: Array, across: Array, down: Array) -> Array:
    """Interpolate an array of the texture's size at fractions of it."""
    x = np.clip(across * values.shape[1] - 0.5, 0, values.shape[1] - 1)
    y = np.clip(down * values.shape[0] - 0.5, 0, values.shape[0] - 1)
    i, j = np.minimum(y.astype(int), values.shape[0] - 2), np.minimum(x.astype(int), values.shape[1] - 2)
    t, s = y - i, x - j
    upper = values[i, j] * (1 - s) + values[i, j + 1] * s
    return np.asarray(upper * (1 - t) + (values[i + 1, j] * (1 - s) + values[i + 1, j + 1] * s) * t)


@pytest.mark.slow
def test_gpu_form_has_the_same_bits(device: Device) -> None:
    for shading, lens in (("headlight", "scaramuzza"), ("tissue", "fisheye")):
        made = seen_aside(CAMERAS[lens], shading=shading, size=[60, 45], light={"relief": 1}, wireframe=True)
        assert_same_bits_with_lanes(made, load_texture(made), dented(made), 1)


@pytest.mark.parametrize("lens", ["pinhole", "fisheye"])
def test_coordinates_at_rest_are_those_of_the_pixels(lens: str, device: Device) -> None:
    made = pictured(CAMERAS[lens])
    labels = Renderer(made).labels(Shot(rest_of(made.sheet).position, view(made)))
    expected = np.stack(np.meshgrid((np.arange(WIDTH) + 0.5) / WIDTH, (np.arange(HEIGHT) + 0.5) / HEIGHT), axis=-1)
    seen = ~np.isnan(labels.coordinates[..., 0])
    assert seen.mean() > 0.99
    # 1e-3 px.
    np.testing.assert_allclose(labels.coordinates[seen], expected[seen], rtol=0, atol=1e-5)
    drawn = Rasterizer(made, load_texture(made), drawing_config(made, labels=LABELS)).render(
        rest_of(made.sheet).position
    )
    assert drawn.labels is not None
    np.testing.assert_allclose(drawn.labels.coordinates, labels.coordinates, rtol=0, atol=1e-6)


def test_flow_of_a_rigid_motion(device: Device) -> None:
    """By t parallel to the picture, a point at depth z moves by f t / z."""
    made, shift = pictured(), np.array([0.001, -0.0005, 0])
    rest, renderer = rest_of(made.sheet), Renderer(made)
    before = renderer.labels(Shot(rest.position, view(made)))
    after = Shot(rest.position + shift, view(made))
    expected = np.array([80, -78]) * shift[:2] / before.depth[..., None]
    # The flow is of refined triangles in f64, from places in f32 on the sheet: 1e-7 of 96 px.
    np.testing.assert_allclose(renderer.flow(before, after).flow, expected, rtol=0, atol=1e-3)
    # Labels from a file have no (u, v): they follow from the coordinates, bilinear in cells, not in triangles.
    np.testing.assert_allclose(renderer.flow(Labels(*before), after).flow, expected, rtol=0, atol=0.02)


def test_places_are_located_and_picked(device: Device) -> None:
    made = pictured(CAMERAS["rational"])
    rest, renderer = rest_of(made.sheet), Renderer(made)
    places = np.array([*product((0.1, 0.4, 0.85), (0.15, 0.5, 0.9))])
    sight = renderer.locate(places, Shot(rest.position, view(made)))
    # Triangles and cells differ by 1/64 of the twist of a cell, at refine 4 less than 0.02 px.
    np.testing.assert_allclose(sight.pixels, places * SIZE, rtol=0, atol=0.02)
    assert not sight.hidden.any()
    for place in places.tolist():
        pixel = place[0] * WIDTH - 0.5, place[1] * HEIGHT - 0.5
        assert pick_at_rest(made.sheet, made.render.refine, view(made), pixel) == pytest.approx(place, abs=2e-4)
    tracks = track_grid(5, rest).astype(float)
    assert len(tracks) == 25
    points = surface_positions(rest.position, 4, rest.mesh_places(tracks))
    np.testing.assert_allclose(view(made).pixels(points), tracks * SIZE, rtol=0, atol=0.02)
    corners, weights = surface_weights(tracks, made.sheet, 4)
    interpolated = (rest.position.reshape(-1, 3)[corners] * weights[..., None]).sum(axis=1)
    np.testing.assert_allclose(interpolated, points, rtol=0, atol=1e-12)


def test_another_camera_keeps_the_surface(device: Device) -> None:
    made = pictured()
    renderer = Renderer(made)
    other = renderer.resolve_camera({"eye": [0.05, 0, 0], "fov": 60})
    # Without a target it looks at the surface in the middle of the picture.
    (middle,) = rest_of(made.sheet).place(np.array([[0.5, 0.5]]))
    np.testing.assert_allclose(other.pixels(middle), np.array(SIZE) / 2, atol=1e-9)
    assert renderer.resolve_camera("oblique").pinhole
    np.testing.assert_allclose(view(made).pixels(middle), np.array(SIZE) / 2, atol=1e-9)


def test_texture_coordinates_of_a_refined_surface() -> None:
    """At a vertex X they are the fractions of the picture at which the camera sees X, in refined cells too."""
    made = pictured(CAMERAS["fisheye"])
    rest = rest_of(made.sheet)
    for count in (0, 3):
        surface = refine_surface(rest.position, count, rest)
        pixels = posed(CAMERAS["fisheye"]).pixels(surface.vertices.astype(float))
        np.testing.assert_allclose(surface.texture_coordinates, pixels / SIZE, rtol=0, atol=1e-9)


@pytest.mark.default_cases("headlight")
@pytest.mark.parametrize("shading", ["none", "headlight", "tissue"])
def test_picture_of_a_camera_that_is_not_the_main_one(shading: str, device: Device) -> None:
    """The light is at the main camera, of the frame and of the reference."""
    made = seen_aside(size=list(SIZE), shading=shading)
    frame = draw_at_rest(made, view_at(made, 0.0, "scope"))
    assert np.abs(frame.astype(int) - load_texture(made)).max() <= 1
