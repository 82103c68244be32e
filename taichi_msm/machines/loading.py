"""Test of a testing machine as the motion of a scene's position-controlled tool, with contact, noise and frames.

The tool moves along a line, from the first contact with the sheet at rest, or a clamp from its rest. It waits there
until the table's depth exceeds the depth of contact, which of a clamp is that of the first row.

Frames are equidistant in time. The equilibria of tissue without relaxation do not depend on time: their frames are
equidistant in depth, from slightly above the contact to the greatest depth, and later rows are not used. The depth and
the force of a frame are means over the rows within half a frame, or interpolated if there are none.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from taichi_msm.errors import SceneError
from taichi_msm.machines.reader import Array, MachineTest
from taichi_msm.model.tools import Clamp, Tool, build_tools, gap_to_sheet
from taichi_msm.scene.scene import Scene

# Default frames per second, and largest number of frames at this default.
FRAMES_PER_SECOND, MAX_FRAMES = 10.0, 200

# Number of frames of an equilibrium without relaxation.
DEPTH_FRAMES = 100

# Smallest force of a contact [noise].
CONTACT_NOISES = 5.0


@dataclass(frozen=True, eq=False)
class Approach:
    """Line of a position-controlled tool, from its first contact with the sheet at rest, or from a clamp's rest.

    Attributes:
        probe: index of the tool in the scene.
        start: centre of the tip at first contact, or 0, the displacement of a clamp at rest [m], shape (3,).
        direction: unit vector, shape (3,).
        tip_height: height of the centre above the lowest point of the tip [m].
        size: height and width of the sheet [m].
        is_clamp: whether the tool is a clamp.
    """

    probe: int
    start: Array
    direction: Array
    tip_height: float
    size: tuple[float, float]
    is_clamp: bool

    def place(self, data: dict[str, Any], travel: Array, rate: float) -> dict[str, Any]:
        """Return a scene's data with the path of the tool, and the times, of a test.

        Args:
            data: data of a scene.
            travel: distance from the first contact at every frame [m], shape (frames,).
            rate: frames per second.
        """
        (height, width), time = self.size, np.arange(len(travel)) / rate
        x, y, z = (self.start + travel[:, None] * self.direction).T
        # Keyframes [t, across, down, height], of a clamp [t, x, y, z].
        places = (x, y, z) if self.is_clamp else (x / width + 0.5, 0.5 - y / height, z - self.tip_height)
        probes = list(data["probes"])
        probes[self.probe] = {**probes[self.probe], "path": np.stack([time, *places], axis=1).tolist()}
        times = {**data["time"], "duration": (len(travel) - 1) / rate, "frames_per_second": rate}
        return {**data, "probes": probes, "time": times}


def find_approach(scene: Scene) -> Approach:
    """Return the line of the scene's tool; raise a SceneError unless one tool moves, over the sheet."""
    tools = build_tools(scene.probes, scene.sheet)
    if len(tools) != 1:
        fault = f"{len(tools)} position-controlled tools, and a table of a testing machine is of one"
        raise SceneError([f"probes: {fault}; give one probe a path and an instrument or a clamp, and no other"])
    (tool,) = tools
    key, offsets = f"probes.{tool.probe}.path", tool.tip_centres - tool.tip_centres[0]
    farthest = offsets[np.linalg.norm(offsets, axis=1).argmax()]
    if not farthest.any():
        raise SceneError([f"{key}: stays at one place; give it a second key, in the direction of the test"])
    direction = farthest / np.linalg.norm(farthest)
    is_clamp = isinstance(tool, Clamp)
    start = np.zeros(3) if is_clamp else _first_contact(tool, direction, scene)
    if start is None:
        raise SceneError([f"{key}: the line from its first key to the farthest misses the sheet; direct it there"])
    tip_height = float(tool.tip_centres[0, 2] - tool.heights[0])
    return Approach(tool.probe, start, direction, tip_height, scene.sheet.size, is_clamp)


