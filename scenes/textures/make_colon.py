"""Shape and paint the inside of a colon: ``colon.jpg``, its wall, and ``haustra.png``, what holds the wall back.

The colon is a funnel with crescent folds, seen from its wide end. Gas presses a sheet into it: where the foundation
is c times as stiff, the sheet goes DEEPEST / c deep. So the map of the foundation, 1 / depth, is the shape.

The wall is painted as in make_mucosa.py: pale tissue darkened by blood, in a net of vessels that grows on the unrolled
funnel. What the light of an endoscope does not reach is painted darker: deep inside, and behind the folds.

Usage: ``python make_colon.py [FOLDER]``
"""

import math
import sys
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np
from make_mucosa import CANVAS, FAT, HAEMOGLOBIN, Field, Point, grow, noise  # type: ignore[import-not-found]
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter, map_coordinates

SIDE = 0.11  # of the square sheet [m]
SIZE = 1024  # pixels of the picture
MAP = 320  # pixels of the map
SUPERSAMPLING = 2  # vessels are drawn this much larger

DEEPEST = 0.05  # of the sheet, where the map is black [m]
STIFFEST = 25  # times as stiff where it is white

LUMEN = 0.001, 0.003  # where the funnel ends: right of the middle of the sheet and above it [m]
RIM = 0.05  # radius at which it begins [m]
SLOPE = 1.02
TRIANGULAR, LEANING = 0.08, 0.4  # how little round it is, and which way


class Fold(NamedTuple):
    """A fold around a part of the funnel: a crest that is steep on the outside."""

    radius: float  # [m]
    angle: float  # of its middle, anticlockwise from the right
    span: float  # to each of its ends
    height: float  # [m]
    inner: float  # its width to each side [m]
    outer: float


FOLDS = (
    Fold(0.0395, 1.90, 1.15, 0.0075, 0.0095, 0.0034),
    Fold(0.0335, -1.25, 1.2, 0.0062, 0.0095, 0.0034),
    Fold(0.0340, 0.05, 0.9, 0.0058, 0.0090, 0.0034),
    Fold(0.0285, 1.50, 1.35, 0.0080, 0.0085, 0.0032),
    Fold(0.0230, -1.70, 1.4, 0.0080, 0.0085, 0.0034),
    Fold(0.0240, 0.20, 0.9, 0.0062, 0.0080, 0.0032),
    Fold(0.0190, 2.00, 1.4, 0.0074, 0.0070, 0.0030),
    Fold(0.0155, -2.20, 1.2, 0.0070, 0.0070, 0.0030),
    Fold(0.0085, -1.45, 1.5, 0.0105, 0.0060, 0.0034),
    Fold(0.0105, 1.20, 1.4, 0.0060, 0.0050, 0.0026),
)

TISSUE = np.array([240.0, 190.0, 160.0])  # RGB of bloodless mucosa
# Radius, blur and absorbance of vessels, as in make_mucosa.py.
LAYERS = (
    (0.9, 0.8, np.array([0.16, 0.52, 0.42])),
    (1.8, 1.4, np.array([0.16, 0.46, 0.38])),
    (3.2, 2.4, np.array([0.20, 0.42, 0.30])),
    (6.0, 5.0, np.array([0.20, 0.30, 0.18])),
)
THINNER = 0.6  # than in make_mucosa.py


def polar(pixels: int) -> tuple[Field, Field]:
    """Return the distance [m] from the lumen and the angle of every pixel of the sheet."""
    across = ((np.arange(pixels) + 0.5) / pixels - 0.5) * SIDE
    x, y = np.meshgrid(across - LUMEN[0], -across - LUMEN[1])
    return np.hypot(x, y), np.arctan2(y, x)


def depth(r: Field, angle: Field) -> Field:
    """Return how deep the wall lies [m]."""
    triangle = np.cos(3 * angle + LEANING)
    deep: Field = SLOPE * (RIM - r * (1 + TRIANGULAR * triangle + 0.04 * np.cos(2 * angle - 1)))
    for fold in FOLDS:
        off = (angle - fold.angle + math.pi) % (2 * math.pi) - math.pi
        presence = np.clip(1 - (off / fold.span) ** 2, 0, None) ** 0.8
        beyond = r - fold.radius * (0.88 + 0.12 * presence + 0.1 * triangle)
        width = np.where(beyond > 0, fold.outer, fold.inner)
        deep -= fold.height * presence * np.exp(-((beyond / width) ** 2))
    return np.clip(deep, DEEPEST / STIFFEST, DEEPEST)


