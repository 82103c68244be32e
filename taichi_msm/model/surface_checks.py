"""Faults of a sheet that is curved at rest."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.errors import Problem
from taichi_msm.images import PictureError
from taichi_msm.model.geometry import CurvedRest
from taichi_msm.model.rest import rest_of
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_POINTS
from taichi_msm.scene.surface import RestSurface

# Tissue is refused if more than this share of its area has an isotropy error above MAX_ISOTROPY_ERROR.
MAX_COARSE_SHARE, MAX_ISOTROPY_ERROR = 0.1, 0.5

FOLD_REMEDY = "take more sheet.points, or a smoother surface"

# Aspect of cells from which square ones are advised.
MAX_ASPECT = 1.5

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
    if (fault := _fold(rest, scene)) or (scene.tissue is not None and (fault := _anisotropy(rest, surface))):
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


def _anisotropy(rest: CurvedRest, surface: RestSurface) -> str:
    errors, area = rest.isotropy_errors[rest.present], rest.present_cells.area
    share = float(area[errors > MAX_ISOTROPY_ERROR].sum() / area.sum())
    if share <= MAX_COARSE_SHARE:
        return ""
    return (
        f"{share:.0%} of the area is in cells with an isotropy error above {MAX_ISOTROPY_ERROR:g}, up to "
        f"{errors.max():.3g} at {describe_largest(rest.isotropy_errors)}; {isotropy_remedy(rest, surface)}"
    )


def aspect(rest: CurvedRest) -> float:
    """Return the aspect of cells, on an even grid r, at which the mean of E / (r A) + G r / A over corners is least."""
    if rest.origin.grid is None:
        return rest.cell_sides[0] / rest.cell_sides[1]
    across, down = np.diff(rest.position, axis=1), np.diff(rest.position, axis=0)
    totals = np.zeros(2)
    for a in (across[:-1], across[1:]):
        for b in (down[:, :-1], down[:, 1:]):
            area = np.linalg.norm(np.cross(a, b), axis=-1)
            totals += ((a * a).sum(axis=-1) / area).sum(), ((b * b).sum(axis=-1) / area).sum()
    return float(np.sqrt(totals[0] / totals[1]))


def square_points(rest: CurvedRest) -> tuple[int, int]:
    """Return the numbers of rows and columns with nearly square cells, at least those of the sheet."""
    r, (rows, cols) = aspect(rest), rest.position.shape[:2]
    return (rows, round((cols - 1) * r) + 1) if r > 1 else (round((rows - 1) / r) + 1, cols)


def isotropy_remedy(rest: CurvedRest, surface: RestSurface) -> str:
    """Return the numbers of points with nearly square cells, or the advice for sheared and uneven cells."""
    square, r = square_points(rest), aspect(rest)
    # Rhombi of 60 to 120 degrees are isotropic.
    is_oblique = np.median(np.abs(rest.present_cells.cosine)) > 0.5
    if max(r, 1 / r) >= MAX_ASPECT and not is_oblique and max(square) <= MAX_POINTS:
        return f"try sheet.points: {list(square)}, with nearly square cells"
    if surface.has_own_size and not surface.is_even:
        return "take sheet.surface.grid: even"
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
