"""Draw ``tumour.png``: where tissue is stiff, as grey from 0 (healthy) to 255 (stiffest).

A round lump with a soft edge, and a smaller, less stiff one below it. It spans the whole sheet, as ``mucosa.png``
does; a scene says how many times as stiff white is.

Usage: ``python make_tumour.py [OUT.png]``
"""

import sys
from pathlib import Path
from typing import NamedTuple

import numpy as np
import numpy.typing as npt
from PIL import Image

SIZE = 256  # pixels of the square picture


class Lump(NamedTuple):
    """A lump: its centre, radius and edge as fractions of the picture's width, and how stiff it is, from 0 to 1."""

    across: float
    down: float
    radius: float
    edge: float  # its stiffness falls over this distance, half of which is inside the radius
    stiffness: float


LUMPS = (
    Lump(across=0.70, down=0.50, radius=0.15, edge=0.06, stiffness=1.0),
    Lump(across=0.46, down=0.77, radius=0.045, edge=0.04, stiffness=0.6),
)


def draw() -> npt.NDArray[np.uint8]:
    """Return the picture."""
    down, across = (np.indices((SIZE, SIZE)) + 0.5) / SIZE
    stiffness = np.zeros((SIZE, SIZE))
    for lump in LUMPS:
        outside = (np.hypot(across - lump.across, down - lump.down) - lump.radius) / lump.edge + 0.5
        ramp = np.clip(outside, 0, 1)
        stiffness = np.maximum(stiffness, lump.stiffness * (1 - ramp**2 * (3 - 2 * ramp)))
    pixels: npt.NDArray[np.uint8] = np.rint(255 * stiffness).astype(np.uint8)
    return pixels


def main() -> None:
    """Write the picture to the given path, by default beside this script."""
    out = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).with_name("tumour.png")
    Image.fromarray(draw()).save(out, optimize=True)
    print(f"{out}: {out.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
