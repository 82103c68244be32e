"""Paint ``mucosa.png``, and those of the data set: seeded, procedural endoscopic pictures of moist mucosa.

The colours follow from optics rather than from a palette: pale tissue is darkened by blood according to the
Beer-Lambert law, and blood lies in branching vessels, in the capillaries round the crypts and, diffusely, in
redder patches and valleys. A soft height field of folds, bumps, crypts and bulging vessels is then lit.

Usage: ``python make_mucosa.py [FOLDER]``
"""

import bisect
import math
import sys
from collections.abc import Iterable, Iterator
from itertools import pairwise
from operator import attrgetter
from pathlib import Path
from typing import NamedTuple, TypeAlias

import numpy as np
import numpy.typing as npt
from PIL import Image, ImageDraw

Field: TypeAlias = npt.NDArray[np.float64]

SIZE = 768  # pixels of the square picture as it is painted
MARGIN = 64  # painted round it and cut off, because the Fourier blur wraps round at the borders
CANVAS = SIZE + 2 * MARGIN
SUPERSAMPLING = 3  # vessels are drawn this much larger, which anti-aliases them

HAEMOGLOBIN = np.array([0.10, 0.62, 0.56])  # absorbance per unit of blood: red passes, green and blue do not
FAT = np.array([0.0, 0.05, 0.13])  # absorbance of the yellowish patches
LAMP = 0.5, 0.85  # the way (x, y) along which the surface must rise to face the light
MIRROR = 0.6  # the slope along it at which the surface mirrors the lamp

# Radius, blur and absorbance of vessels. Thick ones lie deeper: the tissue above them blurs them and scatters
# blue light back, which makes them purplish.
LAYERS = (
    (0.9, 0.55, np.array([0.20, 0.60, 0.48])),
    (1.8, 1.0, np.array([0.20, 0.54, 0.42])),
    (3.2, 2.0, np.array([0.27, 0.52, 0.34])),
    (6.0, 4.5, np.array([0.24, 0.34, 0.18])),
)
THICKEST, FINEST = 4.8, 0.3  # greatest and least radius
STEP = 2.0  # pixels between the points of a vessel
PROBE = 24  # pixels that a growing vessel looks ahead to keep clear of others
CELL = 5  # pixels of a cell of the grid that records where vessels run
MAX_CROWD = 9  # cells taken round a fine vessel at which it dies out instead of branching


class Look(NamedTuple):
    """What one picture differs in from others."""

    seed: int
    size: int = 576  # pixels as it is saved, in 256 colours if smaller than SIZE, which keeps the repository small
    tissue: tuple[float, float, float] = (238.0, 195.0, 171.0)  # RGB of bloodless mucosa
    blood: float = 0.42  # that is everywhere
    patches: float = 0.19  # how much more or less there is in places
    crypts: float = 0.11  # how much there is round the crypts
    trunks: int = 8  # number of vessels that enter
    folds: float = 30.0  # height [px]


FOLDER = Path(__file__).parent
PICTURES = {
    "mucosa.png": Look(55, SIZE),
    "../sweeps/textures/pale.png": Look(2, tissue=(244, 214, 190), blood=0.2, patches=0.12, trunks=12, folds=18),
    "../sweeps/textures/red.png": Look(3, blood=0.72, patches=0.3, trunks=5),
    "../sweeps/textures/smooth.png": Look(4, tissue=(240, 190, 178), blood=0.34, crypts=0.04, trunks=16, folds=8),
    "../sweeps/textures/folded.png": Look(5, tissue=(232, 186, 150), blood=0.5, crypts=0.16, trunks=6, folds=42),
    "../sweeps/textures/patchy.png": Look(6, tissue=(238, 200, 172), patches=0.28, crypts=0.2, trunks=9, folds=24),
}


class Point(NamedTuple):
    """A point on a vessel."""

    x: float
    y: float
    heading: float
    radius: float

    @property
    def cell(self) -> tuple[int, int]:
        """Row and column in a grid that reaches far enough beyond the canvas for every probe."""
        return int((self.y + 2 * PROBE) / CELL), int((self.x + 2 * PROBE) / CELL)

    def ahead(self, distance: float, heading: float) -> "Point":
        """Return the point so far away in that direction."""
        x, y = self.x + distance * math.cos(heading), self.y + distance * math.sin(heading)
        return Point(x, y, heading, self.radius)


def blur(field: Field, sigma: float) -> Field:
    """Return the field convolved with a Gaussian, wrapping round at the borders."""
    fy, fx = np.fft.fftfreq(CANVAS)[:, None], np.fft.rfftfreq(CANVAS)[None, :]
    gauss = np.exp(-2 * (math.pi * sigma) ** 2 * (fx**2 + fy**2))
    blurred: Field = np.fft.irfft2(np.fft.rfft2(field) * gauss, s=field.shape)
    return blurred


