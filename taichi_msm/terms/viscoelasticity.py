"""Stress relaxation: quasi-linear viscoelasticity (Fung) of all elastic forces. Scene: `tissue.relaxation`.

Let f_n be the elastic force (springs, bending, foundation) on a mass point at step n, h the step [s], share_i and
time_i [s] the parameters of branch i, and G the sum of the shares. With x_i = h / time_i and phi_i = (1 - exp(-x_i)) /
x_i, the force

    (1 - G) f_n + sum of (s_i + share_i phi_i f_n)

acts in place of f_n. The memory s_i, initially 0, then becomes exp(-x_i) s_i - share_i phi_i (1 - exp(-x_i)) f_n. This
is exact for forces that are linear in time between steps.

In quasi-static scenes h is the time between frames, and the memory s_i changes at frames only. In frame 0 the full f
acts, and then s_i = share_i (exp(-x_i) - phi_i) f.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.model.loads import Schedule
from taichi_msm.model.plan import Plan
from taichi_msm.scene.scene import Scene
from taichi_msm.terms.base import KernelConfig, Term
from taichi_msm.terms.places import Places

# Columns of a branch: g = 1 - exp(-x) and c = share phi, with which s decreases by g (s + c f). exp(-x) in f32 would
# lose digits of small x.
BRANCH = Places(decrease=1, share=1)


@dataclass(frozen=True)
class ViscoelasticTerm(Term):
    """Stress relaxation of the sum of the elastic forces, whose terms precede it in `terms.TERMS`."""

    key: ClassVar[str] = "tissue.relaxation"

    branches: int  # number of branches
    by_frame: bool  # whether the memory changes only at frames, as marked in the load table

    @staticmethod
    def derive(scene: Scene) -> dict[str, Any]:
        branches = () if scene.tissue is None else scene.tissue.relaxation
        return {"relaxation": tuple((branch.share, branch.time) for branch in branches)}

    @classmethod
    def from_plan(cls, plan: Plan) -> Self | None:
        branches = len(plan.material.relaxation)
        return cls(branches, plan.scene.time.at_rest) if branches else None

    @property
    def memory(self) -> tuple[str, ...]:
        return tuple(f"relaxation {n} {axis}" for n in range(self.branches) for axis in "xyz")

    @property
    def field_places(self) -> Places:
        return Places(memory=[3] * self.branches)

    @property
    def column_places(self) -> Places:
        # The factor of f; with `by_frame` 1 if the memory changes, else 0.
        return Places(factor=1, update=1, branches=[BRANCH] * self.branches)

    def columns(self, plan: Plan, loads: Schedule, first: int) -> NDArray[Any]:
        h = 1 / plan.grid.frames_per_second if self.by_frame else plan.grid.step
        shares, times = np.array(plan.material.relaxation).T
        decrease = -np.expm1(-h / times)
        phi = decrease / (h / times)
        factor, share = 1 - shares.sum() + (shares * phi).sum(), shares * phi
        if self.by_frame and first == 0:
            factor, share = 1, shares * (phi - 1 + decrease) / decrease
        row = factor, 0.0, *np.stack([decrease, share], axis=1).ravel()
        return np.tile(row, (len(loads.active), 1))

    def mark_update(self, columns: NDArray[Any]) -> bool:
        columns[self.column_places.update] = 1
        return True

    def build_forces(self, config: KernelConfig) -> Sequence[Callable[..., Any]]:
        ti, columns, by_frame = config.ti, config.columns(ViscoelasticTerm), self.by_frame
        memory = config.fields(ViscoelasticTerm).memory

        @ti.func
        def relax(force: ti.template(), sheet: ti.template(), entry: ti.template(), now: ti.template()):
            at = entry.row.i * sheet.width + entry.b
            for c in ti.static(range(3)):
                elastic = force[c]
                force[c] = elastic * now[columns.factor]
                for n, branch in ti.static(enumerate(columns.branches)):
                    index = memory[n][c] * sheet.rows * sheet.width + at
                    s = sheet.fields[index]
                    force[c] += s
                    if ti.static(by_frame):
                        if now[columns.update] > 0:
                            sheet.fields[index] = s - now[branch.decrease] * (s + now[branch.share] * elastic)
                    else:
                        sheet.fields[index] = s - now[branch.decrease] * (s + now[branch.share] * elastic)

        return (relax,)
