"""Kernel 1: the forces on every point and its Verlet update, all the steps of a launch in one go.

State of point P: its displacement u_n = x_n - X and the last difference d_n = u_n - u_{n-1}, from which the Verlet
step (eq. 6 to 9) reads

    d_{n+1} = keep d_n + gain F_n,    u_{n+1} = u_n + d_{n+1}

    central:   keep = (1 - g h / 2) / (1 + g h / 2)    gain = h^2 / m / (1 + g h / 2)    g = C / m
    backward:  keep = 1 - g h                          gain = h^2 / m
    step 0:    d_0 = 0                                 gain = h^2 / m / 2

which is the position form without its cancellation: in f32 it keeps the digits of a small motion on a large sheet.

Layout. Columns are cut into as many strips as a CPU vector has lanes; lane l of entry (i, b) is column b of strip l,
so that the neighbours of an entry are the entries beside it and every operation is one vector instruction. The first
and last entry of a row are a halo: the same strips moved by one lane. A GPU takes one strip, the plain layout.
"""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.lattice import axes, fixed_points, spacing, springs
from taichi_msm.loads import decay, grips, schedule
from taichi_msm.runtime import Device, FieldTree, available_threads, ti
from taichi_msm.scene import Scene
from taichi_msm.stability import step

# Lanes of a 256-bit vector.
LANES = {"f32": 8, "f64": 4}

# Below this many points a worker costs more in waiting for the others than it saves.
POINTS_PER_WORKER = 4000

# A launch is to end soon enough for Ctrl-C: so many steps of points, some 0.1 s of one core.
POINT_STEPS_PER_LAUNCH = 40_000_000
MAX_STEPS_PER_LAUNCH = 8192

# On a GPU a launch is a chain of this many kernels, one a step.
GPU_STEPS_PER_LAUNCH = 8

# Taichi gives a CPU thread at least this many iterations of a parallel loop: make_cpu_multithreaded_range_for.cpp.
ITERATIONS_PER_THREAD = 512

# Integers between the progress counters of two workers, so that each has a cache line of its own.
COUNTER_STRIDE = 16

# Rows of the field by_column; the first three say which points of a first, a middle and a last row move.
ACROSS, HAS_LEFT, HAS_RIGHT = 3, 4, 5

# Columns of the table of loads: gain, stiffness of the virtual springs, then for each grip force (3), point (2),
# falloff and offset.
GRIP_COLUMN, GRIP_COLUMNS = 2, 7


