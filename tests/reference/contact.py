"""The reference for tools that are moved: contact, friction, grips and clamps, point by point."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from tests.reference.sheet import sheet

Array = NDArray[np.float64]


class Contact:
    """What the tools do to the points after each step.

    `push` is by how much each probe has moved each point in the last step [m], shape (probes, rows, cols, 3), `force`
    what it took [N], and `holder` the probe that holds each point, or -1.
    """

    def __init__(self, plan: Plan) -> None:
        self._plan, self._rest = plan, rest_positions(plan.scene.sheet)
        self._mass = sheet(plan.scene).mass
        shape = plan.scene.sheet.points
        self.push = np.zeros((len(plan.scene.probes), *shape, 3))
        self.force = np.zeros_like(self.push)
        self.holder = np.full(shape, -1)
        self._taken = np.zeros((*shape, 3))
        self._since = np.zeros((len(plan.scene.probes), 3))
        self._grip: dict[int, int | None] = {}
        self._clamps = [index for index, probe in enumerate(plan.scene.probes) if probe.clamp is not None]
        last_row, last_column = shape[0] - 1, shape[1] - 1
        for i, j in np.argwhere(~plan.fixed):
            sides = {"top": i == 0, "bottom": i == last_row, "left": j == 0, "right": j == last_column}
            for index in self._clamps:
                if self.holder[i, j] < 0 and sides[str(plan.scene.probes[index].clamp)]:
                    self.holder[i, j] = index

    def after(self, n: int, u: Array, following: Array) -> Array:
        """Resolve the contact in step n, which led from u to `following` [m]; returns u_{n+1}."""
        plan, grid, h = self._plan, self._plan.grid, self._plan.grid.step
        self._take_and_leave(n, u)
        for point in np.argwhere(~plan.fixed):
            i, j = point
            held = self.holder[i, j]
            for tool in plan.tools:
                index = tool.probe
                before, after = (tool.tip_centre(np.array([step / grid.steps_per_second]))[0] for step in (n, n + 1))
                push = np.zeros(3)
                if held == index and index in self._clamps:
                    keys = np.array(plan.scene.probes[index].path)
                    t = (n + 1) / grid.steps_per_second
                    push = [np.interp(t, keys[:, 0], keys[:, 1 + axis]) for axis in range(3)] - following[i, j]
                elif held == index:
                    push = self._taken[i, j] + after - self._since[index] - following[i, j]
                elif held < 0 and index not in self._clamps:
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

    def _take_and_leave(self, n: int, u: Array) -> None:
        plan, grid = self._plan, self._plan.grid
        t, equal = n / grid.steps_per_second, 1e-6 / grid.frames_per_second
        now = {}
        tools = [tool for tool in plan.tools if tool.probe not in self._clamps]
        for tool in tools:
            holds = [k for k, (begin, end) in enumerate(tool.grips) if begin - equal <= t < end - equal]
            now[tool.probe] = holds[0] if holds else None
        begun = [probe for probe, grip in now.items() if grip is not None and self._grip.get(probe) != grip]
        for probe, grip in now.items():
            if grip is None or probe in begun:
                self.holder[self.holder == probe] = -1
        for tool in tools:
            if tool.probe in begun:
                middle = tool.tip_centre(np.array([t]))[0]
                near = np.linalg.norm(self._rest + u - middle, axis=-1) <= 1.5 * tool.radius
                taken = near & ~plan.fixed & (self.holder < 0)
                self.holder[taken] = tool.probe
                self._taken[taken] = u[taken]
                self._since[tool.probe] = middle
        self._grip = now
