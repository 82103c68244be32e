"""The force of a probe on the points around its control point.

A probe with `force` gives a point at the distance d from its control point (eq. 5)

    F = force exp(-falloff d - offset)

and one with `total`, whatever the points, the share of the sheet's area that belongs to the point times

    F = total w(d) / W,    w = exp(-falloff max(d - radius, 0)),    W = pi R^2 + 2 pi (R / falloff + 1 / falloff^2)

where W is the integral of w over an endless sheet, and R the radius of the tool's flat end.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import TypedDict

from taichi_msm.physics.lattice import axes, spacing
from taichi_msm.physics.material import area_shares
from taichi_msm.scene import Probe, Scene, Sheet

Array = NDArray[np.float64]


class ProbeForce(NamedTuple):
    """How a probe acts: force exp(-max(falloff d + shift, offset)) on a point at the distance d.

    Attributes:
        force: [N] at 100 %, before the decay.
        falloff: [1/m].
        shift: exponent at d = 0 if the flat end had no area.
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


class ProbeRecord(TypedDict):
    """What a probe does at 100 %, at the first place of its control point.

    Attributes:
        total_force: on all points together [N].
        largest_pressure: force on a point by the area that belongs to it [Pa].
    """

    total_force: float
    largest_pressure: float


def probe_records(scene: Scene) -> list[ProbeRecord]:
    """Add up what every probe of a scene does."""
    (x, y), (dx, dy) = axes(scene.sheet), spacing(scene.sheet)
    shares = area_shares(scene.sheet)
    found = []
    for probe in scene.probes:
        acts, (at_x, at_y) = probe_force(probe, scene.sheet), control_points(probe, scene.sheet)[1][0]
        decay = acts.decay(np.hypot(x - at_x, y - at_y))
        weight = decay * shares if acts.by_area else decay
        force = math.hypot(*acts.force)
        total, largest = force * float(weight.sum()), force * float((weight / shares).max()) / (dx * dy)
        found.append(ProbeRecord(total_force=total, largest_pressure=largest))
    return found


def in_words(record: ProbeRecord) -> str:
    """Say what a probe does."""
    return f"{record['total_force']:.3g} N in all, at most {record['largest_pressure'] / 1000:.3g} kPa"
