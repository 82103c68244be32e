"""Kernel 2 on a CPU: the picture is cut into bands of rows, which workers take one after the other.

What is kept of a band fits into the cache, and no two workers write to one sample, so they need no locks.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render.coverage import POINT_NUMBERS, SEEN, Band, Surface, covering
from taichi_msm.render.instrument_coverage import instruments
from taichi_msm.render.numbers import (
    BANDS_TAKEN,
    COLS,
    HEIGHT,
    LEVELS,
    NEAR,
    PARTS,
    ROD_COUNT,
    ROWS,
    ROWS_PROJECTED,
    ROWS_TAKEN,
    WIDTH,
)
from taichi_msm.render.projection import projection
from taichi_msm.render.samples import DEPTH, INFINITY, Code
from taichi_msm.render.shading import Out, Texture, resolving
from taichi_msm.system.runtime import ITERATIONS_PER_THREAD, Memory, our_compilation, started, ti


class Bands:
    """The memory of one sheet's pictures on a CPU, and their kernel.

    Args:
        code: what the kernel is compiled for.
        points: rows and columns of mass points.
        size: width and height of the picture [px].
        texels: as in a `Pyramid`.
    """

    def __init__(self, code: Code, points: tuple[int, int], size: tuple[int, int], texels: NDArray[np.float32]) -> None:
        self._code, self._size, self._texels = code, size, texels
        self._draw = _kernel(code)
        (rows, cols), (width, height) = points, size
        self._workers = min(-(-height // code.band_rows), started().threads)
        self._memory = memory = Memory()
        # After the mass points, for every row of them, its highest and its lowest place in the picture.
        self._point = memory.array("f32", 0, rows * (cols * POINT_NUMBERS + 2))
        self._samples = memory.array("f32", code.lanes, self._workers * code.band_vectors(width))

    def draw(
        self, position: NDArray[np.float32], numbers: NDArray[np.float32], sizes: NDArray[np.int32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Draw the picture, the labels or both, as the code says.

        Args:
            position: positions of the mass points [m], shape (rows, cols, 3).
            numbers: as `view_numbers` makes them.
            sizes: of the sheet, the picture, the instruments and the texture (numbers.py).

        Returns:
            Colours, shape (height, width, 3), and labels as in `shading.Out`; each has meaning only if drawn.
        """
        code, (width, height) = self._code, self._size
        # Whole tiles are written, and the last of a row may reach beyond the picture.
        stride = code.tiles_across(width) * code.tile_width if code.in_words else width
        picture = np.empty((height, stride, 3) if code.picture else (1, 4, 3), np.uint8)
        # Without labels nothing is written there; an array of Taichi's is passed in half the time of one of NumPy's.
        labels: Any = np.zeros(4 * width * height, np.float32) if code.labels else self._point
        sizes[[ROWS_TAKEN, ROWS_PROJECTED, BANDS_TAKEN]] = 0
        with our_compilation(optimised=False):
            self._draw(
                position,
                self._texels,
                numbers,
                self._workers,
                sizes,
                self._point,
                self._samples,
                picture.ravel().view(np.int32) if code.in_words else picture.ravel(),
                labels,
            )
        return picture[:, :width], labels


