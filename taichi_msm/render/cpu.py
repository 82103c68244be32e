"""Kernel 2 on a CPU: the picture is divided into bands of rows, which the workers process one by one.

The G-buffer of a band fits into the cache. No two workers write the same sample, so no locks are needed.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render import geometry
from taichi_msm.render import uniforms as uni
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
from taichi_msm.render.undistortion import INVALID_COORDINATE
from taichi_msm.system import runtime
from taichi_msm.system.runtime import ITERATIONS_PER_THREAD, ti


class Bands:
    """Memory and kernel of pictures of `size` (width, height) [px] of a sheet of `shape` (rows, cols), on a CPU."""

    def __init__(
        self, config: DrawingConfig, shape: tuple[int, int], size: tuple[int, int], texels: NDArray[np.float32]
    ) -> None:
        self._config, self._size, self._texels = config, size, texels
        self._draw = _kernel(config)
        (rows, cols), (width, height) = shape, size
        self._workers = min(-(-height // config.band_rows), runtime.current_device().threads)
        self._memory = memory = runtime.Memory()
        # Projected mass points; then, for each row of them, the first and last row of the undistorted picture.
        self._nodes = memory.array("f32", 0, rows * (cols * (geometry.POINT_STRIDE + config.picture_stride) + 2))
        tiles_of_band = config.band_lines * config.tiles_across(width)
        # The undistortion map, in which each band ends with its bounds; then the G-buffer of a band per worker.
        map_vectors = -(-height // config.band_rows) * (tiles_of_band * config.map_planes + config.has_distortion)
        self._samples = memory.array("f32", config.lanes, map_vectors + self._workers * tiles_of_band * config.planes)

    def set_undistortion_map(self, table: NDArray[np.float32]) -> None:
        """Set the undistortion map of the following pictures, as returned by `undistortion_map`."""
        runtime.write_vectors(self._samples, _tiled_map(table, self._config))

    def draw(
        self, position: NDArray[np.float32], uniforms: NDArray[np.float32], sizes: NDArray[np.int32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Return colours, shape (height, width, 3), and values for `labels_of`; undefined unless configured."""
        config, (width, height) = self._config, self._size
        # Tiles are written completely, and the last one of a row may extend beyond the picture.
        stride = config.tiles_across(width) * config.tile_width if config.writes_words else width
        picture = np.empty((height, stride, 3) if config.picture else (1, 4, 3), np.uint8)
        # Without labels the argument is unused: any Taichi array, which is passed in half the time of a NumPy array.
        labels: Any = self._nodes
        if config.values_per_pixel:
            labels = np.zeros(config.values_per_pixel * width * height, np.float32)
        sizes[[uni.ROWS_TAKEN, uni.ROWS_PROJECTED, uni.BANDS_TAKEN]] = 0
        with runtime.compilation_options(optimised=False):
            self._draw(
                position, self._texels, uniforms, self._workers, sizes, self._nodes, self._samples,
                picture.ravel().view(np.int32) if config.writes_words else picture.ravel(), labels,
            )  # fmt: skip
        return picture[:, :width], labels


