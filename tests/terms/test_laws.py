"""Stiffening and stress relaxation: laws, kernels against the twin, gradients, closed forms, invalid keys."""

from __future__ import annotations

import copy
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from scipy.integrate import quad

from taichi_msm import Simulation, run
from taichi_msm.arithmetic import NUMPY
from taichi_msm.errors import SceneError
from taichi_msm.gradients.gradient import Adjoint, gradient
from taichi_msm.laws.locking import Locking
from taichi_msm.load.check import check_scene
from taichi_msm.model.loads import evaluate_frame_loads
from taichi_msm.model.sheet import rest_positions
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import make_plan
from taichi_msm.system.runtime import Device
from taichi_msm.terms.elasticity import energy_density
from taichi_msm.terms.law import build_law, build_spring
from tests import reference
from tests.conftest import Program
from tests.golden import Messages
from tests.reference.dynamics import Relaxation, internal_force, lock
from tests.scenes import plan_of
from tests.solver.test_dynamics import assert_like_twin

STIFFENING = {"stiffening": {"lock": 0.02, "factor": 6}}
LOCKING_FOUNDATION = {"foundation": {"young": 2e4, "depth": 0.015, "lock": 0.002, "factor": 5}}
RELAXATION = {"relaxation": [{"share": 0.5, "time": 0.03}, {"share": 0.2, "time": 0.4}]}
CASES: dict[str, dict[str, Any]] = {
    "sheet": STIFFENING,
    "foundation": LOCKING_FOUNDATION,
    "relaxation": RELAXATION,
    "everything": {**STIFFENING, **LOCKING_FOUNDATION, **RELAXATION, "pretension": 3, "bending": 1e-7},
}


def pressed(case: str, **sections: Any) -> dict[str, Any]:
    """A scene that reaches the straight part of both laws."""
    tissue = {"young": 2e4, "thickness": 2e-3, "density": 1000, "damping": 30, "foundation": 1e6}
    probe = {"total": [1.2, 0, -12], "at": [0.45, 0.5], "falloff": 100, "load": [[0, 0], [0.05, 100]]}
    return {
        "sheet": {"points": [6, 7], "size": [0.05, 0.06], **sections.pop("sheet", {})},
        "tissue": {**tissue, "foundation_active": "always", **CASES[case]},
        "probes": [probe],
        "time": {"duration": 0.1, "frames_per_second": 40, "precision": "f64", **sections.pop("time", {})},
        "output": [],
    }


def made(case: str, **sections: Any) -> Scene:
    return Scene.model_validate(pressed(case, **sections))


@pytest.mark.parametrize("factor", [1.5, 10.0, 1000.0])
def test_law_integral_and_tangent(factor: float) -> None:
    law, shape = build_law(Locking(), NUMPY), list(Locking().shape(factor))
    (end,) = shape
    for x in (-0.3, 1e-3, 0.05, 0.2, 0.5, 0.9, 1.5):
        assert x * law.secant(x, shape) == pytest.approx(float(lock(np.array(x), 1.0, factor)), rel=1e-14)
        integral, _ = quad(lambda e: float(lock(np.array(e), 1.0, factor)), 0, x, points=[min(end, max(x, 0))])
        assert law.integral(x, *shape) == pytest.approx(2 * integral, rel=1e-9)
        slope = (lock(np.array(x + 1e-7), 1.0, factor) - lock(np.array(x - 1e-7), 1.0, factor)) / 2e-7
        assert law.tangent(x, shape) == pytest.approx(float(slope), rel=1e-5)
        assert law.tangent(x, shape) == pytest.approx((1 - min(max(x, 0), end)) ** -2, rel=1e-12)


def test_digits_of_small_energies() -> None:
    law = build_law(Locking(), NUMPY)
    x = np.float32(10) ** np.arange(-6, 0, dtype=np.float32)
    exact = 2 * (-x.astype(np.longdouble) - np.log1p(-x.astype(np.longdouble)))
    np.testing.assert_allclose(law.integral(x, np.float32(0.99)), exact.astype(float), rtol=2e-6)


