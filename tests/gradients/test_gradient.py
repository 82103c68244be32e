"""Derivatives of a loss against complex steps of the twin, differences of runs, and each other."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any
from unittest.mock import Mock

import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image
from pydantic import BaseModel

from taichi_msm import Scene, Simulation, gradient
from taichi_msm.errors import ArgumentError, MsmError, SceneError
from taichi_msm.gradients import kernel_motion, motion, rest
from taichi_msm.gradients.chain_rule import Derivatives
from taichi_msm.gradients.gradient import Adjoint, with_stiffness_map
from taichi_msm.gradients.kernel_motion import build_sweep
from taichi_msm.gradients.motion import MotionAdjoint
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.solver import backoff
from taichi_msm.solver.sheet_solver import choose_layout
from taichi_msm.system.runtime import Device
from taichi_msm.terms.base import KernelConfig, Term
from taichi_msm.terms.foundation import FoundationTerm
from tests import reference
from tests.golden import Messages
from tests.reference.sheet import Sheet, sheet
from tests.scenes import plan_of, speckle

Array = NDArray[np.float64]

# A complex step; its square vanishes.
STEP = 1e-60

# Kinds of sheets, each with another configuration of the kernels.
KINDS = ("tissue", "tissue, free edges", "springs", "springs, bare")

TISSUE = {"young": 900, "thickness": 0.015, "density": 1000, "damping": 3.0}


@pytest.fixture(autouse=True)
def _short_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    """By default one segment contains all steps of a small sheet."""
    monkeypatch.setattr(motion, "SEGMENT_BYTES", 0)


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("maps") / "map.png"
    Image.fromarray(speckle(12, 9)[..., 0]).save(path)
    return str(path)


def moving(kind: str, image: str, steps: int = 12) -> dict[str, Any]:
    """A dynamic scene with two frames of `steps` steps; keyframes lie on and between steps."""
    stands = {"at": [0.43, 0.58], "load": [[0, 30], [0.011, 100], [0.03, 80], [0.03, -20]], "falloff": 25}
    moves = {"at": [[0, 0.3, 0.4], [0.025, 0.72, 0.47], [0.025, 0.23, 0.57]], "load": [[0.005, 50]], "falloff": 30}
    time = {"duration": 0.04, "frames_per_second": 50, "precision": "f64", "step": 0.02 / steps}
    made: dict[str, Any] = {"sheet": {"points": [6, 11], "size": [0.1, 0.19]}, "time": time, "output": []}
    stiffness_map = {"map": {"image": image, "range": [0.7, 3]}}
    if kind.startswith("tissue"):
        made["probes"] = [{**stands, "total": [2, -1, 3], "radius": 0.015}, {**moves, "total": [-1, 2, 2]}]
        if kind == "tissue":
            held = {"young": 100.0, "depth": 0.02}
            stiff = {"pretension": 2.0, "bending": 3e-4, "foundation": held, "foundation_active": "always"}
            foundation_map = {"image": image, "range": [0.5, 2]}
            made["tissue"] = {**TISSUE, **stiff, **stiffness_map, "foundation_map": foundation_map}
        else:
            made["sheet"]["fixed"] = ["left"]
            made["tissue"] = {**TISSUE, "foundation": 4e3}
        return made
    made["sheet"] |= {"mass": 2e-3, "fixed": "corners"}
    made["probes"] = [{**stands, "force": [2, -1, 3], "offset": 1}, {**moves, "force": [-1, 2, 2], "offset": 1}]
    if kind == "springs":
        made |= {"springs": {"structural": 20, "shear": 8, "virtual": 3, **stiffness_map}, "damping": 0.02}
        time["damping_difference"] = "backward"
    else:
        made["springs"] = {"structural": 25}
    return made


RESTING: dict[str, Any] = {
    "sheet": {"points": [6, 7], "size": [0.1, 0.12]},
    "tissue": {"young": 3e4, "thickness": 3e-3, "foundation": 1e5, "foundation_active": "always"}
    | {"pretension": 15, "bending": 1e-3},
    "probes": [
        {"at": [0.43, 0.52], "total": [0.1, 0.2, -1], "radius": 0.01, "falloff": 200, "load": [[0, 0], [2, 100]]},
        {"at": [[0, 0.31, 0.3], [2, 0.6, 0.35]], "total": [0, 0, 0.3], "falloff": 60, "load": [[1, 60]]},
    ],
    "time": {"motion": "quasistatic", "duration": 2, "frames_per_second": 1},
    "output": [],
}


def of_motion(motion_kind: str, image: str) -> dict[str, Any]:
    return RESTING if motion_kind == "quasistatic" else moving("tissue", image)


def plan_from(description: Mapping[str, Any]) -> Plan:
    return plan_of(Scene.model_validate(description))


def adjoint_of(description: Mapping[str, Any], device: Device) -> Adjoint:
    return Adjoint(plan_from(description), device)


def value(position: NDArray[Any]) -> Any:
    """A loss of the positions at all frames that is not linear in them; also of complex positions."""
    return (weights(position.shape) * position + 3 * position**2).sum()


def weights(shape: tuple[int, ...]) -> Array:
    return np.cos(np.arange(np.prod(shape))).reshape(shape)


def loss(position: Array) -> tuple[float, Array]:
    """The same loss and its derivative."""
    return float(value(position)), weights(position.shape) + 6 * position


def derivatives_of(description: Mapping[str, Any], device: Device) -> Derivatives:
    adjoint = adjoint_of(description, device)
    return adjoint.backward(loss(adjoint.run())[1])


def twin_value(plan: Plan, changed: Sheet) -> Any:
    """The loss by the twin with another sheet, which may be complex."""
    displacements = [u for u, _ in reference.steps(plan, changed)]
    return value(rest_positions(plan.scene.sheet) + np.array(displacements[:: plan.grid.steps_per_frame]))


def with_relative_step(section: Any, path: Sequence[str], relative: complex) -> Any:
    """A scene with a number changed by a share of itself, without validation."""
    name, *inner = path
    number = getattr(section, name)
    changed = with_relative_step(number, inner, relative) if inner else number * (1 + relative)
    return BaseModel.model_copy(section, update={name: changed})


def material_numbers(derivatives: Derivatives) -> list[str]:
    return [name for name in derivatives.numbers if not name.startswith("probes")]


@pytest.mark.default_cases("tissue, free edges-12")
@pytest.mark.parametrize("steps", [1, 12])
@pytest.mark.parametrize("kind", KINDS)
def test_material_numbers_against_complex_steps(kind: str, steps: int, image: str, device: Device) -> None:
    description = moving(kind, image, steps)
    plan, derivatives = plan_from(description), derivatives_of(description, device)
    names = material_numbers(derivatives)
    assert len(names) == {"tissue": 8, "tissue, free edges": 5, "springs": 5, "springs, bare": 2}[kind]
    for name in names:
        changed = sheet(with_relative_step(plan.scene, name.split("."), 1j * STEP))
        derivative = derivatives.numbers[name] * float(attrgetter(name)(plan.scene))
        expected = twin_value(plan, changed).imag / STEP
        assert derivative == pytest.approx(expected, rel=1e-13 if steps == 1 else 1e-11), name


def test_foundation_map_against_complex_steps(image: str, device: Device) -> None:
    description = moving("tissue", image)
    plan, derivatives = plan_from(description), derivatives_of(description, device)
    direction, at_rest = np.random.default_rng(2).standard_normal(plan.fixed.shape), sheet(plan.scene)
    factors: Any = plan.material.virtual_factors
    changed = at_rest._replace(virtual=at_rest.virtual * (1 + 1j * STEP * direction / factors))
    derivative = float((derivatives.maps["tissue.foundation_map"] * direction).sum())
    assert derivative == pytest.approx(twin_value(plan, changed).imag / STEP, rel=1e-11)


def assert_second_order(
    known: float, derivative: float, step: float, changed: Callable[[float], float], name: str
) -> None:
    """The remainder of a linear extrapolation is 4 times smaller at half the step, but for the next order."""
    remainder, half = (abs(changed(h) - known - h * derivative) for h in (step, step / 2))
    # Rounding is 1e-15 of the loss.
    assert remainder > 1e-12 * abs(known), f"{name}: {remainder}"
    assert 3.8 < remainder / half < 4.2, f"{name}: {remainder / half}"


def with_change(description: dict[str, Any], path: list[str], index: tuple[int, ...], change: float) -> dict[str, Any]:
    """A description with one number changed, at an index of a load, a position or a force."""
    description = copy.deepcopy(description)
    container: Any = description
    *keys, last = [int(key) if key.isdigit() else key for key in path]
    for key in keys:
        container = container[key]
    if last == "load":
        container, last = container["load"][index[0]], 1
    elif len(index) == 2:
        # Keyframes of a control point begin with the time.
        container, last = container[last][index[0]], index[1] + 1
    elif index:
        container, last = container[last], index[0]
    container[last] += change
    return description


@pytest.mark.default_cases("tissue, free edges")
@pytest.mark.parametrize("kind", KINDS)
def test_probe_numbers_against_differences(kind: str, image: str, device: Device) -> None:
    description = moving(kind, image)
    adjoint = adjoint_of(description, device)
    known, slope = loss(adjoint.run())
    count = 0
    numbers = adjoint.backward(slope).numbers
    for name in [name for name in numbers if name.startswith("probes")]:
        for index in np.ndindex(np.shape(numbers[name])):
            path, step = name.split("."), {"load": 5.0, "at": 1e-4}.get(name.split(".")[-1], 0.05)

            def changed(by: float, path: list[str] = path, index: tuple[int, ...] = index) -> float:
                return loss(adjoint_of(with_change(description, path, index, by), device).run())[0]

            assert_second_order(known, float(np.asarray(numbers[name])[index]), step, changed, f"{name} {index}")
            count += 1
    # 6 components, 5 percents, and 4 control points of two numbers.
    assert count == 6 + 5 + 8


@pytest.mark.parametrize("kind", ["tissue, free edges", "springs"])
def test_stiffness_map_against_differences(kind: str, image: str, device: Device) -> None:
    plan = plan_from(moving(kind, image))
    adjoint, rng = Adjoint(plan, device), np.random.default_rng(3)
    # The scene with tissue has no map of its own; factors need no other kernels.
    factors, direction = rng.uniform(0.7, 2, (5, 10)), rng.standard_normal((5, 10))
    known, slope = loss(adjoint.run(factors))
    derivative = float((adjoint.backward(slope).maps[f"{plan.scene.kind}.map"] * direction).sum())
    assert_second_order(known, derivative, 0.02, lambda by: loss(adjoint.run(factors + by * direction))[0], kind)
    # Without factors, the map of the scene counts again.
    fresh = Adjoint(plan, device)
    assert (adjoint.run() == fresh.run()).all()
    maps = [each.backward(slope).maps[f"{plan.scene.kind}.map"] for each in (adjoint, fresh)]
    assert (maps[0] == maps[1]).all()


def test_numbers_after_10000_steps(image: str, device: Device) -> None:
    description = moving("tissue", image)
    description["time"] |= {"duration": 16, "frames_per_second": 1 / 16, "step": 0.0016}
    adjoint = adjoint_of(description, device)
    known, slope = loss(adjoint.run())
    numbers = adjoint.backward(slope).numbers
    for name, index, step in (
        ("probes.0.total", (2,), 0.2),
        ("tissue.thickness", (), 4e-4),
        ("probes.0.load", (3,), 5.0),
    ):

        def changed(by: float, name: str = name, index: tuple[int, ...] = index) -> float:
            return loss(adjoint_of(with_change(description, name.split("."), index, by), device).run())[0]

        assert_second_order(known, float(np.asarray(numbers[name])[index]), step, changed, name)


def test_pause_after_every_launch(image: str, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    adjoint, launch = adjoint_of(moving("tissue", image), device), MotionAdjoint._launch
    _, by_frame = loss(adjoint.run())
    launched, pause = Mock(side_effect=launch), Mock()
    monkeypatch.setattr(MotionAdjoint, "_launch", lambda *arguments: launched(*arguments))
    adjoint.backward(by_frame, pause)
    assert pause.call_count == launched.call_count > 2


def test_bits_depend_neither_on_workers_nor_on_segments(
    image: str, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    description = moving("tissue", image)
    # With bending a worker needs two rows that move.
    description["sheet"] |= {"points": [9, 11], "size": [0.16, 0.19]}
    plan = with_stiffness_map(plan_from(description))

    def bits(workers: int) -> bytes:
        adjoint = MotionAdjoint(plan, device, layout=replace(choose_layout(plan, device), workers=workers))
        by_sheet, loads = adjoint.backward(loss(adjoint.run())[1])
        arrays: list[Any] = [*by_sheet.springs, by_sheet.tensions, by_sheet.foundation, *loads.by_key.values()]
        arrays += [by_sheet.bending, by_sheet.keep, by_sheet.gain, by_sheet.first_gain]
        return b"".join(np.asarray(array).tobytes() for array in arrays)

    expected = bits(1)
    assert bits(2) == bits(3) == expected
    with monkeypatch.context() as patched:
        patched.setattr(motion, "SEGMENT_BYTES", 2**20)
        assert bits(2) == expected
    # Workers that give up at once.
    monkeypatch.setattr(motion, "MAX_WAIT_CHECKS", 0)
    assert bits(3) == expected
    # After that a single worker sweeps, until the back-off ends.
    monkeypatch.setattr(backoff, "MIN_BACKOFF_S", 1000.0)
    monkeypatch.setattr(backoff, "MAX_BACKOFF_S", 1000.0)
    launches: list[bool] = []

    def counted(config: KernelConfig, *, parallel: bool) -> Any:
        launches.append(parallel)
        return build_sweep(config, parallel=parallel)

    monkeypatch.setattr(kernel_motion, "build_sweep", counted)
    assert bits(3) == expected
    assert not any(launches[launches.index(False) :])


def test_positions_equal_those_of_a_simulation(image: str, device: Device) -> None:
    made, expected = Scene.model_validate(moving("tissue", image)), []
    with Simulation(made, threads=device.threads) as simulation:
        for _ in range(3):
            expected.append(simulation.positions())
            simulation.advance()

    def zero(position: Array) -> tuple[float, Array]:
        assert (position == np.array(expected)).all()
        return 0.0, 0 * position

    result = gradient(made, zero, threads=device.threads)
    assert result.value == 0
    assert not any(np.any(derivative) for derivative in (*result.numbers.values(), *result.maps.values()))


def test_quasi_static_derivatives_against_differences(device: Device) -> None:
    adjoint = adjoint_of(RESTING, device)
    slope = loss(adjoint.run())[1]
    derivatives = adjoint.backward(slope)
    assert len(material_numbers(derivatives)) == 5

    def difference(step: float = 0.0, name: str = "", index: tuple[int, ...] = (), factors: Any = None) -> float:
        """Central difference of the loss, linearised, because equilibria are solved to 1e-7 of the forces."""

        def position(sign: int) -> Array:
            changed = with_change(RESTING, name.split("."), index, sign * step) if name else RESTING
            return adjoint_of(changed, device).run(None if factors is None else 1 + sign * factors)

        return float(((position(1) - position(-1)) * slope).sum() / 2)

    for name, by in derivatives.numbers.items():
        for index in np.ndindex(np.shape(by)):
            step = {"load": 1.0, "at": 1e-3, "total": 0.02}.get(name.split(".")[-1], 0.02)
            if not name.startswith("probes"):
                step *= float(attrgetter(name)(Scene.model_validate(RESTING)))
            # Relative to the largest derivative of the key, as some components hardly matter.
            tolerance = 2e-3 * step * float(np.abs(by).max())
            expected = step * float(np.asarray(by)[index])
            assert difference(step, name, index) == pytest.approx(expected, rel=2e-3, abs=tolerance), (name, index)
    direction = 0.02 * np.random.default_rng(4).standard_normal((5, 6))
    expected = float((derivatives.maps["tissue.map"] * direction).sum())
    assert difference(factors=direction) == pytest.approx(expected, rel=2e-3)


@pytest.mark.slow
def test_flat_sheet_without_stiffness_stays_flat(device: Device) -> None:
    description = copy.deepcopy(RESTING)
    description["tissue"] |= {"pretension": 0, "bending": 0, "foundation_active": "loaded"}
    adjoint = adjoint_of(description, device)
    slope = 0 * adjoint.run()
    slope[0] = 1.0
    assert not any(np.any(by) for by in adjoint.backward(slope).numbers.values())


def test_singular_stiffness_is_reported(device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    adjoint = adjoint_of(RESTING, device)
    slope = 1 + 0 * adjoint.run()
    monkeypatch.setattr(rest, "RESIDUAL_TOLERANCE", -1)  # No solution is accurate enough.
    with message.raises(MsmError, "frame 1 "):
        adjoint.backward(slope)


def test_scenes_without_a_gradient_are_rejected(
    device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    tool = {"path": [[0, 0.5, 0.5, 0.01]], "instrument": {"radius": 0.005, "shaft": [0, 0, 1], "length": 0.1}}
    with message.raises(SceneError, "probes.0.path: "):
        gradient({**RESTING, "probes": [tool]}, loss, threads=device.threads)
    # A new term has no gradient until it has tangents.
    assert not Term.has_gradient
    monkeypatch.setattr(FoundationTerm, "has_gradient", False)
    monkeypatch.setattr(FoundationTerm, "key", "tissue.foundation")
    with pytest.raises(SceneError, match=r"^tissue\.foundation: has no gradient"):
        gradient(RESTING, loss, threads=device.threads)


def test_invalid_losses_are_rejected(image: str, device: Device, message: Messages) -> None:
    losses: list[Any] = [
        3,
        lambda position: 1.0,
        lambda position: (np.nan, position),
        lambda position: (position, position),
        lambda position: (1.0, position[0]),
        lambda position: (1.0, position + np.inf),
    ]
    for invalid in losses:
        with message.raises(ArgumentError, "loss"):
            gradient(moving("tissue", image), invalid, threads=device.threads)


@pytest.mark.parametrize("motion_kind", ["dynamic", "quasistatic"])
def test_missing_memory_is_reported(
    motion_kind: str, image: str, device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    monkeypatch.setattr("taichi_msm.gradients.gradient.available_memory", lambda: 1000)
    with message.raises(SceneError, "memory"):
        adjoint_of(of_motion(motion_kind, image), device)


def interrupt() -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("motion_kind", ["dynamic", "quasistatic"])
def test_interrupted_adjoint_can_be_repeated(motion_kind: str, image: str, device: Device) -> None:
    adjoint = adjoint_of(of_motion(motion_kind, image), device)
    slope = loss(adjoint.run())[1]
    expected = adjoint.backward(slope).maps["tissue.map"]
    with pytest.raises(KeyboardInterrupt):
        adjoint.run(pause=interrupt)
    adjoint.run()
    with pytest.raises(KeyboardInterrupt):
        adjoint.backward(slope, interrupt)
    assert (adjoint.backward(slope).maps["tissue.map"] == expected).all()


def test_interrupt_during_a_linear_solution(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    adjoint = adjoint_of(RESTING, device)
    slope = loss(adjoint.run())[1]
    monkeypatch.setattr(rest, "_solve", lambda *_: time.sleep(2))
    with pytest.raises(KeyboardInterrupt):
        adjoint.backward(slope, Mock(side_effect=[None, None, KeyboardInterrupt]))
