"""Work and precision of drawing: every refinement and supersampling, for the most deformed frame."""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray
from pydantic import BaseModel

from taichi_msm.progress import Count
from taichi_msm.render.rasterizer import Drawing
from taichi_msm.scene import Scene
from taichi_msm.scenefile import budget
from taichi_msm.study.result import Drawn, Study
from taichi_msm.system import resources

REFINES = (0, 1, 2, 5, 10, 20)
SUPERSAMPLES = (1, 2, 3, 4)

# Settings of the reference picture, if there is memory for it; they must be finer than all that are compared with it.
FINEST = {"refine": 40, "supersample": 8}

ROUNDS = 5

Picture = NDArray[np.uint8]


def measure_pictures(
    scene: Scene, position: NDArray[Any], texture: Picture, quick: bool, study: Study, progress: Count
) -> None:
    """Draw the reference picture, then every setting, taking turns; `quick` varies the settings one at a time.

    The positions of the points [m] have the shape (rows, cols, 3), the picture on the sheet (height, width, 3).
    """
    position = np.ascontiguousarray(position, np.float32)
    memory = resources.available_memory() // 2
    finest = _with_render(scene, **FINEST)
    if budget.drawing_bytes(finest) > memory:
        study.notes.append("drawing was not measured: there is no memory for a picture fine enough to compare with")
        return
    truth = Drawing(finest, texture).draw(position)
    drawings, compared = [], list(settings(scene, quick))
    for number, (refine, supersample) in enumerate(compared):
        progress(number, len(compared) * ROUNDS)
        changed = _with_render(scene, refine=refine, supersample=supersample)
        memory -= budget.drawing_bytes(changed)
        if memory < 0:
            study.notes.append(f"drawing was not measured from refine {refine}, supersample {supersample} on: memory")
            break
        drawing = Drawing(changed, texture)
        drawings.append(drawing)
        picture = drawing.draw(position)
        apart = int(np.abs(picture.astype(np.int16) - truth).max())
        study.drawing.append(Drawn(refine, supersample, psnr(picture, truth), apart))
    for round_ in range(ROUNDS):
        for number, (drawing, drawn) in enumerate(zip(drawings, study.drawing, strict=True)):
            progress(round_ * len(drawings) + number, len(drawings) * ROUNDS)
            start = time.perf_counter()
            drawing.draw(position)
            drawn.samples.append(time.perf_counter() - start)


def settings(scene: Scene, quick: bool) -> Iterator[tuple[int, int]]:
    """List refinements and supersamplings to compare; `quick`: with one of them as in the scene."""
    own = scene.render
    for supersample in sorted({*SUPERSAMPLES, own.supersample}):
        for refine in sorted({*REFINES, own.refine}):
            if not quick or refine == own.refine or supersample == own.supersample:
                yield refine, supersample


def psnr(picture: Picture, truth: Picture) -> float | None:
    """Give the peak signal-to-noise ratio [dB], 10 log10(255^2 / mean square error); None where they are the same."""
    square = float(np.mean((picture.astype(np.float64) - truth) ** 2))
    return 10 * math.log10(255**2 / square) if square > 0 else None


def _with_render(scene: Scene, **changes: int) -> Scene:
    # Not checked, because the settings of the reference picture exceed the limits of a scene.
    return scene.model_copy(update={"render": BaseModel.model_copy(scene.render, update=changes)})