def _tiled_map(table: NDArray[np.float32], config: DrawingConfig) -> NDArray[np.float32]:
    """Arrange an undistortion map in bands of tiles; append the box of its samples to each tile and to each band."""
    rows, columns, planes = table.shape
    band_height, lines = config.band_rows * config.supersample, config.band_lines
    tile_height, tile_width = config.tile_height, config.tile_width
    bands, tiles_across = -(-rows // band_height), -(-columns // tile_width)
    padding = (0, bands * band_height - rows), (0, tiles_across * tile_width - columns), (0, 0)
    padded = np.pad(table, padding, constant_values=INVALID_COORDINATE).reshape(bands, band_height, -1, planes)
    padding_of_lines = (0, 0), (0, lines * tile_height - band_height), (0, 0), (0, 0)
    padded = np.pad(padded, padding_of_lines, constant_values=INVALID_COORDINATE)
    tiles = padded.reshape(bands, lines, tile_height, tiles_across, tile_width, planes).transpose(0, 1, 3, 5, 2, 4)
    tiles = tiles.reshape(bands, lines, tiles_across, planes, config.lanes)
    positions = tiles[..., :2, :]
    low, high = positions.min(axis=-1), np.where(positions < INVALID_COORDINATE, positions, -np.inf).max(axis=-1)
    # A tile without valid coordinates has an invalid box.
    boxes = np.stack([low, np.maximum(low, high)], axis=-1).reshape(bands, lines, tiles_across, 1, 4)
    band_boxes = np.stack([low.min(axis=(1, 2)), high.max(axis=(1, 2))], axis=-1).reshape(bands, 1, 4)
    boxes, band_boxes = (
        np.pad(box, [*[(0, 0)] * (box.ndim - 1), (0, config.lanes - 4)]) for box in (boxes, band_boxes)
    )
    vectors = np.concatenate([tiles, boxes], axis=3).reshape(bands, -1, config.lanes)
    return np.concatenate([vectors, band_boxes], axis=1).reshape(-1, config.lanes)


@ti.func
def _project_row(position: ti.template(), i, band: ti.template()):
    """Project a row of mass points, and store the first and last row of the undistorted picture that it overlaps."""
    cols, nodes = ti.static((band.cols, band.nodes))
    first_row, last_row = INFINITY, -INFINITY
    for j in range(cols):
        store_point(position, i, j, band)
        entry = (i * cols + j) * geometry.NODE_STRIDE
        if nodes[entry + 2] > band.near:
            first_row = ti.min(first_row, nodes[entry + geometry.SCREEN + 1])
            last_row = ti.max(last_row, nodes[entry + geometry.SCREEN + 1])
        else:
            first_row, last_row = -INFINITY, INFINITY
    row_entry = band.rows * cols * (geometry.POINT_STRIDE + band.config.picture_stride) + 2 * i
    nodes[row_entry] = first_row
    nodes[row_entry + 1] = last_row


@ti.func
def _project_all(position: ti.template(), band: ti.template()):
    """Project all mass points, row by row, shared among the workers; return when every row is finished.

    A worker waits only for rows that a running worker has taken, so a worker that starts late does not delay others.
    """
    sizes = ti.static(band.sizes)
    has_row = True
    while has_row:
        i = ti.atomic_add(sizes[uni.ROWS_TAKEN], 1)
        has_row = i < band.rows
        if has_row:
            _project_row(position, i, band)
            ti.atomic_add(sizes[uni.ROWS_PROJECTED], 1)
    finished = ti.atomic_add(sizes[uni.ROWS_PROJECTED], 0)
    while finished < band.rows:
        finished = ti.atomic_add(sizes[uni.ROWS_PROJECTED], 0)


@ti.func
def _cover_band(band: ti.template()):
    """Cover the samples of a band with the sheet."""
    config, cols, nodes = ti.static((band.config, band.cols, band.nodes))
    lines = (band.bottom - band.top + config.tile_height - 1) // config.tile_height
    for tile in range(lines * band.tiles_across):
        clear_tile(band.first + tile * config.planes, band)
    # First and last row of the band in the undistorted picture.
    top, bottom = ti.cast(band.top, ti.f32), ti.cast(band.bottom, ti.f32)
    if ti.static(config.has_distortion):
        box = band.samples[band.map_start + config.band_lines * config.map_planes * band.tiles_across]
        top, bottom = box[2] - 1.0, box[3] + 1.0
    subdivisions = ti.cast(band.subdivisions, ti.i32)
    for i in range(band.rows - 1):
        row_entry = band.rows * cols * (geometry.POINT_STRIDE + band.config.picture_stride) + 2 * i
        first_row = ti.min(nodes[row_entry], nodes[row_entry + 2])
        last_row = ti.max(nodes[row_entry + 1], nodes[row_entry + 3])
        if first_row < bottom and last_row > top:
            for j in range(cols - 1):
                overlaps = True
                if ti.static(config.masked):
                    overlaps = is_present(i * (cols - 1) + j, band.sizes)
                corner, _, distorted_entry = geometry.point_entries(i * cols + j, band)
                if ti.static(config.has_distortion):
                    overlaps = overlaps and geometry.may_cover_rows(
                        corner, distorted_entry, cols, band.top, band.bottom, band.uniforms, nodes
                    )
                if overlaps:
                    outline = ti.static(geometry.cell_outline(corner, cols, band.near, nodes))
                    invertible = geometry.is_invertible(outline)
                    pieces = ti.select(invertible, 1, 2 * subdivisions * subdivisions)
                    cover_cell(i, j, invertible, 0, pieces, outline, band)


@cache
def _kernel(config: DrawingConfig) -> Callable[..., None]:
    @ti.kernel
    def draw(
        position: ti.types.ndarray(dtype=ti.f32, ndim=3), texels: Floats, uniforms: Floats, workers: ti.i32,
        sizes: Integers, nodes: Floats, samples: ti.types.ndarray(dtype=config.float_vector, ndim=1),
        colours: Integers if config.writes_words else Bytes, labels: Floats,
    ):  # fmt: skip
        """Draw the picture, the labels or both, as configured; the counters in `sizes` are 0 at the start."""
        for index in range(workers * ITERATIONS_PER_THREAD):
            if index % ITERATIONS_PER_THREAD == 0:
                picture = ti.static(read_arguments(uniforms, sizes, nodes, samples, config))
                # In this loop, because the start of another one takes longer than projecting a sheet of usual size.
                _project_all(position, picture)
                height = sizes[uni.HEIGHT]
                tiles_of_band = picture.tiles_across * config.band_lines
                map_vectors = tiles_of_band * config.map_planes + int(config.has_distortion)
                map_end = (height + config.band_rows - 1) // config.band_rows * map_vectors
                first = map_end + index // ITERATIONS_PER_THREAD * tiles_of_band * config.planes
                # Bands are taken one by one, so that others take those of a delayed worker.
                has_band = True
                while has_band:
                    row = ti.atomic_add(sizes[uni.BANDS_TAKEN], 1) * config.band_rows
                    has_band = row < height
                    if has_band:
                        end_row = ti.min(row + config.band_rows, height)
                        top, bottom = row * config.supersample, end_row * config.supersample
                        map_start = row // config.band_rows * map_vectors
                        band = ti.static(
                            picture._replace(
                                first=first, map_start=map_start, right=picture.width, top=top, bottom=bottom
                            )
                        )
                        _cover_band(band)
                        if ti.static(len(config.shapes) > 0):
                            cover_instruments(band)
                        resolve(row, end_row, 0, sizes[uni.WIDTH], texels, colours, labels, band)

    return draw
