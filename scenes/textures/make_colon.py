"""Paint ``colon.jpg``, the inside of a colon, unrolled: a tube with folds around it, seen along its axis.

The wall is painted as in make_mucosa.py: pale tissue darkened by blood, in a net of vessels. Its left edge continues at
the right one, where the tube closes. What the light of an endoscope does not reach is painted darker: far away, and
in the valleys between the folds.

Usage: ``python make_colon.py [FOLDER]``
"""

import math
import sys
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import numpy as np
from make_mucosa import (  # type: ignore[import-not-found]
    CANVAS,
    FAT,
    HAEMOGLOBIN,
    THICKEST,
    Field,
    Point,
    grow,
    noise,
)
from PIL import Image, ImageDraw
from scipy.ndimage import gaussian_filter, map_coordinates

LENGTH = 0.15  # of the tube, from the bottom to the top of the picture [m]
SPACING = 0.03  # of the folds, one of which is in the middle [m]
EYE = 0.013  # from the bottom: the place of the endoscope [m]
FADING = 0.14  # distance from it at which half of the light is left [m]
DARK = 0.055  # from the top, where the tube ends: the beginning of darkness [m]
HEIGHT, WIDTH = 1430, 1500  # of the picture [px]
SUPERSAMPLING = 2  # vessels are drawn this much larger

TISSUE = np.array([240.0, 190.0, 160.0])  # RGB of bloodless mucosa
# Radius, blur and absorbance of vessels, as in make_mucosa.py.
LAYERS = (
    (0.9, 0.6, np.array([0.16, 0.52, 0.42])),
    (1.8, 1.0, np.array([0.16, 0.46, 0.38])),
    (3.2, 1.8, np.array([0.20, 0.42, 0.30])),
    (6.0, 4.0, np.array([0.20, 0.30, 0.18])),
)
THINNER = 0.5  # than in make_mucosa.py


def trunks(rng: np.random.Generator, number: int) -> Iterator[Point]:
    """Yield where vessels enter, spread over both ends of the tube and headed along it."""
    for n in range(number):
        across, radius = CANVAS * (n + rng.uniform()) / number, THICKEST * rng.uniform(0.3, 0.9)
        down, heading = (0, math.pi / 2) if n % 2 else (CANVAS - 1, -math.pi / 2)
        yield Point(across, down, heading + rng.uniform(-0.7, 0.7), radius)


def enlarged(field: Field) -> Field:
    """Return a field on the canvas at the pixels of the picture."""
    at = np.meshgrid(*(CANVAS * (np.arange(pixels) + 0.5) / pixels - 0.5 for pixels in (HEIGHT, WIDTH)), indexing="ij")
    return map_coordinates(field, at, order=1, mode="grid-wrap")


def draw(vessels: list[list[Point]], layer: int) -> Field:
    """Return how much of a vessel of that one of the ``LAYERS`` there is at each pixel, from 0 to 1."""
    radii, weights = [0.0, *(radius for radius, _, _ in LAYERS)], np.eye(len(LAYERS) + 1)[layer + 1]
    scale_x, scale_y = SUPERSAMPLING * WIDTH / CANVAS, SUPERSAMPLING * HEIGHT / CANVAS
    image = Image.new("L", (SUPERSAMPLING * WIDTH, SUPERSAMPLING * HEIGHT))
    pen = ImageDraw.Draw(image)
    for a, b in (ends for vessel in reversed(vessels) for ends in pairwise(vessel)):
        if fill := round(255 * float(np.interp(b.radius, radii, weights))):
            r = scale_x * max(0.35, b.radius * THINNER)
            # A vessel that crosses the edge is drawn at both.
            for shift in (-CANVAS, 0, CANVAS):
                end = b.x + shift
                start = end + (a.x - b.x + CANVAS / 2) % CANVAS - CANVAS / 2
                x0, y0, x1, y1 = start * scale_x, a.y * scale_y, end * scale_x, b.y * scale_y
                pen.line((x0, y0, x1, y1), fill=fill, width=max(1, round(2 * r)))
                pen.ellipse((x1 - r, y1 - r, x1 + r, y1 + r), fill=fill)
    return np.asarray(image.reduce(SUPERSAMPLING), dtype=np.float64) / 255


def grain(rng: np.random.Generator, scale: float) -> Field:
    """Return noise of unit variance with blobs of about ``scale`` pixels of the picture."""
    field: Field = gaussian_filter(rng.standard_normal((HEIGHT, WIDTH)), scale, mode="wrap")
    return field / field.std()


def paint(seed: int = 7) -> Image.Image:
    """Return the wall."""
    rng = np.random.default_rng(seed)

    def spots(*scales: tuple[float, float]) -> Field:
        field: Field = sum(share * noise(rng, scale) for share, scale in scales)
        return enlarged(field)

    vessels = list(grow(rng, trunks(rng, 20), wraps=True))
    absorbance = np.zeros((HEIGHT, WIDTH, 3))
    for layer, (_, blurred, colour) in enumerate(LAYERS):
        absorbance += np.multiply.outer(gaussian_filter(draw(vessels, layer), blurred, mode="wrap"), colour)
    absorbance *= np.clip(0.55 + spots((0.35, 60)), 0.12, 1)[..., None]
    y = LENGTH * (0.5 - (np.arange(HEIGHT) + 0.5) / HEIGHT)[:, None]
    crest = np.cos(2 * math.pi * y / SPACING)
    distance = np.maximum(y + LENGTH / 2 - EYE, 0)
    blood = (
        0.44 + 0.13 * spots((0.6, 70), (0.4, 25), (0.15, 6)) + 0.02 * grain(rng, 2.5) - 0.05 * crest + 1.5 * distance
    )
    absorbance += np.multiply.outer(blood, HAEMOGLOBIN) + np.multiply.outer(1.2 + spots((0.6, 50)), FAT)
    light = (1 + 0.06 * crest) / (1 + (distance / FADING) ** 2)
    light *= np.clip((LENGTH / 2 - y) / DARK, 0, 1)
    light = light * (1 + 0.014 * grain(rng, 1.2) + 0.018 * grain(rng, 3) + 0.016 * grain(rng, 6))
    picture = TISSUE * np.exp(-absorbance) * light[..., None]
    return Image.fromarray(np.clip(np.rint(picture), 0, 255).astype(np.uint8))


def main() -> None:
    """Write the picture, into the given folder or, by default, beside this script."""
    path = (Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent) / "colon.jpg"
    paint().save(path, quality=86)
    print(f"{path}: {path.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
