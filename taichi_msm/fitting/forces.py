"""Measured forces of tools on the sheet, and reader of forces.csv, with any separator and decimal mark.

Cells are numbers, or empty or NaN where not measured.
"""

from __future__ import annotations

import math
import re
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from taichi_msm.arithmetic import Array
from taichi_msm.errors import SceneError
from taichi_msm.fitting import observation
from taichi_msm.fitting.observation import Observation, ObservationModel, root_mean_square
from taichi_msm.fitting.panels import Panel, plot_forces
from taichi_msm.machines.cells import Row, decimal_mark, read_text
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene

# Units in which forces may be given by mistake, per newton; largest factor between such a ratio and an observed one.
UNITS_PER_NEWTON, MAX_UNIT_FACTOR = {"mN": 1000.0, "gf": 101.97, "kN": 0.001}, 3.0

# Columns and their units.
COLUMNS = {"time": "s", "probe": "", "force_x": "N", "force_y": "N", "force_z": "N"}
EXPECTED = f"name a forces.csv, with the columns {', '.join(COLUMNS)}"


@dataclass(frozen=True, eq=False)
class Forces(Observation):
    """Forces [N] with independent errors of a given sigma; values of shape (rows, components), times (rows,)."""

    noun: ClassVar[str] = "forces"
    unit: ClassVar[str] = "N"
    is_independent: ClassVar[bool] = True

    sigma: float | Array

    def signal(self, scene: Scene) -> float:
        """Return the root mean square of the forces."""
        return float(np.sqrt(np.nanmean(self.values**2)))

    def fits_well(self, residuals: Array, deviation: float, signal: float) -> bool:
        limit = (observation.MAX_RESIDUAL_SHARE * signal) ** 2
        limit = max(limit, observation.MAX_RESIDUAL_SIGMAS**2 * np.mean(np.square(self.sigma)))
        return float(np.mean(residuals**2)) <= limit

    def summary(self, residuals: Array, sigma: float | Array) -> dict[str, Any]:
        return {"residual_force": root_mean_square(residuals), "sigma_force": float(np.mean(sigma))}

    def format_residual(self, residual: float) -> str:
        return f"{residual:.3g} N"

    def factor_note(self, predicted: Array) -> str:
        """Return a clause with the ratio of measured to predicted forces, or an empty string."""
        square = float(np.nansum(predicted**2 * self.known))
        factor = float(np.nansum(predicted * self.values)) / square if square else 1.0
        return f", which are {factor:.3g} times the predicted ones" if abs(factor - 1) > 0.02 else ""


class ForceModel(ObservationModel):
    """Map from a run to the forces of its tools at the measured times."""

    def __init__(self, scene: Scene, observed: ToolForces, frames: int) -> None:
        self._probe, self._time_weights = observed.probe, observation.time_weights(scene, observed.time, frames)

    def record(self, simulation: Simulation) -> Array:
        """Return the force of every probe in the current frame [N], shape (probes, 3)."""
        return np.array([tool.force for tool in simulation.forces()])

    def predict(self, recorded: Array) -> Array:
        """Return the forces of all rows [N], shape (rows, 3); `recorded`: shape (frames, probes, 3)."""
        rows, at_times = len(self._probe), self._time_weights @ recorded.reshape(len(recorded), -1)
        return np.asarray(at_times.reshape(rows, -1, 3)[np.arange(rows), self._probe])


@dataclass(frozen=True, eq=False)
class ToolForces(Forces):
    """Forces of tools on the sheet; values of shape (rows, 3), one row per time and tool."""

    probe: NDArray[np.intp]  # index of the tool, shape (rows,)

    def build_model(self, scene: Scene, frames: int) -> ForceModel:
        return ForceModel(scene, self, frames)

    def panels(self, scene: Scene, fitted: Array) -> list[Panel]:
        return [partial(plot_forces, time=self.time, probe=self.probe, fitted=fitted, observed=self.values)]

    def opposed(self, scene: Scene, *predictions: Array) -> Iterator[str]:
        for axis in observation.opposed_axes(self.values, predictions, self.sigma):
            fault = "is it the force on the tool? give the force on the sheet, of opposite sign"
            yield f"{self.name}: force_{'xyz'[axis]}: opposite to the scene's; {fault}"

    def unit_faults(self, *predictions: Array) -> Iterator[str]:
        """Yield a message if another unit explains the ratio of measured forces to all predictions."""
        ratios = [self._ratio(predicted) for predicted in predictions]
        for unit, per_newton in UNITS_PER_NEWTON.items():
            if all(1 / MAX_UNIT_FACTOR < ratio / per_newton < MAX_UNIT_FACTOR for ratio in ratios):
                fault = f"{ratios[0]:.3g} times the forces at the initial values; are they in {unit}?"
                remedy = f"divide them by {per_newton:g}" if per_newton > 1 else f"multiply them by {1 / per_newton:g}"
                yield f"{self.name}: forces: {fault} {remedy}, or take closer initial values by --set"
                return

    def _ratio(self, predictions: Array) -> float:
        """Return the ratio of measured to predicted forces, or 0 if they are small or not parallel."""
        measured, predicted = self.values[self.known], predictions[self.known]
        lengths = float(np.linalg.norm(measured)), float(np.linalg.norm(predicted))
        is_small = max(lengths) < observation.MIN_SIGMAS * self.sigma * np.sqrt(len(measured))
        if len(measured) < observation.MIN_COUNT or is_small:
            return 0.0
        is_parallel = measured @ predicted > -observation.MAX_COSINE * lengths[0] * lengths[1] > 0
        return lengths[0] / lengths[1] if is_parallel else 0.0


