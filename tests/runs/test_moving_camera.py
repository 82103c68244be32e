"""Cameras that move, and those that stand at a pose: every frame is seen from their place at its time."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from PIL import Image

from taichi_msm import Playback, resume, run
from taichi_msm.errors import SceneError
from taichi_msm.load.scene_file import load_scene
from taichi_msm.render.camera import calibration, view
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from taichi_msm.view.recording import Captures
from taichi_msm.view.session import Session
from tests.outputs import results
from tests.reference import labels as twin
from tests.runs.test_label_files import read_flow
from tests.runs.test_resume import interrupted
from tests.scenes import scene

LENS = {"k1": -0.1, "p1": 0.002}
MOVING = {
    "eye": [[0, 0.1, -0.3, 0.3], [0.4, -0.1, -0.2, 0.35]],
    "up": [[0, 0, 1, 0], [0.4, 0.2, 1, 0]],
    "fov": 60,
    "distortion": LENS,
}
ALL = "output=[png, gif, coordinates, depth, flow, occlusion, tracks, trajectory]"


def moving(*overrides: str) -> Scene:
    return load_scene("small.yaml", ["render.tracks=6", f"render.camera={json.dumps(MOVING)}", *overrides])


def still(made: Scene, time: float) -> Scene:
    """The same scene seen from where the camera is at a time."""
    matrix = np.array(calibration(view(made, time))["pose"])
    pose = {"rotation": matrix[:, :3].tolist(), "translation": matrix[:, 3].tolist()}
    camera = {"pose": pose, "fov": 60, "distortion": LENS}
    return made.model_copy(update={"render": made.render.model_copy(update={"camera": camera})})


def test_every_frame_has_its_own_pose(small: Path, device: Device) -> None:
    made = moving(ALL)
    run(made, "out", threads=device.threads)
    out = Path("out")
    positions = np.load(out / "trajectory.npz")["position"].astype(float)
    tracks = dict(np.load(out / "tracks.npz"))
    written = json.loads((out / "camera.json").read_text())
    assert np.array(written["poses"]).shape == (5, 3, 4)
    assert written["poses"][0] == written["pose"]
    np.testing.assert_allclose(written["projection"], view(made).matrix[:3])
    for frame in range(5):
        seen = still(made, frame / 10)
        np.testing.assert_allclose(calibration(view(seen))["pose"], written["poses"][frame], atol=1e-12)
        coordinates, depth, _ = twin.labels(seen, positions[frame])
        found = np.load(out / f"coordinates/{frame:04}.npy")
        sheet = ~np.isnan(coordinates[..., 0])
        np.testing.assert_allclose(found, coordinates, atol=1e-5)
        with Image.open(out / f"depth/{frame:04}.tiff") as image:
            np.testing.assert_allclose(np.array(image), depth, rtol=1e-5)
        pixels, hidden = twin.find(seen, tracks["coordinates"].astype(float), positions[frame])
        np.testing.assert_allclose(tracks["points"][:, frame], pixels, atol=1e-3)
        np.testing.assert_array_equal(tracks["occluded"][:, frame], hidden)
        if frame < 4:
            pixels, hidden = twin.find(still(made, (frame + 1) / 10), coordinates[sheet], positions[frame + 1])
            flow = read_flow(out / f"flow/{frame:04}.flo")
            assert np.abs(flow[sheet] - (pixels - np.argwhere(sheet)[:, ::-1] - 0.5)).max() < 0.01
            assert np.abs(flow[sheet]).max() > 1
            with Image.open(out / f"occlusion/{frame:04}.png") as image:
                assert (np.array(image)[sheet] == 255 * hidden).mean() > 0.99
    with Playback("out") as again:
        with Image.open(out / "frames/0003.png") as image:
            np.testing.assert_array_equal(again.draw(3), np.array(image))
        np.testing.assert_array_equal(again.flow(1, 2).flow, read_flow(out / "flow/0001.flo"))


def test_a_resumed_run_has_the_same_bits(small: Path, device: Device) -> None:
    run(moving(ALL), "whole", threads=device.threads)
    interrupted(moving(ALL), "part", device)
    resume("part", threads=device.threads)
    assert results(Path("whole")) == results(Path("part"))


def test_a_session_that_plays_follows_the_camera(small: Path, device: Device) -> None:
    made = moving("time.frames_per_second=25")
    for play in (True, False):
        with Session(made, Captures(Path("captures"), "small.yaml"), threads=device.threads, play=play) as session:
            for _ in range(5):
                session.advance()
            at = session.frame / session.frame_rate if play else 0.0
            np.testing.assert_allclose(session.viewport.view.matrix, view(made, at).matrix, rtol=1e-6, atol=1e-9)
            session.viewport.turn(3, 0)
            turned = session.viewport.view
            session.advance()
            assert session.viewport.view is turned, "a camera that was turned stays"


def posed(**camera: Any) -> Scene:
    return scene(render={"camera": camera, "size": [40, 30]})


def test_a_pose_is_that_of_an_eye_and_a_target() -> None:
    by_eye = posed(eye=[0.1, -0.3, 0.4], target=[0, 0.05, 0], fov=50)
    matrix = np.array(calibration(view(by_eye))["pose"])
    pose = {"rotation": (matrix[:, :3] * 1.0004).tolist(), "translation": matrix[:, 3].tolist()}
    # Rounded ones are made orthonormal.
    np.testing.assert_allclose(view(posed(pose=pose, fov=50)).matrix, view(by_eye).matrix, atol=1e-9)
    for wrong in (matrix[:, :3] * 1.002, matrix[[1, 0, 2], :3]):
        with pytest.raises(SceneError, match=r"render.camera.pose.rotation: is .*no rotation.*; its rows are the"):
            view(posed(pose={**pose, "rotation": wrong.tolist()}))


STOP = [[0, 0, 0, 1, 1, 0, 0, 0]]


@pytest.mark.parametrize(
    ("camera", "said"),
    [
        (
            {"eye": [[0, 0, 0, 1], [0, 0, 0, 2]]},
            "eye.1: is at 0 s, and the key before it at 0 s; sort the keys, each later than the last",
        ),
        (
            {"eye": [0, 0, 1], "target": [[0, 0, 0, 0], [0.2, 0, 0, 1]]},
            "eye: [0.0, 0.0, 1.0] is also the target at 0.2 s; move one of them",
        ),
        ({"eye": [0, 0, 1], "poses": STOP}, "eye: is given together with poses; remove one of them"),
        (
            {"poses": [*STOP, *STOP]},
            "poses.1: is at 0 s, the pose before it at 0 s; sort them, each later than the last",
        ),
        ({"eye": [0, 0, 1], "scale": True}, "scale: goes with calibration; remove it"),
        ({"poses": STOP, "up": [0, 1, 0]}, "up: goes with eye; a pose has a direction of its own"),
        (
            {"eye": [0, 0, 1], "intrinsics": {"fx": 1, "fy": 1, "cx": 0, "cy": 0}, "fov": 30},
            "fov: is given together with intrinsics; remove one of them",
        ),
    ],
)
def test_what_cannot_be_is_refused(camera: dict[str, Any], said: str) -> None:
    with pytest.raises(SceneError) as caught:
        view(Scene(**posed(eye=[0, 0, 1]).model_dump(exclude={"render"}), render={"camera": camera}))
    assert str(caught.value).endswith(f"camera.{said}")
