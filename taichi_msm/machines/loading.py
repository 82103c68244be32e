"""Machine test as the motion of a scene's position-controlled tool, with depth of contact, noise and frames.

The first rows define the noise that a force in contact exceeds. A clamp may pull already in these, so standard
deviations of frames are estimated from all rows.

The tool moves along a line, and its travel is max(0, depth - depth of contact). An instrument starts at first contact
with the sheet at rest; a clamp starts at its rest, and its depth of contact is that of the first row.

Frames are equidistant in time. Equilibria without relaxation do not depend on time: their frames are equidistant in
depth, from slightly before contact to the greatest depth; later rows are ignored. Depth and force of a frame are means
over the rows within half a frame, or interpolated if there are none. The tool is at rest at the first frame.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Any, NamedTuple

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.errors import SceneError
from taichi_msm.machines.reader import MachineTest
from taichi_msm.model.rest import rest_of
from taichi_msm.model.tools import SolidTool, Tool, build_tools
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet

# Default frames per second, and largest number of frames at this default.
FRAMES_PER_SECOND, MAX_FRAMES = 10.0, 200

# Number of frames that are equidistant in depth.
DEPTH_FRAMES = 100

# Standard deviation of normal errors over their median magnitude.
NORMAL_FACTOR = 1.48

# Smallest force in contact, in units of the noise.
CONTACT_NOISES = 5.0

# Largest range of the forces in the rows of the noise before contact, as a share of that of all forces.
MAX_FIRST_SHARE = 0.3

# Spacing of the points of a curved sheet at the first contact, in radii of the tool.
MAX_SPACING_RADII = 1 / 16

# Share of the travel that frames begin before the contact; largest share at an estimated contact.
CONTACT_SHARE, MAX_CONTACT_SHARE = 0.05, 0.5

# Largest share of a frame that the tool has travelled at the first frame.
MAX_FIRST_TRAVEL = 0.05

# Accuracy of predicted forces, as a share of the peak.
FORCE_ACCURACY = 1e-5


@dataclass(frozen=True, eq=False)
class Approach:
    """Straight path of a tool, from first contact with the sheet at rest, or from the rest of a clamp."""

    probe: int  # index of the tool in the scene
    start: Array  # centre of the tip at first contact [m], shape (3,); 0, the displacement at rest, for a clamp
    direction: Array  # unit vector of the motion, shape (3,)
    tool: Tool
    sheet: Sheet

    @property
    def is_clamp(self) -> bool:
        """Whether the tool is a clamp."""
        return not isinstance(self.tool, SolidTool)

    def place(self, data: dict[str, Any], travel: Array, rate: float) -> dict[str, Any]:
        """Return a scene's data with the path, duration and frame rate of a test.

        `travel`: distance from `start` at every frame [m], shape (frames,).
        """
        time, centres = np.arange(len(travel)) / rate, self.start + travel[:, None] * self.direction
        # Keyframes are [t, across, down, height], and those of a clamp [t, x, y, z].
        keys = self.tool.keys_at(centres, self.sheet) if isinstance(self.tool, SolidTool) else centres
        probes = list(data["probes"])
        probes[self.probe] = {**probes[self.probe], "path": np.column_stack([time, keys]).tolist()}
        times = {**data["time"], "duration": (len(travel) - 1) / rate, "frames_per_second": rate}
        return {**data, "probes": probes, "time": times}


def find_approach(scene: Scene) -> Approach:
    """Return the path of the scene's tool; raise a SceneError unless one tool moves, toward the sheet."""
    tools = build_tools(scene.probes, scene.sheet)
    if len(tools) != 1:
        fault = f"{len(tools)} position-controlled tools, but a machine test has one"
        raise SceneError([f"probes: {fault}; give exactly one probe a path, with an instrument or a clamp"])
    (tool,) = tools
    key, offsets = f"probes.{tool.probe}.path", tool.path - tool.path[0]
    farthest = offsets[np.linalg.norm(offsets, axis=1).argmax()]
    if not farthest.any():
        raise SceneError([f"{key}: does not move; add a key in the direction of the test"])
    direction = farthest / np.linalg.norm(farthest)
    start: Array | None = np.zeros(3)
    if isinstance(tool, SolidTool):
        start = _first_contact(tool, direction, scene.sheet)
    if start is None:
        fault = "the line from its first to its farthest key misses the sheet; direct it at the sheet"
        raise SceneError([f"{key}: {fault}"])
    return Approach(tool.probe, start, direction, tool, scene.sheet)


