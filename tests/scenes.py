"""Scenes for tests."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.plan import Plan
from taichi_msm.physics.planning import try_plan, with_time
from taichi_msm.scene import Scene
from taichi_msm.timegrid import TimeGrid

SHEET = {"points": [9, 11], "size": [0.3, 0.4], "mass": 1e-3}
SPRINGS = {"structural": 20, "shear": 10, "virtual": 0.5}
PRESS = {"force": [0, 3000, -10000], "load": [[0, 0], [0.1, 100], [0.2, 100], [0.2, 0]], "falloff": 20}


# A scene as its file has it, with a picture beside it.
SMALL = """\
image: speckle.png
sheet: {points: [9, 11], size: [0.3, 0.4], mass: 1.0e-3}
springs: {structural: 20, shear: 10, virtual: 0.5}
damping: 0.01
probes:
  - force: [0, 300, -1000]
    load: [[0, 0], [0.1, 100], [0.2, 100], [0.2, 0]]
    falloff: 20
time: {duration: 0.4, frames_per_second: 10}
render: {size: [40, 30], refine: 1}
"""


def scene(**sections: Any) -> Scene:
    """A small scene in f64 that simulates only; sections given replace its own, keys of time are added."""
    return Scene.model_validate(
        {
            "sheet": SHEET,
            "springs": SPRINGS,
            "damping": 0.01,
            "probes": [PRESS],
            "output": [],
            **sections,
            "time": {"duration": 0.4, "precision": "f64", **sections.get("time", {})},
        }
    )


def random_scene(seed: int, precision: str = "f64") -> Scene:
    """A random scene of few points that uses every term of the model in some seed."""
    rng = np.random.default_rng(seed)

    def some(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    def keys(count: int, *ranges: tuple[float, float]) -> list[list[float]]:
        times = np.sort(rng.choice(40, count, replace=False)) / 100
        return [[float(t), *(some(*limits) for limits in ranges)] for t in times]

    def probe() -> dict[str, Any]:
        load = keys(4, (-100, 100))
        load[2][0] = load[1][0]
        across = keys(3, (0, 1), (0, 1)) if rng.random() < 0.5 else [some(0, 1), some(0, 1)]
        if rng.random() < 0.3 and isinstance(across[0], list):
            across[2][0] = across[1][0]
        force = [some(-3, 3) for _ in range(3)]
        return {"at": across, "force": force, "load": load, "falloff": some(0, 30), "offset": 2}

    sides = ["top", "bottom", "left", "right"]
    fixed = [side for side in sides if rng.random() < 0.4]
    return scene(
        sheet={
            "points": [int(rng.integers(2, 14)), int(rng.integers(2, 23))],
            "size": [some(0.2, 0.5), some(0.2, 0.5)],
            "mass": some(1e-3, 3e-3),
            "fixed": ["border", "corners", "none", fixed][rng.integers(4)],
        },
        springs={
            "structural": some(20, 40) if rng.random() < 0.9 else 0,
            "shear": some(10, 30) if rng.random() < 0.8 else 0,
            "virtual": some(1, 30) if rng.random() < 0.7 else 0,
            "virtual_active": ["loaded", "always"][rng.integers(2)],
        },
        damping=some(0.01, 0.1) if rng.random() < 0.8 else 0,
        probes=[probe() for _ in range(rng.integers(0, 4))],
        time={
            "duration": 0.4,
            "precision": precision,
            "damping_difference": ["central", "backward"][rng.integers(2)],
        },
    )


def random_tissue(seed: int, image: str, precision: str = "f64") -> Scene:
    """A random scene of tissue with few points, as stiff for its size as `random_scene`; `image` is for maps."""
    rng = np.random.default_rng(seed)

    def some(low: float, high: float) -> float:
        return float(rng.uniform(low, high))

    sides = ["top", "bottom", "left", "right"]
    rows, cols = int(rng.integers(3, 14)), int(rng.integers(3, 23))
    fixed = ["border", "border", "corners", "none", [side for side in sides if rng.random() < 0.4]][rng.integers(5)]
    cell = some(0.01, 0.02)
    size = [cell * (rows - 1), cell * some(0.65, 1.5) * (cols - 1)]
    moving = [[0.0, some(0, 1), some(0, 1)], [0.3, some(0, 1), some(0, 1)]]
    probes = [
        {
            "at": moving if rng.random() < 0.5 else [some(0, 1), some(0, 1)],
            "total": [some(-2, 2) for _ in range(3)],
            "radius": some(0, 0.05) if rng.random() < 0.5 else 0.0,
            "falloff": some(20, 60),
            "load": [[0, 0], [0.1, 100], [0.25, some(-50, 50)], [0.25, 30]],
        }
        for _ in range(rng.integers(1, 3))
    ]
    tissue = {
        "young": some(500, 2000),
        "thickness": some(0.01, 0.02),
        "density": 1000,
        "foundation": some(1e3, 1e4) if rng.random() < 0.7 else 0,
        "foundation_active": ["loaded", "always"][rng.integers(2)],
        "damping": some(1, 10) if rng.random() < 0.8 else 0,
        "pretension": some(0.5, 3) if fixed == "border" and rng.random() < 0.6 else 0,
        "bending": ["plate", 0, some(1e-5, 3e-4)][rng.integers(3)],
    }
    if fixed != "border":
        tissue["bending"] = 0
    if rng.random() < 0.5:
        tissue["map"] = {"image": image, "range": [some(0.7, 1), some(1, 4)]}
    if tissue["foundation"] and rng.random() < 0.5:
        tissue["foundation_map"] = {"image": image, "range": [some(0.1, 1), some(1, 4)]}
    return Scene(
        sheet={"points": [rows, cols], "size": size, "fixed": fixed},
        tissue=tissue,
        probes=probes,
        time={
            "duration": 0.4,
            "precision": precision,
            "damping_difference": ["central", "backward"][rng.integers(2)],
        },
        output=[],
    )


def speckle(height: int, width: int, seed: int = 0) -> NDArray[np.uint8]:
    """A picture of random texels, the hardest to draw right."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def with_steps(made: Scene, count: int) -> Scene:
    """The scene with so many steps in a frame."""
    return with_time(made, step=1 / made.time.frames_per_second / count, tolerance=None)


def plan_of(made: Scene) -> Plan:
    """The plan of a scene, whose step may be unstable."""
    plan, _ = try_plan(made)
    assert plan is not None
    return plan


def scene_and_grid(made: Scene) -> tuple[Scene, TimeGrid]:
    """The scene and its steps."""
    return made, plan_of(made).grid
