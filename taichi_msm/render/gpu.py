"""Kernel 2 on a GPU: every mass point, cell, sample and pixel is a thread.

A piece is an invertible cell, or a triangle of a cell that is not. A part is some consecutive pieces of a cell. Bins
(bins.py) list the parts, and each sample processes the list of its bin, in chunks that bound the time of a thread; the
nearest surface is kept between launches. Then each pixel covers its samples with the instruments and shades them. The
picture is drawn in strips of rows, with a thread per sample.
"""

from collections.abc import Callable
from functools import cache

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render import geometry
from taichi_msm.render import uniforms as uni
from taichi_msm.render.bins import BOUNDS_STRIDE, SEARCH_ROUNDS, build_bins, is_in_bounds, owner_of, store_bounds
from taichi_msm.render.config import (
    INFINITY,
    Bytes,
    DrawingConfig,
    Floats,
    Integers,
    clear_tile,
    is_present,
    read_arguments,
)
from taichi_msm.render.coverage import cover_cell, cover_instruments, store_point
from taichi_msm.render.shading import resolve
from taichi_msm.system.launches import VULKAN_THREADS, Launches, end_thread
from taichi_msm.system.runtime import compilation_options, ti, write_vectors

# Margin of bounding boxes: for rounding, and for the offset of sample centres [samples].
MARGIN = 1.5

# Maximum number of parts; a part has several pieces if there are more of them.
MAX_PARTS = 1 << 22


