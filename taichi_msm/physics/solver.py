"""The interface to kernel 1, which computes the force on every point and its Verlet step, a frame in few launches.

State of point P: its displacement u_n = x_n - X and the last difference d_n = u_n - u_{n-1}, from which the Verlet
step (eq. 6 to 9) reads

    d_{n+1} = keep d_n + gain F_n,    u_{n+1} = u_n + d_{n+1}

    central:   keep = (1 - g h / 2) / (1 + g h / 2)    gain = h^2 / m / (1 + g h / 2)    g = C / m
    backward:  keep = 1 - g h                          gain = h^2 / m
    step 0:    d_0 = 0                                 gain = h^2 / m / 2

This is the position form rearranged so that nothing cancels: in f32 it keeps the digits of a small motion on a large
sheet.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ArgumentError, DeviceError, MsmError
from taichi_msm.physics.kernel import (
    ACROSS,
    AREA,
    BENT,
    BYTES,
    COLUMN_ROWS,
    HAS_LEFT,
    HAS_RIGHT,
    LEAST,
    MEASURES,
    MOST,
    MOTION,
    MOVES,
    SLOT_COLUMN,
    SLOT_COLUMNS,
    STRETCHED,
    TENSE,
    Code,
    ReadArguments,
    Start,
    Structure,
)
from taichi_msm.physics.kernel_cpu import Sweep
from taichi_msm.physics.kernel_gpu import STEPS_PER_LAUNCH, Gather
from taichi_msm.physics.lattice import axes, spacing
from taichi_msm.physics.loads import decay, schedule
from taichi_msm.physics.material import area_shares, has_fixed_border, stiffness
from taichi_msm.physics.plan import Plan
from taichi_msm.physics.probe_force import probe_force
from taichi_msm.physics.state import Reading, State
from taichi_msm.physics.verlet import coefficients
from taichi_msm.progress import Pause
from taichi_msm.system.resources import available_threads
from taichi_msm.system.runtime import Device, lanes

# With fewer points per worker, one worker more costs more time in waiting than it saves in work.
POINTS_PER_WORKER = 450

# If a band takes more than CACHE bytes, its sweeps take DEPTH steps each.
CACHE = 3 << 17
DEPTH = 8

# Numbers that a sweep keeps per point: displacement, difference and the force carried to the next row, as vectors.
NUMBERS_PER_POINT = 9

# A launch takes no more steps than this, so that Ctrl-C is noticed soon: steps times points, about 0.1 s of one core;
# and steps.
POINT_STEPS_PER_LAUNCH = 40_000_000
MAX_STEPS_PER_LAUNCH = 8192

# Loads are tabulated for this many steps at a time; NumPy takes hardly less time for the steps of a few frames.
STEPS_PER_TABLE = 4096


def structure(plan: Plan, device: Device, cores: int | None = None) -> Structure:
    """Choose how a sheet is laid out and shared out, and what is compiled for it: only the terms that the scene has.

    Args:
        plan: of the scene.
        device: what `runtime.start` returned.
        cores: number of cores that stepping may use; None: all.

    Raises:
        DeviceError: when the device cannot do what the scene needs.
    """
    rows, cols = plan.scene.sheet.points
    fixed, material, precision = plan.fixed, plan.material, plan.grid.precision
    open_edges = not has_fixed_border(fixed)
    fixed_rows = bool(fixed[0].all()), bool(fixed[-1].all())
    if device.arch == "cpu":
        # Workers wait by spinning, so more workers than cores would only hold each other up.
        cores = min(device.threads, available_threads() if cores is None else cores)
        workers = max(1, min(cores, rows * cols // POINTS_PER_WORKER, (rows - sum(fixed_rows)) // 2))
    else:
        workers = 0
    code = Code(
        precision=precision,
        lanes=lanes(precision),
        structural=max(material.across, material.down) > 0,
        shear=material.shear > 0,
        open_edges=open_edges,
        by_area=open_edges and material.by_area,
        mapped=material.factors is not None,
        tense=material.tension > 0,
        bending=material.bending > 0,
        virtual=material.virtual > 0,
        damped=material.drag > 0,
        slots_move=_moves(plan),
        slots_by_area=_slots_by_area(plan),
    )
    if device.arch == "vulkan" and precision == "f64" and any(code.slots_move):
        raise DeviceError(
            "--arch vulkan: has no exp in f64, which control points that move need; take time.precision: f32 without a "
            "tolerance or an estimate of the error, or --arch cpu"
        )
    fits = workers == 0 or rows // workers * cols * NUMBERS_PER_POINT * BYTES[precision] <= CACHE
    depth = 1 if fits or code.bending else DEPTH
    return Structure(rows, cols, workers, depth, fixed_rows, code)


class Dynamics:
    """The sheet in motion.

    Args:
        plan: of the scene.
        device: what `runtime.start` returned.
        layout: a structure in the place of the scene's own; for tests.
        cores: number of cores that stepping may use; None: all.

    Attributes:
        plan: of what is stepped.
        structure: what the kernels are compiled for.
        steps_done: number of steps taken.
        launches: number of times that a series of steps was taken, each followed by a call of `pause`.
        torn: whether an exception, such as KeyboardInterrupt, came while steps were taken, so that it is not known how
            many were; then only `restart` helps.
    """

    def __init__(
        self,
        plan: Plan,
        device: Device,
        layout: Structure | None = None,
        cores: int | None = None,
    ) -> None:
        self._device = device
        self._cores = cores
        self._layout = layout
        self.launches = 0
        self._sheet: Sweep | Gather | None = None
        self.restart(plan)

    def restart(self, plan: Plan, state: State | None = None) -> None:
        """Begin again with the same scene or another; nothing is compiled if only numbers differ.

        Args:
            plan: of the scene.
            state: what `state` returned for the same points and steps, to continue from; None: at rest.
        """
        self.plan = plan
        self.structure = self._layout or structure(plan, self._device, self._cores)
        self._begin(state)

    def steer(self, plan: Plan) -> None:
        """Continue with other loads and the same steps.

        Args:
            plan: with other probes, each of which moves, jumps or stands as its predecessor did.

        Raises:
            ArgumentError: when the new probes need another kernel.
        """
        moves = _moves(plan)
        if moves != self.structure.code.slots_move:
            before = _in_words(self.structure.code.slots_move)
            raise ArgumentError(
                f"probes: which control points move or jump cannot change (before: {before}; now: {_in_words(moves)}); "
                "restart with the new scene"
            )
        if _slots_by_area(plan) != self.structure.code.slots_by_area:
            raise ArgumentError("probes: one has total instead of force, or the reverse; restart with the new scene")
        if _standing(plan) != _standing(self.plan):
            self._moving.set_decay(_standing_decays(plan))
        self.plan = plan
        # A caller that steers will steer again in a frame, so no more loads than those of a frame are tabulated.
        self._first_tabled, self._loads = self.steps_done, self._table(self.steps_done, plan.grid.steps_per_frame)

    def advance(self, steps: int, pause: Pause = lambda: None) -> None:
        """Take a number of steps.

        Args:
            steps: how many.
            pause: called after every launch. An exception from it stops the sheet there; another call continues.

        Raises:
            MsmError: when the sheet is torn; so do `state` and `read`.
        """
        points = self.structure.rows * self.structure.cols
        most, depth = max(1, min(MAX_STEPS_PER_LAUNCH, POINT_STEPS_PER_LAUNCH // points)), self.structure.depth
        # A launch takes whole passes. If not even one is within the limit, it takes up to four times the limit.
        most = most // depth * depth or min(depth, 4 * most)
        if self.structure.workers == 0:
            most = STEPS_PER_LAUNCH
        self._require_whole()
        end = self.steps_done + steps
        while self.steps_done < end:
            count = min(most, end - self.steps_done)
            self.torn = True
            self._moving.advance(count, self._arguments, self._next_loads(count))
            self.steps_done += count
            self.torn = False
            self.launches += 1
            pause()

    def compile(self) -> None:
        """Compile the step and the read-out without moving anything."""
        self._moving.compile(self._arguments, self._loads)
        self.displacement()

    def displacement(self) -> NDArray[Any]:
        """Read the displacements.

        Returns:
            x - X [m], shape (rows, cols, 3), in the scene's precision.
        """
        return self.read().displacement

    def state(self) -> State:
        """Read everything that the next steps depend on."""
        self._require_whole()
        return State(self.steps_done, self._copy(differences=False)[0], self._copy(differences=True)[0])

    def read(self) -> Reading:
        """Read the displacements and measure the sheet, in the scene's precision."""
        self._require_whole()
        displacement, measures = self._copy(differences=False)
        shortest, longest = (
            math.sqrt(max(0.0, 1.0 + float(one))) for one in (measures[:, LEAST].min(), measures[:, MOST].max())
        )
        sums = measures.sum(axis=0, dtype=np.float64)
        material, (dx, dy) = self.plan.material, spacing(self.plan.scene.sheet)
        squares = np.array([dx**2, dy**2, dx**2 + dy**2])
        stiffness = np.ones(3) if self.structure.code.mapped else np.array(material.stiffness)
        springs = (stiffness * sums[STRETCHED : STRETCHED + 3] + material.tensions * sums[TENSE : TENSE + 3]) @ squares
        motion = material.mass * sums[MOTION] / self.plan.grid.step**2
        return Reading(
            self.steps_done,
            displacement,
            shortest,
            longest,
            float(springs + motion + material.bending * sums[BENT]) / 2,
        )

    def _copy(self, *, differences: bool) -> tuple[NDArray[Any], NDArray[Any]]:
        """Copy the displacements or the differences, and the measures of every row."""
        s = self.structure
        out, measures = np.empty((s.rows, s.cols, 3), self._real), np.empty((s.rows, MEASURES), self._real)
        self._moving.read(spacing(self.plan.scene.sheet), ReadArguments(differences, out, measures))
        return out, measures

    def _require_whole(self) -> None:
        if self.torn:
            raise MsmError("interrupted while steps were taken; restore what was saved before, or restart the scene")

    def close(self) -> None:
        """Free the memory."""
        self._sheet = None

    @property
    def _moving(self) -> Sweep | Gather:
        assert self._sheet is not None, "it is closed"
        return self._sheet

    def _begin(self, state: State | None) -> None:
        """Prepare the sheet at rest or in a given state."""
        self._real = np.dtype(np.float32 if self.structure.code.precision == "f32" else np.float64)
        self.steps_done, self.torn = 0 if state is None else state.steps, True
        plan = self.plan
        self._verlet = coefficients(plan.material, plan.grid.step, plan.scene.time.damping_difference)
        self._arguments = self._numbers()
        self._first_tabled, self._loads = self.steps_done, self._table(self.steps_done, STEPS_PER_TABLE)
        self._place(state)
        self.torn = False

    def _numbers(self) -> tuple[float, ...]:
        """List the scene's numbers in the order of the kernel's arguments."""
        material, sheet = self.plan.material, self.plan.scene.sheet
        numbers = *material.stiffness, *material.tensions, material.bending
        return self._verlet.keep, *spacing(sheet), *numbers, sheet.size[0] / 2

    def _next_loads(self, count: int) -> NDArray[Any]:
        """Give the table of the loads of the next steps, shape (count, columns)."""
        done = self.steps_done - self._first_tabled
        if done + count > len(self._loads):
            done = 0
            self._first_tabled = self.steps_done
            self._loads = self._table(self.steps_done, max(count, STEPS_PER_TABLE))
        return self._loads[done : done + count]

    def _table(self, first: int, count: int) -> NDArray[Any]:
        """Tabulate the loads of steps first, ..., first + count - 1, shape (count, columns)."""
        plan, loads = self.plan, schedule(self.plan, first, count)
        table = np.empty((count, self.structure.code.load_columns))
        table[:, 0] = self._verlet.gain
        if first == 0:
            table[0, 0] = self._verlet.first_gain
        table[:, 1] = plan.material.virtual * loads.active
        slot = table[:, SLOT_COLUMN:].reshape(count, len(plan.slots), SLOT_COLUMNS)
        slot[..., :3] = loads.strength
        slot[..., 3:5] = loads.point
        for n, part in enumerate(plan.slots):
            acts = probe_force(plan.scene.probes[part.probe], plan.scene.sheet)
            slot[:, n, 5:] = acts.falloff, acts.shift, acts.offset
        # Loads too large for f32 become infinite; the next reading of the sheet shows it.
        with np.errstate(over="ignore"):
            return table.astype(self._real)

    def _place(self, state: State | None) -> None:
        """Fill the arrays of the sheet."""
        s, plan, sheet = self.structure, self.plan, self.plan.scene.sheet
        moves, column, areas = ~plan.fixed, np.arange(s.cols), area_shares(sheet)
        # Rows are of three kinds: the first, any in between, the last.
        kinds = [0, s.rows // 2, -1]
        shares = areas[kinds] if s.code.by_area else np.ones((3, s.cols))
        by_column = np.empty((COLUMN_ROWS, s.cols))
        by_column[MOVES : MOVES + 3] = moves[kinds] / shares
        by_column[AREA : AREA + 3] = areas[kinds]
        by_column[ACROSS] = axes(sheet)[0]
        by_column[HAS_LEFT] = column > 0
        by_column[HAS_RIGHT] = column < s.cols - 1
        self._sheet = None  # Frees its memory before another sheet takes some.
        kind = Sweep if s.workers else Gather
        begun = None if state is None else (state.displacement, state.difference)
        self._sheet = kind(s, Start(by_column, _standing_decays(plan), _mapped_stiffness(plan), begun))


def _moves(plan: Plan) -> tuple[bool, ...]:
    """Tell for every slot whether its control point moves."""
    return tuple(slot.moves for slot in plan.slots)


def _slots_by_area(plan: Plan) -> tuple[bool, ...]:
    """Tell for every slot whether there are points at a free edge, and these get less of its force than others."""
    open_edges = not has_fixed_border(plan.fixed)
    return tuple(open_edges and plan.scene.probes[slot.probe].total is not None for slot in plan.slots)


def _mapped_stiffness(plan: Plan) -> tuple[NDArray[Any], NDArray[Any], NDArray[Any]] | None:
    """Give the stiffness k - tau of every spring in the form of `Start`; None without a map."""
    material = plan.material
    if material.factors is None:
        return None
    parts = zip(stiffness(material, material.factors), material.tensions, strict=True)
    along_rows, along_columns, diagonals = (np.maximum(k - tension, 0) for k, tension in parts)
    return (
        np.pad(along_rows, ((0, 0), (0, 1))),
        np.pad(along_columns, ((1, 1), (0, 0))),
        np.pad(diagonals, ((1, 1), (0, 1))),
    )


def _standing(plan: Plan) -> list[tuple[object, ...]]:
    """List everything that the decays of the standing slots depend on."""
    probes = [plan.scene.probes[slot.probe] for slot in plan.slots if not slot.moves]
    return [(probe.at, probe_force(probe, plan.scene.sheet)[1:]) for probe in probes]


def _standing_decays(plan: Plan) -> NDArray[np.float64]:
    """Evaluate the decays of all standing slots, shape (slots, rows, cols)."""
    scene = plan.scene
    return np.array([decay(scene.probes[slot.probe], scene.sheet) for slot in plan.slots if not slot.moves])


def _in_words(moves: tuple[bool, ...]) -> str:
    return ", ".join("yes" if one else "no" for one in moves) or "none"