@cache
def _kernel(code: Code) -> Callable[..., None]:
    """Make the kernel of one code."""
    factor, floats = code.supersample, code.floats
    project, cover, cover_rods, resolve = projection(code), covering(code), instruments(code), resolving(code)

    @ti.func
    def project_row(position: ti.template(), numbers: ti.template(), point: ti.template(), i, rows, cols):
        """Project a row of mass points; store how far up and down in the picture it reaches."""
        low, high = INFINITY, -INFINITY
        for j in range(cols):
            project(position, numbers, point, i, j, rows, cols)
            here = (i * cols + j) * POINT_NUMBERS
            if point[here + 2] > numbers[NEAR]:
                low = ti.min(low, point[here + SEEN + 1])
                high = ti.max(high, point[here + SEEN + 1])
            else:
                low, high = -INFINITY, INFINITY
        point[rows * cols * POINT_NUMBERS + 2 * i] = low
        point[rows * cols * POINT_NUMBERS + 2 * i + 1] = high

    @ti.func
    def project_all(
        position: ti.template(), numbers: ti.template(), point: ti.template(), rows, cols, sizes: ti.template()
    ):
        """Project all rows of mass points, shared among the workers; returns when every row is done.

        A worker waits only for rows that a running worker has taken, so one that starts late holds up nobody.
        """
        taking = True
        while taking:
            i = ti.atomic_add(sizes[ROWS_TAKEN], 1)
            taking = i < rows
            if taking:
                project_row(position, numbers, point, i, rows, cols)
                ti.atomic_add(sizes[ROWS_PROJECTED], 1)
        projected = ti.atomic_add(sizes[ROWS_PROJECTED], 0)
        while projected < rows:
            projected = ti.atomic_add(sizes[ROWS_PROJECTED], 0)

    @ti.func
    def draw_band(surface: ti.template(), band: ti.template()):
        """Find what every sample of a band shows."""
        lines = (band.bottom - band.top + code.tile_height - 1) // code.tile_height
        for tile in range(lines * band.across):
            band.samples[band.first + tile * code.planes + DEPTH] = floats(INFINITY)
            if ti.static(code.instruments):
                band.samples[band.first + tile * code.planes + ti.static(code.layout["instrument"])] = floats(0)
        reach = surface.rows * surface.cols * POINT_NUMBERS
        for i in range(surface.rows - 1):
            row = reach + 2 * i
            low = ti.min(surface.point[row], surface.point[row + 2])
            high = ti.max(surface.point[row + 1], surface.point[row + 3])
            if low < band.bottom and high > band.top:
                for j in range(surface.cols - 1):
                    cover(i, j, (), surface, band)

    @ti.kernel
    def draw(
        position: ti.types.ndarray(dtype=ti.f32, ndim=3),
        texels: ti.types.ndarray(dtype=ti.f32, ndim=1),
        numbers: ti.types.ndarray(dtype=ti.f32, ndim=1),
        workers: ti.i32,
        sizes: ti.types.ndarray(dtype=ti.i32, ndim=1),
        point: ti.types.ndarray(dtype=ti.f32, ndim=1),
        samples: ti.types.ndarray(dtype=floats, ndim=1),
        colours: ti.types.ndarray(dtype=ti.i32 if code.in_words else ti.u8, ndim=1),
        labels: ti.types.ndarray(dtype=ti.f32, ndim=1),
    ):
        for index in range(workers * ITERATIONS_PER_THREAD):
            if index % ITERATIONS_PER_THREAD == 0:
                rows, cols, width, height = sizes[ROWS], sizes[COLS], sizes[WIDTH], sizes[HEIGHT]
                # To start a loop for this alone takes longer than to project a sheet of usual size.
                project_all(position, numbers, point, rows, cols, sizes)
                texture_width, texture_height = sizes[LEVELS + 1], sizes[LEVELS + 2]
                rod_count, parts, near = sizes[ROD_COUNT], numbers[PARTS], numbers[NEAR]
                across = (width * factor + code.tile_width - 1) // code.tile_width
                first = index // ITERATIONS_PER_THREAD * across * (code.band_lines * code.planes)
                surface = ti.static(Surface(point, rows, cols, parts, texture_width, texture_height))
                texture = ti.static(Texture(texels, sizes, texture_width, texture_height, numbers, rod_count))
                pixels = width * height
                out = ti.static(Out(colours, labels, pixels))
                samples_width, samples_height = width * factor, height * factor
                # Bands are taken one by one: if another program delays a worker, the others take its bands.
                taking = True
                while taking:
                    row = ti.atomic_add(sizes[BANDS_TAKEN], 1) * code.band_rows
                    taking = row < height
                    if taking:
                        end_row = ti.min(row + code.band_rows, height)
                        top, bottom = row * factor, end_row * factor
                        band = ti.static(
                            Band(
                                samples, first, across, 0.0, samples_width, top, bottom,
                                samples_width, samples_height, near, numbers,
                            )
                        )  # fmt: skip
                        draw_band(surface, band)
                        if ti.static(code.instruments):
                            cover_rods(rod_count, band)
                        resolve(samples, first, row, end_row, 0, width, across, width, texture, out)

    return draw