def _first_contact(tool: Tool, direction: Array, scene: Scene) -> Array | None:
    """Return the centre of the tip at first contact [m], shape (3,), or None if the tool misses the sheet."""
    start, tolerance = tool.tip_centres[0], 1e-9 * tool.radius
    travel, reach = 0.0, float(np.linalg.norm(start)) + tool.length + math.hypot(*scene.sheet.size)
    # The distance from the sheet changes by at most the travel, so that the tool may advance by it (sphere tracing).
    # That of a tilted plate is approximate, so that it may have to go back.
    goes_back, tip_height = False, tool.tip_centres[0, 2] - tool.heights[0]
    for _ in range(1000):
        centre = start + travel * direction
        placed = replace(tool, times=np.zeros(1), tip_centres=centre[None], heights=centre[2:] - tip_height)
        gap = gap_to_sheet(placed, scene.sheet)
        if abs(gap) <= tolerance or (goes_back and gap > 0):
            return np.asarray(centre)
        goes_back = goes_back or gap < 0
        travel += gap
        if travel > reach:
            break
    return None


@dataclass(frozen=True, eq=False)
class Loading:
    """A machine test at the frames of its scene.

    Attributes:
        test: the test, with the median of the first forces subtracted.
        rate: frames per second of the scene.
        time: times of the table at every frame [s], shape (frames,).
        depth: depths of the table at every frame [m], shape (frames,).
        force: measured force along the tool's direction [N], shape (frames,).
        noise: standard deviation of the force in the first rows [N].
        contact: depth of contact [m of the table].
    """

    test: MachineTest
    rate: float
    time: Array
    depth: Array
    force: Array
    noise: float
    contact: float

    @property
    def scene_time(self) -> Array:
        """Times of the frames in the scene [s], shape (frames,)."""
        return np.arange(len(self.depth)) / self.rate

    @property
    def peak(self) -> float:
        """Largest measured force of a frame [N]."""
        return float(self.force.max())

    @property
    def sigma(self) -> float:
        """Standard deviation of measured minus predicted forces [N]."""
        # Predicted forces have an accuracy of 1e-5 of the peak.
        return max(self.noise, 1e-5 * self.peak)

    def travel(self, contact: float | None = None) -> Array:
        """Return the distance of the tool from its first contact at every frame [m], shape (frames,)."""
        travel = np.maximum(self.depth - (self.contact if contact is None else contact), 0.0)
        travel[0] = 0.0
        return travel


def build_loading(
    test: MachineTest, scene: Scene, rate: float | None = None, contact: float | None = None, *, is_clamp: bool = False
) -> Loading:
    """Return a machine test at frames, with its noise and contact.

    Args:
        test: the test.
        scene: the scene; its motion and relaxation determine the frames.
        rate: frames per second. By default frames are equidistant in depth without relaxation, otherwise 10 or less per
            second.
        contact: depth of contact [m of the table]; by default from the forces, or that of the first row of a clamp.
        is_clamp: whether the tool is a clamp.

    Raises:
        SceneError: when the force does not rise with the depth, or the depth of contact is outside the table.
    """
    first = test.force[: _noise_rows(test)]
    offset = float(np.median(first))
    # 1.48 is the ratio of the standard deviation to the median of the magnitudes, of normal errors.
    noise = max(1.48 * float(np.median(np.abs(first - offset))), test.digit)
    test = replace(test, force=test.force - offset, time=test.time - test.time[0])
    peak = int(test.force.argmax())
    if contact is not None and not test.depth.min() <= contact < test.depth.max():
        limits = f"{test.depth.min():.4g} to {test.depth.max():.4g} m"
        raise SceneError([f"--contact {contact:g}: {test.name}: the depths of the table are {limits}"])
    if contact is None:
        contact = float(test.depth[0 if is_clamp else _contact_row(test, noise, peak)])
    if test.depth[peak] <= contact:
        fault = (
            f"the depth falls from {contact:.4g} to {test.depth[peak]:.4g} m while the force rises to "
            f"{test.force[peak]:.4g} N: is it counted against the motion of the tool?"
        )
        raise SceneError([f"{test.name}: {fault} Choose another by --columns, or change its sign"])
    if rate is None and scene.time.at_rest and not (scene.tissue and scene.tissue.relaxation):
        return _in_depth(test, noise, contact)
    if rate is None:
        rate = min(FRAMES_PER_SECOND, MAX_FRAMES / float(test.time[-1]))
    frames = max(1, math.ceil(float(test.time[-1]) * rate - 1e-6))
    time = np.arange(frames + 1) / rate
    depth, force = _means(test.time, time, 0.5 / rate, (test.depth, test.force))
    return Loading(test, rate, time, depth, force, noise, contact)