@pytest.mark.parametrize("law", [None, Locking()])
def test_derivatives_of_a_spring(law: Locking | None) -> None:
    spring, length = build_spring(law, NUMPY), 2.0
    edge, h = np.array([1.7, 0.9, 1.0]), 1e-6
    values: tuple[float, ...] = (0.1, 0.6) if law else ()

    def force(edge: NDArray[Any], k: float = 3.0, tau: float = 0.4, values: tuple[float, ...] = values) -> NDArray[Any]:
        square = float(edge @ edge)
        numbers = [1 / (values[0] * length), *values] if law else []
        return np.asarray(spring.pull(k, tau, square - length**2, square, length, numbers) * edge)

    p, square = np.array([0.3, -0.2, 0.5]), float(edge @ edge)
    numbers = [1 / (values[0] * length), *values] if law else []
    s, w, by_k, by_tau, by_numbers = spring.derivatives(3.0, 0.4, square - length**2, square, length, edge @ p, numbers)
    np.testing.assert_allclose(s * p + w * edge, (force(edge + h * p) - force(edge - h * p)) / (2 * h), rtol=1e-8)
    np.testing.assert_allclose(by_k * edge, force(edge, k=4.0) - force(edge), rtol=1e-12)
    np.testing.assert_allclose(by_tau * edge, force(edge, tau=1.4) - force(edge), rtol=1e-12, atol=1e-12)
    for n, by in enumerate(by_numbers):
        less, more = (tuple(value * (1 + sign * h * (m == n)) for m, value in enumerate(values)) for sign in (-1, 1))
        change = (force(edge, values=more) - force(edge, values=less)) / (2 * h)
        np.testing.assert_allclose(by * edge, change if n == 0 else change / values[n], rtol=1e-7)


@pytest.mark.parametrize(("case", "fixed"), [(case, "border") for case in CASES] + [("sheet", ["left"])])
def test_laws_match_twin(case: str, fixed: Any, device: Device) -> None:
    assert_like_twin(made(case, sheet={"fixed": fixed}), device)


def test_energy_matches_twin(device: Device) -> None:
    scene = made("everything")
    with Simulation(scene, threads=device.threads) as simulation:
        simulation.advance(4)
        u, reading = simulation.positions() - rest_positions(scene.sheet), simulation._dynamics.read()
        speed = simulation._dynamics.state().difference / plan_of(scene).grid.step
    assert reference.longest_spring(scene, u) - 1 > 0.02, "the straight part"
    assert -u[..., 2].min() > 0.002, "the straight part"
    kinetic = (reference.sheet(scene).mass[..., None] * speed**2).sum() / 2
    assert reading.energy == pytest.approx(reference.energy(scene, u) + kinetic, rel=1e-11)
    plain = scene.model_copy(update={"tissue": scene.tissue.model_copy(update={"bending": 0.0})})  # type: ignore[union-attr]
    height, width = scene.sheet.size
    share = np.outer(*(np.r_[0.5, np.ones(n - 2), 0.5] / (n - 1) for n in scene.sheet.points))
    total = (energy_density(plan_of(plain), u) * share).sum() * height * width
    assert total == pytest.approx(reference.energy(plain, u), rel=1e-11)


@pytest.mark.parametrize("preloaded", [False, True])
def test_equilibrium_with_relaxation(preloaded: bool, device: Device) -> None:
    data = pressed("everything", time={"motion": "quasistatic"})
    if preloaded:
        data["probes"][0]["load"] = [[0, 50], [0.05, 100]]
    scene = Scene.model_validate(data)
    plan, made_sheet = make_plan(scene), reference.sheet(scene)
    relaxation, free = Relaxation(scene, 1 / scene.time.frames_per_second), ~plan.fixed
    with Simulation(scene, threads=device.threads) as simulation:
        for frame in range(5):
            if frame:
                simulation.advance()
            u = simulation.positions() - rest_positions(scene.sheet)
            loads = evaluate_frame_loads(plan, frame)
            elastic = internal_force(scene, u, loads, 0, made_sheet)
            acting = relaxation.step(elastic) if frame else elastic
            if frame == 0:
                relaxation.begin(elastic)
            surgical = reference.surgical_force(scene, loads, 0)
            assert np.abs((acting + surgical)[free]).max() <= 2e-7 * max(1e-9, np.abs(elastic).max())


def test_creep_of_a_foundation(device: Device) -> None:
    """Under a constant uniform load only the foundation resists; its depth follows from the Prony series."""
    shares, times = (0.5, 0.2), (0.03, 0.4)
    data = pressed("relaxation", time={"motion": "quasistatic", "duration": 1.0, "frames_per_second": 200})
    data["sheet"]["fixed"] = "none"
    data["probes"] = [{"total": [0, 0, -1], "falloff": 1e-3, "load": [[0, 100]]}]
    scene = Scene.model_validate(data)
    with Simulation(scene, threads=device.threads) as simulation:
        depths = [-simulation.positions()[3, 3, 2]]
        for _ in range(200):
            simulation.advance()
            depths.append(-simulation.positions()[3, 3, 2])
    # The convolution of the relaxation with the rate of the depth is constant.
    t = np.arange(201) / 200
    kernel = np.array(1 - sum(shares) + sum(s * np.exp(-t / tau) for s, tau in zip(shares, times, strict=True)))
    exact: NDArray[np.float64] = np.empty(201)
    exact[0] = 1.0
    for n in range(1, 201):
        rates = np.diff(exact[:n])
        middle = (kernel[1:] + kernel[:-1])[::-1] / 2
        known = kernel[n] * exact[0] + (rates * middle[-n:][: n - 1]).sum()
        exact[n] = exact[n - 1] + (1 - known) / ((kernel[0] + kernel[1]) / 2)
    np.testing.assert_allclose(np.array(depths) / depths[0], exact, rtol=3e-3)


