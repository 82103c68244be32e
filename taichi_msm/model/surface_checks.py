"""Faults of a sheet that is curved at rest."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.errors import Problem
from taichi_msm.images import PictureError
from taichi_msm.model.rest import CurvedRest, rest_of
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_POINTS

# Tissue is refused if more than this share of its area has an isotropy error above MAX_ISOTROPY_ERROR.
MAX_COARSE_SHARE, MAX_ISOTROPY_ERROR = 0.1, 0.5

FOLD_REMEDY = "take more sheet.points, or a smoother surface"

# Smallest sine of the angle between the sides of a cell.
MIN_SINE = 1e-6


def surface_problems(scene: Scene) -> Iterator[Problem]:
    """Yield the first fault of a curved sheet at rest, and that of bending."""
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
    if (fault := _fold(rest, scene)) or (scene.tissue is not None and (fault := _anisotropy(rest, surface.kind))):
        yield Problem(key, fault)
    if scene.tissue is not None and scene.tissue.bending:
        text = "needs a flat sheet; with sheet.surface take pretension or foundation instead, which also limit folds"
        yield Problem(("tissue", "bending"), text)


def _fold(rest: CurvedRest, scene: Scene) -> str:
    """Return the fault of a cell without area, or turned over relative to a neighbour; empty without one."""
    normals, cells = rest.cell_normals, rest.cells
    has_area = (cells.area > MIN_SINE * cells.side_a * cells.side_b) | ~rest.present
    if not has_area.all():
        return f"the cell at {describe_largest(~has_area)} has no area; its corners must not be on a line"
    if (angle := neighbour_angles(normals, rest.present)).max(initial=0.0) > 90:
        rise, remedy = float(np.ptp(rest.position[..., 2])), FOLD_REMEDY
        if scene.sheet.surface and scene.sheet.surface.height and rise > max(scene.sheet.size):
            remedy = f"heights are in metres, and rise by {rise:.3g} m"
        return f"{describe_fold(angle)}, more than 90; {remedy}"
    return ""


def describe_fold(angles: Array) -> str:
    """Describe the largest angle between neighbouring cells, from `neighbour_angles`."""
    return f"the cell at {describe_largest(angles)} and the next one meet at {angles.max():.0f} degrees"


def _anisotropy(rest: CurvedRest, kind: str) -> str:
    errors, area = rest.isotropy_errors[rest.present], rest.present_cells.area
    share = float(area[errors > MAX_ISOTROPY_ERROR].sum() / area.sum())
    if share <= MAX_COARSE_SHARE:
        return ""
    return (
        f"{share:.0%} of the area is in cells with an isotropy error above {MAX_ISOTROPY_ERROR:g}, up to "
        f"{errors.max():.3g} at {describe_largest(rest.isotropy_errors)}; {isotropy_remedy(rest, kind)}"
    )


def isotropy_remedy(rest: CurvedRest, kind: str) -> str:
    """Return the numbers of points with nearly square cells, or the advice for sheared and uneven cells."""
    (p, q), (rows, cols) = rest.cell_sides, (count - 1 for count in rest.position.shape[:2])
    # Rhombi of 60 to 120 degrees are isotropic.
    if np.median(np.abs(rest.present_cells.cosine)) <= 0.5 and max(p / q, q / p) >= 1.5:
        finer = (rows, round(cols * p / q)) if p > q else (round(rows * q / p), cols)
        if max(finer) < MAX_POINTS:
            return f"try sheet.points: {[count + 1 for count in finer]}, with nearly square cells"
    if kind == "points":
        return "give points at even distances along lines that cross at right angles"
    return "take a less steep surface, on which cells are sheared and stretched less"


def neighbour_angles(normals: Array, present: NDArray[np.bool_]) -> Array:
    """Return the larger angle of the normal of each cell to those of the next ones [degrees], 0 without sheet."""
    angles = np.zeros(normals.shape[:2])
    for at, following in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        cosine = (normals[at] * normals[following]).sum(axis=-1)
        cosine = np.where(present[at] & present[following], cosine, 1)
        angles[at] = np.maximum(angles[at], np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return angles


def describe_largest(values: NDArray[Any]) -> str:
    """Return row and column of the first cell with the largest value, but for rounding."""
    row, column = np.unravel_index(int((values >= (1 - 1e-9) * values.max()).argmax()), values.shape)
    return f"row {row}, column {column}"