def _first_contact(tool: SolidTool, direction: Array, sheet: Sheet) -> Array | None:
    """Return the centre of the tip at first contact [m], shape (3,), or None if the tool misses the sheet."""
    start, tolerance = tool.path[0], 1e-9 * tool.radius
    rest, travel = rest_of(sheet), 0.0
    reach = float(np.linalg.norm(start - rest.box.mean(axis=0))) + tool.length + rest.diagonal
    points = tool.points_between(sheet, MAX_SPACING_RADII)
    # Sphere tracing: the tool advances by its gap to the sheet. The gap of a tilted plate is approximate, so the tool
    # may have to go back.
    goes_back = False
    for _ in range(1000):
        centre = start + travel * direction
        gap = tool.gap_at(centre, sheet, points)
        if abs(gap) <= tolerance or (goes_back and gap > 0):
            return np.asarray(centre)
        goes_back = goes_back or gap < 0
        travel += gap
        if travel > reach:
            break
    return None


@dataclass(frozen=True, eq=False)
class Loading:
    """Machine test, sampled at the frames of a scene."""

    test: MachineTest  # without force offset, and with times from 0
    rate: float  # frames per second of the scene
    time: Array  # of every frame [s], shape (frames,)
    depth: Array  # depth at every frame, as in the table [m], shape (frames,)
    force: Array  # measured force along the tool's direction at every frame [N], shape (frames,)
    sigma: Array  # standard deviation of the force at every frame [N], shape (frames,)
    sigma_freedom: float  # degrees of freedom of the estimate of sigma
    # Number of independent forces per frame, shape (frames,): 1, less for frames that share rows, 0 for a frame between
    # rows and for a first frame in contact.
    information: Array
    offset: float  # force of the table without contact [N], subtracted from all forces
    noise: float  # standard deviation of the force in the first rows [N]
    contact: float  # depth of contact, as in the table [m]
    finds_contact: bool  # whether the depth of contact is estimated from the noise
    has_exact_offset: bool = False  # whether the offset is given, and not fitted

    @property
    def peak(self) -> float:
        """Largest measured force of a frame [N]."""
        return float(self.force.max())

    def without_offset(self, offset: float) -> Loading:
        """Return the test with a further offset [N] subtracted from its forces."""
        test = replace(self.test, force=self.test.force - offset)
        return replace(self, test=test, force=self.force - offset, offset=self.offset + offset)

    def travel(self, contact: float | None = None) -> Array:
        """Return the travel of the tool [m], shape (frames,); `contact`: another depth of contact [m]."""
        travel = np.maximum(self.depth - (self.contact if contact is None else contact), 0.0)
        travel[0] = 0.0
        return travel


