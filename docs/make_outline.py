"""Measure the openings of a wound and of a hole that a mask cuts, on several meshes, for docs/outline.md.

    PYTHONPATH=. python docs/make_outline.py

Takes some minutes.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.marked import replace_marked, table
from tests.solver.test_hole import CUT, RADIUS, SIDE, finite_elements, gape, opening

PAGE = Path(__file__).parent / "outline.md"

MESHES = (21, 41, 81, 161)
RADII = (0.013, 0.014, RADIUS, 0.016, 0.017)


# Cells along a side, of which the cut is a third long, and strains of the sheet.
CELLS, STRAINS = (27, 81, 243), (0.02, 0.05, 0.1)


def gapes() -> str:
    """Return the table of the gape of a wound [mm]."""
    rows = []
    with TemporaryDirectory() as name:
        for cells in CELLS:
            gaps = [1000 * gape(Path(name), cells, strain) for strain in STRAINS]
            rows.append([f"{cells + 1} x {cells + 1}", *(f"{gap:.2f} mm" for gap in gaps)])
    rows.append(["a crack in a wide sheet", *(f"{1000 * 4 * CUT / 2 * strain:.2f} mm" for strain in STRAINS)])
    return table(["points", *(f"strain {100 * strain:.0f} %" for strain in STRAINS)], rows)


def holes() -> str:
    """Return the table of the errors of a hole's opening."""
    expected, rows = {radius: np.array(finite_elements(radius)) for radius in RADII}, []
    with TemporaryDirectory() as name:
        for points in MESHES:
            errors = [100 * (opening(Path(name), points, radius) / expected[radius] - 1) for radius in RADII]
            rows.append(
                [
                    f"{points} x {points}",
                    f"{2 * RADIUS / SIDE * (points - 1):.0f}",
                    *(f"{error:+.1f} %" for error in errors[RADII.index(RADIUS)]),
                    *(f"{error:.1f} %" for error in np.abs(errors).max(axis=0)),
                ]
            )
    head = ["points", "cells across the hole", "along", "across", "along, largest", "across, largest"]
    return table(head, rows)


def main() -> None:
    """Write the tables of the page."""
    page = PAGE.read_text(encoding="utf-8")
    for part, text in (("gape", gapes()), ("hole", holes())):
        page = replace_marked(page, part, "docs/make_outline.py", text + "\n")
    PAGE.write_text(page, encoding="utf-8")


if __name__ == "__main__":
    main()
