"""The NumPy reference of a sheet that is curved at rest, against closed forms."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.sparse.linalg import spsolve
from skfem import Basis, BilinearForm, ElementQuad2, ElementVector, LinearForm, MeshQuad, condense, solve

from taichi_msm.model.loads import average_loads, evaluate_frame_loads
from taichi_msm.model.plan import Plan
from taichi_msm.model.tools import solid_tools
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.tools import Probe
from taichi_msm.solver.planning import make_plan
from tests import reference
from tests.reference import surface
from tests.reference.contact import centre, lowest_point
from tests.reference.dynamics import probe_force
from tests.reference.loads import Loads, frame_loads, step_loads
from tests.reference.rough import rough_frames
from tests.reference.sheet import Sheet, highest_frequency, largest_pressure, sheet
from tests.scenes import plan_of, random_scene, random_tissue, scene, speckle

Array = NDArray[np.float64]

YOUNG, THICKNESS = 3e4, 2e-3
TISSUE = {"young": YOUNG, "thickness": THICKNESS, "density": 1050}
TUBE, DOME = {"tube": {"radius": 0.025}}, {"dome": {"radius": 0.05}}
FOLDS = {"tube": {"radius": 0.025, "folds": {"depth": 0.005, "spacing": 0.02}}}


def tissue(points: tuple[int, int], size: tuple[float, float] = (0.05, 0.05), **changes: Any) -> Scene:
    return scene(
        sheet={"points": points, "size": size, "fixed": "border"},
        tissue={**TISSUE, **changes},
        springs=None,
        damping=0,
        probes=[],
    )


def moving(points: tuple[int, int], probes: list[dict[str, Any]], **changes: Any) -> Scene:
    """A short run of tissue with tools."""
    sides = {"fixed": changes.pop("fixed", ["left"])}
    return scene(
        sheet={"points": points, "size": (0.05, 0.06), **sides},
        tissue={**TISSUE, "foundation_active": "always", "damping": 40, **changes.pop("tissue", {})},
        springs=None,
        damping=0,
        probes=probes,
        time={"duration": 0.02, "frames_per_second": 100, **changes.pop("time", {})},
        **changes,
    )


def curved(made: Scene, kind: Any) -> Sheet:
    return sheet(made, surface.rest_positions(kind, made.sheet.points, made.sheet.size))


def skewed(points: tuple[int, int], p: float, q: float, angle: float) -> Array:
    """A flat sheet of parallelograms with sides p to the right and q down [m], and an angle between them [rad]."""
    i, j = np.mgrid[: points[0], : points[1]]
    return np.stack([j * p + i * q * math.cos(angle), -i * q * math.sin(angle), 0 * i], axis=-1)


def uneven(points: tuple[int, int]) -> Array:
    """A smooth surface whose cells are neither plane nor parallelograms."""
    flat = surface.flat_positions(points, (0.05, 0.05))
    x, y = flat[..., 0], flat[..., 1]
    return flat + np.stack([2 * x * y, 3 * y**2 - 4 * x * y, 6 * x**2 - 4 * y**2 + 40 * x**3], axis=-1)


def test_heights_are_bilinear_between_pixel_centres(tmp_path: Path) -> None:
    grey = np.round(np.add.outer(3000 * np.arange(8), 4000 * np.arange(10))).astype(np.uint16)
    Image.fromarray(grey).save(tmp_path / "z.png")
    np.save(tmp_path / "z.npy", 8 * (grey / 65535))
    picture = {"height": {"file": "z.png", "range": [0, 8e-3]}}
    array = {"height": {"file": "z.npy", "unit": "mm"}}
    z = surface.rest_positions(picture, (5, 7), (0.05, 0.06), tmp_path)[..., 2]
    np.testing.assert_allclose(z, surface.rest_positions(array, (5, 7), (0.05, 0.06), tmp_path)[..., 2], atol=1e-18)
    # A linear picture of 8 x 10 pixels, constant outside the centres of its outermost ones.
    row, column = np.clip(np.linspace(0, 8, 5) - 0.5, 0, 7), np.clip(np.linspace(0, 10, 7) - 0.5, 0, 9)
    np.testing.assert_allclose(z, np.add.outer(3000 * row, 4000 * column) * 8e-3 / 65535, rtol=1e-14)


def test_tubes_and_domes_keep_their_radii() -> None:
    tube = surface.rest_positions(FOLDS, (21, 11), (0.04, 0.06))
    distance = np.hypot(tube[..., 0], tube[..., 2] - 0.025)
    # The ridges of folds are at y = 0 and multiples of the spacing, the wall is half way between.
    np.testing.assert_allclose(distance[[0, 10, 20]], 0.02, rtol=1e-14)
    np.testing.assert_allclose(distance[[5, 15]], 0.025, rtol=1e-14)
    np.testing.assert_allclose(tube[..., 1], surface.flat_positions((21, 11), (0.04, 0.06))[..., 1])
    for radius in (0.05, -0.05):
        dome = surface.rest_positions({"dome": {"radius": radius}}, (7, 9), (0.05, 0.06))
        np.testing.assert_allclose(np.linalg.norm(dome + np.array([0, 0, radius]), axis=-1), 0.05, rtol=1e-14)
        assert (dome[..., 2] * radius <= 0).all()
        # Columns and rows lie on great circles, at equal angles through the middle.
        angles = np.arctan(dome[..., 0] / (dome[..., 2] + radius))
        np.testing.assert_allclose(angles, np.tile(np.linspace(-0.03, 0.03, 9) / radius, (7, 1)), atol=1e-15)


def test_points_of_another_number_lie_on_splines(tmp_path: Path) -> None:
    """Cubic not-a-knot splines reproduce cubic polynomials."""
    u, v = np.meshgrid(np.linspace(0, 1, 9), np.linspace(0, 1, 6))
    fine_u, fine_v = np.meshgrid(np.linspace(0, 1, 14), np.linspace(0, 1, 17))

    def positions(u: Array, v: Array) -> Array:
        return np.stack([50 * u + 3 * u * v**3, -40 * v + u**3 * v, 5 * u**2 * v - 7 * v**3], axis=-1)

    np.savez(tmp_path / "wall.npz", points=positions(u, v), other=u)
    keys = {"points": {"file": tmp_path / "wall.npz", "unit": "mm"}}
    for points in (None, (6, 9)):
        np.testing.assert_array_equal(surface.rest_positions(keys, points), 1e-3 * positions(u, v))
    resampled = surface.rest_positions(keys, (17, 14))
    np.testing.assert_allclose(resampled, 1e-3 * positions(fine_u, fine_v), rtol=0, atol=1e-15)


def test_rectangles_have_the_springs_of_a_flat_sheet(tmp_path: Path) -> None:
    Image.fromarray(np.arange(48, dtype=np.uint8).reshape(6, 8) * 5).save(tmp_path / "map.png")
    changes = {
        "map": {"image": str(tmp_path / "map.png"), "range": [1, 8]},
        "foundation_map": {"image": str(tmp_path / "map.png"), "range": [2, 0.5]},
        "foundation": 2e6,
        "damping": 40,
        "pretension": 3,
    }
    made = tissue((7, 9), (0.05, 0.06), **changes)
    flat, bent = sheet(made), curved(made, None)
    for expected, actual in zip(flat.springs, bent.springs, strict=True):
        for name in ("stiffness", "length", "unstretched", "offset"):
            wanted = np.broadcast_to(getattr(expected, name), getattr(actual, name).shape)
            np.testing.assert_allclose(getattr(actual, name), wanted, rtol=1e-12, atol=1e-16)
    for name in ("mass", "drag", "virtual", "area", "normal", "rest"):
        np.testing.assert_allclose(getattr(bent, name), getattr(flat, name), rtol=1e-12, atol=1e-18)


def test_step_limit_of_rectangles_is_that_of_a_flat_sheet() -> None:
    """The step of a flat sheet follows from 2 / w; with open edges and locking tissue."""
    stiffer = {"stiffening": {"lock": 0.5, "factor": 7}, "foundation": {"young": 2e4, "depth": 0.01, "lock": 0.003}}
    for fixed, changes in (("border", {}), ("none", {"foundation": 1e6}), ("none", stiffer)):
        made = tissue((7, 9), (0.05, 0.06), foundation_active="always", **changes)
        made = made.model_copy(update={"sheet": made.sheet.model_copy(update={"fixed": fixed})})
        limit = 2 / highest_frequency(made, surface.flat_positions((7, 9), (0.05, 0.06)))
        np.testing.assert_allclose(limit, make_plan(made).stable_step, rtol=1e-12)


def test_rectangles_and_rhombi_are_isotropic() -> None:
    shapes = [(p, 1.0, math.pi / 2) for p in (0.6, 1.0, 1.7)] + [(1.0, 1.0, angle) for angle in (1.05, 1.3, 2.0)]
    for shape in shapes:
        cells = surface.cells(skewed((2, 2), *shape))
        assert not cells.clamped.any()
        assert surface.isotropy_error(cells).max() < 1e-12
    # Cells that are too long lose the springs along their sides; their diagonals alone are too stiff along them.
    long = surface.cells(skewed((2, 2), 2.5, 1.0, math.pi / 2))
    assert long.clamped.all()
    assert surface.isotropy_error(long).max() > 0.5


def test_summary_of_a_tube() -> None:
    """Rectangles of chords across and of straight sides along, with an aspect ratio above sqrt(3)."""
    measured = surface.summary(surface.rest_positions(TUBE, (5, 13), (0.04, 0.06)))
    np.testing.assert_allclose(measured.sides, [0.05 * math.sin(0.1), 0.01], rtol=1e-12)
    assert measured.clamped == 48
    np.testing.assert_allclose(measured.mean, measured.worst)


def test_poissons_ratio_of_rhombi_is_a_third() -> None:
    """A uniform plane strain of rhombi has the stress C11 = 9/8 E t, C12 = C66 = 3/8 E t at their springs."""
    rest = skewed((2, 2), 0.01, 0.01, 1.2)
    cells = surface.cells(rest)
    diagonals = cells.a + cells.b, cells.a - cells.b
    weights = cells.constants[0, 0] * [2, 2, 1, 1]
    strain = np.array([[0.3, 0.2, 0], [0.2, -0.5, 0], [0, 0, 0]])
    stress = np.zeros((3, 3))
    for weight, d in zip(weights, (cells.a, cells.b, *diagonals), strict=True):
        d = d[0, 0]
        stress += weight * (d @ strain @ d) * np.outer(d, d) / cells.area[0, 0]
    np.testing.assert_allclose(stress, 3 / 4 * strain + 3 / 8 * np.trace(strain) * np.diag([1, 1, 0]), atol=1e-12)


def pressurised(rest: Array, expected: Array, pressure: float) -> float:
    """The largest error of small displacements under pressure, relative to the largest ones expected.

    Mass points on the border have the displacements expected, and those within it are in equilibrium.
    """
    made = tissue((rest.shape[0], rest.shape[1]))
    assembled = sheet(made, rest)
    stiffness = reference.stiffness(made, 0.0, 0.0, assembled)
    inner = np.zeros((*rest.shape[:2], 3), dtype=bool)
    inner[1:-1, 1:-1] = True
    free, load = inner.ravel(), (pressure * assembled.area[..., None] * assembled.normal).ravel()
    u = expected.ravel().copy()
    u[free] = spsolve(stiffness[free][:, free], load[free] - stiffness[free][:, ~free] @ u[~free])
    return float(np.abs(u - expected.ravel()).max() / np.abs(expected).max())


def slanted_tube(n: int) -> tuple[Array, Array]:
    """A tube whose mesh lines are helices, a rhombus of them, and its displacement under 1 Pa from inside [m]."""
    radius, side, angle = 0.025, 0.05 / (n - 1), 1.2
    flat = skewed((n, n), side, side, angle)
    x, y = flat[..., 0] - flat[..., 0].mean(), flat[..., 1] - flat[..., 1].mean()
    outward = np.stack([np.sin(x / radius), 0 * x, -np.cos(x / radius)], axis=-1)
    rest = np.stack([0 * x, y, 0 * x + radius], axis=-1) + radius * outward
    # The hoop tension is the pressure times the radius; the ends are free to slide along the axis.
    strain = radius / (YOUNG * THICKNESS)
    return rest, strain * radius * outward - strain / 3 * rest * [0, 1, 0]


def conformal_cap(n: int) -> tuple[Array, Array]:
    """A spherical cap with square cells, by stereographic projection, and its displacement under 1 Pa [m]."""
    radius = 0.05
    flat = surface.flat_positions((n, n), (0.8, 0.8))
    square = (flat**2).sum(axis=-1)[..., None]
    outward = (2 * flat + (1 - square) * [0, 0, 1]) / (1 + square)
    # The tension is half the pressure times the radius along both axes, and the strain (1 - nu) / (E t) times that.
    return radius * outward, radius**2 / 3 / (YOUNG * THICKNESS) * outward


@pytest.mark.parametrize("wall", [slanted_tube, conformal_cap])
def test_pressure_in_tubes_and_caps(wall: Any) -> None:
    """Displacements under pressure converge to those of a membrane of nu = 1/3 with the square of the cells' side."""
    errors = []
    for n in (9, 17, 33):
        rest, expected = wall(n)
        # The normal of the tube's wall points to its axis, that of the cap away from the centre.
        errors.append(pressurised(rest, expected, -1 if wall is slanted_tube else 1))
    orders = np.log2(np.divide(errors[:-1], errors[1:]))
    assert errors[-1] < 1e-3
    np.testing.assert_allclose(orders, 2, atol=0.2)


