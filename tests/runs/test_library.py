"""What a caller may get wrong gets one clear error; what is public works."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
from collections.abc import Iterator
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
from taichi_msm.solver.planning import with_time
from taichi_msm.system.process import processor_name
from taichi_msm.system.runtime import Device
from tests import reference
from tests.scenes import PRESS, SHEET, plan_of, scene, speckle

HAND = {"at": [[0, 0.5, 0.5]], "force": [0, 0, -20], "falloff": 20, "offset": 0}


@pytest.fixture
def simulation(device: Device) -> Iterator[Simulation]:
    made = scene(render={"size": [40, 30], "refine": 1})
    with Simulation(made, threads=device.threads, texture=speckle(30, 40)) as simulation:
        yield simulation


def test_what_is_exported_is_there_and_nothing_else() -> None:
    for name in taichi_msm.__all__:
        exported = getattr(taichi_msm, name)
        assert exported.__name__ == name
        assert exported.__doc__
    assert (Path(taichi_msm.__file__).parent / "py.typed").exists()
    with pytest.raises(AttributeError, match="no attribute 'nothing'"):
        taichi_msm.nothing  # noqa: B018


@pytest.mark.parametrize("shape", [(9, 11), (9, 12, 3), (8, 11, 3), (9, 11, 4), (2001, 2001, 3), (0,)])
def test_positions_of_another_shape_are_refused(shape: tuple[int, ...], simulation: Simulation) -> None:
    with pytest.raises(ArgumentError, match=r"positions: float64 of shape .*; take numbers of shape \(9, 11, 3\)"):
        simulation.draw(positions=np.zeros(shape))
    with pytest.raises(ArgumentError, match="positions: <U1"):
        simulation.draw(positions=np.full((9, 11, 3), "a"))


@pytest.mark.parametrize(
    "texture",
    [
        np.zeros((4, 5), np.uint8),
        np.zeros((4, 5, 3)),
        np.zeros((4, 5, 4), np.uint8),
        np.zeros((0, 5, 3), np.uint8),
        np.zeros((1, 70000, 3), np.uint8),
    ],
    ids=["grey", "float", "alpha", "empty", "long"],
)
def test_what_is_no_picture_is_refused(texture: Any, device: Device) -> None:
    with pytest.raises(ArgumentError, match="is not a picture; take uint8 of shape"):
        Simulation(scene(), threads=device.threads, texture=texture)


def test_a_camera_is_given_as_in_a_scene(simulation: Simulation) -> None:
    keys = {"eye": [0, -0.3, 0.4]}
    for camera in ("oblique", keys, Camera(eye=(0.0, -0.3, 0.4))):
        seen = scene(render={"size": [40, 30], "refine": 1, "camera": camera})
        np.testing.assert_array_equal(simulation.draw(camera), simulation.draw(view(seen)))
    assert (simulation.draw("oblique") != simulation.draw()).any()


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        (3, "camera: 3 is not allowed; expected top, oblique, or"),
        ("side", 'camera: "side" is not allowed; expected top, oblique, or'),
        ({"eye": [0, 0]}, r"camera.eye: \[0, 0\] is not allowed; expected three numbers"),
        ({"eye": [0, 0, 0]}, r"render.camera.eye: \[0.0, 0.0, 0.0\] is also the target; move one of them"),
    ],
)
def test_a_wrong_camera_is_refused(camera: Any, said: str, simulation: Simulation) -> None:
    with pytest.raises(SceneError, match=said):
        simulation.draw(camera)


@pytest.mark.parametrize("frames", [-1, 1.5, "2", None])
def test_a_wrong_number_of_frames_is_refused(frames: Any, simulation: Simulation) -> None:
    with pytest.raises(ArgumentError, match="frames cannot be simulated; take a whole number, 0 or more"):
        simulation.advance(frames)


def test_scenes_made_in_python_are_checked(device: Device, tmp_path: Path) -> None:
    good = scene()
    with pytest.raises(SceneError) as caught:
        Scene(sheet={"points": [3, 3], "size": [1, 1], "mass": 0}, springs={}, time={"duration": 1}, output=(), shaer=1)
    assert caught.value.lines == (
        "sheet.mass: 0 is not allowed; expected a number above 0, in kg",
        "shaer: unknown key; did you mean 'sheet'?",
    )
    with pytest.raises(SceneError, match="damping: -1 is not allowed"):
        good.model_copy(update={"damping": -1})
    with pytest.raises(SceneError, match="supersample: 9 is not allowed"):
        Render(supersample=9)
    with pytest.raises(SceneError, match="force: missing"):
        Probe()
    broken = {"sheet": SHEET, "springs": {}, "time": {"duration": -1}, "output": []}
    unstable = with_time(good, step=0.04)
    assert plan_of(good).stable_step < 0.04
    for attempt in (lambda made: Simulation(made, threads=device.threads), lambda made: run(made, tmp_path / "out")):
        with pytest.raises(SceneError, match=r"time\.duration: -1 is not allowed"):
            attempt(broken)
        with pytest.raises(SceneError, match=r"time\.step: 0\.04 s is"):
            attempt(unstable)
        with pytest.raises(ArgumentError, match="str is no scene; take what load_scene returns"):
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


@pytest.mark.parametrize("probes", [[], [PRESS, PRESS], [{**PRESS, "at": [[0, 0.5, 0.5], [1, 0.6, 0.5]]}]])
def test_what_needs_another_kernel_is_refused(probes: Any, simulation: Simulation) -> None:
    simulation.advance()
    before = simulation.scene
    with pytest.raises(
        ArgumentError, match=r"cannot change .* restart with the new scene|the scene has 1; give all of them"
    ):
        simulation.steer(probes)
    with pytest.raises(SceneError, match=r"probes.0.force: \[1\] is not allowed"):
        simulation.steer([{"force": [1]}])
    assert simulation.scene == before
    simulation.advance()


def test_restarted_it_is_a_new_simulation(simulation: Simulation, device: Device) -> None:
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
    with pytest.raises(SceneError, match=r"time\.step"):
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


def test_a_divergence_says_where_it_is(device: Device) -> None:
    made = scene(probes=[{"force": [0, 0, 1e12], "falloff": 20, "at": [0.5, 0.5]}])
    with Simulation(made, threads=device.threads) as simulation, pytest.raises(DivergedError) as caught:
        simulation.advance(10)
    error = caught.value
    assert error.step > 0
    assert error.time == pytest.approx(error.step * plan_of(made).grid.step)
    assert f"point {error.point}" in str(error)
    again = pickle.loads(pickle.dumps(error))
    assert (str(again), again.step, again.time, again.point) == (str(error), error.step, error.time, error.point)


def test_a_pickled_scene_error_has_its_lines() -> None:
    again = pickle.loads(pickle.dumps(SceneError(["first", "second"])))
    assert (str(again), again.lines) == ("first\nsecond", ("first", "second"))


def test_all_errors_are_ours(simulation: Simulation) -> None:
    assert issubclass(ArgumentError, MsmError)
    assert issubclass(ArgumentError, ValueError)
    simulation.close()
    calls = (simulation.advance, simulation.draw, simulation.velocities, simulation.restart, simulation.compile)
    for call in (*calls, simulation.save):
        with pytest.raises(MsmError, match="this simulation is closed"):
            call()
    assert np.isfinite(simulation.positions()).all()


@pytest.mark.parametrize("threads", [0, -1, 10**6, True, 1.5, "2"])
def test_a_wrong_number_of_threads_is_refused(threads: Any, device: Device) -> None:
    # Taichi would abort the process, or start them all.
    with pytest.raises(ArgumentError, match=r"threads: .*; take a whole number, 1 to 1024, or None"):
        Simulation(scene(), threads=threads)


def test_what_was_saved_elsewhere_is_not_gone_on_with(simulation: Simulation, device: Device) -> None:
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
            with pytest.raises(ArgumentError, match="saved with this scene's points, probes, precision and step"):
                simulation.restore(elsewhere.save())
    with pytest.raises(ArgumentError, match="int is not what `save` returns"):
        simulation.restore(3)  # type: ignore[arg-type]
    np.testing.assert_array_equal(simulation.positions(), before)
    simulation.advance()


def test_nothing_is_diagnosed_of_a_sound_simulation(simulation: Simulation) -> None:
    simulation.advance(2)
    with pytest.raises(MsmError, match="has not diverged"):
        simulation.diagnose()


@pytest.mark.parametrize("pixel", [3, None, ("a", 1), (1, 2, 3), (np.inf, 1), [[1], [1, 2]]])
def test_what_is_no_pixel_is_refused(pixel: Any, simulation: Simulation) -> None:
    with pytest.raises(ArgumentError, match="pixel: "):
        simulation.pick(pixel)


def test_rows_of_unequal_length_are_refused(simulation: Simulation) -> None:
    with pytest.raises(ArgumentError, match="positions: "):
        simulation.draw(positions=[[1], [1, 2]])  # type: ignore[arg-type]
    with pytest.raises(ArgumentError, match="frames cannot be simulated"):
        simulation.play(-1)
    with pytest.raises(ArgumentError, match="probes: 3"):
        simulation.steer(3)  # type: ignore[arg-type]
    with pytest.raises(SceneError) as caught:
        simulation.draw("side")
    assert caught.value.lines[0].startswith('render.camera: "side" is not allowed')
    assert len(caught.value.lines) == 1


def test_sections_take_keys_by_name_and_stay_as_they_are(simulation: Simulation) -> None:
    made = simulation.scene
    with pytest.raises(ArgumentError, match="Sheet takes its keys by name: points, size, mass, fixed"):
        Sheet((3, 3), (1, 1), 1)  # type: ignore[call-arg]
    with pytest.raises(
        SceneError, match=r"damping: a scene cannot be changed; use model_copy\(update={'damping': ...}\)"
    ):
        made.damping = 3
    for update in (3, {3: 3}):
        with pytest.raises(ArgumentError, match=r"update: .*; take a mapping from keys to values"):
            made.model_copy(update=update)  # type: ignore[arg-type]


def test_a_mapping_is_no_path_of_a_scene() -> None:
    with pytest.raises(ArgumentError, match=r"^path: a mapping; Scene\(\*\*mapping\)"):
        load_scene({"sheet": {}})  # type: ignore[arg-type]


@pytest.mark.parametrize("overrides", [None, 3, {3: 3}, [3], "damping=1"])
def test_overrides_are_texts(overrides: Any, small: Path) -> None:
    with pytest.raises(ArgumentError, match="overrides: "):
        load_scene("small.yaml", overrides)


@pytest.mark.parametrize("directory", [None, 3, "a\0b"])
def test_a_directory_is_a_path(directory: Any, device: Device) -> None:
    with pytest.raises(ArgumentError, match=r"directory: .*; take a path"):
        run(scene(), directory, threads=device.threads)
    with pytest.raises(ArgumentError, match=r"directory: .*; take a path"):
        resume(directory)


NO_TIMES = [10**400, -(10**400), np.inf, np.float16(np.nan), np.complex64(1), True, "1", [0.1]]


@pytest.mark.parametrize("time", NO_TIMES, ids=lambda time: repr(time)[:20])
def test_what_is_no_time_is_refused(time: Any, simulation: Simulation) -> None:
    for call in (simulation.labels, simulation.draw):
        with pytest.raises(ArgumentError, match=r"^time: .*; take a number, in seconds, or None for now$"):
            call(time=time)


@pytest.mark.parametrize("call", [pickle.dumps, copy.copy, copy.deepcopy])
def test_a_simulation_that_is_pickled_names_what_can_be(call: Any, simulation: Simulation, device: Device) -> None:
    with pytest.raises(MsmError) as caught:
        call(simulation)
    remedy = "keep its `scene` and what `save` returns, and `restore` that in a new one"
    assert str(caught.value) == f"a Simulation cannot be pickled or copied; {remedy}"
    saved, made = pickle.loads(pickle.dumps((simulation.save(), simulation.scene)))
    with Simulation(made, threads=device.threads) as other:
        other.restore(saved)
        np.testing.assert_array_equal(other.positions(), simulation.positions())
