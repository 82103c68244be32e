"""The public API, and the errors of invalid arguments."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import taichi_msm
from taichi_msm import (
    ArgumentError,
    Camera,
    DivergedError,
    MsmError,
    Probe,
    Render,
    Scene,
    SceneError,
    Sheet,
    Simulation,
    load_scene,
    run,
)
from taichi_msm.model.sheet import rest_positions
from taichi_msm.render.camera import view
from taichi_msm.runs.run import free_cores
from taichi_msm.solver.planning import with_time
from taichi_msm.system import process
from taichi_msm.system.compiler import active_compiler
from taichi_msm.system.process import processor_name
from taichi_msm.system.runtime import Device
from tests import reference
from tests.golden import Messages
from tests.scenes import PRESS, SHEET, plan_of, scene, speckle


@pytest.fixture
def simulation(device: Device) -> Iterator[Simulation]:
    made = scene(render={"size": [40, 30], "refine": 1})
    with Simulation(made, threads=device.threads, texture=speckle(30, 40)) as simulation:
        yield simulation


def test_public_names(message: Messages) -> None:
    assert dir(taichi_msm) == sorted(taichi_msm.__all__)
    for name in taichi_msm.__all__:
        exported = getattr(taichi_msm, name)
        assert exported.__name__ == name
        assert exported.__doc__
    assert (Path(taichi_msm.__file__).parent / "py.typed").exists()
    with message.raises(AttributeError, "nothing"):
        taichi_msm.nothing  # noqa: B018


def test_camera_argument(simulation: Simulation) -> None:
    for camera in ("oblique", {"eye": [0, -0.3, 0.4]}, Camera(eye=(0.0, -0.3, 0.4))):
        expected = view(scene(render={"size": [40, 30], "refine": 1, "camera": camera}))
        np.testing.assert_array_equal(simulation.draw(camera), simulation.draw(expected))
    assert (simulation.draw("oblique") != simulation.draw()).any()


INVALID_TIMES: list[Any] = [10**400, np.inf, np.float16(np.nan), np.complex64(1), True, "1", [0.1]]


INVALID_ARGUMENTS: dict[str, tuple[Callable[[Simulation, Any], object], list[Any]]] = {
    "positions": (
        lambda simulation, value: simulation.draw(positions=value),
        [
            *(np.zeros(shape) for shape in [(9, 11), (9, 12, 3), (0,)]),
            *(np.full((9, 11, 3), "a"), [[1], [1, 2]]),
            # Their cells would cover every pixel, for a minute; NaN is found in any place.
            *(np.full((9, 11, 3), value) for value in (np.nan, -np.inf, 1e300)),
            np.where(np.arange(297).reshape(9, 11, 3) == 100, np.nan, 0.0),
        ],
    ),
    "texture": (
        lambda simulation, value: Simulation(simulation.scene, threads=2, texture=value),
        [
            *(np.zeros(shape, np.uint8) for shape in [(4, 5, 4), (0, 5, 3), (1, 70000, 3)]),
            np.zeros((4, 5, 3)),
        ],
    ),
    "labels": (
        lambda simulation, value: simulation.flow(value(simulation.labels())),
        [
            lambda labels: "labels",
            lambda labels: labels._replace(coordinates=np.zeros((3, 3, 2))),
            lambda labels: labels._replace(coordinates="none"),
            lambda labels: labels._replace(coordinates=labels.coordinates * 7),
        ],
    ),
    "coordinates": (Simulation.locate, [[[0.5, 1.5]], [0.5, 0.5], [[np.nan, 0.5]]]),
    "camera": (Simulation.draw, [3, "side", {"eye": [0, 0]}, {"eye": [0, 0, 0]}]),
    "frames": (Simulation.advance, [-1, 1.5, "2"]),
    # Taichi would abort the process, or start all of them.
    "threads": (lambda simulation, value: Simulation(simulation.scene, threads=value), [0, -1, 10**6, True, 1.5, "2"]),
    "pixel": (Simulation.pick, [3, None, ("a", 1), (1, 2, 3), (np.inf, 1), [[1], [1, 2]]]),
    "probes": (Simulation.steer, [3]),
    "probe": (Simulation.steer, [[{"force": [1]}]]),
    "time": (lambda simulation, value: simulation.draw(time=value), INVALID_TIMES),
    "saved": (Simulation.restore, [3]),
    "path of a scene": (lambda _, value: load_scene(value), [{"sheet": {}}, 5, None]),
    "picture of a scene": (lambda _, value: load_scene("small.yaml", image=value), [5]),
    "overrides": (lambda _, value: load_scene("small.yaml", value), [None, 3, {3: 3}, [3], "damping=1"]),
    "directory of a run": (lambda simulation, value: run(simulation.scene, value, threads=2), [None, 3, "a\0b"]),
    "update": (lambda simulation, value: simulation.scene.model_copy(update=value), [3, {3: 3}]),
    "keys without names": (lambda _, value: Sheet(*value), [((3, 3), (1, 1), 1)]),
}


# Texts that depend on the version of NumPy, and many digits.
NUMPY_TEXT = r"(np\.float16\()?nan\)?|(np\.complex64)?\(1\+0j\)|setting an array.*(?=; take)|0{99,}"


@pytest.mark.parametrize("name", INVALID_ARGUMENTS)
def test_invalid_arguments(name: str, simulation: Simulation, small: Path, message: Messages) -> None:
    call, values = INVALID_ARGUMENTS[name]
    for value in values:
        with message.raises(SceneError if name in ("camera", "probe") else ArgumentError, hide=NUMPY_TEXT):
            call(simulation, value)


def test_scenes_built_in_python_are_validated(device: Device, tmp_path: Path, message: Messages) -> None:
    good = scene()
    with message.raises(SceneError, "sheet.mass", "shaer"):
        Scene(sheet={"points": [3, 3], "size": [1, 1], "mass": 0}, springs={}, time={"duration": 1}, output=(), shaer=1)
    with message.raises(SceneError, "damping"):
        good.model_copy(update={"damping": -1})
    with message.raises(SceneError, "damping"):
        good.damping = 3
    with message.raises(SceneError, "supersample"):
        Render(supersample=9)
    with message.raises(SceneError, "force"):
        Probe()
    broken = {"sheet": SHEET, "springs": {}, "time": {"duration": -1}, "output": []}
    unstable = with_time(good, step=0.04)
    assert plan_of(good).stable_step < 0.04
    for attempt in (lambda made: Simulation(made, threads=device.threads), lambda made: run(made, tmp_path / "out")):
        with message.raises(SceneError, "time.duration"):
            attempt(broken)
        with message.raises(SceneError, "time.step"):
            attempt(unstable)
        with message.raises(ArgumentError, "load_scene"):
            attempt("scenes/press.yaml")
    assert not (tmp_path / "out").exists()
    with Simulation(good.model_dump(), threads=device.threads) as simulation:
        assert simulation.scene == good


def test_steering_a_fixed_tool(device: Device, message: Messages) -> None:
    """It can jump to another position, but not move."""
    moved = {**PRESS, "at": [0.25, 0.75], "falloff": 30, "offset": 11}
    with (
        Simulation(scene(), threads=device.threads) as steered,
        Simulation(scene(probes=[moved]), threads=device.threads) as expected,
    ):
        before = steered.scene
        with message.raises(ArgumentError):
            steered.steer([{**PRESS, "at": [[0, 0.5, 0.5], [1, 0.6, 0.5]]}])
        assert steered.scene == before
        steered.steer([moved])
        steered.advance(3)
        expected.advance(3)
        np.testing.assert_array_equal(steered.positions(), expected.positions())


def test_steering_between_force_and_total(device: Device, message: Messages) -> None:
    """Only a total is smaller at an open edge."""
    made = scene(sheet={**SHEET, "fixed": ["top"]})
    with Simulation(made, threads=device.threads) as simulation, message.raises(ArgumentError, "restart"):
        simulation.steer([{"total": [0, 0, -1], "load": PRESS["load"], "falloff": 20}])


def test_restart(simulation: Simulation, device: Device, message: Messages) -> None:
    simulation.advance(3)
    simulation.restart()
    assert (simulation.frame, simulation.time, simulation.steps) == (0, 0.0, 0)
    np.testing.assert_array_equal(simulation.positions(), rest_positions(simulation.scene.sheet))
    changed = scene(sheet={**SHEET, "points": [6, 20]}, render={"size": [20, 25], "camera": "oblique"}, damping=0.02)
    simulation.restart(changed)
    simulation.advance(2)
    with Simulation(changed, threads=device.threads, texture=speckle(30, 40)) as expected:
        expected.advance(2)
        np.testing.assert_array_equal(simulation.positions(), expected.positions())
        np.testing.assert_array_equal(simulation.draw(), expected.draw())
    with message.raises(SceneError, "time.step"):
        simulation.restart(with_time(changed, step=0.04))
    assert simulation.scene == changed


def test_velocities_of_the_last_step(simulation: Simulation) -> None:
    assert not simulation.velocities().any()
    simulation.advance(2)
    h = plan_of(simulation.scene).grid.step
    made = with_time(simulation.scene, duration=2 * 0.04, frames_per_second=round(1 / h), step=h)
    states = list(reference.displacements(plan_of(made)))
    np.testing.assert_allclose(simulation.velocities(), (states[-1] - states[-2]) / h, atol=1e-12)


def test_surface(simulation: Simulation) -> None:
    simulation.advance(2)
    vertices, triangles, coordinates = simulation.surface()
    position = simulation.positions()
    np.testing.assert_allclose(vertices, reference.refine(position.astype(float), 1).reshape(-1, 3), atol=1e-15)
    np.testing.assert_array_equal(vertices.reshape(17, 21, 3)[::2, ::2], position)
    assert (triangles.shape, triangles.min(), triangles.max()) == ((2 * 16 * 20, 3), 0, 17 * 21 - 1)
    # Triangles tile the unit square of texture coordinates, counterclockwise; cells are cut from top left.
    x, y = coordinates[:, 0], -coordinates[:, 1]
    p, q, r = triangles.T
    areas = ((x[q] - x[p]) * (y[r] - y[p]) - (y[q] - y[p]) * (x[r] - x[p])) / 2
    np.testing.assert_allclose(areas, 1 / len(triangles), rtol=1e-12)
    assert {tuple(corner) for corner in triangles[:2]} == {(0, 21, 22), (0, 22, 1)}


def test_pick(simulation: Simulation) -> None:
    assert simulation.pick((9.5, 6.5)) == pytest.approx((0.25, 7 / 30))
    assert simulation.pick((20, 2), "oblique") != simulation.pick((20, 2))
    assert simulation.pick((-10, -10)) is None


def test_picture_and_device_in_the_record(device: Device, small: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    record = run(load_scene("small.yaml", ["output=[png]"]), "out", threads=device.threads)
    monkeypatch.chdir("/")
    image = Path(record["working_directory"]) / record["scene"]["image"]
    assert image.samefile(small / "speckle.png")
    assert record["device"] == device.name == processor_name()


def test_import_in_a_notebook_prints_nothing() -> None:
    # A notebook replaces sys.stdout.
    notebook = "import io, sys; sys.stdout = io.StringIO(); import taichi_msm.system.runtime"
    done = subprocess.run([sys.executable, "-c", notebook], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")


def test_errors_of_the_package(simulation: Simulation, message: Messages) -> None:
    assert issubclass(ArgumentError, MsmError)
    assert issubclass(ArgumentError, ValueError)
    error = pickle.loads(pickle.dumps(SceneError(["first", "second"])))
    assert (str(error), error.lines) == ("first\nsecond", ("first", "second"))
    with message.raises(MsmError):
        simulation.diagnose()
    simulation.close()
    calls = (simulation.advance, simulation.draw, simulation.velocities, simulation.restart, simulation.compile)
    for call in (*calls, simulation.save):
        with message.raises(MsmError):
            call()
    assert np.isfinite(simulation.positions()).all()


def test_state_of_another_scene(simulation: Simulation, device: Device, message: Messages) -> None:
    simulation.advance(3)
    before = simulation.positions()
    changed = (
        scene(time={"step": plan_of(simulation.scene).grid.step / 4}),
        scene(sheet={**SHEET, "points": [5, 5]}),
        scene(time={"precision": "f32"}),
    )
    for made in changed:
        with Simulation(made, threads=device.threads) as source:
            source.advance(1)
            with message.raises(ArgumentError, "saved"):
                simulation.restore(source.save())
    np.testing.assert_array_equal(simulation.positions(), before)
    simulation.advance()


def test_pickled_simulation(simulation: Simulation, device: Device, message: Messages) -> None:
    for call in (pickle.dumps, copy.copy, copy.deepcopy):
        with message.raises(MsmError, "restore"):
            call(simulation)
    saved, made = pickle.loads(pickle.dumps((simulation.save(), simulation.scene)))
    with Simulation(made, threads=device.threads) as restored:
        restored.restore(saved)
        np.testing.assert_array_equal(restored.positions(), simulation.positions())


def test_simulation_against_the_reference(device: Device) -> None:
    made = scene(render={"size": [40, 30], "refine": 1})
    twin = reference.simulate(made)
    with Simulation(made, threads=device.threads, texture=speckle(30, 40)) as simulation:
        first = simulation.positions()
        np.testing.assert_array_equal(first, twin[0])
        simulation.advance(3)
        simulation.advance(0)
        assert simulation.frame == 3
        assert simulation.time == pytest.approx(0.12)
        np.testing.assert_allclose(simulation.positions(), twin[3], atol=1e-13)
        np.testing.assert_array_equal(first, twin[0], "positions of a frame are not overwritten")
        assert not first.flags.writeable
        differences = np.abs(simulation.draw().astype(int) - reference.draw(made, twin[3], speckle(30, 40)))
        assert (differences > 1).mean() < 0.01
    assert simulation.progress.max_displacement == pytest.approx(np.linalg.norm(twin[:4] - twin[0], axis=-1).max())


def test_divergence_keeps_the_last_valid_frame(device: Device, message: Messages) -> None:
    # At 0.1 s the load jumps to an unstable value.
    made = scene(probes=[{"force": [0, 0, 1], "load": [[0, 0], [0.1, 100], [0.1, 1e15]], "falloff": 20}])
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance(2)
        good = simulation.positions()
        with message.raises(DivergedError, "0.12 s", hide=r"point .*? is \S+") as caught:
            simulation.advance(5)
        np.testing.assert_array_equal(simulation.positions(), good)
    error = caught.value
    assert isinstance(error, DivergedError)
    assert error.step > 0
    assert error.time == pytest.approx(error.step * plan_of(made).grid.step)
    assert f"point {error.point}" in str(error)
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.step, again.time, again.point) == (str(error), error.step, error.time, error.point)


def test_free_sheet_under_a_constant_force(device: Device) -> None:
    # F = 0.05 N on each point of 1 g for 0.8 s: u = F t^2 / (2 m) = 16 m, forty sheets away, and no error of Verlet.
    made = scene(
        sheet={"points": [2, 2], "size": [0.4, 0.4], "mass": 1e-3, "fixed": "none"},
        springs={"structural": 20},
        damping=0,
        probes=[{"force": [0, 0, 0.05], "falloff": 0, "offset": 0}],
        time={"duration": 0.8},
    )
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance(20)
        np.testing.assert_allclose(simulation.positions()[..., 2], 16.0, rtol=1e-12)


def test_one_device_per_process(device: Device, message: Messages) -> None:
    with message.raises(taichi_msm.DeviceError, hide=active_compiler().title):
        Simulation(scene(), threads=device.threads + 1)


def test_steered_tool_is_drawn_with_its_instrument(simulation: Simulation) -> None:
    bare, probe = simulation.draw(), simulation.scene.probes[0]
    simulation.steer([probe.model_copy(update={"instrument": {"radius": 0.02, "shaft": [0, 0, 1], "length": 0.1}})])
    assert (simulation.draw() != bare).any()


def test_html_of_a_frame(simulation: Simulation, message: Messages) -> None:
    page = simulation._repr_html_()
    assert page
    message(page.partition("<figcaption>")[2])


def test_free_cores(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "available_threads", lambda: 4)
    made = scene(render={"size": [512, 512]}, time={"step": 0.001})
    assert free_cores(plan_of(made)) == 4, "nothing to encode"
    made = made.model_copy(update={"image": "a.png", "output": ("gif",)})
    assert free_cores(plan_of(made)) == 3
    # 40 steps of 10^6 points a frame take longer than its 512 x 512 pixels.
    large = made.sheet.model_copy(update={"points": (1000, 1000)})
    large_scene = made.model_copy(update={"sheet": large})
    assert free_cores(plan_of(large_scene)) == 4
    monkeypatch.setattr(process, "available_threads", lambda: 1)
    assert free_cores(plan_of(made)) == 1