def test_pressure_in_a_tube_along_the_mesh() -> None:
    """Cells are rectangles, and chords are as much strained as arcs: exact, up to the condition of the equations."""
    rest = surface.rest_positions(TUBE, (9, 13), (0.06, 0.07))
    outward = (rest - [0, 0, 0.025]) * [40, 0, 40]
    strain = 0.025 / (YOUNG * THICKNESS)
    assert pressurised(rest, strain * 0.025 * outward - strain / 3 * rest * [0, 1, 0], -1) < 1e-11


def test_dome_is_as_wrong_as_its_cells_are_anisotropic() -> None:
    """Parallelograms far from the middle of a wide dome leave an error that more points do not reduce."""
    errors = []
    for size in (0.02, 0.05):
        rest = surface.rest_positions(DOME, (17, 17), (size, size))
        expected = 0.05 / 3 / (YOUNG * THICKNESS) * (rest + np.array([0, 0, 0.05]))
        errors.append(pressurised(rest, expected, 1))
    assert errors[0] < 2e-3
    assert errors[1] < surface.isotropy_error(surface.cells(rest)).max()


@pytest.mark.parametrize("kind", [TUBE, DOME])
def test_pressure_of_the_pretension(kind: Any) -> None:
    """On a fine mesh it is S (1 / R1 + 1 / R2)."""
    made = tissue((41, 41), (0.03, 0.03), pretension=3)
    free = np.zeros((41, 41), dtype=bool)
    free[1:-1, 1:-1] = True
    expected = 3 / 0.025 if kind is TUBE else 2 * 3 / 0.05
    # The error is of the order of the square of a cell's angle, and of the dome's anisotropy.
    np.testing.assert_allclose(largest_pressure(curved(made, kind), free), expected, rtol=0.01)


