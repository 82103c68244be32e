"""Tissue against closed forms: plane stress, plates, membranes, conservation laws, frequencies.

Static shapes come from the linear stiffness of the twin; they must be equilibria of the kernel.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy import sparse
from scipy.integrate import quad
from scipy.sparse.linalg import eigsh, spsolve
from skfem import Basis, BilinearForm, ElementQuad2, ElementVector, LinearForm, MeshQuad, condense, solve
from skfem.helpers import dot
from skfem.models.elasticity import linear_elasticity, plane_stress

from taichi_msm.model.loads import evaluate_loads
from taichi_msm.model.sheet import fixed_points, rest_positions, spacing
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.tools import Probe
from taichi_msm.solver.state import State
from taichi_msm.system.runtime import Device
from taichi_msm.terms import highest_frequency
from taichi_msm.terms.elasticity import energy_density
from tests import reference
from tests.motion import dynamics_of
from tests.reference.sheet import sheet as assembled
from tests.scenes import plan_of, random_tissue, speckle
from tests.scenes import scene as scene_of_springs

Array = NDArray[np.float64]

YOUNG, THICKNESS, DENSITY = 3e4, 2e-3, 1050.0
MEMBRANE = YOUNG * THICKNESS
PLATE = YOUNG * THICKNESS**3 / (12 * (1 - 1 / 9))

# Mass points along each side; those of the coarsest sheet are among those of the finer ones.
MESHES = (31, 61, 121)

# Decays over half of the sheet. The force is not smooth at the control point, so its sum has an error of order 3, which
# would hide order 2 for a narrow tool.
WIDE = {"at": [0.4, 0.6], "falloff": 20}

# A flat end that covers the sheet with uniform pressure.
EVERYWHERE = {"falloff": 100, "radius": 0.2}


def tissue(
    points: tuple[int, int],
    size: tuple[float, float] = (0.1, 0.1),
    fixed: Any = "border",
    probes: Any = (),
    time: Any = None,
    **terms: Any,
) -> Scene:
    """A sheet of tissue in f64 without output."""
    return Scene(
        sheet={"points": points, "size": size, "fixed": fixed},
        tissue={"young": YOUNG, "thickness": THICKNESS, "density": DENSITY, **terms},
        probes=probes,
        time={"duration": 0.4, "precision": "f64", **(time or {})},
        output=[],
    )


def picture(folder: Path) -> str:
    """Write a map of random grey values."""
    Image.fromarray(speckle(7, 5)[..., 0]).save(folder / "map.png")
    return str(folder / "map.png")


def moving(made: Scene, directions: tuple[int, ...] = (0, 1, 2)) -> NDArray[np.intp]:
    """Indices of the displacements of moving mass points in some directions."""
    chosen = np.zeros((*made.sheet.points, 3), bool)
    chosen[..., directions] = ~fixed_points(made.sheet)[..., None]
    return np.flatnonzero(chosen)


def tool_forces(made: Scene, time: float = 0.01) -> Array:
    return reference.surgical_force(made, evaluate_loads(plan_of(made), np.array([time])), 0)


def at_rest(made: Scene, directions: tuple[int, ...]) -> Array:
    """Static displacements in some directions under a small load [m], shape (rows, cols, 3)."""
    free, u = moving(made, directions), np.zeros((*made.sheet.points, 3))
    u.ravel()[free] = spsolve(reference.stiffness(made)[free][:, free], tool_forces(made).ravel()[free])
    return u


def assert_equilibrium(made: Scene, displacement: Array, directions: tuple[int, ...], device: Device) -> None:
    """A step of the kernel from static displacements moves the sheet by less than 1e-5 of a step from rest."""
    dynamics = dynamics_of(made, device)
    dynamics.advance(1)
    from_rest = np.abs(dynamics.state().difference).max()
    dynamics.restart(plan_of(made), State(1, displacement, np.zeros_like(displacement)))
    dynamics.advance(1)
    # Strains of up to 1e-6 leave nonlinear forces.
    assert np.abs(dynamics.state().difference[..., directions]).max() < 1e-5 * from_rest


def relative_error(expected: Array, displacement: Array) -> float:
    """Relative error at the mass points of the coarsest sheet, of root mean squares."""
    every = (len(displacement) - 1) // (len(expected) - 1)
    return float(np.linalg.norm(displacement[::every, ::every] - expected) / np.linalg.norm(expected))


def order(errors: list[float]) -> float:
    """The order of convergence in the size of the cells."""
    return -float(np.polyfit(np.log2([points - 1 for points in MESHES]), np.log2(errors), 1)[0])


def weight(probe: Probe) -> float:
    """The integral of a tool's decay over the plane [m2]."""

    def ring(distance: float) -> float:
        return 2 * math.pi * distance * math.exp(-probe.falloff * max(distance - probe.radius, 0))

    flat, around = (quad(ring, *ends, epsabs=0)[0] for ends in ((0, probe.radius), (probe.radius, math.inf)))
    return float(flat + around)


