"""Paint ``skin.jpg``, skin with the line of an incision, and draw ``incision.png``, black where the skin is cut.

Furrows divide the skin into small fields, deeper ones along the lines of tension. Two layers of vessels shine through.
The cut is one pixel wide, one cell of the scene; its lips are red with blood. As in make_mucosa.py, pale tissue is
darkened by blood.

Usage: ``python make_skin.py [FOLDER]``
"""

import sys
from pathlib import Path

import numpy as np
from make_mucosa import (  # type: ignore[import-not-found]
    CANVAS,
    HAEMOGLOBIN,
    LAYERS,
    MARGIN,
    SIZE,
    Field,
    blur,
    draw,
    grow,
    honeycomb,
    noise,
    trunks,
)
from PIL import Image

CELLS = 81  # of the scene along a side
CUT = 27  # cells of the cut, down, in the middle column

SKIN = np.array([236.0, 192.0, 160.0])  # RGB without blood
MELANIN = np.array([0.16, 0.30, 0.44])  # absorbance of freckles and of the furrows' shade
BLUE = np.array([0.22, 0.16, 0.06])  # absorbance of a vein beneath the skin


def distance_to_cut() -> Field:
    """Return the distance from the cut, in pixels."""
    y, x = np.indices((CANVAS, CANVAS)) + 0.5 - CANVAS / 2
    return np.hypot(x, np.maximum(np.abs(y) - SIZE * CUT / CELLS / 2, 0))


def paint(rng: np.random.Generator) -> Image.Image:
    """Return the picture."""
    fields, fine = honeycomb(rng, 10), honeycomb(rng, 4.5)
    lines = np.clip(noise(rng, 2.2) + 0.35 * noise(rng, 30), 0, None)
    furrows = blur(fields**4, 0.8) + 0.45 * blur(fine**3, 0.5) + 0.06 * lines
    blood = 0.22 + 0.06 * noise(rng, 60) + 0.035 * noise(rng, 14) + 0.02 * noise(rng, 4)
    away = distance_to_cut()
    blood += 0.35 * np.exp(-((away / 34) ** 2)) * (1 + 0.25 * noise(rng, 18))
    ragged = away + 1.6 * noise(rng, 5)
    absorbance = np.multiply.outer(blood, HAEMOGLOBIN)
    absorbance += np.multiply.outer(2.4 / (1 + np.exp((ragged - 8) / 1.2)), np.array([0.34, 1.0, 0.95]))
    freckles = blur((noise(rng, 3.5) > 2.6).astype(np.float64), 1.6) + 0.35 * np.clip(noise(rng, 40), 0, None)
    absorbance += np.multiply.outer(0.75 * freckles, MELANIN)
    pores = blur((rng.uniform(size=(CANVAS, CANVAS)) > 0.9993).astype(np.float64), 1.1) * 6
    absorbance += np.multiply.outer(0.11 * furrows + 0.3 * pores, MELANIN)
    vessels = list(grow(rng, trunks(rng, 5)))
    for layer in (2, 3):
        absorbance += np.multiply.outer(0.9 * blur(draw(vessels, layer), 2.5 * LAYERS[layer][1]), BLUE)
    light = 1 - 0.07 * (furrows - furrows.mean()) + 0.012 * noise(rng, 1.0)
    picture = SKIN * np.exp(-absorbance) * light[..., None]
    cut = slice(MARGIN, MARGIN + SIZE)
    return Image.fromarray(np.clip(np.rint(picture), 0, 255).astype(np.uint8)[cut, cut])


def main() -> None:
    """Write both, into the given folder or, by default, beside this script."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    mask, first = np.full((CELLS, CELLS), 255, np.uint8), (CELLS - CUT) // 2
    mask[first : first + CUT, CELLS // 2] = 0
    paint(np.random.default_rng(7)).save(folder / "skin.jpg", quality=85)
    Image.fromarray(mask).save(folder / "incision.png", optimize=True)
    for name in ("skin.jpg", "incision.png"):
        print(f"{folder / name}: {(folder / name).stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
