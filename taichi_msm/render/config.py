"""Compile-time configuration and G-buffer layout of the rasteriser (kernel 2).

A sample is a pixel, or with supersampling one of several per pixel. The samples of a tile form a vector: 4 x 4 samples
for the 16 lanes of AVX-512, 4 x 2 for 8 lanes, 4 x 1 for 4 lanes, and a single sample on a GPU. Each plane of the
G-buffer (depth, normals, ...) has one vector per tile. On a CPU the unit of parallel work is a band, some rows of
tiles, and each worker has the G-buffer of one band.

Names that the functions of kernel 2 share, in addition to the fields of `DrawingConfig` and `Band`:

    position              positions of the mass points [m], shape (rows, cols, 3)
    texels                levels of the texture, as returned by `pyramid`
    colours, labels       colours of all pixels, as words or bytes; labels of all pixels, one label after the other
    first, end, ended     first index of a launch; index after the last one; counter of finished threads (`end_thread`)

    i, j                  row and column of a mass point or a cell
    corner                first entry of a cell's upper left mass point in `nodes`
    distorted_entry       first entry of its distorted position in `nodes`
    quad_column, quad_row column and row of sub-quads in their cell
    quad_side             side of the sub-quads, as a fraction of the cell's
    lower                 whether a triangle is below the diagonal of its sub-quad; for cells that are not invertible
    enlargement           enlargement of such a triangle, as a fraction of its side
    s, t                  coordinates on a triangle, to the right and down
    across, along         coordinates in a cell, to the right and down, from 0 to 1

    entry                 first entry of a tile in the G-buffer
    left, top             first column and row of a tile [samples]
    x, y                  columns and rows of the undistorted samples of a tile, one number per lane
    visible, inside       masks of the samples of a tile
    normal                list of three components, of any length
    colour                list of red, green and blue, 0 to 255
    a, b                  point in the camera of a picture, to the right and down at depth 1, without lens distortion
    slope_x, slope_y      gradient of the grey level, to the right and down [1/texel]
    row, end_row          first row of pixels, and the row after the last one

Modules with kernels have no `from __future__ import annotations`, because Taichi reads the annotations.
"""

from collections import namedtuple
from functools import cache
from typing import Any, NamedTuple

from taichi_msm.render import uniforms as uni
from taichi_msm.render.labels import WRITTEN, values_per_pixel
from taichi_msm.system.runtime import ti

# Maximum number of samples in a row of a tile.
TILE_WIDTH = 4

# Depth of samples without a surface.
INFINITY = 3e38

# Types of kernel arguments.
Floats = ti.types.ndarray(dtype=ti.f32, ndim=1)
Doubles = ti.types.ndarray(dtype=ti.f64, ndim=1)
Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)
Bytes = ti.types.ndarray(dtype=ti.u8, ndim=1)