def pressure(made: Scene, x: Array, y: Array) -> Array:
    """Pressure of the first tool at places of the sheet [Pa], shape (3, ...)."""
    (height, width), probe = made.sheet.size, made.probes[0]
    across, down = np.array(probe.at, float)
    distance = np.hypot(x - (across - 0.5) * width, y - (0.5 - down) * height)
    decay = np.exp(-probe.falloff * np.maximum(distance - probe.radius, 0))
    return np.multiply.outer(np.array(probe.total, float), decay) / weight(probe)


@pytest.mark.parametrize("ratio", [1.0, 1.2, 1 / 1.5, math.sqrt(3), 1 / math.sqrt(3)])
def test_energy_of_uniform_strains(ratio: float, device: Device) -> None:
    made = tissue((5, 6), size=(4 * 0.01, 5 * 0.01 * ratio), fixed="none")
    x, y = rest_positions(made.sheet)[..., 0], rest_positions(made.sheet)[..., 1]
    zero, area = np.zeros_like(x), math.prod(made.sheet.size)
    modes = [np.stack(mode, axis=-1) for mode in ([x, zero, zero], [zero, y, zero], [y / 2, x / 2, zero])]
    flat = np.array(modes).reshape(3, -1)
    moduli = flat @ (reference.stiffness(made) @ flat.T) / area
    expected = MEMBRANE * np.array([[9, 3, 0], [3, 9, 0], [0, 0, 3]]) / 8
    # Sums over some 100 springs.
    np.testing.assert_allclose(moduli, expected, rtol=0, atol=1e-13 * MEMBRANE)
    # The energies of the twin and of the kernel deviate by the third power of the strain.
    strain, dynamics = 1e-5, dynamics_of(made, device)
    for n, mode in enumerate(modes):
        density = expected[n, n] * strain**2 / 2
        assert reference.energy(made, strain * mode) / area == pytest.approx(density, rel=10 * strain)
        # Also at edges and corners, whose mass points have fewer springs and less area.
        uniform = np.full(made.sheet.points, density)
        np.testing.assert_allclose(energy_density(plan_of(made), strain * mode), uniform, rtol=10 * strain)
        dynamics.restart(plan_of(made), State(1, strain * mode, np.zeros_like(mode)))
        assert dynamics.read().energy / area == pytest.approx(density, rel=10 * strain)


