"""The force of a probe on the points around its control point.

A probe with `force` exerts on a point at the distance d from its control point (eq. 5)

    F = force exp(-falloff max(d - radius, 0) - offset)

and one with `total`, for any number of points, the area that belongs to the point times

    F = total w(d) / W,    w = exp(-falloff max(d - radius, 0)),    W = pi R^2 + 2 pi (R / falloff + 1 / falloff^2)

where W is the integral of w over an infinite sheet, and R the radius of the tool's flat end.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypedDict

from taichi_msm.model.sheet import spacing
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Probe

# Times that differ by less are one [s, or of the time].
SAME_TIME = 1e-12

Array = NDArray[np.float64]

# Forces are summed for this many points at a time.
BLOCK = 1 << 20

# A note is made if the force on the sheet is below this share of a tool's total, or above its inverse.
MIN_FORCE_RATIO = 0.8


class ProbeForce(NamedTuple):
    """How a probe acts: force exp(-max(falloff d + shift, offset)) on a point at the distance d."""

    force: tuple[float, float, float]  # [N] at 100 %, before the decay
    falloff: float  # [1/m]
    shift: float  # offset - falloff radius, so that the exponent is that of the flat end up to its rim
    offset: float  # exponent on the flat end
    by_area: bool  # whether the force on a point is multiplied by its share of a cell's area

    @property
    def size(self) -> float:
        """Largest force on a point at 100 % [N]."""
        return math.hypot(*self.force) * math.exp(-self.offset)

    def decay(self, distance: Array) -> Array:
        """Give the share of the force that acts at a distance from the control point [m]."""
        return np.exp(-np.maximum(self.falloff * distance + self.shift, self.offset))


def probe_force(probe: Probe, sheet: Sheet) -> ProbeForce:
    """Compute how a probe acts on a sheet."""
    flat = probe.falloff * probe.radius
    if probe.total is None:
        assert probe.force is not None
        return ProbeForce(probe.force, probe.falloff, probe.offset - flat, probe.offset, by_area=False)
    dx, dy = spacing(sheet)
    share = dx * dy / decay_integral(probe)
    x, y, z = probe.total
    return ProbeForce((x * share, y * share, z * share), probe.falloff, 0.0 - flat, 0.0, by_area=True)


def control_points(probe: Probe, sheet: Sheet) -> tuple[Array, Array]:
    """Give the keys of a probe's control point: times [s], shape (n,), and points [m], shape (n, 2)."""
    first = probe.at[0]
    keys = probe.at if isinstance(first, tuple) else ((0.0, *probe.at),)
    time, across, down = np.array(keys, dtype=float).T
    height, width = sheet.size
    return time, np.stack([(across - 0.5) * width, (0.5 - down) * height], axis=1)


def control_point(probe: Probe, sheet: Sheet, time: float) -> Array:
    """Give a probe's control point at a time, x and y at rest [m], shape (2,); where it jumps, the one it jumps to."""
    return point_at(*control_points(probe, sheet), time)


def point_at(times: Array, points: Array, time: float) -> Array:
    """Give the control point with these keys at a time [s], as `control_point` does."""
    # Times of frames are rounded.
    after = int(np.searchsorted(times, time + SAME_TIME * max(1.0, abs(time)), side="right"))
    if after in (0, len(times)):
        return points[min(after, len(times) - 1)]
    share = min(1.0, (time - times[after - 1]) / (times[after] - times[after - 1]))
    return points[after - 1] + share * (points[after] - points[after - 1])


def decay_integral(probe: Probe) -> float:
    """Integrate the decay of a probe with `total` over an infinite sheet: W [m2]."""
    reach = 1 / probe.falloff
    # Products instead of powers: these raise OverflowError where a product is infinite.
    return math.pi * (probe.radius * probe.radius + 2 * (probe.radius * reach + reach * reach))


