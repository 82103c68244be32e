"""Derivatives of a loss against complex steps of the twin, differences of runs, and each other."""

from __future__ import annotations

import copy
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from operator import attrgetter
from typing import Any

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
from taichi_msm.model.loads import average_loads
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import rest_positions
from taichi_msm.solver import backoff
from taichi_msm.solver.planned_sheet import choose_layout
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

# Kinds of sheets: what a kernel can be compiled for.
KINDS = ("tissue", "tissue, free edges", "springs", "springs, bare")

TISSUE = {"young": 900, "thickness": 0.015, "density": 1000, "damping": 3.0}


@pytest.fixture(autouse=True)
def _short_segments(monkeypatch: pytest.MonkeyPatch) -> None:
    """Of small sheets, one segment would hold all steps."""
    monkeypatch.setattr(motion, "SEGMENT_BYTES", 0)


@pytest.fixture(scope="module")
def image(tmp_path_factory: pytest.TempPathFactory) -> str:
    path = tmp_path_factory.mktemp("maps") / "map.png"
    Image.fromarray(speckle(12, 9)[..., 0]).save(path)
    return str(path)


def described(kind: str, image: str, steps: int = 12) -> dict[str, Any]:
    """A scene of a kind with two frames of so many steps; keys of loads and places lie on and between steps."""
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


def value(position: NDArray[Any]) -> Any:
    """A loss of the positions of all frames that is not linear in them; also of complex ones."""
    return (weights(position.shape) * position + 3 * position**2).sum()


def weights(shape: tuple[int, ...]) -> Array:
    return np.cos(np.arange(np.prod(shape))).reshape(shape)


def loss(position: Array) -> tuple[float, Array]:
    """The same loss and its derivative."""
    return float(value(position)), weights(position.shape) + 6 * position


def differentiated(made: Mapping[str, Any], device: Device) -> Derivatives:
    adjoint = Adjoint(plan_of(Scene.model_validate(made)), device)
    return adjoint.backward(loss(adjoint.run())[1])


def twin_value(plan: Plan, put: Sheet) -> Any:
    """The loss by the twin, of another sheet, which may be complex."""
    every = [u for u, _ in reference.steps(plan, put)]
    return value(rest_positions(plan.scene.sheet) + np.array(every[:: plan.grid.steps_per_frame]))


def with_step(section: Any, path: Sequence[str], relative: complex) -> Any:
    """A scene with a number that is changed by a share of itself, and not checked."""
    name, *inner = path
    of = getattr(section, name)
    changed = with_step(of, inner, relative) if inner else of * (1 + relative)
    return BaseModel.model_copy(section, update={name: changed})


def material_numbers(found: Derivatives) -> list[str]:
    return [name for name in found.numbers if not name.startswith("probes")]


@pytest.mark.parametrize("kind", KINDS)
def test_the_tangent_is_symmetric_and_that_of_the_force(kind: str, image: str) -> None:
    plan = plan_of(Scene.model_validate(described(kind, image)))
    loads = average_loads(plan, 0, 1)
    u, v, w = 0.004 * np.random.default_rng(1).standard_normal((3, *plan.scene.sheet.points, 3))
    changed = [reference.tangent(plan.scene, u, of, loads.active[0]) for of in (v, w)]
    assert (w * changed[0]).sum() == pytest.approx((v * changed[1]).sum(), rel=1e-13)
    exact = reference.force(plan.scene, u + 1j * STEP * v, loads, 0).imag / STEP
    np.testing.assert_allclose(changed[0], exact, rtol=0, atol=1e-13 * np.abs(exact).max())


@pytest.mark.default_cases("tissue, free edges-12")
@pytest.mark.parametrize("steps", [1, 12])
@pytest.mark.parametrize("kind", KINDS)
def test_material_numbers_are_those_of_complex_steps(kind: str, steps: int, image: str, device: Device) -> None:
    made = described(kind, image, steps)
    plan, found = plan_of(Scene.model_validate(made)), differentiated(made, device)
    names = material_numbers(found)
    assert len(names) == {"tissue": 8, "tissue, free edges": 5, "springs": 5, "springs, bare": 2}[kind]
    for name in names:
        put = sheet(with_step(plan.scene, name.split("."), 1j * STEP))
        slope = found.numbers[name] * float(attrgetter(name)(plan.scene))
        # Of the second of two steps the product of the adjoint with all that the material does to it.
        assert slope == pytest.approx(twin_value(plan, put).imag / STEP, rel=1e-13 if steps == 1 else 1e-11), name


