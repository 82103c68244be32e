"""A scene resolved: what is decided before the first step, once, and then handed on."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.material import Material, has_fixed_border
from taichi_msm.physics.slots import ProbeSlot, probe_slots
from taichi_msm.physics.stiffness_map import MapImage
from taichi_msm.scene import Probe, Scene
from taichi_msm.timegrid import TimeGrid


@dataclass(frozen=True, eq=False)
class Plan:
    """What a scene comes to; `planning.make_plan` makes it.

    Attributes:
        scene: as it was given.
        image: of its map; None: it has none.
        fixed: which points are fixed, shape (rows, cols).
        material: what the sheet is made of, with the map as an array.
        stable_step: the largest stable step [s]; infinite where nothing oscillates.
        grid: the steps.
        slots: the places where probes act.
    """

    scene: Scene
    image: MapImage | None
    fixed: NDArray[np.bool_]
    material: Material
    stable_step: float
    grid: TimeGrid
    slots: tuple[ProbeSlot, ...]

    @property
    def open_edges(self) -> bool:
        """Whether a point at an edge moves."""
        return not has_fixed_border(self.fixed)

    def with_grid(self, **changes: Any) -> Plan:
        """Change attributes of the time grid: steps_per_frame, precision."""
        grid = replace(self.grid, **changes)
        if grid.step == self.grid.step:
            return replace(self, grid=grid)
        return replace(self, grid=grid, slots=probe_slots(self.scene.probes, self.scene.sheet, grid.step))

    def with_probes(self, probes: Sequence[Probe | Mapping[str, Any]]) -> Plan:
        """Replace the probes.

        Raises:
            SceneError: when one of them is not a probe.
        """
        scene = self.scene.model_copy(update={"probes": tuple(probes)})
        return replace(self, scene=scene, slots=probe_slots(scene.probes, scene.sheet, self.grid.step))
