"""What kernel 2 is compiled for, and what is stored of every sample of the picture between covering and shading.

Samples are pixels, or parts of pixels where these are supersampled. A tile of samples is one vector: 4 x 4 samples for
the 16 lanes of AVX-512, 4 x 2 for 8 lanes, 4 x 1 for 4, a single one on a GPU. A tile takes several vectors, its
planes. On a CPU bands of rows of tiles are the unit of parallel work; a worker stores one band at a time.

What functions of kernel 2 take: x and y are column and row of a tile's samples, a number for each; `at` the entry of
`samples` where the tile begins; `numbers` and `sizes` the arrays of uniforms.py; `point` what `project` stores.

Modules with kernels have no `from __future__ import annotations`: Taichi reads the annotations.
"""

from collections import namedtuple
from functools import cache
from typing import Any, NamedTuple

from taichi_msm.render.labels import LABELS
from taichi_msm.system.runtime import ti

# Approximate number of rows of samples in a band on a CPU.
BAND_ROWS = 16

# Samples in a row of a tile, if there are that many lanes.
TILE_WIDTH = 4

# Farther than anything that is drawn.
INFINITY = 3e38

# Types of a kernel's arguments.
Floats = ti.types.ndarray(dtype=ti.f32, ndim=1)
Doubles = ti.types.ndarray(dtype=ti.f64, ndim=1)
Integers = ti.types.ndarray(dtype=ti.i32, ndim=1)
Bytes = ti.types.ndarray(dtype=ti.u8, ndim=1)


