"""Machine test as the motion of a scene's position-controlled tool, with depth of contact, noise and frames.

The tool moves along a line, and its travel is max(0, depth - depth of contact). An instrument starts at first contact
with the sheet at rest; a clamp starts at its rest, and its depth of contact is that of the first row.

Frames are equidistant in time. Equilibria without relaxation do not depend on time: their frames are equidistant in
depth, from slightly before contact to the greatest depth; later rows are ignored. Depth and force of a frame are means
over the rows within half a frame, or interpolated if there are none.
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

# Number of frames that are equidistant in depth.
DEPTH_FRAMES = 100

# Smallest force in contact, in units of the noise.
CONTACT_NOISES = 5.0


@dataclass(frozen=True, eq=False)
class Approach:
    """Straight path of a tool, from first contact with the sheet at rest, or from the rest of a clamp.

    Attributes:
        probe: index of the tool in the scene.
        start: centre of the tip at first contact [m], shape (3,); 0, the displacement at rest, for a clamp.
        direction: unit vector of the motion, shape (3,).
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
        """Return a scene's data with the path, duration and frame rate of a test.

        Args:
            data: data of a scene.
            travel: distance from `start` at every frame [m], shape (frames,).
            rate: frames per second.
        """
        (height, width), time = self.size, np.arange(len(travel)) / rate
        x, y, z = (self.start + travel[:, None] * self.direction).T
        # Keyframes are [t, across, down, height], and those of a clamp [t, x, y, z].
        places = (x, y, z) if self.is_clamp else (x / width + 0.5, 0.5 - y / height, z - self.tip_height)
        probes = list(data["probes"])
        probes[self.probe] = {**probes[self.probe], "path": np.stack([time, *places], axis=1).tolist()}
        times = {**data["time"], "duration": (len(travel) - 1) / rate, "frames_per_second": rate}
        return {**data, "probes": probes, "time": times}


def find_approach(scene: Scene) -> Approach:
    """Return the path of the scene's tool; raise a SceneError unless one tool moves, toward the sheet."""
    tools = build_tools(scene.probes, scene.sheet)
    if len(tools) != 1:
        fault = f"{len(tools)} position-controlled tools, but a machine test has one"
        raise SceneError([f"probes: {fault}; give exactly one probe a path, with an instrument or a clamp"])
    (tool,) = tools
    key, offsets = f"probes.{tool.probe}.path", tool.tip_centres - tool.tip_centres[0]
    farthest = offsets[np.linalg.norm(offsets, axis=1).argmax()]
    if not farthest.any():
        raise SceneError([f"{key}: does not move; add a key in the direction of the test"])
    direction = farthest / np.linalg.norm(farthest)
    is_clamp = isinstance(tool, Clamp)
    start = np.zeros(3) if is_clamp else _first_contact(tool, direction, scene)
    if start is None:
        raise SceneError(
            [f"{key}: the line from its first to its farthest key misses the sheet; direct it at the sheet"]
        )
    tip_height = float(tool.tip_centres[0, 2] - tool.heights[0])
    return Approach(tool.probe, start, direction, tip_height, scene.sheet.size, is_clamp)


def _first_contact(tool: Tool, direction: Array, scene: Scene) -> Array | None:
    """Return the centre of the tip at first contact [m], shape (3,), or None if the tool misses the sheet."""
    start, tolerance = tool.tip_centres[0], 1e-9 * tool.radius
    travel, reach = 0.0, float(np.linalg.norm(start)) + tool.length + math.hypot(*scene.sheet.size)
    # Sphere tracing: the tool advances by its gap to the sheet. The gap of a tilted plate is approximate, so the tool
    # may have to go back.
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
    """Machine test, sampled at the frames of a scene.

    Attributes:
        test: the test, without force offset, and with times from 0.
        rate: frames per second of the scene.
        time: time of the test at every frame [s], shape (frames,).
        depth: depth at every frame, as in the table [m], shape (frames,).
        force: measured force along the tool's direction at every frame [N], shape (frames,).
        noise: standard deviation of the force in the first rows [N].
        contact: depth of contact, as in the table [m].
    """

    test: MachineTest
    rate: float
    time: Array
    depth: Array
    force: Array
    noise: float
    contact: float

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
        """Return the travel of the tool [m], shape (frames,); `contact`: another depth of contact [m]."""
        travel = np.maximum(self.depth - (self.contact if contact is None else contact), 0.0)
        travel[0] = 0.0
        return travel