def test_bound_of_a_cell_is_its_highest_eigenvalue() -> None:
    """The Laplacian of four points joined by sides and diagonals; the bound takes the stiffer of two sides."""
    rng = np.random.default_rng(2)
    for _ in range(20):
        rest, stiffness = skewed((2, 2), 1.0, *rng.uniform(0.5, 2.5, 2)), rng.exponential(size=4)
        corners = rest.reshape(4, 3)
        matrix = np.zeros((4, 4))
        for family, (start, end) in zip(
            (0, 0, 1, 1, 2, 3), ((0, 1), (2, 3), (0, 2), (1, 3), (0, 3), (1, 2)), strict=True
        ):
            ends = np.zeros(4)
            ends[[start, end]] = 1, -1
            matrix += stiffness[family] * ((corners[end] - corners[start]) ** 2).sum() * np.outer(ends, ends)
        bound = surface.stiffness_bounds(rest, stiffness[None, None])
        np.testing.assert_allclose(bound, np.linalg.eigvalsh(matrix)[-1], rtol=1e-12)


def test_places_are_bilinear_and_go_on_outside() -> None:
    """A bilinear function of across and down, at all fractions that a path may have."""
    across, down = np.meshgrid(np.linspace(0, 1, 5), np.linspace(0, 1, 4))

    def values(u: Any, v: Any) -> Array:
        return np.stack([1 + u - 2 * v, u * v, 3 * v], axis=-1)

    for u, v in ((0.3, 0.7), (0, 1), (1, 0), (1, 1), (-1, 0.5), (2, -1), (0.4, 2)):
        np.testing.assert_allclose(surface.at_fractions(values(across, down), u, v), values(u, v), atol=1e-14)


