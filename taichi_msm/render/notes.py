"""Warnings about scenes whose pictures may not look as intended."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_msm.cameras.view import View, pair_transform
from taichi_msm.lenses import MODELS
from taichi_msm.model.rest import rest_of
from taichi_msm.model.tool_force import control_points
from taichi_msm.render import texture
from taichi_msm.render.camera import is_moving, view_at
from taichi_msm.render.labels import track_grid
from taichi_msm.scene.camera import Camera, Distortion
from taichi_msm.scene.framing import MATTE
from taichi_msm.scene.render import Light
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Probe


def drawing_warnings(scene: Scene) -> Iterator[str]:
    """Yield warnings about the rendering of a scene, one line each."""
    if scene.sheet.unit_hint:
        yield scene.sheet.unit_hint
    if scene.tissue and scene.tissue.unit_hint:
        yield scene.tissue.unit_hint
    for name, camera in scene.render.all_cameras.items():
        if isinstance(camera, Camera) and camera.note:
            yield f"render.{f'cameras.{name}' if name else 'camera'}.poses: {camera.note}"
    if scene.draws:
        yield from _stretched_picture(scene)
        if texture.is_see_through(scene):
            yield f"parts of the picture are transparent, and show render.background: {list(scene.render.background)}"
        if scene.render.light not in (Light(), Light(**MATTE)) and scene.render.shading != "tissue":
            yield f"render.light has no effect with shading: {scene.render.shading}; take render.shading: tissue"
    if scene.renders:
        yield from _invisible_sheet(scene)
    if scene.asks_for("tracks"):
        count, tracks = scene.render.tracks**2, len(track_grid(scene.render.tracks, rest_of(scene.sheet)))
        if tracks < count:
            yield f"render.tracks: {count - tracks} of {count} tracks are left out, as they fall on no sheet"
    for index, probe in enumerate(scene.probes):
        if (instrument := probe.instrument) is None:
            continue
        normals = _normals_on_path(probe, scene.sheet)
        if (pierced := np.flatnonzero(normals @ instrument.shaft < 0)).size:
            normal = ", ".join(f"{component:g}" for component in normals[pierced[0]].round(2) + 0.0)
            is_flat = scene.sheet.surface is None
            side = "with z above 0" if is_flat else f"less than 90 degrees from the normal there, [{normal}]"
            yield (
                f"probes.{index}.instrument: its shaft points down, through the sheet at rest; take the direction "
                f"from the tip to the hand, {side}"
            )
        if instrument.outer_radius > 0.25 * rest_of(scene.sheet).extent:
            yield (
                f"probes.{index}.instrument: {instrument.outer_radius:g} m is a wide instrument for a sheet of "
                f"{rest_of(scene.sheet).extent:g} m; the radius is in metres"
            )


def _normals_on_path(probe: Probe, sheet: Sheet) -> NDArray[np.float64]:
    """Return the unit normals at rest at the keyframes of a tool's place, shape (n, 3)."""
    rest = rest_of(sheet)
    if probe.path is None:
        return rest.normals(control_points(probe, sheet)[1])
    return rest.normals(rest.coordinates(np.array(probe.path, dtype=float)[:, 1:3]))


def describe_cameras(scene: Scene) -> Iterator[str]:
    """Describe each camera with intrinsics or a reference camera: lens, fields of view, coefficients and baseline."""
    for name, camera in scene.render.all_cameras.items():
        if not isinstance(camera, Camera):
            continue
        facts = [] if camera.intrinsics is None else [_describe_lens(camera, view_at(scene, 0.0, name))]
        if camera.beside is not None:
            baseline = np.linalg.norm(pair_transform(camera)["translation"])
            facts.append(f"beside {camera.beside} with a baseline of {baseline:.6g} m")
        if facts:
            yield f"{_camera_key(name)}: {', '.join(facts)}"


def _describe_lens(camera: Camera, view: View) -> str:
    """Describe lens model, picture size, fields of view with distortion, and coefficients."""
    distortion = camera.distortion or Distortion()
    (x, y), (width, height) = view.centre, view.size
    edges = (view.undistort(np.array([[0, y], [width, y], [x, 0], [x, height]])) - view.centre) / view.scale
    left, right, top, bottom = np.degrees(np.arctan(edges[[0, 1, 2, 3], [0, 0, 1, 1]]))
    angles = right - left, bottom - top
    fov = " x ".join("(limited by the lens)" if np.isnan(angle) else f"{angle:.1f}" for angle in angles)
    pairs = zip(MODELS[distortion.model].coefficients, distortion.coefficients, strict=True)
    values = "".join(f", {coefficient} {value:g}" for coefficient, value in pairs if value)
    return f"{distortion.model}, {width:g} x {height:g} px, fov {fov} degrees{values or ', no distortion'}"