def test_pretension_is_isotropic_and_uniform(tmp_path: Path) -> None:
    """With any map, the sum of o o^T tau over the springs is S times the area, and moving mass points are balanced."""
    stiff = {"image": picture(tmp_path), "range": [0.5, 4]}
    made = tissue((8, 6), size=(0.07, 0.06), pretension=12.5, map=stiff)
    stress, force = np.zeros((3, 3)), np.zeros((8, 6, 3))
    for springs in assembled(made).springs:
        tension = springs.stiffness * (springs.length - springs.unstretched) / springs.length
        stress += tension.sum() * np.outer(springs.offset, springs.offset)
        force[springs.start] += tension[..., None] * springs.offset
        force[springs.end] -= tension[..., None] * springs.offset
    expected = 12.5 * np.diag([1, 1, 0])
    np.testing.assert_allclose(stress / math.prod(made.sheet.size), expected, rtol=0, atol=1e-13 * 12.5)
    assert np.abs(force[1:-1, 1:-1]).max() < 1e-13 * np.abs(force).max()


def finite_elements(made: Scene) -> Array:
    """Plane stress with biquadratic elements, half as wide as the cells of the coarsest sheet.

    Returns:
        Displacements at the mass points of the coarsest sheet [m], shape (31, 31, 2).
    """
    assert made.tissue is not None
    (height, width), foundation = made.sheet.size, made.tissue.foundation_stiffness
    count = 2 * (MESHES[0] - 1)
    mesh = MeshQuad.init_tensor(*(np.linspace(-side / 2, side / 2, count + 1) for side in (width, height)))
    basis = Basis(mesh, ElementVector(ElementQuad2()), intorder=6)
    lame = (THICKNESS * constant for constant in plane_stress(YOUNG, 1 / 3))
    matrix = linear_elasticity(*lame).assemble(basis)
    matrix += BilinearForm(lambda u, v, _: foundation * dot(u, v)).assemble(basis)
    load = LinearForm(lambda v, at: dot(pressure(made, *at.x)[:2], v)).assemble(basis)
    u = solve(*condense(matrix, load, D=basis.get_dofs()))
    by_rows = np.lexsort((mesh.p[0], -mesh.p[1]))
    by_node: Array = u[basis.nodal_dofs[:, by_rows]].T.reshape(count + 1, count + 1, 2)
    return by_node[::2, ::2]


@pytest.mark.default_cases("size0-0")
@pytest.mark.parametrize(("size", "foundation"), [((0.1, 0.1), 0), ((0.08, 0.1), 2e6)])
def test_in_plane_load_matches_finite_elements(size: tuple[float, float], foundation: float, device: Device) -> None:
    def made(points: int) -> Scene:
        probe = {**WIDE, "total": [2e-6, -1e-6, 0]}
        return tissue((points, points), size=size, foundation=foundation, probes=[probe])

    expected = finite_elements(made(MESHES[0]))
    shapes = [at_rest(made(points), (0, 1)) for points in MESHES]
    errors = [relative_error(expected, u[..., :2]) for u in shapes]
    assert errors[-1] < 5e-4
    assert abs(order(errors) - 2) < 0.1
    assert_equilibrium(made(MESHES[0]), shapes[0], (0, 1), device)


def series(made: Scene) -> Array:
    """Navier's double series of sines for a simply supported sheet under a small normal load.

    D Laplacian^2 u - S Laplacian u + foundation u = pressure

    Returns:
        Displacements along z at the mass points of the coarsest sheet [m], shape (31, 31).
    """
    (height, width), parts = made.sheet.size, made.tissue
    assert parts is not None
    modes, samples = 150, 900
    middles, waves = (np.arange(samples) + 0.5) / samples, np.arange(1, modes + 1)
    load = pressure(made, *np.meshgrid((middles - 0.5) * width, (0.5 - middles) * height))[2]
    # Integrals for a pressure that is constant around each sample.
    sines = np.sin(np.pi * np.outer(waves, middles)) * np.sinc(waves / (2 * samples))[:, None]
    amplitude = 4 / samples**2 * sines @ load @ sines.T
    squares = (np.pi * waves[:, None] / height) ** 2 + (np.pi * waves / width) ** 2
    bending = PLATE if parts.bending == "plate" else parts.bending
    amplitude /= bending * squares**2 + parts.pretension * squares + parts.foundation_stiffness
    at_points = np.sin(np.pi * np.outer(np.linspace(0, 1, MESHES[0]), waves))
    return at_points @ amplitude @ at_points.T


