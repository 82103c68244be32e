"""Reader of measured tool forces, a forces.csv with any separator and decimal mark.

Empty cells and NaN mean "not measured"; any other cell must be a number.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from taichi_msm.errors import SceneError
from taichi_msm.fitting.forces import ToolForces
from taichi_msm.fitting.tables import Row, read_text

# Columns and their units.
COLUMNS = {"time": "s", "probe": "", "force_x": "N", "force_y": "N", "force_z": "N"}
EXPECTED = f"name a forces.csv, with the columns {', '.join(COLUMNS)}"


def read_forces(path: str | Path, sigma: float, probes: int) -> ToolForces:
    """Read a forces.csv.

    Args:
        path: the file.
        sigma: standard deviation of the error of each component [N].
        probes: number of tools of the scene.

    Raises:
        SceneError: when the file is not such a table, or refers to a missing tool.
    """
    name = str(path)
    if not 0 < sigma < math.inf:
        raise SceneError([f"--forces {name},{sigma:g}: take a number above 0, the standard deviation in newtons"])
    grid = read_text(name, _is_header, EXPECTED)
    header = next((n for n, row in enumerate(grid.rows) if _is_header(row)), None)
    if header is None:
        found = [{*re.findall(r"\w+", " ".join(row).lower())} & {*COLUMNS} for row in grid.rows]
        missing = [key for key in COLUMNS if key not in max(found, key=len)]
        raise SceneError([f"{name}: no row names {', '.join(missing)}; {EXPECTED}"])
    names, units = map(list, zip(*_titles(grid.rows[header]), strict=True))
    if repeated := [key for key in COLUMNS if names.count(key) > 1]:
        fault = f"{repeated[0]}: {names.count(repeated[0])} columns of this name; leave one"
        raise SceneError([f"{grid.place(header)}: {fault}"])
    columns = [names.index(key) for key in COLUMNS]
    _require_units(grid.place(header), [units[column] for column in columns])
    rows = [n for n in range(header + 1, len(grid.rows)) if grid.has_content(n)]
    below = grid.rows[rows[0]] if rows else []
    units = [below[column].strip("[]() ") if column < len(below) else "" for column in columns]
    if units[0].isalpha() and units[0].lower() != "nan":
        _require_units(grid.place(rows.pop(0)), units)
    for n in rows:
        grid.require_names(n, header)
    cells = [(n, column) for n in rows for column in columns if column < len(grid.rows[n])]
    cells = [(n, column) for n, column in cells if grid.rows[n][column].lower() not in ("", "nan")]
    table = np.full((len(grid.rows), len(names)), np.nan)
    remedy = "take a number, or leave the cell empty where nothing was measured"
    for cell, (value, _) in zip(cells, grid.numbers(header, cells, remedy), strict=True):
        table[cell] = value
    table = table[np.ix_(rows, columns)]
    time, probe, force = table[:, 0], table[:, 1], table[:, 2:]
    if not (np.isfinite(force).any() and np.isfinite(time).all()):
        fault = "no row" if not len(time) else "no force" if np.isfinite(time).all() else "a row without a time"
        raise SceneError([f"{name}: {fault}; {EXPECTED}, and numbers in them"])
    if unknown := [index for index in probe.tolist() if index not in range(probes)]:
        raise SceneError([f"{name}: probe: {unknown[0]:g}; the scene has {probes}, numbered from 0"])
    _, kept = np.unique(table[:, :2], axis=0, return_index=True)
    for n in set(range(len(rows))) - set(kept.tolist()):
        raise SceneError([f"{grid.place(rows[n])}: a second row of {time[n]:g} s and probe {probe[n]:g}; leave one"])
    return ToolForces(name, time, force, sigma, probe.astype(np.intp))


def _titles(row: Row) -> list[tuple[str, str]]:
    """Return the names and units of columns, such as force_x [N]."""
    parts = [cell.lstrip("#% ").replace("(", "[").partition("[") for cell in row]
    return [(name.strip().lower(), unit.rstrip("]) ")) for name, _, unit in parts]


def _is_header(row: Row) -> bool:
    return {*COLUMNS} <= {name for name, _ in _titles(row)}


def _require_units(where: str, units: Sequence[str]) -> None:
    """Check the units of the columns; SceneError: another one."""
    for (key, expected), unit in zip(COLUMNS.items(), units, strict=True):
        if unit not in (expected, "", "-", "1"):
            raise SceneError([f"{where}: {key}: unit {unit!r}; give seconds and newtons"])