# Along the bare wall it is so far from the lumen, which narrows more than a cone, to the radii.
RADII = np.linspace(0, SIDE, 4000)
ALONG = np.concatenate([[0.0], np.cumsum((1.5 + 0.008 / (RADII[1:] + 0.004)) * np.diff(RADII))])
UNROLLED = 0.46 * CANVAS / float(np.interp(0.072, RADII, ALONG))  # pixels of the canvas per metre


def rolled(point: Point) -> tuple[float, float, float]:
    """Return where a point of a vessel is on the sheet, and how thick [px]."""
    x, y = point.x - CANVAS / 2, point.y - CANVAS / 2
    away = math.hypot(x, y)
    share = float(np.interp(away / UNROLLED, ALONG, RADII)) / away
    scale = SIZE / SIDE
    across, down = SIZE / 2 + (LUMEN[0] + x * share) * scale, SIZE / 2 - (LUMEN[1] + y * share) * scale
    return across, down, max(0.35, point.radius * share * scale) * THINNER


def draw(vessels: list[list[Point]], layer: int) -> Field:
    """Return how much of a vessel of that one of the ``LAYERS`` there is at each pixel, from 0 to 1."""
    radii, weights = [0.0, *(radius for radius, _, _ in LAYERS)], np.eye(len(LAYERS) + 1)[layer + 1]
    image = Image.new("L", (SIZE * SUPERSAMPLING,) * 2)
    pen = ImageDraw.Draw(image)
    for a, b in (ends for vessel in reversed(vessels) for ends in pairwise(vessel)):
        if fill := round(255 * float(np.interp(b.radius, radii, weights))):
            (x0, y0, _), (x1, y1, r) = ([SUPERSAMPLING * value for value in rolled(end)] for end in (a, b))
            pen.line((x0, y0, x1, y1), fill=fill, width=max(1, round(2 * r)))
            pen.ellipse((x1 - r, y1 - r, x1 + r, y1 + r), fill=fill)
    return np.asarray(image.reduce(SUPERSAMPLING), dtype=np.float64) / 255


def grain(rng: np.random.Generator, scale: float) -> Field:
    """Return noise of unit variance with blobs of about ``scale`` pixels of the sheet."""
    field: Field = gaussian_filter(rng.standard_normal((SIZE, SIZE)), scale)
    return field / field.std()


def paint(seed: int = 7) -> Image.Image:
    """Return the wall."""
    rng = np.random.default_rng(seed)
    r, angle = polar(SIZE)
    along = UNROLLED * np.interp(r, RADII, ALONG)
    canvas = CANVAS / 2 + np.stack([along * np.sin(angle), along * np.cos(angle)])

    def spots(*scales: tuple[float, float]) -> Field:
        field: Field = sum(share * noise(rng, scale) for share, scale in scales)
        return map_coordinates(field, canvas, order=1, mode="reflect")

    vessels = list(grow(rng, 9))
    absorbance = np.zeros((SIZE, SIZE, 3))
    for layer, (_, blurred, colour) in enumerate(LAYERS):
        absorbance += np.multiply.outer(gaussian_filter(draw(vessels, layer), blurred), colour)
    absorbance *= np.clip(0.5 + spots((0.4, 60)), 0.08, 1)[..., None]
    deep = depth(r, angle)
    valley = np.clip((deep - gaussian_filter(deep, 14)) / 0.0022, -1, 1.3)
    within = np.clip((0.016 - r) / 0.014, 0, 1)
    blood = 0.46 + 0.12 * (spots((0.6, 70), (0.4, 25), (0.12, 6)) + valley) + 0.8 * within
    absorbance += np.multiply.outer(blood, HAEMOGLOBIN) + np.multiply.outer(1.2 + spots((0.6, 50)), FAT)
    light = 1 - 0.26 * np.maximum(valley, 0) - 0.1 * np.minimum(valley, 0)
    light *= 1 - 0.75 * np.clip((0.0135 - r) / 0.011, 0, 1)
    light *= 1 + 0.012 * grain(rng, 1.2) + 0.018 * grain(rng, 3) + 0.016 * grain(rng, 6)
    picture = TISSUE * np.exp(-absorbance) * light[..., None]
    return Image.fromarray(np.clip(np.rint(picture), 0, 255).astype(np.uint8))


def main() -> None:
    """Write both, into the given folder or, by default, beside this script."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    paint().save(folder / "colon.jpg", quality=88)
    grey = np.rint((DEEPEST / depth(*polar(MAP)) - 1) / (STIFFEST - 1) * 65535).astype(np.uint16)
    Image.fromarray(grey).save(folder / "haustra.png", optimize=True)
    for name in ("colon.jpg", "haustra.png"):
        print(f"{folder / name}: {(folder / name).stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
