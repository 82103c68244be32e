"""What a caller may get wrong gets one clear error; what is public works."""

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
from PIL import Image

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
    resume,
    run,
)
from taichi_msm.model.sheet import rest_positions
from taichi_msm.render.camera import view
from taichi_msm.runs.finished import read_run
from taichi_msm.runs.run import free_cores
from taichi_msm.solver.planning import with_time
from taichi_msm.system import process
from taichi_msm.system.compiler import active_compiler
from taichi_msm.system.process import processor_name
from taichi_msm.system.runtime import Device
from tests import reference
from tests.golden import Messages
from tests.scenes import PRESS, SHEET, plan_of, scene, speckle

HAND = {"at": [[0, 0.5, 0.5]], "force": [0, 0, -20], "falloff": 20, "offset": 0}


@pytest.fixture
def simulation(device: Device) -> Iterator[Simulation]:
    made = scene(render={"size": [40, 30], "refine": 1})
    with Simulation(made, threads=device.threads, texture=speckle(30, 40)) as simulation:
        yield simulation


def test_what_is_exported_is_there_and_nothing_else(message: Messages) -> None:
    for name in taichi_msm.__all__:
        exported = getattr(taichi_msm, name)
        assert exported.__name__ == name
        assert exported.__doc__
    assert (Path(taichi_msm.__file__).parent / "py.typed").exists()
    with message.raises(AttributeError, "nothing"):
        taichi_msm.nothing  # noqa: B018


def test_a_camera_is_given_as_in_a_scene(simulation: Simulation) -> None:
    keys = {"eye": [0, -0.3, 0.4]}
    for camera in ("oblique", keys, Camera(eye=(0.0, -0.3, 0.4))):
        seen = scene(render={"size": [40, 30], "refine": 1, "camera": camera})
        np.testing.assert_array_equal(simulation.draw(camera), simulation.draw(view(seen)))
    assert (simulation.draw("oblique") != simulation.draw()).any()


NO_TIMES: list[Any] = [10**400, -(10**400), np.inf, np.float16(np.nan), np.complex64(1), True, "1", [0.1]]

WRONG: dict[str, tuple[Callable[[Simulation, Any], object], list[Any]]] = {
    "positions": (
        lambda one, value: one.draw(positions=value),
        [
            *(np.zeros(shape) for shape in [(9, 11), (9, 12, 3), (8, 11, 3), (9, 11, 4), (2001, 2001, 3), (0,)]),
            *(np.full((9, 11, 3), "a"), [[1], [1, 2]]),
        ],
    ),
    "texture": (
        lambda one, value: Simulation(one.scene, threads=2, texture=value),
        [
            *(np.zeros(shape, np.uint8) for shape in [(4, 5), (4, 5, 4), (0, 5, 3), (1, 70000, 3)]),
            np.zeros((4, 5, 3)),
        ],
    ),
    "labels": (
        lambda one, value: one.flow(value(one.labels())),
        [
            lambda labels: "labels",
            lambda labels: labels._replace(coordinates=np.zeros((3, 3, 2))),
            lambda labels: labels._replace(coordinates="none"),
            lambda labels: labels._replace(coordinates=labels.coordinates * 7),
        ],
    ),
    "coordinates": (Simulation.locate, [[[0.5, 1.5]], [0.5, 0.5], [[np.nan, 0.5]]]),
    "camera": (Simulation.draw, [3, "side", {"eye": [0, 0]}, {"eye": [0, 0, 0]}]),
    "frames": (Simulation.advance, [-1, 1.5, "2", None]),
    "frames played": (lambda one, value: one.play(value), [-1]),
    # Taichi would abort the process, or start them all.
    "threads": (lambda one, value: Simulation(one.scene, threads=value), [0, -1, 10**6, True, 1.5, "2"]),
    "pixel": (Simulation.pick, [3, None, ("a", 1), (1, 2, 3), (np.inf, 1), [[1], [1, 2]]]),
    "probes": (Simulation.steer, [3]),
    "probe": (Simulation.steer, [[{"force": [1]}]]),
    "time of labels": (lambda one, value: one.labels(time=value), NO_TIMES),
    "time of a picture": (lambda one, value: one.draw(time=value), NO_TIMES),
    "saved": (Simulation.restore, [3]),
    "path of a scene": (lambda _, value: load_scene(value), [{"sheet": {}}]),
    "overrides": (lambda _, value: load_scene("small.yaml", value), [None, 3, {3: 3}, [3], "damping=1"]),
    "directory of a run": (lambda one, value: run(one.scene, value, threads=2), [None, 3, "a\0b"]),
    "directory to resume": (lambda _, value: resume(value), [None, 3, "a\0b"]),
    "directory to read": (lambda _, value: read_run(value), ["a\0b"]),
    "update": (lambda one, value: one.scene.model_copy(update=value), [3, {3: 3}]),
    "keys without names": (lambda _, value: Sheet(*value), [((3, 3), (1, 1), 1)]),
}