def sum_probe_forces(probe: Probe, sheet: Sheet, finer: int = 1) -> tuple[float, float]:
    """Sum the forces of a probe at 100 % and at its first place on the points of a sheet.

    finer: how many times shorter the cells are.

    Returns:
        The sum [N], and the largest force on a point per area that belongs to it [Pa].
    """
    acts, (at_x, at_y) = probe_force(probe, sheet), control_points(probe, sheet)[1][0]
    (rows, cols), (height, width) = ((count - 1) * finer for count in sheet.points), sheet.size
    x, y = (np.arange(cols + 1) / cols - 0.5) * width, (0.5 - np.arange(rows + 1) / rows) * height
    along, down = np.ones(cols + 1), np.ones(rows + 1)
    along[[0, -1]], down[[0, -1]] = 0.5, 0.5
    total, largest = 0.0, 0.0
    # A block of rows at a time, which takes little memory.
    block = max(1, BLOCK // (cols + 1))
    for first in range(0, rows + 1, block):
        part = slice(first, first + block)
        decay, share = acts.decay(np.hypot(x - at_x, y[part, None] - at_y)), down[part, None] * along
        total += float((decay * share if acts.by_area else decay).sum())
        largest = max(largest, float((decay if acts.by_area else decay / share).max()))
    force, (dx, dy) = math.hypot(*acts.force), spacing(sheet)
    return force * total / finer**2, force * largest / (dx * dy)


class ProbeRecord(TypedDict, total=False):
    """The forces of a probe."""

    # Those of a load at 100 %, at the first place of the control point; a tool that is moved has none.
    total_force: float  # sum over all points [N]
    flat_end_force: float  # the part of a `total` that acts under the tool's flat end, on a wide sheet [N]
    largest_pressure: float  # largest force on a point per area that belongs to it [Pa]
    # Of a run, the force on the points that are not fixed at the frame at which it is greatest.
    greatest_force: float  # [N]
    greatest_force_vector: Sequence[float]  # x, y and z [N]
    greatest_force_time: float  # [s]


def probe_records(scene: Scene) -> list[ProbeRecord]:
    """Sum the forces of every probe of a scene; nothing of one that is moved."""
    records: list[ProbeRecord] = []
    for probe in scene.probes:
        if probe.moved:
            records.append(ProbeRecord())
            continue
        flat, (total, pressure) = 0.0, sum_probe_forces(probe, scene.sheet)
        if probe.total is not None:
            flat = math.hypot(*probe.total) * math.pi * probe.radius * probe.radius / decay_integral(probe)
        records.append(ProbeRecord(total_force=total, flat_end_force=flat, largest_pressure=pressure))
    return records


def describe_forces(record: ProbeRecord) -> str:
    """Describe the forces of a probe in a line; empty if nothing is known of them."""
    if "total_force" not in record:
        known = "greatest_force" in record
        return f"at most {record['greatest_force']:.3g} N, at {record['greatest_force_time']:.3g} s" if known else ""
    flat = f", {record['flat_end_force']:.3g} N of it under the flat end" if record["flat_end_force"] > 0 else ""
    return f"{record['total_force']:.3g} N in all{flat}, at most {record['largest_pressure'] / 1000:.3g} kPa"


def force_warnings(scene: Scene, records: Sequence[ProbeRecord]) -> Iterator[str]:
    """Note the probes of a checked scene whose forces do not add up to their total on this sheet."""
    across, down = spacing(scene.sheet)
    cell = f"a cell of {across:.3g} x {down:.3g} m"
    for index, (probe, record) in enumerate(zip(scene.probes, records, strict=True)):
        if probe.moved:
            continue
        asked, reaching = math.hypot(*probe.total) if probe.total is not None else 0.0, record["total_force"]
        if asked > 0 and reaching <= MIN_FORCE_RATIO * asked:
            yield (
                f"probes.{index}: {reaching:.3g} N of its {asked:.3g} N reach the sheet; is the tool beside the sheet, "
                f"wider than the sheet, or narrower than {cell}?"
            )
        elif asked > 0 and reaching * MIN_FORCE_RATIO >= asked:
            yield f"probes.{index}: {reaching:.3g} N instead of its {asked:.3g} N, as the tool is narrower than {cell}"
