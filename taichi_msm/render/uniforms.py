"""Constants of the shading, and the per-view arguments of kernel 2.

Every argument of a kernel costs time, so they are packed into two arrays: sizes and counters, and the constants of the
view, its light and its instruments ("uniforms", as in OpenGL).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.cameras.view import View
from taichi_msm.model.rest import rest_of
from taichi_msm.model.surface import Solid
from taichi_msm.render.undistortion import visible_region
from taichi_msm.scene.scene import Scene
from taichi_msm.shapes import SHAPES

# The wireframe: colour, width [px] and opacity of its lines.
WIRE_COLOUR = (235, 245, 255)
WIRE_WIDTH = 1.0
WIRE_OPACITY = 0.75

# Largest size on the texture of a sample that needs no mipmap [texels]; the bilinear filter spans two.
FULL_RESOLUTION_TEXELS = 2.0

# Offset of the light from the eye, to the right and up, as a fraction of the distance to the target.
LIGHT_RIGHT, LIGHT_UP = -0.3, 0.0

# Wrap of diffuse light; binary logarithm of the shininess of highlights (shading.py).
WRAP = 0.3
SHARPNESS = 3

# Share of the light that an instrument removes from the tissue that it touches.
SHADE = 0.7

# Metal: colour; shares of ambient light, diffuse light and the reflected room; brightness of the highlight, white at 1.
METAL = (176.0, 182.0, 190.0)
METAL_AMBIENT, METAL_DIFFUSE, METAL_MIRROR, METAL_GLOSS = 0.2, 0.35, 0.6, 0.7

# Minimum depth at which metal is lit, as a fraction of the distance from the light to the main camera's target.
METAL_NEAREST = 0.2

# Indices into the array of sizes: sizes of the sheet, the picture and its bins; counters of the workers, for rows
# taken, rows projected and bands taken; levels of the texture, each with its first texel, width and height; then, of a
# masked sheet, a bit per cell, row by row, 1 where there is sheet.
ROWS, COLS, WIDTH, HEIGHT, INSTRUMENT_COUNT, BIN_SIZE, BINS_ACROSS = range(7)
ROWS_TAKEN, ROWS_PROJECTED, BANDS_TAKEN, LEVEL_COUNT, LEVELS = range(7, 12)
LEVEL_STRIDE = 3

# Indices into the array of uniforms. The camera's matrix and axes, row by row, and its near plane; the number of
# sub-quads along a side of a cell; the background's colour.
MATRIX, AXES, NEAR, SUBDIVISIONS, BACKGROUND = 0, 16, 25, 26, 27

# The principal point without distortion [samples]; metres per sample at w = 1, horizontal and vertical; 1 for a pinhole
# camera, else 0; the centre of the picture [samples].
CENTRE_X, CENTRE_Y, SPREAD_X, SPREAD_Y, PINHOLE, MIDDLE_X, MIDDLE_Y = range(30, 37)

# The light's position in the camera's frame [m]; its distance from the target of the main camera [m]; the factor that
# normalises the light to 1 at the target; the scene's light settings.
LIGHT_X, LIGHT_Y, LIGHT_Z, LIGHT_DISTANCE, LIGHT_NORMALISATION, AMBIENT, GLOSS, VIGNETTE = range(37, 45)

# The direction to the headlight, in the world. The axes of the sheet to the right and up, in the camera's frame; the
# slope of the relief per grey level between neighbouring texels.
HEADLIGHT, ACROSS, UP, SLOPE_X, SLOPE_Y = 45, 48, 51, 54, 55

# Depth by which a surface must be nearer than a point to occlude it [m].
DEPTH_TOLERANCE = 56

# The lens: its coefficients; its limit or the largest visible radius, at w = 1 [m]; the principal point [samples];
# samples per metre at w = 1; the box and the factors of `undistortion.VisibleRegion`, in samples.
LENS, LENS_RADIUS, PICTURE_X, PICTURE_Y, FOCAL_X, FOCAL_Y, VISIBLE = 57, *range(65, 71)
SAGITTA_FACTOR, STRETCH_FACTOR = 74, 75

# Of a picture by a camera: the coefficients of its lens; the limit of the lens at depth 1 [m]; the principal point, and
# the focal lengths [texels].
PICTURE_LENS, PICTURE_LENS_RADIUS, TEXEL_X, TEXEL_Y, TEXEL_FOCAL_X, TEXEL_FOCAL_Y = 76, *range(84, 89)

# The instruments, each with the centre of its tip and its axis in the camera's frame, its length and radius [m], its
# bounding box in the undistorted picture [samples], and the number of its shape.
INSTRUMENTS, INSTRUMENT_STRIDE = 89, 13
TIP, AXIS, LENGTH, RADIUS, LEFT, TOP, RIGHT, BOTTOM, KIND = 0, 3, 6, 7, 8, 9, 10, 11, 12
KINDS = {name: float(number) for number, name in enumerate(SHAPES)}


def sizes_of(scene: Scene, levels: NDArray[np.int32], size: tuple[int, int]) -> NDArray[np.int32]:
    """Return the array of sizes and counters of a picture, 0 where they vary by frame; `levels` as from `pyramid`."""
    mask = rest_of(scene.sheet).mask
    bits = np.empty(0, np.uint8) if mask is None else np.packbits(mask.cells, bitorder="little")
    words = np.pad(bits, (0, -bits.size % 4)).view("<i4")
    sizes = np.concatenate([np.zeros(LEVELS, np.int32), levels.ravel(), words], dtype=np.int32)
    sizes[[ROWS, COLS, WIDTH, HEIGHT, LEVEL_COUNT]] = *scene.sheet.points, *size, len(levels)
    return sizes


def view_uniforms(
    view: View, scene: Scene, instruments: Sequence[Solid], supersample: int = 1, texture_size: tuple[int, int] = (1, 1)
) -> Array:
    """Return the array of uniforms of a view; `texture_size` is the width and height of the texture [texels]."""
    render, rest = scene.render, rest_of(scene.sheet)
    sides = rest.sides
    uniforms = np.zeros(INSTRUMENTS + len(instruments) * INSTRUMENT_STRIDE)
    uniforms[MATRIX:AXES] = (view.matrix * np.array([[supersample], [supersample], [1], [1]])).ravel()
    uniforms[AXES:NEAR] = view.axes.ravel()
    uniforms[NEAR:BACKGROUND] = view.near, render.refine + 1
    uniforms[BACKGROUND:CENTRE_X] = render.background
    uniforms[CENTRE_X:SPREAD_X], uniforms[SPREAD_X:PINHOLE] = view.centre * supersample, 1 / (view.scale * supersample)
    uniforms[PINHOLE], uniforms[MIDDLE_X:LIGHT_X] = view.pinhole, view.size / 2 * supersample
    light_view, light = view.light_view or view, render.light
    light_position = np.array([LIGHT_RIGHT, LIGHT_UP, 0.0]) * light_view.distance
    light_distance = math.hypot(light_position[0], light_position[1], light_view.distance)
    normalisation = (1 + WRAP) / (light_view.distance / light_distance + WRAP)
    if light_view is not view:
        light_position = view.axes @ (light_view.eye + light_position @ light_view.axes - view.eye)
    uniforms[LIGHT_X:LIGHT_DISTANCE], uniforms[HEADLIGHT:ACROSS] = light_position, light_view.axes[2]
    uniforms[LIGHT_DISTANCE:HEADLIGHT] = light_distance, normalisation, light.ambient, light.gloss, light.vignette
    uniforms[ACROSS:UP], uniforms[UP:SLOPE_X] = view.axes[:, 0], view.axes[:, 1]
    height = light.relief / 100 / 255 * rest.extent
    uniforms[SLOPE_X:DEPTH_TOLERANCE] = height * texture_size[0] / sides[1], -height * texture_size[1] / sides[0]
    uniforms[DEPTH_TOLERANCE] = 1e-9 * rest.extent
    if view.lens is not None:
        region = visible_region(view)
        set_lens(uniforms, view, supersample, region.radius)
        uniforms[VISIBLE:SAGITTA_FACTOR] = np.array(region.box) * supersample
        uniforms[SAGITTA_FACTOR], uniforms[STRETCH_FACTOR] = region.sagitta_factor / supersample, region.stretch_factor
    for numbers, solid in zip(uniforms[INSTRUMENTS:].reshape(-1, INSTRUMENT_STRIDE), instruments, strict=True):
        numbers[:] = _instrument_uniforms(solid, view, supersample)
    return uniforms


def set_lens(uniforms: Array, view: View, supersample: int, radius: float) -> None:
    """Set the uniforms of a lens, with its limit or the largest visible radius, at w = 1 [m]."""
    assert view.lens is not None
    uniforms[LENS : LENS + len(view.lens.coefficients)] = view.lens.coefficients
    uniforms[LENS_RADIUS] = radius
    uniforms[PICTURE_X:FOCAL_X], uniforms[FOCAL_X:VISIBLE] = view.centre * supersample, view.scale * supersample


def set_picture(uniforms: Array, picture: View, view: View, scene: Scene) -> None:
    """Set the uniforms of a picture by a camera, whose view is in texels; its relief is seen from that camera."""
    if picture.lens is not None:
        uniforms[PICTURE_LENS : PICTURE_LENS + len(picture.lens.coefficients)] = picture.lens.coefficients
        uniforms[PICTURE_LENS_RADIUS] = picture.lens.limit
    # The centre of the first texel is (0, 0) in the kernel.
    uniforms[TEXEL_X:TEXEL_FOCAL_X], uniforms[TEXEL_FOCAL_X:INSTRUMENTS] = picture.centre - 0.5, picture.scale
    height = scene.render.light.relief / 100 / 255 * rest_of(scene.sheet).extent
    uniforms[ACROSS:UP], uniforms[UP:SLOPE_X] = view.axes @ picture.axes[0], view.axes @ picture.axes[1]
    uniforms[SLOPE_X:DEPTH_TOLERANCE] = height * picture.scale * (1, -1) / picture.distance


def _instrument_uniforms(solid: Solid, view: View, supersample: int) -> Array:
    uniforms = np.empty(INSTRUMENT_STRIDE)
    uniforms[TIP:AXIS] = view.axes @ (solid.tip - view.eye)
    uniforms[AXIS:LENGTH] = view.axes @ solid.axis
    uniforms[[LENGTH, RADIUS]] = solid.length, solid.radius
    # The convex hull of two cubes, one around each end, contains the shape.
    ends = np.stack([solid.tip, solid.tip + solid.axis * solid.length])
    corner = np.array(np.meshgrid(*[(-solid.radius, solid.radius)] * 3)).reshape(3, -1).T @ view.axes
    boxes = (ends[:, None] + corner).reshape(-1, 3)
    x, y, w, _ = view.project(boxes).T
    # The visible part of the undistorted picture, to which the box is clipped.
    left, right, top, bottom = (0, view.size[0], 0, view.size[1]) if view.lens is None else visible_region(view).box
    low, high = np.array([left, top]), np.array([right, bottom])
    if (w > view.near).all():
        projected = np.stack([x / w, y / w], axis=-1)
        low, high = np.clip([projected.min(axis=0), projected.max(axis=0)], low, high)
    uniforms[LEFT:KIND], uniforms[KIND] = np.concatenate([low, high]) * supersample, KINDS[solid.shape.name]
    return uniforms
