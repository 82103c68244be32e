"""Result of a palpation: record and summary."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.palpation.law import FACTOR
from taichi_msm.palpation.predict import Forces, StiffnessMap
from taichi_msm.palpation.presses import LeftOut, Presses
from taichi_msm.palpation.scores import Scores


@dataclass(frozen=True, eq=False)
class Palpation:
    """Presses of a table, their fit, map and scores, and predictions for another table."""

    name: str  # of the table
    presses: Presses
    left_out: list[LeftOut]
    normal: Array  # mean direction out of the tissue, shape (3,)
    map: StiffnessMap
    lock_interval: tuple[float, float | None] | None  # 95 % [m]; None without a lock
    scores: Scores
    predicted: tuple[Presses, Forces] | None  # presses of another table, and their forces
    notes: list[str] = field(default_factory=list)

    def as_json(self) -> dict[str, Any]:
        """Return the record of fit.json, without files and versions."""
        fit, scores = self.map.fit, self.scores
        return {
            "lock": None if math.isinf(fit.law.lock) else fit.law.lock,
            "lock_interval": None if self.lock_interval is None else list(self.lock_interval),
            "factor": FACTOR,
            "radius": fit.law.radius,
            "presses": self.presses.count,
            "left_out": [press._asdict() for press in self.left_out],
            "offset": {"mean": fit.prior.mean, "width": fit.prior.width},
            "length": self.map.process.length,
            "noise": self.map.process.noise,
            "residual": _quantiles(fit.residual),
            "scores": {
                **{name: _quantiles(getattr(scores, name)) for name in ("constant", "nearest", "map")},
                "coverage": scores.coverage,
            },
            "notes": self.notes,
        }

    def summary(self) -> Iterator[str]:
        """Yield the lines for the terminal."""
        fit, scores, interval = self.map.fit, self.scores, self.lock_interval
        left_out = f", {len(self.left_out)} left out" if self.left_out else ""
        for press in self.left_out[:5]:
            left_out += f"; place {press.place}: {press.reason}"
        yield f"presses: {self.presses.count}{left_out}"
        if interval is None:
            yield "lock: none; no lock is significantly better than a linear foundation"
        else:
            high = "?" if interval[1] is None else f"{1000 * interval[1]:.3g}"
            yield f"lock: {1000 * fit.law.lock:.3g} mm, 95 % {1000 * interval[0]:.3g} to {high} mm"
        low, median, high = (f"{value / 1e6:.3g}" for value in np.quantile(fit.stiffness, [0, 0.5, 1]))
        yield f"stiffness: {low} to {high} N/cm3, median {median}, each known to {100 * np.median(fit.error):.2g} %"
        yield f"offset of the depth: {1000 * fit.prior.mean:.3g} mm, +- {1000 * fit.prior.width:.2g} mm between presses"
        process = self.map.process
        yield f"map: length {1000 * process.length:.3g} mm, noise {100 * process.noise:.2g} %"
        residual = 100 * float(np.median(fit.residual))
        errors = [f"{100 * np.median(each):.3g} %" for each in (scores.map, scores.nearest, scores.constant)]
        yield (
            f"residual: {residual:.2g} % of the peak; of presses left out: map {errors[0]}, nearest press {errors[1]}, "
            f"constant {errors[2]}; {100 * scores.coverage:.0f} % of their forces in the 90 % interval"
        )
        yield from self.notes


def _quantiles(residuals: Array) -> dict[str, float]:
    return {"median": float(np.median(residuals)), "p90": float(np.quantile(residuals, 0.9))}
