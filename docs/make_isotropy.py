"""Measure the effect of the isotropy error of sheared cells on stretch and indentation, for docs/surfaces.md.

    PYTHONPATH=. python docs/make_isotropy.py

Takes some seconds.
"""

from __future__ import annotations

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import brentq

from benchmarks.marked import replace_marked, table
from taichi_msm import Scene, Simulation
from taichi_msm.model.cells import Cells, cell_stiffness, isotropy_errors

Floats = NDArray[np.float64]

PAGE = Path(__file__).parent / "surfaces.md"

ROWS, COLS = 71, 99
WIDTH, HEIGHT = 0.1, 0.1  # [m]; cells are 1.4 times as high as wide
ERRORS = (0.1, 0.3, 0.5)

# The tissue and the tool of scenes/press.yaml without pretension, at rest; pressed, and pulled sideways.
TISSUE = {"young": 3e4, "thickness": 3e-3, "foundation": 3e5, "foundation_active": "always"}
PRESS, PULL = 2.0, 1.0  # [N]
FORCES = {f"depth under {PRESS:g} N": [(0.0, 0.0, -PRESS)]}
FORCES[f"displacement by {PULL:g} N sideways"] = [
    (PULL * float(np.cos(angle)), PULL * float(np.sin(angle)), 0.0) for angle in np.radians([0, 45, 90, 135])
]


def sheared_grid(shear: float) -> Floats:
    """Return positions [m], shape (ROWS, COLS, 3), of a sheet whose columns lean by `shear` = tan(angle)."""
    x, y = np.meshgrid(np.linspace(-WIDTH / 2, WIDTH / 2, COLS), np.linspace(HEIGHT / 2, -HEIGHT / 2, ROWS))
    return np.stack([x + shear * y, y, np.zeros_like(x)], axis=-1)


def isotropy_error(shear: float) -> float:
    """Return the isotropy error of the cells of a sheared grid."""
    return float(isotropy_errors(Cells.of(sheared_grid(shear)))[0, 0])


def moduli(shear: float) -> Floats:
    """Return Young's modulus of a sheared grid in 180 directions, as a fraction of that of its tissue."""
    cells = Cells.of(sheared_grid(shear))
    k, a, b = cell_stiffness(cells, 1.0), cells.a[0, 0, :2], cells.b[0, 0, :2]
    stiffness = np.zeros((3, 3))
    for value, (x, y) in ((2 * k.along_a, a), (2 * k.along_b, b), (k.falling, a + b), (k.rising, a - b)):
        bond = np.array([x * x, y * y, x * y])
        stiffness += value[0, 0] / cells.area[0, 0] * np.outer(bond, bond)
    angles = np.radians(np.arange(180))
    stress = np.stack([np.cos(angles) ** 2, np.sin(angles) ** 2, np.cos(angles) * np.sin(angles)])
    return 1 / np.einsum("in,ij,jn->n", stress, np.linalg.inv(stiffness), stress)


def displacement(shear: float, force: tuple[float, float, float], folder: Path) -> float:
    """Return the displacement of the middle along a force [m]."""
    file = folder / "grid.npy"
    np.save(file, sheared_grid(shear))
    scene = Scene(
        sheet={"surface": {"points": {"file": str(file), "unit": "m"}}},
        tissue=TISSUE,
        probes=[{"at": [0.5, 0.5], "total": force, "radius": 0.005, "falloff": 300}],
        time={"duration": 1, "frames_per_second": 1, "motion": "quasistatic"},
        output=[],
    )
    with Simulation(scene) as simulation:
        simulation.advance(1)
        moved = simulation.positions()[ROWS // 2, COLS // 2] - sheared_grid(shear)[ROWS // 2, COLS // 2]
    return float(moved @ force / np.linalg.norm(force))


def main() -> None:
    """Write the table of the page."""
    rows = []
    with TemporaryDirectory() as name:
        folder = Path(name)
        right = {force: displacement(0.0, force, folder) for forces in FORCES.values() for force in forces}
        for error in ERRORS:
            # A little less, as a scene with larger errors is refused.
            shear = brentq(lambda s, e=error: isotropy_error(s) - e, 0.0, 0.6) * (1 - 1e-9)
            modulus = [f"{100 * (value - 1):+.0f} %" for value in (moduli(shear).min(), moduli(shear).max())]
            cells = [f"{error:g}", f"{90 - np.degrees(np.arctan(shear)):.0f}°", " to ".join(modulus)]
            for forces in FORCES.values():
                changes = [displacement(shear, force, folder) / right[force] - 1 for force in forces]
                cells.append(f"{100 * max(changes, key=abs):+.1f} %")
            rows.append(cells)
    head = ["isotropy error", "angle of the sides", "Young's modulus, by direction", *FORCES]
    page = PAGE.read_text(encoding="utf-8")
    PAGE.write_text(
        replace_marked(page, "isotropy", "docs/make_isotropy.py", table(head, rows) + "\n"), encoding="utf-8"
    )


if __name__ == "__main__":
    main()
