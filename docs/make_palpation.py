"""Map published presses of a ball, and write the tables and figures of docs/palpation.md.

    PYTHONPATH=. python docs/make_palpation.py FOLDER

FOLDER has the tables of the page, from the repository that it names. Takes some seconds.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy.cluster.vq import kmeans2
from scipy.spatial import cKDTree
from scipy.spatial.distance import cdist

from benchmarks.marked import replace_marked, table
from taichi_msm.arithmetic import Array
from taichi_msm.palpation.fit import fit_presses
from taichi_msm.palpation.palpate import palpate
from taichi_msm.palpation.plane import find_plane
from taichi_msm.palpation.presses import Presses
from taichi_msm.palpation.process import fit_process
from taichi_msm.palpation.result import Palpation
from taichi_msm.palpation.scene import MARGIN_RADII

DOCS = Path(__file__).parent
PAGE, IMAGES = DOCS / "palpation.md", DOCS / "images"

# Tables, with the radius of the ball [m].
TABLES = {"liver_v2_r3": 4e-3, "beef0904_r4": 3.16e-3, "silicone_T1": 3.16e-3, "silicone_T2": 3.16e-3}

# Figures, by the table and the file of its map.
FIGURES = {
    "palpation-liver.png": ("liver_v2_r3", "map.png"),
    "palpation-silicone.png": ("silicone_T2", "map.png"),
    "palpation-curves.png": ("liver_v2_r3", "curves.png"),
}
MAX_WIDTH_PX = 1200

# Rows that are predicted from the shallower ones of a press.
DEEPEST = 2

REPEATS, PARTS = 4, 5


def deepest_rows(presses: Presses, radius: float) -> float:
    """Return the median error of the deepest rows over the peak, predicted from the other rows of all presses."""
    order = np.lexsort((-presses.depth, presses.index))
    first = np.concatenate([[0], np.cumsum(presses.rows[:-1])]).astype(int)
    is_deep = np.zeros(len(presses.depth), bool)
    is_deep[order] = np.arange(len(order)) - first[presses.index[order]] < DEEPEST
    index, depth, force = presses.index[~is_deep], presses.depth[~is_deep], presses.force[~is_deep]
    shallow = Presses(presses.places, presses.position, index, depth, force)
    fit = fit_presses(shallow, radius)
    index = presses.index[is_deep]
    predicted = fit.stiffness[index] * fit.law.force(presses.depth[is_deep] + fit.offset[index])
    error = (predicted - presses.force[is_deep]) / presses.peak[index]
    return float(np.median(np.sqrt(np.bincount(index, error**2) / DEEPEST)))


def explained(places: Array, logs: Array, labels: NDArray[np.integer]) -> float:
    """Return R^2 of the map of log K over presses that are left out by their labels."""
    predicted, constant = np.empty((2, len(logs)))
    for label in np.unique(labels):
        out = labels == label
        predicted[out], _ = fit_process(places[~out], logs[~out]).predict(places[out])
        constant[out] = logs[~out].mean()
    return 1 - float(((logs - predicted) ** 2).sum() / ((logs - constant) ** 2).sum())


def left_out(result: Palpation) -> tuple[list[float], list[float]]:
    """Return R^2 of the map of presses left out in random parts, and in blocks, of `REPEATS` repetitions."""
    places, logs = result.presses.position, np.log(result.map.fit.mean_stiffness)
    random, blocks = list[float](), list[float]()
    for seed in range(REPEATS):
        rng = np.random.default_rng(seed)
        random.append(explained(places, logs, rng.permutation(len(logs)) % PARTS))
        blocks.append(explained(places, logs, kmeans2(places, PARTS, minit="++", seed=seed)[1]))
    return random, blocks


def repeatability(first: Palpation, second: Palpation, reach: float = 2e-3) -> tuple[float, int]:
    """Return the correlation of the maps of two runs at the presses of the second near those of the first."""
    near = cdist(second.presses.position, first.presses.position).min(axis=1) < reach
    at = second.presses.position[near]
    one, other = (np.log(each.map.stiffness(at)[0]) for each in (first, second))
    return float(np.corrcoef(one, other)[0, 1]), int(near.sum())


def flatness(result: Palpation) -> tuple[float, float]:
    """Return the share of the sheet farther than a length from the presses, and the deviation of heights [m]."""
    plane = find_plane(result.presses.position, result.normal, MARGIN_RADII * result.map.fit.law.radius)
    distance = cKDTree(result.presses.position).query(plane.pixels(100, 100).reshape(-1, 3))[0]
    return float(np.mean(distance > result.map.process.length)), float(plane.places[:, 2].std())


def interval(values: list[float]) -> str:
    """Format the range of some values."""
    low, high = (f"{value:.2f}" for value in (min(values), max(values)))
    return low if low == high else f"{low} to {high}"


def law_row(name: str, result: Palpation) -> list[str]:
    """Return the row of a table in the page's first table."""
    fit, limits = result.map.fit, result.lock_interval
    low, median, high = (f"{value / 1e6:.1f}" for value in np.quantile(fit.stiffness, [0, 0.5, 1]))
    lock = "none"
    if limits is not None and limits[1] is not None:
        lock = f"{1000 * fit.law.lock:.1f} ({1000 * limits[0]:.1f} to {1000 * limits[1]:.1f}) mm"
    offset = f"{1000 * fit.prior.mean:.2f} ± {1000 * fit.prior.width:.2f} mm"
    deepest = deepest_rows(result.presses, fit.law.radius)
    numbers = f"{100 * np.median(fit.residual):.1f} %", f"{100 * deepest:.1f} %"
    return [name, str(result.presses.count), lock, f"{low} to {high}, {median}", offset, *numbers]


