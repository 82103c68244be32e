"""What both forms of kernel 1 share: the force of a spring, the step of a point, the measures of a row.

The values of the sheet are vectors of lanes, each lane of another column; on a GPU a vector has one lane. They lie in
Taichi's ndarrays row after row. A row has `width` entries: one for every column of a strip, and a halo of one entry at
both ends. The arrays are one-dimensional, which saves a few instructions for every index:

    u, d         displacements and last differences; three arrays each, for x, y and z
    by_column    for a first, a middle and a last row: 1 over the points' share of a cell's mass, 0 if they are fixed;
                 and their share of a cell's area. For all rows: x at rest [m]; whether there is a left neighbour;
                 whether there is a right one
    decay        of every standing slot; as many rows as the sheet has
    stiffness    with a map, of every spring: along rows, as many rows as the sheet has; along columns and diagonals,
                 one row more, the first and the last of them zeros
    moment       with bending, D dx dy times the Laplacian of u; only the rows that are needed

Vectors stay vectors down to the machine code (docs/decisions/0010). There, some of Taichi's operations crash or give
wrong results; so unary minus, `-=`, abs, any and all are not used on vectors, and exp is applied lane by lane.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.system.runtime import Memory, ti, write

# Rows of the array by_column. MOVES and AREA have three each, for a first, a middle and a last row of the sheet.
MOVES, AREA, ACROSS, HAS_LEFT, HAS_RIGHT, COLUMN_ROWS = 0, 3, 6, 7, 8, 9

# Columns of the table of loads: gain, stiffness of the virtual springs, then for each slot force (3), point (2),
# falloff, shift and offset.
SLOT_COLUMN, SLOT_COLUMNS = 2, 8

# Measures of every row of points: the smallest and the largest (L^2 - L0^2) / L0^2; for the springs along the row, down
# and diagonal each, the sum of (L / L0 - 1)^2, times the stiffness if there is a map, and then, under tension, the sum
# of |q|^2 / L0^2; the sum of |d|^2 times the share of mass; with bending, the sum of the Laplacian's square.
LEAST, MOST, STRETCHED, TENSE, MOTION, BENT, MEASURES = 0, 1, 2, 5, 8, 9, 10

# Bytes of a number.
BYTES = {"f32": 4, "f64": 8}


@dataclass(frozen=True)
class Code:
    """What a kernel is compiled for; everything else is an argument.

    Attributes:
        precision: f32 or f64.
        lanes: of a vector; columns are cut into as many strips.
        structural, shear: whether there are springs of that family.
        open_edges: whether a point at an edge moves, so that springs beyond the edge must be left out.
        by_area: whether points and springs at such an edge get less than others, because they belong to fewer cells.
        mapped: whether the stiffness of every spring is read from an array.
        tense: whether the sheet is under tension at rest.
        bending: whether it resists bending.
        virtual: whether there are virtual springs.
        damped: whether there is damping.
        slots_move: for every probe slot, whether it moves.
        slots_by_area: for every probe slot, whether points at an open edge get less of its force.
    """

    precision: str
    lanes: int
    structural: bool
    shear: bool
    open_edges: bool
    by_area: bool
    mapped: bool
    tense: bool
    bending: bool
    virtual: bool
    damped: bool
    slots_move: tuple[bool, ...]
    slots_by_area: tuple[bool, ...]

    @property
    def real(self) -> Any:
        """Taichi's type of a number."""
        return getattr(ti, self.precision)

    @property
    def vector(self) -> Any:
        """Taichi's type of a vector of lanes."""
        return ti.types.vector(self.lanes, self.real)

    @property
    def border_rows(self) -> int:
        """Number of rows on either side of a band that its steps depend on."""
        return 2 if self.bending else 1

    @property
    def load_columns(self) -> int:
        """Number of columns of the table of loads."""
        return SLOT_COLUMN + SLOT_COLUMNS * len(self.slots_move)