def noise(rng: np.random.Generator, scale: float) -> Field:
    """Return smooth noise of zero mean and unit variance with blobs of about ``scale`` pixels."""
    field = blur(rng.standard_normal((CANVAS, CANVAS)), scale)
    field -= field.mean()
    field /= field.std()
    return field


def folds(rng: np.random.Generator) -> Field:
    """Return the height of the rugae, from 0 to 1: round, winding ridges that fade out here and there."""
    y, x = np.indices((CANVAS, CANVAS)) / CANVAS
    phase = 4.6 * (0.45 * x + 0.9 * y) + 0.7 * noise(rng, 100) + 0.2 * noise(rng, 36)
    ridges = np.abs(np.sin(math.pi * phase))  # round tops, narrow valleys
    presence = 1 / (1 + np.exp(-1.6 * noise(rng, 80) - 0.8))
    return blur(ridges * presence, 7)


def honeycomb(rng: np.random.Generator, cell: float) -> Field:
    """Return the crypt pattern: 0 at the pits, 1 on the walls between them (Worley's F1 / F2)."""
    count = math.ceil(CANVAS / cell) + 3
    sites = np.indices((count, count)) + rng.uniform(0.05, 0.95, (2, count, count))
    place = np.indices((CANVAS, CANVAS)) / cell + 1
    row, column = place.astype(int)
    nearest = second = np.full((CANVAS, CANVAS), np.inf)
    for i in (-1, 0, 1):
        for j in (-1, 0, 1):
            distance = np.hypot(*(sites[:, row + i, column + j] - place))
            second = np.minimum(second, np.maximum(nearest, distance))
            nearest = np.minimum(nearest, distance)
    walls: Field = nearest / second
    return walls


def trunks(rng: np.random.Generator, number: int) -> Iterator[Point]:
    """Yield where vessels enter, spread round the border and headed roughly for the middle."""
    for angle in 2 * math.pi * (np.arange(number) + rng.uniform(-0.4, 0.4, number)) / number:
        middle = Point(CANVAS / 2, CANVAS / 2, 0, THICKEST * rng.uniform(0.3, 1))
        border = middle.ahead(0.499 * CANVAS / max(abs(math.cos(angle)), abs(math.sin(angle))), angle)
        yield border._replace(heading=angle + math.pi + rng.uniform(-0.6, 0.6))


def crowd(taken: Field, point: Point) -> float:
    """Return how many of the 25 cells round the point a vessel has taken."""
    i, j = point.cell
    return float(taken[i - 2 : i + 3, j - 2 : j + 3].sum())


def creep(rng: np.random.Generator, start: Point, radius: float, taken: Field, wraps: bool) -> tuple[list[Point], bool]:
    """Let one vessel wind onwards, away from others, while it tapers to ``radius``.

    Returns:
        Its points, and whether it ended before its time: on another vessel, which it joins, or at the border.
    """
    path, aim, turn = [start], start.heading, 0.0
    steps = max(5, int(rng.gamma(2.0, 9 + 7 * start.radius) / STEP))
    for step in range(1, steps + 1):
        here = path[-1]
        left, right = (crowd(taken, here.ahead(PROBE, here.heading + side)) for side in (-0.7, 0.7))
        aim += 0.004 * (left - right) - 0.05 * (aim - start.heading)
        turn = 0.85 * turn + 0.07 * rng.standard_normal() / math.sqrt(start.radius)  # fine ones wind more
        there = here.ahead(STEP, here.heading + turn - 0.1 * (here.heading - aim))
        if wraps:
            there = there._replace(x=there.x % CANVAS)
        if not (0 <= there.x < CANVAS and 0 <= there.y < CANVAS):
            return path, True
        path.append(there._replace(radius=start.radius + (radius - start.radius) * step / steps))
        clear_of_parent = step * STEP > 4 * start.radius + 2 * CELL
        if clear_of_parent and start.radius < 1.6 and taken[there.cell] and rng.uniform() < 0.25:
            return path, True
    return path, False


