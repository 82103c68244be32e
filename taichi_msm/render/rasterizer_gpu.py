"""Kernel 2 on a GPU: every mass point, cell, sample and pixel is a thread.

The cells are listed in bins (bins.py). A sample tries the cells of its bin's list, so many in a launch that no thread
takes long, however long the list is; what is nearest is kept in between. Then a pixel covers its samples with the
instruments and shades them. The picture is drawn in strips of rows, of which each has a sample a thread.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from typing import Any, NamedTuple
from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render.bins import BOUNDS, FIRST_X, FIRST_Y, LAST_X, LAST_Y, Bins, binned
from taichi_msm.render.coverage import FARTHEST, POINT_NUMBERS, SEEN, Band, Surface, covering
from taichi_msm.render.instrument_coverage import instruments
from taichi_msm.render.numbers import COLS, HEIGHT, LEVEL_COUNT, LEVELS, NEAR, PARTS, ROD_COUNT, ROWS, WIDTH
from taichi_msm.render.projection import projection
from taichi_msm.render.samples import DEPTH, INFINITY, Code
from taichi_msm.render.shading import Out, Texture, resolving
from taichi_msm.system.launches import THREADS, Launches, end_thread
from taichi_msm.system.quick_taichi import defined_once
from taichi_msm.system.runtime import our_compilation, ti

# The smallest width of a bin [samples].
SMALLEST_BIN = 8

# A cell reaches at most so much farther than its mass points, by rounding and to the centres of samples [samples].
MARGIN = 1.5


class Kernels(NamedTuple):
    """The kernels of one code."""

    project: Callable[..., None]
    cover: Callable[..., None]
    resolve: Callable[..., None]


class Threads:
    """The memory of one sheet's pictures on a GPU, and their kernels; arguments as for `rasterizer_cpu.Bands`."""

    def __init__(
        self, code: Code, points: tuple[int, int], size: tuple[int, int], texels: NDArray[np.float32]
    ) -> None:
        self._code, self._size, self._kernels = code, size, _kernels(code)
        self._launches = launches = Launches(bounded=True)
        (rows, cols), (width, height) = points, size
        self._cells = (rows - 1) * (cols - 1)
        across = width * code.supersample
        # Rows of pixels in a strip.
        self._rows = min(max(1, THREADS // (across * code.supersample)), height)
        self._texels = launches.give(texels)
        self._point = launches.array(np.float32, rows * cols * POINT_NUMBERS)
        self._bounds = launches.array(np.int32, self._cells * BOUNDS)
        self._samples = ti.ndarray(code.floats, self._rows * code.supersample * across * code.planes)
        self._colours = launches.array(np.uint8, 3 * width * height if code.picture else 1)
        self._labels = launches.array(np.float32, 4 * width * height if code.labels else 1)

    def draw(
        self, position: NDArray[np.float32], numbers: NDArray[np.float32], sizes: NDArray[np.int32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Draw the picture, the labels or both; arguments and results as for `rasterizer_cpu.Bands.draw`.

        Raises:
            DeviceError: when the device cut threads short.
        """
        launches, kernels, factor = self._launches, self._kernels, self._code.supersample
        (width, height), rods = self._size, int(sizes[ROD_COUNT])
        across, down, pieces = width * factor, height * factor, 2 * int(numbers[PARTS]) ** 2
        view = launches.give(numbers), launches.give(sizes)
        with our_compilation(optimised=False):
            kernels.project(position, *view, self._point, self._bounds)
        bin_size = max(SMALLEST_BIN, round((across * down / self._cells) ** 0.5))
        bins = binned(launches, self._bounds, self._cells, (across, down), bin_size)
        # A sample takes one round for a cell, and for each of its pieces one and one or two for tiles.
        rounds_of_cell = 1 + 3 * pieces
        rounds_of_rods = rods * (1 + factor * (1 + factor))
        rounds_of_shading = factor * (1 + factor * (1 + int(sizes[LEVEL_COUNT]) + rods)) + 2
        for row in range(0, height, self._rows):
            rows = min(self._rows, height - row)
            top, bottom = row * factor, (row + rows) * factor
            longest = int(bins.lengths[top // bins.size : (bottom - 1) // bins.size + 1].max())
            for listed, count in launches.parts(longest, rounds_of_cell):
                launches.launch(
                    kernels.cover, rows * factor * across,
                    top, listed, count, *view, self._point, self._bounds,
                    bins.size, bins.across, bins.starts, bins.entries, self._samples,
                    rounds=count * rounds_of_cell,
                )  # fmt: skip
            launches.launch(
                kernels.resolve, rows * width,
                row, *view, self._texels, self._samples, self._colours, self._labels,
                rounds=rounds_of_rods + rounds_of_shading,
            )  # fmt: skip
        launches.require_ended()
        colours = launches.take(self._colours) if self._code.picture else np.empty(0, np.uint8)
        return colours.reshape(-1, width, 3), launches.take(self._labels)


@defined_once
def _kernels(code: Code) -> Kernels:
    """Make the kernels of one code."""
    factor, floats, planes = code.supersample, code.floats, code.planes
    project_point, cover_with = projection(code), covering(code)
    cover_rods, resolve_samples = instruments(code), resolving(code)

    @ti.func
    def bound(cell, near, cols, width, height, point: ti.template(), bounds: ti.template()):
        """Find the samples that a cell may cover."""
        corner = (cell // (cols - 1) * cols + cell % (cols - 1)) * POINT_NUMBERS
        low_x, high_x, low_y, high_y = INFINITY, -INFINITY, INFINITY, -INFINITY
        before, behind, resolved = True, True, True
        for n in ti.static(range(4)):
            at = corner + (n % 2 + n // 2 * cols) * POINT_NUMBERS
            x, y = point[at + SEEN], point[at + SEEN + 1]
            low_x, high_x, low_y, high_y = ti.min(low_x, x), ti.max(high_x, x), ti.min(low_y, y), ti.max(high_y, y)
            before = before and point[at + 2] > near
            behind = behind and point[at + 2] <= near
            # False for NaN.
            resolved = resolved and abs(x) < FARTHEST and abs(y) < FARTHEST
        here = cell * BOUNDS
        bounds[here + FIRST_X], bounds[here + FIRST_Y] = 0, 0
        bounds[here + LAST_X], bounds[here + LAST_Y] = width - 1, height - 1
        if behind:
            bounds[here + LAST_X], bounds[here + LAST_Y] = -1, -1
        elif before and resolved:
            bounds[here + FIRST_X] = ti.max(ti.cast(ti.floor(low_x - MARGIN), ti.i32), 0)
            bounds[here + FIRST_Y] = ti.max(ti.cast(ti.floor(low_y - MARGIN), ti.i32), 0)
            bounds[here + LAST_X] = ti.math.clamp(ti.cast(ti.floor(high_x + MARGIN), ti.i32), -1, width - 1)
            bounds[here + LAST_Y] = ti.math.clamp(ti.cast(ti.floor(high_y + MARGIN), ti.i32), -1, height - 1)

    @ti.kernel
    def project(
        position: ti.types.ndarray(dtype=ti.f32, ndim=3),
        numbers: ti.types.ndarray(dtype=ti.f32, ndim=1),
        sizes: ti.types.ndarray(dtype=ti.i32, ndim=1),
        point: ti.types.ndarray(dtype=ti.f32, ndim=1),
        bounds: ti.types.ndarray(dtype=ti.i32, ndim=1),
    ):
        """Project the mass points, and find the bounds of the cells [samples]."""
        for index in range(sizes[ROWS] * sizes[COLS]):
            rows, cols = sizes[ROWS], sizes[COLS]
            project_point(position, numbers, point, index // cols, index % cols, rows, cols)

        for cell in range((sizes[ROWS] - 1) * (sizes[COLS] - 1)):
            bound(cell, numbers[NEAR], sizes[COLS], sizes[WIDTH] * factor, sizes[HEIGHT] * factor, point, bounds)

    @ti.kernel
    def cover(
        first: ti.i32,
        end: ti.i32,
        ended: ti.types.ndarray(dtype=ti.i32, ndim=1),
        top: ti.i32,
        listed: ti.i32,
        count: ti.i32,
        numbers: ti.types.ndarray(dtype=ti.f32, ndim=1),
        sizes: ti.types.ndarray(dtype=ti.i32, ndim=1),
        point: ti.types.ndarray(dtype=ti.f32, ndim=1),
        bounds: ti.types.ndarray(dtype=ti.i32, ndim=1),
        bin_size: ti.i32,
        bins_across: ti.i32,
        starts: ti.types.ndarray(dtype=ti.i32, ndim=1),
        entries: ti.types.ndarray(dtype=ti.i32, ndim=1),
        samples: ti.types.ndarray(dtype=floats, ndim=1),
    ):
        """Cover the samples of a strip that begins at row `top`, with `count` cells of their lists from `listed` on."""
        for index in range(first, end):
            rows, cols, width, height = sizes[ROWS], sizes[COLS], sizes[WIDTH] * factor, sizes[HEIGHT] * factor
            x, y = index % width, top + index // width
            if listed == 0:
                samples[index * planes + DEPTH] = floats(INFINITY)
                if ti.static(code.instruments):
                    samples[index * planes + ti.static(code.layout["instrument"])] = floats(0)
            surface = ti.static(Surface(point, rows, cols, numbers[PARTS], sizes[LEVELS + 1], sizes[LEVELS + 2]))
            line = index // width * width * planes
            band = ti.static(
                Band(samples, line, width, x, x + 1, y, y + 1, width, height, numbers[NEAR], numbers)
            )
            square = y // bin_size * bins_across + x // bin_size
            begin = starts[square] + listed
            for n in range(begin, ti.min(begin + count, starts[square + 1])):
                cell = entries[n]
                here = cell * BOUNDS
                if (
                    bounds[here + FIRST_X] <= x
                    and x <= bounds[here + LAST_X]
                    and bounds[here + FIRST_Y] <= y
                    and y <= bounds[here + LAST_Y]
                ):
                    cover_with(cell // (cols - 1), cell % (cols - 1), surface, band)
            end_thread(ended)

    @ti.kernel
    def resolve(
        first: ti.i32,
        end: ti.i32,
        ended: ti.types.ndarray(dtype=ti.i32, ndim=1),
        row: ti.i32,
        numbers: ti.types.ndarray(dtype=ti.f32, ndim=1),
        sizes: ti.types.ndarray(dtype=ti.i32, ndim=1),
        texels: ti.types.ndarray(dtype=ti.f32, ndim=1),
        samples: ti.types.ndarray(dtype=floats, ndim=1),
        colours: ti.types.ndarray(dtype=ti.u8, ndim=1),
        labels: ti.types.ndarray(dtype=ti.f32, ndim=1),
    ):
        """Cover the pixels of a strip that begins at `row` with the instruments, and write them."""
        for index in range(first, end):
            width, height, rod_count = sizes[WIDTH], sizes[HEIGHT], sizes[ROD_COUNT]
            x, y = index % width, row + index // width
            left, top, across = x * factor, y * factor, width * factor
            line = (y - row) * factor * across * planes
            if ti.static(code.instruments):
                band = ti.static(
                    Band(
                        samples, line, across, left, left + factor, top, top + factor,
                        across, height * factor, numbers[NEAR], numbers,
                    )
                )  # fmt: skip
                cover_rods(rod_count, band)
            texture = ti.static(Texture(texels, sizes, sizes[LEVELS + 1], sizes[LEVELS + 2], numbers, rod_count))
            pixels = width * height
            out = ti.static(Out(colours, labels, pixels))
            resolve_samples(samples, line, y, y + 1, x, x + 1, across, width, texture, out)
            end_thread(ended)

    return Kernels(project, cover, resolve)
