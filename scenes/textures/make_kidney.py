"""Paint ``kidney.jpg``, a kidney in its fat, and draw ``kidney.png``, how high they stand, from black to white.

The kidney is a bean about a bent spine. The fat around it lies in lobules, and wells up at its edge. A vein and an
artery leave at its hollow side. As in make_mucosa.py, pale tissue is darkened by blood.

Usage: ``python make_kidney.py [FOLDER]``
"""

import math
import sys
from itertools import pairwise
from pathlib import Path

import numpy as np
from make_mucosa import (  # type: ignore[import-not-found]
    FAT,
    HAEMOGLOBIN,
    LAYERS,
    Field,
    draw,
    grow,
    honeycomb,
    noise,
    trunks,
)
from PIL import Image
from scipy.ndimage import gaussian_filter

SIDE = 0.18  # of the square sheet [m]
SIZE = 1200  # pixels of the picture
MAP = 180  # pixels of the heights

HEIGHT = 0.021  # of the kidney [m]
RADIUS = 0.0255  # of its cross section [m]
SPINE = 0.036, 1.0  # radius [m] of the arc about which it lies, and half of the arc's angle
UPWARD = 0.004  # of the kidney's middle above the middle of the sheet [m]

CORTEX = np.array([170.0, 112.0, 90.0])  # RGB without blood
YELLOW = np.array([204.0, 172.0, 118.0])
PALE = np.array([236.0, 205.0, 196.0])
BLURS = 0.7, 1.2, 2.2, 5.0  # of the layers of vessels [px]

# A vein and an artery: points (x, y) from the middle of the sheet [m], radius [m] and absorbance.
TUBES = (
    (((-0.004, -0.010), (-0.006, -0.030), (-0.014, -0.052), (-0.020, -0.095)), 0.0046, np.array([0.72, 0.92, 0.50])),
    (((0.006, -0.010), (0.007, -0.030), (0.015, -0.050), (0.013, -0.095)), 0.0030, np.array([0.12, 0.85, 0.80])),
)


def places(pixels: int) -> tuple[Field, Field]:
    """Return x and y [m] of every pixel, from the middle of the sheet."""
    across = ((np.arange(pixels) + 0.5) / pixels - 0.5) * SIDE
    x, y = np.meshgrid(across, -across)
    return x, y


def kidney(x: Field, y: Field) -> Field:
    """Return the distance from the kidney's spine, in radii of its cross section: 1 at its edge."""
    arc, half = SPINE
    below = y - UPWARD + arc - 0.008
    angle = np.clip(np.arctan2(x, below), -half, half)
    away = np.hypot(x - arc * np.sin(angle), below - arc * np.cos(angle))
    return away / (RADIUS * (1 + 0.05 * np.sin(2.2 * angle) - 0.1 * np.cos(angle * math.pi / half)))


def tube(x: Field, y: Field, points: tuple[tuple[float, float], ...]) -> Field:
    """Return the distance [m] from a line through points."""
    nearest = np.full(x.shape, np.inf)
    for (x0, y0), (x1, y1) in pairwise(points):
        dx, dy = x1 - x0, y1 - y0
        share = np.clip(((x - x0) * dx + (y - y0) * dy) / (dx**2 + dy**2), 0, 1)
        nearest = np.minimum(nearest, np.hypot(x - x0 - share * dx, y - y0 - share * dy))
    return nearest


def resized(field: Field, pixels: int) -> Field:
    """Return a field on the canvas with another number of pixels."""
    return np.asarray(Image.fromarray(field.astype(np.float32)).resize((pixels, pixels)), dtype=np.float64)


