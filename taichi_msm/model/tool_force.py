"""The force of a force-controlled probe on the mass points around its control point.

A probe with `force` exerts on a mass point at the distance d from its control point (eq. 5)

    F = force exp(-falloff max(d - radius, 0) - offset)

A probe with `total` exerts a force F per area of a mass point, which is independent of the mesh:

    F = total w(d) / W,    w = exp(-falloff max(d - R, 0)),    W = pi R^2 + 2 pi (R / falloff + 1 / falloff^2)

where W is the integral of w over an infinite sheet and R the `radius` of the tool's flat end. A force that is a number
is along the normal of the sheet at rest at the control point.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from typing import NamedTuple

import numpy as np
from typing_extensions import TypedDict

from taichi_msm.arithmetic import Array
from taichi_msm.model.geometry import CurvedRest
from taichi_msm.model.mask import Mask
from taichi_msm.model.rest import rest_of
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.sheet import Sheet
from taichi_msm.scene.tools import Probe

# A warning is issued if the ratio of the force on the sheet to `total` is below this value or above its inverse.
MIN_FORCE_RATIO = 0.8

# Largest pressure of a tool without a warning [Pa].
MAX_PRESSURE_PA = 1e6


class ProbeForce(NamedTuple):
    """The force law of a probe: force exp(-max(falloff d + shift, offset)) on a mass point at the distance d."""

    force: tuple[float, float, float]  # [N] at 100 %, before the decay
    falloff: float  # [1/m]
    shift: float  # offset - falloff radius; the exponent is constant under the flat end and continuous at its rim
    offset: float  # exponent under the flat end
    by_area: bool  # whether the force on a mass point is multiplied by its share of a cell's area

    @property
    def max_force(self) -> float:
        """Largest force on a mass point at 100 % [N]."""
        return math.hypot(*self.force) * math.exp(-self.offset)

    def decay(self, distance: Array) -> Array:
        """Return the decay factors at distances from the control point [m]."""
        return np.exp(-np.maximum(self.falloff * distance + self.shift, self.offset))


def probe_force(probe: Probe, sheet: Sheet) -> ProbeForce:
    """Return the force law of a force-controlled probe; the area of the sheet's cells scales a `total`."""
    rim, vector = probe.falloff * probe.radius, probe.vector
    assert vector is not None
    if probe.total is None:
        return ProbeForce(vector, probe.falloff, probe.offset - rim, probe.offset, by_area=False)
    fraction = rest_of(sheet).cell_area / _decay_integral(probe)
    x, y, z = vector
    return ProbeForce((x * fraction, y * fraction, z * fraction), probe.falloff, 0.0 - rim, 0.0, by_area=True)


def probe_directions(probe: Probe, sheet: Sheet, coordinates: Array) -> Array:
    """Return `ProbeForce.force` [N] with the control point at coordinates, shape (n, 2); shape (n, 3)."""
    force, rest = np.array(probe_force(probe, sheet).force), rest_of(sheet)
    if not probe.is_normal or rest.is_flat:
        return np.tile(force, (len(coordinates), 1))
    return force[2] * rest.normals(coordinates)


def control_points(probe: Probe, sheet: Sheet) -> tuple[Array, Array]:
    """Return the keyframes of a control point: times [s], shape (n,), and coordinates of `Rest`, shape (n, 2)."""
    first = probe.at[0]
    keys = np.array(probe.at if isinstance(first, tuple) else ((0.0, *probe.at),), dtype=float)
    return keys[:, 0], rest_of(sheet).coordinates(keys[:, 1:])


def control_point(probe: Probe, sheet: Sheet, time: float) -> Array:
    """Return the coordinates of a probe's control point, shape (2,); at a jump, those after the jump."""
    return point_at(*control_points(probe, sheet), time)


def point_at(times: Array, points: Array, time: float) -> Array:
    """Interpolate between the control points of keyframes, shape (n, 2); at a jump, return the point after it."""
    # A keyframe later than the time by a rounding error counts as reached.
    after = int(np.searchsorted(times, time + 1e-12 * max(1.0, abs(time)), side="right"))
    if after in (0, len(times)):
        return points[min(after, len(times) - 1)]
    fraction = min(1.0, (time - times[after - 1]) / (times[after] - times[after - 1]))
    return points[after - 1] + fraction * (points[after] - points[after - 1])


def _decay_integral(probe: Probe) -> float:
    """Return the integral W of the decay of a probe with `total` over an infinite sheet [m2]."""
    reach = 1 / probe.falloff
    # Powers would raise OverflowError where products become infinite.
    return math.pi * (probe.radius * probe.radius + 2 * (probe.radius * reach + reach * reach))