def test_the_map_of_the_foundation_is_that_of_the_twin(image: str, device: Device) -> None:
    made = described("tissue", image)
    plan, found = plan_of(Scene.model_validate(made)), differentiated(made, device)
    some, put = np.random.default_rng(2).standard_normal(plan.fixed.shape), sheet(plan.scene)
    factors: Any = plan.material.virtual_factors
    changed = put._replace(virtual=put.virtual * (1 + 1j * STEP * some / factors))
    slope = float((found.maps["tissue.foundation_map"] * some).sum())
    assert slope == pytest.approx(twin_value(plan, changed).imag / STEP, rel=1e-11)


def remainders(known: float, slope: float, step: float, changed: Callable[[float], float]) -> tuple[float, float]:
    """What a line through the loss misses a step away, and half a step away."""
    return abs(changed(step) - known - step * slope), abs(changed(step / 2) - known - step / 2 * slope)


def require_second_order(known: float, missed: tuple[float, float], name: str) -> None:
    """What is missed is 4 times smaller at half the step, but for the next order; rounding is 1e-15 of the loss."""
    whole, half = missed
    assert whole > 1e-12 * abs(known), f"{name}: {whole}"
    assert 3.8 < whole / half < 4.2, f"{name}: {whole / half}"


def put_in(made: dict[str, Any], path: list[str], index: tuple[int, ...], change: float) -> dict[str, Any]:
    """A description with a number that is changed."""
    made = copy.deepcopy(made)
    of: Any = made
    *keys, last = [int(key) if key.isdigit() else key for key in path]
    for key in keys:
        of = of[key]
    if last == "load":
        of, last = of["load"][index[0]], 1
    elif len(index) == 2:
        # Keys of a control point begin with the time.
        of, last = of[last][index[0]], index[1] + 1
    elif index:
        of, last = of[last], index[0]
    of[last] += change
    return made


@pytest.mark.default_cases("tissue, free edges")
@pytest.mark.parametrize("kind", KINDS)
def test_what_is_missed_by_every_number_is_of_second_order(kind: str, image: str, device: Device) -> None:
    """By every number of a tool; complex steps do the others."""
    made = described(kind, image)
    adjoint = Adjoint(plan_of(Scene.model_validate(made)), device)
    known, slope = loss(adjoint.run())
    numbers = {name: by for name, by in adjoint.backward(slope).numbers.items() if name.startswith("probes")}
    count = 0
    for name, by in numbers.items():
        for index in np.ndindex(np.shape(by)):
            path, step = name.split("."), {"load": 5.0, "at": 1e-4}.get(name.split(".")[-1], 0.05)

            def changed(by: float, path: list[str] = path, index: tuple[int, ...] = index) -> float:
                return loss(Adjoint(plan_of(Scene.model_validate(put_in(made, path, index, by))), device).run())[0]

            missed = remainders(known, float(np.asarray(by)[index]), step, changed)
            require_second_order(known, missed, f"{name} {index}")
            count += 1
    # 6 components, 5 percents, and 4 places of two numbers.
    assert count == 6 + 5 + 8


@pytest.mark.parametrize("kind", ["tissue, free edges", "springs"])
def test_a_map_of_the_stiffness_has_its_slope_wherever_it_is(kind: str, image: str, device: Device) -> None:
    plan = plan_of(Scene.model_validate(described(kind, image)))
    adjoint, rng = Adjoint(plan, device), np.random.default_rng(3)
    # The scene with tissue has no map of its own; another one compiles nothing.
    factors, some = rng.uniform(0.7, 2, (5, 10)), rng.standard_normal((5, 10))
    known, slope = loss(adjoint.run(factors))
    by_cell = adjoint.backward(slope).maps[f"{plan.scene.kind}.map"]

    def changed(by: float) -> float:
        return loss(adjoint.run(factors + by * some))[0]

    require_second_order(known, remainders(known, float((by_cell * some).sum()), 0.02, changed), kind)
    # Without factors it is the scene's own again.
    own = Adjoint(plan, device)
    assert (adjoint.run() == own.run()).all()
    maps = [each.backward(slope).maps[f"{plan.scene.kind}.map"] for each in (adjoint, own)]
    assert (maps[0] == maps[1]).all()


@pytest.mark.parametrize("steps", [1, 2, 3, 10_000])
def test_any_number_of_steps(steps: int, image: str, device: Device) -> None:
    made = described("tissue", image)
    made["time"] |= {"duration": steps * 0.0016, "frames_per_second": 1 / (steps * 0.0016), "step": 0.0016}
    adjoint = Adjoint(plan_of(Scene.model_validate(made)), device)
    known, slope = loss(adjoint.run())
    found = adjoint.backward(slope)
    numbers = ("probes.0.total", (2,), 0.2), ("tissue.thickness", (), 4e-4), ("probes.0.load", (3,), 5.0)
    for name, index, step in numbers:

        def changed(by: float, name: str = name, index: tuple[int, ...] = index) -> float:
            other = Scene.model_validate(put_in(made, name.split("."), index, by))
            return loss(Adjoint(plan_of(other), device).run())[0]

        by = float(np.asarray(found.numbers[name])[index])
        if steps > 10 or (by and name.startswith("tissue")):
            require_second_order(known, remainders(known, by, step, changed), name)
        else:
            # In the first step a point moves in proportion to the load, and the loss is quadratic in that.
            assert (changed(step) - changed(-step)) / (2 * step) == pytest.approx(by, rel=1e-9, abs=1e-12)


