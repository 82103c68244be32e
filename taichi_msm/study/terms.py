"""The cost of each term of the model: the time of a step without it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing

from taichi_msm.physics.plan import Plan
from taichi_msm.physics.planning import make_plan
from taichi_msm.physics.solver import Dynamics
from taichi_msm.progress import Count
from taichi_msm.scene import Scene
from taichi_msm.study.result import Term
from taichi_msm.system.runtime import Device

ROUNDS = 9


class TermStudy:
    """Measures the time of a step with each term left out in turn.

    Args:
        plan: of the scene.
        device: what `runtime.start` returned.
        sample: approximate time of one measurement [s].
        progress: called with the measurements done and all of them; may raise KeyboardInterrupt.

    Attributes:
        results: the whole scene first.
    """

    def __init__(self, plan: Plan, device: Device, sample: float, progress: Count) -> None:
        self._device = device
        # All variants have the steps of the whole scene: without a spring the automatic step would be another.
        self._grid = plan.grid
        grid = {"steps_per_frame": plan.grid.steps_per_frame, "precision": plan.grid.precision}
        self._plans = [make_plan(scene, plan.image).with_grid(**grid) for _, scene in variants(plan.scene)]
        self.results = [Term(without) for without, _ in variants(plan.scene)]
        self._sample = sample
        self._progress = progress

    def run(self) -> None:
        """Compile every variant, and then let them step in turn."""
        with ExitStack() as opened:
            sheets: list[Dynamics] = []
            for plan in self._plans:
                self._progress(0, len(self._plans))
                sheets.append(opened.enter_context(closing(Dynamics(plan, self._device))))
                sheets[-1].compile()
            frames = self._frames(sheets[0])
            for round_ in range(ROUNDS):
                for number, (term, sheet) in enumerate(zip(self.results, sheets, strict=True)):
                    self._progress(round_ * len(sheets) + number, ROUNDS * len(sheets))
                    # From rest, so that all variants step through the same part of the scene.
                    sheet.restart(sheet.plan)
                    term.samples.append(_step_seconds(sheet, frames))

    def _frames(self, whole: Dynamics) -> int:
        """Count the frames that a measurement takes."""
        seconds = _step_seconds(whole, 1) * self._grid.steps_per_frame
        return max(1, min(self._grid.frames, round(self._sample / seconds)))


# The terms of a sheet that can be left out, and the values that leave them out.
SPRING_TERMS: dict[str, float | None] = {"structural": 0.0, "shear": 0.0, "virtual": 0.0, "map": None}
TISSUE_TERMS: dict[str, float | None] = {
    "foundation": 0.0,
    "damping": 0.0,
    "pretension": 0.0,
    "bending": 0.0,
    "map": None,
}


def variants(scene: Scene) -> Iterator[tuple[str, Scene]]:
    """Give the scene without each of its terms in turn, by the term's key; the first variant is the whole scene."""
    yield "", scene
    section, terms = ("springs", SPRING_TERMS) if scene.tissue is None else ("tissue", TISSUE_TERMS)
    sheet = getattr(scene, section)
    for name, absent in terms.items():
        if getattr(sheet, name) not in (0, None):
            yield f"{section}.{name}", scene.model_copy(update={section: sheet.model_copy(update={name: absent})})
    if scene.damping > 0:
        yield "damping", scene.model_copy(update={"damping": 0.0})
    for index in range(len(scene.probes)):
        others = scene.probes[:index] + scene.probes[index + 1 :]
        yield f"probes.{index}", scene.model_copy(update={"probes": others})


def _step_seconds(dynamics: Dynamics, frames: int) -> float:
    """Measure the time of one step [s]."""
    steps = frames * dynamics.plan.grid.steps_per_frame
    start = time.perf_counter()
    dynamics.advance(steps)
    return (time.perf_counter() - start) / steps
