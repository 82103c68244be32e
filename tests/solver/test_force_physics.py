"""Forces of tools: Newton's third law, work and energy, and closed forms of indentation."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.special import k0, k1

from taichi_msm import Simulation
from taichi_msm.model.loads import evaluate_loads
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests import reference
from tests.reference.sheet import sheet as assembled
from tests.scenes import plan_of
from tests.terms.test_contact import HELD, PRESSED, RUBBED, moved, touching

Array = NDArray[np.float64]

FREE = {"points": [17, 21], "size": [0.3, 0.4], "fixed": "none"}
UNDAMPED = {"young": 1e3, "thickness": 0.01, "density": 1000}
LOAD = {"total": [0.3, 0, -1], "at": [0.3, 0.3], "load": [[0, 0], [0.4, 100]], "falloff": 40}


def test_momentum_of_a_free_sheet(device: Device) -> None:
    """Its change is the impulse of the tools; velocities are those half a step before the frames."""
    made = touching([PRESSED, HELD, LOAD], sheet=FREE, tissue=UNDAMPED, time={"step": 1 / 1000})
    mass, gained = assembled(made).mass[..., None], []
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance()
        for _ in range(9):
            momentum = (mass * simulation.velocities()).sum(axis=(0, 1))
            load_before = np.array(simulation.forces()[2].force)
            simulation.advance()
            *tools, load = (np.array(felt.force) for felt in simulation.forces())
            impulse = sum(tools) / 25 + (load_before + load) / 2 / 25 - (load - load_before) / 2 / 1000
            gained.append((mass * simulation.velocities()).sum(axis=(0, 1)) - momentum - impulse)
            assert np.abs(impulse).max() > 1e-3
    assert np.abs(gained).max() < 1e-12


@pytest.mark.parametrize(
    "probe",
    [
        moved([0, 0.5, 0.5, 0.0], [0.2, 0.55, 0.5, -0.03]),
        moved([0, 0.5, 0.5, 0.0], [0.2, 0.55, 0.5, -0.03], friction=0.3),
        moved([0, 0.5, 0.5, 0.0], [0.2, 0.55, 0.5, 0.03], grip=[[0, 10]]),
    ],
    ids=["pressed", "rubbed", "pulled"],
)
def test_reaction_of_a_tool_after_damping(probe: dict[str, Any], device: Device) -> None:
    """It carries the forces of springs and foundation on its mass points, which equal those on the supports."""
    tissue = {**UNDAMPED, "foundation": 3e3, "foundation_active": "always", "damping": 30}
    made = touching([probe], tissue=tissue, time={"duration": 3.0})
    with Simulation(made, threads=device.threads) as simulation:
        rest = simulation.positions()
        simulation.advance(75)
        (felt,), u = simulation.forces(), simulation.positions() - rest
        assert np.abs(simulation.velocities()).max() < 1e-12
    fixed, force = plan_of(made).fixed, reference.force(made, u, evaluate_loads(plan_of(made), np.array([3.0])), 0)
    touched = np.linalg.norm(force, axis=-1) > 1e-9
    assert 5 < (touched & ~fixed).sum() < 60
    size = np.linalg.norm(felt.force)
    np.testing.assert_allclose(felt.force, -force[touched & ~fixed].sum(axis=0), rtol=0, atol=1e-9 * size)
    springs, held = reference.elastic_force(made, u), assembled(made).virtual[..., None] * u
    np.testing.assert_allclose(springs[fixed].sum(axis=0), -springs[~fixed].sum(axis=0), rtol=0, atol=1e-12 * size)
    np.testing.assert_allclose(felt.force, springs[fixed].sum(axis=0) + held.sum(axis=(0, 1)), rtol=0, atol=1e-9 * size)


def dipped(count: int = 81) -> list[list[float]]:
    """A smooth downward path."""
    times = np.linspace(0, 0.4, count).tolist()
    return [[t, 0.5, 0.5, 0.001 - 0.03 * math.sin(math.pi * t / 0.8) ** 2] for t in times]


def balance(probe: dict[str, Any], device: Device, points: tuple[int, int] = (17, 21), rate: int = 1200) -> Array:
    """Work of a tool, energy gained, and energy lost to damping [J]; every step is a frame."""
    tissue = {**UNDAMPED, "foundation": 3e3, "foundation_active": "always", "damping": 5}
    time = {"frames_per_second": rate, "step": 1 / rate}
    made = touching([probe], sheet={"points": points, "size": [0.3, 0.4]}, tissue=tissue, time=time)
    parts, tips, forces, velocities = assembled(made), [], [], []
    with Simulation(made, threads=device.threads) as simulation:
        rest = simulation.positions()
        for _ in range(plan_of(made).grid.frames):
            tips.append(simulation.forces()[0].tip)
            simulation.advance()
            forces.append(simulation.forces()[0].force)
            velocities.append(simulation.velocities())
        u, last = simulation.positions() - rest, simulation.forces()[0].tip
        gained = simulation.progress.energy + (parts.virtual[..., None] * u * u).sum() / 2
    # A force at step n does work along half the path from step n - 1 to n + 1, and so does the damping.
    paths = np.diff([*tips, last], axis=0)
    work = (np.array(forces)[1:] * (paths[1:] + paths[:-1])).sum() / 2
    middle = (np.array(velocities)[1:] + np.array(velocities)[:-1]) / 2
    return np.array([work, gained, 5 * (parts.mass[..., None] * middle**2).sum() / rate])


@pytest.mark.slow
def test_work_and_energy_of_a_grip(device: Device) -> None:
    """They differ by m (dv)^2 / 2 for each kink of the path within a step, and by half a step at both ends."""
    differences = []
    for rate in (300, 600, 1200):
        work, gained, lost = balance(moved(*dipped(), grip=[[0, 1]]), device, rate=rate)
        assert lost > 0.05 * work
        differences.append(abs(work - gained - lost) / work)
    assert differences[0] < 1e-3
    assert differences[1] < 0.6 * differences[0]
    assert differences[2] < 0.6 * differences[1]


@pytest.mark.parametrize(("finest", "most"), [((33, 41), 0.025), pytest.param((65, 81), 0.02, marks=pytest.mark.slow)])
def test_work_and_energy_of_a_press(finest: tuple[int, int], most: float, device: Device) -> None:
    """A mass point that meets the tool takes its velocity, an inelastic impact that vanishes with finer meshes."""
    differences = []
    for points in ((9, 11), (17, 21), finest):
        work, gained, lost = balance(moved(*dipped()), device, points)
        differences.append((work - gained - lost) / work)
    assert 0.05 > differences[0] > differences[1] > differences[2] > 0
    assert differences[2] < most


@pytest.mark.slow
def test_friction_dissipates_energy(device: Device) -> None:
    work, gained, lost = balance(RUBBED, device)
    assert work - gained - lost > 0.3 * work


# Tension [N/m], modulus of the foundation [N/m3], and decay length of a dent [m], short against the sheet.
S, K = 25.0, 4e5
DECAY = math.sqrt(S / K)


def membrane(points: int, probe: dict[str, Any], **tissue: Any) -> Scene:
    """A sheet under tension, in equilibrium after 0.12 s."""
    held = {"young": 3e4, "thickness": 3e-3, "density": 1050, "damping": 700, "pretension": S, "foundation": K}
    return Scene(
        sheet={"points": [points, points], "size": [0.1, 0.1]},
        tissue={**held, "foundation_active": "always", **tissue},
        probes=[probe],
        time={"duration": 0.12, "precision": "f64"},
        output=[],
    )


def lowered(radius: float, height: float, **changes: Any) -> dict[str, Any]:
    """A vertical capsule."""
    rod = {"radius": radius, "shaft": [0, 0, 1], "length": 0.1}
    return {"path": [[0, 0.5, 0.5, 0.0], [0.02, 0.5, 0.5, height]], "instrument": rod, **changes}


def pressed(made: Scene, device: Device) -> tuple[Array, Array]:
    """Tip [m] and force [N] in equilibrium."""
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance(3)
        (felt,) = simulation.forces()
        assert np.abs(simulation.velocities()).max() < 1e-9
        return np.array(felt.tip), np.array(felt.force)


def test_indentation_by_a_round_tip(device: Device) -> None:
    """Outside the contact radius c the membrane S Laplacian(w) = K w decays as K0, with a smooth transition at c.

    The depth is a twentieth of the decay length, so squared slopes, which stretch springs, are 0.003.
    """
    radius, depth = 0.04, 4e-4

    def height(c: float) -> float:
        return float(c / radius * DECAY / k1(c / DECAY) * k0(c / DECAY) + c**2 / (2 * radius))

    c = brentq(lambda c: height(c) - depth, 1e-6, 0.02)
    under = K * (math.pi * c**2 * depth - math.pi * c**4 / (4 * radius))
    expected = under + S * 2 * math.pi * c * c / radius
    errors = []
    for points in (61, 121):
        tip, force = pressed(membrane(points, lowered(radius, -depth)), device)
        assert tip[2] == -depth
        assert np.abs(force[:2]).max() < 1e-12
        errors.append(abs(force[2] / -expected - 1))
    assert errors[0] < 0.04
    assert errors[1] < 0.01


def test_indentation_by_a_flat_disc(device: Device) -> None:
    """A grip holds a disc: K pi a^2 w below it, and 2 pi a S w / l K1(a / l) / K0(a / l) at its rim.

    The rim is a staircase with an error of order 1, which two meshes extrapolate.
    """
    a, height = 0.01, 4e-4
    # The tip holds the mass points within 1.5 radii of its centre.
    tool = lowered(a / math.sqrt(1.5**2 - 1), height, grip=[[0, 10]])
    x = a / DECAY
    expected = height * (K * math.pi * a**2 + 2 * math.pi * a * S / DECAY * k1(x) / k0(x))
    coarse, fine = (float(pressed(membrane(points, tool), device)[1][2]) for points in (61, 121))
    assert fine == pytest.approx(expected, rel=0.06)
    assert 2 * fine - coarse == pytest.approx(expected, rel=0.03)
