"""The problem of all steppers: n x n mass points, a fixed border, all three families of springs, a constant load.

With u_n the displacement, F_n all forces except damping and g = C / m, a step is (docs/model.md, central)

    u_{n+1} = u_n + keep (u_n - u_{n-1}) + gain F_n,    u_1 = gain_0 F_0
    keep = (1 - g h / 2) / (1 + g h / 2),  gain = h^2 / m / (1 + g h / 2),  gain_0 = h^2 / m / 2

The size of cells is independent of n, and so is the motion of a single cell. The load reaches the whole sheet, so that
there are no denormal numbers, which are slow. Stiff virtual springs prevent wrinkles, whose pattern would depend on
rounding.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from itertools import islice
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from benchmarks.neighbours import Spring, springs
from taichi_msm.model.loads import decay
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import Material
from taichi_msm.model.time_grid import TimeGrid
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import make_plan
from tests import reference

CELL = 0.01
FORCE = (0.02, 0.01, -0.08)

# From the centre to the middle of a side the load decays by e^-3.
DECAY = 3.0

Array = NDArray[np.float32]


class Stepper(Protocol):
    """A peer's sheet, at rest at first; the module of each peer has `prepare(problem, threads)`, which returns one."""

    def advance(self, steps: int) -> None:
        """Advance by a number of steps, and wait until they are done."""

    def displacement(self) -> Array:
        """Return the displacements [m], shape (n, n, 3)."""


@dataclass(frozen=True)
class Problem:
    """The parameters of a problem."""

    points: int  # n, mass points along a side

    @cached_property
    def scene(self) -> Scene:
        """The problem as a scene of this program."""
        side = CELL * (self.points - 1)
        return Scene.model_validate(
            {
                "sheet": {"points": [self.points, self.points], "size": [side, side], "mass": 1e-3},
                "springs": {"structural": 20, "shear": 15, "virtual": 10, "virtual_active": "always"},
                "damping": 0.01,
                "probes": [{"force": FORCE, "falloff": 2 * DECAY / side, "offset": 0}],
                "time": {"duration": 1, "step": 0.002, "precision": "f32"},
                "output": [],
            }
        )

    @cached_property
    def plan(self) -> Plan:
        """The plan of the scene."""
        return make_plan(self.scene)

    @property
    def grid(self) -> TimeGrid:
        """The time grid of the plan."""
        return self.plan.grid

    @property
    def material(self) -> Material:
        """The material of the plan."""
        return self.plan.material

    @cached_property
    def springs(self) -> tuple[Spring, ...]:
        """Every spring once, from the point above or to the left."""
        return tuple(spring for spring in springs(self.scene) if (spring.down, spring.right) > (0, 0))

    @cached_property
    def load(self) -> Array:
        """Force on each point, constant in time [N], shape (3, n, n)."""
        share = decay(self.scene.probes[0], self.plan)
        return np.array(FORCE, np.float32)[:, None, None] * share.astype(np.float32)

    @property
    def keep(self) -> float:
        """Factor of u_n - u_{n-1} in a step."""
        drag = self._drag
        return (1 - drag) / (1 + drag)

    @property
    def gain(self) -> float:
        """Factor of the force in a step [m/N]."""
        return self.grid.step**2 / self.material.mass / (1 + self._drag)

    @property
    def first_gain(self) -> float:
        """Factor of the force in the first step [m/N]."""
        return self.grid.step**2 / self.material.mass / 2

    @property
    def _drag(self) -> float:
        return self.material.drag * self.grid.step / 2

    def answer(self, steps: int) -> NDArray[np.float64]:
        """Return the displacements after some steps, by the NumPy reference in float64 [m], shape (n, n, 3)."""
        return next(islice(reference.displacements(self.plan), steps, None))
