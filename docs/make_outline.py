"""Measure the opening of a hole that a mask cuts, on several meshes, for docs/outline.md.

    PYTHONPATH=. python docs/make_outline.py

Takes some seconds.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from benchmarks.marked import replace_marked, table
from tests.solver.test_hole import RADIUS, SIDE, finite_elements, opening

PAGE = Path(__file__).parent / "outline.md"

MESHES = (21, 41, 81, 161)
RADII = (0.013, 0.014, RADIUS, 0.016, 0.017)


def main() -> None:
    """Write the table of the page."""
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
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(replace_marked(page, "hole", "docs/make_outline.py", table(head, rows) + "\n"), encoding="utf-8")


if __name__ == "__main__":
    main()
