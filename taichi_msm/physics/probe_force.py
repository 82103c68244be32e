"""The force of a probe on the points around its control point.

A probe with `force` gives a point at the distance d from its control point (eq. 5)

    F = force exp(-falloff max(d - radius, 0) - offset)

and one with `total`, whatever the points, the share of the sheet's area that belongs to the point times

    F = total w(d) / W,    w = exp(-falloff max(d - radius, 0)),    W = pi R^2 + 2 pi (R / falloff + 1 / falloff^2)

where W is the integral of w over an endless sheet, and R the radius of the tool's flat end.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypedDict

from taichi_msm.physics.lattice import axes, spacing
from taichi_msm.physics.material import area_shares
from taichi_msm.scene import Probe, Scene, Sheet

Array = NDArray[np.float64]

# Less of a tool's total than this share on the sheet, or as much more, is remarkable.
LEAST_REACHING = 0.8


class ProbeForce(NamedTuple):
    """How a probe acts: force exp(-max(falloff d + shift, offset)) on a point at the distance d.

    Attributes:
        force: [N] at 100 %, before the decay.
        falloff: [1/m].
        shift: offset - falloff radius, so that the exponent is that of the flat end up to its rim.
        offset: exponent on the flat end.
        by_area: whether a point gets its share of a cell's area.
    """

    force: tuple[float, float, float]
    falloff: float
    shift: float
    offset: float
    by_area: bool

    @property
    def size(self) -> float:
        """Largest force on a point at 100 % [N]."""
        return math.hypot(*self.force) * math.exp(-self.offset)

    def decay(self, distance: Array) -> Array:
        """Tell which share of the force acts at a distance from the control point [m]."""
        return np.exp(-np.maximum(self.falloff * distance + self.shift, self.offset))


def probe_force(probe: Probe, sheet: Sheet) -> ProbeForce:
    """Find how a probe acts on a sheet."""
    by_area = probe.total is not None
    offset = 0.0 if by_area else probe.offset
    shift = offset - probe.falloff * probe.radius
    if not by_area:
        assert probe.force is not None
        return ProbeForce(probe.force, probe.falloff, shift, offset, by_area)
    assert probe.total is not None
    dx, dy = spacing(sheet)
    share = dx * dy / spread(probe)
    x, y, z = probe.total
    return ProbeForce((x * share, y * share, z * share), probe.falloff, shift, offset, by_area)


def control_points(probe: Probe, sheet: Sheet) -> tuple[Array, Array]:
    """Give the keys of a probe's control point: times [s], shape (n,), and points [m], shape (n, 2)."""
    first = probe.at[0]
    keys = probe.at if isinstance(first, tuple) else ((0.0, *probe.at),)
    time, across, down = np.array(keys, dtype=float).T
    height, width = sheet.size
    return time, np.stack([(across - 0.5) * width, (0.5 - down) * height], axis=1)


def spread(probe: Probe) -> float:
    """Integrate the decay of a probe with `total` over an endless sheet: W [m2]."""
    reach = 1 / probe.falloff
    # Products and no powers, which raise where a product is infinite.
    return math.pi * (probe.radius * probe.radius + 2 * (probe.radius * reach + reach * reach))


def total_on_points(probe: Probe, sheet: Sheet, finer: int = 1) -> float:
    """Add up the forces of a probe at 100 % on all points of a sheet, or of one with cells a whole number finer [N]."""
    acts, (at_x, at_y) = probe_force(probe, sheet), control_points(probe, sheet)[1][0]
    (rows, cols), (height, width) = ((count - 1) * finer for count in sheet.points), sheet.size
    x, y = (np.arange(cols + 1) / cols - 0.5) * width, (0.5 - np.arange(rows + 1)[:, None] / rows) * height
    forces = acts.decay(np.hypot(x - at_x, y - at_y))
    if acts.by_area:
        forces[[0, -1]] /= 2
        forces[:, [0, -1]] /= 2
    return math.hypot(*acts.force) * float(forces.sum()) / finer**2


class ProbeRecord(TypedDict):
    """What a probe does at 100 %, at the first place of its control point.

    Attributes:
        total_force: on all points together [N].
        flat_end_force: the part of a `total` that acts under the tool's flat end, on a wide sheet [N].
        largest_pressure: force on a point by the area that belongs to it [Pa].
    """

    total_force: float
    flat_end_force: float
    largest_pressure: float


def probe_records(scene: Scene) -> list[ProbeRecord]:
    """Add up what every probe of a scene does."""
    (dx, dy), found = spacing(scene.sheet), []
    for probe in scene.probes:
        acts, (at_x, at_y) = probe_force(probe, scene.sheet), control_points(probe, scene.sheet)[1][0]
        x, y = axes(scene.sheet)
        force = math.hypot(*acts.force) * acts.decay(np.hypot(x - at_x, y - at_y)).max()
        largest = force / (dx * dy if acts.by_area else float(area_shares(scene.sheet).max()) * dx * dy)
        flat = 0.0
        if probe.total is not None:
            flat = math.hypot(*probe.total) * math.pi * probe.radius * probe.radius / spread(probe)
        total = total_on_points(probe, scene.sheet)
        found.append(ProbeRecord(total_force=total, flat_end_force=flat, largest_pressure=float(largest)))
    return found


def in_words(record: ProbeRecord) -> str:
    """Say what a probe does."""
    flat = f", {record['flat_end_force']:.3g} N of it under the flat end" if record["flat_end_force"] > 0 else ""
    return f"{record['total_force']:.3g} N in all{flat}, at most {record['largest_pressure'] / 1000:.3g} kPa"


def notes(scene: Scene) -> Iterator[str]:
    """Say of which tool most does not reach the sheet, or more than its total, as there are too few points."""
    for index, (probe, record) in enumerate(zip(scene.probes, probe_records(scene), strict=True)):
        asked = math.hypot(*probe.total) if probe.total is not None else 0.0
        if asked > 0 and not LEAST_REACHING < record["total_force"] / asked < 1 / LEAST_REACHING:
            yield (
                f"probes.{index}: {record['total_force']:.3g} N of its {asked:.3g} N reach the sheet; is it beside it, "
                "wider than the sheet, or narrower than a cell?"
            )
