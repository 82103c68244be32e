"""Kernel 2 on a GPU: every mass point, cell, sample and pixel is a thread.

A part is a cell, or some triangles of a cell that is drawn triangle by triangle. Parts are listed in bins (bins.py).
Each sample processes the list of its bin, in several launches if necessary to bound the time of a thread; the nearest
surface is kept between launches. Then each pixel covers its samples with the instruments and shades them. The picture
is drawn in strips of rows, with a thread per sample.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render import uniforms as uni
from taichi_msm.render.bins import BOUNDS_STRIDE, SEARCH_ROUNDS, build_bins, is_in_bounds, owner_of, store_bounds
from taichi_msm.render.config import INFINITY, Band, Bytes, DrawingConfig, Floats, Integers, clear_tile
from taichi_msm.render.coverage import NORMAL_STRIDE, DrawnSheet, Part, cover_cell, cover_instruments, store_normal
from taichi_msm.render.geometry import (
    NODE_STRIDE,
    cell_outline,
    cell_patch,
    corner_entry,
    distorted_cell_bounds,
    is_invertible,
    project,
    triangle_bounds,
)
from taichi_msm.render.labels import label_offsets
from taichi_msm.render.lens_kernels import DISTORTED_STRIDE, store_distorted
from taichi_msm.render.shading import Appearance, PixelArrays, resolve
from taichi_msm.system.launches import VULKAN_THREADS, Launches, end_thread
from taichi_msm.system.runtime import compilation_options, ti, write_vectors

# Margin of bounding boxes for rounding and for the centres of samples [samples].
MARGIN = 1.5

# Maximum number of parts; if there are more triangles, a part has several of them.
MAX_PARTS = 1 << 22

# Numbers per mass point, without the distorted ones.
UNDISTORTED_STRIDE = NODE_STRIDE + NORMAL_STRIDE


class Threads:
    """Memory and kernels of one sheet's pictures on a GPU; arguments as for `cpu.Bands`."""

    def __init__(
        self, config: DrawingConfig, shape: tuple[int, int], size: tuple[int, int], texels: NDArray[np.float32]
    ) -> None:
        self._config, self._size = config, size
        self._project, self._bound = _sheet_kernels(config)
        self._cover, self._resolve = _picture_kernels(config)
        launches = Launches(bounded=True)
        (rows, cols), (width, height) = shape, size
        self._cells = (rows - 1) * (cols - 1)
        samples_across = width * config.supersample
        # Rows of pixels in a strip.
        self._rows = min(max(1, VULKAN_THREADS // (samples_across * config.supersample)), height)
        self._texels = launches.upload(texels)
        self._nodes = launches.array(np.float32, rows * cols * (UNDISTORTED_STRIDE + DISTORTED_STRIDE))
        self._pieces = launches.array(np.int32, self._cells)
        strip = self._rows * config.supersample * samples_across * config.planes
        # With lens distortion the undistortion map comes before the strip.
        self._samples = ti.ndarray(
            config.float_vector, height * config.supersample * samples_across * config.map_planes + strip
        )
        self._colours = launches.array(np.uint8, 3 * width * height if config.picture else 1)
        label_count = label_offsets(config.labels)[""]
        self._labels = launches.array(np.float32, max(label_count * width * height, 1))

    def set_undistortion_map(self, table: NDArray[np.float32]) -> None:
        """Set the undistortion map of the following pictures, as returned by `undistortion_map`."""
        write_vectors(self._samples, table.reshape(-1, 1))

    def draw(
        self, position: NDArray[np.float32], uniforms: NDArray[np.float32], sizes: NDArray[np.int32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Draw the picture, the labels or both, like `cpu.Bands.draw`.

        Raises:
            DeviceError: when the device ended a thread early.
        """
        launches, factor = Launches(bounded=True), self._config.supersample
        (width, height), instruments = self._size, int(sizes[uni.INSTRUMENT_COUNT])
        samples_across, samples_down = width * factor, height * factor
        view = launches.upload(uniforms), launches.upload(sizes)
        with compilation_options(optimised=False):
            self._project(position, *view, self._nodes, self._pieces)
        pieces = launches.download(self._pieces)
        pieces_per_part = max(1, min(-(-int(pieces.sum(dtype=np.int64)) // MAX_PARTS), int(pieces.max())))
        # A cell behind the eye is one empty part.
        ends = np.cumsum(np.maximum(-(-pieces // pieces_per_part), 1), dtype=np.int32)
        parts = int(ends[-1])
        owners, bounds = launches.array(np.int32, 2 * parts), launches.array(np.int32, BOUNDS_STRIDE * parts)
        launches.launch(
            self._bound, parts, pieces_per_part, *view, launches.upload(ends), self._nodes, self._pieces,
            owners, bounds,
            rounds=SEARCH_ROUNDS + pieces_per_part,
        )  # fmt: skip
        bin_size = max(8, round((samples_across * samples_down / self._cells) ** 0.5))
        bins = build_bins(launches, bounds, parts, (samples_across, samples_down), bin_size)
        sizes[[uni.BIN_SIZE, uni.BINS_ACROSS]] = bins.size, bins.columns
        view = view[0], launches.upload(sizes)
        # Iterations per sample: one per part, and three per triangle, for the triangle and its tiles.
        rounds_of_part = 1 + 3 * pieces_per_part
        rounds_of_instruments = instruments * (1 + factor * (1 + factor))
        rounds_of_shading = factor * (1 + factor * (1 + int(sizes[uni.LEVEL_COUNT]) + instruments)) + 2
        for row in range(0, height, self._rows):
            rows = min(self._rows, height - row)
            top, bottom = row * factor, (row + rows) * factor
            longest = int(bins.lengths[top // bins.size : (bottom - 1) // bins.size + 1].max())
            for listed, count in launches.chunks(longest, rounds_of_part):
                launches.launch(
                    self._cover, rows * factor * samples_across,
                    top, listed, count, pieces_per_part, *view, self._nodes, self._pieces, owners, bounds,
                    bins.starts, bins.entries, self._samples,
                    rounds=count * rounds_of_part,
                )  # fmt: skip
            launches.launch(
                self._resolve, rows * width,
                row, *view, self._texels, self._samples, self._colours, self._labels,
                rounds=rounds_of_instruments + rounds_of_shading,
            )  # fmt: skip
        launches.require_completion()
        colours = launches.download(self._colours) if self._config.picture else np.empty(0, np.uint8)
        return colours.reshape(-1, width, 3), launches.download(self._labels)


@cache
def _sheet_kernels(config: DrawingConfig) -> tuple[Callable[..., None], Callable[..., None]]:
    """Return the kernels that project the sheet and compute the bounding boxes of its parts."""
    factor = config.supersample

    @ti.kernel
    def project_points(
        position: ti.types.ndarray(dtype=ti.f32, ndim=3), uniforms: Floats, sizes: Integers, nodes: Floats,
        pieces: Integers,
    ):  # fmt: skip
        """Project the mass points, and count the pieces of each cell.

        A cell has 1 piece if its bilinear map is inverted, otherwise one per triangle, and 0 behind the eye.
        """
        for index in range(sizes[uni.ROWS] * sizes[uni.COLS]):
            rows, cols = sizes[uni.ROWS], sizes[uni.COLS]
            project(position, index // cols, index % cols, cols, uniforms, nodes, False)
            store_normal(position, index // cols, index % cols, rows, cols, config, uniforms, nodes)
            if ti.static(config.has_distortion):
                distorted_entry = rows * cols * UNDISTORTED_STRIDE + index * DISTORTED_STRIDE
                store_distorted(distorted_entry, index * NODE_STRIDE, uniforms, nodes, config.lens)

        for cell in range((sizes[uni.ROWS] - 1) * (sizes[uni.COLS] - 1)):
            cols, subdivisions = sizes[uni.COLS], ti.cast(uniforms[uni.SUBDIVISIONS], ti.i32)
            outline = ti.static(cell_outline(corner_entry(cell, cols), cols, uniforms[uni.NEAR], nodes))
            pieces[cell] = ti.select(
                outline.behind, 0, ti.select(is_invertible(outline), 1, 2 * subdivisions * subdivisions)
            )

    @ti.kernel
    def bound(
        first: ti.i32, end: ti.i32, ended: Integers, pieces_per_part: ti.i32, uniforms: Floats, sizes: Integers,
        ends: Integers, nodes: Floats, pieces: Integers, owners: Integers, bounds: Integers,
    ):  # fmt: skip
        """Compute the cell, the first piece and the bounding box [samples] of parts.

        Args:
            pieces_per_part: maximum number of pieces in a part.
            ends: cumulative number of parts up to and including each cell.
            pieces: number of pieces of each cell.
            owners: cell and first piece of each part, written.
            bounds: bounding box of each part, written.
        """
        for item in range(first, end):
            cols, width, height = sizes[uni.COLS], sizes[uni.WIDTH] * factor, sizes[uni.HEIGHT] * factor
            cell = owner_of(item, (sizes[uni.ROWS] - 1) * (cols - 1), ends)
            parts_of_cell = ti.max((pieces[cell] + pieces_per_part - 1) // pieces_per_part, 1)
            piece = (item - ends[cell] + parts_of_cell) * pieces_per_part
            owners[2 * item], owners[2 * item + 1] = cell, piece
            outline = ti.static(cell_outline(corner_entry(cell, cols), cols, uniforms[uni.NEAR], nodes))
            left, right, top, bottom = outline.left, outline.right, outline.top, outline.bottom
            if ti.static(config.has_distortion):
                distorted_entry = (
                    sizes[uni.ROWS] * cols * UNDISTORTED_STRIDE
                    + corner_entry(cell, cols) // NODE_STRIDE * DISTORTED_STRIDE
                )
                left, right, top, bottom = distorted_cell_bounds(distorted_entry, cols, outline, uniforms, nodes)
            if pieces[cell] != 1:
                left, right, top, bottom = INFINITY, -INFINITY, INFINITY, -INFINITY
                patch = ti.static(cell_patch(corner_entry(cell, cols), cols, outline.facing, False, nodes, False))
                subdivisions = ti.cast(uniforms[uni.SUBDIVISIONS], ti.i32)
                for triangle in range(piece, ti.min(piece + pieces_per_part, pieces[cell])):
                    s, t = ti.cast(triangle // 2 % subdivisions, ti.f32), ti.cast(triangle // 2 // subdivisions, ti.f32)
                    low_x, high_x, low_y, high_y, _ = triangle_bounds(
                        s, t, triangle % 2 == 0, 1.0 / uniforms[uni.SUBDIVISIONS], uniforms[uni.NEAR], width, height,
                        patch, uniforms, config.lens,
                    )  # fmt: skip
                    if not high_x < low_x:
                        # With NaN bounds the triangle may be anywhere.
                        if not (low_x <= high_x and low_y <= high_y):
                            low_x, high_x, low_y, high_y = -INFINITY, INFINITY, -INFINITY, INFINITY
                        left, right = ti.min(left, low_x), ti.max(right, high_x)
                        top, bottom = ti.min(top, low_y), ti.max(bottom, high_y)
            store_bounds(item, left - MARGIN, right + MARGIN, top - MARGIN, bottom + MARGIN, width, height, bounds)
            end_thread(ended)

    return project_points, bound


@cache
def _picture_kernels(config: DrawingConfig) -> tuple[Callable[..., None], Callable[..., None]]:
    """Return the kernels that cover the samples of a strip and shade its pixels."""
    factor, planes = config.supersample, config.planes

    @ti.kernel
    def cover_samples(
        first: ti.i32, end: ti.i32, ended: Integers, top: ti.i32, listed: ti.i32, count: ti.i32,
        pieces_per_part: ti.i32, uniforms: Floats, sizes: Integers, nodes: Floats, pieces: Integers, owners: Integers,
        bounds: Integers, starts: Integers, entries: Integers,
        samples: ti.types.ndarray(dtype=config.float_vector, ndim=1),
    ):  # fmt: skip
        """Cover the samples of a strip with a chunk of the parts in their bins.

        Args:
            top: first row of samples of the strip.
            listed: position of the first part in its list.
            count: number of parts.
            pieces_per_part: maximum number of pieces in a part.
            pieces: number of pieces of each cell.
            owners: cell and first piece of each part.
            bounds: bounding box of each part.
            starts: start of the list of each bin.
            entries: parts of all lists.
        """
        for index in range(first, end):
            rows, cols, subdivisions = sizes[uni.ROWS], sizes[uni.COLS], uniforms[uni.SUBDIVISIONS]
            width, height = sizes[uni.WIDTH] * factor, sizes[uni.HEIGHT] * factor
            x, y = index % width, top + index // width
            table = width * height * config.map_planes
            line, near = table + index // width * width * planes, uniforms[uni.NEAR]
            map_start, distorted_start = y * width * config.map_planes, rows * cols * UNDISTORTED_STRIDE
            texture_width, texture_height = sizes[uni.LEVELS + 1], sizes[uni.LEVELS + 2]
            sheet = ti.static(
                DrawnSheet(nodes, rows, cols, subdivisions, texture_width, texture_height, distorted_start)
            )
            band = ti.static(
                Band(config, samples, line, width, x, x + 1, y, y + 1, width, height, near, uniforms, map_start)
            )
            if listed == 0:
                clear_tile(table + index * planes, band)
            bin_index = y // sizes[uni.BIN_SIZE] * sizes[uni.BINS_ACROSS] + x // sizes[uni.BIN_SIZE]
            begin = starts[bin_index] + listed
            for n in range(begin, ti.min(begin + count, starts[bin_index + 1])):
                if is_in_bounds(entries[n], x, y, bounds):
                    cell, piece = owners[2 * entries[n]], owners[2 * entries[n] + 1]
                    is_inverted, end_piece = pieces[cell] == 1, ti.min(piece + pieces_per_part, pieces[cell])
                    part = ti.static(Part(is_inverted, piece, end_piece))
                    cover_cell(cell // (cols - 1), cell % (cols - 1), part, sheet, band)
            end_thread(ended)

    @ti.kernel
    def resolve_pixels(
        first: ti.i32, end: ti.i32, ended: Integers, row: ti.i32, uniforms: Floats, sizes: Integers, texels: Floats,
        samples: ti.types.ndarray(dtype=config.float_vector, ndim=1), colours: Bytes, labels: Floats,
    ):  # fmt: skip
        """Cover the pixels of a strip, which begins at `row`, with the instruments; write their colours and labels."""
        for index in range(first, end):
            width, height, instrument_count = sizes[uni.WIDTH], sizes[uni.HEIGHT], sizes[uni.INSTRUMENT_COUNT]
            x, y = index % width, row + index // width
            left, top, samples_across = x * factor, y * factor, width * factor
            table = samples_across * height * factor * config.map_planes
            line = table + (y - row) * factor * samples_across * planes
            map_start = top * samples_across * config.map_planes
            if ti.static(len(config.shapes) > 0):
                band = ti.static(
                    Band(
                        config, samples, line, samples_across, left, left + factor, top, top + factor,
                        samples_across, height * factor, uniforms[uni.NEAR], uniforms, map_start,
                    )
                )  # fmt: skip
                cover_instruments(instrument_count, band)
            appearance = ti.static(
                Appearance(
                    config, texels, sizes, sizes[uni.LEVELS + 1], sizes[uni.LEVELS + 2], uniforms, instrument_count
                )
            )
            pixels = width * height
            output = ti.static(PixelArrays(colours, labels, pixels))
            resolve(line, y, y + 1, x, x + 1, samples_across, width, map_start, samples, appearance, output)
            end_thread(ended)

    return cover_samples, resolve_pixels
