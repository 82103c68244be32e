"""Estimate a lump in pulled tissue, and measure the accuracy of estimated maps, for the page on fits.

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

# Positions of eight tools that stick to the surface, around its middle.
POSITIONS = [(x, y) for y in (0.2, 0.5, 0.8) for x in (0.2, 0.5, 0.8) if (x, y) != (0.5, 0.5)]

RESOLUTION = 16


def directions() -> Floats:
    """Return the directions of pull, across and down, of each tool in each picture, shape (8, 8, 2).

    All to the right; all down; alternately to the right and down; alternately to the right and up; outward; around the
    middle; and the last two with every second tool reversed.
    """
    odd, right, down = np.arange(8)[:, None] % 2, np.array([[1, 0]] * 8), np.array([[0, 1]] * 8)
    outward = np.array(POSITIONS) - 0.5
    outward /= np.linalg.norm(outward, axis=1, keepdims=True)
    around, sign = outward[:, ::-1] * (-1, 1), 1 - 2 * odd
    uniform = [right, down, np.where(odd, down, right), np.where(odd, -down, right)]
    return np.array([*uniform, outward, around, outward * sign, around * sign])


def pulled(newtons: float) -> list[dict[str, Any]]:
    """Return the tools: a probe for each of their two directions."""
    shares = directions()
    return [
        {
            "at": at,
            "total": total,
            "load": [[0, 0], *([frame, 100 * share] for frame, share in enumerate(shares[:, n, axis].tolist(), 1))],
            "radius": 0.008,
            "falloff": 150,
        }
        for n, at in enumerate(POSITIONS)
        for axis, total in enumerate(((newtons, 0, 0), (0, -newtons, 0)))
    ]


def scene_of(points: int, **more: Any) -> Scene:
    """Return scenes/tumour.yaml on a softer foundation, with these tools and a camera above it."""
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


def fit_map(truth: Scene, error: float) -> FitResult:
    """Fit the map to tracks with errors [px] of a truth with twice the points per side."""
    with tempfile.TemporaryDirectory() as directory:
        run(truth, directory, estimate_error=False)
        with np.load(Path(directory) / "tracks.npz") as archive:
            pixel, coordinates = archive["points"].astype(np.float64)[:, 1:], archive["coordinates"]
    pixel += np.random.default_rng(1).normal(0, error, pixel.shape)
    observed = {"time": np.arange(1, 9), "coordinates": coordinates, "pixel": pixel, "sigma": error}
    return fit(scene_of(31, **{"tissue.map": None}), observed, ["tissue.map"], resolution=RESOLUTION)


def factors(scene: Scene) -> Floats:
    """Return the true factors at the centres of the cells."""
    assert scene.tissue is not None
    assert scene.tissue.map is not None
    at = centres(RESOLUTION)
    return map_factors(scene.tissue.map, read_map(scene.tissue.map), at, at)


def draw(truth: Scene, result: FitResult) -> None:
    """Draw the truth, the estimate, and its errors."""
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


def coarse_truth(truth: Scene, directory: Path) -> Scene:
    """Return the truth with a map of the estimate's resolution."""
    grey = np.round(65535 * (factors(truth) - 1)).astype(np.uint16)
    Image.fromarray(grey).save(directory / "fields.png")
    assert truth.tissue is not None
    coarse = StiffnessMap(image=str(directory / "fields.png"), range=(1, 2))
    return truth.model_copy(update={"tissue": truth.tissue.model_copy(update={"map": coarse})})


def main() -> None:
    """Write the picture, and print the numbers."""
    truth = scene_of(61, **{"tissue.map.range": [1, 2]})
    result = fit_map(truth, 1.0)
    draw(truth, result)
    print("\n".join(result.summary()))
    with tempfile.TemporaryDirectory() as directory:
        coarse = coarse_truth(truth, Path(directory))
        for error in (1.0, 0.1, 0.02):
            result = fit_map(coarse, error)
            assert result.map is not None
            known, error_of = ~result.map.unknown, np.abs(result.map.factors / factors(coarse) - 1)
            errors = [f"{100 * quantile:.2g} %" for quantile in np.quantile(error_of[known], (0.5, 0.95))]
            standard_error = 100 * np.median(result.map.errors[known])
            within, seconds = (error_of[known] < 0.05).mean(), result.seconds
            print(
                f"| {error:g} px | {known.sum()} | {standard_error:.2g} % | {' | '.join(errors)} | {within:.0%} "
                f"| {result.map.range[1]:.3g} | {result.runs} | {seconds:.0f} s |",
                flush=True,
            )


if __name__ == "__main__":
    main()