def heights(lobules: Field, bumps: Field) -> Field:
    """Return the heights [m]."""
    x, y = places(MAP)
    away, pixel = kidney(x, y), SIDE / MAP
    body = HEIGHT * np.clip(1 - away**2, 0, None)
    fat = 0.0022 * resized(lobules, MAP) + 0.0016 * resized(bumps, MAP) + 0.004 * np.exp(-(((away - 1.25) / 0.3) ** 2))
    fat *= np.clip((away - 0.85) / 0.2, 0, 1)
    for points, radius, _ in TUBES:
        fat += 0.8 * radius * np.clip(1 - (tube(x, y, points) / (1.6 * radius)) ** 2, 0, None)
    return gaussian_filter(np.maximum(body, 0.6 * body + fat), 0.0022 / pixel)


def paint(rng: np.random.Generator, lobules: Field) -> Image.Image:
    """Return the picture."""

    def spots(*scales: tuple[float, float]) -> Field:
        return resized(sum(share * noise(rng, scale) for share, scale in scales), SIZE)

    def grain(scale: float) -> Field:
        field: Field = gaussian_filter(rng.standard_normal((SIZE, SIZE)), scale)
        return field / field.std()

    x, y = places(SIZE)
    is_kidney = 1 / (1 + np.exp((kidney(x, y) - 1 + 0.02 * spots((1, 12))) / 0.02))
    septa = 1 - resized(lobules, SIZE)
    vessels = list(grow(rng, trunks(rng, 12)))
    absorbance = np.zeros((SIZE, SIZE, 3))
    for layer, (colour, blurred) in enumerate(zip((colour for _, _, colour in LAYERS), BLURS, strict=True)):
        absorbance += np.multiply.outer(gaussian_filter(resized(draw(vessels, layer), SIZE), blurred), colour)
    absorbance *= (np.clip(0.5 + spots((0.35, 50)), 0.1, 1) * (1 - 0.45 * is_kidney))[..., None]
    blood_of_kidney = 0.72 + 0.10 * spots((0.6, 70), (0.4, 22), (0.25, 6)) + 0.05 * grain(2.5)
    blood_of_fat = 0.10 + 0.05 * spots((0.6, 60), (0.4, 20)) + 0.10 * septa
    blood = is_kidney * blood_of_kidney + (1 - is_kidney) * np.maximum(blood_of_fat, 0)
    absorbance += np.multiply.outer(blood, HAEMOGLOBIN)
    absorbance += np.multiply.outer((1 - is_kidney) * (2.2 + spots((0.5, 50))), FAT)
    tissue = YELLOW + np.multiply.outer(is_kidney, CORTEX - YELLOW)
    for points, radius, colour in TUBES:
        within = (np.clip(1.6 - tube(x, y, points) / radius, 0, 1) * (1 - is_kidney))[..., None]
        absorbance += within * (0.8 * colour - 0.7 * absorbance)
        tissue += within * (PALE - tissue)
    light = 1 - 0.12 * septa * (1 - is_kidney) - 0.25 * np.exp(-(((kidney(x, y) - 1.02) / 0.05) ** 2))
    light *= 1 + 0.012 * grain(1.2) + 0.014 * grain(3)
    picture = tissue * np.exp(-absorbance) * light[..., None]
    return Image.fromarray(np.clip(np.rint(picture), 0, 255).astype(np.uint8))


def main() -> None:
    """Write both, into the given folder or, by default, beside this script."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    rng = np.random.default_rng(11)
    walls = np.clip(1.0 - honeycomb(rng, 44) ** 3, 0, 1)
    lobules = gaussian_filter(walls, 3, mode="wrap")
    lobules /= lobules.max()
    high = heights(lobules, noise(rng, 30))
    high = np.clip(high - high.min(), 0, None)
    grey = np.rint(65535 * high / high.max()).astype(np.uint16)
    print(f"{1000 * high.max():.2f} mm from black to white")
    paint(rng, lobules).save(folder / "kidney.jpg", quality=86)
    Image.fromarray(grey).save(folder / "kidney.png", optimize=True)
    for name in ("kidney.jpg", "kidney.png"):
        print(f"{folder / name}: {(folder / name).stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
