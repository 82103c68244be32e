"""Faults of a mask, and parts of the sheet that nothing holds."""

from __future__ import annotations

from collections.abc import Iterator

from taichi_msm.errors import Problem
from taichi_msm.images import PictureError
from taichi_msm.model.mask import Mask
from taichi_msm.scene.scene import Scene

KEY = "sheet", "mask"


def mask_problems(scene: Scene) -> Iterator[Problem]:
    """Yield the first fault of a mask: its file, no cell, or parts that meet in a point."""
    if scene.sheet.mask is None:
        return
    try:
        is_sheet = scene.sheet.mask.pixels.is_sheet
    except PictureError as error:
        yield Problem(KEY, str(error))
        return
    mask = Mask.at_cells(is_sheet, scene.sheet.points)
    if not mask.cells.any():
        colour, remedy = ("black", "remove invert") if scene.sheet.mask.invert else ("white", "set invert: true")
        yield Problem(KEY, f"no cell is sheet, as none has a {colour} pixel at its middle; {remedy}, or draw the sheet")
    elif pinched := next(mask.pinched_points(), None):
        row, column = pinched
        text = f"two parts meet only in the point at row {row}, column {column}; join them by a cell, or part them"
        yield Problem(KEY, text)
