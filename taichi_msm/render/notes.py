"""Warnings about a scene that will not look as intended."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render import texture
from taichi_msm.render.camera import View, is_moving, view_at
from taichi_msm.scene.render import Light
from taichi_msm.scene.scene import Scene

# A picture whose proportions differ from those of the sheet by this factor is visibly stretched.
ASPECT_TOLERANCE = 1.02

# The radius of an instrument is rarely above this share of the sheet's larger side.
WIDEST = 0.25

# No sheet of tissue has a larger side [m]; one of 75 m is meant in millimetres.
LARGEST_SHEET = 5.0

# Whether a camera shows the sheet is found at so many places across and down. What is between them is a dot, as the
# sheet is to a camera that is placed in millimetres.
SAMPLES_PER_SIDE = 100


def drawing_warnings(scene: Scene) -> Iterator[str]:
    """List warnings about how a scene is drawn, each in a line."""
    height, width = scene.sheet.size
    if max(height, width) > LARGEST_SHEET:
        yield (
            f"sheet.size: {height:g} x {width:g} m is large for tissue; if these are millimetres, take "
            f"[{height / 1000:g}, {width / 1000:g}]"
        )
    if scene.draws:
        yield from _stretched_picture(scene)
        if texture.is_see_through(scene):
            yield (
                f"the picture is see-through in parts, which show render.background: {list(scene.render.background)}"
            )
        if scene.render.light != Light() and scene.render.shading != "tissue":
            yield f"render.light has no effect with shading: {scene.render.shading}; take render.shading: tissue"
    if scene.renders:
        yield from _invisible_sheet(scene)
    for index, probe in enumerate(scene.probes):
        if (instrument := probe.instrument) is None:
            continue
        if instrument.shaft[2] < 0:
            yield (
                f"probes.{index}.instrument: its shaft points down, through the sheet at rest; it goes from the tip "
                "to the hand, upward for z above 0"
            )
        if instrument.radius > WIDEST * max(scene.sheet.size):
            yield (
                f"probes.{index}.instrument: {instrument.radius:g} m is a wide rod for a sheet of "
                f"{max(scene.sheet.size):g} m; the radius is in metres"
            )


def _invisible_sheet(scene: Scene) -> Iterator[str]:
    """Warn of cameras that show nothing of the sheet at rest, or only a dot, in all frames."""
    rate = scene.time.frames_per_second
    for name in scene.render.all_cameras:
        camera = view_at(scene, 0.0, name)
        middle = (np.arange(SAMPLES_PER_SIDE) + 0.5) / SAMPLES_PER_SIDE
        places = camera.undistort(np.stack(np.meshgrid(*(middle * side for side in camera.size)), axis=-1))
        frames = range(scene.time.frames + 1 if is_moving(scene, name) else 1)
        if not any(_is_visible(view_at(scene, frame / rate, name), places, scene.sheet.size) for frame in frames):
            key = f"render.cameras.{name}" if name else "render.camera"
            yield f"{key} shows nothing of the sheet at rest, or only a dot, in all frames; lengths are in metres"


def _is_visible(camera: View, places: NDArray[np.float64], size: tuple[float, float]) -> bool:
    """Tell whether a camera shows a sheet of this height and width, at rest, at any of some places [px], (..., 2)."""
    try:
        # From the plane of the sheet to the picture, and back.
        back = np.linalg.inv(camera.matrix[:3][:, [0, 1, 3]])
    except np.linalg.LinAlgError:
        return False
    x, y, per_w = np.moveaxis(places @ back[:, :2].T + back[:, 2], -1, 0)
    height, width = size
    # Where nothing is shown they are NaN.
    seen = (per_w > 0) & (np.abs(x) <= width / 2 * per_w) & (np.abs(y) <= height / 2 * per_w)
    return bool((seen & (per_w * camera.near < 1)).any())


def _stretched_picture(scene: Scene) -> Iterator[str]:
    """Warn of a picture that is stretched onto the sheet, and name two remedies."""
    size = texture.image_size(scene)
    if size is None:
        return
    left, top, width, height = scene.region or (0, 0, *size)
    high, wide = scene.sheet.size
    if _fits(wide * height, high * width):
        return
    side = max(high, wide) / max(height, width)
    settings = f'--set "sheet.size=[{height * side:.4g},{width * side:.4g}]"'
    if scene.tissue is not None:
        # With cells that stay square, as tissue allows none that are much longer than wide.
        cells = (max(scene.sheet.points) - 1) / max(height, width)
        rows, cols = (max(1, round(cells * count)) + 1 for count in (height, width))
        settings += f' --set "sheet.points=[{rows},{cols}]"'
    warning = (
        f"the picture of {width} x {height} pixels is stretched onto a sheet {wide:g} m wide and {high:g} m high; "
        f"{settings} makes the sheet like the picture"
    )
    cut_width, cut_height = min(width, round(height * wide / high)), min(height, round(width * high / wide))
    # Of few pixels, even the part whose proportions are nearest to the sheet's may be stretched.
    if cut_width and cut_height and _fits(wide * cut_height, high * cut_width):
        cut = left + (width - cut_width) // 2, top + (height - cut_height) // 2, cut_width, cut_height
        warning += f', --set "region=[{",".join(map(str, cut))}]" cuts a part like the sheet'
    yield warning


def _fits(area: float, expected: float) -> bool:
    return expected / ASPECT_TOLERANCE < area < expected * ASPECT_TOLERANCE
