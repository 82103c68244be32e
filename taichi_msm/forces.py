"""What both forms of kernel 1 are made of: the force of a spring, the step of a point, strains, the start.

A value of the sheet is a vector of lanes, each of another column; on a GPU of one.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

from numpy.typing import NDArray

from taichi_msm.runtime import FieldTree, ti

# Rows of the field by_column; the first three say which points of a first, a middle and a last row move.
MOVES, ACROSS, HAS_LEFT, HAS_RIGHT = 0, 3, 4, 5

# Columns of the table of loads: gain, stiffness of the virtual springs, then for each grip force (3), point (2),
# falloff and offset.
GRIP_COLUMN, GRIP_COLUMNS = 2, 7

# What is read of every row of points: the least of (L^2 - L0^2) / L0^2, the sums of (L / L0 - 1)^2 of springs along the
# row, down and diagonal, and the sum of |d|^2.
MEASURES = 5

# Bytes of a number.
BYTES = {"f32": 4, "f64": 8}


@dataclass(frozen=True)
class Structure:
    """What a kernel is compiled for; numbers are its arguments.

    Attributes:
        rows, cols: points of the sheet.
        precision: f32 or f64.
        lanes: strips of columns.
        workers: bands of rows that step side by side; 0 on a GPU, where every point does.
        depth: steps that a band takes in one sweep.
        structural, shear: whether there are springs of that family.
        fixed_rows: whether every point of the first row is fixed, and of the last.
        open_edges: whether a point at an edge moves, so that springs beyond the edge must be left out.
        virtual: whether there are virtual springs.
        damped: whether there is damping.
        grips: for every grip whether it moves.
    """

    rows: int
    cols: int
    precision: str
    lanes: int
    workers: int
    depth: int
    structural: bool
    shear: bool
    fixed_rows: tuple[bool, bool]
    open_edges: bool
    virtual: bool
    damped: bool
    grips: tuple[bool, ...]

    @property
    def strip(self) -> int:
        """Number of columns of a strip."""
        return -(-self.cols // self.lanes)

    @property
    def load_columns(self) -> int:
        """Number of columns of the table of loads."""
        return GRIP_COLUMN + GRIP_COLUMNS * len(self.grips)


class Readings(NamedTuple):
    """What is read of a sheet, in the order of the kernel's arguments.

    Attributes:
        differences: whether d is wanted, and not u.
        out: filled with it, shape (rows, cols, 3).
        measures: filled with those of every row of points, shape (rows, MEASURES).
    """

    differences: bool
    out: NDArray[Any]
    measures: NDArray[Any]


class SheetFields(FieldTree):
    """The fields of one sheet; entry 0 and the last one of a row are the halo of its strips.

    Args:
        s: the structure.
        stored_rows: rows of displacements.

    Attributes:
        displacement: u of x, y and z, each of shape (stored rows, strip + 2).
        difference: d of x, y and z, each of shape (rows, strip + 2).
        by_column: whether the points move, of a first, middle and last row; their place across [m]; whether they have
            a left and a right neighbour: shape (6, strip + 2).
        decay: of every standing grip, shape (standing grips, rows, strip + 2).
    """

    def __init__(self, s: Structure, stored_rows: int) -> None:
        super().__init__()
        self._lanes, self._real = s.lanes, getattr(ti, s.precision)
        width = s.strip + 2
        self.displacement = [self.vector(stored_rows, width) for _ in range(3)]
        self.difference = [self.vector(s.rows, width) for _ in range(3)]
        self.by_column = self.vector(6, width)
        self.decay = self.vector(max(1, s.grips.count(False)), s.rows, width)

    def vector(self, *shape: int) -> Any:
        """Place a field of vectors of lanes."""
        return self.place(ti.Vector.field(self._lanes, self._real), *shape)


def spring_forces(s: Structure, fields: SheetFields) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Make the functions that give the force of a spring along a row, and of one to the row ahead.

    With q = u_Q - u_P and the rest vector o from P to Q, L^2 - L0^2 = q (q + 2 o), so that the force

        k (L - L0) (Q - P) / L = k (L^2 - L0^2) / (L^2 + L0 L) (o + q)                         (eq. 2)

    keeps the digits of a small motion on a large sheet. Swapping P and Q changes its sign and not one bit more.
    """
    u, by_column, open_edges = fields.displacement, fields.by_column, s.open_edges
    # Keeps L = 0 from dividing by 0: the force is then 0, as Q - P is. A literal in a kernel is f32, also among f64.
    tiny = 1e-36

    @ti.func
    def pull(longer, square, length, stiffness):
        return stiffness * longer / (square + length * ti.sqrt(square))

    @ti.func
    def along(p, b, dx, stiffness):
        """Force on entry b of row p by its right neighbour."""
        x = u[0][p, b + 1] - u[0][p, b]
        y = u[1][p, b + 1] - u[1][p, b]
        z = u[2][p, b + 1] - u[2][p, b]
        to_x = x + dx
        rest = y * y + z * z
        force = pull(x * (to_x + dx) + rest, to_x * to_x + rest + tiny, dx, stiffness)
        if ti.static(open_edges):
            force *= by_column[HAS_RIGHT, b]
        return force * to_x, force * y, force * z

    @ti.func
    def ahead(p, q, b, right: ti.template(), dx, dy, stiffness, there):
        """Force on entry b of row p by entry b + right of row q, which is dy above; there: 0 without a row q."""
        x = u[0][q, b + right] - u[0][p, b]
        y = u[1][q, b + right] - u[1][p, b]
        z = u[2][q, b + right] - u[2][p, b]
        to_x = x
        to_y = y + dy
        longer = x * x + (y * (to_y + dy) + z * z)
        length = ti.abs(dy)
        if ti.static(right != 0):
            to_x = x + right * dx
            longer = x * (to_x + right * dx) + (y * (to_y + dy) + z * z)
            length = ti.sqrt(dx * dx + dy * dy)
        force = pull(longer, to_x * to_x + to_y * to_y + z * z + tiny, length, stiffness)
        if ti.static(open_edges):
            force *= there
        if ti.static(open_edges and right < 0):
            force *= by_column[HAS_LEFT, b]
        if ti.static(open_edges and right > 0):
            force *= by_column[HAS_RIGHT, b]
        return force * to_x, force * to_y, force * z

    return along, ahead


