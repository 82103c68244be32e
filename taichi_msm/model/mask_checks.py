"""Faults of a mask, and parts of the sheet that nothing holds."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import pairwise

import numpy as np

from taichi_msm.errors import Problem
from taichi_msm.images import PictureError
from taichi_msm.model.geometry import Rest
from taichi_msm.model.mask import Mask
from taichi_msm.model.rest import rest_of
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.tools import Probe

KEY = "sheet", "mask"


def mask_problems(scene: Scene) -> Iterator[Problem]:
    """Yield the first fault of a mask: its file, no cell, or parts that meet in a point; else tools on no sheet."""
    if scene.sheet.mask is None:
        return
    try:
        is_sheet = scene.sheet.mask.pixels.is_sheet
    except PictureError as error:
        yield Problem(KEY, str(error))
        return
    if scene.calibrated_size is None:
        mask = Mask.at_cells(is_sheet, scene.sheet.points)
    else:
        # Cells of a picture by a camera follow from the surface, whose faults are reported separately.
        try:
            mask = rest_of(scene.sheet).mask or Mask(np.empty((0, 0), bool))
        except PictureError:
            return
    if not mask.cells.any():
        colour, remedy = ("black", "remove invert") if scene.sheet.mask.invert else ("white", "set invert: true")
        yield Problem(KEY, f"no cell is sheet, as none has a {colour} pixel at its middle; {remedy}, or draw the sheet")
    elif pinched := next(mask.pinched_points(), None):
        row, column = pinched
        text = f"two parts meet only in the point at row {row}, column {column}; join them by a cell, or part them"
        yield Problem(KEY, text)
    else:
        yield from place_problems(scene, rest_of(scene.sheet))


def place_problems(scene: Scene, rest: Rest) -> Iterator[Problem]:
    """Yield a problem for each force-controlled tool that is on no sheet at any time."""
    for index, probe in enumerate(scene.probes):
        if not probe.moved and (place := _place_without_sheet(probe, rest, scene.time.duration)):
            moves = isinstance(probe.at[0], tuple)
            remedy = "move the tool onto the sheet" + (", over holes by two keyframes at one time" if moves else "")
            yield Problem(("probes", index, "at"), f"{place} is on no sheet, see sheet.mask; {remedy}")


def _place_without_sheet(probe: Probe, rest: Rest, duration: float) -> str:
    """Describe the first place and time at which a force-controlled tool is on no sheet; empty if there is none."""
    keys = np.array(probe.at if isinstance(probe.at[0], tuple) else ((0.0, *probe.at),), dtype=float)
    # The tool stays where its last keyframe is.
    keys = np.concatenate([keys, [[max(keys[-1, 0], duration) + 1, *keys[-1, 1:]]]])
    for (begin, *first), (end, *last) in pairwise(keys.tolist()):
        start, offset = np.array(first), np.array(last) - first
        share = min(1.0, (duration - begin) / (end - begin)) if end > begin else -1.0
        if share >= 0 and (gap := rest.first_gap(start, start + share * offset)) is not None:
            across, down = start + gap * share * offset
            time = f" at {begin + gap * share * (end - begin):.3g} s" if len(keys) > 2 else ""
            return f"[{across:.3g}, {down:.3g}]{time}"
    return ""
