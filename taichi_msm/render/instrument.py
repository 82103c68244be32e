"""Instruments: rods with rounded ends, whose tips touch the deformed sheet at the tools' control points."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.physics.probe_force import control_point
from taichi_msm.render.surface import touched
from taichi_msm.scene import Instrument, Scene

Array = NDArray[np.float64]


class Rod(NamedTuple):
    """The shape and place of an instrument at one time.

    Attributes:
        tip: middle of its rounded tip [m], shape (3,).
        axis: unit vector from there along the rod, shape (3,).
        length: between the middles of its ends [m].
        radius: of the rod and its ends [m].
    """

    tip: Array
    axis: Array
    length: float
    radius: float


def rods(scene: Scene, position: NDArray[np.floating], time: float) -> list[Rod]:
    """Place the instruments of a scene.

    Args:
        scene: a checked scene.
        position: positions of the mass points [m], shape (rows, cols, 3).
        time: the time at which the control points are taken [s].
    """
    return [
        rod(probe.instrument, scene, position, control_point(probe, scene.sheet, time))
        for probe in scene.probes
        if probe.instrument is not None
    ]


def rod(instrument: Instrument, scene: Scene, position: NDArray[np.floating], rest: Array) -> Rod:
    """Place an instrument.

    Args:
        instrument: the instrument.
        scene: whose sheet it touches.
        position: positions of the mass points [m], shape (rows, cols, 3).
        rest: rest position of the point that it touches, x and y [m], shape (2,).
    """
    shaft = np.array(instrument.shaft) / max(map(abs, instrument.shaft))
    axis = shaft / np.linalg.norm(shaft)
    point, normal = touched(position, scene.render.refine, scene.sheet, rest)
    outward = normal if normal @ axis >= 0 else -normal
    return Rod(point + instrument.radius * outward, axis, instrument.length, instrument.radius)
