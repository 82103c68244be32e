"""Files of a fit: fit.json, scene.yaml, copies of the scene's pictures, fit.png, and the pictures of a map.

Machine tests after the first one have scenes of their own, scene-1.yaml and so on.
"""

from __future__ import annotations

import shutil
from pathlib import Path

import numpy as np
import yaml
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.errors import printable
from taichi_msm.fitting.result import FitResult, FittedMap, sixteen_bits
from taichi_msm.runs.directory import Publication, PublicationSpec, create_file, write_new_file
from taichi_msm.scene.scene import Scene
from taichi_msm.system.compiler import versions

RECORD, SCENE, PLOT, PICTURES = "fit.json", "scene.yaml", "fit.png", "pictures"

MAP, ERRORS = FittedMap.FILE, "map-error.png"

PATTERNS = (r"fit\.json", r"scene(-\d+)?\.yaml", r"fit\.png", r"map\.png", r"map-error\.png", rf"{PICTURES}/.+")


def publication(directory: Path) -> Publication:
    """Return the atomic replacement of a fit in a directory."""
    spec = PublicationSpec("fit", RECORD, PATTERNS, lambda record: {RECORD, *record["files"]}.__contains__)
    return Publication(directory, spec, [RECORD, SCENE, PLOT, MAP, ERRORS])


def write_report(result: FitResult, published: Publication) -> None:
    """Write and publish the files of a fit; without matplotlib, skip fit.png and add a note to the result."""
    folder = published.new_folder
    names: dict[str, str] = {}
    for n, scene in enumerate([result.scene, *result.other_scenes]):
        name = f"scene-{n}.yaml" if n else SCENE
        write_new_file(folder / name, _scene_text(result, scene, folder, names).encode())
    if result.map is not None:
        _write_png(result.map.grey, folder / MAP)
        # White cells are unknown, or have an error of at least 100 %.
        _write_png(sixteen_bits(np.nan_to_num(result.map.errors, nan=1.0).clip(0, 1)), folder / ERRORS)
    try:
        from taichi_msm.fitting.plots import plot
    except ImportError:
        message = 'fit.png is left out, as matplotlib is not installed; pip install "taichi-msm[report]"'
        result.notes.append(message)
    else:
        with create_file(folder / PLOT) as file:
            plot(result, file)
    published.publish_record({**result.as_json(), "versions": versions()})


def _write_png(grey: NDArray[np.uint16], path: Path) -> None:
    with create_file(path) as file:
        Image.fromarray(grey).save(file, "PNG")


def _scene_text(result: FitResult, scene: Scene, folder: Path, names: dict[str, str]) -> str:
    """Format a fitted scene, and copy its pictures to the folder; `names`: names of the copies by path."""

    def copy(path: str) -> str:
        if path not in names:
            name, number = Path(path).name, 1
            while f"{PICTURES}/{name}" in names.values():
                number += 1
                name = f"{Path(path).stem}-{number}{Path(path).suffix}"
            (folder / PICTURES).mkdir(exist_ok=True)
            shutil.copyfile(path, folder / PICTURES / name)
            names[path] = f"{PICTURES}/{name}"
        return names[path]

    if result.map is not None and scene.tissue is not None:
        # The fitted map is written by `write_report`, and not copied; another picture may have its name.
        scene = scene.model_copy(update={"tissue": scene.tissue.model_copy(update={"map": None})})
    data = scene.with_pictures(copy).model_dump(mode="json", exclude_none=True)
    if result.map is not None:
        data["tissue"]["map"] = {"image": MAP, "range": list(result.map.range)}
    text = yaml.safe_dump(data, sort_keys=False, default_flow_style=None, width=120, allow_unicode=True)
    summary = (
        ", ".join(f"{key} {estimate.value:.6g}" for key, estimate in result.parameters.items()) or f"tissue.map, {MAP}"
    )
    return f"# Fitted to {printable(result.observations[0].name)}: {printable(summary)}; more in {RECORD}.\n{text}"
