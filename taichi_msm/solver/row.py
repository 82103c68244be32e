"""A row in a pass on a CPU: the forces of its springs, each evaluated once for both ends, and its step in place.

Lane l of entry b of a row is column b - 1 of strip l. The neighbours of an entry are therefore the adjacent entries,
and every operation is one vector instruction. The first and the last entry of a row are its halo: the last column of
the previous strip and the first column of the next strip. The force of a spring between this row and the next is added
to this row and carried to the next row; the force of a spring along the row is carried to the next entry. No later row
depends on the old displacements of this row, so it is stepped in place.

Contact with position-controlled tools is resolved afterwards, in the rows that the tools can reach.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable

from taichi_msm.system.runtime import ti
from taichi_msm.terms.base import BY_COLUMN, DX, DY, Correction, Entry, KernelConfig, RowPair, build_max_lane
from taichi_msm.terms.points import build_point_functions
from taichi_msm.terms.springs import SpringTerm


def build_pass_row(config: KernelConfig, move: Callable[..., None]) -> Callable[..., None]:
    """Build the Taichi function that computes the forces on a row and steps it.

    move(sheet, entry, target, force, now) steps an entry with the force of its springs, see `build_point_step`.
    """
    vector, columns, springs = config.vector, config.columns().end, config.require(SpringTerm)
    structural, shear, open_edges = springs.structural, springs.shear, springs.open_edges
    force_on_right, force_on_other = springs.build_spring_forces(config)

    @ti.func
    def pass_row(
        sheet: ti.template(), carried: ti.template(), carried_row, line: ti.template(), source, next_row, exists, up,
        loads: ti.template(), n, moving,
    ):  # fmt: skip
        """Compute the forces on a row `line`, and step it if `moving`.

        Its displacements are in row `source` of u, those of the next row of the pass in row `next_row`. `exists` is 1,
        or 0 if the sheet has no next row, and `up` its y minus that of this row, at rest [m]. Row `carried_row` of the
        three arrays `carried` has the forces carried to the next row [N]; row n of `loads` is that of the step.
        """
        width, strip, i = sheet.width, sheet.width - 2, line.i
        diagonal = ti.sqrt(sheet.constants[DX] * sheet.constants[DX] + sheet.constants[DY] * sheet.constants[DY])
        # The sheet has no row above the first and none below the last one.
        upper, other = i - ti.select(up < 0, 0, 1), ti.max(0, ti.min(i + ti.select(up < 0, 1, -1), sheet.rows - 1))
        pair = ti.static(RowPair(i, line.kind, other, upper, up, diagonal))
        # Entry 0 of both rows of u and of the row of carried forces.
        row, next_at, carry = source * width, next_row * width, carried_row * width
        # Force of the left neighbour, and forces carried to the other row for the previous, this and the next entry.
        left, last = [vector(0) for _ in ti.static(range(3))], [vector(0) for _ in ti.static(range(3))]
        this, following = [vector(0) for _ in ti.static(range(3))], [vector(0) for _ in ti.static(range(3))]
        has_left, has_right = vector(1), vector(1)
        if ti.static(open_edges):
            has_right = sheet.by_column[BY_COLUMN.has_right * width + 0]
        u = [sheet.u[c][row] for c in ti.static(range(3))]
        if ti.static(structural):
            first = force_on_right(sheet, pair, row + 1, 0, u, has_right)
            for c in ti.static(range(3)):
                left[c] = first[c]
        if ti.static(shear):
            first_right = force_on_other(sheet, pair, next_at + 1, 1, 0, u, has_right * exists)
            for c in ti.static(range(3)):
                following[c] = first_right[c]
        # Read once, because the compiler must assume that stores to the arrays could change the table.
        now = [loads[n, c] for c in ti.static(range(columns))]
        for b in range(1, strip + 1):
            # Until the carried force is added, `force` is the force on the neighbours in the other row.
            force = [vector(0) for _ in ti.static(range(3))]
            for c in ti.static(range(3)):
                # Neighbours are read again for every entry, because registers are too few to keep them.
                u[c] = sheet.u[c][row + b]
                last[c] = this[c]
                this[c] = following[c]
            if ti.static(open_edges):
                has_left, has_right = (
                    sheet.by_column[BY_COLUMN.has_left * width + b],
                    sheet.by_column[BY_COLUMN.has_right * width + b],
                )
            if ti.static(shear):
                to_left = force_on_other(sheet, pair, next_at + b - 1, -1, b, u, has_left * exists)
                for c in ti.static(range(3)):
                    force[c] = to_left[c]
                    last[c] += to_left[c]
            if ti.static(structural):
                straight = force_on_other(sheet, pair, next_at + b, 0, b, u, exists)
                for c in ti.static(range(3)):
                    force[c] += straight[c]
                    this[c] += straight[c]
            if ti.static(shear):
                to_right = force_on_other(sheet, pair, next_at + b + 1, 1, b, u, has_right * exists)
                for c in ti.static(range(3)):
                    force[c] += to_right[c]
                    following[c] = to_right[c]
            for c in ti.static(range(3)):
                force[c] = carried[c][carry + b] - force[c]
            if ti.static(structural):
                right = force_on_right(sheet, pair, row + b + 1, b, u, has_right)
                for c in ti.static(range(3)):
                    force[c] += left[c] - right[c]
                    left[c] = right[c]
            for c in ti.static(range(3)):
                # The previous entry has already read the old value.
                carried[c][carry + b - 1] = last[c]
            if moving:
                entry = ti.static(Entry(line, b, u))
                move(sheet, entry, source, force, now)
        if ti.static(shear):
            if ti.static(open_edges):
                has_left = sheet.by_column[BY_COLUMN.has_left * width + strip + 1]
            for c in ti.static(range(3)):
                u[c] = sheet.u[c][row + strip + 1]
            end = force_on_other(sheet, pair, next_at + strip, -1, strip + 1, u, has_left * exists)
            for c in ti.static(range(3)):
                this[c] += end[c]
        for c in ti.static(range(3)):
            carried[c][carry + strip] = this[c]

    return pass_row


def build_correct_row(config: KernelConfig, correction: Correction) -> Callable[..., None]:
    """Build the Taichi function correct_row(sheet, i, kind, loads, n), which corrects row i, if a term may need it."""
    columns, (reaches, resolve), max_lane = config.columns().end, correction, build_max_lane(config)
    curved, rest_position = config.curved, build_point_functions(config).rest_position

    @ti.func
    def place(sheet: ti.template(), i, b):
        """Return displacements along y and z, on a curved sheet positions."""
        placed = [sheet.u[c][i * sheet.width + b] for c in ti.static((1, 2))]
        if ti.static(curved):
            rest = rest_position(sheet, i, b)
            placed[0], placed[1] = placed[0] + rest[1], placed[1] + rest[2]
        return placed

    @ti.func
    def correct_row(sheet: ti.template(), i, kind, loads: ti.template(), n):
        now = [loads[n, c] for c in ti.static(range(columns))]
        least, most = place(sheet, i, 1), place(sheet, i, 1)
        for b in range(2, sheet.width - 1):
            placed = place(sheet, i, b)
            for axis in ti.static(range(2)):
                least[axis], most[axis] = ti.min(least[axis], placed[axis]), ti.max(most[axis], placed[axis])
        low = [0 - max_lane(0.0 - least[axis]) for axis in ti.static(range(2))]
        high = [max_lane(most[axis]) for axis in ti.static(range(2))]
        if reaches(sheet, i, low, high, now):
            for b in range(1, sheet.width - 1):
                resolve(sheet, i, kind, i, b, now)

    return correct_row
