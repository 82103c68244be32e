"""The constants that decide the look of the picture.

What kernel 2 is told of a picture, in two arrays, as every argument of a kernel costs time.

One holds sizes and counters; the other the numbers of the view, its light and its instruments.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.surface import Rod
from taichi_msm.render.camera import View
from taichi_msm.render.lens_table import visible_region
from taichi_msm.scene.render import Render
from taichi_msm.scene.scene import Scene

# The mass-point mesh: its colour, the width of a line [px], and how much of the surface it hides.
WIRE_COLOUR = (235, 245, 255)
WIRE_WIDTH = 1.0
WIRE_OPACITY = 0.75

# A sample of tissue that is at most this many texels wide shows the texture at full size: the filter has two texels.
SHARP = 2.0

# Where the light is, to the right of the eye and above it, as a fraction of the distance to what the camera looks at.
LIGHT_RIGHT, LIGHT_UP = -0.3, 0.0

# How far around the surface light wraps, and how narrow highlights are: (M V)^(2^SHARPNESS).
WRAP = 0.3
SHARPNESS = 3

# Share of the light that an instrument takes from the tissue that it touches.
SHADE = 0.7

# Metal: its colour; the shares of ambient light, of diffuse light and of the reflected room; and the brightness of its
# highlight, as a fraction of white.
METAL = (176.0, 182.0, 190.0)
METAL_AMBIENT, METAL_DIFFUSE, METAL_MIRROR, METAL_GLOSS = 0.2, 0.35, 0.6, 0.7

# The least depth at which metal is lit, in units of the distance from the light to the middle of the picture.
METAL_NEAREST = 0.2


Array = NDArray[np.float64]

# Indices into the array of sizes: of the sheet, the picture and its bins. Three are counters: rows of mass points that
# workers have taken, rows projected, bands taken. Last come the levels of the texture, each with its first texel, its
# width and its height.
ROWS, COLS, WIDTH, HEIGHT, CAPSULE_COUNT, BIN_SIZE, BINS_ACROSS = range(7)
ROWS_TAKEN, ROWS_PROJECTED, BANDS_TAKEN, LEVEL_COUNT, LEVELS = range(7, 12)
LEVEL_STRIDE = 3

# Indices into the array of numbers. The camera: its matrix, row after row; its axes; only what is farther than NEAR is
# drawn. Then the number of small quads along a side of a cell, and the background's colour.
MATRIX, AXES, NEAR, SUBDIVISIONS, BACKGROUND = 0, 16, 25, 26, 27

# Where the axis of view is seen without distortion [samples]; metres per sample at w = 1, across and down; 1 for a
# pinhole camera, else 0. The middle of the picture [samples].
CENTRE_X, CENTRE_Y, SPREAD_X, SPREAD_Y, PINHOLE, MIDDLE_X, MIDDLE_Y = range(30, 37)

# The light's place to the right and up, in the camera's frame [m]; its distance from the point in the middle of the
# picture of the main camera [m]; the factor that makes the light 1 there; the scene's numbers.
LIGHT_X, LIGHT_Y, LIGHT_DISTANCE, LIGHT_NORMALISATION, AMBIENT, GLOSS, VIGNETTE = range(37, 44)

# The sheet's axes to the right and up, in the camera's frame; the slope of the relief for a step of one grey from texel
# to texel.
ACROSS, UP, SLOPE_X, SLOPE_Y = 44, 47, 50, 51

# A mass point's place in the picture is after its X, Y, w and depth.
SCREEN = 4

# Whatever is in front of a point by less than this counts as the point's own place [m].
DEPTH_TOLERANCE = 52
RELATIVE_DEPTH_TOLERANCE = 1e-9  # this distance as a fraction of the sheet's larger side

# The lens: its coefficients; how far from the axis of view it is taken [m], at w = 1; where the axis is seen [samples],
# and samples per metre at w = 1; the numbers of `lens_table.VisibleRegion`, in samples.
LENS, LENS_RADIUS, PICTURE_X, PICTURE_Y, FOCAL_X, FOCAL_Y, VISIBLE, SAGITTA_FACTOR, STRETCH_FACTOR = (
    53,
    *range(61, 67),
    70,
    71,
)

# The light's place toward the camera, in its frame [m]; the direction to the headlight, in the world.
LIGHT_Z, HEADLIGHT = 72, 73

# Then the instruments, each with the middle of its tip and its axis in the camera's frame; its length and radius; and
# its bounds in the picture [samples].
CAPSULES, CAPSULE_STRIDE = 76, 12
TIP, AXIS, LENGTH, RADIUS, LEFT, TOP, RIGHT, BOTTOM = 0, 3, 6, 7, 8, 9, 10, 11


def sizes_of(scene: Scene, levels: NDArray[np.int32]) -> NDArray[np.int32]:
    """Put the sizes together, but for what changes from frame to frame; `levels` of the texture, as of `pyramid`."""
    sizes = np.zeros(LEVELS + levels.size, np.int32)
    sizes[[ROWS, COLS, WIDTH, HEIGHT, LEVEL_COUNT]] = *scene.sheet.points, *scene.render.size, len(levels)
    sizes[LEVELS:] = levels.flat
    return sizes


def view_numbers(
    view: View, render: Render, factor: int, sheet: tuple[float, float], texture: tuple[int, int], rods: Sequence[Rod]
) -> Array:
    """Put the numbers together, for `factor` samples per pixel along each axis.

    The sheet has this height and width [m], its texture this width and height [texels].
    """
    uniforms = np.zeros(CAPSULES + len(rods) * CAPSULE_STRIDE)
    uniforms[MATRIX:AXES] = (view.matrix * np.array([[factor], [factor], [1], [1]])).ravel()
    uniforms[AXES:NEAR] = view.axes.ravel()
    uniforms[NEAR:BACKGROUND] = view.near, render.refine + 1
    uniforms[BACKGROUND:CENTRE_X] = render.background
    uniforms[CENTRE_X:SPREAD_X], uniforms[SPREAD_X:PINHOLE] = view.centre * factor, 1 / (view.scale * factor)
    uniforms[PINHOLE], uniforms[MIDDLE_X:LIGHT_X] = view.pinhole, view.size / 2 * factor
    light_view, light = view.light_view or view, render.light
    place = np.array([LIGHT_RIGHT, LIGHT_UP, 0.0]) * light_view.distance
    far = math.hypot(place[0], place[1], light_view.distance)
    unit = (1 + WRAP) / (light_view.distance / far + WRAP)
    if light_view is not view:
        place = view.axes @ (light_view.eye + place @ light_view.axes - view.eye)
    uniforms[[LIGHT_X, LIGHT_Y, LIGHT_Z]], uniforms[HEADLIGHT:CAPSULES] = place, light_view.axes[2]
    uniforms[LIGHT_DISTANCE:ACROSS] = far, unit, light.ambient, light.gloss, light.vignette
    uniforms[ACROSS:UP], uniforms[UP:SLOPE_X] = view.axes[:, 0], view.axes[:, 1]
    height = light.relief / 100 / 255 * max(sheet)
    uniforms[SLOPE_X:DEPTH_TOLERANCE] = height * texture[0] / sheet[1], -height * texture[1] / sheet[0]
    uniforms[DEPTH_TOLERANCE] = RELATIVE_DEPTH_TOLERANCE * max(sheet)
    if view.lens is not None:
        seen = visible_region(view)
        set_lens(uniforms, view, factor, seen.radius)
        uniforms[VISIBLE:SAGITTA_FACTOR] = np.array(seen.box) * factor
        uniforms[SAGITTA_FACTOR], uniforms[STRETCH_FACTOR] = seen.bend / factor, seen.stretch
    for n, rod in enumerate(rods):
        uniforms[CAPSULES + n * CAPSULE_STRIDE : CAPSULES + (n + 1) * CAPSULE_STRIDE] = _rod_numbers(rod, view, factor)
    return uniforms


def set_lens(uniforms: Array, view: View, factor: int, radius: float) -> None:
    """Add the numbers of a lens, which is taken up to a radius."""
    assert view.lens is not None
    uniforms[LENS : LENS + len(view.lens.coefficients)] = view.lens.coefficients
    uniforms[LENS_RADIUS] = radius
    uniforms[PICTURE_X:FOCAL_X], uniforms[FOCAL_X:VISIBLE] = view.centre * factor, view.scale * factor


def _rod_numbers(rod: Rod, view: View, factor: int) -> Array:
    uniforms = np.empty(CAPSULE_STRIDE)
    uniforms[TIP:AXIS] = view.axes @ (rod.tip - view.eye)
    uniforms[AXIS:LENGTH] = view.axes @ rod.axis
    uniforms[[LENGTH, RADIUS]] = rod.length, rod.radius
    # The bounds of a box around each end also hold for the end itself.
    ends = np.stack([rod.tip, rod.tip + rod.axis * rod.length])
    corner = np.array(np.meshgrid(*[(-rod.radius, rod.radius)] * 3)).reshape(3, -1).T @ view.axes
    boxes = (ends[:, None] + corner).reshape(-1, 3)
    x, y, w, _ = view.project(boxes).T
    # Without distortion, as all places are in kernels.
    left, right, top, bottom = (0, view.size[0], 0, view.size[1]) if view.lens is None else visible_region(view).box
    low, high = np.array([left, top]), np.array([right, bottom])
    if (w > view.near).all():
        seen = np.stack([x / w, y / w], axis=-1)
        low, high = np.clip([seen.min(axis=0), seen.max(axis=0)], low, high)
    uniforms[LEFT:] = np.concatenate([low, high]) * factor
    return uniforms
