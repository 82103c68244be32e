"""Kernel 2: bilinear refinement, projection, rasterisation of textured triangles, shading.

The picture is cut into bands of rows. A worker takes the next band and finds what each of its samples shows: the sheet
(coverage.py) or an instrument in front of it (instrument_coverage.py). From that it writes the colours of pixels, their
labels, or both (shading.py). As in kernel 1, vectors stay vectors down to the machine code (docs/decisions/0010), and
casts, floor and abs of vectors are written to allow this.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render.camera import View, view
from taichi_msm.render.coverage import NORMAL, POINT_NUMBERS, SEEN, Band, Surface, covering
from taichi_msm.render.instrument import Rod
from taichi_msm.render.instrument_coverage import instruments
from taichi_msm.render.labels import Labels
from taichi_msm.render.numbers import (
    AXES,
    BANDS_TAKEN,
    COLS,
    HEIGHT,
    LEVEL_COUNT,
    LEVELS,
    MATRIX,
    NEAR,
    PARTS,
    ROD_COUNT,
    ROWS,
    ROWS_PROJECTED,
    ROWS_TAKEN,
    WIDTH,
    view_numbers,
)
from taichi_msm.render.pyramid import pyramid
from taichi_msm.render.samples import DEPTH, INFINITY, Code
from taichi_msm.render.shading import Out, Texture, resolving
from taichi_msm.scene import Scene
from taichi_msm.system.quick_taichi import defined_once
from taichi_msm.system.runtime import ITERATIONS_PER_THREAD, Memory, lanes, our_compilation, started, ti


class Drawn(NamedTuple):
    """What was drawn of one frame.

    Attributes:
        picture: colours, shape (height, width, 3); None where only labels are drawn.
        labels: what each pixel shows; None where only the picture is drawn.
    """

    picture: NDArray[np.uint8] | None
    labels: Labels | None


def structure(scene: Scene, *, picture: bool = True, labels: bool = False) -> Code:
    """Decide what the kernel must be compiled for to draw a scene.

    Args:
        scene: the scene.
        picture: whether colours are wanted.
        labels: whether labels are wanted; for both together, the scene must have one sample per pixel.
    """
    render = scene.render
    return Code(
        refined=render.refine > 0,
        supersample=render.supersample if picture else 1,
        shading=render.shading,
        relief=render.shading == "tissue" and picture and render.light.relief != 0,
        vignette=render.shading == "tissue" and picture and render.light.vignette != 0,
        wireframe=render.wireframe,
        instruments=scene.has_instruments,
        picture=picture,
        labels=labels,
        lanes=lanes("f32"),
    )


class Drawing:
    """Draws one scene's sheet; call `runtime.start` first.

    Args:
        scene: a checked scene.
        texture: the picture on the sheet, shape (height, width, 3).
        code: what the kernel is compiled for; None: what the scene's picture needs.
    """

    def __init__(self, scene: Scene, texture: NDArray[np.uint8], code: Code | None = None) -> None:
        self.scene = scene
        self.code = code or structure(scene)
        self._draw = _kernel(self.code)
        self._view = view(scene)
        (rows, cols), (width, height) = scene.sheet.points, scene.render.size
        bands = -(-height // self.code.band_rows)
        self._workers = min(bands, started().threads) if started().arch == "cpu" else bands
        self._memory = memory = Memory()
        # After the mass points, for every row of them, its highest and its lowest place in the picture.
        self._point = memory.array("f32", 0, rows * (cols * POINT_NUMBERS + 2))
        self._samples = memory.array("f32", self.code.lanes, self._workers * self.code.band_vectors(width))
        self._known: tuple[View, NDArray[np.float32]] | None = None
        self._texture_size = texture.shape[1], texture.shape[0]
        texels, levels = pyramid(texture, minified=self.code.tissue)
        self._sizes = np.zeros(LEVELS + levels.size, np.int32)
        self._sizes[[ROWS, COLS, WIDTH, HEIGHT, LEVEL_COUNT]] = rows, cols, width, height, len(levels)
        self._sizes[LEVELS:] = levels.flat
        self._texels: Any = texels
        if started().arch != "cpu":
            # The texture stays on the device; a NumPy array would be copied there and back with every picture.
            self._texels = ti.ndarray(ti.f32, texels.size)
            self._texels.from_numpy(texels)

    def draw(self, position: NDArray[Any], camera: View | None = None, rods: Sequence[Rod] = ()) -> NDArray[np.uint8]:
        """Draw the sheet, where the code has a picture.

        Args:
            position: positions of the mass points [m], shape (rows, cols, 3).
            camera: another view than the scene's.
            rods: the instruments.

        Returns:
            Colours, shape (height, width, 3).
        """
        picture = self.look(position, camera, rods).picture
        assert picture is not None
        return picture

    def look(self, position: NDArray[Any], camera: View | None = None, rods: Sequence[Rod] = ()) -> Drawn:
        """Draw the picture, the labels or both, as the code says; arguments as for `draw`."""
        camera, code = camera or self._view, self.code
        width, height = self.scene.render.size
        # Whole tiles are written, and the last of a row may reach beyond the picture.
        stride = code.tiles_across(width) * code.tile_width if code.in_words else width
        picture = np.empty((height, stride, 3) if code.picture else (1, 4, 3), np.uint8)
        pixels = width * height
        # Without labels nothing is written there; an array of Taichi's is passed in half the time of one of NumPy's.
        labels = np.zeros(4 * pixels, np.float32) if code.labels else self._point
        self._sizes[ROD_COUNT : BANDS_TAKEN + 1] = len(rods), 0, 0, 0
        with our_compilation(optimised=False):
            self._draw(
                np.ascontiguousarray(position, np.float32),
                self._texels,
                self._numbers(camera, rods),
                self._workers,
                self._sizes,
                self._point,
                self._samples,
                picture.ravel().view(np.int32) if code.in_words else picture.ravel(),
                labels,
            )
        seen = np.ascontiguousarray(picture[:, :width]) if code.picture else None
        if not code.labels:
            return Drawn(seen, None)
        coordinates, depth, instrument = np.split(labels, [2 * pixels, 3 * pixels])
        return Drawn(
            seen,
            Labels(
                coordinates.reshape(height, width, 2),
                depth.reshape(height, width),
                instrument.reshape(height, width).astype(np.uint8),
            ),
        )

    def _numbers(self, camera: View, rods: Sequence[Rod]) -> NDArray[np.float32]:
        """Give the numbers of a view; without instruments they are computed again only when the camera changes."""
        if rods or self._known is None or self._known[0] is not camera:
            render, size = self.scene.render, self.scene.sheet.size
            numbers = view_numbers(camera, render, self.code.supersample, size, self._texture_size, rods)
            if rods:
                return numbers.astype(np.float32)
            self._known = camera, numbers.astype(np.float32)
        return self._known[1]


@defined_once
def _kernel(code: Code) -> Callable[..., None]:
    """Make the kernel of one code."""
    factor, floats = code.supersample, code.floats
    cover, cover_rods, resolve = covering(code), instruments(code), resolving(code)

    @ti.func
    def project(position: ti.template(), numbers: ti.template(), point: ti.template(), i, j, rows, cols):
        """Store where mass point (i, j) is seen, and its normal; for tissue, in the camera's frame."""
        here = (i * cols + j) * POINT_NUMBERS
        x, y, z = position[i, j, 0], position[i, j, 1], position[i, j, 2]
        for n in ti.static(range(4)):
            row = MATRIX + 4 * n
            point[here + n] = numbers[row] * x + numbers[row + 1] * y + numbers[row + 2] * z + numbers[row + 3]
        point[here + SEEN] = point[here] / point[here + 2]
        point[here + SEEN + 1] = point[here + 1] / point[here + 2]
        if ti.static(code.headlit or code.tissue):
            i0, i1 = ti.max(i - 1, 0), ti.min(i + 1, rows - 1)
            j0, j1 = ti.max(j - 1, 0), ti.min(j + 1, cols - 1)
            r_x = position[i, j1, 0] - position[i, j0, 0]
            r_y = position[i, j1, 1] - position[i, j0, 1]
            r_z = position[i, j1, 2] - position[i, j0, 2]
            u_x = position[i0, j, 0] - position[i1, j, 0]
            u_y = position[i0, j, 1] - position[i1, j, 1]
            u_z = position[i0, j, 2] - position[i1, j, 2]
            n_x = r_y * u_z - r_z * u_y
            n_y = r_z * u_x - r_x * u_z
            n_z = r_x * u_y - r_y * u_x
            length = ti.max(ti.sqrt(n_x * n_x + n_y * n_y + n_z * n_z), 1e-30)
            n_x, n_y, n_z = n_x / length, n_y / length, n_z / length
            if ti.static(code.tissue):
                for n in ti.static(range(3)):
                    axis = AXES + 3 * n
                    point[here + NORMAL + n] = numbers[axis] * n_x + numbers[axis + 1] * n_y + numbers[axis + 2] * n_z
            else:
                point[here + NORMAL] = n_x
                point[here + NORMAL + 1] = n_y
                point[here + NORMAL + 2] = n_z

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
                    cover(i, j, surface, band)

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
        # On a GPU there may be more workers than run at once, so that they cannot wait for each other as on a CPU.
        if ti.static(code.lanes == 1):
            for i in range(sizes[ROWS]):
                project_row(position, numbers, point, i, sizes[ROWS], sizes[COLS])

        for index in range(workers * ITERATIONS_PER_THREAD):
            if index % ITERATIONS_PER_THREAD == 0:
                rows, cols, width, height = sizes[ROWS], sizes[COLS], sizes[WIDTH], sizes[HEIGHT]
                if ti.static(code.lanes > 1):
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
                            Band(samples, first, across, top, bottom, samples_width, samples_height, near, numbers)
                        )
                        draw_band(surface, band)
                        if ti.static(code.instruments):
                            cover_rods(rod_count, band)
                        resolve(samples, first, row, end_row, across, width, texture, out)

    return draw
