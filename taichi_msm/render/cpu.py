"""Kernel 2 on a CPU: the picture is cut into bands of rows, which workers take one after the other.

What is kept of a band fits into the cache, and no two workers write to one sample, so they need no locks.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render import uniforms as uni
from taichi_msm.render.config import INFINITY, Band, Bytes, DrawingConfig, Floats, Integers, clear_tile
from taichi_msm.render.coverage import NORMAL_STRIDE, DrawnSheet, cover_capsules, cover_cell, store_normal
from taichi_msm.render.geometry import NODE_STRIDE, SCREEN, may_cover_rows, project
from taichi_msm.render.labels import label_numbers
from taichi_msm.render.lens_kernels import DISTORTED_STRIDE, store_distorted
from taichi_msm.render.lens_table import bounds, tiled_map
from taichi_msm.render.shading import Appearance, PixelArrays, resolve
from taichi_msm.system.runtime import ITERATIONS_PER_THREAD, Memory, our_compilation, started, ti, write

# The numbers that are stored of all mass points come first; then, for every row of them, its highest and its lowest
# place in the picture, without distortion.
STORED = NODE_STRIDE + NORMAL_STRIDE


class Bands:
    """The memory of one sheet's pictures on a CPU, and their kernel.

    The sheet has rows and columns of `points`, the picture is of this width and height [px]; texels are from `pyramid`.
    """

    def __init__(
        self, config: DrawingConfig, points: tuple[int, int], size: tuple[int, int], texels: NDArray[np.float32]
    ) -> None:
        self._config, self._size, self._texels = config, size, texels
        self._draw = _kernel(config)
        (rows, cols), (width, height) = points, size
        self._workers = min(-(-height // config.band_rows), started().threads)
        self._memory = memory = Memory()
        self._nodes = memory.array("f32", 0, rows * (cols * (STORED + DISTORTED_STRIDE * config.has_distortion) + 2))
        band_vectors = config.band_lines * config.tiles_across(width) * config.planes
        # Before the bands are the places of all samples, if there is a lens.
        self._table = -(-height // config.band_rows) * _map_vectors(config, width)
        self._samples = memory.array("f32", config.lanes, self._table + self._workers * band_vectors)

    def place(self, places: NDArray[np.float32]) -> None:
        """Take the places of the samples of the pictures that follow, as of `undistortion_map`."""
        config, bands = self._config, tiled_map(places, self._config)
        rows = config.band_rows * config.supersample
        known = [bounds(places[first : first + rows, :, :2]) for first in range(0, len(places), rows)]
        last = np.pad(known, ((0, 0), (0, config.lanes - len(known[0]))))
        table = np.concatenate([bands, last[:, None].astype(np.float32)], axis=1)
        write(self._samples, table.reshape(-1, config.lanes))

    def draw(
        self, position: NDArray[np.float32], uniforms: NDArray[np.float32], sizes: NDArray[np.int32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Draw the picture, the labels or both, as the config says; `uniforms` and `sizes` are those of uniforms.py.

        Returns:
            Colours, shape (height, width, 3), and labels as `labels_of` takes them; each has meaning only if drawn.
        """
        config, (width, height) = self._config, self._size
        # Whole tiles are written, and the last of a row may reach beyond the picture.
        stride = config.tiles_across(width) * config.tile_width if config.writes_words else width
        picture = np.empty((height, stride, 3) if config.picture else (1, 4, 3), np.uint8)
        # Without labels nothing is written there; an array of Taichi's is passed in half the time of one of NumPy's.
        labels: Any = self._nodes
        if config.labels:
            labels = np.zeros(label_numbers(normals=config.normals) * width * height, np.float32)
        sizes[[uni.ROWS_TAKEN, uni.ROWS_PROJECTED, uni.BANDS_TAKEN]] = 0
        with our_compilation(optimised=False):
            self._draw(
                position, self._texels, uniforms, self._workers, sizes, self._nodes, self._samples,
                picture.ravel().view(np.int32) if config.writes_words else picture.ravel(), labels,
            )  # fmt: skip
        return picture[:, :width], labels


def _map_vectors(config: DrawingConfig, width: int) -> int:
    """Count the vectors that hold a band's places, and their bounds, in a picture of this width [px]."""
    return config.band_map_vectors * config.tiles_across(width) + 1 if config.lens else 0


@ti.func
def project_row(
    position: ti.template(), i, rows, cols, config: ti.template(), uniforms: ti.template(), nodes: ti.template()
):
    """Project a row of mass points; store how far up and down in the picture it reaches."""
    low, high = INFINITY, -INFINITY
    for j in range(cols):
        project(position, i, j, cols, uniforms, nodes, False)
        store_normal(position, i, j, rows, cols, config, uniforms, nodes)
        here = (i * cols + j) * NODE_STRIDE
        if ti.static(config.has_distortion):
            bent = rows * cols * STORED + (i * cols + j) * DISTORTED_STRIDE
            store_distorted(bent, here, uniforms, nodes, config.lens)
        if nodes[here + 2] > uniforms[uni.NEAR]:
            low = ti.min(low, nodes[here + SCREEN + 1])
            high = ti.max(high, nodes[here + SCREEN + 1])
        else:
            low, high = -INFINITY, INFINITY
    reach = rows * cols * (STORED + DISTORTED_STRIDE * config.has_distortion) + 2 * i
    nodes[reach] = low
    nodes[reach + 1] = high