def map_row(name: str, result: Palpation) -> list[str]:
    """Return the row of a table in the page's second table."""
    scores, process = result.scores, result.map.process
    medians = (f"{100 * np.median(each):.1f} %" for each in (scores.map, scores.nearest, scores.constant))
    random, blocks = left_out(result)
    length = f"{1000 * process.length:.0f} mm"
    return [name, length, *medians, f"{100 * scores.coverage:.0f} %", interval(random), interval(blocks)]


def main() -> None:
    """Write the tables and figures of the page."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("folder", type=Path)
    folder: Path = parser.parse_args().folder
    results = {}
    with TemporaryDirectory() as name:
        for table_name, radius in TABLES.items():
            out = Path(name) / table_name
            file = str(folder / f"{table_name}.csv")
            results[table_name] = palpate(file, radius, out, lambda stage, done, total: None)
        for figure, (table_name, file) in FIGURES.items():
            with Image.open(Path(name) / table_name / file) as image:
                size = MAX_WIDTH_PX, round(MAX_WIDTH_PX * image.height / image.width)
                image.convert("RGB").resize(size, Image.Resampling.LANCZOS).quantize(256).save(
                    IMAGES / figure, optimize=True
                )
    head = ["table", "presses", "lock", "K [N/cm³], median", "offset", "residual", "two deepest rows"]
    laws = table(head, [law_row(name, result) for name, result in results.items()])
    head = ["table", "length", "map", "nearest press", "constant", "in 90 %", "R² at random", "R² in blocks"]
    maps = table(head, [map_row(name, result) for name, result in results.items()])
    page = PAGE.read_text(encoding="utf-8")
    for mark, text in (("laws", laws), ("maps", maps)):
        page = replace_marked(page, mark, "docs/make_palpation.py", f"{text}\n")
    PAGE.write_text(page, encoding="utf-8")
    correlation, count = repeatability(results["silicone_T1"], results["silicone_T2"])
    print(f"the maps of two runs correlate by {correlation:.2f} at {count} places")
    for name, result in results.items():
        share, height = flatness(result)
        print(f"{name}: {100 * share:.1f} % of the sheet is grey; heights above the plane: {1000 * height:.2f} mm")


if __name__ == "__main__":
    main()
