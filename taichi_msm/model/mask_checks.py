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
    # The tool is at the first keyframe before it, and at the last one after it.
    before, after = min(keys[0, 0], 0) - 1, max(keys[-1, 0], duration) + 1
    keys = np.concatenate([[[before, *keys[0, 1:]]], keys, [[after, *keys[-1, 1:]]]])
    for (begin, *first), (end, *last) in pairwise(keys.tolist()):
        start, stop = max(begin, 0.0), min(end, duration)
        if end <= start or begin > duration:  # outside the scene, or a jump
            continue
        velocity = np.subtract(last, first) / (end - begin)
        origin, offset = np.array(first) + (start - begin) * velocity, (stop - start) * velocity
        if (gap := rest.first_gap(origin, origin + offset)) is not None:
            across, down = origin + gap * offset
            time = f" at {start + gap * (stop - start):.3g} s" if len(keys) > 3 else ""
            return f"[{across:.3g}, {down:.3g}]{time}"
    return ""
