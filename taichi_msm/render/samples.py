"""What kernel 2 is compiled for, and what is stored of every sample of the picture between covering and shading.

Samples are pixels, or parts of pixels where these are supersampled. A tile of samples is one vector: 4 x 4 samples for
the 16 lanes of AVX-512, 4 x 2 for 8 lanes, 4 x 1 for 4, a single one on a GPU. A tile takes several vectors, its
planes. On a CPU bands of rows of tiles are the unit of parallel work; a worker stores one band at a time.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

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


class DrawingConfig(NamedTuple):
    """What kernel 2 is compiled for; all else it takes as arguments.

    Attributes:
        refined: whether vertices are inserted between mass points.
        supersample: samples per pixel along each axis.
        shading: none, headlight or tissue.
        relief: whether tissue is shaded with a relief.
        vignette: whether tissue is shaded with a vignette.
        wireframe: whether the mass-point mesh is drawn.
        instruments: whether there are any.
        picture: whether colours are written.
        labels: whether labels are written; needs one sample per pixel.
        lanes: samples in a tile.
    """

    refined: bool
    supersample: int
    shading: str
    relief: bool
    vignette: bool
    wireframe: bool
    instruments: bool
    picture: bool
    labels: bool
    lanes: int

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
    def headlit(self) -> bool:
        """Whether the sheet is lit by the headlight."""
        return self.picture and self.shading == "headlight"

    @property
    def tissue(self) -> bool:
        """Whether the sheet is shaded as wet tissue."""
        return self.picture and self.shading == "tissue"

    @property
    def wires(self) -> bool:
        """Whether the mesh is drawn over the sheet."""
        return self.picture and self.wireframe

    @property
    def metal(self) -> bool:
        """Whether instruments are shaded."""
        return self.picture and self.instruments

    @property
    def plane(self) -> Any:
        """The planes of a tile by name, and which of its vectors each is."""
        return _planes(self)

    @property
    def planes(self) -> int:
        """Vectors stored per tile."""
        return len(self.plane)

    @property
    def normal_planes(self) -> list[int]:
        """The planes of the normal in the camera's frame, if what is seen is shaded by it."""
        return [self.plane.normal_x + n for n in range(3)] if self.tissue or self.metal else []

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

    @property
    def columns(self) -> list[float]:
        """How far the centre of every lane's sample is from the tile's left edge."""
        return [lane % self.tile_width + 0.5 for lane in range(self.lanes)]

    @property
    def lines(self) -> list[float]:
        """How far it is from the tile's upper edge."""
        return [lane // self.tile_width + 0.5 for lane in range(self.lanes)]


@cache
def _planes(config: DrawingConfig) -> Any:
    """Number the planes that a config needs."""
    needed = {
        **{name: config.labels for label in LABELS.values() for name in label.planes},
        **dict.fromkeys(("depth", "texel_x", "texel_y"), True),  # of what is seen; its place in the texture [texels]
        "light": config.headlit,  # share of the headlight that comes back
        "wire": config.wires,  # share of the mesh's lines in the colour
        "instrument": config.instruments,  # 255 where an instrument is seen, else 0
        **dict.fromkeys(("normal_x", "normal_y", "normal_z"), config.tissue or config.metal),  # in the camera's frame
        **dict.fromkeys(("cell", "triangle"), config.unordered),  # their numbers
        "footprint": config.tissue,  # square of the texels of a sample's longer side
        **dict.fromkeys(("red", "green", "blue"), config.picture and config.supersample > 1),  # to be averaged
    }
    names = [name for name, there in needed.items() if there]
    return namedtuple("Planes", names)(*range(len(names)))


class Band(NamedTuple):
    """A band of the picture, or a part of one, and the view.

    Attributes:
        config: what the kernel is compiled for.
        samples: the planes of all tiles that are kept.
        first: entry of `samples` where the band begins, from the left edge of the picture.
        across: tiles in a row.
        left, right: first column of samples, and the column after the last.
        top, bottom: first row of samples, and the row after the last.
        width, height: of the picture [samples].
        near: only what is farther than this is drawn.
        numbers: as `view_numbers` makes them.
    """

    config: DrawingConfig
    samples: Any
    first: Any
    across: Any
    left: Any
    right: Any
    top: Any
    bottom: Any
    width: Any
    height: Any
    near: Any
    numbers: Any


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
    return config.floats(config.columns) + ti.cast(left, ti.f32), config.floats(config.lines) + ti.cast(top, ti.f32)


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