class Threads:
    """Memory and kernels of pictures of `size` (width, height) [px] of a sheet of `shape` (rows, cols), on a GPU."""

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
        self._strip_rows = min(max(1, VULKAN_THREADS // (samples_across * config.supersample)), height)
        self._texels = launches.upload(texels)
        self._nodes = launches.array(np.float32, rows * cols * (geometry.POINT_STRIDE + config.picture_stride))
        self._pieces = launches.array(np.int32, self._cells)
        strip = self._strip_rows * config.supersample * samples_across * config.planes
        # The undistortion map, empty without lens distortion; then the strip.
        self._samples = ti.ndarray(
            config.float_vector, height * config.supersample * samples_across * config.map_planes + strip
        )
        self._colours = launches.array(np.uint8, 3 * width * height if config.picture else 1)
        self._labels = launches.array(np.float32, max(config.values_per_pixel * width * height, 1))

    def set_undistortion_map(self, table: NDArray[np.float32]) -> None:
        """Set the undistortion map of the following pictures, as returned by `undistortion_map`."""
        write_vectors(self._samples, table.reshape(-1, 1))

    def draw(
        self, position: NDArray[np.float32], uniforms: NDArray[np.float32], sizes: NDArray[np.int32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return colours, shape (height, width, 3), and values for `labels_of`; undefined unless configured."""
        launches, factor = Launches(bounded=True), self._config.supersample
        (width, height), instruments = self._size, int(sizes[uni.INSTRUMENT_COUNT])
        samples_across, samples_down = width * factor, height * factor
        view_arrays = launches.upload(uniforms), launches.upload(sizes)
        with compilation_options(optimised=False):
            self._project(position, *view_arrays, self._nodes, self._pieces)
        pieces = launches.download(self._pieces)
        pieces_per_part = max(1, min(-(-int(pieces.sum(dtype=np.int64)) // MAX_PARTS), int(pieces.max())))
        # A cell behind the eye or without sheet is one empty part.
        ends = np.cumsum(np.maximum(-(-pieces // pieces_per_part), 1), dtype=np.int32)
        parts = int(ends[-1])
        owners, bounds = launches.array(np.int32, 2 * parts), launches.array(np.int32, BOUNDS_STRIDE * parts)
        launches.launch(
            self._bound, parts, pieces_per_part, *view_arrays, launches.upload(ends), self._nodes, self._pieces,
            owners, bounds,
            rounds=SEARCH_ROUNDS + pieces_per_part,
        )  # fmt: skip
        bin_size = max(8, round((samples_across * samples_down / self._cells) ** 0.5))
        bins = build_bins(launches, bounds, parts, (samples_across, samples_down), bin_size)
        sizes[[uni.BIN_SIZE, uni.BINS_ACROSS]] = bins.size, bins.columns
        view_arrays = view_arrays[0], launches.upload(sizes)
        # Iterations of a sample: one per part, and three per piece, for the piece and its tiles.
        rounds_of_part = 1 + 3 * pieces_per_part
        rounds_of_instruments = instruments * (1 + factor * (1 + factor))
        rounds_of_shading = factor * (1 + factor * (1 + int(sizes[uni.LEVEL_COUNT]) + instruments)) + 2
        for row in range(0, height, self._strip_rows):
            rows = min(self._strip_rows, height - row)
            top, bottom = row * factor, (row + rows) * factor
            longest = int(bins.lengths[top // bins.size : (bottom - 1) // bins.size + 1].max())
            for chunk_start, chunk_size in launches.chunks(longest, rounds_of_part):
                launches.launch(
                    self._cover, rows * factor * samples_across,
                    top, chunk_start, chunk_size, pieces_per_part, *view_arrays, self._nodes, self._pieces, owners,
                    bounds, bins.starts, bins.entries, self._samples,
                    rounds=chunk_size * rounds_of_part,
                )  # fmt: skip
            launches.launch(
                self._resolve, rows * width,
                row, *view_arrays, self._texels, self._samples, self._colours, self._labels,
                rounds=rounds_of_instruments + rounds_of_shading,
            )  # fmt: skip
        launches.require_completion()
        colours = launches.download(self._colours) if self._config.picture else np.empty(0, np.uint8)
        return colours.reshape(-1, width, 3), launches.download(self._labels)


@cache
def _sheet_kernels(config: DrawingConfig) -> tuple[Callable[..., None], Callable[..., None]]:
    """Return the kernels that project the sheet and compute the bounding boxes of its parts."""

    @ti.kernel
    def project_points(
        position: ti.types.ndarray(dtype=ti.f32, ndim=3), uniforms: Floats, sizes: Integers, nodes: Floats,
        pieces: Integers,
    ):  # fmt: skip
        """Project the mass points, and count the pieces of each cell.

        A cell has one piece if it is invertible, one per triangle if not, and none behind the eye or without sheet.
        """
        for index in range(sizes[uni.ROWS] * sizes[uni.COLS]):
            picture = ti.static(read_arguments(uniforms, sizes, nodes, (), config))
            store_point(position, index // picture.cols, index % picture.cols, picture)

        for cell in range((sizes[uni.ROWS] - 1) * (sizes[uni.COLS] - 1)):
            cols, subdivisions = sizes[uni.COLS], ti.cast(uniforms[uni.SUBDIVISIONS], ti.i32)
            corner = geometry.corner_entry(cell, cols)
            outline = ti.static(geometry.cell_outline(corner, cols, uniforms[uni.NEAR], nodes))
            missing = outline.behind
            if ti.static(config.masked):
                missing = missing or not is_present(cell, sizes)
            pieces[cell] = ti.select(
                missing, 0, ti.select(geometry.is_invertible(outline), 1, 2 * subdivisions * subdivisions)
            )

    @ti.kernel
    def bound(
        first: ti.i32, end: ti.i32, ended: Integers, pieces_per_part: ti.i32, uniforms: Floats, sizes: Integers,
        ends: Integers, nodes: Floats, pieces: Integers, owners: Integers, bounds: Integers,
    ):  # fmt: skip
        """Compute the cell and the first piece (`owners`, shape (2 * parts,)) and the bounding box [samples] of parts.

        `ends` is the number of parts up to and including each cell.
        """
        for item in range(first, end):
            picture = ti.static(read_arguments(uniforms, sizes, nodes, (), config))
            cols, width, height = picture.cols, picture.width, picture.height
            cell = owner_of(item, (picture.rows - 1) * (cols - 1), ends)
            parts_of_cell = ti.max((pieces[cell] + pieces_per_part - 1) // pieces_per_part, 1)
            piece = (item - ends[cell] + parts_of_cell) * pieces_per_part
            owners[2 * item], owners[2 * item + 1] = cell, piece
            corner = geometry.corner_entry(cell, cols)
            outline = ti.static(geometry.cell_outline(corner, cols, picture.near, nodes))
            left, right, top, bottom = outline.left, outline.right, outline.top, outline.bottom
            if ti.static(config.has_distortion):
                _, _, distorted_entry = geometry.point_entries(corner // geometry.NODE_STRIDE, picture)
                left, right, top, bottom = geometry.distorted_cell_bounds(
                    distorted_entry, cols, outline, uniforms, nodes
                )
            if pieces[cell] != 1:
                left, right, top, bottom = INFINITY, -INFINITY, INFINITY, -INFINITY
                patch = ti.static(geometry.cell_patch(corner, cols, outline.facing, False, nodes, False))
                subdivisions = ti.cast(picture.subdivisions, ti.i32)
                for triangle in range(piece, ti.min(piece + pieces_per_part, pieces[cell])):
                    s, t = ti.cast(triangle // 2 % subdivisions, ti.f32), ti.cast(triangle // 2 // subdivisions, ti.f32)
                    low_x, high_x, low_y, high_y, _ = geometry.triangle_bounds(
                        s, t, triangle % 2 == 0, 1.0 / picture.subdivisions, picture.near, width, height,
                        patch, uniforms, config.lens,
                    )  # fmt: skip
                    if not high_x < low_x:
                        # A triangle with NaN bounds may be anywhere.
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
    factor = config.supersample

    @ti.func
    def band_of(x, y, across, strip_row, picture: ti.template()):
        """Return the band of `across` x `across` samples at (x, y), in the strip that begins at row `strip_row`."""
        samples_of_map = picture.width * picture.height * config.map_planes
        first = samples_of_map + (y - strip_row) * picture.width * config.planes
        map_start = y * picture.width * config.map_planes
        right, bottom = x + across, y + across
        return ti.static(picture._replace(first=first, map_start=map_start, left=x, right=right, top=y, bottom=bottom))

    @ti.kernel
    def cover_samples(
        first: ti.i32, end: ti.i32, ended: Integers, top: ti.i32, chunk_start: ti.i32, chunk_size: ti.i32,
        pieces_per_part: ti.i32, uniforms: Floats, sizes: Integers, nodes: Floats, pieces: Integers, owners: Integers,
        bounds: Integers, starts: Integers, entries: Integers,
        samples: ti.types.ndarray(dtype=config.float_vector, ndim=1),
    ):  # fmt: skip
        """Cover the samples of a strip, which begins at row `top`, with a chunk of the parts in their bins.

        The chunk begins at position `chunk_start` of each list; at 0 the samples are cleared.
        """
        for index in range(first, end):
            picture = ti.static(read_arguments(uniforms, sizes, nodes, samples, config))
            x, y = index % picture.width, top + index // picture.width
            band = ti.static(band_of(x, y, 1, top, picture))
            if chunk_start == 0:
                clear_tile(band.first + x * config.planes, band)
            bin_index = y // sizes[uni.BIN_SIZE] * sizes[uni.BINS_ACROSS] + x // sizes[uni.BIN_SIZE]
            begin = starts[bin_index] + chunk_start
            for n in range(begin, ti.min(begin + chunk_size, starts[bin_index + 1])):
                if is_in_bounds(entries[n], x, y, bounds):
                    cell, piece = owners[2 * entries[n]], owners[2 * entries[n] + 1]
                    end_piece = ti.min(piece + pieces_per_part, pieces[cell])
                    corner = geometry.corner_entry(cell, band.cols)
                    outline = ti.static(geometry.cell_outline(corner, band.cols, band.near, nodes))
                    i, j = cell // (band.cols - 1), cell % (band.cols - 1)
                    cover_cell(i, j, pieces[cell] == 1, piece, end_piece, outline, band)
            end_thread(ended)

    @ti.kernel
    def resolve_pixels(
        first: ti.i32, end: ti.i32, ended: Integers, row: ti.i32, uniforms: Floats, sizes: Integers, texels: Floats,
        samples: ti.types.ndarray(dtype=config.float_vector, ndim=1), colours: Bytes, labels: Floats,
    ):  # fmt: skip
        """Cover the pixels of a strip, which begins at `row`, with the instruments; write their colours and labels."""
        for index in range(first, end):
            picture = ti.static(read_arguments(uniforms, sizes, (), samples, config))
            x, y = index % sizes[uni.WIDTH], row + index // sizes[uni.WIDTH]
            band = ti.static(band_of(x * factor, y * factor, factor, row * factor, picture))
            if ti.static(len(config.shapes) > 0):
                cover_instruments(band)
            resolve(y, y + 1, x, x + 1, texels, colours, labels, band)
            end_thread(ended)

    return cover_samples, resolve_pixels
