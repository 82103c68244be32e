"""A plate with a round hole, cut by a mask, that is stretched in its plane: its opening against finite elements."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from skfem import Basis, ElementQuad2, ElementVector, MeshQuad, condense, solve
from skfem.models.elasticity import linear_elasticity, plane_stress

from taichi_msm.model.rest import rest_of
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device

WIDTH, CUT = 0.08, 0.08 / 3  # of a square sheet, and length of a cut across the pull in its middle [m]
SIDE, RADIUS = 0.1, 0.015  # of the square plate and of the hole in its middle [m]
STRAIN = 1e-4  # of the plate's width, small enough for linear elasticity


def finite_elements(radius: float = RADIUS, count: int = 48) -> tuple[float, float]:
    """Return the changes of the hole's diameter along and across the pull, relative to diameter times strain.

    Plane stress with biquadratic elements in a quarter of the plate, `count` along each of its sides. The left and the
    right edge of the plate move apart and keep their length; the others are free.
    """
    # From the hole to the edge, denser at the hole.
    mesh = MeshQuad.init_tensor(np.linspace(0, np.pi / 2, count + 1), np.linspace(0, 1, count + 1) ** 1.5)
    angle, share = mesh.p
    edge = SIDE / 2 / np.maximum(np.cos(angle), np.sin(angle))
    r = radius + (edge - radius) * share
    mesh = MeshQuad(r * np.stack([np.cos(angle), np.sin(angle)]), mesh.t)
    basis = Basis(mesh, ElementVector(ElementQuad2()), intorder=5)

    def numbers(axis: int, at: float, component: int) -> NDArray[Any]:
        chosen = basis.get_dofs(lambda x: np.abs(x[axis] - at) < 1e-9)
        return np.concatenate([chosen.nodal[f"u^{component}"], chosen.facet[f"u^{component}"]])

    u = np.zeros(basis.N)
    pulled = numbers(0, SIDE / 2, 1)
    u[pulled] = SIDE / 2
    held = np.concatenate([pulled, numbers(0, SIDE / 2, 2), numbers(0, 0, 1), numbers(1, 0, 2)])
    u = solve(*condense(linear_elasticity(*plane_stress(1.0, 1 / 3)).assemble(basis), np.zeros(basis.N), x=u, D=held))
    # On the hole: the node on the axis of the pull, and the one across.
    along, across = (np.flatnonzero((share == 0) & (np.abs(angle - at) < 1e-9))[0] for at in (0, np.pi / 2))
    return float(u[basis.nodal_dofs[0, along]] / radius), float(u[basis.nodal_dofs[1, across]] / radius)


def opening(folder: Path, points: int, radius: float = RADIUS, threads: int | None = None) -> tuple[float, float]:
    """Return what `finite_elements` does, of a sheet of points x points whose hole is that of a picture in a folder.

    Damped motion, as the sheet then stays in its plane: at rest it would wrinkle where it is compressed.
    """
    middle = (np.arange(1000) + 0.5) / 1000 * SIDE - SIDE / 2
    white = np.hypot(middle, middle[:, None]) > radius
    Image.fromarray(np.where(white, 255, 0).astype(np.uint8)).save(folder / "hole.png")
    scene = Scene(
        sheet={
            "points": [points, points],
            "size": [SIDE, SIDE],
            "fixed": ["left"],
            "mask": {"image": str(folder / "hole.png")},
        },
        tissue={"young": 3e4, "thickness": 2e-3, "density": 1000, "damping": 100},
        probes=[{"clamp": "right", "path": [[0, 0, 0, 0], [0.1, STRAIN * SIDE, 0, 0]]}],
        time={"duration": 1, "frames_per_second": 1, "precision": "f64"},
        output=[],
    )
    with Simulation(scene, threads=threads) as simulation:
        rest = simulation.positions().copy()
        simulation.advance()
        u = simulation.positions() - rest
    assert not u[..., 2].any()
    mask, half = rest_of(scene.sheet).mask, points // 2
    assert mask is not None
    # The mass points of the sheet next to the hole, in the middle row and in the middle column.
    columns, rows = (np.flatnonzero(~line) for line in (mask.points[half], mask.points[:, half]))
    along = u[half, columns[-1] + 1, 0] - u[half, columns[0] - 1, 0]
    across = u[rows[0] - 1, half, 1] - u[rows[-1] + 1, half, 1]
    return float(along / (2 * radius * STRAIN)), float(across / (2 * radius * STRAIN))


def test_finite_elements_converge() -> None:
    """Half as many elements change the opening by less than 0.1 %."""
    np.testing.assert_allclose(finite_elements(count=24), finite_elements(), rtol=1e-3)


@pytest.mark.parametrize("points", [41, 81])
def test_opening_matches_finite_elements(points: int, tmp_path: Path, device: Device) -> None:
    """The outline is up to half a cell from the circle, and displacements grow with the radius."""
    half_cell = SIDE / (points - 1) / 2
    np.testing.assert_allclose(
        opening(tmp_path, points, threads=device.threads), finite_elements(), rtol=half_cell / RADIUS
    )


def gape(folder: Path, cells: int, strain: float, threads: int | None = None) -> float:
    """Return the opening of the middle of a cut, one cell wide, in a sheet of cells x cells that is stretched [m]."""
    middle, half = cells // 2, cells // 6
    white = np.full((cells, cells), 255, np.uint8)
    white[middle - half : middle + half + 1, middle] = 0
    Image.fromarray(white).save(folder / "cut.png")
    scene = Scene(
        sheet={"points": [cells + 1] * 2, "size": [WIDTH] * 2, "fixed": ["left"], "mask": str(folder / "cut.png")},
        tissue={"young": 2.46e5, "thickness": 2e-3, "density": 1100, "damping": 400},
        probes=[{"clamp": "right", "path": [[0, 0, 0, 0], [0.5, strain * WIDTH, 0, 0]]}],
        time={"duration": 2, "frames_per_second": 5, "precision": "f64"},
        output=[],
    )
    with Simulation(scene, threads=threads) as simulation:
        simulation.advance(scene.time.frames)
        lips = simulation.positions()[middle : middle + 2, middle : middle + 2, 0].mean(axis=0)
    return float(lips[1] - lips[0]) - WIDTH / cells


def test_wound_gapes_like_a_crack(tmp_path: Path, device: Device) -> None:
    # A crack of length 2 a in a wide sheet opens by 4 a times the strain. Here it is a third of the width, which adds
    # some percent, and the clamped sides, which keep their length, take some.
    assert gape(tmp_path, 27, 0.02, device.threads) == pytest.approx(4 * CUT / 2 * 0.02, rel=0.1)