BENT: dict[str, dict[str, Any]] = {
    "plate": {"bending": "plate"},
    "plate on a foundation": {"bending": 2e-4, "foundation": 1e4},
    "membrane": {"pretension": 5},
    "membrane on a foundation": {"pretension": 5, "foundation": 1e4},
    "plate under tension": {"pretension": 0.5, "bending": "plate"},
}


@pytest.mark.default_cases("plate under tension-False", "membrane on a foundation-True")
@pytest.mark.parametrize(
    ("name", "everywhere"), [*((name, False) for name in BENT), ("plate", True), ("membrane on a foundation", True)]
)
def test_normal_load_matches_double_series(name: str, everywhere: bool, device: Device) -> None:
    tool, terms = EVERYWHERE if everywhere else WIDE, BENT[name]

    def made(points: int) -> Scene:
        return tissue((points, points), size=(0.08, 0.1), probes=[{**tool, "total": [0, 0, -1e-7]}], **terms)

    expected = series(made(MESHES[0]))
    shapes = [at_rest(made(points), (2,)) for points in MESHES]
    errors = [relative_error(expected, u[..., 2]) for u in shapes]
    assert errors[1] < 1e-3
    assert abs(order(errors) - 2) < 0.1
    assert_equilibrium(made(MESHES[0]), shapes[0], (2,), device)


@pytest.mark.slow
def test_depth_of_a_tool_on_different_meshes(device: Device) -> None:
    probe = {"total": [0, 0, -2], "radius": 0.004, "falloff": 300, "load": [[0, 0], [0.5, 100]]}
    time, depths = {"duration": 1.0, "frames_per_second": 25}, []
    for points in MESHES:
        made = tissue((points, points), foundation=2e6, damping=40, probes=[probe], time=time)
        dynamics = dynamics_of(made, device)
        dynamics.advance(plan_of(made).grid.steps)
        depths.append(-dynamics.displacement()[..., 2].min())
    assert depths[:2] == pytest.approx(depths[2:] * 2, rel=0.01)


@pytest.mark.parametrize("mapped", [False, True])
def test_momenta_of_a_free_sheet(mapped: bool, device: Device, tmp_path: Path) -> None:
    thrown = {"at": [0.3, 0.2], "total": [0.2, -0.1, 0.4], "falloff": 40, "load": [[0, 100], [0.04, 100], [0.04, 0]]}
    maps = {"map": {"image": picture(tmp_path), "range": [0.5, 3]}} if mapped else {}
    made = tissue((9, 11), size=(0.08, 0.13), fixed="none", probes=[thrown], **maps)
    mass, rest, h = assembled(made).mass[..., None], rest_positions(made.sheet), plan_of(made).grid.step
    dynamics = dynamics_of(made, device)

    def momenta() -> Array:
        """Linear and angular momentum, sums of m d / h and x times that, which the steps conserve."""
        state = dynamics.state()
        momentum = mass * state.difference / h
        angular = np.cross(rest + state.displacement, momentum)
        return np.array([momentum.sum(axis=(0, 1)), angular.sum(axis=(0, 1))])

    by_frame = []
    for _ in range(made.time.frames):
        dynamics.advance(plan_of(made).grid.steps_per_frame)
        by_frame.append(momenta())
    # The load ends with the first frame. Each step rounds once.
    rounding = plan_of(made).grid.steps * 2.0**-53
    for after in by_frame[2:]:
        for momentum, expected in zip(after, by_frame[1], strict=True):
            np.testing.assert_allclose(momentum, expected, rtol=0, atol=rounding * np.abs(expected).max())
    impulse = 0.04 * tool_forces(made, 0.02).sum(axis=(0, 1))
    np.testing.assert_allclose(by_frame[1][0], impulse, rtol=0, atol=rounding * np.abs(impulse).max())


