"""What kernel 2 is told of a picture, in two arrays, as every argument of a kernel costs time.

One holds sizes and counters; the other the numbers of the view, its light and its instruments.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render import style
from taichi_msm.render.camera import View
from taichi_msm.render.instrument import Rod
from taichi_msm.scene import Render, Scene

Array = NDArray[np.float64]

# Indices into the array of sizes: of the sheet, the picture and its bins. Three are counters: rows of mass points that
# workers have taken, rows projected, bands taken. Last come the levels of the texture, each with its first texel, its
# width and its height.
ROWS, COLS, WIDTH, HEIGHT, ROD_COUNT, BIN_SIZE, BINS_ACROSS = range(7)
ROWS_TAKEN, ROWS_PROJECTED, BANDS_TAKEN, LEVEL_COUNT, LEVELS = range(7, 12)
LEVEL_SIZES = 3

# Indices into the array of numbers. The camera: its matrix, row after row; its axes; only what is farther than NEAR is
# drawn. Then the number of small quads along a side of a cell, and the background's colour.
MATRIX, AXES, NEAR, PARTS, BACKGROUND = 0, 16, 25, 26, 27

# The middle of the picture [samples]; metres per sample at w = 1; 1 for a pinhole camera, else 0.
CENTRE_X, CENTRE_Y, SPREAD, PINHOLE = range(30, 34)

# The light's place [m]; its distance from the point in the middle of the picture [m]; the factor that makes the light 1
# there; the scene's numbers.
LIGHT_X, LIGHT_Y, FARNESS, UNIT, AMBIENT, GLOSS, VIGNETTE = range(34, 41)

# The sheet's axes to the right and up, in the camera's frame; the slope of the relief for a step of one grey from texel
# to texel.
ACROSS, UP, SLOPE_X, SLOPE_Y = 41, 44, 47, 48

# Whatever is in front of a point by less than this counts as the point's own place [m].
TOUCHING = 49

# Then the instruments, each with the middle of its tip and its axis in the camera's frame; its length and radius; and
# its bounds in the picture [samples].
RODS, ROD_NUMBERS = 50, 12
TIP, AXIS, LENGTH, RADIUS, LEFT, TOP, RIGHT, BOTTOM = 0, 3, 6, 7, 8, 9, 10, 11


# The above distance, as a fraction of the sheet's larger side.
TOUCHING_SHARE = 1e-9


def sizes_of(scene: Scene, levels: NDArray[np.int32]) -> NDArray[np.int32]:
    """Put the sizes together, but for what changes from frame to frame.

    Args:
        scene: a checked scene.
        levels: of the texture, as in a `Pyramid`.
    """
    sizes = np.zeros(LEVELS + levels.size, np.int32)
    sizes[[ROWS, COLS, WIDTH, HEIGHT, LEVEL_COUNT]] = *scene.sheet.points, *scene.render.size, len(levels)
    sizes[LEVELS:] = levels.flat
    return sizes


def view_numbers(
    view: View, render: Render, factor: int, sheet: tuple[float, float], texture: tuple[int, int], rods: Sequence[Rod]
) -> Array:
    """Put the numbers together.

    Args:
        view: the camera.
        render: how the scene is drawn.
        factor: samples per pixel along each axis.
        sheet: its height and width [m].
        texture: its width and height [texels].
        rods: the instruments.
    """
    numbers = np.empty(RODS + len(rods) * ROD_NUMBERS)
    numbers[MATRIX:AXES] = (view.matrix * np.array([[factor], [factor], [1], [1]])).ravel()
    numbers[AXES:NEAR] = view.axes.ravel()
    numbers[NEAR:BACKGROUND] = view.near, render.refine + 1
    numbers[BACKGROUND:CENTRE_X] = render.background
    centre_x, centre_y = view.centre
    numbers[CENTRE_X:LIGHT_X] = centre_x * factor, centre_y * factor, 1 / (view.scale * factor), view.pinhole
    x, y = style.LIGHT_RIGHT * view.distance, style.LIGHT_UP * view.distance
    far, light = math.hypot(x, y, view.distance), render.light
    unit = (1 + style.WRAP) / (view.distance / far + style.WRAP)
    numbers[LIGHT_X:ACROSS] = x, y, far, unit, light.ambient, light.gloss, light.vignette
    numbers[ACROSS:UP], numbers[UP:SLOPE_X] = view.axes[:, 0], view.axes[:, 1]
    height = light.relief / 100 / 255 * max(sheet)
    numbers[SLOPE_X:TOUCHING] = height * texture[0] / sheet[1], -height * texture[1] / sheet[0]
    numbers[TOUCHING] = TOUCHING_SHARE * max(sheet)
    for n, rod in enumerate(rods):
        numbers[RODS + n * ROD_NUMBERS : RODS + (n + 1) * ROD_NUMBERS] = _rod_numbers(rod, view, factor)
    return numbers


def _rod_numbers(rod: Rod, view: View, factor: int) -> Array:
    """Give the numbers of an instrument."""
    numbers = np.empty(ROD_NUMBERS)
    numbers[TIP:AXIS] = view.axes @ (rod.tip - view.eye)
    numbers[AXIS:LENGTH] = view.axes @ rod.axis
    numbers[[LENGTH, RADIUS]] = rod.length, rod.radius
    # The bounds of a box around each end also hold for the end itself.
    ends = np.stack([rod.tip, rod.tip + rod.axis * rod.length])
    corner = np.array(np.meshgrid(*[(-rod.radius, rod.radius)] * 3)).reshape(3, -1).T @ view.axes
    boxes = (ends[:, None] + corner).reshape(-1, 3)
    x, y, w, _ = view.project(boxes).T
    size = 2 * view.centre
    bounds = np.array([0, 0, *size])
    if (w > view.near).all():
        bounds = np.array([(x / w).min(), (y / w).min(), (x / w).max(), (y / w).max()])
    numbers[LEFT:] = np.clip(bounds, 0, np.tile(size, 2)) * factor
    return numbers
