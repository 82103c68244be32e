"""Rounding in f32 by the stored form of the state, against the same steps in f64.

The paper's sheet (scenes/figure-3.yaml) at 18,000 steps a second, in NumPy.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from benchmarks.neighbours import springs
from taichi_msm import load_scene
from taichi_msm.model.loads import Schedule, average_loads, decay
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import make_plan

SCENE = Path(__file__).parent.parent / "scenes" / "figure-3.yaml"
STEPS_PER_SECOND = 18000

FORMS = {
    "positions x_n, x_{n-1}": "positions",
    "displacements u_n, u_{n-1}": "displacements",
    "displacement and difference u_n, u_n - u_{n-1}": "difference",
}

Array = NDArray[Any]


def elastic_force(scene: Scene, values: Array, form: str) -> Array:
    """Return the sum of k (L - L0) (Q - P) / L in the precision of the values, positions or displacements."""
    real = values.dtype.type
    force = np.zeros_like(values)
    for spring in springs(scene):
        start, end = spring.ends(scene.sheet.points)
        between = values[end] - values[start]
        if form != "positions":
            between += np.array([*spring.offset, 0], real)
        length = np.sqrt((between * between).sum(axis=-1, keepdims=True))
        force[start] += real(spring.stiffness) * (1 - real(spring.length) / length) * between
    return force


def displacements(plan: Plan, real: type[np.floating[Any]], form: str) -> Array:
    """Step the scene with its state in one form; return the displacements of all frames [m]."""
    scene, grid, material = plan.scene, plan.grid, plan.material
    h, m = grid.step, material.mass
    g = scene.damping / m
    keep = real((1 - g * h / 2) / (1 + g * h / 2))
    rest64 = rest_positions(scene.sheet)
    rest = rest64.astype(real)
    moves = ~plan.fixed[..., None]
    share = [decay(probe, plan).astype(real)[..., None] for probe in scene.probes]
    loads: Schedule = average_loads(plan, 0, grid.steps)
    now = rest.copy() if form == "positions" else np.zeros_like(rest)
    # The previous state, or the difference from it.
    before = now.copy()
    frames = []
    for n in range(len(loads.active)):
        u = now - rest if form == "positions" else now
        force = elastic_force(scene, now, form) - real(material.virtual * loads.active[n]) * u
        for part, strength in zip(share, loads.strength[n], strict=True):
            force += part * strength.astype(real)
        gain = real(h * h / m / (1 + g * h / 2) if n else h * h / m / 2)
        if form == "difference":
            before = keep * before + gain * force * moves
            now = now + before
        else:
            now, before = now + keep * (now - before) + gain * force * moves, now
        if (n + 1) % grid.steps_per_frame == 0:
            frames.append((now.astype(float) - rest64) if form == "positions" else now.astype(float))
    return np.array(frames)


def measure() -> dict[str, float]:
    """Return the rounding of every form, relative to the largest displacement."""
    scene = load_scene(SCENE, ["output=[]"])
    plan = make_plan(scene).with_grid(steps_per_frame=round(STEPS_PER_SECOND / scene.time.frames_per_second))
    exact = displacements(plan, np.float64, "difference")
    largest = np.linalg.norm(exact, axis=-1).max()
    return {
        name: float(np.linalg.norm(displacements(plan, np.float32, form) - exact, axis=-1).max() / largest)
        for name, form in FORMS.items()
    }