def test_frequencies_are_below_the_bound() -> None:
    """The largest eigenvalue of the stiffness over the masses, of clamped and of skew cells."""
    for rest in (surface.rest_positions(FOLDS, (9, 7), (0.04, 0.06)), uneven((8, 9))):
        points = (rest.shape[0], rest.shape[1])
        made = tissue(points, foundation=1e6)
        assembled = sheet(made, rest)
        inverse = np.repeat(assembled.mass.ravel() ** -0.5, 3)
        matrix = inverse[:, None] * reference.stiffness(made, 0.0, 1.0, assembled).toarray() * inverse
        highest, bound = math.sqrt(float(np.linalg.eigvalsh(matrix).max())), highest_frequency(made, rest)
        assert 0.6 * bound < highest < bound


@pytest.mark.parametrize("kind", [FOLDS, DOME, "uneven"])
def test_forces_under_pretension(kind: Any) -> None:
    """The sum of (k - tau) (1 - |o| / |o + q|) (o + q) + tau q, which is 0 at rest."""
    made = tissue((9, 8), (0.04, 0.06), pretension=20)
    assembled = sheet(made, uneven((9, 8))) if kind == "uneven" else curved(made, kind)
    u = np.random.default_rng(3).uniform(-1e-3, 1e-3, (9, 8, 3))
    force, scale = np.zeros((9, 8, 3)), 0.0
    stretch = 20 / (1.5 * YOUNG * THICKNESS)
    for springs in assembled.springs:
        o, q = assembled.rest[springs.end] - assembled.rest[springs.start], u[springs.end] - u[springs.start]
        ratio = np.linalg.norm(o, axis=-1) / np.linalg.norm(o + q, axis=-1)
        # Without a map, tau is the same share of k in all springs.
        k = springs.stiffness[..., None]
        pull = k * ((1 - stretch) * (1 - ratio[..., None]) * (o + q) + stretch * q)
        force[springs.start] += pull
        force[springs.end] -= pull
        scale = max(scale, float(np.abs(k * o).max()))
    # Eight springs, whose forces are differences of terms of the size of k |o|.
    np.testing.assert_allclose(reference.elastic_force(made, u, assembled), force, rtol=0, atol=2e-15 * 8 * scale)
    assert np.abs(reference.elastic_force(made, 0 * u, assembled)).max() <= 2e-15 * 8 * scale