def sum_probe_forces(probe: Probe, sheet: Sheet, refinement: int = 1) -> tuple[float, float]:
    """Sum the forces of a probe over all mass points, at 100 % and at its first control point.

    Return the sum [N], and the largest force on a mass point per area that belongs to it [Pa], for a sheet whose cells
    are divided along both axes by the factor `refinement`.
    """
    law, at, rest = probe_force(probe, sheet), control_points(probe, sheet)[1][0], rest_of(sheet)
    force = math.hypot(*law.force)
    if isinstance(rest, CurvedRest):
        points = tuple((count - 1) * refinement + 1 for count in sheet.points)
        fine = rest_of(sheet.model_copy(update={"points": points}))
        assert isinstance(fine, CurvedRest)
        decay, areas = law.decay(fine.distances(at)), fine.areas / rest.cell_area
        forces, is_sheet = decay * areas if law.by_area else decay / refinement**2, areas > 0
        return force * float(forces.sum()), force * float((forces[is_sheet] / fine.areas[is_sheet]).max())
    at_x, at_y = at
    (rows, cols), (height, width) = ((count - 1) * refinement for count in sheet.points), sheet.size
    x, y = (np.arange(cols + 1) / cols - 0.5) * width, (0.5 - np.arange(rows + 1) / rows) * height
    along, down = np.ones(cols + 1), np.ones(rows + 1)
    along[[0, -1]], down[[0, -1]] = 0.5, 0.5
    cells = None
    if sheet.mask is not None:
        cells = Mask.at_cells(sheet.mask.pixels.is_sheet, (rows + 1, cols + 1)).cell_counts
    total, largest = 0.0, 0.0
    # Blocks of rows limit the memory to about a million mass points.
    block = max(1, (1 << 20) // (cols + 1))
    for first in range(0, rows + 1, block):
        rows_of_block = slice(first, first + block)
        decay = law.decay(np.hypot(x - at_x, y[rows_of_block, None] - at_y))
        area_share = down[rows_of_block, None] * along
        if cells is not None:  # a sheet of tissue
            area_share = cells[rows_of_block] / 4
            decay = np.where(area_share > 0, decay, 0)
        total += float((decay * area_share if law.by_area else decay).sum())
        largest = max(largest, float((decay if law.by_area else decay / area_share).max()))
    return force * total / refinement**2, force * largest / rest.cell_area


class ProbeRecord(TypedDict, total=False):
    """The forces of a probe, as written to run.json."""

    # At 100 % and at the first control point; missing for position-controlled tools.
    total_force: float  # sum over all mass points [N]
    flat_end_force: float  # part of a `total` that acts under the tool's flat end, on a wide sheet [N]
    largest_pressure: float  # largest force on a mass point per area that belongs to it [Pa]
    # At the frame of a run with the largest force on free mass points.
    greatest_force: float  # [N]
    greatest_force_vector: Sequence[float]  # x, y and z [N]
    greatest_force_time: float  # [s]


def probe_records(scene: Scene) -> list[ProbeRecord]:
    """Return the forces of every probe of a scene; the record of a position-controlled tool is empty."""
    records: list[ProbeRecord] = []
    for probe in scene.probes:
        if probe.moved:
            records.append(ProbeRecord())
            continue
        flat, (total, pressure) = 0.0, sum_probe_forces(probe, scene.sheet)
        if probe.total is not None and probe.vector is not None:
            flat = math.hypot(*probe.vector) * math.pi * probe.radius * probe.radius / _decay_integral(probe)
        records.append(ProbeRecord(total_force=total, flat_end_force=flat, largest_pressure=pressure))
    return records


def describe_forces(record: ProbeRecord) -> str:
    """Format the forces of a probe as one line; empty for an empty record."""
    if "total_force" not in record:
        known = "greatest_force" in record
        return f"at most {record['greatest_force']:.3g} N, at {record['greatest_force_time']:.3g} s" if known else ""
    # On a sheet that is smaller than the tool, only a part of these forces acts.
    has_flat_end = 0 < record["flat_end_force"] <= record["total_force"]
    flat = f", {record['flat_end_force']:.3g} N of it under the flat end" if has_flat_end else ""
    return f"{record['total_force']:.3g} N in all{flat}, at most {record['largest_pressure'] / 1000:.3g} kPa"


def force_warnings(scene: Scene, records: Sequence[ProbeRecord]) -> Iterator[str]:
    """Yield warnings of probes, from `probe_records`, with implausible pressures or not all of their `total`."""
    across, down = rest_of(scene.sheet).cell_sides
    cell = f"a cell of {across:.3g} x {down:.3g} m"
    cause = f"the tool is narrower than {cell}"
    if scene.sheet.surface:
        cause = f"the surface has more area around it than a plane, or {cause}"
    for index, (probe, record) in enumerate(zip(scene.probes, records, strict=True)):
        if probe.moved:
            continue
        requested, applied = math.hypot(*(probe.vector or ())) * (probe.total is not None), record["total_force"]
        if requested > 0 and applied <= MIN_FORCE_RATIO * requested:
            yield (
                f"probes.{index}: {applied:.3g} N of its {requested:.3g} N reach the sheet; is the tool outside "
                f"the sheet, wider than the sheet, or narrower than {cell}?"
            )
        elif requested > 0 and applied * MIN_FORCE_RATIO >= requested:
            yield (f"probes.{index}: {applied:.3g} N instead of its {requested:.3g} N, as {cause}")
        elif (pressure := record["largest_pressure"]) > MAX_PRESSURE_PA:
            fault = f"presses with up to {pressure / 1e6:.3g} MPa, and tissue tears at less"
            yield f"probes.{index}: {fault}; forces are in newtons, lengths in metres: check force, radius and falloff"
