"""Warnings about a flat sheet that is compressed by loads within its plane, which do not determine its shape."""

from __future__ import annotations

from collections.abc import Iterator

from taichi_msm.model.plan import Plan
from taichi_msm.model.tools import solid_tools
from taichi_msm.solver.state import RunProgress
from taichi_msm.terms.springs import SpringTerm

# Smallest distance from the plane, relative to the largest displacement, and smallest compression of a spring.
MIN_RISE, MIN_COMPRESSION = 0.01, 0.01

REMEDY = (
    "a probe across the sheet with a thousandth of the forces within it selects the side; a larger tissue.bending, "
    "which needs every side held, keeps it flat"
)


def buckling_warnings(plan: Plan, progress: RunProgress) -> Iterator[str]:
    """Yield a warning if a sheet has buckled to an arbitrary side, or stays flat without being stable."""
    if not _is_symmetric(plan):
        return
    rise, largest, material = max(progress.deepest, progress.highest), progress.max_displacement, plan.material
    # By Poisson's ratio of 1/3 a stretched sheet contracts across, without stress.
    compression = 1 - material.tension - progress.shortest_spring - (progress.longest_spring - 1) / 3
    # A compressed spring repels the mass points next to it with its tension per length.
    unstable = compression * SpringTerm.stiffness_bound(material, plan.scene.sheet) > material.virtual
    if rise > MIN_RISE * largest:
        yield (
            f"the sheet buckled, up to {1000 * rise:.2g} mm out of its plane, although no load acts across it: the "
            f"opposite side is an equilibrium, too, and rounding decides between them, so the shape is not determined; "
            f"{REMEDY}"
        )
    elif compression > MIN_COMPRESSION and unstable and material.bending == 0 and not plan.scene.time.at_rest:
        yield (
            f"the sheet is compressed by {100 * compression:.2g} %, and stays flat only because no load acts "
            f"across it: any disturbance may make it buckle, to either side, with other forces; {REMEDY}"
        )


def _is_symmetric(plan: Plan) -> bool:
    """Return whether the mirror image of a motion, at the plane of the sheet at rest, is a solution, too."""
    forces = [probe.vector or (0, 0, 0) for probe in plan.scene.probes if probe.path is None]
    crosses = any(force[2] != 0 for force in forces) or any(tool.path[:, 2].any() for tool in plan.tools)
    return not (plan.scene.sheet.surface or crosses or solid_tools(plan.tools))
