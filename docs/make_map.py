"""Find a lump in tissue that is pulled, and measure how well a map is found, for the page on fits.

    python docs/make_map.py

Writes a picture, and prints the numbers that docs/fit-map.md shows. Takes about two minutes.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from matplotlib.colors import LogNorm
from numpy.typing import NDArray
from PIL import Image

from taichi_msm import FitResult, Scene, fit, load_scene, run
from taichi_msm.fitting.tikhonov import centres
from taichi_msm.model.sheet import map_factors, read_map
from taichi_msm.plot_style import DPI, STYLE
from taichi_msm.scene.sheet import StiffnessMap

Floats = NDArray[np.float64]

ROOT = Path(__file__).parent.parent
IMAGES = ROOT / "docs" / "images"

# Eight tools that stick to the surface, around its middle.
PLACES = [(x, y) for y in (0.2, 0.5, 0.8) for x in (0.2, 0.5, 0.8) if (x, y) != (0.5, 0.5)]

RESOLUTION = 16


def directions() -> Floats:
    """Give where the tools pull, across and down, shape (8, 8, 2): in every picture each tool.

    They pull all to the right, all down, to the right and down by turns, to the right and up by turns; outward, around
    the middle, and both again, every other tool the other way.
    """
    turns, right, down = np.arange(8)[:, None] % 2, np.array([[1, 0]] * 8), np.array([[0, 1]] * 8)
    outward = np.array(PLACES) - 0.5
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    around, other = outward[:, ::-1] * (-1, 1), 1 - 2 * turns
    alike = [right, down, np.where(turns, down, right), np.where(turns, -down, right)]
    return np.array([*alike, outward, around, outward * other, around * other])


def pulled(newtons: float) -> list[dict[str, Any]]:
    """Make the tools: a probe for each of their two directions."""
    shares = directions()
    return [
        {
            "at": at,
            "total": total,
            "load": [[0, 0], *([frame, 100 * share] for frame, share in enumerate(shares[:, n, axis].tolist(), 1))],
            "radius": 0.008,
            "falloff": 150,
        }
        for n, at in enumerate(PLACES)
        for axis, total in enumerate(((newtons, 0, 0), (0, -newtons, 0)))
    ]


def scene_of(points: int, **more: Any) -> Scene:
    """Take the tissue of scenes/tumour.yaml, on a softer ground, with these tools and a camera above it."""
    return load_scene(
        ROOT / "scenes" / "tumour.yaml",
        {
            "sheet.points": [points, points],
            "tissue.foundation": 2.5e4,
            "tissue.foundation_map": None,
            "tissue.pretension": 2,
            "probes": pulled(0.1),
            "time": {"duration": 8, "frames_per_second": 1, "motion": "quasistatic"},
            "render": {"size": [1024, 1024], "camera": "top", "tracks": 30},
            "output": ["tracks"],
            **more,
        },
    )


def found(truth: Scene, error: float) -> FitResult:
    """Find the map of a truth with twice as many points a side, from its tracks with errors [px]."""
    with tempfile.TemporaryDirectory() as directory:
        run(truth, directory, estimate_error=False)
        with np.load(Path(directory) / "tracks.npz") as seen:
            pixel, coordinates = seen["points"].astype(np.float64)[:, 1:], seen["coordinates"]
    pixel += np.random.default_rng(1).normal(0, error, pixel.shape)
    observed = {"time": np.arange(1, 9), "coordinates": coordinates, "pixel": pixel, "sigma": error}
    return fit(scene_of(31, **{"tissue.map": None}), observed, ["tissue.map"], resolution=RESOLUTION)


def factors(scene: Scene) -> Floats:
    """Give the true factors at the centres of the fields."""
    assert scene.tissue is not None
    assert scene.tissue.map is not None
    places = centres(RESOLUTION)
    return map_factors(scene.tissue.map, read_map(scene.tissue.map), places, places)


def draw(truth: Scene, result: FitResult) -> None:
    """Draw the truth, what was found, and its errors."""
    assert result.map is not None
    both, errors = LogNorm(0.7, 2.2), 100 * result.map.errors
    with plt.style.context(STYLE, after_reset=True):
        figure, panels = plt.subplots(1, 3, figsize=(8.0, 2.5), layout="constrained")
        shown: tuple[tuple[Floats, str, dict[str, Any]], ...] = (
            (factors(truth), "Truth", {"norm": both}),
            (result.map.factors, "Estimate", {"norm": both}),
            (errors, "Standard error", {"cmap": "cividis", "vmin": 0}),
        )
        for axes, (values, title, options) in zip(panels, shown, strict=True):
            image = axes.imshow(values, **options)
            axes.set(title=title, xticks=[], yticks=[])
            axes.grid(visible=False)
            label = "error [%], white: unknown" if values is errors else "factor of young"
            bar = figure.colorbar(image, ax=axes, label=label, shrink=0.9)
            if values is not errors:
                bar.set_ticks([0.7, 1, 1.4, 2], labels=["0.7", "1", "1.4", "2"])
                bar.minorticks_off()
        figure.savefig(IMAGES / "fit-map.png", dpi=DPI)
        plt.close(figure)


def in_fields(truth: Scene, directory: Path) -> Scene:
    """Give the truth a map that has as few fields as the one that is found."""
    grey = np.round(65535 * (factors(truth) - 1)).astype(np.uint16)
    Image.fromarray(grey).save(directory / "fields.png")
    assert truth.tissue is not None
    own = StiffnessMap(image=str(directory / "fields.png"), range=(1, 2))
    return truth.model_copy(update={"tissue": truth.tissue.model_copy(update={"map": own})})


def main() -> None:
    """Write the picture, and print the numbers."""
    truth = scene_of(61, **{"tissue.map.range": [1, 2]})
    result = found(truth, 1.0)
    draw(truth, result)
    print("\n".join(result.summary()))
    with tempfile.TemporaryDirectory() as directory:
        fields = in_fields(truth, Path(directory))
        for error in (1.0, 0.1, 0.02):
            result = found(fields, error)
            assert result.map is not None
            known, off = ~result.map.unknown, np.abs(result.map.factors / factors(fields) - 1)
            errors = [f"{100 * one:.2g} %" for one in np.quantile(off[known], (0.5, 0.95))]
            told = 100 * np.median(result.map.errors[known])
            within, seconds = (off[known] < 0.05).mean(), result.seconds
            print(
                f"| {error:g} px | {known.sum()} | {told:.2g} % | {' | '.join(errors)} | {within:.0%} "
                f"| {result.map.range[1]:.3g} | {result.runs} | {seconds:.0f} s |",
                flush=True,
            )


if __name__ == "__main__":
    main()
