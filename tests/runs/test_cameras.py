"""Several cameras: one simulation with the results of each named camera."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from PIL import Image

from taichi_msm import ArgumentError, Playback, Simulation, resume, run
from taichi_msm.cameras.view import pair_transform
from taichi_msm.errors import ForeignError, SceneError
from taichi_msm.load.scene_file import load_scene
from taichi_msm.model.surface import place_instruments
from taichi_msm.render import rasterizer
from taichi_msm.render.camera import calibration, is_moving, view, view_at
from taichi_msm.render.rasterizer import Rasterizer
from taichi_msm.runs.finished import read_run
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from taichi_msm.view.recording import Captures
from taichi_msm.view.session import Session
from tests.golden import Messages
from tests.outputs import files, results
from tests.reference import drawing
from tests.render.test_rasterizer import dented, difference, drawable, with_instruments
from tests.runs.test_resume import interrupted
from tests.scenes import scene

ALL = "[png, gif, mp4, trajectory, forces, coordinates, depth, flow, occlusion, instrument, tracks]"
LEFT = {"eye": [0.05, 0, 0.5], "target": [0.05, 0, 0]}
SWAYING = {"eye": [[0, 0.1, -0.3, 0.3], [0.4, -0.1, -0.2, 0.35]], "up": [[0, 0, 1, 0], [0.4, 0.2, 1, 0]], "fov": 60}
RIGHT = {"beside": "left", "baseline": 0.02}
STEREO = {"left": LEFT, "right": RIGHT}
SWAYING_STEREO = {"left": SWAYING, "right": RIGHT}
PAIR = "rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]], translation: {}"
TURN = cv2.Rodrigues(np.array([0.02, -0.1, 0.03]))[0]

Cameras = dict[str, Any]

UNLIT = "render.shading=none"


def with_cameras(cameras: Cameras, output: str = "[png, trajectory]", *overrides: str) -> Scene:
    """The small scene with 9 x 9 points and several cameras."""
    render = [f"render.cameras={json.dumps(cameras)}", "render.tracks=3", "sheet.points=[9, 9]"]
    return load_scene("small.yaml", [*render, f"output={output}", *overrides])


def alone(camera: Any, output: str) -> Scene:
    """The same scene with one unnamed camera."""
    render = [f"render.camera={json.dumps(camera)}", "render.tracks=3", "sheet.points=[9, 9]", UNLIT]
    return load_scene("small.yaml", [*render, f"output={output}"])


@pytest.mark.slow
def test_results_of_each_camera(small: Path, device: Device) -> None:
    record = run(
        with_cameras({**STEREO, "sway": SWAYING}, ALL, UNLIT), "out", threads=device.threads, estimate_error=False
    )
    moved = {"eye": [0.05 + 0.02, 0, 0.5], "target": [0.05 + 0.02, 0, 0]}
    written = files(Path("out"))
    for name, camera in {"left": LEFT, "right": moved, "sway": SWAYING}.items():
        run(alone(camera, ALL), name, threads=device.threads, estimate_error=False)
        expected = results(Path(name))
        for file in ("trajectory.npz", "forces.csv"):
            assert written.pop(file, expected[file]) == expected.pop(file)
        several, single = (
            json.loads(each) for each in (written.pop(f"{name}/camera.json"), expected.pop("camera.json"))
        )
        if name == "right":
            pair = {"beside": "left", "rotation": np.eye(3).tolist(), "translation": [-0.02, 0, 0]}
            assert {key: several.pop(key) for key in pair} == pair
        assert several.keys() == single.keys()
        assert several.pop("model") == single.pop("model")
        for key, value in single.items():
            np.testing.assert_allclose(several[key], value, atol=1e-12)
        assert {file: written.pop(f"{name}/{file}") for file in expected} == expected
    assert list(written) == ["run.json"]
    assert record["outputs"][:3] == ["left/frames", "right/frames", "sway/frames"]
    assert record["outputs"][-4:] == ["left/camera.json", "right/camera.json", "sway/camera.json", "run.json"]


def test_disparity_against_depth_and_flow(small: Path, device: Device) -> None:
    cameras = {**SWAYING_STEREO, "third": {"beside": "right", "baseline": -0.05}}
    run(
        with_cameras(cameras, "[png, trajectory, depth, disparity]"),
        "out",
        threads=device.threads,
        estimate_error=False,
    )
    focal = json.loads(Path("out/left/camera.json").read_text())["intrinsics"][0][0]
    assert not Path("out/third/disparity").exists()
    with Playback("out") as playback:
        for frame in (0, 2):
            for name, right, baseline in (("left", "right", 0.02), ("right", "third", -0.05)):
                with Image.open(f"out/{name}/depth/{frame:04}.tiff") as image:
                    depth = np.array(image)
                with Image.open(f"out/{name}/disparity/{frame:04}.tiff") as image:
                    disparity = np.array(image)
                assert disparity.dtype == np.float32
                sheet = depth > 0
                assert 0 < sheet.sum() < sheet.size
                np.testing.assert_allclose(disparity[sheet], focal * baseline / depth[sheet], rtol=1e-6)
                assert (disparity[~sheet] == 0).all()
                flow = playback.flow(frame, frame, camera=name, camera_then=right).flow
                # Coordinates have f32, on a picture of 40 px.
                assert np.abs(flow[sheet] + np.stack([disparity, 0 * disparity], axis=-1)[sheet]).max() < 1e-4


def test_disparity_of_an_orthographic_pair(small: Path, device: Device) -> None:
    made = with_cameras({"left": "top", "right": RIGHT}, "[png, disparity]")
    with Simulation(made, threads=device.threads) as simulation:
        disparity = simulation.observe(None, "left").stereo
        sight = simulation.locate(np.array([[0.5, 0.5]]), "right").pixels
    assert disparity is not None
    assert disparity.disparity is not None
    assert disparity.stereo is None
    # 40 px are 0.4 m.
    np.testing.assert_allclose(np.unique(disparity.disparity), 2.0)
    np.testing.assert_allclose(sight, [[18, 15]], atol=1e-5)


def test_right_camera_with_a_rotation(small: Path) -> None:
    """X_right = R X_left + T in every frame; the right camera has its own lens, labels belong to the left one."""
    pair = {"rotation": TURN.tolist(), "translation": [-0.03, 0.004, 0.002]}
    lens = {"intrinsics": {"fx": 30, "fy": 31, "cx": 18, "cy": 13}, "distortion": {"k1": -0.05, "p1": 0.002}}
    left = {**SWAYING, "distortion": {"k1": -0.1}}
    made = with_cameras({"left": left, "right": {"beside": "left", **pair, **lens}}, "[stereo]")
    assert made.folders == {"": (), "left": ("stereo", "stereo_occlusion"), "right": ()}
    assert is_moving(made, "right")
    for time in (0, 0.3):
        left_matrices, right_matrices = (calibration(view_at(made, time, name)) for name in ("left", "right"))
        expected = TURN @ left_matrices["pose"] + np.array([0, 0, 0, 1]) * np.array(pair["translation"])[:, None]
        np.testing.assert_allclose(right_matrices["pose"], expected, atol=1e-12)
    assert right_matrices["calibration"] == [[30, 0, 18], [0, 31, 13], [0, 0, 1]]
    assert right_matrices["distortion"] == [-0.05, 0, 0.002, 0, 0, 0, 0, 0]
    written = pair_transform(made.render.all_cameras["right"])
    assert written.pop("beside") == "left"
    for key, value in pair.items():
        np.testing.assert_allclose(written[key], value, atol=1e-12)
    assert Scene.model_validate(made.model_dump()).render == made.render


@pytest.mark.parametrize("left", ["top", {**SWAYING, "distortion": {"k1": -0.1}}], ids=["top", "pinhole"])
def test_right_camera_inherits_the_lens(left: Any, small: Path) -> None:
    pair = {"beside": "left", "rotation": TURN.tolist(), "translation": [-0.03, 0.004, 0.002]}
    made = with_cameras({"left": left, "right": pair, "third": {"beside": "right", "baseline": 0.1}})
    first, second, third = (view_at(made, 0.2, name) for name in ("left", "right", "third"))
    points = np.random.default_rng(0).uniform(-0.1, 0.1, (20, 3))
    in_second = (points - first.eye) @ first.axes.T * [1, -1, -1] @ TURN.T + pair["translation"]
    np.testing.assert_allclose((points - second.eye) @ second.axes.T * [1, -1, -1], in_second, atol=1e-12)
    # The left camera projects points with these coordinates in its own axes to the same pixels.
    moved = first.eye + in_second * [1, -1, -1] @ first.axes
    np.testing.assert_allclose(second.pixels(points), first.pixels(moved), atol=1e-9)
    np.testing.assert_allclose(third.eye, second.eye + 0.1 * second.axes[0], atol=1e-12)


@pytest.mark.slow
@pytest.mark.parametrize("shading", [pytest.param("headlight", marks=pytest.mark.slow), "tissue"])
def test_light_at_the_main_camera(shading: str, device: Device) -> None:
    side = {"eye": [0.35, 0.1, 0.3], "up": [0.1, 1, 0]}
    cameras = {"main": {"eye": [-0.3, 0.05, 0.35]}, "side": side, "beside": {"beside": "main", "baseline": 0.06}}
    made = with_instruments(drawable(shading=shading, size=[30, 24]))
    render = {**dict(made.render), "cameras": {**cameras, "above": "top"}}
    del render["camera"]
    made = made.model_copy(update={"render": render})
    position, texture = dented(made), np.full((9, 9, 3), 120, np.uint8)
    placed, config = place_instruments(made, position, 0), rasterizer.drawing_config(made)
    on_cpu = Rasterizer(made, texture, config)
    of_gpu = Rasterizer(made, texture, config._replace(lanes=1)) if shading == "tissue" else on_cpu
    for name in made.render.all_cameras:
        camera = view_at(made, 0.0, name)
        drawn = on_cpu.draw(position, camera, placed)
        differences = difference(drawn, drawing.draw(made, position, texture, placed, camera))
        assert (differences > 1).mean() < 0.01, f"{name}, except outlines"
        headlight = on_cpu.draw(position, camera._replace(light_view=None), placed)
        assert (difference(drawn, headlight).max() > 20) == (name != "main")
        np.testing.assert_array_equal(of_gpu.draw(position, camera, placed), drawn)


def test_resumed_run_of_several_cameras(small: Path, device: Device) -> None:
    made = with_cameras(SWAYING_STEREO, ALL.replace("tracks", "tracks, disparity, stereo"))
    run(made, "whole", threads=device.threads, estimate_error=False)
    assert {path.parent.parent.name for path in Path("whole").rglob("stereo*/0004.*")} == {"left"}
    for n in (1, 3):
        frames = interrupted(made, f"part-{n}", device, after=n)["frames"]
        for camera in (Path(f"part-{n}/{name}") for name in ("left", "right")):
            counts = [len(list(camera.glob(f"{name}/*"))) for name in ("frames", "depth", "flow")]
            assert counts == [frames, frames, frames - 1]
            with np.load(camera / "tracks.npz") as archive:
                assert archive["points"].shape == (9, frames, 2)
            with Image.open(camera / "animation.gif") as film:
                assert getattr(film, "n_frames", 1) <= frames
        resume(f"part-{n}", threads=device.threads)
        assert results(Path(f"part-{n}")) == results(Path("whole"))


def test_results_of_earlier_cameras_are_replaced(small: Path, device: Device, message: Messages) -> None:
    run(with_cameras(STEREO), "out", threads=device.threads, estimate_error=False)
    Path("out/left/mine.txt").write_text("mine")
    run(with_cameras({"one": LEFT, "two": LEFT}), "out", threads=device.threads, estimate_error=False)
    assert sorted(path.name for path in Path("out").iterdir()) == ["left", "one", "run.json", "trajectory.npz", "two"]
    assert [path.name for path in Path("out/left").iterdir()] == ["mine.txt"]
    Path("out/left/frames").mkdir()
    shutil.copy("speckle.png", "out/left/frames/0002.png")
    with message.raises(ForeignError, "out/left/frames/0002.png"):
        run(with_cameras(STEREO), "out", threads=device.threads, estimate_error=False)


def test_cameras_of_a_playback(stereo: Path, device: Device, message: Messages) -> None:
    finished = read_run(stereo)
    assert (finished.camera_names(), finished.camera) == (["left", "right"], "left")
    with Playback(stereo, threads=device.threads) as playback:
        for name in ("left", "right"):
            with Image.open(stereo / name / "frames/0002.png") as image:
                np.testing.assert_array_equal(playback.draw(2, name), np.asarray(image))
            with np.load(stereo / name / "tracks.npz") as tracks:
                pixels, hidden = playback.locate(2, tracks["coordinates"], camera=name)
                np.testing.assert_array_equal(pixels, tracks["points"][:, 2])
                np.testing.assert_array_equal(hidden, tracks["occluded"][:, 2])
        np.testing.assert_array_equal(playback.draw(2), playback.draw(2, "left"))
        to_right = playback.flow(1, 2, "left", "right").flow
        assert not np.array_equal(to_right, playback.flow(1, 2, "left").flow)
        assert playback.draw(0, "oblique").shape == (256, 320, 3)
        with message.raises(ArgumentError, "camera"):
            playback.draw(0, "lift")


@pytest.mark.parametrize("play", [True, False])
def test_session_with_several_cameras(play: bool, small: Path, device: Device) -> None:
    made = with_cameras(SWAYING_STEREO, "[png]", "time.frames_per_second=25")
    with Session(made, Captures(Path("captures"), "small.yaml"), threads=device.threads, play=play) as session:
        for _ in range(5):
            session.advance()
        at = session.frame / session.frame_rate if play else 0.0
        np.testing.assert_allclose(session.viewport.view.matrix, view(made, at).matrix, rtol=1e-6, atol=1e-9)
        assert session.recorded_scene().render == made.render or not play
        session.viewport.turn(20, 5)
        turned = session.viewport.view
        session.advance()
        assert session.viewport.view is turned, "a turned camera stays"
        left, right = session.recorded_scene().render.all_cameras.items()
        assert left[1] != made.render.main_camera
        assert right == ("right", made.render.all_cameras["right"])
        session.viewport.set_camera("top")
        assert session.recorded_scene().render.all_cameras["left"] == "top"


def refuse(message: Messages, cameras: str, *overrides: str) -> None:
    """Compare the errors of cameras; they begin in line 11 of a scene file."""
    text = Path("small.yaml").read_text()
    Path("s.yaml").write_text(text.replace("refine: 1}", f"refine: 1, cameras: {{\n{cameras}}}}}"))
    with message.raises(SceneError):
        load_scene("s.yaml", overrides)


NEAR = PAIR.format("[1, 0, 0]")


def right_of_top(keys: str) -> str:
    return f"left: top,\n right: {{beside: left, {keys}}}"


INVALID_CAMERAS = {
    "unknown camera": "left: top,\n right: {beside: lift, baseline: 1}",
    "itself": "left: top,\n right: {beside: right, baseline: 1}",
    "cycle": "left: top,\n a: {beside: b, baseline: 1}, b: {beside: a, baseline: 1}",
    "main camera": "right: {beside: left, baseline: 1},\n left: top",
    "baseline 0": "left: top,\n right: {beside: left, baseline: 0}",
    "large baseline": "left: top,\n right: {beside: left, baseline: 1.0e+20}",
    "baseline alone": "left: {eye: [0, 0, 1], baseline: 1}",
    "baseline and eye": "left: top,\n right: {beside: left, baseline: 1, eye: [0, 0, 1]}",
    "baseline and lens": right_of_top("baseline: 1, fov: 30"),
    "rotation alone": right_of_top("rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 1]]"),
    "scaled rotation": right_of_top("rotation: [[1, 0, 0], [0, 1, 0], [0, 0, 2]], translation: [1, 0, 0]"),
    "distortion without a lens": right_of_top(f"{NEAR}, distortion: {{k1: 1}}"),
    "folded distortion": right_of_top(f"{NEAR}, fov: 90, distortion: {{k1: -1}}"),
    "invalid name": "Left: top",
    "folder of labels": "flow: top",
    "folder in place of a calibration": "left: top, right: {eye: [0, 0, 1], calibration: .}",
    "missing calibration": "left: top, right: {eye: [0, 0, 1], calibration: a.yml}",
}


@pytest.mark.parametrize("cameras", INVALID_CAMERAS.values(), ids=INVALID_CAMERAS)
def test_errors_of_cameras(cameras: str, small: Path, message: Messages) -> None:
    refuse(message, cameras)


def test_invalid_combinations_with_cameras(small: Path, message: Messages) -> None:
    refuse(message, "left: top", "render.camera=top")
    for override, cameras in (("render.cameras=null", [""]), ("render.camera=null", ["left"])):
        assert list(load_scene("s.yaml", ["render.camera=top", override]).render.all_cameras) == cameras
    refuse(message, "left: top", "output=[disparity]")
    refuse(message, "left: top", "output=[stereo]")
    distorted = "a: {eye: [0, 0, 1], distortion: {k1: -0.01}}, b: {beside: a, baseline: 1}"
    refuse(message, distorted, "output=[disparity]")
    refuse(message, right_of_top(NEAR), "output=[stereo, disparity]")
    refuse(message, INVALID_CAMERAS["baseline 0"], "output=[png, disparity]")  # the output is not at fault


def test_stereo_calibration(small: Path, message: Messages) -> None:
    """R and T are those of the file or, if it has one camera, of the scene."""
    matrices = [f"[[{fx}, 0, 20], [0, 41, 15], [0, 0, 1]]" for fx in (40, 43)]
    eyes = [f"K{n}: {matrix}\nD{n}: [-0.0{n}, 0, 0, 0]\n" for n, matrix in enumerate(matrices, 1)]
    rotation = TURN.tolist()
    Path("pair.yml").write_text("".join(eyes) + f"R: {rotation}\nT: [-10, 2, 0.5]\n")
    Path("right.yml").write_text(f"camera_matrix: {matrices[1]}\ndist_coeffs: [-0.02, 0, 0, 0]\n")
    left = {**LEFT, "calibration": "pair.yml"}
    right = {"beside": "left", "calibration": "pair.yml", "calibration_eye": "right", "calibration_unit": "mm"}
    single = {"beside": "left", "calibration": "right.yml"}
    pose = {"rotation": rotation, "translation": [-0.01, 0.002, 0.0005]}
    pairs = [with_cameras({"left": left, "right": camera}) for camera in (right, {**single, **pose})]
    assert pairs[0].render == pairs[1].render
    np.testing.assert_allclose(
        pair_transform(pairs[0].render.all_cameras["right"])["translation"], [-0.01, 0.002, 5e-4]
    )
    assert [view_at(pairs[0], 0, name).scale[0] for name in ("left", "right")] == [40, 43]
    for invalid in (single, {**right, **pose}, {**right, "calibration_eye": "left"}):
        with message.raises(SceneError):
            with_cameras({"left": left, "right": invalid})


def test_poses_of_a_moving_camera(small: Path, device: Device) -> None:
    """tests/test_consistency.py compares labels with these poses."""
    moving = {**SWAYING, "distortion": {"k1": -0.1, "p1": 0.002}}
    made = load_scene("small.yaml", [f"render.camera={json.dumps(moving)}", "output=[depth]"])
    run(made, "out", threads=device.threads, estimate_error=False)
    written = json.loads(Path("out/camera.json").read_text())
    assert written["poses"][0] == written["pose"]
    np.testing.assert_allclose(written["projection"], view(made).matrix[:3])
    expected = [calibration(view(made, frame / 10))["pose"] for frame in range(5)]
    np.testing.assert_allclose(written["poses"], expected, atol=1e-12)


def posed(**camera: Any) -> Scene:
    return scene(render={"camera": camera, "size": [40, 30]})


def test_pose_against_eye_and_target(message: Messages) -> None:
    by_eye = posed(eye=[0.1, -0.3, 0.4], target=[0, 0.05, 0], fov=50)
    matrix = np.array(calibration(view(by_eye))["pose"])
    pose = {"rotation": (matrix[:, :3] * 1.0004).tolist(), "translation": matrix[:, 3].tolist()}
    # A rounded rotation is made orthonormal.
    np.testing.assert_allclose(view(posed(pose=pose, fov=50)).matrix, view(by_eye).matrix, atol=1e-9)
    for invalid in (matrix[:, :3] * 1.002, matrix[[1, 0, 2], :3]):
        with message.raises(SceneError, "render.camera.pose.rotation"):
            view(posed(pose={**pose, "rotation": invalid.round(3).tolist()}))


POSE = [[0, 0, 0, 1, 1, 0, 0, 0]]

INVALID_MOTIONS: dict[str, dict[str, Any]] = {
    "equal times": {"eye": [[0, 0, 0, 1], [0, 0, 0, 2]]},
    "eye at its target": {"eye": [0, 0, 1], "target": [[0, 0, 0, 0], [0.2, 0, 0, 1]]},
    "eye and poses": {"eye": [0, 0, 1], "poses": POSE},
    "equal times of poses": {"poses": [*POSE, *POSE]},
    "poses and up": {"poses": POSE, "up": [0, 1, 0]},
    "intrinsics and fov": {"eye": [0, 0, 1], "intrinsics": {"fx": 1, "fy": 1, "cx": 0, "cy": 0}, "fov": 30},
}


@pytest.mark.parametrize("camera", INVALID_MOTIONS.values(), ids=INVALID_MOTIONS)
def test_invalid_motions(camera: dict[str, Any], message: Messages) -> None:
    with message.raises(SceneError, "camera."):
        view(Scene(**posed(eye=[0, 0, 1]).model_dump(exclude={"render"}), render={"camera": camera}))
