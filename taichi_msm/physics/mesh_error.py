"""How much the number of points changes a run of tissue, by runs with half and a quarter of the cells a side.

With r times longer cells the displacement u_c tells the error of u by Richardson's extrapolation: it is
|u - u_c| / (r^p - 1). The lattice is of order p = 2 in the length of its cells where the displacement is smooth, and
less at the rim of a tool's flat end, at an edge in a map, at a fixed edge without tension and in wrinkles. So p is what
the third run shows, at most 2 and at least 1; and 1 where there are too few points for a third run.

A tool that is not much wider than a cell presses with more or less than its total, as the points happen to lie. The
other runs press as hard as the first, and what that lacks of the total is added to the error.

With `springs` a sheet is another one with other points, and nothing can be told.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from contextlib import ExitStack, closing
from dataclasses import replace
from functools import partial
from itertools import pairwise, product
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import SceneError
from taichi_msm.physics.error_control import longest
from taichi_msm.physics.material import LONGEST_CELL, cell_ratio
from taichi_msm.physics.probe_force import sums
from taichi_msm.physics.solver import Dynamics
from taichi_msm.physics.timestep import time_grid
from taichi_msm.progress import Count, Pause
from taichi_msm.scene import MAX_POINTS, Probe, Scene, Sheet
from taichi_msm.system.runtime import Device
from taichi_msm.timegrid import TimeGrid

# The runs of one search, how much finer each may be than the one before, and how much finer it is at least.
MOST_TRIALS = 10
LARGEST_CUT, LEAST_CUT = 2.0, 1.1

# The points found are the fewest but for some: their error is to be this share of the tolerance.
CLOSE = 0.8

# The force of a tool is summed over no more points than this to know what it is.
MOST_SUMMED = 4_000_000

# With fewer points a side than this nothing is left to compare with.
FEWEST = 7


def coarser(scene: Scene) -> Scene | None:
    """Give the scene half as many cells a side, and tools that press as hard in all.

    None where there are too few points, or there is no tissue.
    """
    if scene.tissue is None or min(scene.sheet.points) < FEWEST:
        return None
    # Rounded either way, so that cells do not get too long.
    ways = product(*({count // 2 + 1, (count - 1) // 2 + 1} for count in scene.sheet.points))
    tried = [with_points(scene, (rows, cols)) for rows, cols in ways]
    coarse = min(tried, key=lambda one: (cell_ratio(one.sheet) > LONGEST_CELL, one.sheet.points))
    if cell_ratio(coarse.sheet) > LONGEST_CELL:
        return None
    probes = tuple(_pressing_alike(probe, scene.sheet, coarse.sheet) for probe in scene.probes)
    return coarse.model_copy(update={"probes": probes})


def _pressing_alike(probe: Probe, sheet: Sheet, other: Sheet) -> Probe:
    """Change the total of a probe, but for twice or half, so that it presses another sheet as hard as this one."""
    own, there = sums(probe, sheet).total, sums(probe, other).total
    if probe.total is None or not 0.5 * there < own < 2 * there:
        return probe
    return probe.model_copy(update={"total": tuple(own / there * part for part in probe.total)})


def missing_force(scene: Scene) -> float:
    """Tell by which share the forces of any tool's total on the points differ in sum from those on a finer sheet."""
    finer = min(8, math.isqrt(MOST_SUMMED // math.prod(scene.sheet.points)))
    if finer < 2:
        return 0.0  # No tool is as narrow as cells of so many points.
    probes = [probe for probe in scene.probes if probe.total is not None]
    pairs = [(sums(probe, scene.sheet).total, sums(probe, scene.sheet, finer).total) for probe in probes]
    return max((abs(own / exact - 1) for own, exact in pairs if exact > 0), default=0.0)


class MeshPilot:
    """Runs in float64 beside another run, with half the cells a side and, where there are enough, with a quarter.

    Args:
        scene: what is run.
        grid: its steps, which are also the pilot's.
        coarse: what `coarser` gave for it.
        device: what `runtime.start` returned.
        cores: how many cores are free for it; None: all.

    Raises:
        DeviceError: when the device cannot run it in float64.
    """

    def __init__(self, scene: Scene, grid: TimeGrid, coarse: Scene, device: Device, cores: int | None = None) -> None:
        self._steps = grid.steps_per_frame
        exact, coarsest = replace(grid, precision="f64"), coarser(coarse)
        scenes = [coarse] if coarsest is None else [coarse, coarsest]
        with ExitStack() as opened:
            self._sheets = [opened.enter_context(closing(Dynamics(one, exact, device, cores=cores))) for one in scenes]
            self._open = opened.pop_all()
        points = [one.sheet.points for one in (scene, *scenes)]
        self._samplings = [CubicSampling(after, before) for before, after in pairwise(points)]
        self._ratio = min((own - 1) / (other - 1) for own, other in zip(*points[:2], strict=True))
        self._differences = [0.0 for _ in scenes]
        self._missing = missing_force(scene)
        self._largest = 0.0

    def compile(self) -> None:
        """Compile now what would be compiled by the first frame."""
        self._sheets[0].compile()

    def follow(self, displacement: NDArray[Any], pause: Pause) -> None:
        """Take the next frame, and compare.

        Args:
            displacement: of the run at that frame, shape (rows, cols, 3).
            pause: called some times a second; what it raises stops the pilot for good.
        """
        self._largest = max(self._largest, longest(displacement))
        finer = displacement
        for n, (sheet, sampling) in enumerate(zip(self._sheets, self._samplings, strict=True)):
            sheet.advance(self._steps, pause)
            found = sheet.displacement()
            with np.errstate(all="ignore"):
                self._differences[n] = max(self._differences[n], longest(finer - sampling.at(found)))
            finer = found

    @property
    def error(self) -> float:
        """What is known by the frames so far, as a fraction of the largest displacement; infinite: not known."""
        if self._largest == 0:
            return 0.0
        relative = self._differences[0] / (self._ratio**self.order - 1) / self._largest
        return relative + self._missing if relative < math.inf else math.inf

    @property
    def order(self) -> float:
        """Order in the length of the cells that the frames so far show, 1 to 2."""
        first, *others = self._differences
        if not others or not 0 < first < others[0] < math.inf:
            return 1.0
        return min(2.0, max(1.0, math.log(others[0] / first) / math.log(self._ratio)))

    def close(self) -> None:
        """Free the memory."""
        self._open.close()


def with_points(scene: Scene, points: tuple[int, int]) -> Scene:
    """Give the sheet of a scene so many points; what they were to be chosen by is done with."""
    return scene.model_copy(update={"sheet": scene.sheet.model_copy(update={"points": points, "tolerance": None})})


def choose_points(
    scene: Scene,
    device: Device,
    check: Callable[[Scene], object],
    progress: Count = lambda done, total: None,
) -> tuple[Scene, float]:
    """Find the fewest points, but for some, of which the error is within the sheet's tolerance.

    Args:
        scene: a checked scene; its points are the fewest that are tried, and its cells keep their shape.
        device: what `runtime.start` returned.
        check: raises SceneError where a scene with other points cannot be run.
        progress: called with the frames done and the frames in all of each pilot run.

    Returns:
        The scene with these points, and its error.

    Raises:
        SceneError: when so many points as there may be are too few, or cannot be run.
    """
    tolerance, given = scene.sheet.tolerance, scene.sheet.points
    assert tolerance is not None
    times, most = 1.0, (MAX_POINTS - 1) / (max(given) - 1)
    for _ in range(MOST_TRIALS):
        rows, cols = (max(FEWEST - 1, round((count - 1) * times)) + 1 for count in given)
        tried = with_points(scene, (rows, cols))
        try:
            check(tried)
        except SceneError as error:
            asked = f"with the {rows} x {cols} points that sheet.tolerance: {tolerance:g} asks for"
            raise SceneError([f"{line} ({asked})" for line in error.lines]) from None
        found = _error(tried, device, progress)
        if found <= tolerance:
            return tried, found
        if times >= most:
            break
        times = min(most, times * min(LARGEST_CUT, max(LEAST_CUT, math.sqrt(found / (CLOSE * tolerance)))))
    raise SceneError(
        [
            f"sheet.tolerance: {tolerance:g} is out of reach: with {rows} x {cols} points the error is still "
            f"{found:.2g}; take a wider tool (probes.N.radius, a smaller falloff), more tissue.pretension or bending "
            "where it wrinkles, or a larger tolerance"
        ]
    )


def _error(scene: Scene, device: Device, progress: Count) -> float:
    """Run a scene and its pilot, in float64."""
    grid, coarse = replace(time_grid(scene, device.arch), precision="f64"), coarser(scene)
    assert coarse is not None
    with closing(Dynamics(scene, grid, device)) as own, closing(MeshPilot(scene, grid, coarse, device)) as pilot:
        for frame in range(grid.frames):
            pause = partial(progress, frame, grid.frames)
            pause()
            own.advance(grid.steps_per_frame, pause)
            pilot.follow(own.displacement(), pause)
        return pilot.error


class CubicSampling:
    """Samples displacements of one lattice at the points of another one over the same sheet, by cubics.

    Args:
        of: rows, columns of points whose displacements are given; 4 or more.
        to: rows, columns of points at which they are asked for.
    """

    def __init__(self, of: tuple[int, int], to: tuple[int, int]) -> None:
        self._rows, self._cols = (_Cubic(given - 1, asked - 1) for given, asked in zip(of, to, strict=True))

    def at(self, displacement: NDArray[Any]) -> NDArray[np.float64]:
        """Sample displacements, shape (rows, cols, 3)."""
        return self._cols.at(self._rows.at(displacement).swapaxes(0, 1)).swapaxes(0, 1)


class _Cubic:
    """Samples values at the ends of `of` equal cells at those of `to` others, along the first axis, by cubics."""

    def __init__(self, of: int, to: int) -> None:
        place = np.arange(to + 1) * (of / to)
        self._first = np.clip(np.floor(place).astype(int) - 1, 0, of - 3)
        t = place - self._first
        nodes = range(4)
        self._weights = np.stack(
            [math.prod((t - other) / (node - other) for other in nodes if other != node) for node in nodes]
        )

    def at(self, values: NDArray[Any]) -> NDArray[np.float64]:
        """Sample an array."""
        shape = (-1,) + (1,) * (values.ndim - 1)
        return sum(
            (weight.reshape(shape) * values[self._first + n] for n, weight in enumerate(self._weights)),
            start=np.zeros(()),
        )
