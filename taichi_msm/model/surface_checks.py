"""Faults of a sheet that is curved at rest."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import Problem
from taichi_msm.images import PictureError
from taichi_msm.model.rest import CurvedRest, rest_of
from taichi_msm.scene.scene import Scene

# A sheet is refused if a larger share of its area than this has a larger isotropy error than that.
MAX_COARSE_SHARE, MAX_ISOTROPY_ERROR = 0.1, 0.5

Array = NDArray[np.float64]


def surface_problems(scene: Scene) -> Iterator[Problem]:
    """Yield the first fault of a sheet that is curved at rest."""
    surface = scene.sheet.surface
    if surface is None:
        return
    key = "sheet", "surface", surface.kind
    try:
        rest = rest_of(scene.sheet)
    except PictureError as error:
        yield Problem(("sheet", "surface", *surface.file_key), str(error))
        return
    assert isinstance(rest, CurvedRest)
    if (fault := _fold(rest)) or (scene.tissue is not None and (fault := _anisotropy(rest))):
        yield Problem(key, fault)
    if scene.tissue is not None and scene.tissue.bending:
        text = "needs a flat sheet; remove bending, or surface, as wide folds hold by pretension or foundation"
        yield Problem(("tissue", "bending"), text)


def _fold(rest: CurvedRest) -> str:
    """Return the fault of a cell without area, or turned over relative to a neighbour; empty without one."""
    normals = rest.cell_normals
    is_flat = np.isnan(normals[..., 0])
    if is_flat.any():
        return f"the cell at {describe_place(is_flat)} has no area; move its corners apart"
    if (angle := neighbour_angles(normals)).max(initial=0.0) > 90:
        return f"the cells at {describe_place(angle > 90)} are turned over; give a surface without folds that overlap"
    return ""


def _anisotropy(rest: CurvedRest) -> str:
    errors, area = rest.isotropy_errors, rest.cells.area
    share = float(area[errors > MAX_ISOTROPY_ERROR].sum() / area.sum())
    if share <= MAX_COARSE_SHARE:
        return ""
    worst = np.unravel_index(int(errors.argmax()), errors.shape)
    return (
        f"{share:.0%} of the area is in cells with an isotropy error above {MAX_ISOTROPY_ERROR:g}, up to "
        f"{errors.max():.3g} at row {worst[0]}, column {worst[1]}; {isotropy_remedy(rest)}"
    )


def isotropy_remedy(rest: CurvedRest) -> str:
    """Return the numbers of points with nearly square cells, or the advice for sheared cells."""
    p, q = rest.cell_sides
    if max(p / q, q / p) < 1.5:
        return "its cells are sheared: give points along lines that cross at right angles"
    rows, cols = (count - 1 for count in rest.position.shape[:2])
    return f"try sheet.points: [{rows + 1}, {max(1, round(cols * p / q)) + 1}], with nearly square cells"


def neighbour_angles(normals: Array) -> Array:
    """Return the larger angle of the normal of a cell to those of the next ones [degrees], shape (rows, cols)."""
    angles = np.zeros(normals.shape[:2])
    for at, following in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        cosine = (normals[at] * normals[following]).sum(axis=-1)
        angles[at] = np.maximum(angles[at], np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return angles


def describe_place(is_faulty: NDArray[np.bool_]) -> str:
    """Return row and column of the first faulty cell."""
    row, column = np.unravel_index(int(is_faulty.argmax()), is_faulty.shape)
    return f"row {row}, column {column}"