def strains(s: Structure, fields: SheetFields) -> Callable[..., Any]:
    """Make the function that tells how far springs are stretched: those to the right of an entry and to a row below.

    The function gives, in every lane, the least (L^2 - L0^2) / L0^2 of all of them, and the sums of (L / L0 - 1)^2 of
    those along the row, those down and the diagonals.
    """
    u, by_column, open_edges = fields.displacement, fields.by_column, s.open_edges
    real, lanes, structural, shear = getattr(ti, s.precision), s.lanes, s.structural, s.shear

    @ti.func
    def longer(p, q, b, right: ti.template(), x0, y0):
        """(L^2 - L0^2) / L0^2 of the spring from entry b of row p to entry b + right of row q; with all its digits."""
        x = u[0][q, b + right] - u[0][p, b]
        y = u[1][q, b + right] - u[1][p, b]
        z = u[2][q, b + right] - u[2][p, b]
        found = (x * (x + 2 * x0) + (y * (y + 2 * y0) + z * z)) / (x0 * x0 + y0 * y0)
        # Beyond the edge there is no spring.
        if ti.static(open_edges and right < 0):
            found = ti.select(by_column[HAS_LEFT, b] > 0, found, 0)
        if ti.static(open_edges and right > 0):
            found = ti.select(by_column[HAS_RIGHT, b] > 0, found, 0)
        return found

    @ti.func
    def square(share):
        """(L / L0 - 1)^2, given (L^2 - L0^2) / L0^2, which rounding may put below -1."""
        stretch = share / (1 + ti.sqrt(ti.max(share + 1, 0)))
        return stretch * stretch

    @ti.func
    def strain(p, q, b, dx, dy, there):
        """Entry b of row p, and row q below it if it is there."""
        zero = ti.Vector.zero(real, lanes)
        least, along, down, diagonal = zero, zero, zero, zero
        if ti.static(structural):
            share = longer(p, p, b, 1, dx, 0)
            least = ti.min(least, share)
            along = square(share)
        if there:
            if ti.static(structural):
                share = longer(p, q, b, 0, 0, -dy)
                least = ti.min(least, share)
                down = square(share)
            if ti.static(shear):
                left, right = longer(p, q, b, -1, -dx, -dy), longer(p, q, b, 1, dx, -dy)
                least = ti.min(least, ti.min(left, right))
                diagonal = square(left) + square(right)
        return least, along, down, diagonal

    return strain


