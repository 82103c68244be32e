"""Scenes for tests."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.plan import Plan
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import try_plan, with_time

SHEET = {"points": [9, 11], "size": [0.3, 0.4], "mass": 1e-3}
SPRINGS = {"structural": 20, "shear": 10, "virtual": 0.5}
PRESS = {"force": [0, 3000, -10000], "load": [[0, 0], [0.1, 100], [0.2, 100], [0.2, 0]], "falloff": 20}


# A scene file; its picture is in the same folder.
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
    """A small scene in f64 without output; `sections` replace the default ones, except `time`, whose keys are added."""
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


def _random(*seed: int) -> tuple[np.random.Generator, Callable[[float, float], float]]:
    """Return a generator, and its uniform floats between two limits."""
    rng = np.random.default_rng(seed[0] if len(seed) == 1 else seed)
    return rng, lambda low, high: float(rng.uniform(low, high))


def random_scene(seed: int, precision: str = "f64") -> Scene:
    """A random scene of few mass points; every term of the model occurs in some seed."""
    rng, uniform = _random(seed)

    def keys(count: int, *ranges: tuple[float, float]) -> list[list[float]]:
        times = np.sort(rng.choice(40, count, replace=False)) / 100
        return [[float(t), *(uniform(*limits) for limits in ranges)] for t in times]

    def probe() -> dict[str, Any]:
        load = keys(4, (-100, 100))
        load[2][0] = load[1][0]
        across = keys(3, (0, 1), (0, 1)) if rng.random() < 0.5 else [uniform(0, 1), uniform(0, 1)]
        if rng.random() < 0.3 and isinstance(across[0], list):
            across[2][0] = across[1][0]
        force = [uniform(-3, 3) for _ in range(3)]
        return {"at": across, "force": force, "load": load, "falloff": uniform(0, 30), "offset": 2}

    sides = ["top", "bottom", "left", "right"]
    fixed = [side for side in sides if rng.random() < 0.4]
    return scene(
        sheet={
            "points": [int(rng.integers(2, 14)), int(rng.integers(2, 23))],
            "size": [uniform(0.2, 0.5), uniform(0.2, 0.5)],
            "mass": uniform(1e-3, 3e-3),
            "fixed": ["border", "corners", "none", fixed][rng.integers(4)],
        },
        springs={
            "structural": uniform(20, 40) if rng.random() < 0.9 else 0,
            "shear": uniform(10, 30) if rng.random() < 0.8 else 0,
            "virtual": uniform(1, 30) if rng.random() < 0.7 else 0,
            "virtual_active": ["loaded", "always"][rng.integers(2)],
        },
        damping=uniform(0.01, 0.1) if rng.random() < 0.8 else 0,
        probes=[probe() for _ in range(rng.integers(0, 4))],
        time={"duration": 0.4, "precision": precision, "damping_difference": ["central", "backward"][rng.integers(2)]},
    )


def random_tissue(seed: int, image: str, precision: str = "f64") -> Scene:
    """A random scene of tissue with few mass points, as stiff for its size as `random_scene`; `image` is for maps."""
    rng, uniform = _random(seed)
    sides = ["top", "bottom", "left", "right"]
    rows, cols = int(rng.integers(3, 14)), int(rng.integers(3, 23))
    fixed = ["border", "border", "corners", "none", [side for side in sides if rng.random() < 0.4]][rng.integers(5)]
    cell = uniform(0.01, 0.02)
    size = [cell * (rows - 1), cell * uniform(0.65, 1.5) * (cols - 1)]
    moving = [[0.0, uniform(0, 1), uniform(0, 1)], [0.3, uniform(0, 1), uniform(0, 1)]]
    probes = [
        {
            "at": moving if rng.random() < 0.5 else [uniform(0, 1), uniform(0, 1)],
            "total": [uniform(-2, 2) for _ in range(3)],
            "radius": uniform(0, 0.05) if rng.random() < 0.5 else 0.0,
            "falloff": uniform(20, 60),
            "load": [[0, 0], [0.1, 100], [0.25, uniform(-50, 50)], [0.25, 30]],
        }
        for _ in range(rng.integers(1, 3))
    ]
    tissue = {
        "young": uniform(500, 2000),
        "thickness": uniform(0.01, 0.02),
        "density": 1000,
        "foundation": uniform(1e3, 1e4) if rng.random() < 0.7 else 0,
        "foundation_active": ["loaded", "always"][rng.integers(2)],
        "damping": uniform(1, 10) if rng.random() < 0.8 else 0,
        "pretension": uniform(0.5, 3) if fixed == "border" and rng.random() < 0.6 else 0,
        "bending": ["plate", 0, uniform(1e-5, 3e-4)][rng.integers(3)],
    }
    if fixed != "border":
        tissue["bending"] = 0
    if rng.random() < 0.5:
        tissue["map"] = {"image": image, "range": [uniform(0.7, 1), uniform(1, 4)]}
    if tissue["foundation"] and rng.random() < 0.5:
        tissue["foundation_map"] = {"image": image, "range": [uniform(0.1, 1), uniform(1, 4)]}
    return Scene(
        sheet={"points": [rows, cols], "size": size, "fixed": fixed},
        tissue=tissue,
        probes=probes,
        time={"duration": 0.4, "precision": precision, "damping_difference": ["central", "backward"][rng.integers(2)]},
        output=[],
    )


def random_contact(seed: int, image: str, *, cells: float = 2.0) -> Scene:
    """A random scene of tissue or springs that one to three tools press, rub and hold.

    Args:
        seed: seed of the scene.
        image: picture for maps.
        cells: radius of the tools, about [cells].
    """
    for attempt in range(100):
        made = Scene.model_validate(_random_contact(seed, attempt, image, cells))
        if not try_plan(made)[1]:
            return made
    raise AssertionError("no valid scene")


def _random_contact(seed: int, attempt: int, image: str, cells: float) -> dict[str, Any]:
    rng, uniform = _random(seed, attempt)

    def likely(chance: float) -> bool:
        return bool(rng.random() < chance)

    rows, cols = (int(rng.integers(13, 34)) for _ in range(2))
    cell, duration = uniform(0.06, 0.14) / (rows - 1), float(rng.choice([0.2, 0.4]))
    sides = ["border", "border", "corners", "none", ["left", "right"], ["top"], ["bottom", "left"]]
    fixed = sides[rng.integers(len(sides))]

    def tool() -> dict[str, Any]:
        radius, across, down = uniform(0.6, 1.4) * cells * cell, uniform(0.2, 0.8), uniform(0.2, 0.8)
        depth, touch = uniform(0.2, 1.5) * radius, uniform(0.15, 0.5) * duration
        leave = touch + uniform(0.1, 0.6) * (duration - touch)
        end = across + uniform(-0.1, 0.1), down + uniform(-0.1, 0.1)
        path = [[0, across, down, uniform(0, 1e-3)], [touch, across, down, -depth], [leave, *end, -depth]]
        if likely(0.7):
            path.append([leave + 0.2 * duration, *end, uniform(0.002, 0.015)])
        shaft = [uniform(-1, 1), uniform(-1, 1), uniform(0.7, 1.2)]
        if likely(0.1):  # From below.
            path = [[*place, -2 * radius - height] for *place, height in path]
            shaft[2] *= -1
        begin = uniform(0.8, 1.3) * touch
        return {
            "path": path,
            "instrument": {"radius": radius, "shaft": shaft, "length": uniform(0.03, 0.15)},
            "friction": uniform(0.05, 0.8) if likely(0.5) else 0.0,
            "grip": [[begin, begin + uniform(0.1, 1) * duration]] if likely(0.4) else [],
        }

    made: dict[str, Any] = {
        "sheet": {"points": [rows, cols], "size": [cell * (rows - 1), uniform(0.8, 1.25) * cell * (cols - 1)]},
        "probes": [tool() for _ in range(rng.integers(1, 4) if likely(0.5) else 1)],
        "time": {"duration": duration, "precision": ["f32", "f64"][rng.integers(2)]},
        "output": [],
    }
    made["sheet"]["fixed"] = fixed
    made["time"]["damping_difference"] = "backward" if likely(0.15) else "central"
    damping = float(rng.choice([0, 20, 200, 2000]))
    support, active = likely(0.7) or fixed == "none", ["loaded", "always"][rng.integers(2)]
    if likely(0.3):
        made["sheet"]["mass"], made["damping"] = 1e-4, 1e-4 * damping
        made["springs"] = {"structural": uniform(20, 100), "shear": uniform(10, 60), "virtual_active": active}
        made["springs"]["virtual"] = uniform(0.5, 10) if support else 0
        return made
    made["tissue"] = {
        "young": 10 ** uniform(3.7, 4.8),
        "thickness": uniform(1e-3, 4e-3),
        "density": 1050,
        "foundation": 10 ** uniform(5, 6.5) if support else 0,
        "foundation_active": active,
        "damping": damping,
        "pretension": uniform(5, 40) if fixed == "border" and likely(0.5) else 0,
        "bending": "plate" if fixed == "border" and likely(0.4) else 0,
    }
    if likely(0.35):
        made["tissue"]["map"] = {"image": image, "range": [uniform(0.7, 1), uniform(1, 4)]}
    return made


def speckle(height: int, width: int, seed: int = 0) -> NDArray[np.uint8]:
    """A picture of random texels, the most sensitive to sampling errors; shape (height, width, 3)."""
    return np.random.default_rng(seed).integers(0, 256, (height, width, 3), dtype=np.uint8)


def with_steps(made: Scene, count: int) -> Scene:
    """The scene with `count` steps per frame."""
    return with_time(made, step=1 / made.time.frames_per_second / count, tolerance=None)


def plan_of(made: Scene) -> Plan:
    """The plan of a scene; its step may be unstable."""
    plan, _ = try_plan(made)
    assert plan is not None
    return plan