def test_rigid_motions_are_free_of_force() -> None:
    made = tissue((9, 8), (0.04, 0.06), stiffening={"lock": 0.3})
    assembled = curved(made, FOLDS)
    angle = 0.7
    turn = np.array([[math.cos(angle), 0, math.sin(angle)], [0, 1, 0], [-math.sin(angle), 0, math.cos(angle)]])
    u = assembled.rest @ turn.T + [0.01, -0.02, 0.03] - assembled.rest
    scale = max(float((springs.stiffness * springs.length).max()) for springs in assembled.springs)
    assert np.abs(reference.elastic_force(made, u, assembled)).max() < 1e-14 * scale
    assert abs(reference.energy(made, u, assembled)) < 1e-14 * scale * 0.01


@pytest.mark.parametrize("kind", [FOLDS, DOME, "uneven"])
def test_force_is_the_slope_of_the_energy(kind: Any) -> None:
    made = tissue((6, 7), (0.04, 0.06), pretension=5, stiffening={"lock": 0.3})
    assembled = sheet(made, uneven((6, 7))) if kind == "uneven" else curved(made, kind)
    rng = np.random.default_rng(7)
    u, direction, d = rng.uniform(-1e-3, 1e-3, (6, 7, 3)), rng.uniform(-1, 1, (6, 7, 3)), 1e-7
    after, before = (reference.energy(made, u + sign * d * direction, assembled) for sign in (1, -1))
    slope = (after - before) / (2 * d)
    # The error of the difference is d^2 / 6 times the third derivative, with lengths of 1e-3 and above.
    np.testing.assert_allclose(-(reference.elastic_force(made, u, assembled) * direction).sum(), slope, rtol=1e-6)


@pytest.mark.parametrize("seed", range(6))
def test_loads_and_forces_of_flat_sheets(seed: int, tmp_path: Path) -> None:
    """Loads in fractions of the sheet, and forces in space, against those in the plane; jumps are in some seeds."""
    Image.fromarray(speckle(6, 7)[..., 0]).save(tmp_path / "grey.png")
    made = random_tissue(seed, str(tmp_path / "grey.png")) if seed % 2 else random_scene(seed)
    plan = plan_of(made)
    bent, flat = sheet(made, surface.flat_positions(made.sheet.points, made.sheet.size)), sheet(made)
    schedules: list[tuple[Loads, Any]] = [(step_loads(plan), average_loads(plan, 0, plan.grid.steps))]
    schedules += [(frame_loads(plan, n), evaluate_frame_loads(plan, n)) for n in range(plan.grid.frames + 1)]
    for loads, schedule in schedules:
        np.testing.assert_allclose(loads.active, schedule.active, rtol=0, atol=1e-9)
        forces = np.array([reference.surgical_force(made, schedule, n, flat) for n in range(len(schedule.active))])
        for n, force in enumerate(forces):
            actual = reference.surgical_force(made, loads, n, bent)
            np.testing.assert_allclose(actual, force, rtol=0, atol=1e-9 * np.abs(forces).max())


def motion(plan: Plan, assembled: Sheet | None = None) -> tuple[Array, Array]:
    """Displacements of all steps [m], and forces of all tools on the mass points [N]."""
    u, contacts = zip(
        *((u.copy(), contact.force.copy()) for u, contact in reference.steps(plan, assembled)), strict=True
    )
    return np.array(u), np.array(contacts)


