"""NumPy reference of position-controlled tools: contact, friction, grips and clamps, point by point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.plan import Plan
from taichi_msm.model.tools import SolidTool, Tool, solid_tools
from taichi_msm.scene.scene import Scene
from tests.reference.sheet import Sheet, sheet
from tests.reference.surface import at_fractions, normal_at

Array = NDArray[np.float64]


def lowest_point(scene: Scene, tool: SolidTool, time: float, assembled: Sheet) -> tuple[Array, Array]:
    """Return the tip X + height N of a tool over a surface [m], and the normal N there; shape (3,) each.

    Across, down and height are linear between keys, so a tool that is dragged follows the surface.
    """
    path = scene.probes[tool.probe].path
    assert path is not None
    keys = np.array(path, dtype=float)
    across, down, height = (float(np.interp(time, keys[:, 0], keys[:, 1 + k])) for k in range(3))
    normal = normal_at(assembled.normal, across, down)
    return at_fractions(assembled.rest, across, down) + height * normal, normal


def centre(scene: Scene, tool: Tool, time: float, assembled: Sheet) -> Array:
    """Return the place c of a tool's axis at its tip at a time [m], shape (3,): X + (height + tip) N."""
    if not assembled.is_curved or not isinstance(tool, SolidTool):
        return tool.path_at(np.array([time]))[0]
    lowest, normal = lowest_point(scene, tool, time, assembled)
    across = np.linalg.norm(tool.axis - tool.axis @ normal * normal)
    return lowest + tool.radius * (1 if tool.shape.is_round else across) * normal


class Contact:
    """Corrections of positions by the tools after each step, and their forces.

    Attributes:
        push: displacement of each mass point by each probe in the last step [m], shape (probes, rows, cols, 3).
        force: the mean force in that step that gives the same displacement [N], same shape.
        holder: index of the probe that grips each mass point, or -1, shape (rows, cols).
    """

    def __init__(self, plan: Plan, assembled: Sheet | None = None) -> None:
        self._plan, self._sheet = plan, assembled or sheet(plan.scene)
        self._rest, self._mass = self._sheet.rest, self._sheet.mass
        shape = plan.scene.sheet.points
        self.push = np.zeros((len(plan.scene.probes), *shape, 3))
        self.force = np.zeros_like(self.push)
        self.holder = np.full(shape, -1)
        # Displacement of each gripped point, and the tip's centre, at the begin of the grip.
        self._grip_displacement = np.zeros((*shape, 3))
        self._grip_centre = np.zeros((len(plan.scene.probes), 3))
        self._grip: dict[int, int | None] = {}
        self._clamps = [index for index, probe in enumerate(plan.scene.probes) if probe.clamp is not None]
        last_row, last_column = shape[0] - 1, shape[1] - 1
        for i, j in np.argwhere(~plan.fixed):
            sides = {"top": i == 0, "bottom": i == last_row, "left": j == 0, "right": j == last_column}
            for index in self._clamps:
                if self.holder[i, j] < 0 and sides[str(plan.scene.probes[index].clamp)]:
                    self.holder[i, j] = index

    def resolve(self, n: int, u: Array, following: Array) -> Array:
        """Return the displacements u_{n+1} after contact [m], shape (rows, cols, 3).

        A point inside a capsule goes to its surface along the normal; friction then takes back its tangential slip, by
        at most the coefficient of friction times the penetration.

        Args:
            n: index of the step.
            u: displacements before it, u_n [m], shape (rows, cols, 3).
            following: displacements after it without contact [m], same shape; changed in place.
        """
        plan, grid, h = self._plan, self._plan.grid, self._plan.grid.step
        self._update_grips(n, u)
        for point in np.argwhere(~plan.fixed):
            i, j = point
            holder = self.holder[i, j]
            for tool in plan.tools:
                index = tool.probe
                before, after = (self._centre(tool, step / grid.steps_per_second) for step in (n, n + 1))
                push = np.zeros(3)
                if holder == index and index in self._clamps:
                    keys = np.array(plan.scene.probes[index].path)
                    t = (n + 1) / grid.steps_per_second
                    push = [np.interp(t, keys[:, 0], keys[:, 1 + axis]) for axis in range(3)] - following[i, j]
                elif holder == index:
                    push = self._grip_displacement[i, j] + after - self._grip_centre[index] - following[i, j]
                elif holder < 0 and isinstance(tool, SolidTool):
                    r = self._rest[i, j] + following[i, j] - after
                    r -= np.clip(r @ tool.axis, 0, tool.length) * tool.axis
                    distance = float(np.linalg.norm(r))
                    if distance < tool.radius:
                        normal = r / distance if distance > 0 else np.array([0.0, 0.0, 1.0])
                        push = (tool.radius - distance) * normal
                        w = following[i, j] + push - u[i, j] - (after - before)
                        w -= (w @ normal) * normal
                        slip = float(np.linalg.norm(w))
                        if tool.friction > 0 and slip > 0:
                            push -= w * min(1.0, tool.friction * (tool.radius - distance) / slip)
                following[i, j] += push
                self.push[index, i, j] = push
        g = plan.material.drag
        weight = 2 / h**2 if n == 0 else 1 / h**2
        if n > 0 and plan.scene.time.damping_difference == "central":
            weight *= 1 + g * h / 2
        self.force = self._mass[..., None] * self.push * weight
        return following

    def _update_grips(self, n: int, u: Array) -> None:
        """End and begin grips at step n; a new grip takes free points within 1.5 radii of the tip's centre."""
        plan, grid = self._plan, self._plan.grid
        t, tolerance = n / grid.steps_per_second, 1e-6 / grid.frames_per_second
        grips = {}
        tools = solid_tools(plan.tools).values()
        for tool in tools:
            active = [k for k, (begin, end) in enumerate(tool.grips) if begin - tolerance <= t < end - tolerance]
            grips[tool.probe] = active[0] if active else None
        begun = [probe for probe, grip in grips.items() if grip is not None and self._grip.get(probe) != grip]
        for probe, grip in grips.items():
            if grip is None or probe in begun:
                self.holder[self.holder == probe] = -1
        for tool in tools:
            if tool.probe in begun:
                middle = self._centre(tool, t)
                near = np.linalg.norm(self._rest + u - middle, axis=-1) <= 1.5 * tool.radius
                gripped = near & ~plan.fixed & (self.holder < 0)
                self.holder[gripped] = tool.probe
                self._grip_displacement[gripped] = u[gripped]
                self._grip_centre[tool.probe] = middle
        self._grip = grips

    def _centre(self, tool: Tool, time: float) -> Array:
        return centre(self._plan.scene, tool, time, self._sheet)