@dataclass(frozen=True)
class Structure:
    """How a sheet is laid out in memory and shared out among workers, and the code that steps it.

    Attributes:
        rows, cols: points of the sheet.
        workers: number of bands of rows that are stepped in parallel; 0 on a GPU, where all points are.
        depth: number of steps that a band takes in one sweep.
        fixed_rows: whether all points of the first row are fixed, and all of the last.
        code: what the kernels are compiled for.
    """

    rows: int
    cols: int
    workers: int
    depth: int
    fixed_rows: tuple[bool, bool]
    code: Code

    @property
    def strip(self) -> int:
        """Number of columns of a strip."""
        return -(-self.cols // self.code.lanes)

    @property
    def width(self) -> int:
        """Number of entries in a row, including the halo of its strips."""
        return self.strip + 2


class Start(NamedTuple):
    """What the arrays of a sheet hold at the start.

    Attributes:
        by_column: content of the array by_column, shape (COLUMN_ROWS, cols).
        decay: of the standing slots, shape (standing slots, rows, cols).
        stiffness: of springs along rows, shape (rows, cols), along columns and diagonals, shape (rows + 1, cols) each;
            None without a map.
        state: displacements and differences [m], each of shape (rows, cols, 3); None: at rest.
    """

    by_column: NDArray[Any]
    decay: NDArray[Any]
    stiffness: tuple[NDArray[Any], NDArray[Any], NDArray[Any]] | None
    state: tuple[NDArray[Any], NDArray[Any]] | None


class ReadArguments(NamedTuple):
    """What is read from a sheet, in the order of the kernel's arguments.

    Attributes:
        differences: True: read d; False: read u.
        out: receives it, shape (rows, cols, 3).
        measures: receives the measures of every row of points, shape (rows, MEASURES).
    """

    differences: bool
    out: NDArray[Any]
    measures: NDArray[Any]


def in_lanes(s: Structure, values: NDArray[Any]) -> NDArray[Any]:
    """Lay columns out in strips with their halo.

    Args:
        s: the structure.
        values: shape (..., cols).

    Returns:
        Shape (entries, lanes), in the precision of the code. Entries without a column are 0, and values too large for
        the precision infinite.
    """
    column = np.arange(s.code.lanes) * s.strip + np.arange(-1, s.strip + 1)[:, None]
    inside = (column >= 0) & (column < s.cols)
    real = np.float32 if s.code.precision == "f32" else np.float64
    with np.errstate(over="ignore"):
        laid = np.take(values.astype(real), column * inside, axis=-1) * inside.astype(real)
    return laid.reshape(-1, s.code.lanes)


class SheetArrays:
    """The arrays that both forms of kernel 1 have.

    Args:
        s: the structure.
        stored: for every stored row of displacements, the row of the sheet that it holds, or -1 for none.
        start: what the arrays hold at the start.
    """

    def __init__(self, s: Structure, stored: NDArray[np.int32], start: Start) -> None:
        by_column, decay, stiffness, state = start
        self._s = s
        self._memory = Memory()
        self.u = [self.rows(len(stored)) for _ in range(3)]
        self.d = [self.rows(s.rows) for _ in range(3)]
        self.by_column = self.rows(len(by_column))
        self.decay = self.rows(max(1, len(decay)) * s.rows)
        self.stiffness = [self.rows(s.rows + 1 if s.code.mapped else 1) for _ in range(3)]
        self._set(self.by_column, by_column)
        for array, values in zip(self.stiffness, stiffness or (), strict=False):
            self._set(array, values)
        for c in range(3):
            if state is None:
                self._set(self.u[c], np.zeros((0, s.cols)))
                self._set(self.d[c], np.zeros((0, s.cols)))
            else:
                held = (stored >= 0)[:, None]
                self._set(self.u[c], np.where(held, state[0][stored, :, c], 0))
                self._set(self.d[c], state[1][..., c])
        self.set_decay(decay)

    def set_decay(self, decay: NDArray[Any]) -> None:
        """Replace the decays of the standing slots, shape (slots, rows, cols)."""
        if len(decay):
            self._set(self.decay, decay)

    def _set(self, array: Any, values: NDArray[Any]) -> None:
        """Set the first rows of an array to values, shape (..., cols), and the others to zero."""
        write(array, in_lanes(self._s, values))

    def rows(self, count: int) -> Any:
        """Allocate an array of `count` rows; its content is arbitrary."""
        return self._memory.array(self._s.code.precision, self._s.code.lanes, count * self._s.width)


def spring_forces(code: Code) -> tuple[Callable[..., Any], Callable[..., Any]]:
    """Make the functions for the force of a spring along a row, and of a spring to the other row.

    They give the force of P on its neighbour Q; that of Q on P is the opposite, to the bit. With q = u_P - u_Q and the
    rest vector o from Q to P, L^2 - L0^2 = q (q + 2 o). In the form

        k (L - L0) (P - Q) / L = k (L^2 - L0^2) / (L^2 + L0 L) (o + q)                         (eq. 2)

    the force keeps the digits of a small motion on a large sheet. Under tension tau q is added (see `material`).
    """
    open_edges, tense = code.open_edges and not code.mapped, code.tense
    # Prevents a division by 0 at L = 0, where the force is then 0, as P - Q is. A literal in a kernel is always f32.
    tiny = 1e-36

    @ti.func
    def pull(weighted, square, length, to_x, to_y, to_z, tension, x, y, z):
        """Force along the deformed spring, from k (L^2 - L0^2) and L^2, plus tension times the difference (x, y, z)."""
        force = weighted / (square + length * ti.sqrt(square))
        force_x, force_y, force_z = force * to_x, force * to_y, force * to_z
        if ti.static(tense):
            force_x += tension * x
            force_y += tension * y
            force_z += tension * z
        return force_x, force_y, force_z

    @ti.func
    def along(u: ti.template(), right, here_x, here_y, here_z, dx, stiffness, tension, exists):
        """Force of a point displaced by `here` on its right neighbour, in entry `right` of u; exists: 0 if none."""
        x, y, z = here_x - u[0][right], here_y - u[1][right], here_z - u[2][right]
        to_x = x - dx
        rest = y * y + z * z
        weighted = stiffness * (x * (to_x - dx) + rest)
        if ti.static(open_edges):
            weighted *= exists
        return pull(weighted, to_x * to_x + (rest + tiny), dx, to_x, y, z, tension, x, y, z)

    @ti.func
    def to_other_row(
        u: ti.template(), entry, right: ti.template(), here_x, here_y, here_z,
        dx, dy, length, stiffness, tension, exists,
    ):  # fmt: skip
        """Force of a point displaced by `here` on the neighbour in `entry`: `right` columns on, in the row dy above."""
        x, y, z = here_x - u[0][entry], here_y - u[1][entry], here_z - u[2][entry]
        to_x = x
        to_y = y - dy
        rest = z * z
        longer = x * x + (y * (to_y - dy) + rest)
        if ti.static(right != 0):
            to_x = x - right * dx
            longer = x * (to_x - right * dx) + (y * (to_y - dy) + rest)
        weighted = stiffness * longer
        if ti.static(open_edges):
            weighted *= exists
        return pull(weighted, to_x * to_x + to_y * to_y + (rest + tiny), length, to_x, to_y, z, tension, x, y, z)

    return along, to_other_row


def measuring(code: Code) -> Callable[..., Any]:
    """Make the function that measures an entry of the sheet: its springs to the right and to the row below, its motion.

    It returns MEASURES vectors of lanes, in the order of the constants above.
    """
    real, vector, open_edges = code.real, code.vector, code.open_edges
    structural, shear = code.structural, code.shear
    mapped, tense, by_area, bending = code.mapped, code.tense, code.by_area, code.bending
    laplacian = five_point()

    @ti.func
    def longer(u: ti.template(), by_column: ti.template(), width, p, q, b, right: ti.template(), x0, y0):
        """(L^2 - L0^2) / L0^2 and |q|^2 / L0^2 of the spring from entry b of row p to entry b + right of row q."""
        x = u[0][q * width + b + right] - u[0][p * width + b]
        y = u[1][q * width + b + right] - u[1][p * width + b]
        z = u[2][q * width + b + right] - u[2][p * width + b]
        square = x0 * x0 + y0 * y0
        share = (x * (x + 2 * x0) + (y * (y + 2 * y0) + z * z)) / square
        apart = (x * x + y * y + z * z) / square
        # Beyond the edge there is no spring.
        if ti.static(open_edges and right < 0):
            share = ti.select(by_column[HAS_LEFT * width + b] > 0, share, vector(0))
        if ti.static(open_edges and right > 0):
            share = ti.select(by_column[HAS_RIGHT * width + b] > 0, share, vector(0))
        return share, apart

    @ti.func
    def square(share):
        """(L / L0 - 1)^2, given (L^2 - L0^2) / L0^2, which rounding may put below -1."""
        stretch = share / (1 + ti.sqrt(ti.max(share + 1, vector(0))))
        return stretch * stretch

    @ti.func
    def measure(
        u: ti.template(), d: ti.template(), by_column: ti.template(), stiffness: ti.template(),
        width, rows, p, i, b, dx, dy,
    ):  # fmt: skip
        """Measure entry b of row i of the sheet, stored in row p of u, and the row below it, the next one."""
        least, most, motion, bent = vector(0), vector(0), vector(0), vector(0)
        along, below, across = vector(0), vector(0), vector(0)
        along_apart, below_apart, across_apart = vector(0), vector(0), vector(0)
        kind = ti.select(i == rows - 1, 2, ti.select(i == 0, 0, 1))
        if ti.static(structural):
            share, apart = longer(u, by_column, width, p, p, b, 1, dx, 0)
            least = ti.min(least, share)
            most = ti.max(most, share)
            along = square(share)
            if ti.static(tense):
                along_apart = apart
            if ti.static(mapped):
                along *= stiffness[0][i * width + b]
            elif ti.static(by_area):
                along *= ti.select(kind == 1, 1.0, 0.5)
        if i < rows - 1:
            if ti.static(structural):
                share, apart = longer(u, by_column, width, p, p + 1, b, 0, 0, -dy)
                least = ti.min(least, share)
                most = ti.max(most, share)
                below = square(share)
                if ti.static(tense):
                    below_apart = apart
                if ti.static(mapped):
                    below *= stiffness[1][(i + 1) * width + b]
                elif ti.static(by_area):
                    below *= by_column[(AREA + 1) * width + b]
            if ti.static(shear):
                one, one_apart = longer(u, by_column, width, p, p + 1, b, -1, -dx, -dy)
                other, other_apart = longer(u, by_column, width, p, p + 1, b, 1, dx, -dy)
                least = ti.min(least, ti.min(one, other))
                most = ti.max(most, ti.max(one, other))
                if ti.static(tense):
                    across_apart = one_apart + other_apart
                if ti.static(mapped):
                    left, right = stiffness[2][(i + 1) * width + b - 1], stiffness[2][(i + 1) * width + b]
                    across = left * square(one) + right * square(other)
                else:
                    across = square(one) + square(other)
        for c in ti.static(range(3)):
            change = d[c][i * width + b]
            motion += change * change
        if ti.static(by_area):
            motion *= by_column[(AREA + kind) * width + b]
        if ti.static(bending):
            # Only an inner row has both a row before it and one after it.
            inside = by_column[HAS_LEFT * width + b] * by_column[HAS_RIGHT * width + b] * ti.cast(kind == 1, real)
            before, after = p - ti.cast(kind == 1, ti.i32), p + ti.cast(kind == 1, ti.i32)
            for c in ti.static(range(3)):
                curved = inside * laplacian(u, c, width, before, p, after, b, 1 / (dx * dx), 1 / (dy * dy))
                bent += curved * curved
        return least, most, along, below, across, along_apart, below_apart, across_apart, motion, bent

    return measure


def five_point() -> Callable[..., Any]:
    """Make the function that gives the five-point Laplacian of an array."""

    @ti.func
    def laplacian(field: ti.template(), c: ti.template(), width, before, row, after, b, across, down):
        """Laplacian of component c at entry b of a row, between rows before and after; across: 1/dx^2, down: 1/dy^2."""
        here = field[c][row * width + b]
        beside = (field[c][row * width + b - 1] - here) + (field[c][row * width + b + 1] - here)
        over = (field[c][before * width + b] - here) + (field[c][after * width + b] - here)
        return across * beside + down * over

    return laplacian


def point_step(code: Code) -> Callable[..., None]:
    """Make the function that adds the forces of bending, virtual springs and probes to those of springs, and steps.

    d_{n+1} = keep d_n + gain F_n,    u_{n+1} = u_n + d_{n+1}                                  (eq. 6 to 9)
    """
    vector, lanes = code.vector, code.lanes
    virtual, damped, slot_moves = code.virtual, code.damped, code.slots_move
    by_area, slot_by_area = code.by_area, code.slots_by_area
    bending, laplacian = code.bending, five_point()
    standing = [slot_moves[:n].count(False) for n in range(len(slot_moves))]

    @ti.func
    def move(
        u: ti.template(), d: ti.template(), by_column: ti.template(), decay: ti.template(),
        moment: ti.template(), rows, width, q, i, b, kind, before, here, after,
        x, y, z, spring_x, spring_y, spring_z, keep, dx, dy, top, now,
    ):  # fmt: skip
        """Step entry b of row i of the sheet, displaced by (x, y, z), and store it in row q of u.

        The moments of the row and of its neighbours are in rows before, here and after. `now` is a row of the table of
        loads.
        """
        force_x, force_y, force_z = spring_x, spring_y, spring_z
        if ti.static(bending):
            across, down = 1 / (dx * dx), 1 / (dy * dy)
            force_x = force_x - laplacian(moment, 0, width, before, here, after, b, across, down)
            force_y = force_y - laplacian(moment, 1, width, before, here, after, b, across, down)
            force_z = force_z - laplacian(moment, 2, width, before, here, after, b, across, down)
        if ti.static(virtual):
            if ti.static(by_area):
                held = now[1] * by_column[(AREA + kind) * width + b]
                force_x = force_x - held * x
                force_y = force_y - held * y
                force_z = force_z - held * z
            else:
                force_x = force_x - now[1] * x
                force_y = force_y - now[1] * y
                force_z = force_z - now[1] * z
        for g in ti.static(range(len(slot_moves))):
            column = ti.static(SLOT_COLUMN + SLOT_COLUMNS * g)
            share = vector(0)
            if ti.static(slot_moves[g]):
                off_x = by_column[ACROSS * width + b] - now[column + 3]
                off_y = top - i * dy - now[column + 4]
                exponent = now[column + 5] * ti.sqrt(off_x * off_x + off_y * off_y) + now[column + 6]
                exponent = ti.max(exponent, now[column + 7])
                share = vector([ti.exp(-exponent[lane]) for lane in ti.static(range(lanes))])
                if ti.static(slot_by_area[g]):
                    share *= by_column[(AREA + kind) * width + b]
            else:
                share = decay[(standing[g] * rows + i) * width + b]
            force_x += now[column] * share
            force_y += now[column + 1] * share
            force_z += now[column + 2] * share

        gain = now[0] * by_column[(MOVES + kind) * width + b]
        d_x, d_y, d_z = d[0][i * width + b], d[1][i * width + b], d[2][i * width + b]
        if ti.static(damped):
            d_x *= keep
            d_y *= keep
            d_z *= keep
        d_x += gain * force_x
        d_y += gain * force_y
        d_z += gain * force_z
        d[0][i * width + b] = d_x
        d[1][i * width + b] = d_y
        d[2][i * width + b] = d_z
        u[0][q * width + b] = x + d_x
        u[1][q * width + b] = y + d_y
        u[2][q * width + b] = z + d_z

    return move