def build_loading(
    test: MachineTest,
    scene: Scene,
    rate: float | None = None,
    contact: float | None = None,
    *,
    is_clamp: bool = False,
    force_offset: float | None = None,
    fits_contact: bool = False,
) -> Loading:
    """Return a machine test sampled at frames, with estimated noise and depth of contact.

    The default rate is 10 frames per second, or less for a long test; of equilibria without relaxation, frames are then
    equidistant in depth. The default depth of contact [m of the table] is estimated from the forces, for a clamp it is
    the first depth. With `fits_contact` a test that begins in contact has it at first there, too. `force_offset` [N] is
    exact, by default estimated.
    """
    first = test.force[: test.noise_rows]
    median = float(np.median(first))
    offset = median if force_offset is None else force_offset
    if offset >= test.force.max():
        limit = f"the largest force of the table is {test.force.max():.4g} N"
        raise SceneError([f"--force-offset {offset:g}: {test.name}: {limit}; take the force without contact"])
    noise = max(NORMAL_FACTOR * float(np.median(np.abs(first - median))), test.digit)
    test = replace(test, force=test.force - offset, time=test.time - test.time[0])
    peak, finds_contact = int(test.force.argmax()), contact is None and not is_clamp
    if contact is not None and not test.depth.min() <= contact < test.depth.max():
        limits = f"{test.depth.min():.4g} to {test.depth.max():.4g} m"
        raise SceneError([f"--contact {contact:g}: {test.name}: the depths of the table are {limits}"])
    if contact is None and fits_contact and _begins_in_contact(test, noise, float(test.force.max())):
        contact, finds_contact = float(test.depth[0]), False
    if contact is None:
        contact = float(test.depth[0 if is_clamp else _contact_row(test, noise, peak)])
    if test.depth[peak] <= contact:
        fall = f"the depth falls from {contact:.4g} to {test.depth[peak]:.4g} m"
        question = f"the force rises to {test.force[peak]:.4g} N: is its sign opposite to the motion of the tool?"
        remedy = "Choose another depth by --columns, or change its sign"
        raise SceneError([f"{test.name}: {fall} while {question} {remedy}"])
    if rate is None and scene.time.at_rest and not (scene.tissue and scene.tissue.relaxation):
        frames, rate = _sample_in_depth(test, noise, contact, median - offset, finds_contact=finds_contact)
    else:
        rate = rate or min(FRAMES_PER_SECOND, MAX_FRAMES / float(test.time[-1]))
        time = np.arange(max(1, math.ceil(float(test.time[-1]) * rate - 1e-6)) + 1) / rate
        frames = _means(test.time, time, 0.5 / rate, test)._replace(time=time)
    information = frames.information
    if frames.depth[0] - contact > MAX_FIRST_TRAVEL * (frames.depth[1] - frames.depth[0]):
        information[0] = 0.0
    deviation, freedom = _row_deviation(test, max(1, len(test.force) // max(3 * len(frames.force), 10)))
    # Rounding to a digit has a standard deviation of 12^(-1/2).
    least = max(test.digit / math.sqrt(12), FORCE_ACCURACY * float(frames.force.max()))
    sigma = np.maximum(deviation / np.sqrt(np.where(frames.rows > 0, frames.rows, 1.0)), least)
    is_exact = force_offset is not None
    return Loading(
        test, rate, *frames[:3], sigma, freedom, information, offset, noise, contact, finds_contact, is_exact
    )


def require_plausible_travel(loading: Loading, scene: Scene) -> None:
    """Raise a SceneError if the tool travels farther than ten sizes of the sheet, as it does in another unit."""
    travel, side = float(loading.travel().max()), rest_of(scene.sheet).extent
    if travel > 10 * side:
        fault = f"depth: the tool travels {travel:.4g} m, and the sheet is {side:g} m long"
        name = loading.test.columns[1].choice if loading.test.columns else "NAME"
        remedy = f'write the unit in the header, such as [mm], or give it by --columns "depth={name}, mm"'
        raise SceneError([f"{loading.test.name}: {fault}; {remedy}"])


def _contact_row(test: MachineTest, noise: float, peak: int) -> int:
    """Return the last row without a significant force before the peak; the first row if there is none."""
    without_force = np.flatnonzero(test.force[: peak + 1] <= CONTACT_NOISES * noise)
    row = int(without_force[-1]) if len(without_force) else 0
    if row == peak:
        fault = f"the force never exceeds 5 times its noise, {noise:.3g} N in the first {test.noise_rows} rows"
        depth = "find the depth by --free contact, or give it by --contact, if the tool touches from the start"
        remedy = f"{depth}, or choose the force by --columns"
        raise SceneError([f"{test.name}: {fault}; {remedy}, or cut the table by --window"])
    return row


def late_contact_note(loading: Loading, key: str) -> str | None:
    """Return a warning if the force rises already in the first rows, or None.

    The noise of these rows is then too large, and the contact is found too late.
    """
    test, significant = loading.test, CONTACT_NOISES * loading.noise
    if not _begins_in_contact(test, loading.noise, loading.peak):
        return None
    fault = (
        f"the force rises within the first {test.noise_rows} rows, so its noise, {loading.noise:.3g} N, is too large"
    )
    effect = f"the tool touches before {1000 * loading.contact:.4g} mm, where the force is {significant:.3g} N"
    return f"{test.name}: {fault}: {effect}; find the depth by --free {key}, or give it by --contact"


def _begins_in_contact(test: MachineTest, noise: float, peak: float) -> bool:
    """Return whether the force rises significantly already in the rows of the noise, with the depth or in a step."""
    from scipy.stats import kendalltau

    first = test.force[: test.noise_rows]
    # Rows of errors without a trend span at most some six standard deviations, and differ by 2^(1/2) of them.
    extent, scatter = float(np.ptp(first)), NORMAL_FACTOR / math.sqrt(2) * float(np.median(np.abs(np.diff(first))))
    if extent > MAX_FIRST_SHARE * float(np.ptp(test.force)) and extent > 10 * scatter:
        return True
    # Ten independent rows have a rank correlation above 0.55 with a probability of 0.015.
    correlation = kendalltau(test.depth[: test.noise_rows], first).statistic
    return CONTACT_NOISES * noise > 0.01 * peak and correlation > 0.55


class _Frames(NamedTuple):
    """Means over the rows of every frame, each of shape (frames,)."""

    time: Array  # [s]
    depth: Array  # [m]
    force: Array  # [N]
    rows: Array  # number of rows, with those of several frames in equal parts
    information: Array  # `rows` as a share of all rows of the frame; 0 without rows


def _sample_in_depth(
    test: MachineTest, noise: float, contact: float, level: float, *, finds_contact: bool
) -> tuple[_Frames, float]:
    """Sample a test at equidistant depths, up to the greatest one; return the frames, and their number per second.

    `level`: median force of the first rows [N].
    """
    last = int(test.depth.argmax()) + 1
    deepest, share = float(test.depth[last - 1]), CONTACT_SHARE
    if finds_contact:
        # The force of a ball rises with the cube of the depth or less, and exceeds the noise first at the contact.
        late = min((CONTACT_NOISES * noise / float(test.force[:last].max())) ** (1 / 3), MAX_CONTACT_SHARE)
        share += late / (1 - late)
    start = max(contact - share * (deepest - contact), float(test.depth[:last].min()))
    depth = np.linspace(start, deepest, DEPTH_FRAMES + 1)
    half, order = 0.5 * (depth[1] - depth[0]), np.argsort(test.depth[:last], kind="stable")
    pressed = replace(test, time=test.time[order], depth=test.depth[order], force=test.force[order])
    frames = _means(pressed.depth, depth, half, pressed)
    count = test.noise_rows
    if test.depth[:count].max() < depth[0] - 1.01 * half:
        # The first rows, with their median, belong to the first frame. The variance of a median is pi / 2 times that
        # of a mean.
        rows = frames.rows[0] + 2 / math.pi * count
        share = frames.rows[0] / rows
        frames.force[0] = share * frames.force[0] + (1 - share) * level
        frames.rows[0] = rows
    return frames, DEPTH_FRAMES / max(float(test.time[last - 1]), 1e-3)


def _means(coordinate: Array, at: Array, half_width: float, test: MachineTest) -> _Frames:
    """Return means over the rows within `half_width` of coordinates `at`, shape (frames,); interpolate without rows.

    `coordinate`, shape (rows,), is the position of a row, and increases.
    """
    # Rows on the border of two frames belong to both, up to rounding.
    reach = half_width * (1 + 1e-6)
    low, high = np.searchsorted(coordinate, at - reach, "left"), np.searchsorted(coordinate, at + reach, "right")

    def sums(column: Array) -> Array:
        total = np.append(0.0, np.cumsum(column))
        return np.asarray(total[high] - total[low])

    count = np.maximum(high - low, 1)
    starts, ends = (np.bincount(rows, minlength=len(coordinate) + 1) for rows in (low, high))
    own = sums(1 / np.maximum(np.cumsum(starts - ends)[:-1], 1))
    time, depth, force = (
        np.where(high > low, sums(column) / count, np.interp(at, coordinate, column))
        for column in (test.time, test.depth, test.force)
    )
    return _Frames(time, depth, force, own, own / count)


def _row_deviation(test: MachineTest, size: int) -> tuple[float, float]:
    """Return the standard deviation of the errors of a row [N], from means of `size` rows, and its degrees of freedom.

    These are distances from cubics through the four neighbouring means: they do not depend on a ramp, unlike the spread
    of the first rows, and slow errors count fully.
    """
    count = len(test.force) // size
    means = (column[: count * size].reshape(count, size).mean(axis=1) for column in (test.time, test.force))
    time, force = (np.lib.stride_tricks.sliding_window_view(column, 5) for column in means)
    weights = np.ones(time.shape)
    for n in (0, 1, 3, 4):
        for m in {0, 1, 3, 4} - {n}:
            weights[:, n] *= (time[:, 2] - time[:, m]) / (time[:, n] - time[:, m])
    weights[:, 2] = -1.0
    distances = (weights * force).sum(axis=1) / np.linalg.norm(weights, axis=1)
    distances = np.abs(distances)
    deviation = NORMAL_FACTOR * float(np.median(distances))
    for _ in range(5):
        # Corners of the ramp are beyond three standard deviations; 0.9866 is that of a normal error within three.
        kept = distances[distances <= 3 * deviation]
        deviation = float(np.sqrt(np.mean(kept**2))) / 0.9866
    # The sum of the squared autocorrelations of the distances is 2.63.
    return deviation * math.sqrt(size), len(distances) / 2.63
