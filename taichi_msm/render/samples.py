"""What is stored of every sample of the picture between covering and shading, and its layout in memory.

Samples are pixels, or parts of pixels where these are supersampled. A tile of samples is one vector: 4 x 4 samples for
the 16 lanes of AVX-512, 4 x 2 for 8 lanes, 4 x 1 for 4, a single one on a GPU. A tile takes `planes` vectors. On a CPU
bands of rows of tiles are the unit of parallel work; a worker stores one band at a time.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Any

from taichi_msm.system.runtime import ti

# Approximate number of rows of samples in a band on a CPU.
BAND_ROWS = 16

# Samples in a row of a tile, if there are that many lanes.
TILE_WIDTH = 4

# The first planes of every tile: the depth of what is seen, and its place in the texture [texels]. Other planes follow
# as the code needs them (`Code.layout`).
DEPTH, TEXEL_X, TEXEL_Y = 0, 1, 2

# Farther than anything that is drawn.
INFINITY = 3e38


@dataclass(frozen=True)
class Code:
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

    @cached_property
    def layout(self) -> dict[str, int]:
        """Map the names of the planes after the first three to the vector of a tile that each is."""
        wanted = {
            "light": self.headlit,  # share of the headlight that comes back
            "wire": self.wires,  # share of the mesh's lines in the colour
            **dict.fromkeys(("across", "down"), self.labels),  # the material point, fractions of the sheet
            "instrument": self.instruments,  # 1 where an instrument is seen, else 0
            **dict.fromkeys(("normal_x", "normal_y", "normal_z"), self.tissue or self.metal),  # in the camera's frame
            **dict.fromkeys(("cell", "triangle"), self.unordered),  # their numbers
            "footprint": self.tissue,  # square of the texels of a sample's longer side
            **dict.fromkeys(("red", "green", "blue"), self.picture and self.supersample > 1),  # to be averaged
        }
        return {name: TEXEL_Y + 1 + n for n, name in enumerate(name for name, there in wanted.items() if there)}

    @property
    def planes(self) -> int:
        """Vectors stored per tile."""
        return TEXEL_Y + 1 + len(self.layout)

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
        """Count the tiles in a row.

        Args:
            width: of the picture [px].
        """
        return -(-width * self.supersample // self.tile_width)

    def band_vectors(self, width: int) -> int:
        """Count the vectors that a worker stores.

        Args:
            width: of the picture [px].
        """
        return self.band_lines * self.tiles_across(width) * self.planes

    @cached_property
    def floats(self) -> Any:
        """Taichi's type of one floating-point number per lane."""
        return ti.types.vector(self.lanes, ti.f32)

    @cached_property
    def integers(self) -> Any:
        """Taichi's type of one whole number per lane."""
        return ti.types.vector(self.lanes, ti.i32)