@ti.func
def project_all(
    position: ti.template(), rows, cols, config: ti.template(), uniforms: ti.template(), sizes: ti.template(),
    nodes: ti.template(),
):  # fmt: skip
    """Project all rows of mass points, shared among the workers; returns when every row is done.

    A worker waits only for rows that a running worker has taken, so one that starts late holds up nobody.
    """
    taking = True
    while taking:
        i = ti.atomic_add(sizes[uni.ROWS_TAKEN], 1)
        taking = i < rows
        if taking:
            project_row(position, i, rows, cols, config, uniforms, nodes)
            ti.atomic_add(sizes[uni.ROWS_PROJECTED], 1)
    projected = ti.atomic_add(sizes[uni.ROWS_PROJECTED], 0)
    while projected < rows:
        projected = ti.atomic_add(sizes[uni.ROWS_PROJECTED], 0)


@ti.func
def cover_band(sheet: ti.template(), band: ti.template()):
    """Find what every sample of a band shows of the sheet."""
    config, nodes = ti.static((band.config, sheet.nodes))
    lines = (band.bottom - band.top + config.tile_height - 1) // config.tile_height
    for tile in range(lines * band.across):
        clear_tile(band.first + tile * config.planes, band)
    reach = sheet.rows * sheet.cols * (STORED + DISTORTED_STRIDE * config.has_distortion)
    # The rows of samples that the band shows, which without distortion are others.
    top, bottom = ti.cast(band.top, ti.f32), ti.cast(band.bottom, ti.f32)
    if ti.static(config.has_distortion):
        known = band.samples[band.map_start + config.band_map_vectors * band.across]
        top, bottom = known[2] - 1.0, known[3] + 1.0
    for i in range(sheet.rows - 1):
        row = reach + 2 * i
        low = ti.min(nodes[row], nodes[row + 2])
        high = ti.max(nodes[row + 1], nodes[row + 3])
        if low < bottom and high > top:
            for j in range(sheet.cols - 1):
                if ti.static(config.has_distortion):
                    cell = i * sheet.cols + j
                    bent = sheet.bent + cell * DISTORTED_STRIDE
                    if may_cover_rows(
                        cell * NODE_STRIDE, bent, sheet.cols, band.top, band.bottom, band.uniforms, nodes
                    ):
                        cover_cell(i, j, (), sheet, band)
                else:
                    cover_cell(i, j, (), sheet, band)


@cache
def _kernel(config: DrawingConfig) -> Callable[..., None]:
    factor = config.supersample

    @ti.kernel
    def draw(
        position: ti.types.ndarray(dtype=ti.f32, ndim=3), texels: Floats, uniforms: Floats, workers: ti.i32,
        sizes: Integers, nodes: Floats, samples: ti.types.ndarray(dtype=config.float_vector, ndim=1),
        colours: Integers if config.writes_words else Bytes, labels: Floats,
    ):  # fmt: skip
        for index in range(workers * ITERATIONS_PER_THREAD):
            if index % ITERATIONS_PER_THREAD == 0:
                rows, cols = sizes[uni.ROWS], sizes[uni.COLS]
                width, height = sizes[uni.WIDTH], sizes[uni.HEIGHT]
                # To start a loop for this alone takes longer than to project a sheet of usual size.
                project_all(position, rows, cols, config, uniforms, sizes, nodes)
                texture_width, texture_height = sizes[uni.LEVELS + 1], sizes[uni.LEVELS + 2]
                capsule_count, parts, near = sizes[uni.CAPSULE_COUNT], uniforms[uni.SUBDIVISIONS], uniforms[uni.NEAR]
                across = (width * factor + config.tile_width - 1) // config.tile_width
                first = index // ITERATIONS_PER_THREAD * across * (config.band_lines * config.planes)
                band_map_vectors = 0
                if ti.static(config.has_distortion):
                    band_map_vectors = across * config.band_map_vectors + 1
                    first += (height + config.band_rows - 1) // config.band_rows * band_map_vectors
                bent = rows * cols * STORED
                sheet = ti.static(DrawnSheet(nodes, rows, cols, parts, texture_width, texture_height, bent))
                appearance = ti.static(
                    Appearance(config, texels, sizes, texture_width, texture_height, uniforms, capsule_count)
                )
                pixels = width * height
                output = ti.static(PixelArrays(colours, labels, pixels))
                samples_width, samples_height = width * factor, height * factor
                # Bands are taken one by one: if another program delays a worker, the others take its bands.
                taking = True
                while taking:
                    row = ti.atomic_add(sizes[uni.BANDS_TAKEN], 1) * config.band_rows
                    taking = row < height
                    if taking:
                        end_row = ti.min(row + config.band_rows, height)
                        top, bottom = row * factor, end_row * factor
                        places = row // config.band_rows * band_map_vectors
                        band = ti.static(
                            Band(
                                config, samples, first, across, 0.0, samples_width, top, bottom,
                                samples_width, samples_height, near, uniforms, places,
                            )
                        )  # fmt: skip
                        cover_band(sheet, band)
                        if ti.static(config.instruments):
                            cover_capsules(capsule_count, band)
                        resolve(first, row, end_row, 0, width, across, width, places, samples, appearance, output)

    return draw