def read_forces(path: str | Path, sigma: float, probe_count: int) -> ToolForces:
    """Return the forces of a forces.csv; `sigma`: standard deviation of the error of a component [N]."""
    name = str(path)
    if not 0 < sigma < math.inf:
        raise SceneError([f"--forces {name},{sigma:g}: take a number above 0, the standard deviation in newtons"])
    grid = read_text(name, _is_header, EXPECTED)
    header = next((n for n, row in enumerate(grid.rows) if _is_header(row)), None)
    if header is None:
        named = [{*re.findall(r"\w+", " ".join(row).lower())} & {*COLUMNS} for row in grid.rows]
        best = max(range(len(named)), key=lambda n: len(named[n]))
        if missing := [key for key in COLUMNS if key not in named[best]]:
            raise SceneError([f"{name}: no row names {', '.join(missing)}; {EXPECTED}"])
        remedy = "give every name a cell, alone or with its unit, as time [s]"
        raise SceneError([f"{grid.place(best)}: names several columns in one cell; {remedy}"])
    names, units = map(list, zip(*_split_titles(grid.rows[header]), strict=True))
    if repeated := [key for key in COLUMNS if names.count(key) > 1]:
        fault = f"{repeated[0]}: {names.count(repeated[0])} columns of this name; leave one"
        raise SceneError([f"{grid.place(header)}: {fault}"])
    columns = [names.index(key) for key in COLUMNS]
    _require_units(grid.place(header), [units[column] for column in columns])
    rows = [n for n in range(header + 1, len(grid.rows)) if grid.has_content(n)]
    # The first row below the header may consist of units.
    row_units = [grid.cell(rows[0] if rows else None, column).strip("[]() ") for column in columns]
    if row_units[0].isalpha() and row_units[0].lower() != "nan":
        _require_units(grid.place(rows.pop(0)), row_units)
    for n in rows:
        grid.require_width(n, names)
        if (count := grid.counts[n]) < len(names):
            fault = f"{count} of {len(names)} cells, separated by {grid.separator}"
            remedy = "complete the row, with nan where not measured, or delete it"
            raise SceneError([f"{grid.place(n)}: {fault}; {remedy}"])
    cells = [(n, column) for n in rows for column in columns if column < len(grid.rows[n])]
    cells = [(n, column) for n, column in cells if grid.rows[n][column].lower() not in ("", "nan")]
    for n, column in cells:
        if grid.separator == "commas" and decimal_mark(text := grid.rows[n][column]) == ",":
            fault = "a comma within a cell, and commas between cells"
            remedy = "write thousands without commas, or separate cells by semicolons"
            raise SceneError([f"{grid.place(n)}: {grid.rows[header][column]}: {text[:40]!r}, {fault}; {remedy}"])
    table, row_index = np.full((len(rows), len(columns)), np.nan), {n: index for index, n in enumerate(rows)}
    remedy = "take a number, or leave the cell empty if not measured"
    for (n, column), (value, _) in zip(cells, grid.numbers(grid.rows[header], cells, remedy), strict=True):
        table[row_index[n], columns.index(column)] = value
    time, probe, force = table[:, 0], table[:, 1], table[:, 2:]
    for key, values in (("time", time), ("probe", probe)):
        if len(absent := np.flatnonzero(np.isnan(values))):
            raise SceneError([f"{grid.place(rows[absent[0]])}: a row without a {key}; fill it in, or delete the row"])
    if not np.isfinite(force).any():
        fault = "no force" if len(time) else "no row"
        raise SceneError([f"{name}: {fault}; {EXPECTED}, and rows of numbers"])
    for n, index in zip(rows, probe.tolist(), strict=True):
        if index not in range(probe_count):
            raise SceneError([f"{grid.place(n)}: probe: {index:g}; the scene has {probe_count}, numbered from 0"])
    _, kept = np.unique(table[:, :2], axis=0, return_index=True)
    for n in set(range(len(rows))) - set(kept.tolist()):
        raise SceneError([f"{grid.place(rows[n])}: a second row of {time[n]:g} s and probe {probe[n]:g}; leave one"])
    return ToolForces(name, time, force, sigma, probe.astype(np.intp))


def _split_titles(row: Row) -> list[tuple[str, str]]:
    """Return the names and units of columns, such as force_x [N]."""
    parts = [cell.lstrip("#% ").replace("(", "[").partition("[") for cell in row]
    return [(name.strip().lower(), unit.rstrip("]) ")) for name, _, unit in parts]


def _is_header(row: Row) -> bool:
    return len(row) >= len(COLUMNS) and {*COLUMNS} <= {name for name, _ in _split_titles(row)}


def _require_units(where: str, units: Sequence[str]) -> None:
    """Raise a SceneError unless every unit is missing, or seconds or newtons as in `COLUMNS`."""
    for (key, expected), unit in zip(COLUMNS.items(), units, strict=True):
        if unit not in (expected, "", "-", "1"):
            raise SceneError([f"{where}: {key}: unit {unit[:40]!r}; give seconds and newtons"])