ROD = {"radius": 0.006, "shaft": [0.3, -0.5, 1], "length": 0.1}
DRAG = {
    "path": [[0, 0.55, 0.4, 0.0005], [0.01, 0.5, 0.45, -0.004], [0.02, 0.7, 0.5, -0.003]],
    "instrument": ROD,
    "friction": 0.3,
}
GRIP = {"path": [[0, 0.7, 0.7, 0.0005], [0.02, 0.75, 0.6, 0.006]], "instrument": ROD, "grip": [[0.003, 0.015]]}
CLAMP = {"clamp": "right", "path": [[0, 0, 0, 0], [0.02, 0.003, 0, 0.002]]}
PUSH = {"at": [[0, 0.4, 0.4], [0.015, 0.6, 0.7]], "radius": 0.005, "falloff": 300, "load": [[0, 0], [0.01, 100]]}
LOCKS = {"stiffening": {"lock": 0.3}, "foundation": {"young": 2e4, "depth": 0.01, "lock": 0.003}}
RELAXING = {"foundation": 1e6, "relaxation": [{"share": 0.5, "time": 0.01}]}
MOTIONS: dict[str, Scene] = {
    "linear": moving((9, 11), [{**PUSH, "total": [0.1, 0.2, -0.9]}], tissue={"foundation": 1e6}),
    "locks": moving((9, 11), [{**PUSH, "total": [0, 0, -2.0]}, CLAMP], tissue=LOCKS),
    "contact": moving((11, 13), [DRAG, GRIP], tissue={"foundation": 1e6}),
    "backward": moving((9, 11), [DRAG], tissue=LOCKS, time={"damping_difference": "backward"}),
    "relaxing": moving((9, 11), [DRAG], tissue=RELAXING),
    "tense": moving((9, 11), [{**PUSH, "total": [0, 0, -3]}], tissue={"pretension": 8, **LOCKS}, fixed="border"),
}
TURN = np.linalg.qr(np.random.default_rng(1).normal(size=(3, 3)))[0]
TURN = TURN * np.linalg.det(TURN)


def turned(probe: dict[str, Any]) -> dict[str, Any]:
    """A tool in world axes, turned with the sheet; heights are along the normal as they are."""
    changed = dict(probe)
    if "instrument" in probe:
        changed["instrument"] = {**probe["instrument"], "shaft": (TURN @ probe["instrument"]["shaft"]).tolist()}
    if "clamp" in probe:
        changed["path"] = [[t, *(TURN @ u).tolist()] for t, *u in probe["path"]]
    if "total" in probe:
        changed["total"] = (TURN @ probe["total"]).tolist()
    return changed


@pytest.mark.parametrize("name", list(MOTIONS))
def test_motion_of_flat_and_turned_surfaces(name: str) -> None:
    """A flat surface anywhere in space moves as a flat sheet, turned with its foundation and its tools."""
    made = MOTIONS[name]
    probes = [turned(probe.model_dump(mode="json", exclude_defaults=True)) for probe in made.probes]
    made_turned = Scene.model_validate({**made.model_dump(exclude_defaults=True), "probes": probes})
    plan, plan_turned = plan_of(made), plan_of(made_turned)
    rest = surface.flat_positions(made.sheet.points, made.sheet.size)
    expected, flat = motion(plan), motion(plan, sheet(made, rest))
    away = motion(plan_turned, sheet(made_turned, rest @ TURN.T + [0.3, -0.2, 0.5]))
    assert np.abs(expected[0]).max() > 1e-3
    for wanted, found, found_turned in zip(expected, flat, away, strict=True):
        # A rounding per step, amplified by the number of steps; far from the origin, of a larger number.
        atol = 1e-13 * plan.grid.steps * np.abs(wanted).max(initial=1e-300)
        np.testing.assert_allclose(found, wanted, rtol=0, atol=atol)
        np.testing.assert_allclose(found_turned @ TURN, wanted, rtol=0, atol=10 * atol)


def test_numbers_act_along_the_normal() -> None:
    shape: dict[str, Any] = {"radius": 0.004, "falloff": 600.0}
    along, tool = (Probe.model_construct(total=total, **shape) for total in (-2.0, (0.0, 0.0, -2.0)))
    made = tissue((31, 31), (0.06, 0.06))
    dome = curved(made, DOME)
    force = probe_force(along, dome, 0.3, 0.6).sum(axis=(0, 1))
    normal = (surface.at_fractions(dome.rest, 0.3, 0.6) + np.array([0, 0, 0.05])) / 0.05
    # Normals of a mesh are off by the square of half a cell's angle; the tool is as wide as some cells, and so the sum
    # over mass points as right as that.
    np.testing.assert_allclose(force, -2 * normal, atol=0.05)
    np.testing.assert_allclose(np.cross(force, normal), 0, atol=2 * 0.02**2)
    plane = sheet(made, surface.flat_positions((31, 31), (0.06, 0.06)) @ TURN.T)
    wanted = probe_force(tool, curved(made, None), 0.5, 0.4)
    np.testing.assert_allclose(probe_force(along, plane, 0.5, 0.4) @ TURN, wanted, rtol=0, atol=1e-12)