def point_step(s: Structure, fields: SheetFields) -> Callable[..., None]:
    """Make the function that adds to the forces of springs those of the tissue and the probes, and steps a point.

    d_{n+1} = keep d_n + gain F_n,    u_{n+1} = u_n + d_{n+1}                                  (eq. 6 to 9)
    """
    real = getattr(ti, s.precision)
    rows, lanes, virtual, damped, grip_moves = s.rows, s.lanes, s.virtual, s.damped, s.grips
    u, d, by_column, decay = fields.displacement, fields.difference, fields.by_column, fields.decay
    standing = [grip_moves[:n].count(False) for n in range(len(grip_moves))]

    @ti.func
    def move(p, q, i, b, spring_x, spring_y, spring_z, keep, dy, top, now):
        """Step entry b of row i of the sheet, stored in row p, into row q; now is the row of the table of loads."""
        x = u[0][p, b]
        y = u[1][p, b]
        z = u[2][p, b]
        force_x, force_y, force_z = spring_x, spring_y, spring_z
        if ti.static(virtual):
            force_x -= now[1] * x
            force_y -= now[1] * y
            force_z -= now[1] * z
        for g in ti.static(range(len(grip_moves))):
            column = ti.static(GRIP_COLUMN + GRIP_COLUMNS * g)
            share = ti.Vector.zero(real, lanes)
            if ti.static(grip_moves[g]):
                off_x = by_column[ACROSS, b] - now[column + 3]
                off_y = top - i * dy - now[column + 4]
                distance = ti.sqrt(off_x * off_x + off_y * off_y)
                share = ti.exp(-now[column + 5] * distance - now[column + 6])
            else:
                share = decay[standing[g], i, b]
            force_x += now[column] * share
            force_y += now[column + 1] * share
            force_z += now[column + 2] * share

        kind = MOVES + 1
        if i == 0:
            kind = MOVES
        if i == rows - 1:
            kind = MOVES + 2
        gain = now[0] * by_column[kind, b]
        d_x = d[0][i, b]
        d_y = d[1][i, b]
        d_z = d[2][i, b]
        if ti.static(damped):
            d_x *= keep
            d_y *= keep
            d_z *= keep
        d_x += gain * force_x
        d_y += gain * force_y
        d_z += gain * force_z
        d[0][i, b] = d_x
        d[1][i, b] = d_y
        d[2][i, b] = d_z
        u[0][q, b] = x + d_x
        u[1][q, b] = y + d_y
        u[2][q, b] = z + d_z

    return move


def start_kernel(s: Structure, fields: SheetFields) -> Callable[..., None]:
    """Make the kernel that puts the sheet where it begins and writes what steps do not change.

    Its arguments: `by_column` and `decay`, whose last axis is the lanes; for every stored row of displacements the row
    of the sheet that it holds, or -1; whether displacements and differences are given, and these, of shape
    (rows, cols, 3), or else any: the sheet is at rest.
    """
    real, rows, cols, lanes, strip = getattr(ti, s.precision), s.rows, s.cols, s.lanes, s.strip
    u, d, by_column, decay = fields.displacement, fields.difference, fields.by_column, fields.decay

    @ti.kernel
    def start(
        columns: ti.types.ndarray(dtype=real, ndim=3),
        shares: ti.types.ndarray(dtype=real, ndim=4),
        source: ti.types.ndarray(dtype=ti.i32, ndim=1),
        given: ti.i32,
        displacement: ti.types.ndarray(dtype=real, ndim=3),
        difference: ti.types.ndarray(dtype=real, ndim=3),
    ):
        # One loop for all: each would be compiled by itself.
        for p, b in u[0]:
            for c in ti.static(range(3)):
                u[c][p, b] = ti.Vector.zero(real, lanes)
                if p < rows:
                    d[c][p, b] = ti.Vector.zero(real, lanes)
            for lane in ti.static(range(lanes)):
                j = lane * strip + b - 1
                if given and 0 <= j < cols:
                    for c in ti.static(range(3)):
                        if source[p] >= 0:
                            u[c][p, b][lane] = displacement[source[p], j, c]
                        if p < rows and 0 < b <= strip:
                            d[c][p, b][lane] = difference[p, j, c]
            if p < rows:
                for g in range(decay.shape[0]):
                    for lane in ti.static(range(lanes)):
                        decay[g, p, b][lane] = shares[g, p, b, lane]
            if p == 0:
                for r in range(by_column.shape[0]):
                    for lane in ti.static(range(lanes)):
                        by_column[r, b][lane] = columns[r, b, lane]

    return start
