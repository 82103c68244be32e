"""Time of a step with each term of tissue, against a sheet of springs; in turn, in one process."""

from __future__ import annotations

import math
import tempfile
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from benchmarks.clock import in_turn
from benchmarks.process import call
from benchmarks.race import Progress
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import make_plan
from taichi_msm.system import runtime
from taichi_msm.system.process import available_threads

POINTS = (61, 331, 1024)
PRECISIONS = ("f32", "f64")

SPRINGS = "springs"

# Point updates of one sample, about 30 ms.
POINT_STEPS = 10_000_000

TISSUE = {"young": 3e4, "thickness": 2e-3, "density": 1050, "foundation": 2e6, "damping": 40}
BENDING = {"bending": 1e-7}
PRETENSION = {"pretension": 5}

PRESSED = {"total": [0, 0, -2], "radius": 0.004, "falloff": 300}

# A capsule that is pressed in and stays; timing begins when it is down [s].
DOWN = 5e-3
MOVED = {
    "path": [[0, 0.5, 0.5, 0], [DOWN, 0.5, 0.5, -0.006]],
    "instrument": {"radius": 0.005, "shaft": [0.5, -0.6, 0.9], "length": 0.15},
}


def variants(points: int, precision: str, image: str) -> dict[str, Scene]:
    """Return the scenes: the same tissue, with one additional term or with all."""
    stiffness_map = {"map": {"image": image, "range": [1, 1.5]}}

    def scene(sheet: dict[str, Any], **others: Any) -> Scene:
        return Scene(
            sheet={"points": [points, points], "size": [0.1, 0.1], **sheet},
            time={"duration": 1000, "precision": precision},
            output=[],
            **{"probes": [PRESSED], **others},
        )

    plain = make_plan(scene({}, tissue=TISSUE)).material
    springs = {"structural": plain.across, "shear": plain.shear, "virtual": plain.virtual}
    return {
        SPRINGS: scene({"mass": plain.mass}, springs=springs, damping=plain.drag * plain.mass),
        "tissue": scene({}, tissue=TISSUE),
        "tissue, free edges": scene({"fixed": "none"}, tissue=TISSUE),
        "tissue, pretension": scene({}, tissue={**TISSUE, **PRETENSION}),
        "tissue, map": scene({}, tissue={**TISSUE, **stiffness_map}),
        "tissue, bending": scene({}, tissue={**TISSUE, **BENDING}),
        "tissue, all but free edges": scene({}, tissue={**TISSUE, **PRETENSION, **stiffness_map, **BENDING}),
        "tissue, no tool": scene({}, tissue=TISSUE, probes=[]),
        "tissue, a rod in place of the force": scene({}, tissue=TISSUE, probes=[MOVED]),
        "tissue, a rod with friction": scene({}, tissue=TISSUE, probes=[{**MOVED, "friction": 0.3}]),
    }


def cost(points: int, precision: str, rounds: int) -> dict[str, list[float]]:
    """Return times of a step of every variant [s], measured in turn."""
    device = runtime.start("cpu", available_threads())
    count = max(1, POINT_STEPS // points**2)
    with tempfile.TemporaryDirectory() as folder:
        image = Path(folder) / "map.png"
        Image.fromarray(np.random.default_rng(0).integers(0, 256, (64, 64), dtype=np.uint8)).save(image)
        sheets = {
            name: Dynamics(make_plan(scene), device) for name, scene in variants(points, precision, str(image)).items()
        }
    for sheet in sheets.values():
        sheet.advance(math.ceil(DOWN * sheet.plan.grid.steps_per_second))
    samples = in_turn({name: partial(sheet.advance, count) for name, sheet in sheets.items()}, rounds)
    return {name: [seconds / count for seconds in times] for name, times in samples.items()}


def measure(rounds: int, progress: Progress) -> dict[str, dict[str, list[float]]]:
    """Time all variants by size and precision, such as "331 × 331, f32"."""
    results = {}
    for precision in PRECISIONS:
        for points in POINTS:
            progress(f"{points} x {points}, {precision}")
            name = f"{points} × {points}, {precision}"
            results[name] = call("benchmarks.terms:cost", points=points, precision=precision, rounds=4 * rounds)
    return results
