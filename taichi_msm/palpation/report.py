"""Files of a palpation: fit.json, places.csv, predicted.csv, map.png, curves.png, scene.yaml with its pictures."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from taichi_msm.palpation.predict import NORMAL_95
from taichi_msm.palpation.result import Palpation
from taichi_msm.palpation.scene import SCENE, STIFFNESS, TISSUE, write_scene
from taichi_msm.runs.directory import Publication, PublicationSpec, create_file, write_new_file
from taichi_msm.system.compiler import versions

RECORD, PLACES, PREDICTED, MAP, CURVES = "fit.json", "places.csv", "predicted.csv", "map.png", "curves.png"

NAMES = (RECORD, PLACES, PREDICTED, MAP, CURVES, SCENE, STIFFNESS, TISSUE)
PATTERNS = tuple(name.replace(".", r"\.") for name in NAMES)


def publication(directory: Path) -> Publication:
    """Return the atomic replacement of a map in a directory."""
    spec = PublicationSpec("palpation", RECORD, PATTERNS, lambda record: {RECORD, *record["files"]}.__contains__)
    return Publication(directory, spec, NAMES)


def write_report(result: Palpation, published: Publication) -> None:
    """Write and publish the files; without matplotlib, skip its figures and add a note to the result."""
    folder, presses, fit = published.new_folder, result.presses, result.map.fit
    width = np.exp(NORMAL_95 * fit.error)
    numbers = [
        *presses.position.T,
        fit.stiffness,
        fit.stiffness / width,
        fit.stiffness * width,
        fit.offset,
        fit.residual,
    ]
    header = ["place", "x", "y", "z", "stiffness", "low", "high", "offset", "residual"]
    _write_csv(folder / PLACES, header, presses.places, numbers)
    if result.predicted is not None:
        others, forces = result.predicted
        labels = [others.places[n] for n in others.index]
        _write_csv(folder / PREDICTED, ["place", "depth", "force", "low", "high"], labels, [others.depth, *forces])
    if note := write_scene(folder, result):
        result.notes.append(note)
    try:
        from taichi_msm.palpation.plots import plot_curves, plot_map
    except ImportError:
        missing = f'{MAP} and {CURVES} are left out, as matplotlib is not installed; pip install "taichi-msm[report]"'
        result.notes.append(missing)
    else:
        for name, plot in ((MAP, plot_map), (CURVES, plot_curves)):
            with create_file(folder / name) as file:
                plot(result, file)
    published.publish_record({**result.as_json(), "versions": versions()})


def _write_csv(path: Path, header: Sequence[str], labels: Iterable[str], columns: Sequence[Any]) -> None:
    """Write labels and columns of numbers."""
    text = io.StringIO(newline="")
    writer = csv.writer(text, lineterminator="\n")
    writer.writerow(header)
    writer.writerows([label, *(f"{value:.8g}" for value in row)] for label, *row in zip(labels, *columns, strict=True))
    write_new_file(path, text.getvalue().encode())