# Terms of tissue, and the largest ratio of the bound to the highest frequency.
LIMITED: dict[str, tuple[dict[str, Any], float]] = {
    "oblong": ({"size": (0.08, 0.15)}, 1.25),
    "free": ({"fixed": "none"}, 1.25),
    "foundation map": ({"foundation": 1e7, "foundation_range": (0.2, 5)}, 1.25),
    "pretension": ({"pretension": 20}, 1.25),
    "plate": ({"bending": "plate"}, 1.25),
    "stiff plate": ({"bending": 1e-2}, 1.25),
    "map, pretension, bending": ({"range": (5, 0.2), "pretension": 10, "bending": 1e-3}, 1.6),
    "map, free edges": ({"range": (0.2, 5), "fixed": ["left"]}, 1.6),
}


def limited(name: str, folder: Path, **more: Any) -> Scene:
    terms = {"size": (0.08, 0.1), "foundation": 1e5, **LIMITED[name][0], **more}
    if "range" in terms:
        terms["map"] = {"image": picture(folder), "range": terms.pop("range")}
    if "foundation_range" in terms:
        terms["foundation_map"] = {"image": picture(folder), "range": terms.pop("foundation_range")}
    return tissue((9, 11), foundation_active="always", **terms)


def frequency(made: Scene, displacement: Array | float = 0.0) -> float:
    """The highest angular frequency of small motions [rad/s], or the largest growth rate of a crumpled sheet."""
    free = moving(made)
    scale = 1 / np.sqrt(np.repeat(assembled(made).mass.ravel(), 3)[free])
    weights = sparse.diags_array(scale)
    matrix = weights @ reference.stiffness(made, displacement)[free][:, free] @ weights
    largest = eigsh(matrix, 1, v0=np.random.default_rng(0).normal(size=len(free)), return_eigenvectors=False)
    return math.sqrt(abs(largest[0]))


@pytest.mark.parametrize("name", [*LIMITED, "stiff corner"])
def test_frequency_bound(name: str, tmp_path: Path) -> None:
    if name == "stiff corner":
        # A mass point at a free corner has the mass and the stiffness of one cell.
        grey = np.zeros((8, 10), np.uint8)
        grey[0, 0] = 255
        Image.fromarray(grey).save(tmp_path / "corner.png")
        made = tissue((9, 11), fixed="none", map={"image": str(tmp_path / "corner.png"), "range": [1, 30]})
    else:
        made = limited(name, tmp_path)
    largest = LIMITED[name][1] if name in LIMITED else 1.6
    assert 1 <= highest_frequency(plan_of(made).material, made.sheet) / frequency(made) < largest


@pytest.mark.parametrize("seed", range(8))
def test_frequency_bound_of_random_tissues(seed: int, tmp_path: Path) -> None:
    """At rest and with springs of at least half their rest length."""
    made, rng = random_tissue(seed, picture(tmp_path)), np.random.default_rng(seed)
    crumpled = 0.15 * min(spacing(made.sheet)) * rng.uniform(-1, 1, (*made.sheet.points, 3))
    assert reference.shortest_spring(made, crumpled) > 0.5
    for displacement in (np.zeros_like(crumpled), crumpled):
        assert frequency(made, displacement) <= highest_frequency(plan_of(made).material, made.sheet)


@pytest.mark.default_cases("map, pretension, bending", "free")
@pytest.mark.parametrize("name", ["stiff plate", "map, pretension, bending", "map, free edges", "free"])
def test_bounded_energy_below_stability_limit(name: str, device: Device, tmp_path: Path) -> None:
    """10^5 steps after impulses at random places in the first step."""
    rng, h = np.random.default_rng(1), 0.99 * plan_of(limited(name, tmp_path)).stable_step
    brief = {"falloff": 200, "load": [[0, 100], [h, 0]]}
    kicks = [{"at": list(rng.random(2)), "total": list(1e-2 * rng.normal(size=3)), **brief} for _ in range(8)]
    time = {"duration": 100_000 * h, "frames_per_second": 1 / (1000 * h), "step": h}
    dynamics = dynamics_of(limited(name, tmp_path, probes=kicks, time=time), device)
    energies = []
    for _ in range(100):
        dynamics.advance(1000)
        energies.append(dynamics.read().energy)
    # The energy without that of the foundation, with which it is exchanged.
    assert min(energies) > 0
    assert max(energies) < 4 * energies[0]