# How NumPy of some version writes a number, and why it makes no array; and many digits.
OF_NUMPY = r"(np\.float16\()?nan\)?|(np\.complex64)?\(1\+0j\)|setting an array.*(?=; take)|0{99,}"


@pytest.mark.parametrize("name", WRONG)
def test_wrong_arguments_are_refused(name: str, simulation: Simulation, small: Path, message: Messages) -> None:
    call, values = WRONG[name]
    for value in values:
        with message.raises(SceneError if name in ("camera", "probe") else ArgumentError, hide=OF_NUMPY):
            call(simulation, value)


def test_scenes_made_in_python_are_checked(device: Device, tmp_path: Path, message: Messages) -> None:
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


def test_a_tool_that_stands_can_be_put_elsewhere(device: Device) -> None:
    # As if it had been there all the time, and at the same time moved by its keys.
    there = {**PRESS, "at": [0.25, 0.75], "falloff": 30, "offset": 11}
    with (
        Simulation(scene(), threads=device.threads) as steered,
        Simulation(scene(probes=[there]), threads=device.threads) as expected,
    ):
        steered.steer([there])
        steered.advance(3)
        expected.advance(3)
        np.testing.assert_array_equal(steered.positions(), expected.positions())


def test_a_tool_that_stands_cannot_be_moved(simulation: Simulation, message: Messages) -> None:
    simulation.advance()
    before = simulation.scene
    with message.raises(ArgumentError):
        simulation.steer([{**PRESS, "at": [[0, 0.5, 0.5], [1, 0.6, 0.5]]}])
    assert simulation.scene == before
    simulation.advance()


def test_restarted_it_is_a_new_simulation(simulation: Simulation, device: Device, message: Messages) -> None:
    simulation.advance(3)
    simulation.restart()
    assert (simulation.frame, simulation.time, simulation.steps) == (0, 0.0, 0)
    np.testing.assert_array_equal(simulation.positions(), rest_positions(simulation.scene.sheet))
    other = scene(sheet={**SHEET, "points": [6, 20]}, render={"size": [20, 25], "camera": "oblique"}, damping=0.02)
    simulation.restart(other)
    simulation.advance(2)
    with Simulation(other, threads=device.threads, texture=speckle(30, 40)) as expected:
        expected.advance(2)
        np.testing.assert_array_equal(simulation.positions(), expected.positions())
        np.testing.assert_array_equal(simulation.draw(), expected.draw())
    with message.raises(SceneError, "time.step"):
        simulation.restart(with_time(other, step=0.04))
    assert simulation.scene == other


def test_restarted_it_reads_its_picture_again_where_it_would_look_different(device: Device, tmp_path: Path) -> None:
    # Nothing of the picture hides the background.
    Image.new("RGBA", (8, 8)).save(tmp_path / "clear.png")
    colours = [(0, 0, 0), (200, 0, 0)]
    first, second = (
        scene(image=str(tmp_path / "clear.png"), render={"size": [40, 30], "background": colour}) for colour in colours
    )
    with Simulation(first, threads=device.threads) as simulation:
        assert (simulation.draw() == colours[0]).all()
        simulation.restart(second)
        assert (simulation.draw() == colours[1]).all()


def test_a_tool_that_gets_an_instrument_is_drawn_with_it(simulation: Simulation) -> None:
    bare = simulation.draw()
    probe = simulation.scene.probes[0]
    simulation.steer([probe.model_copy(update={"instrument": {"radius": 0.02, "shaft": [0, 0, 1], "length": 0.1}})])
    assert (simulation.draw() != bare).any()


def test_velocities_are_the_mean_of_the_last_step(simulation: Simulation) -> None:
    assert not simulation.velocities().any()
    simulation.advance(2)
    h = plan_of(simulation.scene).grid.step
    made = with_time(simulation.scene, duration=2 * 0.04, frames_per_second=round(1 / h), step=h)
    states = list(reference.displacements(plan_of(made)))
    np.testing.assert_allclose(simulation.velocities(), (states[-1] - states[-2]) / h, atol=1e-12)


def test_the_surface_is_what_is_drawn(simulation: Simulation) -> None:
    simulation.advance(2)
    vertices, triangles, coordinates = simulation.surface()
    position = simulation.positions()
    twin = reference.refine(position.astype(float), 1)
    np.testing.assert_allclose(vertices, twin.reshape(-1, 3), atol=1e-15)
    np.testing.assert_array_equal(vertices.reshape(17, 21, 3)[::2, ::2], position)
    assert triangles.shape == (2 * 16 * 20, 3)
    assert (triangles.min(), triangles.max()) == (0, 17 * 21 - 1)
    x, y = coordinates[:, 0], -coordinates[:, 1]
    p, q, r = triangles.T
    areas = ((x[q] - x[p]) * (y[r] - y[p]) - (y[q] - y[p]) * (x[r] - x[p])) / 2
    np.testing.assert_allclose(areas, 1 / len(triangles), rtol=1e-12)
    first = {tuple(corner) for corner in triangles[:2]}
    assert first == {(0, 21, 22), (0, 22, 1)}, "cut from top left to bottom right"


