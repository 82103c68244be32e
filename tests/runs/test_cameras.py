"""Several cameras: one simulation, seen from each of them, by its name."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm import ArgumentError, Playback, Simulation, resume, run
from taichi_msm.errors import ForeignError, SceneError
from taichi_msm.load import cost
from taichi_msm.load.scene_file import load_plan, load_scene
from taichi_msm.model.surface import place_capsules
from taichi_msm.render import rasterizer
from taichi_msm.render.camera import View, view, view_at
from taichi_msm.render.lens_table import undistortion_map
from taichi_msm.render.rasterizer import Rasterizer
from taichi_msm.runs.finished import read_run
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from taichi_msm.view.recording import Captures
from taichi_msm.view.session import Session
from tests.conftest import Program
from tests.outputs import files, results
from tests.reference import drawing as twin
from tests.render.test_rasterizer import dented, difference, drawable, with_instruments
from tests.runs.test_resume import interrupted

ALL = "[png, gif, mp4, trajectory, forces, coordinates, depth, flow, occlusion, instrument, tracks]"
LEFT = {"eye": [0.05, 0, 0.5], "target": [0.05, 0, 0]}
SWAYING = {"eye": [[0, 0.1, -0.3, 0.3], [0.4, -0.1, -0.2, 0.35]], "up": [[0, 0, 1, 0], [0.4, 0.2, 1, 0]], "fov": 60}
RIGHT = {"beside": "left", "baseline": 0.02}
STEREO = {"left": LEFT, "right": RIGHT}
SWAYING_STEREO = {"left": SWAYING, "right": RIGHT}

Cameras = dict[str, Any]

UNLIT = "render.shading=none"


def seen_by(cameras: Cameras, output: str = "[png, trajectory]", *overrides: str) -> Scene:
    """The small scene, with 9 x 9 points, seen by cameras."""
    render = [f"render.cameras={json.dumps(cameras)}", "render.tracks=3", "sheet.points=[9, 9]"]
    return load_scene("small.yaml", [*render, f"output={output}", *overrides])


def alone(camera: Any, output: str) -> Scene:
    """The same scene seen by one camera, which has no name."""
    of_one = [f"render.camera={json.dumps(camera)}", "render.tracks=3", "sheet.points=[9, 9]", UNLIT]
    return load_scene("small.yaml", [*of_one, f"output={output}"])


def test_each_camera_writes_what_it_would_write_alone(small: Path, device: Device) -> None:
    record = run(seen_by({**STEREO, "sway": SWAYING}, ALL, UNLIT), "out", threads=device.threads)
    moved = {"eye": [0.05 + 0.02, 0, 0.5], "target": [0.05 + 0.02, 0, 0]}
    written = files(Path("out"))
    for name, camera in {"left": LEFT, "right": moved, "sway": SWAYING}.items():
        run(alone(camera, ALL), name, threads=device.threads)
        expected = results(Path(name))
        for file in ("trajectory.npz", "forces.csv"):
            assert written.pop(file, expected[file]) == expected.pop(file)
        found, alike = (json.loads(each) for each in (written.pop(f"{name}/camera.json"), expected.pop("camera.json")))
        assert found.keys() == alike.keys()
        assert found.pop("model") == alike.pop("model")
        for key, value in alike.items():
            np.testing.assert_allclose(found[key], value, atol=1e-12)
        assert {file: written.pop(f"{name}/{file}") for file in expected} == expected
    assert list(written) == ["run.json"], "and nothing else"
    assert record["outputs"][:3] == ["left/frames", "right/frames", "sway/frames"]
    assert record["outputs"][-4:] == ["left/camera.json", "right/camera.json", "sway/camera.json", "run.json"]


def test_disparity_is_that_of_depth_and_of_flow_from_left_to_right(small: Path, device: Device) -> None:
    cameras = {**SWAYING_STEREO, "third": {"beside": "right", "baseline": -0.05}}
    run(seen_by(cameras, "[png, trajectory, depth, disparity]"), "out", threads=device.threads)
    focal = json.loads(Path("out/left/camera.json").read_text())["intrinsics"][0][0]
    assert not Path("out/third/disparity").exists()
    with Playback("out") as playback:
        for frame in (0, 2):
            for name, other, baseline in (("left", "right", 0.02), ("right", "third", -0.05)):
                with Image.open(f"out/{name}/depth/{frame:04}.tiff") as image:
                    depth = np.array(image)
                with Image.open(f"out/{name}/disparity/{frame:04}.tiff") as image:
                    disparity = np.array(image)
                assert disparity.dtype == np.float32
                sheet = depth > 0
                assert 0 < sheet.sum() < sheet.size
                np.testing.assert_allclose(disparity[sheet], focal * baseline / depth[sheet], rtol=1e-6)
                assert (disparity[~sheet] == 0).all()
                flow = playback.flow(frame, frame, camera=name, camera_then=other).flow
                # Of coordinates in f32, on a picture of 40 px.
                assert np.abs(flow[sheet] + np.stack([disparity, 0 * disparity], axis=-1)[sheet]).max() < 1e-4


def test_an_orthographic_pair_has_the_same_disparity_everywhere(small: Path, device: Device) -> None:
    made = seen_by({"left": "top", "right": RIGHT}, "[png, disparity]")
    with Simulation(made, threads=device.threads) as simulation:
        disparity = simulation.observe(None, "left").stereo
        sight = simulation.locate(np.array([[0.5, 0.5]]), "right").pixels
    assert disparity is not None
    # 40 px are 0.4 m.
    np.testing.assert_allclose(np.unique(disparity.disparity), 2.0)
    np.testing.assert_allclose(sight, [[18, 15]], atol=1e-5)


@pytest.mark.parametrize("shading", ["headlight", "tissue"])
def test_the_light_is_that_of_the_main_camera(shading: str, device: Device) -> None:
    side = {"eye": [0.35, 0.1, 0.3], "up": [0.1, 1, 0]}
    cameras = {"main": {"eye": [-0.3, 0.05, 0.35]}, "side": side, "beside": {"beside": "main", "baseline": 0.06}}
    made = with_instruments(drawable(shading=shading, size=[30, 24]))
    render = {**dict(made.render), "cameras": {**cameras, "above": "top"}}
    del render["camera"]
    made = made.model_copy(update={"render": render})
    position, texture = dented(made), np.full((9, 9, 3), 120, np.uint8)
    placed, config = place_capsules(made, position, 0), rasterizer.drawing_config(made)
    drawing, of_gpu = (Rasterizer(made, texture, config._replace(lanes=lanes)) for lanes in (config.lanes, 1))
    for name in made.render.all_cameras:
        seen = view_at(made, 0.0, name)
        drawn = drawing.draw(position, seen, placed)
        apart = difference(drawn, twin.draw(made, position, texture, placed, seen))
        assert (apart > 1).mean() < 0.01, f"{name}, but for outlines"
        own = drawing.draw(position, seen._replace(light_view=None), placed)
        assert (difference(drawn, own).max() > 20) == (name != "main")
        np.testing.assert_array_equal(of_gpu.draw(position, seen, placed), drawn)


def test_an_interrupted_run_goes_on_to_the_same_bits(small: Path, device: Device) -> None:
    made = seen_by(SWAYING_STEREO, ALL.replace("tracks", "tracks, disparity"))
    run(made, "whole", threads=device.threads)
    for n in (1, 3):
        record = interrupted(made, f"part-{n}", device, after=n)
        counts = {len(list(Path(f"part-{n}/{name}/frames").iterdir())) for name in ("left", "right")}
        assert counts == {record["frames"]}
        resume(f"part-{n}", threads=device.threads)
        assert results(Path(f"part-{n}")) == results(Path("whole"))


def test_a_run_with_another_main_camera_is_another_run(small: Path, device: Device) -> None:
    cameras = {"a": LEFT, "b": {"eye": [0.3, 0, 0.3]}}
    interrupted(seen_by(cameras), "out", device, after=3)
    record = run(seen_by(dict(reversed(cameras.items()))), "out", threads=device.threads)
    assert (record["status"], record["resumed"]) == ("complete", 0)


def test_a_run_is_repeated_with_its_cameras(small: Path, program: Program) -> None:
    command = ["run", "small.yaml", "--set", f"render.cameras={json.dumps(STEREO)}", "--set", "output=[png]"]
    assert program(*command, "--out", "first", "--set", "render.cameras.left.fov=50").returncode == 0
    assert program("run", "--again", "first", "--out", "second").returncode == 0
    assert results(Path("first")) == results(Path("second"))
    assert list(read_run("second").scene.render.all_cameras) == ["left", "right"]
    assert read_run("second").scene.render.origin("right")[0].fov == 50  # type: ignore[union-attr]


def test_results_replace_those_of_other_cameras_and_nothing_else(small: Path, device: Device) -> None:
    run(seen_by(STEREO), "out", threads=device.threads)
    Path("out/left/mine.txt").write_text("mine")
    run(seen_by({"one": LEFT, "two": LEFT}), "out", threads=device.threads)
    assert sorted(path.name for path in Path("out").iterdir()) == ["left", "one", "run.json", "trajectory.npz", "two"]
    assert [path.name for path in Path("out/left").iterdir()] == ["mine.txt"]
    Path("out/left/frames").mkdir()
    shutil.copy("speckle.png", "out/left/frames/0002.png")
    with pytest.raises(ForeignError, match=r"out/left/frames/0002.png: a file that no run has put there"):
        run(seen_by(STEREO), "out", threads=device.threads)
    Path("plain").mkdir()
    Path("plain/right").write_text("a file")
    with pytest.raises(ForeignError, match=r"plain/right: a file that no run has put there"):
        run(seen_by(STEREO), "plain", threads=device.threads)


def test_cameras_have_names_in_python(stereo: Path, device: Device) -> None:
    found = read_run(stereo)
    assert (found.camera_names(), found.camera) == (["left", "right"], "left")
    with Playback(stereo, threads=device.threads) as playback:
        for name in ("left", "right"):
            with Image.open(stereo / name / "frames/0002.png") as image:
                np.testing.assert_array_equal(playback.draw(2, name), np.asarray(image))
            with np.load(stereo / name / "tracks.npz") as tracks:
                pixels, hidden = playback.locate(2, tracks["coordinates"], camera=name)
                np.testing.assert_array_equal(pixels, tracks["points"][:, 2])
                np.testing.assert_array_equal(hidden, tracks["occluded"][:, 2])
        np.testing.assert_array_equal(playback.draw(2), playback.draw(2, "left"))
        found_then = playback.flow(1, 2, "left", "right").flow
        assert not np.array_equal(found_then, playback.flow(1, 2, "left").flow)
        there = playback.positions[2], float(playback.time[2])
        np.testing.assert_array_equal(
            found_then, playback._simulation.flow(playback.labels(1, "left"), "right", *there).flow
        )
        assert playback.draw(0, "oblique").shape == (256, 320, 3)
        with pytest.raises(ArgumentError, match=r"camera: 'lift'; the cameras are left, right, top, .*mean 'left'\?"):
            playback.draw(0, "lift")


def test_two_lenses_find_their_places_once_each(small: Path, device: Device, monkeypatch: pytest.MonkeyPatch) -> None:
    cameras = {name: {**LEFT, "distortion": {"k1": k1}} for name, k1 in (("a", -0.1), ("b", -0.2))}
    found: list[View] = []

    def counted(camera: View, *arguments: Any, **more: Any) -> Any:
        found.append(camera)
        return undistortion_map(camera, *arguments, **more)

    monkeypatch.setattr(rasterizer, "undistortion_map", counted)
    made = seen_by({**cameras, "c": {"beside": "b", "baseline": 0.1}}, "[png, depth]")
    with Simulation(made, threads=device.threads) as simulation:
        for _ in range(3):
            for name in "abc":
                simulation.observe(None, name)
    assert len(found) == 2


def test_the_budget_counts_every_camera(small: Path) -> None:
    def need(cameras: Cameras) -> cost.Budget:
        of_three = [f"render.cameras={json.dumps(cameras)}", "output=[png, tracks, trajectory]"]
        return cost.estimate_budget(load_plan("small.yaml", of_three))

    one, three = need({"a": LEFT}), need(dict.fromkeys("abc", LEFT))
    assert three.picture_bytes == 3 * one.picture_bytes
    assert three.track_bytes == 3 * one.track_bytes
    assert three.trajectory_bytes == one.trajectory_bytes


def test_a_session_follows_the_main_camera_and_keeps_the_others(small: Path, device: Device) -> None:
    made = seen_by(SWAYING_STEREO, "[png]", "time.frames_per_second=25")
    with Session(made, Captures(Path("captures"), "small.yaml"), threads=device.threads, play=True) as session:
        session.advance()
        np.testing.assert_allclose(session.viewport.view.matrix, view(made, 1 / session.frame_rate).matrix, rtol=1e-6)
        assert session.recorded_scene().render == made.render
        session.viewport.turn(20, 5)
        left, right = session.recorded_scene().render.all_cameras.items()
        assert left[1] != made.render.main_camera
        assert right == ("right", made.render.all_cameras["right"])
        session.viewport.set_camera("top")
        assert session.recorded_scene().render.all_cameras["left"] == "top"


def fails_with(cameras: str, *overrides: str) -> list[str]:
    """The errors of cameras that begin in line 11 of a scene file."""
    text = Path("small.yaml").read_text()
    Path("s.yaml").write_text(text.replace("refine: 1}", f"refine: 1, cameras: {{\n{cameras}}}}}"))
    with pytest.raises(SceneError) as caught:
        load_scene("s.yaml", overrides)
    return [line.replace("render.cameras.", "") for line in caught.value.lines]


WRONG: dict[str, tuple[str, str]] = {
    "not there": (
        "left: top,\n right: {beside: lift, baseline: 1}",
        "s.yaml:12:10: right.beside: lift: no camera has this name; did you mean 'left'?",
    ),
    "not at all like one": (
        "left: top,\n right: {beside: x, baseline: 1}",
        "s.yaml:12:10: right.beside: x: no camera has this name; the others are left",
    ),
    "itself": (
        "left: top,\n right: {beside: right, baseline: 1}",
        "s.yaml:12:10: right.beside: right is this camera itself; name another one",
    ),
    "a cycle": (
        "left: top,\n a: {beside: b, baseline: 1}, b: {beside: a, baseline: 1}",
        "s.yaml:12:6: a.beside: goes round, a, b, a; give one of them an eye",
    ),
    "the main one": (
        "right: {beside: left, baseline: 1},\n left: top",
        "s.yaml:11:9: right.beside: the first camera is the main one, beside no other; put another one first",
    ),
    "one name": ("left: top,\n left: oblique", "s.yaml:12:2: left: given twice, first in line 11; keep one"),
    "no baseline": (
        "left: top,\n right: {beside: left}",
        "s.yaml:12:2: right.baseline: missing; expected a number but 0, in metres",
    ),
    "baseline 0": (
        "left: top,\n right: {beside: left, baseline: 0}",
        "s.yaml:12:24: right.baseline: 0 puts it where left is; expected a number but 0, in metres",
    ),
    "far away": (
        "left: top,\n right: {beside: left, baseline: 1.0e+20}",
        "s.yaml:12:24: right.baseline: puts it more than 1e+06 times the size of the sheet away; take a smaller "
        "number, in metres",
    ),
    "a baseline alone": (
        "left: {eye: [0, 0, 1], baseline: 1}",
        "s.yaml:11:24: left.baseline: goes with beside, the name of another camera; add it or remove this",
    ),
    "an eye of its own": (
        "left: top,\n right: {beside: left, baseline: 1, eye: [0, 0, 1]}",
        "s.yaml:12:37: right.eye: is given together with beside, and a camera beside another is like that; remove it",
    ),
    "no name": ("Left: top", "s.yaml:11:1: Left: is no name of a camera; take up to 64 of a-z, 0-9, _ and -"),
    "a folder of labels": (
        "flow: top",
        "s.yaml:11:1: flow: is the name of a folder that is not a camera's; take another name",
    ),
    "a folder of exports": (
        "export-obj: top",
        "s.yaml:11:1: export-obj: is the name of a folder that is not a camera's; take another name",
    ),
    "wrong below a name that is a key": (
        "eye: {eye: [1, 2]}",
        "s.yaml:11:7: eye.eye: [1, 2] is not allowed; expected three numbers: [x, y, z] in metres, or keys "
        "[[t, x, y, z], ...], t in seconds",
    ),
    "nothing to see": (
        "left: top, right: {eye: [0, 0, 0]}",
        "s.yaml:11:20: right.eye: [0.0, 0.0, 0.0] is also the target; move one of them",
    ),
    "a calibration that is not there": (
        "left: top, right: {eye: [0, 0, 1], calibration: a.yml}",
        "s.yaml:11:36: right.calibration: a.yml: no such file or directory",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_errors_name_the_camera_and_the_key(name: str, small: Path) -> None:
    cameras, said = WRONG[name]
    assert fails_with(cameras) == [said]


def test_an_output_is_not_blamed_for_a_faulty_camera(small: Path) -> None:
    cameras, said = WRONG["baseline 0"]
    assert fails_with(cameras, "output=[png, disparity]") == [said]


def test_what_does_not_go_together_is_refused(small: Path) -> None:
    both = (
        "--set render.camera=top: render.camera: is given together with cameras; remove one of them, or set it to null"
    )
    assert fails_with("left: top", "render.camera=top") == [both]
    for override, cameras in (("render.cameras=null", [""]), ("render.camera=null", ["left"])):
        assert list(load_scene("s.yaml", ["render.camera=top", override]).render.all_cameras) == cameras
    of_none = "disparity needs a camera beside another one; take render.cameras with {beside: NAME, baseline: metres}"
    assert fails_with("left: top", "output=[disparity]") == [
        f"--set output=[disparity]: output: {of_none}, or leave it out"
    ]
    bent = "a: {eye: [0, 0, 1], distortion: {k1: -0.01}}, b: {beside: a, baseline: 1}"
    assert fails_with(bent, "output=[disparity]") == [
        "--set output=[disparity]: output: disparity is along rows only without distortion, and a has one; leave out "
        "one of them"
    ]