def build_loading(
    test: MachineTest, scene: Scene, rate: float | None = None, contact: float | None = None, *, is_clamp: bool = False
) -> Loading:
    """Return a machine test sampled at frames, with estimated noise and depth of contact.

    Args:
        test: the test.
        scene: scene of the tool and the tissue.
        rate: frames per second; by default 10, or fewer for a long test; of equilibria without relaxation, frames are
            then equidistant in depth.
        contact: depth of contact, as in the table [m]; by default estimated from the forces, for a clamp the first
            depth.
        is_clamp: whether the tool is a clamp.

    Raises:
        SceneError: when the force does not rise with the depth, or the depth of contact is outside the table.
    """
    first = test.force[: _count_noise_rows(test)]
    offset = float(np.median(first))
    # 1.48 converts the median magnitude of normal errors to their standard deviation.
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
            f"{test.force[peak]:.4g} N: is its sign opposite to the motion of the tool?"
        )
        raise SceneError([f"{test.name}: {fault} Choose another depth by --columns, or change its sign"])
    if rate is None and scene.time.at_rest and not (scene.tissue and scene.tissue.relaxation):
        return _sample_in_depth(test, noise, contact)
    if rate is None:
        rate = min(FRAMES_PER_SECOND, MAX_FRAMES / float(test.time[-1]))
    frames = max(1, math.ceil(float(test.time[-1]) * rate - 1e-6))
    time = np.arange(frames + 1) / rate
    depth, force = _means(test.time, time, 0.5 / rate, (test.depth, test.force))
    return Loading(test, rate, time, depth, force, noise, contact)


def require_plausible_travel(loading: Loading, scene: Scene) -> None:
    """Raise a SceneError if the tool travels ten sizes of the sheet or more, probably because of another unit."""
    travel, side = float(loading.travel().max()), max(scene.sheet.size)
    if travel > 10 * side:
        fault = f"depth: the tool travels {travel:.4g} m, and the sheet is {side:g} m long"
        remedy = "write the unit in the header, such as [mm], or in --columns 'depth=NAME, mm'"
        raise SceneError([f"{loading.test.name}: {fault}; {remedy}"])


def _count_noise_rows(test: MachineTest) -> int:
    """Return the number of first rows, which the noise is estimated from."""
    return max(10, math.ceil(0.05 * len(test.force)))


def _contact_row(test: MachineTest, noise: float, peak: int) -> int:
    """Return the last row without a significant force before the peak; the first row if there is none."""
    without_force = np.flatnonzero(test.force[: peak + 1] <= CONTACT_NOISES * noise)
    row = int(without_force[-1]) if len(without_force) else 0
    if row == peak:
        fault = f"the force never exceeds 5 times its noise, {noise:.3g} N in the first {_count_noise_rows(test)} rows"
        remedy = "give the depth by --contact if the tool touches from the start, or choose the force by --columns"
        raise SceneError([f"{test.name}: {fault}; {remedy}, or cut the table by --window"])
    return row


def late_contact_note(loading: Loading, key: str) -> str | None:
    """Return a warning if the force rises already in the first rows, or None.

    The noise of these rows is then too large, and the contact is found too late.

    Args:
        loading: the test.
        key: key of its depth of contact, for the remedy.
    """
    from scipy.stats import kendalltau

    test, count = loading.test, _count_noise_rows(loading.test)
    significant = CONTACT_NOISES * loading.noise
    correlation = kendalltau(test.depth[:count], test.force[:count]).statistic
    # Ten independent rows have a rank correlation above 0.55 with a probability of 0.015.
    if not (significant > 0.01 * loading.peak and correlation > 0.55):
        return None
    return (
        f"{test.name}: the force rises within the first {count} rows, so its noise, {loading.noise:.3g} N, is "
        f"too large: the tool touches before {loading.contact:.4g} m, where the force is {significant:.3g} N; "
        f"find the depth by --free {key}, or give it by --contact"
    )


def _sample_in_depth(test: MachineTest, noise: float, contact: float) -> Loading:
    """Sample a test at equidistant depths, up to the greatest one."""
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
    """Return columns at coordinates `at`, shape (n,): means over the rows within `half_width`, else interpolated.

    `coordinate`, shape (rows,), is the position of a row, and increases.
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
