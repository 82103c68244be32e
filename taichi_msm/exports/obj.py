"""Wavefront OBJ export: a file per frame, with a common material and texture.

Texture coordinates count from the picture's lower left corner. Position, texture coordinate and normal of a vertex
share an index.

Source: Wavefront's Advanced Visualizer manual, appendix B1 (OBJ) and its specification of materials (MTL).
"""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ProgressCallback
from taichi_msm.exports.formats import one_folder_per_run
from taichi_msm.exports.inputs import (
    EXPORT_REFINE,
    FLOAT32_FORMAT,
    PICTURE_FILE,
    mass_points,
    picture_png,
    unit_normals,
)
from taichi_msm.model.surface import refine_surface
from taichi_msm.runs.directory import create_file, write_new_file
from taichi_msm.runs.finished import FinishedRun

MATERIAL_FILE = "surface.mtl"


def _write_run(run: FinishedRun, folder: Path, progress: ProgressCallback) -> list[str]:
    positions, rest, picture = run.positions(), run.rest(), picture_png(run)
    mask = rest.mask if rest else None
    if picture is not None:
        write_new_file(folder / PICTURE_FILE, picture)
    # A matte material.
    material = ["newmtl sheet", "Kd 1 1 1", "Ks 0 0 0", "illum 1", *([f"map_Kd {PICTURE_FILE}"] if picture else [])]
    write_new_file(folder / MATERIAL_FILE, "".join(f"{line}\n" for line in material).encode())
    first = refine_surface(positions[0], EXPORT_REFINE, rest)
    coordinates = _lines("vt", first.texture_coordinates * (1, -1) + (0, 1))
    corners = np.repeat(first.triangles + 1, 3, axis=1)
    faces = ("f %d/%d/%d %d/%d/%d %d/%d/%d\n" * len(corners)) % tuple(corners.ravel().tolist())
    for frame, position in enumerate(positions):
        progress(frame, run.frames)
        with io.TextIOWrapper(create_file(folder / f"{frame:04}.obj"), "ascii", newline="") as file:
            file.write(f"# {run.time[frame]:g} s, in metres\nmtllib {MATERIAL_FILE}\n")
            file.write(_lines("v", mass_points(position, mask)))
            file.write(coordinates)
            file.write(_lines("vn", unit_normals(position, mask)))
            file.write(f"usemtl sheet\n{faces}")
    return []


write = one_folder_per_run(_write_run)


def _lines(key: str, rows: NDArray[np.floating]) -> str:
    line = " ".join([key, *[FLOAT32_FORMAT] * rows.shape[1]]) + "\n"
    return (line * len(rows)) % tuple(rows.ravel().tolist())