def grow(rng: np.random.Generator, entering: Iterable[Point], wraps: bool = False) -> Iterator[list[Point]]:
    """Yield the vessels of the tree, which branches by Murray's law: the cubes of the radii add up.

    With ``wraps``, a vessel that leaves at the left or right comes in again at the other side.
    """
    taken = np.zeros(((CANVAS + 4 * PROBE) // CELL + 1,) * 2)
    thickness = attrgetter("radius")
    tips = sorted(entering, key=thickness)
    while tips:
        tip = tips.pop()  # the thickest first, so that finer ones fill the room left between them
        share = 0.01 + 0.49 * rng.uniform() ** 2  # mostly small: a vessel gives off twigs on its way
        major, minor = tip.radius * (1 - share) ** (1 / 3), tip.radius * share ** (1 / 3)
        if tip.radius < 0.9 and crowd(taken, tip) > MAX_CROWD:
            major = minor = 0.0
        path, ended = creep(rng, tip, major if major > FINEST else 0.0, taken, wraps)
        yield path
        for point in path:
            taken[point.cell] = 1
        side = rng.choice([-1, 1])
        for child, sibling, sign in ((major, minor, side), (minor, major, -side)):
            if child > FINEST and not ended:
                # The angle of least work (Murray again): the thinner a branch, the more it turns off.
                cosine = (tip.radius**4 + child**4 - sibling**4) / (2 * tip.radius**2 * child**2)
                heading = path[-1].heading + sign * math.acos(min(1, cosine)) * rng.uniform(0.6, 1)
                bisect.insort(tips, path[-1]._replace(heading=heading, radius=child), key=thickness)


def draw(vessels: list[list[Point]], layer: int) -> Field:
    """Return how much of a vessel of that one of the ``LAYERS`` there is at each pixel, from 0 to 1."""
    radii, weights = [0.0, *(radius for radius, _, _ in LAYERS)], np.eye(len(LAYERS) + 1)[layer + 1]
    image = Image.new("L", (CANVAS * SUPERSAMPLING,) * 2)
    pen = ImageDraw.Draw(image)
    for a, b in (ends for vessel in reversed(vessels) for ends in pairwise(vessel)):
        if fill := round(255 * float(np.interp(b.radius, radii, weights))):
            x0, y0, x1, y1, r = (SUPERSAMPLING * value for value in (a.x, a.y, b.x, b.y, b.radius))
            pen.line((x0, y0, x1, y1), fill=fill, width=max(1, round(2 * r)))
            pen.ellipse((x1 - r, y1 - r, x1 + r, y1 + r), fill=fill)
    return np.asarray(image.reduce(SUPERSAMPLING), dtype=np.float64) / 255


def gloss(rng: np.random.Generator, height: Field) -> Field:
    """Return how white the moisture shines: a soft sheen and, on a few wet spots, sharp glints."""
    slope_y, slope_x = np.gradient(blur(height, 1.4))
    miss = (slope_x - MIRROR * LAMP[0]) ** 2 + (slope_y - MIRROR * LAMP[1]) ** 2
    wet = blur((noise(rng, 20) > 1.3).astype(np.float64), 4)
    shine: Field = 0.85 * blur(wet * np.exp(-miss / 0.1**2), 0.7) + 0.1 * np.exp(-miss / 0.5**2)
    return shine


def paint(look: Look) -> Image.Image:
    """Return the picture."""
    rng = np.random.default_rng(look.seed)
    crypts = honeycomb(rng, 8)
    relief = look.folds * folds(rng)
    valleys = np.clip(blur(relief, 30) - relief, 0, None)
    patches = 0.6 * noise(rng, 90) + 0.4 * noise(rng, 30) + 0.25 * noise(rng, 9) + 0.15 * noise(rng, 3)
    crypts *= 1 + 0.4 * patches  # they stand out where there is much blood, and fade elsewhere
    # Light that bounces about in valleys passes more blood on its way, so these are redder, not just darker.
    blood = look.blood + look.patches * patches + look.crypts * crypts + 0.03 * valleys
    absorbance = np.multiply.outer(blood, HAEMOGLOBIN) + np.multiply.outer(1 + 0.6 * noise(rng, 70), FAT)
    height = relief + 2.8 * noise(rng, 16) + 0.5 * noise(rng, 6) + 0.5 * crypts
    vessels = list(grow(rng, trunks(rng, look.trunks)))
    for layer, (_, depth, colour) in enumerate(LAYERS):
        seen = blur(draw(vessels, layer), depth)
        absorbance += np.multiply.outer(seen, colour)
        height += 0.8 * seen  # vessels bulge a little
    slope_y, slope_x = np.gradient(blur(height, 0.8))
    light = 1 + 0.15 * np.tanh(1.1 * (LAMP[0] * slope_x + LAMP[1] * slope_y)) - 0.008 * valleys
    picture = np.array(look.tissue) * np.exp(-absorbance) * light[..., None]
    picture += (255 - picture) * gloss(rng, height)[..., None]
    inside = slice(MARGIN, MARGIN + SIZE)
    painted = Image.fromarray(np.clip(np.rint(picture[inside, inside]), 0, 255).astype(np.uint8))
    if look.size == SIZE:
        return painted
    return painted.resize((look.size, look.size)).quantize(dither=Image.Dither.NONE)


def main() -> None:
    """Write the pictures, into the given folder or, by default, where they belong."""
    for name, look in PICTURES.items():
        path = Path(sys.argv[1], Path(name).name) if len(sys.argv) > 1 else FOLDER / name
        paint(look).save(path, optimize=True)
        print(f"{path}: {path.stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
