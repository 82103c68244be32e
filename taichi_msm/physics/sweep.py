"""The sweep of a row on a CPU: the forces of its springs, each evaluated once for both ends, and then its step.

Lane l of entry b of a row is column b - 1 of strip l, so the neighbours of an entry are the entries beside it, and
every operation is one vector instruction. The first and the last entry of a row are a halo: the entries at the other
end of the strips, shifted by one lane. The force of a spring between this row and the next one is added to this row at
once and carried to the next; the force of a spring along the row is carried to the next entry. After that no other row
depends on the old displacements of this row, so it is stepped in place.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable

from taichi_msm.physics.kernel import point_step
from taichi_msm.physics.terms.springs import SpringTerm
from taichi_msm.physics.terms.term import DX, DY, HAS_LEFT, HAS_RIGHT, Entry, StepCode
from taichi_msm.system.runtime import ti


def sweeping(code: StepCode) -> Callable[..., None]:
    """Make the function that sweeps a row."""
    vector, columns, springs = code.vector, code.first_column(None), code.require(SpringTerm)
    structural, shear = springs.structural, springs.shear
    leaves_out = springs.open_edges and not springs.mapped
    along, to_other_row, of_row, of_column, of_diagonal = springs.between(code)
    move = point_step(code)

    @ti.func
    def sweep_row(
        sheet: ti.template(), carried: ti.template(), carried_row, line: ti.template(), here, next_row, exists, up,
        loads: ti.template(), n, moving,
    ):  # fmt: skip
        """Sweep a row, and step it if `moving`.

        Args:
            sheet: the sheet.
            carried: forces carried from row to row, three arrays.
            carried_row: the row of them.
            line: the row.
            here: row of u that holds it.
            next_row: row of u that holds the next row.
            exists: 1 if there is a next row, else 0.
            up: how far the next row is above this one [m].
            loads: the table of loads.
            n: its row.
            moving: whether the row is stepped.
        """
        width, strip, i, kind = sheet.width, sheet.width - 2, line.i, line.kind
        diagonal = ti.sqrt(sheet.numbers[DX] * sheet.numbers[DX] + sheet.numbers[DY] * sheet.numbers[DY])
        # The lower one of the two rows.
        lower = i + ti.select(up < 0, 1, 0)
        # Where u has this row and the other one, and where the forces between them are carried; all from entry 0 on.
        row, other, carry = here * width, next_row * width, carried_row * width
        # Force of the left neighbour.
        left_x, left_y, left_z = vector(0), vector(0), vector(0)
        # Forces carried to the other row: for the entry before this one, this one and the next one.
        last_x, last_y, last_z = vector(0), vector(0), vector(0)
        this_x, this_y, this_z = vector(0), vector(0), vector(0)
        coming_x, coming_y, coming_z = vector(0), vector(0), vector(0)
        has_left, has_right = vector(1), vector(1)
        if ti.static(leaves_out):
            has_right = sheet.by_column[HAS_RIGHT * width + 0]
        here_x, here_y, here_z = sheet.u[0][row], sheet.u[1][row], sheet.u[2][row]
        if ti.static(structural):
            left_x, left_y, left_z = along(sheet, row + 1, here_x, here_y, here_z, of_row(sheet, i, kind, 0), has_right)
        if ti.static(shear):
            coming_x, coming_y, coming_z = to_other_row(
                sheet, other + 1, 1, here_x, here_y, here_z, up, diagonal,
                of_diagonal(sheet, lower, 0), has_right * exists,
            )  # fmt: skip
        # Read once, because the compiler must assume that stores to the arrays change the table.
        now = [loads[n, c] for c in ti.static(range(columns))]
        for b in range(1, strip + 1):
            # Neighbours are read again for every entry: there are too few registers to keep them.
            here_x, here_y, here_z = sheet.u[0][row + b], sheet.u[1][row + b], sheet.u[2][row + b]
            # Sum of the forces on the neighbours in the other row.
            force_x, force_y, force_z = vector(0), vector(0), vector(0)
            last_x, last_y, last_z = this_x, this_y, this_z
            this_x, this_y, this_z = coming_x, coming_y, coming_z
            if ti.static(leaves_out):
                has_left, has_right = sheet.by_column[HAS_LEFT * width + b], sheet.by_column[HAS_RIGHT * width + b]
            if ti.static(shear):
                x, y, z = to_other_row(
                    sheet, other + b - 1, -1, here_x, here_y, here_z, up, diagonal,
                    of_diagonal(sheet, lower, b - 1), has_left * exists,
                )  # fmt: skip
                force_x, force_y, force_z = x, y, z
                last_x += x
                last_y += y
                last_z += z
            if ti.static(structural):
                x, y, z = to_other_row(
                    sheet, other + b, 0, here_x, here_y, here_z, up, ti.abs(up), of_column(sheet, lower, b), exists
                )
                force_x += x
                force_y += y
                force_z += z
                this_x += x
                this_y += y
                this_z += z
            if ti.static(shear):
                x, y, z = to_other_row(
                    sheet, other + b + 1, 1, here_x, here_y, here_z, up, diagonal,
                    of_diagonal(sheet, lower, b), has_right * exists,
                )  # fmt: skip
                force_x += x
                force_y += y
                force_z += z
                coming_x, coming_y, coming_z = x, y, z
            force_x = carried[0][carry + b] - force_x
            force_y = carried[1][carry + b] - force_y
            force_z = carried[2][carry + b] - force_z
            if ti.static(structural):
                x, y, z = along(sheet, row + b + 1, here_x, here_y, here_z, of_row(sheet, i, kind, b), has_right)
                force_x += left_x - x
                force_y += left_y - y
                force_z += left_z - z
                left_x, left_y, left_z = x, y, z
            # What was stored there was read for the entry before.
            carried[0][carry + b - 1] = last_x
            carried[1][carry + b - 1] = last_y
            carried[2][carry + b - 1] = last_z
            if moving:
                entry = ti.static(Entry(line, b, here_x, here_y, here_z))
                move(sheet, entry, here, force_x, force_y, force_z, now)
        if ti.static(shear):
            if ti.static(leaves_out):
                has_left = sheet.by_column[HAS_LEFT * width + strip + 1]
            end = row + strip + 1
            x, y, z = to_other_row(
                sheet, other + strip, -1, sheet.u[0][end], sheet.u[1][end], sheet.u[2][end],
                up, diagonal, of_diagonal(sheet, lower, strip), has_left * exists,
            )  # fmt: skip
            this_x += x
            this_y += y
            this_z += z
        carried[0][carry + strip] = this_x
        carried[1][carry + strip] = this_y
        carried[2][carry + strip] = this_z

    return sweep_row
