"""The cost of each term of the model: the time of a step without it."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack, closing

from taichi_msm.physics.plan import Plan
from taichi_msm.physics.planning import variant
from taichi_msm.physics.solver import Dynamics
from taichi_msm.progress import Count
from taichi_msm.scene import Scene
from taichi_msm.study.result import Study, TimedTerm
from taichi_msm.system.runtime import Device

ROUNDS = 9

# The terms of a sheet that can be left out, and the values that leave them out.
SPRING_TERMS: dict[str, float | None] = {"structural": 0.0, "shear": 0.0, "virtual": 0.0, "map": None}
TISSUE_TERMS: dict[str, float | None] = {
    **dict.fromkeys(("foundation", "damping", "pretension", "bending"), 0.0),
    **dict.fromkeys(("map", "foundation_map")),
}


def measure_terms(plan: Plan, device: Device, sample: float, study: Study, progress: Count) -> None:
    """Measure the time of a step with each term left out in turn, in samples of about so many seconds."""
    # All variants have the steps of the whole scene: without a spring the automatic step would be another.
    grid = {"steps_per_frame": plan.grid.steps_per_frame, "precision": plan.grid.precision}
    plans = {without: variant(plan, scene).with_grid(**grid) for without, scene in variants(plan.scene)}
    study.terms += map(TimedTerm, plans)
    with ExitStack() as opened:
        sheets: list[Dynamics] = []
        for without in plans.values():
            progress(0, len(plans))
            sheets.append(opened.enter_context(closing(Dynamics(without, device))))
            sheets[-1].compile()
        frames = round(sample / (_step_seconds(sheets[0], 1) * plan.grid.steps_per_frame))
        frames = max(1, min(plan.grid.frames, frames))
        for round_ in range(ROUNDS):
            for number, (term, sheet) in enumerate(zip(study.terms, sheets, strict=True)):
                progress(round_ * len(sheets) + number, ROUNDS * len(sheets))
                # From rest, so that all variants step through the same part of the scene.
                sheet.restart(sheet.plan)
                term.samples.append(_step_seconds(sheet, frames))


def variants(scene: Scene) -> Iterator[tuple[str, Scene]]:
    """Give the scene without each of its terms in turn, by the term's key; the first variant is the whole scene."""
    yield "", scene
    terms, sheet = (SPRING_TERMS, scene.springs) if scene.tissue is None else (TISSUE_TERMS, scene.tissue)
    assert sheet is not None
    for name, absent in terms.items():
        if getattr(sheet, name) not in (0, None):
            rest = sheet.model_copy(update={name: absent})
            yield f"{scene.kind}.{name}", scene.model_copy(update={scene.kind: rest})
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
