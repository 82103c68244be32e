"""Contact in quasi-static equilibrium: contact forces of tools, and projection of mass points out of their capsules.

A tool can push a mass point that touches it but cannot pull it. Of the force F on the mass point, the tool therefore
carries the part into the capsule, min(F . n, 0) n; the remainder, tangential or outward, must vanish in equilibrium.
The normals n are stored in the fields of corrections and are 0 where a mass point touches no tool. Held mass points
move with their tool, which carries their whole force.

A mass point may touch several tools. Their contact forces and corrections are then found by projected Gauss-Seidel
iteration.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable

from taichi_msm.terms.base import DY, MOBILITY, REST_X, TOP_Y, KernelConfig
from taichi_msm.terms.contact import (
    COLUMNS,
    CORRECTIONS,
    GRIP_SHIFT,
    HOLD_DISPLACEMENT,
    HOLDER,
    TOOL_COLUMNS,
    ContactTerm,
    build_penetration,
)


def build_remove_contact(config: KernelConfig, contact: ContactTerm) -> Callable[..., None]:
    """Build the Taichi function remove_contact(force, sheet, at), which removes contact forces at an entry."""
    ti, vector, tools, grips = config.ti, config.vector, contact.tools, contact.grips
    first_field = config.first_field(ContactTerm)
    holding, iterations = first_field + CORRECTIONS * tools + HOLDER, _iterations(contact)

    @ti.func
    def remove_contact(force: ti.template(), sheet: ti.template(), at):
        field = sheet.rows * sheet.width
        carried = [vector(0) for _ in ti.static(range(tools))]
        for _ in range(iterations):
            for tool in ti.static(range(tools)):
                normal = [
                    sheet.fields[(first_field + CORRECTIONS * tool + c) * field + at] for c in ti.static(range(3))
                ]
                along = force[0] * normal[0] + force[1] * normal[1] + force[2] * normal[2]
                total = ti.max(carried[tool] - along, 0)
                change = total - carried[tool]
                carried[tool] = total
                for c in ti.static(range(3)):
                    force[c] += change * normal[c]
        if ti.static(grips):
            for c in ti.static(range(3)):
                force[c] = ti.select(sheet.fields[holding * field + at] > 0, vector(0), force[c])

    return remove_contact


def build_project_out(config: KernelConfig, contact: ContactTerm) -> Callable[..., None]:
    """Build the Taichi function project_out(sheet, i, kind, b, now) for entry b of row i of a `RestSheet`.

    It projects mass points out of the tools, removes their momentum into the tools, and moves held mass points with
    their tool.
    """
    ti, vector, tools, grips = config.ti, config.vector, contact.tools, contact.grips
    first_field, first = config.first_field(ContactTerm), config.first_column(ContactTerm)
    grip_field = first_field + CORRECTIONS * tools
    base, penetration = [first + COLUMNS + TOOL_COLUMNS * tool for tool in range(tools)], build_penetration(config)
    iterations = _iterations(contact)

    @ti.func
    def project_out(sheet: ti.template(), i, kind, b, now: ti.template()):
        field, at = sheet.rows * sheet.width, i * sheet.width + b
        rest = [
            sheet.by_column[REST_X * sheet.width + b],
            vector(sheet.constants[TOP_Y] - i * sheet.constants[DY]),
            vector(0),
        ]
        u, q = [sheet.u[c][at] for c in ti.static(range(3))], [sheet.q[c][at] for c in ti.static(range(3))]
        free = ti.select(sheet.by_column[(MOBILITY + kind) * sheet.width + b] > 0, vector(1), vector(0))
        if ti.static(grips):
            held = sheet.fields[(grip_field + HOLDER) * field + at]
            for tool in ti.static(range(tools)):
                for c in ti.static(range(3)):
                    target = (
                        sheet.fields[(grip_field + HOLD_DISPLACEMENT + c) * field + at]
                        + now[base[tool] + GRIP_SHIFT + c]
                    )
                    u[c] = ti.select(held == tool + 1, target, u[c])
                    q[c] = ti.select(held == tool + 1, vector(0), q[c])
            free = ti.select(held > 0, vector(0), free)
        for tool in ti.static(range(tools)):
            for c in ti.static(range(3)):
                sheet.fields[(first_field + CORRECTIONS * tool + c) * field + at] = vector(0)
        for _ in range(iterations):
            for tool in ti.static(range(tools)):
                depth, x, y, z = penetration(rest, u, now, base[tool])
                normal = [x, y, z]
                touches = ti.select(depth > 0, free, vector(0))
                inward = ti.min(q[0] * x + q[1] * y + q[2] * z, 0) * touches
                for c in ti.static(range(3)):
                    u[c] += touches * depth * normal[c]
                    q[c] = q[c] - inward * normal[c]
                    index = (first_field + CORRECTIONS * tool + c) * field + at
                    sheet.fields[index] = ti.select(touches > 0, normal[c], sheet.fields[index])
        for c in ti.static(range(3)):
            sheet.u[c][at] = u[c]
            sheet.q[c][at] = q[c]

    return project_out


def _iterations(contact: ContactTerm) -> int:
    """Return the number of Gauss-Seidel iterations."""
    return 8 if contact.tools > 1 else 1
