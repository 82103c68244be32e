"""Kernel 2 on a CPU: the picture is cut into bands of rows, which workers take one after the other.

What is kept of a band fits into the cache, and no two workers write to one sample, so they need no locks.
"""

from collections.abc import Callable
from functools import cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render import uniforms as uni
from taichi_msm.render.config import INFINITY, Band, Bytes, DrawingConfig, Floats, Integers, clear
from taichi_msm.render.coverage import NORMAL_NUMBERS, DrawnSheet, cover, cover_with_rods, store_normal
from taichi_msm.render.geometry import POINT_NUMBERS, SEEN, may_reach, project
from taichi_msm.render.labels import label_numbers
from taichi_msm.render.lens_kernels import BENT_NUMBERS, store_bent
from taichi_msm.render.lens_table import bounds, tiled
from taichi_msm.render.shading import Appearance, PixelArrays, resolve
from taichi_msm.system.runtime import (
    ITERATIONS_PER_THREAD,
    Memory,
    compilation_options,
    current_device,
    ti,
    write_vectors,
)

# The numbers that are stored of all mass points come first; then, for every row of them, its highest and its lowest
# place in the picture, without distortion.
STORED = POINT_NUMBERS + NORMAL_NUMBERS


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
        self._workers = min(-(-height // config.band_rows), current_device().threads)
        self._memory = memory = Memory()
        self._point = memory.array("f32", 0, rows * (cols * (STORED + BENT_NUMBERS * config.bends) + 2))
        band_vectors = config.band_lines * config.tiles_across(width) * config.planes
        # Before the bands are the places of all samples, if there is a lens.
        self._table = -(-height // config.band_rows) * _places_of_band(config, width)
        self._samples = memory.array("f32", config.lanes, self._table + self._workers * band_vectors)

    def place(self, places: NDArray[np.float32]) -> None:
        """Take the places of the samples of the pictures that follow, as of `sample_places`."""
        config, bands = self._config, tiled(places, self._config)
        rows = config.band_rows * config.supersample
        known = [bounds(places[first : first + rows, :, :2]) for first in range(0, len(places), rows)]
        last = np.pad(known, ((0, 0), (0, config.lanes - len(known[0]))))
        table = np.concatenate([bands, last[:, None].astype(np.float32)], axis=1)
        write_vectors(self._samples, table.reshape(-1, config.lanes))

    def draw(
        self, position: NDArray[np.float32], numbers: NDArray[np.float32], sizes: NDArray[np.int32]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        """Draw the picture, the labels or both, as the config says; `numbers` and `sizes` are those of uniforms.py.

        Returns:
            Colours, shape (height, width, 3), and labels as `labels_of` takes them; each has meaning only if drawn.
        """
        config, (width, height) = self._config, self._size
        # Whole tiles are written, and the last of a row may reach beyond the picture.
        stride = config.tiles_across(width) * config.tile_width if config.in_words else width
        picture = np.empty((height, stride, 3) if config.picture else (1, 4, 3), np.uint8)
        # Without labels nothing is written there; an array of Taichi's is passed in half the time of one of NumPy's.
        labels: Any = self._point
        if config.labels:
            labels = np.zeros(label_numbers(normals=config.normals) * width * height, np.float32)
        sizes[[uni.ROWS_TAKEN, uni.ROWS_PROJECTED, uni.BANDS_TAKEN]] = 0
        with compilation_options(optimised=False):
            self._draw(
                position, self._texels, numbers, self._workers, sizes, self._point, self._samples,
                picture.ravel().view(np.int32) if config.in_words else picture.ravel(), labels,
            )  # fmt: skip
        return picture[:, :width], labels


def _places_of_band(config: DrawingConfig, width: int) -> int:
    """Count the vectors that hold a band's places, and their bounds, in a picture of this width [px]."""
    return config.band_places * config.tiles_across(width) + 1 if config.lens else 0


@ti.func
def project_row(
    position: ti.template(), i, rows, cols, config: ti.template(), numbers: ti.template(), point: ti.template()
):
    """Project a row of mass points; store how far up and down in the picture it reaches."""
    low, high = INFINITY, -INFINITY
    for j in range(cols):
        project(position, i, j, cols, numbers, point, False)
        store_normal(position, i, j, rows, cols, config, numbers, point)
        here = (i * cols + j) * POINT_NUMBERS
        if ti.static(config.bends):
            bent = rows * cols * STORED + (i * cols + j) * BENT_NUMBERS
            store_bent(bent, here, numbers, point, config.lens)
        if point[here + 2] > numbers[uni.NEAR]:
            low = ti.min(low, point[here + SEEN + 1])
            high = ti.max(high, point[here + SEEN + 1])
        else:
            low, high = -INFINITY, INFINITY
    reach = rows * cols * (STORED + BENT_NUMBERS * config.bends) + 2 * i
    point[reach] = low
    point[reach + 1] = high


@ti.func
def project_all(
    position: ti.template(), rows, cols, config: ti.template(), numbers: ti.template(), sizes: ti.template(),
    point: ti.template(),
):  # fmt: skip
    """Project all rows of mass points, shared among the workers; returns when every row is done.

    A worker waits only for rows that a running worker has taken, so one that starts late holds up nobody.
    """
    taking = True
    while taking:
        i = ti.atomic_add(sizes[uni.ROWS_TAKEN], 1)
        taking = i < rows
        if taking:
            project_row(position, i, rows, cols, config, numbers, point)
            ti.atomic_add(sizes[uni.ROWS_PROJECTED], 1)
    projected = ti.atomic_add(sizes[uni.ROWS_PROJECTED], 0)
    while projected < rows:
        projected = ti.atomic_add(sizes[uni.ROWS_PROJECTED], 0)


@ti.func
def cover_band(sheet: ti.template(), band: ti.template()):
    """Find what every sample of a band shows of the sheet."""
    config, point = ti.static((band.config, sheet.point))
    lines = (band.bottom - band.top + config.tile_height - 1) // config.tile_height
    for tile in range(lines * band.across):
        clear(band.first + tile * config.planes, band)
    reach = sheet.rows * sheet.cols * (STORED + BENT_NUMBERS * config.bends)
    # The rows of samples that the band shows, which without distortion are others.
    top, bottom = ti.cast(band.top, ti.f32), ti.cast(band.bottom, ti.f32)
    if ti.static(config.bends):
        known = band.samples[band.places + config.band_places * band.across]
        top, bottom = known[2] - 1.0, known[3] + 1.0
    for i in range(sheet.rows - 1):
        row = reach + 2 * i
        low = ti.min(point[row], point[row + 2])
        high = ti.max(point[row + 1], point[row + 3])
        if low < bottom and high > top:
            for j in range(sheet.cols - 1):
                if ti.static(config.bends):
                    cell = i * sheet.cols + j
                    bent = sheet.bent + cell * BENT_NUMBERS
                    if may_reach(cell * POINT_NUMBERS, bent, sheet.cols, band.top, band.bottom, band.numbers, point):
                        cover(i, j, (), sheet, band)
                else:
                    cover(i, j, (), sheet, band)


@cache
def _kernel(config: DrawingConfig) -> Callable[..., None]:
    factor = config.supersample

    @ti.kernel
    def draw(
        position: ti.types.ndarray(dtype=ti.f32, ndim=3), texels: Floats, numbers: Floats, workers: ti.i32,
        sizes: Integers, point: Floats, samples: ti.types.ndarray(dtype=config.floats, ndim=1),
        colours: Integers if config.in_words else Bytes, labels: Floats,
    ):  # fmt: skip
        for index in range(workers * ITERATIONS_PER_THREAD):
            if index % ITERATIONS_PER_THREAD == 0:
                rows, cols = sizes[uni.ROWS], sizes[uni.COLS]
                width, height = sizes[uni.WIDTH], sizes[uni.HEIGHT]
                # To start a loop for this alone takes longer than to project a sheet of usual size.
                project_all(position, rows, cols, config, numbers, sizes, point)
                texture_width, texture_height = sizes[uni.LEVELS + 1], sizes[uni.LEVELS + 2]
                rod_count, parts, near = sizes[uni.ROD_COUNT], numbers[uni.PARTS], numbers[uni.NEAR]
                across = (width * factor + config.tile_width - 1) // config.tile_width
                first = index // ITERATIONS_PER_THREAD * across * (config.band_lines * config.planes)
                band_places = 0
                if ti.static(config.bends):
                    band_places = across * config.band_places + 1
                    first += (height + config.band_rows - 1) // config.band_rows * band_places
                bent = rows * cols * STORED
                sheet = ti.static(DrawnSheet(point, rows, cols, parts, texture_width, texture_height, bent))
                appearance = ti.static(
                    Appearance(config, texels, sizes, texture_width, texture_height, numbers, rod_count)
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
                        places = row // config.band_rows * band_places
                        band = ti.static(
                            Band(
                                config, samples, first, across, 0.0, samples_width, top, bottom,
                                samples_width, samples_height, near, numbers, places,
                            )
                        )  # fmt: skip
                        cover_band(sheet, band)
                        if ti.static(config.instruments):
                            cover_with_rods(rod_count, band)
                        resolve(first, row, end_row, 0, width, across, width, places, samples, appearance, output)

    return draw
