"""The NumPy reference against closed forms and SciPy."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from scipy.integrate import solve_ivp

from taichi_msm.model.loads import evaluate_loads
from taichi_msm.model.sheet import fixed_points, rest_positions
from taichi_msm.solver.planning import with_time
from taichi_msm.terms.elasticity import energy_density
from tests import reference
from tests.scenes import plan_of, random_scene, random_tissue, scene, speckle

# A 2 x 2 sheet with virtual springs only: four independent oscillators.
OSCILLATORS = {
    "sheet": {"points": [2, 2], "size": [1, 1], "mass": 2.0, "fixed": "none"},
    "springs": {"virtual": 50.0, "virtual_active": "always"},
    "probes": [{"force": [0, 0, 3.0], "falloff": 0, "offset": 0}],
}


def discrete(n: NDArray[np.int_], h: float, w: float, g: float, rest: float) -> NDArray[np.float64]:
    """Solve (1 + gh/2) u_{n+1} = (2 - w^2 h^2) u_n - (1 - gh/2) u_{n-1} + w^2 h^2 rest by its two roots."""
    a, b, c = 1 + g * h / 2, -(2 - (w * h) ** 2), 1 - g * h / 2
    root = np.roots([a, b, c]).astype(complex)
    # u_n - rest = p r_0^n + q r_1^n from u_0 = 0 and u_1 = h^2 a_0 / 2 = (w h)^2 rest / 2.
    p, q = np.linalg.solve(np.array([[1, 1], root]), np.array([-rest, (w * h) ** 2 * rest / 2 - rest]))
    return np.asarray((rest + p * root[0] ** n + q * root[1] ** n).real)


@pytest.mark.parametrize("damping", [0.0, 4.0])
def test_oscillator_matches_the_discrete_solution(damping: float) -> None:
    made = scene(**OSCILLATORS, damping=damping, time={"duration": 4.0, "step": 0.02})
    u = np.array([u[0, 0] for u in reference.displacements(plan_of(made))])
    exact = discrete(np.arange(len(u)), 0.02, 5.0, damping / 2.0, 3.0 / 50.0)
    # 200 steps, each of which rounds numbers of at most 0.12.
    np.testing.assert_allclose(u[:, 2], exact, rtol=0, atol=200**2 * 1.2e-17)
    assert not u[:, :2].any()


def test_backward_damping_matches_the_recurrence() -> None:
    made = scene(**OSCILLATORS, damping=4.0, time={"duration": 0.4, "step": 0.02, "damping_difference": "backward"})
    u = [0.0, 0.02**2 * 3.0 / 2.0 / 2]
    for _ in range(19):
        u.append(2 * u[-1] - u[-2] + 0.02**2 * (3.0 - 50.0 * u[-1]) / 2.0 - 2.0 * 0.02 * (u[-1] - u[-2]))
    z = [v[0, 0, 2] for v in reference.displacements(plan_of(made))]
    np.testing.assert_allclose(z, u, atol=1e-16)


def test_hookes_law() -> None:
    made = scene(sheet={"points": [2, 2], "size": [1, 2], "mass": 1}, springs={"structural": 7.0}, probes=[])
    u = np.zeros((2, 2, 3))
    u[0, 1] = [0.5, 0, 0]
    # Along the top edge the spring of length 2 is 0.5 longer; the right edge of length 1 is now sqrt(1.25) long.
    pull = 7.0 * (np.sqrt(1.25) - 1) / np.sqrt(1.25)
    exact = [[[3.5, 0, 0], [-3.5 - pull * 0.5, -pull, 0]], [[0, 0, 0], [pull * 0.5, pull, 0]]]
    np.testing.assert_allclose(reference.elastic_force(made, u), exact, atol=1e-15)


def test_spring_of_zero_length_has_no_force() -> None:
    made = scene(sheet={"points": [2, 2], "size": [1, 1], "mass": 1}, springs={"structural": 7.0}, probes=[])
    u = np.zeros((2, 2, 3))
    u[:, 1, 0] = -1.0
    np.testing.assert_allclose(reference.elastic_force(made, u), 0, atol=1e-15)


@pytest.mark.parametrize("seed", range(4))
def test_energy_density_integrates_to_the_energy_of_the_springs(seed: int, tmp_path: Path) -> None:
    """With a map, tension, free edges and cells that are not square; without bending."""
    Image.fromarray(speckle(7, 5)).save(tmp_path / "map.png")
    plate = random_tissue(seed, str(tmp_path / "map.png"))
    assert plate.tissue is not None
    membrane = plate.model_copy(update={"tissue": plate.tissue.model_copy(update={"bending": 0.0})})
    for made in (membrane, random_scene(seed)):
        displacement = np.random.default_rng(seed).normal(0, 1e-3, (*made.sheet.points, 3))
        height, width = made.sheet.size
        share = np.outer(*(np.r_[0.5, np.ones(count - 2), 0.5] / (count - 1) for count in made.sheet.points))
        total = (energy_density(plan_of(made), displacement) * share).sum() * height * width
        # Sums over less than 2000 springs; those under tension have terms of both signs.
        assert total == pytest.approx(reference.energy(made, displacement), rel=1e-11)


def test_agrees_with_dop853() -> None:
    made = scene(probes=[{"force": [0, 300, -1000], "load": [[0, 0], [0.4, 100]], "falloff": 20}])
    rest, moves = rest_positions(made.sheet), ~fixed_points(made.sheet)[..., None]
    full = evaluate_loads(plan_of(made), np.array([0.4]))

    def motion(t: float, y: NDArray[np.float64]) -> NDArray[np.float64]:
        u, v = y.reshape(2, *rest.shape)
        surgical = reference.surgical_force(made, full, 0) * t / 0.4
        force = reference.elastic_force(made, u) + surgical - 0.5 * u - made.damping * v
        return np.stack([v, force / made.sheet.mass * moves]).ravel()

    solved = solve_ivp(motion, (0, 0.4), np.zeros(2 * rest.size), "DOP853", rtol=1e-9, atol=1e-12)
    exact = solved.y[:, -1].reshape(2, *rest.shape)[0]
    errors = []
    for halvings in (3, 4):
        fine = with_time(made, step=plan_of(made).grid.step / 2**halvings)
        *_, last = reference.displacements(plan_of(fine))
        errors.append(np.abs(last - exact).max())
    # Order 2; the integrator's error is far smaller.
    assert 3.8 < errors[0] / errors[1] < 4.2
    assert errors[1] < 1e-3 * np.abs(exact).max()
    assert np.abs(exact).max() > 0.01


@pytest.mark.parametrize(
    ("point", "to", "ratio"),
    [
        # The sheet is 0.3 m high and 0.4 m wide; a cell is 0.0375 m by 0.04 m.
        ((4, 5), (0.01, 0, 0), 0.75),
        ((4, 5), (0, 0.03, 0), 0.2),
        ((8, 10), (-0.02, 0.01875, 0), 0.5),
        ((0, 10), (-0.04, -0.0375, 0), 0.0),
        ((4, 5), (0, 0, 5.0), 1.0),
    ],
)
def test_shortest_spring(point: tuple[int, int], to: tuple[float, float, float], ratio: float) -> None:
    displacement = np.zeros((9, 11, 3))
    displacement[point] = to
    assert reference.shortest_spring(scene(), displacement) == pytest.approx(ratio, abs=1e-12)
    assert reference.shortest_spring(scene(springs={}), displacement) == 1