class DrawingConfig(NamedTuple):
    """Compile-time configuration of kernel 2; everything else is passed as an argument."""

    refined: bool  # whether cells are subdivided
    masked: bool  # whether cells are missing
    supersample: int  # samples per pixel along each axis
    headlit: bool  # whether the sheet is lit by a headlight
    tissue: bool  # whether the sheet is shaded as wet tissue
    relief: bool  # whether tissue is shaded with a relief
    vignette: bool  # whether tissue is shaded with a vignette
    wireframe: bool  # whether the mass-point mesh is drawn
    shapes: tuple[str, ...]  # names of the shapes of the instruments
    metal: bool  # whether instruments are shaded
    picture: bool  # whether colours are written
    labels: frozenset[str]  # names of the labels that are written; they require one sample per pixel
    lens: str  # name of the lens model; empty without lens distortion
    lanes: int  # samples in a tile
    picture_lens: str | None = None  # lens model of the camera of a picture by a camera; None for another picture
    writes_light: bool = False  # whether the light is written, in place of colours and labels

    @property
    def tile_width(self) -> int:
        """Columns of samples in a tile."""
        return min(self.lanes, TILE_WIDTH)

    @property
    def tile_height(self) -> int:
        """Rows of samples in a tile."""
        return self.lanes // self.tile_width

    @property
    def unordered(self) -> bool:
        """Whether the cells at a sample come in any order, as on a GPU; on a CPU they come row by row."""
        return self.lanes == 1

    @property
    def plane(self) -> Any:
        """Index of each plane of the G-buffer, by name."""
        return _planes(self)

    @property
    def planes(self) -> int:
        """Number of vectors per tile."""
        return len(self.plane)

    @property
    def has_distortion(self) -> bool:
        """Whether the camera has lens distortion."""
        return self.lens != ""

    @property
    def is_pictured(self) -> bool:
        """Whether the texture is a picture by a camera."""
        return self.picture_lens is not None

    @property
    def picture_stride(self) -> int:
        """Numbers per mass point at rest in the camera of a picture: to the right, down and forward [m]."""
        return 3 * self.is_pictured

    @property
    def is_relit(self) -> bool:
        """Whether colours are relative to the light in which the picture was taken."""
        return self.is_pictured and (self.headlit or self.tissue) and not self.writes_light

    @property
    def values_per_pixel(self) -> int:
        """Floating-point values that are written per pixel."""
        return 1 if self.writes_light else values_per_pixel(self.labels)

    @property
    def map_planes(self) -> int:
        """Vectors per tile of the undistortion map, 0 without lens distortion.

        x and y; with `map_has_steps` also four steps; on a CPU also the bounding box of the tile.
        """
        return (6 if self.map_has_steps else 2) + (not self.unordered) if self.has_distortion else 0

    @property
    def map_has_steps(self) -> bool:
        """Whether the undistortion map includes the steps to the next samples."""
        return self.has_distortion and (self.tissue or self.wireframe)

    @property
    def band_rows(self) -> int:
        """Rows of pixels in a band on a CPU, for 16 rows of samples; at least one."""
        return max(1, 16 // self.supersample)

    @property
    def band_lines(self) -> int:
        """Rows of tiles in a band."""
        return -(-self.band_rows * self.supersample // self.tile_height)

    @property
    def writes_words(self) -> bool:
        """Whether pixels are written in groups of four, as three 32-bit words, instead of bytes."""
        return self.supersample == 1 and self.tile_width == TILE_WIDTH

    def tiles_across(self, width: int) -> int:
        """Return the number of tiles in a row of a picture of this width [px]."""
        return -(-width * self.supersample // self.tile_width)

    @property
    def float_vector(self) -> Any:
        """Taichi type of a vector with one floating-point number per lane."""
        return ti.types.vector(self.lanes, ti.f32)

    @property
    def integer_vector(self) -> Any:
        """Taichi type of a vector with one integer per lane."""
        return ti.types.vector(self.lanes, ti.i32)


@cache
def _planes(config: DrawingConfig) -> Any:
    """Return the index of each plane that a configuration needs, by name."""
    needed = {
        **{plane: name in config.labels for name, label in WRITTEN.items() for plane in label.planes},
        **dict.fromkeys(("depth", "texel_x", "texel_y"), True),  # of the visible surface; texture coordinates [texels]
        "light": config.headlit,  # reflected share of the headlight
        "wire": config.wireframe,  # opacity of the mesh's lines
        "instrument": len(config.shapes) > 0,  # 255 for a visible instrument, else 0
        **dict.fromkeys(("normal_x", "normal_y", "normal_z"), config.tissue or config.metal),  # in the camera's frame
        **dict.fromkeys(("cell", "triangle"), config.unordered),  # indices of the visible cell and triangle
        "footprint": config.tissue,  # squared size of a sample on the texture
        # Of a picture by a camera: `texel_x`, `texel_y` at the next samples to the right and below.
        **dict.fromkeys(("right_x", "right_y", "below_x", "below_y"), config.tissue and config.is_pictured),
        **dict.fromkeys(("red", "green", "blue"), config.picture and config.supersample > 1),  # before averaging
    }
    names = [name for name, is_needed in needed.items() if is_needed]
    return namedtuple("Planes", names)(*range(len(names)))


class Band(NamedTuple):
    """Arguments of a kernel, and a rectangle of the picture [samples]: a band on a CPU, a sample or pixel on a GPU."""

    config: DrawingConfig
    uniforms: Any  # constants of the view (uniforms.py)
    sizes: Any  # sizes and counters (uniforms.py)
    nodes: Any  # projected mass points (geometry.py)
    samples: Any  # G-buffer; with lens distortion also the undistortion map
    rows: Any  # of mass points
    cols: Any
    subdivisions: Any  # sub-quads along a side of a cell
    near: Any  # near plane [m]
    instrument_count: Any
    width: Any  # of the picture
    height: Any
    tiles_across: Any  # tiles in a row of the picture
    first: Any = 0  # first entry of the band in `samples`, at the left edge of the picture
    map_start: Any = 0  # first entry of its undistortion map in `samples`
    left: Any = 0.0  # first column, and the column after the last one
    right: Any = 0.0
    top: Any = 0  # first row, and the row after the last one
    bottom: Any = 0


@ti.func
def read_arguments(
    uniforms: ti.template(), sizes: ti.template(), nodes: ti.template(), samples: ti.template(), config: ti.template()
):
    """Return the arguments of a kernel as a `Band` without extent."""
    rows, cols, instrument_count = sizes[uni.ROWS], sizes[uni.COLS], sizes[uni.INSTRUMENT_COUNT]
    width, height = sizes[uni.WIDTH] * config.supersample, sizes[uni.HEIGHT] * config.supersample
    subdivisions, near = uniforms[uni.SUBDIVISIONS], uniforms[uni.NEAR]
    tiles_across = (width + config.tile_width - 1) // config.tile_width
    return ti.static(
        Band(
            config, uniforms, sizes, nodes, samples, rows, cols, subdivisions, near, instrument_count, width, height,
            tiles_across,
        )
    )  # fmt: skip


@ti.func
def is_present(cell, sizes: ti.template()):
    """Return whether a cell of a masked sheet is sheet."""
    word = sizes[uni.LEVELS + uni.LEVEL_STRIDE * sizes[uni.LEVEL_COUNT] + cell // 32]
    return ((word >> (cell % 32)) & 1) == 1


@ti.func
def triple(array: ti.template(), first):
    """Return the three numbers of an array from index `first` on, as a list."""
    return [array[first + n] for n in ti.static(range(3))]


@ti.func
def dot(a: ti.template(), b: ti.template()):
    """Return the scalar product of two lists of three components."""
    return a[0] * b[0] + a[1] * b[1] + a[2] * b[2]


@ti.func
def cross(a: ti.template(), b: ti.template()):
    """Return the vector product of two lists of three components, as a list."""
    return [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]


@ti.func
def clip(low_x, high_x, low_y, high_y, band: ti.template()):
    """Clip a rectangle [samples] to a band.

    Return a list of the first column, the column after the last one, the first row, and the row after the last one of
    its samples.
    """
    return [
        ti.cast(ti.math.clamp(ti.floor(low_x), band.left, band.right), ti.i32),
        ti.cast(ti.math.clamp(ti.ceil(high_x), band.left, band.right), ti.i32),
        ti.cast(ti.math.clamp(ti.floor(low_y), band.top, band.bottom), ti.i32),
        ti.cast(ti.math.clamp(ti.ceil(high_y), band.top, band.bottom), ti.i32),
    ]


@ti.func
def tile_range(clipped: ti.template(), band: ti.template()):
    """Return the tiles that a rectangle of samples overlaps, as `clip`; their rows count from the band's top."""
    tile_width, tile_height = ti.static((band.config.tile_width, band.config.tile_height))
    return (
        clipped[0] // tile_width,
        (clipped[1] + (tile_width - 1)) // tile_width,
        (clipped[2] - band.top) // tile_height,
        (clipped[3] - band.top + (tile_height - 1)) // tile_height,
    )


@ti.func
def sample_centres(left, top, config: ti.template()):
    """Return x and y of the sample centres of a tile [samples], one per lane."""
    tile_width = ti.static(config.tile_width)
    columns = config.float_vector([lane % tile_width + 0.5 for lane in ti.static(range(config.lanes))])
    lines = config.float_vector([lane // tile_width + 0.5 for lane in ti.static(range(config.lanes))])
    return columns + ti.cast(left, ti.f32), lines + ti.cast(top, ti.f32)


@ti.func
def _map_entry(entry, band: ti.template()):
    """Return the first entry of a tile in the undistortion map."""
    return band.map_start + (entry - band.first) // band.config.planes * band.config.map_planes


@ti.func
def undistorted_centres(left, top, entry, band: ti.template()):
    """Return the undistorted x and y of `sample_centres`; INVALID_COORDINATE beyond the limit of the lens."""
    x, y = sample_centres(left, top, band.config)
    if ti.static(band.config.has_distortion):
        stored = _map_entry(entry, band)
        x, y = band.samples[stored], band.samples[stored + 1]
    return x, y


@ti.func
def tile_box(entry, left, top, band: ti.template()):
    """Return the bounding box of the undistorted sample centres of a tile: left, right, top and bottom [samples]."""
    config = ti.static(band.config)
    x, y = left + 0.5, top + 0.5
    box = [x, x + (config.tile_width - 1.0), y, y + (config.tile_height - 1.0)]
    if ti.static(config.has_distortion):
        stored = _map_entry(entry, band)
        for n in ti.static(range(4)):
            if ti.static(config.unordered):
                box[n] = band.samples[stored + n // 2][0]
            else:
                box[n] = band.samples[stored + config.map_planes - 1][n]
    return ti.static(box)


@ti.func
def map_steps(entry, band: ti.template()):
    """Return the undistorted steps to the next samples [samples]: x and y to the right, x and y to the one below."""
    steps_entry = _map_entry(entry, band) + 2
    return [band.samples[steps_entry + n] for n in ti.static(range(4))]


@ti.func
def clear_tile(entry, band: ti.template()):
    """Mark the samples of a tile as empty."""
    band.samples[entry + band.config.plane.depth] = band.config.float_vector(INFINITY)
    if ti.static(len(band.config.shapes) > 0):
        band.samples[entry + band.config.plane.instrument] = band.config.float_vector(0)


@ti.func
def store_visible(entry, visible, value, samples: ti.template()):
    """Store values for the visible samples of a tile in the plane whose vector is at `entry`."""
    samples[entry] = ti.select(visible, value, samples[entry])


@ti.func
def store_visible_unit(entry, visible, vector: ti.template(), samples: ti.template()):
    """Normalise vectors, and store them for the visible samples of a tile in three planes from `entry` on."""
    length = ti.sqrt(dot(vector, vector))
    for n in ti.static(range(3)):
        store_visible(entry + n, visible, vector[n] / length, samples)