def _noise_rows(test: MachineTest) -> int:
    """Return the number of rows from which the noise is estimated."""
    return max(10, math.ceil(0.05 * len(test.force)))


def _contact_row(test: MachineTest, noise: float, peak: int) -> int:
    """Return the last row without a significant force before the peak; the first row if there is none."""
    without_force = np.flatnonzero(test.force[: peak + 1] <= CONTACT_NOISES * noise)
    row = int(without_force[-1]) if len(without_force) else 0
    if row == peak:
        fault = f"the force never exceeds its noise in the first {_noise_rows(test)} rows, {noise:.3g} N, by 5 times"
        remedy = "if the tool touches from the start, give its depth by --contact; or choose the force by --columns"
        raise SceneError([f"{test.name}: {fault}; {remedy}, or cut the table by --window"])
    return row


def late_contact_note(loading: Loading, key: str) -> str | None:
    """Return a note about a contact found too late, as the force rises in the rows of the noise, or None.

    Args:
        loading: the test.
        key: key of its depth of contact, for the remedy.
    """
    from scipy.stats import kendalltau

    test, count = loading.test, _noise_rows(loading.test)
    significant = CONTACT_NOISES * loading.noise
    correlation = kendalltau(test.depth[:count], test.force[:count]).statistic
    # Of 10 independent rows, a rank correlation above 0.55 has a probability of 0.015.
    if not (significant > 0.01 * loading.peak and correlation > 0.55):
        return None
    return (
        f"{test.name}: the force rises within the first {count} rows, from which its noise, {loading.noise:.3g} N, is "
        f"estimated: the tool touches earlier than at {loading.contact:.4g} m, where the force is {significant:.3g} N; "
        f"find the depth by --free {key}, or give it by --contact"
    )


def _in_depth(test: MachineTest, noise: float, contact: float) -> Loading:
    """Compute frames that are equidistant in depth, up to the greatest one."""
    rows = int(test.depth.argmax()) + 1
    deepest = float(test.depth[rows - 1])
    first = max(contact - 0.05 * (deepest - contact), float(test.depth[:rows].min()))
    depth = np.linspace(first, deepest, DEPTH_FRAMES + 1)
    order = np.argsort(test.depth[:rows], kind="stable")
    half = 0.5 * (depth[1] - depth[0])
    columns = [values[:rows][order] for values in (test.depth, test.force, test.time)]
    depth, force, time = _means(columns[0], depth, half, columns)
    return Loading(test, DEPTH_FRAMES / max(float(test.time[rows - 1]), 1e-3), time, depth, force, noise, contact)


def _means(coordinate: Array, at: Array, half_width: float, columns: Sequence[Array]) -> list[Array]:
    """Average columns over the rows within `half_width` of each of n coordinates `at`, or interpolate them.

    `coordinate` of every row increases; columns have the shape (rows,), and their means (n,).
    """
    # Rows on the border of two frames belong to both, up to rounding.
    reach = half_width * (1 + 1e-6)
    low, high = np.searchsorted(coordinate, at - reach, "left"), np.searchsorted(coordinate, at + reach, "right")
    means = []
    for column in columns:
        sums = np.append(0.0, np.cumsum(column))
        mean = (sums[high] - sums[low]) / np.maximum(high - low, 1)
        means.append(np.where(high > low, mean, np.interp(at, coordinate, column)))
    return means
