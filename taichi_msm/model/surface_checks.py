"""Checks of a curved sheet at rest: faults of its cells, its record for run.json, and notes."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypedDict

from taichi_msm.errors import Problem
from taichi_msm.images import PictureError
from taichi_msm.model.cells import cell_stiffness, isotropy_errors
from taichi_msm.model.rest import CurvedRest, rest_of
from taichi_msm.scene.scene import Scene

# A sheet is refused if a larger share of its area than this has a larger isotropy error than that.
MAX_COARSE_SHARE, MAX_ISOTROPY_ERROR = 0.1, 0.5

# Notes warn from these on: mean isotropy error, angle between neighbouring cells, step of heights in sides of a cell.
NOTED_ISOTROPY_ERROR, NOTED_ANGLE_DEGREES, NOTED_STEP = 0.1, 45.0, 1 / 20

Array = NDArray[np.float64]


class IsotropyRecord(TypedDict):
    """Isotropy errors of the cells, see `isotropy_errors`."""

    mean: float  # over the area
    worst: float


class SurfaceRecord(TypedDict):
    """A curved sheet at rest, as written to run.json."""

    kind: str
    sha256: str | None  # of the file
    sides: list[float]  # shortest and longest mean side of a cell [m]
    isotropy_error: IsotropyRecord
    clamped: int  # cells with a spring whose stiffness would be negative
    filled: float  # share of pixels without depth


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
        return f"the cell at {_place(is_flat)} has no area; move its corners apart"
    if (angle := _neighbour_angles(normals)).max(initial=0.0) > 90:
        return f"the cells at {_place(angle > 90)} are turned over; give a surface without folds that overlap"
    return ""


def _anisotropy(rest: CurvedRest) -> str:
    errors, area = isotropy_errors(rest.cells), rest.cells.area
    share = float(area[errors > MAX_ISOTROPY_ERROR].sum() / area.sum())
    if share <= MAX_COARSE_SHARE:
        return ""
    worst = np.unravel_index(int(errors.argmax()), errors.shape)
    return (
        f"{share:.0%} of the area is in cells with an isotropy error above {MAX_ISOTROPY_ERROR:g}, up to "
        f"{errors.max():.3g} at row {worst[0]}, column {worst[1]}; {_isotropy_remedy(rest)}"
    )


def _isotropy_remedy(rest: CurvedRest) -> str:
    """Return the numbers of points with nearly square cells, or the advice for sheared cells."""
    p, q = rest.cell_sides
    if max(p / q, q / p) < 1.5:
        return "its cells are sheared: give points along lines that cross at right angles"
    rows, cols = (count - 1 for count in rest.position.shape[:2])
    return f"try sheet.points: [{rows + 1}, {max(1, round(cols * p / q)) + 1}], with nearly square cells"


def _neighbour_angles(normals: Array) -> Array:
    """Return the larger angle of the normal of a cell to those of the next ones [degrees], shape (rows, cols)."""
    angles = np.zeros(normals.shape[:2])
    for at, following in ((np.s_[:-1], np.s_[1:]), (np.s_[:, :-1], np.s_[:, 1:])):
        cosine = (normals[at] * normals[following]).sum(axis=-1)
        angles[at] = np.maximum(angles[at], np.degrees(np.arccos(np.clip(cosine, -1, 1))))
    return angles


def _place(is_faulty: NDArray[np.bool_]) -> str:
    row, column = np.unravel_index(int(is_faulty.argmax()), is_faulty.shape)
    return f"row {row}, column {column}"


def surface_record(scene: Scene) -> SurfaceRecord | None:
    """Return the record of a curved sheet at rest; None for a flat one."""
    rest, surface = rest_of(scene.sheet), scene.sheet.surface
    if not isinstance(rest, CurvedRest) or surface is None:
        return None
    errors, area, file = isotropy_errors(rest.cells), rest.cells.area, surface.file
    return {
        "kind": surface.kind,
        "sha256": file.sha256 if file else None,
        "sides": [rest.shortest_side, rest.longest_side],
        "isotropy_error": {"mean": float((errors * area).sum() / area.sum()), "worst": float(errors.max())},
        "clamped": int(cell_stiffness(rest.cells, 1.0).is_clamped.sum()),
        "filled": 0.0,
    }


def surface_notes(scene: Scene) -> Iterator[str]:
    """Yield notes about cells, steps of heights and sharp folds of a curved sheet."""
    rest, record, surface = rest_of(scene.sheet), surface_record(scene), scene.sheet.surface
    if not isinstance(rest, CurvedRest) or record is None or surface is None:
        return
    if scene.tissue is not None and (mean := record["isotropy_error"]["mean"]) > NOTED_ISOTROPY_ERROR:
        yield (
            f"sheet.surface: the springs deviate from isotropic tissue by {mean:.3g} on the mean, up to "
            f"{record['isotropy_error']['worst']:.3g}; {_isotropy_remedy(rest)}"
        )
    file, side = surface.file, min(rest.cell_sides)
    if surface.height and file and file.step > NOTED_STEP * side:
        yield (
            f"sheet.surface: heights in steps of {file.step:.3g} m, over a twentieth of a cell's side, {side:.3g} m; "
            "take a picture of 16 bits or an array"
        )
    if (angle := float(_neighbour_angles(rest.cell_normals).max(initial=0.0))) > NOTED_ANGLE_DEGREES:
        at = _place(_neighbour_angles(rest.cell_normals) == angle)
        yield f"sheet.surface: cells at {at} meet at {angle:.0f} degrees; take more points there, or a smoother surface"


def rest_pressure(rest: CurvedRest, pulls: Array, free: NDArray[np.bool_]) -> float:
    """Return the largest pressure [Pa] that balances the sums of the tensions at rest [N], shape (rows, cols, 3)."""
    along = np.abs((pulls * rest.point_normals).sum(axis=-1)) / rest.areas
    return float(along[free].max(initial=0.0))


def describe_cells(rest: CurvedRest) -> str:
    """Format the sides, aspect ratios and angles of the cells."""
    cells = rest.cells
    aspect = np.maximum(cells.side_a / cells.side_b, cells.side_b / cells.side_a)
    angles = np.degrees(np.arccos(cells.cosine))
    sides = f"{rest.shortest_side:.3g} to {rest.longest_side:.3g} m"
    return f"sides {sides}, aspect up to {aspect.max():.3g}, angles {angles.min():.0f} to {angles.max():.0f} degrees"