def test_paths_follow_the_surface() -> None:
    """A rod and a plate over a dome: at mass points, half way along a straight path, and outside the sheet."""
    shaft, path = [0.6, 0.0, 0.8], [[0, 0.25, 0.5, 0.01], [0.02, 0.75, 0.5, 0.03], [1, 1.25, 0.5, 0.03]]
    for instrument, is_plate in (({"radius": 0.004}, False), ({"plate": 0.004}, True)):
        rod = {"path": path, "instrument": {**instrument, "shaft": shaft, "length": 0.1}}
        made = moving((9, 9), [rod])
        dome, tool = curved(made, DOME), solid_tools(plan_of(made).tools)[0]
        for time, j, height in ((0.0, 2, 0.01), (0.01, 4, 0.02), (0.02, 6, 0.03)):
            normal = dome.normal[4, j]
            tip = np.linalg.norm(np.cross(shaft, normal)) if is_plate else 1
            wanted = dome.rest[4, j] + (height + 0.004 * tip) * normal
            np.testing.assert_allclose(centre(made, tool, time, dome), wanted, rtol=0, atol=1e-15)
        # Two columns beyond the right side, positions and normals of the last cell go on.
        normal = 3 * dome.normal[4, 8] - 2 * dome.normal[4, 7]
        wanted = 3 * dome.rest[4, 8] - 2 * dome.rest[4, 7] + 0.03 * normal / np.linalg.norm(normal)
        np.testing.assert_allclose(lowest_point(made, tool, 2.0, dome)[0], wanted, rtol=0, atol=1e-15)


def test_tangent_is_the_slope_of_the_force() -> None:
    made = tissue((6, 7), (0.04, 0.06), pretension=5, **LOCKS)
    assembled = sheet(made, uneven((6, 7)))
    rng = np.random.default_rng(7)
    u, direction, d = rng.uniform(-4e-3, 4e-3, (6, 7, 3)), rng.uniform(-1, 1, (6, 7, 3)), 1e-9
    after, before = (
        reference.elastic_force(made, v, assembled) + reference.foundation_force(made, v, assembled)
        for v in (u + d * direction, u - d * direction)
    )
    tangent = reference.tangent(made, u, direction, 1.0, assembled)
    np.testing.assert_allclose(tangent, (after - before) / (2 * d), rtol=0, atol=1e-5 * np.abs(tangent).max())


def test_equilibrium_of_a_dome_that_locks() -> None:
    """A load off the middle; sheet and foundation are stretched and pressed far into their laws."""
    push = {"total": [0, 0, -1.5], "at": [0.4, 0.6], "radius": 0.004, "falloff": 300}
    made = moving((11, 11), [push], tissue=LOCKS, fixed="border", time={"motion": "quasistatic", "precision": "auto"})
    plan, dome = plan_of(made), curved(made, {"dome": {"radius": 0.04}})
    loads = frame_loads(plan, 1)
    u = reference.equilibrium(plan, loads, np.zeros((11, 11, 3)), assembled=dome)
    # Where the slope of the foundation's law has grown to at least 4, half of the depth that locks.
    assert -(u * dome.normal).sum(axis=-1).min() > 0.0015
    assert reference.residual(made, u, loads, ~plan.fixed, dome) < 1e-12