@dataclass(frozen=True)
class Structure:
    """What a kernel is compiled for; numbers are its arguments.

    Attributes:
        rows, cols: points of the sheet.
        precision: f32 or f64.
        lanes: strips of columns.
        workers: bands of rows that step side by side; 0 on a GPU, where every point does.
        neighbours: the springs of a point, as (down, right).
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
    neighbours: tuple[tuple[int, int], ...]
    open_edges: bool
    virtual: bool
    damped: bool
    grips: tuple[bool, ...]

    @property
    def strip(self) -> int:
        """Number of columns of a strip."""
        return -(-self.cols // self.lanes)


def structure(scene: Scene, device: Device) -> Structure:
    """Find out what the scene needs: absent terms are left out of the kernel."""
    rows, cols = scene.sheet.points
    fixed = fixed_points(scene.sheet)
    on_cpu = device.arch == "cpu"
    # Workers wait by spinning: more of them than cores would only keep each other from their work.
    cores = min(device.threads, available_threads())
    return Structure(
        rows=rows,
        cols=cols,
        precision=scene.time.precision,
        lanes=LANES[scene.time.precision] if on_cpu else 1,
        workers=max(1, min(cores, rows * cols // POINTS_PER_WORKER, rows // 2)) if on_cpu else 0,
        neighbours=tuple((spring.down, spring.right) for spring in springs(scene)),
        open_edges=not (fixed[[0, -1]].all() and fixed[:, [0, -1]].all()),
        virtual=scene.springs.virtual > 0 and (scene.springs.virtual_active == "always" or bool(scene.probes)),
        damped=scene.damping > 0,
        grips=tuple(grip.moves for grip in grips(scene)),
    )


class Dynamics:
    """The sheet in motion.

    Args:
        scene: a checked scene.
        device: what `runtime.start` returned.
        layout: another structure than the scene's own; for tests.
    """

    def __init__(self, scene: Scene, device: Device, layout: Structure | None = None) -> None:
        self.scene = scene
        self._device = device
        self.structure = layout or structure(scene, device)
        self.steps_done = 0
        self.launches = 0
        self._real = np.dtype(np.float32 if self.structure.precision == "f32" else np.float64)
        self._fields = _Fields(self.structure)
        self._advance, self._read, self._write = _kernels(self.structure, self._fields)
        self._arguments = self._numbers()
        self._place()

    def restart(self, scene: Scene) -> None:
        """Begin again at rest with other numbers, such as another step; nothing is compiled.

        Args:
            scene: a checked scene that differs in numbers only: points, precision and the terms used are the same.

        Raises:
            ValueError: when it needs another kernel.
        """
        if structure(scene, self._device) != structure(self.scene, self._device):
            raise ValueError("this scene needs another kernel; make another Dynamics")
        self.scene = scene
        self.steps_done = 0
        self._arguments = self._numbers()
        self._place()

    def advance(self, steps: int) -> None:
        """Take a number of steps."""
        points = self.structure.rows * self.structure.cols
        most = max(1, min(MAX_STEPS_PER_LAUNCH, POINT_STEPS_PER_LAUNCH // points))
        if self.structure.workers == 0:
            most = GPU_STEPS_PER_LAUNCH
        end = self.steps_done + steps
        while self.steps_done < end:
            count = min(most, end - self.steps_done)
            self._advance(self.steps_done, count, *self._arguments, self._table(count))
            self.steps_done += count
            self.launches += 1

    def compile(self) -> None:
        """Compile the step and the read-out without moving anything."""
        self._advance(0, 0, *self._arguments, self._table(1))
        self.displacement()

    def displacement(self) -> NDArray[Any]:
        """Read the displacements.

        Returns:
            x - X [m], shape (rows, cols, 3), in the scene's precision.
        """
        out = np.empty((self.structure.rows, self.structure.cols, 3), self._real)
        self._read(self.steps_done % 2, out)
        return out

    def close(self) -> None:
        """Free the fields."""
        self._fields.close()

    def _numbers(self) -> tuple[float, ...]:
        """Give the numbers of the scene in the order of the kernel's arguments."""
        scene, h = self.scene, step(self.scene)
        g = scene.damping / scene.sheet.mass
        central = scene.time.damping_difference == "central"
        keep = (1 - g * h / 2) / (1 + g * h / 2) if central else 1 - g * h
        dx, dy = spacing(scene.sheet)
        return keep, dx, dy, scene.springs.structural, scene.springs.shear, scene.sheet.size[0] / 2

    def _table(self, count: int) -> NDArray[Any]:
        """Tabulate the loads of the next steps, shape (count, columns)."""
        scene, h = self.scene, step(self.scene)
        g = scene.damping / scene.sheet.mass
        loads = schedule(scene, self.steps_done, count)
        parts = grips(scene)
        table = np.empty((count, GRIP_COLUMN + GRIP_COLUMNS * len(parts)))
        table[:, 0] = h * h / scene.sheet.mass
        if scene.time.damping_difference == "central":
            table[:, 0] /= 1 + g * h / 2
        if self.steps_done == 0:
            table[0, 0] = h * h / scene.sheet.mass / 2
        table[:, 1] = scene.springs.virtual * loads.active
        grip = table[:, GRIP_COLUMN:].reshape(count, len(parts), GRIP_COLUMNS)
        grip[..., :3] = loads.strength
        grip[..., 3:5] = loads.point
        for n, part in enumerate(parts):
            grip[:, n, 5:] = scene.probes[part.probe].falloff, scene.probes[part.probe].offset
        return table.astype(self._real)

    def _place(self) -> None:
        """Put the sheet at rest and write what steps do not change: who moves, the edges, the decay of grips."""
        s, scene = self.structure, self.scene
        moves = ~fixed_points(scene.sheet)
        column = np.arange(s.cols)
        # Rows are of three kinds: the first, any in between, the last.
        by_column = [*moves[[0, s.rows // 2, -1]], axes(scene.sheet)[0], column > 0, column < s.cols - 1]
        standing = [decay(grip, scene) for grip in grips(scene) if not grip.moves] or [np.zeros((s.rows, s.cols))]
        self._write(self._in_lanes(np.array(by_column)), self._in_lanes(np.array(standing)))

    def _in_lanes(self, values: NDArray[Any]) -> NDArray[Any]:
        """Lay columns out in strips: (..., cols) -> (..., strip + 2, lanes), the halo and the padding 0."""
        s = self.structure
        padded = np.zeros((*values.shape[:-1], s.lanes * s.strip), self._real)
        padded[..., : s.cols] = values
        out = np.zeros((*values.shape[:-1], s.strip + 2, s.lanes), self._real)
        out[..., 1:-1, :] = np.swapaxes(padded.reshape(*values.shape[:-1], s.lanes, s.strip), -1, -2)
        return out


class _Fields(FieldTree):
    """The fields of one sheet."""

    def __init__(self, s: Structure) -> None:
        super().__init__()
        width = s.strip + 2

        def vector(*shape: int) -> Any:
            return self.place(ti.Vector.field(s.lanes, getattr(ti, s.precision)), *shape)

        # u_n and u_{n+1} in turn, with a halo of one row above and below; d_n.
        self.displacement = [vector(2, s.rows + 2, width) for _ in range(3)]
        self.difference = [vector(s.rows, width) for _ in range(3)]
        # Whether the points move, of a first, middle and last row; their place across; whether they have a left and
        # a right neighbour.
        self.by_column = vector(6, width)
        self.decay = vector(max(1, s.grips.count(False)), s.rows, width)
        # The number of steps that each worker has done.
        self.done = self.place(ti.field(ti.i64), max(1, s.workers) * COUNTER_STRIDE)
        self.allocate()


def _kernels(s: Structure, fields: _Fields) -> tuple[Callable[..., None], ...]:
    """Compile the step, the read-out and the writing of the constants for one structure."""
    real = getattr(ti, s.precision)
    # Keeps L = 0 from dividing by 0: the force is then 0, as its vector is.
    tiny = 1e-36 if s.precision == "f32" else 1e-300
    rows, cols, lanes, strip, workers = s.rows, s.cols, s.lanes, s.strip, s.workers
    u, d = fields.displacement, fields.difference
    by_column, decay, done = fields.by_column, fields.decay, fields.done
    neighbours, open_edges, virtual, damped, grip_moves = s.neighbours, s.open_edges, s.virtual, s.damped, s.grips
    standing = [grip_moves[:n].count(False) for n in range(len(grip_moves))]

    @ti.func
    def update(now, i, b, n, keep, dx, dy, structural, shear, top, loads: ti.template()):
        """Step the points of entry (i, b): now is the buffer of u_n, n the row of the table."""
        x = u[0][now, i + 1, b]
        y = u[1][now, i + 1, b]
        z = u[2][now, i + 1, b]
        force_x = ti.Vector.zero(real, lanes)
        force_y = ti.Vector.zero(real, lanes)
        force_z = ti.Vector.zero(real, lanes)

        for spring in ti.static(neighbours):
            down, right = ti.static(spring)
            stiffness = structural
            length = dx
            if ti.static(down != 0 and right != 0):
                stiffness = shear
                length = ti.sqrt(dx * dx + dy * dy)
            elif ti.static(down != 0):
                length = dy
            by_x = u[0][now, i + 1 + down, b + right] - x
            by_y = u[1][now, i + 1 + down, b + right] - y
            to_z = u[2][now, i + 1 + down, b + right] - z
            to_x = by_x + right * dx
            to_y = by_y - down * dy
            # L^2 - L0^2, by which (L - L0) / L keeps the digits of a small motion.
            longer = by_x * (to_x + right * dx) + by_y * (to_y - down * dy) + to_z * to_z
            long = ti.sqrt(ti.max(to_x * to_x + to_y * to_y + to_z * to_z, tiny))
            pull = stiffness * longer / (long * (long + length))
            if ti.static(open_edges and right < 0):
                pull *= by_column[HAS_LEFT, b]
            if ti.static(open_edges and right > 0):
                pull *= by_column[HAS_RIGHT, b]
            if ti.static(open_edges and down != 0):
                pull *= ti.cast(0 <= i + down < rows, real)
            force_x += pull * to_x
            force_y += pull * to_y
            force_z += pull * to_z

        if ti.static(virtual):
            force_x -= loads[n, 1] * x
            force_y -= loads[n, 1] * y
            force_z -= loads[n, 1] * z

        for g in ti.static(range(len(grip_moves))):
            column = ti.static(GRIP_COLUMN + GRIP_COLUMNS * g)
            share = ti.Vector.zero(real, lanes)
            if ti.static(grip_moves[g]):
                off_x = by_column[ACROSS, b] - loads[n, column + 3]
                off_y = top - i * dy - loads[n, column + 4]
                distance = ti.sqrt(off_x * off_x + off_y * off_y)
                share = ti.exp(-loads[n, column + 5] * distance - loads[n, column + 6])
            else:
                share = decay[standing[g], i, b]
            force_x += loads[n, column] * share
            force_y += loads[n, column + 1] * share
            force_z += loads[n, column + 2] * share

        kind = 1
        if i == 0:
            kind = 0
        if i == rows - 1:
            kind = 2
        gain = loads[n, 0] * by_column[kind, b]
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
        u[0][1 - now, i + 1, b] = x + d_x
        u[1][1 - now, i + 1, b] = y + d_y
        u[2][1 - now, i + 1, b] = z + d_z

    @ti.func
    def join_strips(now, i):
        """Fill the halo of row i: beside the first column of a strip is the last one of the strip before."""
        for c in ti.static(range(3)):
            last = u[c][now, i + 1, strip]
            first = u[c][now, i + 1, 1]
            for lane in ti.static(range(lanes)):
                u[c][now, i + 1, 0][lane] = last[(lane - 1) % lanes]
                u[c][now, i + 1, strip + 1][lane] = first[(lane + 1) % lanes]

    @ti.kernel
    def advance_cpu(
        first: ti.i64,
        count: ti.i32,
        keep: real,
        dx: real,
        dy: real,
        structural: real,
        shear: real,
        top: real,
        loads: ti.types.ndarray(dtype=real, ndim=2),
    ):
        ti.loop_config(serialize=workers == 1)
        for index in range(workers * ITERATIONS_PER_THREAD):
            # One worker a thread. A worker is never more than a step ahead of those beside it, for it waits until
            # they have done the steps before this one; so two buffers are enough.
            if index % ITERATIONS_PER_THREAD == 0:
                worker = index // ITERATIONS_PER_THREAD
                for n in range(count):
                    now = ti.cast((first + n) % 2, ti.i32)
                    if ti.static(workers > 1):
                        if worker > 0:
                            while ti.atomic_add(done[(worker - 1) * COUNTER_STRIDE], 0) < first + n:
                                pass
                        if worker < workers - 1:
                            while ti.atomic_add(done[(worker + 1) * COUNTER_STRIDE], 0) < first + n:
                                pass
                    for i in range(rows * worker // workers, rows * (worker + 1) // workers):
                        for b in range(1, strip + 1):
                            update(now, i, b, n, keep, dx, dy, structural, shear, top, loads)
                        join_strips(1 - now, i)
                    if ti.static(workers > 1):
                        ti.atomic_add(done[worker * COUNTER_STRIDE], 1)

    @ti.kernel
    def advance_gpu(
        first: ti.i64,
        count: ti.i32,
        keep: real,
        dx: real,
        dy: real,
        structural: real,
        shear: real,
        top: real,
        loads: ti.types.ndarray(dtype=real, ndim=2),
    ):
        for n in ti.static(range(GPU_STEPS_PER_LAUNCH)):
            for i, b in ti.ndrange(rows, (1, strip + 1)):
                if n < count:
                    update(ti.cast((first + n) % 2, ti.i32), i, b, n, keep, dx, dy, structural, shear, top, loads)

    @ti.kernel
    def read(now: ti.i32, out: ti.types.ndarray(dtype=real, ndim=3)):
        for i, b in ti.ndrange(rows, (1, strip + 1)):
            for lane in ti.static(range(lanes)):
                j = lane * strip + b - 1
                if j < cols:
                    for c in ti.static(range(3)):
                        out[i, j, c] = u[c][now, i + 1, b][lane]

    @ti.kernel
    def write(column: ti.types.ndarray(dtype=real, ndim=3), standing: ti.types.ndarray(dtype=real, ndim=4)):
        for row, b in by_column:
            for lane in ti.static(range(lanes)):
                by_column[row, b][lane] = column[row, b, lane]
        for g, i, b in decay:
            for lane in ti.static(range(lanes)):
                decay[g, i, b][lane] = standing[g, i, b, lane]
        for now, i, b in u[0]:
            for c in ti.static(range(3)):
                u[c][now, i, b] = ti.Vector.zero(real, lanes)
        for i, b in d[0]:
            for c in ti.static(range(3)):
                d[c][i, b] = ti.Vector.zero(real, lanes)
        for n in done:
            done[n] = 0

    return (advance_cpu if workers else advance_gpu), read, write
