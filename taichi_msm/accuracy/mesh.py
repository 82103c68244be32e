"""The error that the number of points makes in a run of tissue, by runs with half and a quarter of the cells a side.

If u_c is the displacement with cells r times as long, Richardson's extrapolation gives the error of u as
|u - u_c| / (r^p - 1). The lattice has order p = 2 in the length of its cells where the displacement is smooth, and a
lower one at the rim of a tool's flat end, at an edge in a map, at a fixed edge without tension and in wrinkles. So p is
measured by a third run. One above 2 shows that the coarsest run is too coarse to tell, and counts as somewhat less than
2; one below 1 counts as 1; so does any if there are too few points for a third run.

Each of the three takes steps twice as long as the one before, as longer cells allow, so that the error of the step
falls with that of the points; where a coarse pilot goes with the run, it is the first of the three. What is told
includes up to four times the error of the step, which mostly is far smaller.

Where the three show no order, or where tissue is pressed together that does not resist bending, and so wrinkles the
more the finer the mesh is, the error may be larger than what is told: that is twice the estimate, and "at least".

A tool that is hardly wider than a cell presses with more or less than its total, depending on where the points lie. The
coarser runs press as hard as the first one does, and the part of the total that the first one misses is added to the
error.

Where tools are moved, they touch more points one by one, and in a coarse run few or none, which then says nothing. So
there is one run with 1 / sqrt(2) of the cells a side and half the steps. It is compared with the run itself, as a
coarse pilot may press quite otherwise, and IN_CONTACT of the difference is the estimate. A difference above FAR says
little, as the tool may have left one of the two sheets earlier; then a second run follows, with NEARER of the cells a
side (docs/decisions/0027).

With `springs`, a sheet with other points is another sheet, so its error is not defined.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.accuracy.time_step import longest
from taichi_msm.errors import DivergedError, Pause, ProgressCallback, SceneError
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import MAX_CELL_ASPECT, Maps, cell_aspect_ratio, spacing
from taichi_msm.model.tool_force import sum_probe_forces
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_POINTS
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Probe
from taichi_msm.solver.planning import choose_precision, plan_variant, stable_steps
from taichi_msm.solver.rest import build_dynamics
from taichi_msm.system.runtime import Device

# Orders between which the three runs are taken to converge.
LOWEST_ORDER, HIGHEST_ORDER = 1.0, 3.0

# The order where tools are moved.
WITH_CONTACT = 1.5

# Where tools are moved: the cells a side of the run with fewer points, as a share of the run's; the estimate for a
# difference of one; the difference, as a share of the largest displacement, above which a second run with NEARER of the
# cells follows, and the estimate in geometric means of both differences; the largest difference of the last run, and
# the smallest radius, in cells of the run, that say anything.
CLOSER = 1 / math.sqrt(2)
IN_CONTACT = 1.2
FAR = 0.4
NEARER = 0.85
OF_BOTH = 0.7
LARGEST_DIFFERENCE = 1.0
NARROWEST = 0.8

# An order above 2 counts as one this much of the difference below 2 (docs/decisions/0022).
ABOVE = 1 / 4

# Springs may be this much shorter than without any force before the tissue counts as pressed together.
SLACK = 1e-4

# The largest number of runs in a search; the largest and the smallest factor by which cells get shorter from one to the
# next.
MOST_TRIALS = 10
LARGEST_CUT, LEAST_CUT = 2.0, 1.1

# The search aims at an error of this share of the tolerance, so the points it finds are nearly the fewest.
CLOSE = 0.8

# To find the true force of a tool, it is summed over at most this many points.
MOST_SUMMED = 4_000_000

# The fewest points a side of which half as many cells still make a sheet to compare with.
FEWEST = 7


# Why the error is not known, or may be larger.
UNTOUCHED = "a tool on a path meets no point"
NARROW = "the radius of a tool on a path is below 0.8 of a cell, so that it touches hardly a point"
STEPPED = "the error of the time step is larger than the largest displacement"
APART = "runs whose points are not as close do not approach the run"
WRINKLES = "tissue without bending is pressed together, and with more points wrinkles more"


@dataclass(frozen=True)
class MeshEstimate:
    """What is known about the error that the number of points makes."""

    error: float  # largest error, as a fraction of the largest displacement; infinite: not known
    doubt: str = ""  # why it may be larger; empty: it is about that
    at_most: bool = False  # whether it may be much smaller, because of contact


def coarser(plan: Plan, share: float = 0.5) -> Plan | None:
    """Plan the scene with a share of its cells a side and the same total forces; None: too few points, or no tissue."""
    scene = plan.scene
    if scene.tissue is None or min(scene.sheet.points) < FEWEST:
        return None
    # Shares are rounded up or down, so that cells do not get too long.
    cells = [share * (count - 1) for count in scene.sheet.points]
    if share == NEARER:
        # Of the same parity, so that a tool over the middle meets a point there in both, or in none.
        cells = [
            count - 1 - 2 * round((count - 1 - few) / 2) for count, few in zip(scene.sheet.points, cells, strict=True)
        ]
    ways = product(*({math.ceil(count) + 1, math.floor(count) + 1} for count in cells))
    halves = [with_points(scene, (rows, cols)) for rows, cols in ways]
    possible = [halved for halved in halves if cell_aspect_ratio(halved.sheet) <= MAX_CELL_ASPECT]
    if not possible:
        return None

    def off(halved: Scene) -> float:
        return sum(abs(count - 1 - cell) for count, cell in zip(halved.sheet.points, cells, strict=True))

    coarse = min(possible, key=lambda halved: (off(halved), halved.sheet.points))
    probes = tuple(_pressing_alike(probe, scene.sheet, coarse.sheet) for probe in scene.probes)
    return plan_variant(plan, coarse.model_copy(update={"probes": probes}))


def companion(plan: Plan) -> Plan | None:
    """Plan the first run with fewer points that a run is compared with; None: there is none, as for `coarser`."""
    return coarser(plan, CLOSER) if plan.tools else coarser(plan)


def _pressing_alike(probe: Probe, sheet: Sheet, other: Sheet) -> Probe:
    """Scale the total of a probe, by less than 2, so that its force on another sheet is that on this one."""
    if probe.total is None:
        return probe
    own, there = sum_probe_forces(probe, sheet)[0], sum_probe_forces(probe, other)[0]
    if not 0.5 * there < own < 2 * there:
        return probe
    return probe.model_copy(update={"total": tuple(own / there * part for part in probe.total)})


def missing_force(scene: Scene) -> float:
    """Give the largest relative difference between a tool's force on the points and that on a much finer sheet."""
    finer = min(8, math.isqrt(MOST_SUMMED // math.prod(scene.sheet.points)))
    if finer < 2:
        return 0.0  # With so many points no tool is as narrow as a cell.
    probes = [probe for probe in scene.probes if probe.total is not None]
    pairs = [
        (sum_probe_forces(probe, scene.sheet)[0], sum_probe_forces(probe, scene.sheet, finer)[0]) for probe in probes
    ]
    return max((abs(own / exact - 1) for own, exact in pairs if exact > 0), default=0.0)


class MeshPilot:
    """Runs in f64 beside another run: its `companion`, and without tools on a path one with half the cells of that.

    Args:
        plan: of the run that it is compared with.
        coarse: what `companion` returned for it.

    Raises:
        DeviceError: when the device cannot run it in f64.
    """

    def __init__(self, plan: Plan, coarse: Plan, device: Device, cores: int | None = None) -> None:
        self._material, steps = plan.material, plan.grid.steps_per_frame
        coarsest = None if plan.tools else coarser(coarse)
        plans = [coarse] if coarsest is None else [coarse, coarsest]
        self._sheets = []
        for sheet in plans:
            # Tools must not move too far in a step.
            least = math.ceil(plan.grid.steps_per_frame / 2) if plan.tools else 1
            steps = 1 if plan.scene.time.at_rest else max(math.ceil(steps / 2), stable_steps(sheet), least)
            exact = sheet.with_grid(precision="f64", steps_per_frame=steps)
            self._sheets.append(build_dynamics(exact, device, cores=cores))
        points = [sheet.scene.sheet.points for sheet in (plan, *plans)]
        self._samplings = [CubicSampling(after, before) for before, after in pairwise(points)]
        self._ratio = min((own - 1) / (other - 1) for own, other in zip(*points[:2], strict=True))
        self._differences = [0.0 for _ in plans]
        self._missing = missing_force(plan.scene)
        self._contact = bool(plan.tools)
        apart = max(spacing(plan.scene.sheet))
        self._narrow = any(tool.radius < NARROWEST * apart for tool in plan.tools)
        self._largest, self._shortest = 0.0, 1.0
        self._nearer: MeshPilot | None = None

    def compile(self) -> None:
        """Compile now what the first frame would compile."""
        self._sheets[0].compile()

    def follow(self, displacement: NDArray[Any], pause: Pause) -> None:
        """Step to the next frame, and compare, as a `Pilot` does."""
        self._largest = max(self._largest, longest(displacement))
        finer = displacement
        for n, (sheet, sampling) in enumerate(zip(self._sheets, self._samplings, strict=True)):
            try:
                sheet.advance(sheet.plan.grid.steps_per_frame, pause)
            except DivergedError:  # At rest; then the error is not known.
                self._differences[n] = math.inf
                return
            reading = sheet.read()
            with np.errstate(all="ignore"):
                self._differences[n] = max(self._differences[n], longest(finer - sampling.at(reading.displacement)))
            finer, self._shortest = reading.displacement, min(self._shortest, reading.shortest_spring)

    def tool_forces(self) -> NDArray[np.float64]:
        """Return the forces of the tools in the first run with fewer points, as `Dynamics.tool_forces` does."""
        return self._sheets[0].tool_forces()

    def nearer(self, plan: Plan, device: Device, cores: int | None = None) -> MeshPilot | None:
        """Build the second run that is to follow, from the first frame on; None: the first says enough.

        Args:
            plan: as for the first, like the others.
            device: to run it on.
            cores: to run it with.
        """
        if self._contact and not self._narrow and self._relative > FAR:
            coarse = coarser(plan, NEARER)
            self._nearer = None if coarse is None else MeshPilot(plan, coarse, device, cores)
        return self._nearer

    @property
    def _relative(self) -> float:
        """The largest difference of the first run, as a share of the largest displacement so far."""
        return self._differences[0] / self._largest if self._largest > 0 else 0.0

    @property
    def estimate(self) -> MeshEstimate:
        """What the frames so far show."""
        if self._largest == 0:
            return MeshEstimate(math.inf, UNTOUCHED) if self._contact else MeshEstimate(0.0)
        first, *others = self._differences
        if not first / self._largest < math.inf:
            return MeshEstimate(math.inf, "the run with fewer points diverged")
        if self._contact:
            return self._in_contact(first / self._largest)
        order, doubt = None, ""
        if others and first > 0:
            order = math.log(others[0] / first) / math.log(self._ratio) if others[0] > 0 else -math.inf
        assumed = 1.0
        if order is not None:
            assumed = max(1.0, min(order, 2 - ABOVE * (order - 2)))
        relative = first / (self._ratio**assumed - 1) / self._largest
        if order is not None and not LOWEST_ORDER <= order <= HIGHEST_ORDER:
            doubt = "runs with fewer points do not converge"
        elif self._wrinkles:
            doubt = WRINKLES
        return MeshEstimate((2 if doubt else 1) * relative + self._missing, doubt)

    @property
    def _wrinkles(self) -> bool:
        return self._material.bending == 0 and self._shortest < 1 - self._material.tension - SLACK

    def _in_contact(self, difference: float) -> MeshEstimate:
        """Estimate the error by the difference of the one run with fewer points, relative to the displacement."""
        if self._narrow:
            return MeshEstimate(math.inf, NARROW)
        share = IN_CONTACT * difference
        if difference > FAR:
            if self._nearer is None or not self._nearer._relative <= LARGEST_DIFFERENCE:
                return MeshEstimate(math.inf, APART)
            share = OF_BOTH * math.sqrt(difference * self._nearer._relative)
        return MeshEstimate(share + self._missing, WRINKLES if self._wrinkles else "", at_most=True)


def with_points(scene: Scene, points: tuple[int, int]) -> Scene:
    """Give the sheet of a scene these points, and remove the tolerance by which they were to be chosen."""
    return scene.model_copy(update={"sheet": scene.sheet.model_copy(update={"points": points, "tolerance": None})})


def choose_points(
    plan: Plan,
    device: Device,
    check: Callable[[Scene, Maps | None], Plan],
    progress: ProgressCallback = lambda done, total: None,
) -> tuple[Plan, MeshEstimate]:
    """Find the fewest points, approximately, whose error is within the sheet's tolerance, and this error.

    No fewer points than the plan's are tried, and cells keep their shape. `check` plans a scene with other points and
    the same maps; progress counts the frames of each pilot run.

    Raises:
        SceneError: when even the largest possible number of points is too small, or cannot be run.
    """
    tolerance, given = plan.scene.sheet.tolerance, plan.scene.sheet.points
    assert tolerance is not None
    times, most = max(1.0, (FEWEST - 1) / (min(given) - 1)), (MAX_POINTS - 1) / (max(given) - 1)
    for _ in range(MOST_TRIALS):
        rows, cols = (round((count - 1) * times) + 1 for count in given)
        try:
            tried = choose_precision(check(with_points(plan.scene, (rows, cols)), plan.maps), device.arch)
        except SceneError as error:
            asked = f"with the {rows} x {cols} points that sheet.tolerance: {tolerance:g} asks for"
            raise SceneError([f"{line} ({asked})" for line in error.lines]) from None
        estimate = estimate_points(tried, device, progress)
        if estimate.error <= tolerance:
            return tried, estimate
        # The error falls with the square of the length of the cells, or more slowly.
        needed = times * math.sqrt(estimate.error / (CLOSE * tolerance))
        if estimate.doubt in (NARROW, APART) and needed == math.inf:
            needed = LARGEST_CUT * times  # With more points it is known.
        if needed > most:
            break
        times *= min(LARGEST_CUT, max(LEAST_CUT, needed / times))
    raise SceneError(
        [
            f"sheet.tolerance: {tolerance:g} is out of reach: with {rows} x {cols} points the error is "
            f"{estimate.error:.2g}, and no sheet has more than {MAX_POINTS} points a side; take a wider tool "
            "(probes.N.radius, a smaller falloff), tissue.pretension or bending where it wrinkles and every side is "
            "fixed, or a larger tolerance"
        ]
    )


def estimate_points(plan: Plan, device: Device, progress: ProgressCallback) -> MeshEstimate:
    """Run a scene for which there is a `companion`, and its pilot, in f64; give the error that the pilot shows."""
    exact, coarse, grid = plan.with_grid(precision="f64"), companion(plan), plan.grid
    assert coarse is not None
    pilot = MeshPilot(exact, coarse, device)
    each: MeshPilot | None = pilot
    while each is not None:
        own = build_dynamics(exact, device)
        for frame in range(grid.frames):
            pause = partial(progress, frame, grid.frames)
            pause()
            own.advance(grid.steps_per_frame, pause)
            each.follow(own.displacement(), pause)
        each = pilot.nearer(exact, device) if each is pilot else None
    return pilot.estimate


class CubicSampling:
    """Interpolates displacements of a lattice of 4 x 4 points or more at the points of another, by cubics."""

    def __init__(self, of: tuple[int, int], to: tuple[int, int]) -> None:
        self._axes = [_cubics(given - 1, asked - 1) for given, asked in zip(of, to, strict=True)]

    def at(self, displacement: NDArray[Any]) -> NDArray[np.float64]:
        """Interpolate displacements, shape (rows, cols, 3)."""
        for first, weights in self._axes:
            nodes = (weight[:, None, None] * displacement[first + n] for n, weight in enumerate(weights))
            displacement = sum(nodes, start=np.zeros(())).swapaxes(0, 1)
        return displacement


def _cubics(of: int, to: int) -> tuple[NDArray[np.intp], NDArray[np.float64]]:
    """Give the first of four ends of `of` equal cells, and their weights, for each of the ends of `to` equal cells."""
    place = np.arange(to + 1) * (of / to)
    first = np.clip(np.floor(place).astype(int) - 1, 0, of - 3)
    t, nodes = place - first, range(4)
    weights = [math.prod((t - other) / (node - other) for other in nodes if other != node) for node in nodes]
    return first, np.stack(weights)
