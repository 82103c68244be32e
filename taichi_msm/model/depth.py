"""The sheet at rest from the depth map of its picture."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.images import PictureError, require_memory
from taichi_msm.model.cells import Cells, unit
from taichi_msm.model.geometry import Origin
from taichi_msm.model.grids import kept_grid
from taichi_msm.model.mask import Mask, sample_nearest
from taichi_msm.model.pictured import Picture
from taichi_msm.scene.sheet import SheetMask
from taichi_msm.scene.surface import DepthMap, Frame
from taichi_msm.surfaces.depths import Depths
from taichi_msm.surfaces.smoothing import smooth_inverse_depth
from taichi_msm.surfaces.surface import Surface, depth_surface, given_grid, positions
from taichi_msm.system.array_cache import cached_arrays

# Largest share of pixels without depth, and of steep cells, those seen at more than MAX_ANGLE [degrees].
MAX_FILLED, MAX_STEEP, MAX_ANGLE = 0.25, 0.01, 80.0

# Inverse depth of pixels without sheet where it would have no end, relative to the least one of the sheet.
MIN_INVERSE = 1e-3

# Memory per pixel for smoothing and splines [bytes].
DEPTH_PIXEL_BYTES = 450


class Relief(NamedTuple):
    """The surface that a depth map shows."""

    surface: Surface  # by fractions of the picture, in the world
    filled: float  # share of pixels without depth, of those of the mask
    deviation: float  # standard deviation of the smoothing [px]
    key: tuple[Any, ...]  # all that the surface depends on


def depth_positions(
    section: DepthMap, frame: Frame, picture: Picture, points: tuple[int, int], mask: SheetMask | None, *, even: bool
) -> tuple[Array, Origin]:
    """Return the positions of the mass points [m]; a PictureError reports a depth map that cannot be used."""
    relief = read_relief(section, frame, picture, mask)
    if not frame.is_kept:
        _check_slopes(section, relief, picture, frame, mask)
    if not even:
        return positions(relief.surface, given_grid(points)), Origin(None, relief.filled, relief.deviation)
    grid = kept_grid(relief.surface, frame, points, relief.key)
    return positions(relief.surface, grid), Origin(grid, relief.filled, relief.deviation)


def read_relief(section: DepthMap, frame: Frame, picture: Picture, mask: SheetMask | None) -> Relief:
    """Return the surface of a depth map."""
    path, numbers = section.file, section.numbers.values
    x, y, width, height = frame.region
    if numbers.shape[1::-1] != frame.image_size:
        sizes = "{1} x {0}".format(*numbers.shape), "{} x {}".format(*frame.image_size)
        raise PictureError(f"{path} has {sizes[0]} pixels, and the image {sizes[1]}", "give the depth of every pixel")
    if min(width, height) < 2:
        raise PictureError(f"{path} has {width} x {height} pixels in the region", "take at least 2 x 2")
    require_memory(path, DEPTH_PIXEL_BYTES * width * height, "cut the region, or scale the picture down")
    known = Depths.of(numbers[y : y + height, x : x + width], section.metres)
    centres = np.stack(np.meshgrid(np.arange(width) + 0.5, np.arange(height) + 0.5), axis=-1)
    corner = np.array([x, y], float)
    pixels = picture.view.undistort(centres + corner)
    if (blind := np.isnan(pixels).any(axis=-1)).any():
        row, column = np.unravel_index(int(blind.argmax()), blind.shape)
        remedy = "cut the region to the pixels that the lens sees"
        raise PictureError(f"{path}: the lens has no line of sight at {_pixel(column, row, frame)}", remedy)
    across, down = np.moveaxis((pixels - picture.view.centre) / picture.view.scale, -1, 0)
    if section.along == "ray":
        known = known.from_distances(across, down)
    is_sheet = None
    if mask is not None:
        is_sheet = sample_nearest(mask.pixels.is_sheet, centres[..., 0] / width, centres[..., 1] / height)
        known = known.within(is_sheet)
    if not known.is_known.any():
        raise PictureError(f"{path} has no depth in the region", "check its unit and the region")
    filled = known.filled(is_sheet)
    if filled > MAX_FILLED:
        remedy = "cut the region to the part with depth, or leave the other parts out by sheet.mask"
        raise PictureError(f"{path} has no depth in {filled:.0%} of its pixels, over {MAX_FILLED:.0%}", remedy)
    deviation = section.smooth
    if deviation == "auto":
        rows, cols = frame.points
        deviation = (width / (cols - 1) + height / (rows - 1)) / 4
    outline = mask and (mask.pixels.sha256, mask.invert)
    key = (section.numbers.sha256, section.unit, section.along, float(deviation), frame.region, outline, picture.key)
    (inverse,) = cached_arrays(
        ("inverse depth", repr(key)),
        lambda: (smooth_inverse_depth(1 / known.depth, known.is_known, pixels[..., 0], pixels[..., 1], deviation),),
    )
    is_endless = inverse <= 0
    if is_sheet is not None:
        # Without sheet, where a depth matters only to the spline, the surface is as far as it may be.
        inverse = np.where(is_endless & ~is_sheet, MIN_INVERSE * inverse[is_sheet].min(), inverse)
        is_endless &= is_sheet
    if is_endless.any():
        row, column = np.unravel_index(int(is_endless.argmax()), inverse.shape)
        remedy = "cut the region, or leave the place out by sheet.mask"
        fault = f"its smoothed depth jumps to infinity at {_pixel(column, row, frame)}"
        raise PictureError(f"{path}: {fault}, next to much smaller ones", remedy)
    return Relief(_in_world(inverse, picture), filled, float(deviation), key)


def _pixel(column: Any, row: Any, frame: Frame) -> str:
    return f"pixel ({int(column) + frame.region[0]}, {int(row) + frame.region[1]})"


def _in_world(inverse: Array, picture: Picture) -> Surface:
    view, corner = picture.view, np.array(picture.region[:2], float)
    rotation = np.stack([view.axes[0], -view.axes[1], -view.axes[2]])

    def sight(pixels: Array) -> tuple[Array, Array]:
        undistorted = (view.undistort(pixels + corner) - view.centre) / view.scale
        if view.lens is None:
            jacobian = np.broadcast_to(np.eye(2), (len(pixels), 2, 2)) * 1.0
        else:
            jacobian = np.asarray(np.linalg.inv(view.lens.jacobian(undistorted)))
        return undistorted, jacobian / view.scale

    in_camera = depth_surface(inverse, sight)

    def surface(fractions: Array) -> tuple[Array, Array]:
        position, slope = in_camera(fractions)
        return view.eye + position @ rotation, np.einsum("kij,il->klj", slope, rotation)

    return surface


def _check_slopes(section: DepthMap, relief: Relief, picture: Picture, frame: Frame, mask: SheetMask | None) -> None:
    """Raise a PictureError at an edge of something in front: cells of the given grid that are seen on edge."""
    x = positions(relief.surface, given_grid(frame.points))
    cells = Cells.of(x)
    middle = (x[:-1, :-1] + x[:-1, 1:] + x[1:, :-1] + x[1:, 1:]) / 4
    cosine = (unit(np.cross(cells.b, cells.a)) * unit(picture.view.eye - middle)).sum(axis=-1)
    present = np.ones(cosine.shape, bool)
    if mask is not None:
        present = Mask.at_cells(mask.pixels.is_sheet, frame.points).cells
    steep: NDArray[np.bool_] = ~(cosine > np.cos(np.radians(MAX_ANGLE))) & present
    if steep.sum() > MAX_STEEP * present.sum():
        row, column = np.unravel_index(int(np.where(steep, -np.nan_to_num(cosine), -np.inf).argmax()), steep.shape)
        (rows, cols), (*_, width, height) = frame.points, frame.region
        at = _pixel((column + 0.5) / (cols - 1) * width, (row + 0.5) / (rows - 1) * height, frame)
        raise PictureError(
            f"{section.file}: depth jumps at {at}: an edge of something in front",
            "cut the region, cut it out by sheet.mask, or set the depth there to 0",
        )
