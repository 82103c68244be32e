"""Synthetic presses of a ball on tissue with a smooth map of stiffness."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.palpation.law import BallLaw
from taichi_msm.palpation.presses import Presses

RADIUS, LOCK = 4e-3, 4.5e-3
MEAN_OFFSET, OFFSET_WIDTH = 0.7e-3, 0.1e-3


@dataclass(frozen=True, eq=False)
class Truth:
    """Presses with their true stiffness [N/m3] and offset [m], shape (n,)."""

    presses: Presses
    stiffness: Array
    offset: Array


def log_stiffness(position: Array) -> Array:
    """Log K of the map: K from 2e6 to 4.5e6 N/m3."""
    return np.asarray(np.log(3e6) + 0.4 * np.sin(150 * position[:, 0]) * np.cos(120 * position[:, 1]))


def make_presses(
    count: int,
    *,
    lock: float = LOCK,
    noise: float = 0.02,
    scatter: float = 0.05,
    width: float = OFFSET_WIDTH,
    seed: int = 1,
) -> Truth:
    """Presses of ten rows; standard deviations: `noise` of forces over the peak, `scatter` of log K about the map."""
    rng, rows = np.random.default_rng(seed), 10
    position = np.column_stack([rng.uniform(0, 0.06, count), rng.uniform(0, 0.04, count), np.zeros(count)])
    stiffness = np.exp(log_stiffness(position) + scatter * rng.standard_normal(count))
    offset = MEAN_OFFSET + width * rng.standard_normal(count)
    index, depth = np.repeat(np.arange(count), rows), np.tile(np.linspace(5e-5, 3e-3, rows), count)
    force = stiffness[index] * BallLaw(RADIUS, lock).force(depth + offset[index])
    peak = force.reshape(count, rows).max(axis=1)[index]
    force = force + noise * peak * rng.standard_normal(len(force))
    presses = Presses(tuple(f"p{n}" for n in range(count)), position, index, depth, force)
    return Truth(presses, stiffness, offset)


def write_table(path: Path, presses: Presses, header: str = "place,x_mm,y_mm,z_mm,depth_mm,force_N") -> Path:
    """Write presses as a table."""
    lines = [header]
    for n, depth, force in zip(presses.index, presses.depth, presses.force, strict=True):
        x, y, z = 1000 * presses.position[n]
        lines.append(f"{presses.places[n]},{x:.4f},{y:.4f},{z:.4f},{1000 * depth:.4f},{force:.5f}")
    path.write_text("\n".join(lines) + "\n")
    return path