class DrawingConfig(NamedTuple):
    """What kernel 2 is compiled for; all else it takes as arguments."""

    refined: bool  # whether vertices are inserted between mass points
    supersample: int  # samples per pixel along each axis
    headlit: bool  # whether the sheet is lit by the headlight
    tissue: bool  # whether the sheet is shaded as wet tissue
    relief: bool  # whether tissue is shaded with a relief
    vignette: bool  # whether tissue is shaded with a vignette
    wireframe: bool  # whether the mass-point mesh is drawn
    instruments: bool  # whether there are any
    metal: bool  # whether they are shaded
    picture: bool  # whether colours are written
    labels: bool  # whether labels are written; needs one sample per pixel
    normals: bool  # whether normals are among them
    lens: str  # the model of the lens, pinhole or fisheye; empty if it bends no lines
    lanes: int  # samples in a tile

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
        """Whether cells come to a sample in any order, as on a GPU, and not row by row."""
        return self.lanes == 1

    @property
    def plane(self) -> Any:
        """The planes of a tile by name, and which of its vectors each is."""
        return _planes(self)

    @property
    def planes(self) -> int:
        """Vectors stored per tile."""
        return len(self.plane)

    @property
    def bends(self) -> bool:
        """Whether there is a lens that bends lines."""
        return self.lens != ""

    @property
    def place_planes(self) -> int:
        """Vectors of the table of places per tile: x, y, their changes (lens_table.py), and a box; 0 without a lens."""
        return (6 if self.place_steps else 2) + (not self.unordered) if self.lens else 0

    @property
    def place_steps(self) -> bool:
        """Whether the table has the way to the next samples."""
        return bool(self.lens) and (self.tissue or self.wireframe)

    @property
    def band_places(self) -> int:
        """Vectors of the table of places per row of tiles and tile across, in a band on a CPU, less its bounds."""
        return self.band_lines * self.place_planes

    @property
    def band_rows(self) -> int:
        """Rows of pixels in a band on a CPU, a whole number of rows of tiles."""
        return max(1, BAND_ROWS // self.supersample)

    @property
    def band_lines(self) -> int:
        """Rows of tiles in a band."""
        return -(-self.band_rows * self.supersample // self.tile_height)

    @property
    def in_words(self) -> bool:
        """Whether pixels are written in groups of four, as three words, and not as bytes."""
        return self.supersample == 1 and self.tile_width == TILE_WIDTH

    def tiles_across(self, width: int) -> int:
        """Count the tiles in a row of a picture of this width [px]."""
        return -(-width * self.supersample // self.tile_width)

    @property
    def floats(self) -> Any:
        """Taichi's type of one floating-point number per lane."""
        return ti.types.vector(self.lanes, ti.f32)

    @property
    def integers(self) -> Any:
        """Taichi's type of one whole number per lane."""
        return ti.types.vector(self.lanes, ti.i32)


@cache
def _planes(config: DrawingConfig) -> Any:
    """Number the planes that a config needs."""
    needed = {
        **{name: config.labels for label in LABELS.values() for name in label.planes},
        **dict.fromkeys(LABELS["normals"].planes, config.normals),
        **dict.fromkeys(("depth", "texel_x", "texel_y"), True),  # of what is seen; its place in the texture [texels]
        "light": config.headlit,  # share of the headlight that comes back
        "wire": config.wireframe,  # share of the mesh's lines in the colour
        "instrument": config.instruments,  # 255 where an instrument is seen, else 0
        **dict.fromkeys(("normal_x", "normal_y", "normal_z"), config.tissue or config.metal),  # in the camera's frame
        **dict.fromkeys(("cell", "triangle"), config.unordered),  # their numbers
        "footprint": config.tissue,  # square of the texels of a sample's longer side
        **dict.fromkeys(("red", "green", "blue"), config.picture and config.supersample > 1),  # to be averaged
    }
    names = [name for name, there in needed.items() if there]
    return namedtuple("Planes", names)(*range(len(names)))


class Band(NamedTuple):
    """A band of the picture, or a part of one, and the view; all in samples."""

    config: DrawingConfig
    samples: Any  # the planes of all tiles that are kept
    first: Any  # entry of `samples` where the band begins, from the left edge of the picture
    across: Any  # tiles in a row
    left: Any  # first column
    right: Any  # the column after the last
    top: Any  # first row
    bottom: Any  # the row after the last
    width: Any  # of the picture
    height: Any
    near: Any  # only what is farther than this is drawn
    numbers: Any
    places: Any  # entry of `samples` where the band's places begin, if there is a lens


@ti.func
def clip(low_x, high_x, low_y, high_y, band: ti.template()):
    """Clip a rectangle to a band: give its first and end column, its first and end row of samples."""
    return (
        ti.cast(ti.math.clamp(ti.floor(low_x), band.left, band.right), ti.i32),
        ti.cast(ti.math.clamp(ti.ceil(high_x), band.left, band.right), ti.i32),
        ti.cast(ti.math.clamp(ti.floor(low_y), band.top, band.bottom), ti.i32),
        ti.cast(ti.math.clamp(ti.ceil(high_y), band.top, band.bottom), ti.i32),
    )


@ti.func
def tiles_of(first_column, end_column, first_row, end_row, band: ti.template()):
    """Give the tiles of a rectangle of samples: the first and end tile in a line of tiles, the first and end line."""
    width, height = ti.static((band.config.tile_width, band.config.tile_height))
    return (
        first_column // width,
        (end_column + (width - 1)) // width,
        (first_row - band.top) // height,
        (end_row - band.top + (height - 1)) // height,
    )


@ti.func
def centres(left, top, config: ti.template()):
    """Give x and y of the samples of a tile, whose upper left corner is at (left, top)."""
    width = ti.static(config.tile_width)
    columns = config.floats([lane % width + 0.5 for lane in ti.static(range(config.lanes))])
    lines = config.floats([lane // width + 0.5 for lane in ti.static(range(config.lanes))])
    return columns + ti.cast(left, ti.f32), lines + ti.cast(top, ti.f32)


@ti.func
def places(left, top, at, samples: ti.template(), config: ti.template()):
    """Give x and y of the samples of a tile, as `centres`, without distortion; `at` is the entry of its places."""
    x, y = centres(left, top, config)
    if ti.static(config.bends):
        x, y = samples[at], samples[at + 1]
    return x, y


@ti.func
def places_of(at, band: ti.template()):
    """Give the entry of the places of a tile that begins at entry `at` of the samples."""
    return band.places + (at - band.first) // band.config.planes * band.config.place_planes


@ti.func
def box_of(at, left, top, band: ti.template()):
    """Give the left, right, top and bottom of the samples of a tile, without distortion; `left`, `top`: its corner."""
    config = ti.static(band.config)
    x, y = left + 0.5, top + 0.5
    box = [x, x + (config.tile_width - 1.0), y, y + (config.tile_height - 1.0)]
    if ti.static(config.bends):
        known = places_of(at, band)
        for n in ti.static(range(4)):
            if ti.static(config.unordered):
                box[n] = band.samples[known + n // 2][0]
            else:
                box[n] = band.samples[known + config.place_planes - 1][n]
    return ti.static(box)


@ti.func
def steps(at, band: ti.template()):
    """Give the ways from the samples of a tile to the next on the right and to the next below, without distortion."""
    way = places_of(at, band) + 2
    return [band.samples[way + n] for n in ti.static(range(4))]


@ti.func
def clear(at, band: ti.template()):
    """Empty a tile."""
    band.samples[at + band.config.plane.depth] = band.config.floats(INFINITY)
    if ti.static(band.config.instruments):
        band.samples[at + band.config.plane.instrument] = band.config.floats(0)


@ti.func
def keep(at, visible, value, samples: ti.template()):
    """Store a plane's value for the samples where it is visible."""
    samples[at] = ti.select(visible, value, samples[at])


@ti.func
def keep_unit(at, visible, vector: ti.template(), samples: ti.template()):
    """Store the direction of a vector in three planes, as `keep` stores one value."""
    length = ti.sqrt(vector[0] * vector[0] + vector[1] * vector[1] + vector[2] * vector[2])
    for n in ti.static(range(3)):
        keep(at + n, visible, vector[n] / length, samples)
