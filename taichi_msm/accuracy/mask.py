"""Cells and parts of a sheet with a mask: line and record of `check`, and the note about parts that nothing holds."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
from typing_extensions import TypedDict

from taichi_msm.model.plan import Plan
from taichi_msm.model.rest import rest_of
from taichi_msm.scene.scene import Scene


class MaskRecord(TypedDict):
    """A sheet with a mask, as printed by `check`."""

    cells: int  # that are sheet
    rectangle: int  # number of all cells
    parts: int  # number of connected parts


def mask_record(scene: Scene) -> MaskRecord | None:
    """Return the record of a sheet with a mask; None without one."""
    if (mask := rest_of(scene.sheet).mask) is None:
        return None
    return {"cells": int(mask.cells.sum()), "rectangle": mask.cells.size, "parts": int(mask.parts.max())}


def describe_mask(scene: Scene) -> Iterator[str]:
    """Yield a line about the cells and parts of a sheet with a mask."""
    if record := mask_record(scene):
        parts = f"{record['parts']} part{'s' * (record['parts'] > 1)}"
        yield f"mask: {record['cells']} of {record['rectangle']} cells, {parts}"


def mask_notes(plan: Plan) -> Iterator[str]:
    """Yield a note about parts that are neither fixed, nor clamped, nor on a foundation."""
    mask = rest_of(plan.scene.sheet).mask
    loose, tissue = plan.loose_parts, plan.scene.tissue
    if mask is not None and loose and tissue is not None and tissue.foundation_stiffness == 0:
        row, column = np.argwhere(mask.parts == loose[0])[0].tolist()
        place = f"with the cell at row {row}, column {column}"
        subject, pronoun = f"the part {place} is", "it"
        if len(loose) > 1:
            subject, pronoun = f"{len(loose)} parts, the first one {place}, are", "them"
        remedy = f"set sheet.fixed or tissue.foundation, or remove {pronoun} from the mask"
        yield f"sheet.mask: {subject} neither fixed nor on a foundation, so any load moves {pronoun} away; {remedy}"