@pytest.mark.parametrize(
    ("at", "share"), [([0.45, 0.52], 1), ([0.5, 0.0], 1 / 2), ([0.0, 0.5], 1 / 2), ([1.0, 1.0], 1 / 4)]
)
def test_total_force_of_a_tool(at: list[float], share: float) -> None:
    """The sheet, of tissue or springs, is below half of a tool at an edge, and below a quarter at a corner."""
    total, sheet = np.array([0.3, -0.2, -1.0]), {"points": [121, 121], "size": [0.1, 0.1], "fixed": "none"}
    probe = {"at": at, "total": total.tolist(), "radius": 0.006, "falloff": 300}
    springs = scene_of_springs(sheet={**sheet, "mass": 1e-5}, probes=[probe])
    for made in (tissue((121, 121), fixed="none", probes=[probe]), springs):
        np.testing.assert_allclose(tool_forces(made).sum(axis=(0, 1)), share * total, rtol=1e-3)


def sampled(grey: NDArray[Any], rows: Array, cols: Array, black: float, white: float) -> Array:
    """Factors, bilinear between the centres of texels, at places as fractions of the sheet's height and width."""
    for axis, places in ((0, rows), (1, cols)):
        last = grey.shape[axis] - 1
        middle = np.clip(places * (last + 1) - 0.5, 0, last)
        near = np.maximum(1 - np.abs(middle[:, None] - np.arange(last + 1)), 0)
        grey = np.moveaxis(np.tensordot(near, grey, (1, axis)), 0, axis)
    return black + (white - black) * grey


@pytest.mark.parametrize(
    ("kind", "texels"), [("grey", (7, 5)), ("grey", (40, 60)), ("grey", (1, 3)), ("rgb", (8, 11)), ("16 bit", (7, 5))]
)
def test_map_sampling_at_cell_centres(texels: tuple[int, int], kind: str, tmp_path: Path) -> None:
    grey, file = speckle(*texels)[..., 0], tmp_path / "map.png"
    if kind == "16 bit":
        grey = np.random.default_rng(0).integers(0, 65536, texels, dtype=np.uint16)
    Image.fromarray(np.repeat(grey[..., None], 3, axis=-1) if kind == "rgb" else grey).save(file)
    stiff = {"image": str(file), "range": [6, 0.5]}
    sheet = {"points": [9, 12], "size": [0.1, 0.1], "mass": 1e-3}
    of_springs = scene_of_springs(sheet=sheet, springs={"structural": 20, "map": stiff})
    expected = sampled(grey / np.iinfo(grey.dtype).max, (np.arange(8) + 0.5) / 8, (np.arange(11) + 0.5) / 11, 6, 0.5)
    for made in (tissue((9, 12), map=stiff), of_springs):
        factors: Any = plan_of(made).material.factors
        np.testing.assert_allclose(factors, expected, rtol=0, atol=1e-14 * 6)


def test_foundation_map_sampling_at_mass_points(tmp_path: Path) -> None:
    deep = {"image": picture(tmp_path), "range": [6, 0.5]}
    factors: Any = plan_of(tissue((9, 12), foundation=1, foundation_map=deep)).material.virtual_factors
    expected = sampled(speckle(7, 5)[..., 0] / 255, np.linspace(0, 1, 9), np.linspace(0, 1, 12), 6, 0.5)
    np.testing.assert_allclose(factors, expected, rtol=0, atol=1e-14 * 6)
