"""Draw ``frame.jpg`` and ``frame-depth.png``, a frame of an endoscope in a stomach and the depth of its pixels.

The wall is a bowl with rugae, winding folds. Crypts and patches of blood mottle its mucosa; as in make_mucosa.py, pale
tissue is darkened by blood. taichi_msm draws it as wet tissue in the light of the endoscope.

Usage: ``python make_frame.py [FOLDER]``
"""

import sys
import tempfile
from pathlib import Path

import numpy as np
from make_mucosa import (  # type: ignore[import-not-found]
    CANVAS,
    FAT,
    HAEMOGLOBIN,
    LAYERS,
    Field,
    blur,
    draw,
    grow,
    honeycomb,
    noise,
    trunks,
)
from PIL import Image

from taichi_msm import Scene, run

SIDE = 0.16  # of the wall [m]
FOLD = 0.0048  # height of the rugae [m]
BOWL = 0.11  # radius of the bowl [m]
SIZE = 480, 384  # of the frame [px]
UNIT = 2e-5  # of the depth [m]
CAMERA = {"eye": [0.006, -0.042, 0.068], "target": [0.002, -0.008, 0.006], "fov": 62}

TISSUE = np.array([246.0, 186.0, 150.0])  # RGB of bloodless mucosa


def rugae(rng: np.random.Generator) -> Field:
    """Return the height of the folds, from 0 to 1."""
    y, x = np.indices((CANVAS, CANVAS)) / CANVAS
    phase = 8.5 * (0.92 * x + 0.30 * y) + 0.75 * noise(rng, 95) + 0.25 * noise(rng, 38)
    presence = 1 / (1 + np.exp(-1.8 * noise(rng, 75) - 1.2))
    return blur(np.abs(np.sin(np.pi * phase)) ** 1.95 * presence, 9)


def paint(rng: np.random.Generator, folds: Field, crypts: Field) -> Image.Image:
    """Return the picture of the wall."""
    valleys = np.clip(blur(folds, 26) - folds, 0, None)
    patches = 0.6 * noise(rng, 80) + 0.4 * noise(rng, 24) + 0.2 * noise(rng, 6)
    blood = np.clip(0.52 + 0.13 * patches + 0.13 * crypts + 0.55 * valleys, 0.1, None)
    absorbance = np.multiply.outer(blood, HAEMOGLOBIN) + np.multiply.outer(1.6 + 0.7 * noise(rng, 60), FAT)
    vessels = list(grow(rng, trunks(rng, 5)))
    for layer, (_, blurred, colour) in enumerate(LAYERS[:3]):
        absorbance += 0.5 * np.multiply.outer(blur(draw(vessels, layer), blurred + 0.6), colour)
    return Image.fromarray(np.clip(np.rint(TISSUE * np.exp(-absorbance)), 0, 255).astype(np.uint8))


def heights(rng: np.random.Generator, folds: Field, crypts: Field) -> Field:
    """Return the heights of the wall [m]."""
    axis = (np.arange(CANVAS) + 0.5) / CANVAS * SIDE - SIDE / 2
    from_axis = np.minimum(np.hypot(axis, axis[:, None]), 0.9 * BOWL)
    return FOLD * folds + BOWL - np.sqrt(BOWL**2 - from_axis**2) + 1.2e-4 * noise(rng, 5) + 6e-5 * crypts


def write_wall(folder: Path) -> dict[str, object]:
    """Write wall.png and wall.npy, the picture and heights of the wall; return sections of a scene with both."""
    rng = np.random.default_rng(21)
    folds, crypts = rugae(rng), honeycomb(rng, 6.5)
    paint(rng, folds, crypts).save(folder / "wall.png")
    np.save(folder / "wall.npy", heights(rng, folds, crypts))
    return {
        "image": str(folder / "wall.png"),
        "sheet": {
            "points": [401, 401],
            "size": [SIDE, SIDE],
            "surface": {"height": {"file": str(folder / "wall.npy"), "unit": "m"}},
        },
        "time": {"duration": 1, "frames_per_second": 1, "motion": "quasistatic"},
        "render": {
            "size": list(SIZE),
            "refine": 2,
            "supersample": 4,
            "camera": CAMERA,
            "shading": "tissue",
            "light": {"ambient": 0.06, "gloss": 0.5, "relief": 0.06},
        },
        "output": ["png", "depth"],
    }


def main() -> None:
    """Write both, into the given folder or, by default, beside this script."""
    folder = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).parent
    with tempfile.TemporaryDirectory() as name:
        out = Path(name) / "out"
        run(Scene(springs={"structural": 1}, **write_wall(Path(name))), out, estimate_error=False)
        with Image.open(out / "frames" / "0000.png") as frame:
            frame.convert("RGB").save(folder / "frame.jpg", quality=90)
        with Image.open(out / "depth" / "0000.tiff") as depths:
            counts = np.rint(np.asarray(depths) / UNIT).astype(np.uint16)
    Image.fromarray(counts).save(folder / "frame-depth.png", optimize=True)
    print(f"{1000 * UNIT * counts.min():.1f} to {1000 * UNIT * counts.max():.1f} mm deep")
    for file in ("frame.jpg", "frame-depth.png"):
        print(f"{folder / file}: {(folder / file).stat().st_size / 1024:.0f} KiB")


if __name__ == "__main__":
    main()