def _camera_key(name: str) -> str:
    return f"render.cameras.{name}" if name else "render.camera"


def _invisible_sheet(scene: Scene) -> Iterator[str]:
    """Warn of cameras that show nothing of the sheet at rest, or only a dot, in all frames."""
    rate = scene.time.frames_per_second
    for name in scene.render.all_cameras:
        camera = view_at(scene, 0.0, name)
        # A sheet between the 100 x 100 test pixels is only a dot, as with a camera in millimetres.
        centres = (np.arange(100) + 0.5) / 100
        pixels = camera.undistort(np.stack(np.meshgrid(*(centres * side for side in camera.size)), axis=-1))
        frames = range(scene.time.frames + 1 if is_moving(scene, name) else 1)
        if not any(_is_visible(view_at(scene, frame / rate, name), pixels, scene) for frame in frames):
            key = _camera_key(name)
            yield f"{key} shows nothing of the sheet at rest, or only a dot, in all frames; lengths are in metres"


def _is_visible(camera: View, pixels: NDArray[np.float64], scene: Scene) -> bool:
    """Return whether any of the pixels [px], shape (..., 2), shows the sheet at rest, or a point of a curved one."""
    if scene.sheet.surface:
        at = camera.pixels(rest_of(scene.sheet).hull)
        is_inside = ((at > 0) & (at < camera.size)).all(axis=1)
        return bool(is_inside.any()) and bool((np.ptp(at[is_inside], axis=0) > camera.size / 100).any())
    try:
        # The homography from the plane of the sheet to the picture, inverted.
        inverse = np.linalg.inv(camera.matrix[:3][:, [0, 1, 3]])
    except np.linalg.LinAlgError:
        return False
    x, y, inverse_w = np.moveaxis(pixels @ inverse[:, :2].T + inverse[:, 2], -1, 0)
    height, width = scene.sheet.size
    # Pixels without a line of sight are NaN, and compare false.
    is_inside = (inverse_w > 0) & (np.abs(x) <= width / 2 * inverse_w) & (np.abs(y) <= height / 2 * inverse_w)
    is_inside &= inverse_w * camera.near < 1
    if (mask := rest_of(scene.sheet).mask) is not None:
        at = np.stack([x, y], axis=-1)[is_inside] / inverse_w[is_inside, None]
        return bool(mask.covers(rest_of(scene.sheet).fractions(at)).any())
    return bool(is_inside.any())


def _stretched_picture(scene: Scene) -> Iterator[str]:
    """Warn of a picture that is stretched onto the sheet, with two remedies."""
    size = texture.image_size(scene)
    if size is None or (scene.sheet.surface and scene.sheet.surface.has_own_size):
        return
    left, top, width, height = scene.region or (0, 0, *size)
    sheet_height, sheet_width = scene.sheet.size
    if _nearly_equal(sheet_width * height, sheet_height * width):
        return
    side, surface = max(sheet_height, sheet_width) / max(height, width), scene.sheet.surface
    # A side of a tube or dome may be at its limit already, so the other one becomes shorter.
    if surface and (surface.tube or surface.dome):
        side = min(sheet_height / height, sheet_width / width)
    settings = f'--set "sheet.size=[{height * side:.4g},{width * side:.4g}]"'
    if scene.tissue is not None:
        # Tissue requires cells that are nearly square.
        cells = (max(scene.sheet.points) - 1) / max(height, width)
        rows, cols = (max(1, round(cells * count)) + 1 for count in (height, width))
        settings += f' --set "sheet.points=[{rows},{cols}]"'
    warning = (
        f"the picture of {width} x {height} pixels is stretched onto a sheet {sheet_width:g} m wide and "
        f"{sheet_height:g} m high; {settings} gives the sheet the proportions of the picture"
    )
    cut_width = min(width, round(height * sheet_width / sheet_height))
    cut_height = min(height, round(width * sheet_height / sheet_width))
    # In a picture of few pixels even the best region may be stretched.
    if cut_width and cut_height and _nearly_equal(sheet_width * cut_height, sheet_height * cut_width):
        region = left + (width - cut_width) // 2, top + (height - cut_height) // 2, cut_width, cut_height
        warning += f', --set "region=[{",".join(map(str, region))}]" cuts a region with the proportions of the sheet'
    yield warning


def _nearly_equal(value: float, expected: float) -> bool:
    """Return whether numbers differ by less than 2 %; such stretching is invisible."""
    return expected / 1.02 < value < expected * 1.02