@pytest.mark.default_cases("dynamic")
@pytest.mark.parametrize("motion", ["dynamic", "quasistatic"])
def test_gradients_by_parameters(motion: str, device: Device) -> None:
    data = pressed("everything", time={"motion": motion})
    del data["tissue"]["relaxation"]
    adjoint = Adjoint(plan_of(Scene.model_validate(data)), device)
    weights = np.random.default_rng(0).standard_normal(adjoint.run().shape)
    derivatives = adjoint.backward(weights)
    # Equilibria have residuals of up to 1e-7.
    step = 1e-3 if motion == "quasistatic" else 1e-4
    keys = ["young", "pretension", "stiffening.lock", "stiffening.factor"]
    for key in [*keys, "foundation.young", "foundation.lock", "foundation.factor"]:
        path = f"tissue.{key}"

        def at(scale: float, key: str = key) -> float:
            changed = copy.deepcopy(data)
            *outer, name = key.split(".")
            section = changed["tissue"]
            for part in outer:
                section = section[part]
            section[name] *= scale
            return float((Adjoint(plan_of(Scene.model_validate(changed)), device).run() * weights).sum())

        value = attrgetter(path)(Scene.model_validate(data))
        slope = (at(1 + step) - at(1 - step)) / (2 * step * value)
        assert derivatives.numbers[path] == pytest.approx(slope, rel=3e-3 if motion == "quasistatic" else 1e-4), path


def test_creep_is_not_path_dependence(tmp_path: Path, device: Device) -> None:
    data = pressed("relaxation", time={"motion": "quasistatic"})
    data["probes"][0]["load"] = [[0, 50], [0.025, 100]]
    outcome: Any = run(Scene.model_validate(data), tmp_path, threads=device.threads)
    assert not [note for note in outcome["notes"] if "path-dependent" in note]


def test_f32_resolves_long_relaxation_times(device: Device) -> None:
    """For a step of 1e-5 of the relaxation time, exp(-x) has two digits of 1 - exp(-x) in f32."""
    memories = []
    for precision in ("f32", "f64"):
        data = pressed("relaxation", time={"precision": precision, "step": 1e-4})
        data["tissue"]["relaxation"] = [{"share": 0.9, "time": 20.0}]
        with Simulation(data, threads=device.threads) as simulation:
            simulation.advance(4)
            memories.append(simulation._dynamics.state().memory[2])
    np.testing.assert_allclose(memories[0], memories[1], rtol=0, atol=1e-3 * np.abs(memories[1]).max())


def test_step_with_and_without_lock(tmp_path: Path, program: Program, message: Messages) -> None:
    data = pressed("sheet") | {"time": {"duration": 0.1, "frames_per_second": 40}}
    data["tissue"] |= {"foundation": 0, "stiffening": {"lock": 0.1}}
    (tmp_path / "s.yaml").write_text(yaml.safe_dump(data))
    lines = program("check", str(tmp_path / "s.yaml")).stdout.splitlines()
    message((line for line in lines if " steps of " in line), "3.2 times")


def test_relaxation_has_no_gradient(device: Device, message: Messages) -> None:
    with message.raises(SceneError, "tissue.relaxation"):
        gradient(pressed("relaxation"), lambda x: (0.0, 0 * x), threads=device.threads)


INVALID: list[dict[str, Any]] = [
    {"stiffening": {"lock": 0}},
    {"stiffening": {"lock": 0.1, "factor": 0.5}},
    {"foundation": {"young": 1e4, "depth": 0.01, "factor": 10}},
    {"relaxation": [{"share": 0.6, "time": 1}, {"share": 0.5, "time": 2}]},
    {"relaxation": [{"share": 0.1, "time": 1}] * 5},
    {"foundation_active": "loaded", **RELAXATION},
]


def test_invalid_laws(message: Messages) -> None:
    for tissue in INVALID:
        data = pressed("sheet")
        data["tissue"].update(tissue)
        with message.raises(SceneError, "tissue"):
            check_scene(data)
