"""Kernel 2 on a GPU: every mass point, cell, sample and pixel is a thread.

Cells, or the triangles of those that are drawn triangle by triangle, are listed in bins (bins.py): the parts of the
sheet. A sample tries the parts of its bin's list, in as many launches as it takes for no thread to take long; what is
nearest is kept in between. Then a pixel covers its samples with the instruments and shades them. A strip of rows is
drawn at a time, with a sample a thread.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render import uniforms as uni
from taichi_msm.render.bins import BOUNDS, ROUNDS_OF_SEARCH, binned, owner, reaches, store_bounds
from taichi_msm.render.config import INFINITY, Band, Bytes, DrawingConfig, Floats, Integers, clear
from taichi_msm.render.coverage import NORMAL_NUMBERS, DrawnSheet, Part, cover, cover_with_rods, store_normal
from taichi_msm.render.geometry import (
    POINT_NUMBERS,
    cell_bounds,
    corner_of,
    is_whole,
    outlined,
    patch_of,
    project,
    triangle_bounds,
)
from taichi_msm.render.labels import label_numbers
from taichi_msm.render.lens_kernels import BENT_NUMBERS, store_bent
from taichi_msm.render.shading import Appearance, PixelArrays, resolve
from taichi_msm.system.launches import VULKAN_THREADS, Launches, end_thread
from taichi_msm.system.runtime import compilation_options, ti, write_vectors

# The smallest width of a bin [samples].
SMALLEST_BIN = 8

# A part reaches at most so much farther than its corners, by rounding and to the centres of samples [samples].
MARGIN = 1.5

# The largest number of parts. If cells would have more, several of their triangles make one.
MOST_PARTS = 1 << 22


# Where the numbers of bent mass points begin, per mass point, and how many numbers it has in all.
BENT = POINT_NUMBERS + NORMAL_NUMBERS
STORED = BENT + BENT_NUMBERS


class Threads:
    """The memory of one sheet's pictures on a GPU, and their kernels; arguments as for `cpu.Bands`."""

    def __init__(
        self, config: DrawingConfig, points: tuple[int, int], size: tuple[int, int], texels: NDArray[np.float32]
    ) -> None:
        self._config, self._size = config, size
        self._project, self._bound = _sheet_kernels(config)
        self._cover, self._resolve = _picture_kernels(config)
        launches = Launches(bounded=True)
        (rows, cols), (width, height) = points, size
        self._cells = (rows - 1) * (cols - 1)
        across = width * config.supersample
        # Rows of pixels in a strip.
        self._rows = min(max(1, VULKAN_THREADS // (across * config.supersample)), height)
        self._texels = launches.upload(texels)
        self._point = launches.array(np.float32, rows * cols * STORED)
        self._pieces = launches.array(np.int32, self._cells)
        strip = self._rows * config.supersample * across * config.planes
        # Before the strip are the places of all samples, if there is a lens.
        self._samples = ti.ndarray(config.floats, height * config.supersample * across * config.place_planes + strip)
        self._colours = launches.array(np.uint8, 3 * width * height if config.picture else 1)
        numbers = label_numbers(normals=config.normals) if config.labels else 0
        self._labels = launches.array(np.float32, max(numbers * width * height, 1))

    def place(self, places: NDArray[np.float32]) -> None:
        """Take the places of the samples of the pictures that follow, as `cpu.Bands.place` does."""
        write_vectors(self._samples, places.reshape(-1, 1))

    def draw(
        self, position: NDArray[np.float32], numbers: NDArray[np.float32], sizes: NDArray[np.int32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Draw as `cpu.Bands.draw` does; raises a DeviceError when the device cut threads short."""
        launches, factor = Launches(bounded=True), self._config.supersample
        (width, height), rods = self._size, int(sizes[uni.ROD_COUNT])
        across, down = width * factor, height * factor
        view = launches.upload(numbers), launches.upload(sizes)
        with compilation_options(optimised=False):
            self._project(position, *view, self._point, self._pieces)
        pieces = launches.download(self._pieces)
        together = max(1, min(-(-int(pieces.sum(dtype=np.int64)) // MOST_PARTS), int(pieces.max())))
        # What is behind the eye makes one empty part.
        ends = np.cumsum(np.maximum(-(-pieces // together), 1), dtype=np.int32)
        parts = int(ends[-1])
        owners, bounds = launches.array(np.int32, 2 * parts), launches.array(np.int32, BOUNDS * parts)
        launches.launch(
            self._bound, parts, together, *view, launches.upload(ends), self._point, self._pieces, owners, bounds,
            rounds=ROUNDS_OF_SEARCH + together,
        )  # fmt: skip
        bin_size = max(SMALLEST_BIN, round((across * down / self._cells) ** 0.5))
        bins = binned(launches, bounds, parts, (across, down), bin_size)
        sizes[[uni.BIN_SIZE, uni.BINS_ACROSS]] = bins.size, bins.across
        view = view[0], launches.upload(sizes)
        # A sample takes one round for a part, and for each of its triangles one and one or two for tiles.
        rounds_of_part = 1 + 3 * together
        rounds_of_rods = rods * (1 + factor * (1 + factor))
        rounds_of_shading = factor * (1 + factor * (1 + int(sizes[uni.LEVEL_COUNT]) + rods)) + 2
        for row in range(0, height, self._rows):
            rows = min(self._rows, height - row)
            top, bottom = row * factor, (row + rows) * factor
            longest = int(bins.lengths[top // bins.size : (bottom - 1) // bins.size + 1].max())
            for listed, count in launches.chunks(longest, rounds_of_part):
                launches.launch(
                    self._cover, rows * factor * across,
                    top, listed, count, together, *view, self._point, self._pieces, owners, bounds,
                    bins.starts, bins.entries, self._samples,
                    rounds=count * rounds_of_part,
                )  # fmt: skip
            launches.launch(
                self._resolve, rows * width,
                row, *view, self._texels, self._samples, self._colours, self._labels,
                rounds=rounds_of_rods + rounds_of_shading,
            )  # fmt: skip
        launches.require_completion()
        colours = launches.download(self._colours) if self._config.picture else np.empty(0, np.uint8)
        return colours.reshape(-1, width, 3), launches.download(self._labels)


@cache
def _sheet_kernels(config: DrawingConfig) -> tuple[Callable[..., None], Callable[..., None]]:
    """Make the kernels that project the sheet, and find the bounds of its parts."""
    factor = config.supersample

    @ti.kernel
    def project_points(
        position: ti.types.ndarray(dtype=ti.f32, ndim=3), numbers: Floats, sizes: Integers, point: Floats,
        pieces: Integers,
    ):  # fmt: skip
        """Project the mass points, and tell in how many pieces each cell is drawn.

        This is 1 for a cell that is drawn as a whole, else the number of its triangles; 0 if it is behind the eye.
        """
        for index in range(sizes[uni.ROWS] * sizes[uni.COLS]):
            rows, cols = sizes[uni.ROWS], sizes[uni.COLS]
            project(position, index // cols, index % cols, cols, numbers, point, False)
            store_normal(position, index // cols, index % cols, rows, cols, config, numbers, point)
            if ti.static(config.bends):
                store_bent(
                    rows * cols * BENT + index * BENT_NUMBERS, index * POINT_NUMBERS, numbers, point, config.lens
                )

        for cell in range((sizes[uni.ROWS] - 1) * (sizes[uni.COLS] - 1)):
            cols, parts = sizes[uni.COLS], ti.cast(numbers[uni.PARTS], ti.i32)
            outline = ti.static(outlined(corner_of(cell, cols), cols, numbers[uni.NEAR], point))
            pieces[cell] = ti.select(outline.behind, 0, ti.select(is_whole(outline), 1, 2 * parts * parts))

    @ti.kernel
    def bound(
        first: ti.i32, end: ti.i32, ended: Integers, together: ti.i32, numbers: Floats, sizes: Integers,
        ends: Integers, point: Floats, pieces: Integers, owners: Integers, bounds: Integers,
    ):  # fmt: skip
        """Find the cell and the first piece of every part, which has `together` pieces; and its bounds [samples]."""
        for item in range(first, end):
            cols, width, height = sizes[uni.COLS], sizes[uni.WIDTH] * factor, sizes[uni.HEIGHT] * factor
            cell = owner(item, (sizes[uni.ROWS] - 1) * (cols - 1), ends)
            parts_of_cell = ti.max((pieces[cell] + together - 1) // together, 1)
            piece = (item - ends[cell] + parts_of_cell) * together
            owners[2 * item], owners[2 * item + 1] = cell, piece
            outline = ti.static(outlined(corner_of(cell, cols), cols, numbers[uni.NEAR], point))
            left, right, top, bottom = outline.left, outline.right, outline.top, outline.bottom
            if ti.static(config.bends):
                at = sizes[uni.ROWS] * cols * BENT + corner_of(cell, cols) // POINT_NUMBERS * BENT_NUMBERS
                left, right, top, bottom = cell_bounds(at, cols, outline, numbers, point)
            if pieces[cell] != 1:
                left, right, top, bottom = INFINITY, -INFINITY, INFINITY, -INFINITY
                patch = ti.static(patch_of(corner_of(cell, cols), cols, outline.side, False, point, False))
                per_side = ti.cast(numbers[uni.PARTS], ti.i32)
                for n in range(piece, ti.min(piece + together, pieces[cell])):
                    s, t = ti.cast(n // 2 % per_side, ti.f32), ti.cast(n // 2 // per_side, ti.f32)
                    low_x, high_x, low_y, high_y, _ = triangle_bounds(
                        s, t, n % 2 == 0, 1.0 / numbers[uni.PARTS], numbers[uni.NEAR], width, height,
                        patch, numbers, config.lens,
                    )  # fmt: skip
                    if not high_x < low_x:
                        # Where it is NaN it may be anywhere.
                        if not (low_x <= high_x and low_y <= high_y):
                            low_x, high_x, low_y, high_y = -INFINITY, INFINITY, -INFINITY, INFINITY
                        left, right = ti.min(left, low_x), ti.max(right, high_x)
                        top, bottom = ti.min(top, low_y), ti.max(bottom, high_y)
            store_bounds(item, left - MARGIN, right + MARGIN, top - MARGIN, bottom + MARGIN, width, height, bounds)
            end_thread(ended)

    return project_points, bound


@cache
def _picture_kernels(config: DrawingConfig) -> tuple[Callable[..., None], Callable[..., None]]:
    """Make the kernels that cover the samples of a strip, and shade its pixels."""
    factor, planes = config.supersample, config.planes

    @ti.kernel
    def cover_samples(
        first: ti.i32, end: ti.i32, ended: Integers, top: ti.i32, listed: ti.i32, count: ti.i32, together: ti.i32,
        numbers: Floats, sizes: Integers, point: Floats, pieces: Integers, owners: Integers, bounds: Integers,
        starts: Integers, entries: Integers, samples: ti.types.ndarray(dtype=config.floats, ndim=1),
    ):  # fmt: skip
        """Cover the samples of a strip that begins at row `top`, with `count` parts of their lists from `listed` on."""
        for index in range(first, end):
            rows, cols, parts = sizes[uni.ROWS], sizes[uni.COLS], numbers[uni.PARTS]
            width, height = sizes[uni.WIDTH] * factor, sizes[uni.HEIGHT] * factor
            x, y = index % width, top + index // width
            table = width * height * config.place_planes
            line, near = table + index // width * width * planes, numbers[uni.NEAR]
            placed, bent = y * width * config.place_planes, rows * cols * BENT
            texture_width, texture_height = sizes[uni.LEVELS + 1], sizes[uni.LEVELS + 2]
            sheet = ti.static(DrawnSheet(point, rows, cols, parts, texture_width, texture_height, bent))
            band = ti.static(
                Band(config, samples, line, width, x, x + 1, y, y + 1, width, height, near, numbers, placed)
            )
            if listed == 0:
                clear(table + index * planes, band)
            square = y // sizes[uni.BIN_SIZE] * sizes[uni.BINS_ACROSS] + x // sizes[uni.BIN_SIZE]
            begin = starts[square] + listed
            for n in range(begin, ti.min(begin + count, starts[square + 1])):
                if reaches(entries[n], x, y, bounds):
                    cell, piece = owners[2 * entries[n]], owners[2 * entries[n] + 1]
                    whole, last = pieces[cell] == 1, ti.min(piece + together, pieces[cell])
                    part = ti.static(Part(whole, piece, last))
                    cover(cell // (cols - 1), cell % (cols - 1), part, sheet, band)
            end_thread(ended)

    @ti.kernel
    def resolve_pixels(
        first: ti.i32, end: ti.i32, ended: Integers, row: ti.i32, numbers: Floats, sizes: Integers, texels: Floats,
        samples: ti.types.ndarray(dtype=config.floats, ndim=1), colours: Bytes, labels: Floats,
    ):  # fmt: skip
        """Cover the pixels of a strip that begins at `row` with the instruments, and write them."""
        for index in range(first, end):
            width, height, rod_count = sizes[uni.WIDTH], sizes[uni.HEIGHT], sizes[uni.ROD_COUNT]
            x, y = index % width, row + index // width
            left, top, across = x * factor, y * factor, width * factor
            table = across * height * factor * config.place_planes
            line, placed = table + (y - row) * factor * across * planes, top * across * config.place_planes
            if ti.static(config.instruments):
                band = ti.static(
                    Band(
                        config, samples, line, across, left, left + factor, top, top + factor,
                        across, height * factor, numbers[uni.NEAR], numbers, placed,
                    )
                )  # fmt: skip
                cover_with_rods(rod_count, band)
            appearance = ti.static(
                Appearance(config, texels, sizes, sizes[uni.LEVELS + 1], sizes[uni.LEVELS + 2], numbers, rod_count)
            )
            pixels = width * height
            output = ti.static(PixelArrays(colours, labels, pixels))
            resolve(line, y, y + 1, x, x + 1, across, width, placed, samples, appearance, output)
            end_thread(ended)

    return cover_samples, resolve_pixels
