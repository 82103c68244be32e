"""Contact at rest: the forces that tools take off the points, and how these are kept out of the rods.

A tool pushes a point that touches it, and never pulls it: of the force F on the point it bears the part into the rod,
min(F . n, 0) n. What is left, along the rod or away from it, must vanish. Each n is kept in the fields where steps keep
pushes, and is 0 where a point does not touch. What is held goes with its tool, which bears all of its force.

A point between tools may touch several: then what they bear, and how far they push, is found in turns (by projected
Gauss-Seidel).
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

# How many turns tools take at a point, if there are several.
TURNS = 8


def build_bear(config: KernelConfig, contact: ContactTerm) -> Callable[..., None]:
    """Make Taichi's function bear(force, sheet, at), which takes off what the tools bear at an entry of the sheet."""
    ti, vector, tools, grips = config.ti, config.vector, contact.tools, contact.grips
    first_field = config.first_field(ContactTerm)
    holding, turns = first_field + CORRECTIONS * tools + HOLDER, _turns(contact)

    @ti.func
    def bear(force: ti.template(), sheet: ti.template(), at):
        field = sheet.rows * sheet.width
        borne = [vector(0) for _ in ti.static(range(tools))]
        for _ in range(turns):
            for tool in ti.static(range(tools)):
                normal = [
                    sheet.fields[(first_field + CORRECTIONS * tool + c) * field + at] for c in ti.static(range(3))
                ]
                along = force[0] * normal[0] + force[1] * normal[1] + force[2] * normal[2]
                all_of_it = ti.max(borne[tool] - along, 0)
                change = all_of_it - borne[tool]
                borne[tool] = all_of_it
                for c in ti.static(range(3)):
                    force[c] += change * normal[c]
        if ti.static(grips):
            for c in ti.static(range(3)):
                force[c] = ti.select(sheet.fields[holding * field + at] > 0, vector(0), force[c])

    return bear


def build_keep_out(config: KernelConfig, contact: ContactTerm) -> Callable[..., None]:
    """Make Taichi's function keep_out(sheet, i, kind, b, now), for entry b of row i of a `RestSheet` that has moved.

    It pushes the points out of the tools, stops them there, and puts what is held where its tool is.
    """
    ti, vector, tools, grips = config.ti, config.vector, contact.tools, contact.grips
    first_field, first = config.first_field(ContactTerm), config.first_column(ContactTerm)
    grip_field = first_field + CORRECTIONS * tools
    own, part = [first + COLUMNS + TOOL_COLUMNS * tool for tool in range(tools)], build_penetration(config)
    turns = _turns(contact)

    @ti.func
    def keep_out(sheet: ti.template(), i, kind, b, now: ti.template()):
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
                    place = (
                        sheet.fields[(grip_field + HOLD_DISPLACEMENT + c) * field + at]
                        + now[own[tool] + GRIP_SHIFT + c]
                    )
                    u[c] = ti.select(held == tool + 1, place, u[c])
                    q[c] = ti.select(held == tool + 1, vector(0), q[c])
            free = ti.select(held > 0, vector(0), free)
        for tool in ti.static(range(tools)):
            for c in ti.static(range(3)):
                sheet.fields[(first_field + CORRECTIONS * tool + c) * field + at] = vector(0)
        for _ in range(turns):
            for tool in ti.static(range(tools)):
                depth, x, y, z = part(rest, u, now, own[tool])
                normal = [x, y, z]
                touches = ti.select(depth > 0, free, vector(0))
                inward = ti.min(q[0] * x + q[1] * y + q[2] * z, 0) * touches
                for c in ti.static(range(3)):
                    u[c] += touches * depth * normal[c]
                    q[c] = q[c] - inward * normal[c]
                    place = (first_field + CORRECTIONS * tool + c) * field + at
                    sheet.fields[place] = ti.select(touches > 0, normal[c], sheet.fields[place])
        for c in ti.static(range(3)):
            sheet.u[c][at] = u[c]
            sheet.q[c][at] = q[c]

    return keep_out


def _turns(contact: ContactTerm) -> int:
    return TURNS if contact.tools > 1 else 1