def test_a_pixel_tells_what_is_seen_there(simulation: Simulation) -> None:
    assert simulation.pick((9.5, 6.5)) == pytest.approx((0.25, 7 / 30))
    assert simulation.pick((20, 2), "oblique") != simulation.pick((20, 2))
    assert simulation.pick((-10, -10)) is None
    # A tool goes where a pixel is.
    made = scene(probes=[HAND], render={"size": [40, 30]})
    simulation.restart(made)
    place = simulation.pick((29.5, 14.5))
    assert place is not None
    simulation.steer([{**HAND, "at": [[0, *place]]}])


def test_a_record_says_where_its_picture_and_its_device_are(
    device: Device, small: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    record = run(load_scene("small.yaml", ["output=[png]"]), "out", threads=device.threads)
    monkeypatch.chdir("/")
    image = Path(record["working_directory"]) / record["scene"]["image"]
    assert image.samefile(small / "speckle.png")
    assert record["device"] == device.name == processor_name()


def test_in_a_notebook_nothing_is_said() -> None:
    # There stdout is an object of its own.
    notebook = "import io, sys; sys.stdout = io.StringIO(); import taichi_msm.system.runtime"
    done = subprocess.run([sys.executable, "-c", notebook], capture_output=True, text=True, check=True)
    assert (done.stdout, done.stderr) == ("", "")


def test_a_pickled_scene_error_has_its_lines() -> None:
    again = pickle.loads(pickle.dumps(SceneError(["first", "second"])))
    assert (str(again), again.lines) == ("first\nsecond", ("first", "second"))


def test_all_errors_are_ours(simulation: Simulation, message: Messages) -> None:
    assert issubclass(ArgumentError, MsmError)
    assert issubclass(ArgumentError, ValueError)
    with message.raises(MsmError):
        simulation.diagnose()
    simulation.close()
    calls = (simulation.advance, simulation.draw, simulation.velocities, simulation.restart, simulation.compile)
    for call in (*calls, simulation.save):
        with message.raises(MsmError):
            call()
    assert np.isfinite(simulation.positions()).all()


def test_what_was_saved_elsewhere_is_not_gone_on_with(
    simulation: Simulation, device: Device, message: Messages
) -> None:
    simulation.advance(3)
    before = simulation.positions()
    others = (
        scene(time={"step": plan_of(simulation.scene).grid.step / 4}),
        scene(sheet={**SHEET, "points": [5, 5]}),
        scene(time={"precision": "f32"}),
    )
    for other in others:
        with Simulation(other, threads=device.threads) as elsewhere:
            elsewhere.advance(1)
            with message.raises(ArgumentError, "saved"):
                simulation.restore(elsewhere.save())
    np.testing.assert_array_equal(simulation.positions(), before)
    simulation.advance()


def test_a_simulation_that_is_pickled_names_what_can_be(
    simulation: Simulation, device: Device, message: Messages
) -> None:
    for call in (pickle.dumps, copy.copy, copy.deepcopy):
        with message.raises(MsmError, "restore"):
            call(simulation)
    saved, made = pickle.loads(pickle.dumps((simulation.save(), simulation.scene)))
    with Simulation(made, threads=device.threads) as other:
        other.restore(saved)
        np.testing.assert_array_equal(other.positions(), simulation.positions())


def test_frames_positions_and_pictures(device: Device) -> None:
    made = scene(render={"size": [40, 30], "refine": 1})
    twin = reference.simulate(made)
    with Simulation(made, threads=device.threads, texture=speckle(30, 40)) as simulation:
        np.testing.assert_array_equal(simulation.positions(), twin[0])
        simulation.advance(3)
        assert simulation.frame == 3
        assert simulation.time == pytest.approx(0.12)
        np.testing.assert_allclose(simulation.positions(), twin[3], atol=1e-13)
        apart = np.abs(simulation.draw().astype(int) - reference.draw(made, twin[3], speckle(30, 40)))
        assert (apart > 1).mean() < 0.01
        simulation.advance(0)
        assert simulation.frame == 3
    assert simulation.progress.max_displacement == pytest.approx(np.linalg.norm(twin[:4] - twin[0], axis=-1).max())


def test_positions_of_a_frame_stay_as_they_were(device: Device) -> None:
    with Simulation(scene(), threads=device.threads) as simulation:
        simulation.advance()
        before = simulation.positions()
        copy = before.copy()
        simulation.advance()
        np.testing.assert_array_equal(before, copy)
        assert not before.flags.writeable


def test_after_a_divergence_the_last_good_frame_is_there(device: Device, message: Messages) -> None:
    # At 0.1 s the load jumps to what tears the sheet apart.
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


def test_a_sheet_that_nothing_holds_may_fly_away(device: Device) -> None:
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


def test_one_device_a_process(device: Device, message: Messages) -> None:
    with message.raises(taichi_msm.DeviceError, hide=active_compiler().title):
        Simulation(scene(), threads=device.threads + 1)


def test_the_encoder_has_a_core_of_its_own_while_it_works(monkeypatch: pytest.MonkeyPatch) -> None:
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