def test_the_bits_depend_neither_on_workers_nor_on_segments(
    image: str, device: Device, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = described("tissue", image)
    # With bending a worker needs two rows that move.
    made["sheet"] |= {"points": [9, 11], "size": [0.16, 0.19]}
    plan = with_stiffness_map(plan_of(Scene.model_validate(made)))

    def bits(workers: int) -> bytes:
        sheet = MotionAdjoint(plan, device, layout=replace(choose_layout(plan, device), workers=workers))
        slopes, loads = sheet.backward(loss(sheet.run())[1])
        arrays = [*slopes.springs, slopes.tensions, slopes.foundation, *loads.by_key.values()]
        arrays += [slopes.bending, slopes.keep, slopes.gain, slopes.first_gain]
        return b"".join(np.asarray(array).tobytes() for array in arrays)

    alone = bits(1)
    assert bits(2) == bits(3) == alone
    with monkeypatch.context() as patched:
        patched.setattr(motion, "SEGMENT_BYTES", 2**20)
        assert bits(2) == alone
    # Workers that give up at once.
    monkeypatch.setattr(motion, "MAX_WAIT_CHECKS", 0)
    assert bits(3) == alone
    # After that a single worker sweeps, until the back-off ends.
    monkeypatch.setattr(backoff, "MIN_BACKOFF_S", 1000.0)
    monkeypatch.setattr(backoff, "MAX_BACKOFF_S", 1000.0)
    launches: list[bool] = []

    def counted(config: KernelConfig, *, parallel: bool) -> Any:
        launches.append(parallel)
        return build_sweep(config, parallel=parallel)

    monkeypatch.setattr(kernel_motion, "build_sweep", counted)
    assert bits(3) == alone
    assert not any(launches[launches.index(False) :])


def test_positions_are_those_of_a_simulation(image: str, device: Device) -> None:
    made = Scene.model_validate(described("tissue", image))
    seen = []
    with Simulation(made, threads=device.threads) as simulation:
        for _ in range(3):
            seen.append(simulation.positions())
            simulation.advance()

    def none(position: Array) -> tuple[float, Array]:
        assert (position == np.array(seen)).all()
        return 0.0, 0 * position

    found = gradient(made, none, threads=device.threads)
    assert found.value == 0
    assert not any(np.any(slope) for slope in (*found.numbers.values(), *found.maps.values()))


REST = {
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


def test_a_sheet_at_rest_has_the_slopes_of_its_shapes(device: Device) -> None:
    adjoint = Adjoint(plan_of(Scene.model_validate(REST)), device)
    slope = loss(adjoint.run())[1]
    found = adjoint.backward(slope)
    assert len(material_numbers(found)) == 5

    def along(some: dict[tuple[str, tuple[int, ...]], float], maps: Any = None) -> float:
        """Central differences of the loss, made linear, as shapes are found to 1e-7 of the forces."""

        def moved(sign: int) -> Array:
            made: dict[str, Any] = copy.deepcopy(REST)
            for (name, index), by in some.items():
                made = put_in(made, name.split("."), index, sign * by)
            other = Adjoint(plan_of(Scene.model_validate(made)), device)
            return other.run(None if maps is None else 1 + sign * maps)

        return float(((moved(1) - moved(-1)) * slope).sum() / 2)

    for name, by in found.numbers.items():
        for index in np.ndindex(np.shape(by)):
            step = {"load": 1.0, "at": 1e-3, "total": 0.02}.get(name.split(".")[-1], 0.02)
            if not name.startswith("probes"):
                step *= float(attrgetter(name)(Scene.model_validate(REST)))
            # Relative to the largest derivative of the key, as some components hardly matter.
            most = step * float(np.abs(by).max())
            assert along({(name, index): step}) == pytest.approx(
                step * float(np.asarray(by)[index]), rel=2e-3, abs=2e-3 * most
            ), (name, index)
    some = 0.02 * np.random.default_rng(4).standard_normal((5, 6))
    assert along({}, some) == pytest.approx(float((found.maps["tissue.map"] * some).sum()), rel=2e-3)


@pytest.mark.slow
def test_a_flat_sheet_that_nothing_holds_stays_flat(device: Device) -> None:
    made: dict[str, Any] = copy.deepcopy(REST)
    made["tissue"] |= {"pretension": 0, "bending": 0, "foundation_active": "loaded"}
    adjoint = Adjoint(plan_of(Scene.model_validate(made)), device)
    slope = 0 * adjoint.run()
    slope[0] = 1.0
    assert not any(np.any(by) for by in adjoint.backward(slope).numbers.values())


def test_a_shape_without_stiffness_is_named(device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    adjoint = Adjoint(plan_of(Scene.model_validate(REST)), device)
    slope = 1 + 0 * adjoint.run()
    # As if no solution were one.
    monkeypatch.setattr(rest, "RESIDUAL_TOLERANCE", -1)
    with message.raises(MsmError, "frame 1 "):
        adjoint.backward(slope)


def test_contact_is_refused(device: Device, message: Messages) -> None:
    rod = {"radius": 0.005, "shaft": [0, 0, 1], "length": 0.1}
    made = {**REST, "probes": [{"path": [[0, 0.5, 0.5, 0.01]], "instrument": rod}]}
    with message.raises(SceneError, "probes.0.path: "):
        gradient(made, loss, threads=device.threads)


def test_a_term_without_a_gradient_is_refused(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    """As every new term is, until it has tangents."""
    assert not Term.has_gradient
    monkeypatch.setattr(FoundationTerm, "has_gradient", False)
    monkeypatch.setattr(FoundationTerm, "key", "tissue.foundation")
    with pytest.raises(SceneError, match=r"^tissue\.foundation: has no gradient"):
        gradient(REST, loss, threads=device.threads)


LOSSES: dict[str, Any] = {
    "number": 3,
    "no pair": lambda position: 1.0,
    "no number": lambda position: (np.nan, position),
    "array": lambda position: (position, position),
    "another shape": lambda position: (1.0, position[0]),
    "infinite": lambda position: (1.0, position + np.inf),
    "bool": lambda position: (1.0, position > 0),
}


@pytest.mark.parametrize("case", LOSSES)
def test_a_loss_that_returns_something_else(case: str, image: str, device: Device, message: Messages) -> None:
    with message.raises(ArgumentError, "loss"):
        gradient(described("tissue", image), LOSSES[case], threads=device.threads)


@pytest.mark.parametrize("kind", ["motion", "rest"])
def test_a_gradient_for_which_there_is_no_memory(
    kind: str, image: str, device: Device, monkeypatch: pytest.MonkeyPatch, message: Messages
) -> None:
    scene = Scene.model_validate(REST if kind == "rest" else described("tissue", image))
    monkeypatch.setattr("taichi_msm.gradients.gradient.available_memory", lambda: 1000)
    with message.raises(SceneError, "memory"):
        Adjoint(plan_of(scene), device)


@pytest.mark.parametrize("kind", ["motion", "rest"])
def test_what_a_pause_raises_stops_there(kind: str, image: str, device: Device) -> None:
    adjoint = Adjoint(plan_of(Scene.model_validate(REST if kind == "rest" else described("tissue", image))), device)
    slope = loss(adjoint.run())[1]
    before = adjoint.backward(slope).maps["tissue.map"]

    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        adjoint.run(pause=stop)
    slope = loss(adjoint.run())[1]
    with pytest.raises(KeyboardInterrupt):
        adjoint.backward(slope, stop)
    assert (adjoint.backward(slope).maps["tissue.map"] == before).all()


def test_a_pause_follows_every_launch(image: str, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    adjoint, launch = Adjoint(plan_of(Scene.model_validate(described("tissue", image))), device), MotionAdjoint._launch
    slope = loss(adjoint.run())[1]
    launches: list[int] = []
    pauses: list[int] = []

    def counted(*arguments: Any) -> None:
        launches.append(1)
        launch(*arguments)

    monkeypatch.setattr(MotionAdjoint, "_launch", counted)
    adjoint.backward(slope, lambda: pauses.append(1))
    assert len(pauses) == len(launches) > 2


def test_a_solution_that_takes_long_is_left_behind(device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    adjoint, pauses = Adjoint(plan_of(Scene.model_validate(REST)), device), []
    slope = loss(adjoint.run())[1]
    monkeypatch.setattr(rest, "_solve", lambda *_: time.sleep(2))

    def stop() -> None:
        pauses.append(1)
        if len(pauses) == 3:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        adjoint.backward(slope, stop)


def test_factors_that_cannot_be(image: str, device: Device, message: Messages) -> None:
    adjoint = Adjoint(plan_of(Scene.model_validate(described("tissue", image))), device)
    with message.raises(MsmError, "run"):
        adjoint.backward(np.zeros((3, 6, 11, 3)))
    for factors in (np.ones((6, 11)), np.zeros((5, 10)), np.full((5, 10), 1000.0)):
        with message.raises(ArgumentError, "factors: "):
            adjoint.run(factors)