def dome_of_elements(probe: Probe, at: tuple[float, float], foundation: float, n: int) -> float:
    """Work of a small load on a dome on a foundation [J]: quadratic elements on the exact surface, in plane stress."""
    size = radius = 0.05

    def place(x: Any, y: Any) -> Array:
        ray = np.stack([np.tan(x / radius), np.tan(y / radius), 1 + 0 * x])
        return radius * ray / np.sqrt((ray**2).sum(axis=0))

    def frame(x: Array, y: Array) -> tuple[Array, ...]:
        """Orthonormal axes e1, e2 of the tangent plane, and p, c, q: g_x = p e1, g_y = c e1 + q e2."""
        d = 1e-9 * 1j
        g_x, g_y = place(x + d, y).imag / 1e-9, place(x, y + d).imag / 1e-9
        p = np.sqrt((g_x**2).sum(axis=0))
        c = (g_x * g_y).sum(axis=0) / p
        rest = g_y - c * g_x / p
        q = np.sqrt((rest**2).sum(axis=0))
        return g_x / p, rest / q, p, c, q

    def strains(u: Any, e1: Array, e2: Array, p: Array, c: Array, q: Array) -> tuple[Array, Array, Array]:
        d1, d2 = u.grad[:, 0] / p, u.grad[:, 1] / q - u.grad[:, 0] * c / (p * q)
        shear = (e1 * d2 + e2 * d1).sum(axis=0) / 2
        return (e1 * d1).sum(axis=0), (e2 * d2).sum(axis=0), shear

    @BilinearForm  # type: ignore[untyped-decorator]
    def form(u: Any, v: Any, w: Any) -> Any:
        axes = frame(*w.x)
        (u1, u2, u12), (v1, v2, v12) = strains(u, *axes), strains(v, *axes)
        membrane = YOUNG * THICKNESS * (9 / 8 * (u1 * v1 + u2 * v2) + 3 / 8 * (u1 * v2 + u2 * v1 + 4 * u12 * v12))
        return axes[2] * axes[4] * (membrane + foundation * (u * v).sum(axis=0))

    middle = place(np.array((at[0] - 0.5) * size), np.array((0.5 - at[1]) * size))
    reach = 1 / probe.falloff
    integral = math.pi * probe.radius**2 + 2 * math.pi * (probe.radius * reach + reach**2)

    @LinearForm  # type: ignore[untyped-decorator]
    def load(v: Any, w: Any) -> Any:
        _, _, p, _, q = frame(*w.x)
        distance = np.sqrt(((place(*w.x) - middle[:, None, None]) ** 2).sum(axis=0))
        decay = np.exp(-probe.falloff * np.maximum(distance - probe.radius, 0))
        return p * q * decay / integral * sum(force * v[axis] for axis, force in enumerate(np.array(probe.total)))

    lines = np.linspace(-size / 2, size / 2, n + 1)
    basis = Basis(MeshQuad.init_tensor(lines, lines), ElementVector(ElementQuad2(), 3), intorder=6)
    forces = load.assemble(basis)
    return float(forces @ solve(*condense(form.assemble(basis), forces, D=basis.get_dofs())))


def test_rough_tool_on_a_turned_surface() -> None:
    """A ball that presses and drags; mass points stick to it."""
    path = [[0, 0.5, 0.5, 0.0001], [1, 0.5, 0.5, -0.006], [2, 0.55, 0.45, -0.004]]
    ball = {"path": path, "instrument": {**ROD, "radius": 0.02}, "friction": "rough"}
    time = {"motion": "quasistatic", "precision": "auto", "duration": 2, "frames_per_second": 1}
    made, away = (
        moving((7, 7), [probe], tissue={"foundation": 1e6}, fixed="border", time=time) for probe in (ball, turned(ball))
    )
    rest = surface.flat_positions((7, 7), made.sheet.size)
    expected = rough_frames(plan_of(made), np.zeros((7, 7, 3)))
    actual = rough_frames(plan_of(away), np.zeros((7, 7, 3)), sheet(away, rest @ TURN.T))
    for (u, force, stuck), (found, found_force, found_stuck) in zip(expected, actual, strict=True):
        assert stuck.sum() >= 4
        np.testing.assert_array_equal(found_stuck, stuck)
        # Both end with Newton's method.
        np.testing.assert_allclose(found @ TURN, u, rtol=0, atol=1e-10 * np.abs(u).max())
        np.testing.assert_allclose(TURN.T @ found_force, force, rtol=0, atol=1e-9 * np.abs(force).max())


def dome_errors(counts: Sequence[int]) -> Array:
    """Relative errors of the work of a load on a dome, pressed off its middle along the normal, on a foundation."""
    at, foundation, work = (0.35, 0.6), 1e5, []
    for points in counts:
        made = tissue((points, points), foundation=foundation)
        dome = curved(made, DOME)
        along = surface.at_fractions(dome.rest, *at) + np.array([0, 0, 0.05])
        probe = Probe.model_construct(total=tuple(-along / np.linalg.norm(along)), radius=0.008, falloff=300.0)
        force, free = probe_force(probe, dome, *at).ravel(), np.repeat(~plan_of(made).fixed, 3)
        stiffness = reference.stiffness(made, 0.0, 1.0, dome)[free][:, free]
        work.append(float(force[free] @ spsolve(stiffness, force[free])))
    # The elements are within 0.01 %: 0.0115609 J with 32 a side, 0.0115602 J with 48.
    return np.asarray(np.array(work) / dome_of_elements(probe, at, foundation, 32) - 1)


@pytest.mark.slow
def test_dome_matches_finite_elements() -> None:
    np.testing.assert_array_less(np.abs(dome_errors((17, 33, 65))), [0.01, 0.002, 0.001])
