"""Calibrations and trajectories as OpenCV, ROS, STIR and TUM write them."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from taichi_msm import load_scene
from taichi_msm.errors import SceneError
from taichi_msm.render.camera import view
from taichi_msm.scene import Camera

MATRIX = np.array([[61.5, 0, 19.25], [0, 60.5, 14.75], [0, 0, 1]])
COEFFICIENTS = [-0.3, 0.1, 0.001, -0.002, 0.03]
READ = "render.camera={eye: [0, 0, 0.4], calibration: FILE}"


def camera_of(path: str, *more: str) -> Camera:
    found = load_scene("small.yaml", [READ.replace("FILE", path), *more]).render.camera
    assert isinstance(found, Camera)
    return found


def refused(path: str, *more: str) -> str:
    with pytest.raises(SceneError) as caught:
        camera_of(path, *more)
    return str(caught.value).partition("render.camera.")[2]


def write_opencv(path: str) -> None:
    storage = cv2.FileStorage(path, cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 40)
    storage.write("image_height", 30)
    storage.write("fisheye_model", 0)
    storage.write("camera_matrix", MATRIX)
    storage.write("distortion_coefficients", np.array([COEFFICIENTS]))
    storage.release()


@pytest.mark.parametrize("suffix", ["yml", "yaml", "xml", "json"])
def test_opencvs_files_are_read(suffix: str, small: Path) -> None:
    write_opencv(f"camera.{suffix}")
    camera = camera_of(f"camera.{suffix}")
    assert camera.calibration is None, "what is read is kept, not the path"
    assert camera.intrinsics is not None
    assert camera.distortion is not None
    assert camera.intrinsics.model_dump() == {"fx": 61.5, "fy": 60.5, "cx": 19.25, "cy": 14.75}
    assert camera.distortion.coefficients == (-0.3, 0.1, 0.001, -0.002, 0.03, 0, 0, 0)
    # Ours begin half a pixel earlier.
    np.testing.assert_array_equal(
        view(load_scene("small.yaml", [READ.replace("FILE", f"camera.{suffix}")])).centre, [19.75, 15.25]
    )


ROS = """\
image_width: 40
image_height: 30
camera_name: narrow_stereo
camera_matrix: {rows: 3, cols: 3, data: [61.5, 0, 19.25, 0, 60.5, 14.75, 0, 0, 1]}
distortion_model: MODEL
distortion_coefficients: {rows: 1, cols: 4, data: [0.01, 0.002, 0.0003, -0.0004]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""


def test_ros_and_stir_are_read(small: Path) -> None:
    for model, expected in (("plumb_bob", "pinhole"), ("equidistant", "fisheye")):
        Path("ros.yaml").write_text(ROS.replace("MODEL", model))
        camera = camera_of("ros.yaml")
        assert camera.distortion is not None
        assert camera.distortion.model == expected
        assert camera.distortion.coefficients[:4] == (0.01, 0.002, 0.0003, -0.0004)
    # STIRLoader.py of the data set reads these keys, and tells no size.
    left = {"leftcameramat": MATRIX.tolist(), "leftdistortioncoeffs": [0, 0, 0, 0, 0]}
    Path("calib.json").write_text(json.dumps({**left, "rightcameramat": [], "rotation": [], "translation": []}))
    camera = camera_of("calib.json")
    assert camera.intrinsics is not None
    assert camera.intrinsics.fy == 60.5
    assert camera.distortion is None


PRINTED = """\
header: {seq: 7, frame_id: "camera"}
height: 30
width: 40
distortion_model: "plumb_bob"
D: [0.01, 0.002, 0.0003, -0.0004, 0.0]
K: [61.5, 0.0, 19.25, 0.0, 60.5, 14.75, 0.0, 0.0, 1.0]
binning_x: 0
binning_y: 1
roi: {x_offset: 0, y_offset: 0, height: 0, width: 0, do_rectify: False}
---
"""


def test_what_ros_prints_of_a_topic_is_read(small: Path) -> None:
    second = PRINTED.replace("D:", "d:").replace("K:", "k:")
    for text in (PRINTED, 2 * PRINTED, second, PRINTED.replace("width: 0", "width: 40")):
        Path("ros.yaml").write_text(text)
        camera = camera_of("ros.yaml")
        assert camera.intrinsics is not None
        assert camera.intrinsics.cx == 19.25
        assert camera.distortion is not None
        assert camera.distortion.k2 == 0.002


@pytest.mark.parametrize("change", [("g_x: 0", "g_x: 2"), ("x_offset: 0", "x_offset: 4"), ("width: 0", "width: 20")])
def test_pictures_that_ros_has_made_smaller_are_refused(change: tuple[str, str], small: Path) -> None:
    Path("ros.yaml").write_text(PRINTED.replace(*change))
    assert refused("ros.yaml") == (
        "calibration: ros.yaml: of pictures that are binned or cut, while its camera matrix is of whole ones; "
        "write that of the pictures, without binning_x, binning_y and roi"
    )


def test_pictures_of_another_size_are_refused_or_scaled(small: Path) -> None:
    write_opencv("camera.yml")
    said = refused("camera.yml", "render.size=[80, 90]")
    assert said == (
        "calibration: camera.yml: of pictures of 40 x 30 pixels, not of 80 x 90; "
        "set render.size to these, or scale: true"
    )
    camera = camera_of("camera.yml", "render.size=[80, 90]", "render.camera.scale=true")
    assert camera.intrinsics is not None
    # The left edge is at -0.5 in both.
    assert camera.intrinsics.model_dump() == {"fx": 123, "fy": 181.5, "cx": 39, "cy": 45.25}


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: b: c", "camera.yml:1: neither YAML, XML nor JSON; name a calibration"),
        ("- 1", "camera.yml: has no keys; expected camera_matrix and distortion_coefficients"),
        ("a: &a [1]\nb: *a", "camera.yml: neither YAML, XML nor JSON; name a calibration"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><a/>', "camera.yml: neither YAML, XML nor JSON; name a calibration"),
        ("K: 3", "camera.yml: its camera matrix is not [fx, 0, cx, 0, fy, cy, 0, 0, 1]; write it like that"),
        (
            "K: [1, 0, 1, 0, 1, 1, 0, 0, 1]\nwidth: 0\nheight: 0",
            "camera.yml: of pictures of 0 x 0 pixels; write the size of those that were calibrated with",
        ),
        ("K: [1, 0, 1e9, 0, 1, 1, 0, 0, 1]", "camera.yml: K: not numbers up to 1e+06; write them as OpenCV does"),
        ("f: 3", "camera.yml: has no camera_matrix; name a calibration of OpenCV, ROS or STIR"),
        ("", "camera.yml: has no keys; expected camera_matrix and distortion_coefficients"),
        ('width: !!int ""', "camera.yml: neither YAML, XML nor JSON; name a calibration"),
        (f"K: [1{400 * '0'}]", "camera.yml: K: not numbers up to 1e+06; write them as OpenCV does"),
        (
            "K: [1, 0, 1, 2, 1, 1, 0, 0, 1]",
            "camera.yml: its camera matrix is not [fx, 0, cx, 0, fy, cy, 0, 0, 1]; write it like that",
        ),
        (
            "K: [1, 0, 1, 0, 1, 1, 0, 0, 1]\nwidth: 40",
            "camera.yml: has only one of image_width and image_height; write both",
        ),
        ("K: [x]", "camera.yml: K: not numbers up to 1e+06; write them as OpenCV does"),
        (
            "K: [1, 0, 1, 0, 1, 1, 0, 0, 1]\nD: [1, 2, 3]",
            "camera.yml: 3 distortion coefficients that are not known; expected k1, k2, p1, p2, k3, k4, k5, k6, and 0 "
            "after them",
        ),
        (
            "K: [1, 0, 1, 0, 1, 1, 0, 0, 1]\ndistortion_model: fov",
            "camera.yml: distortion_model: fov is not known; expected one of: plumb_bob, rational_polynomial, "
            "equidistant, fisheye",
        ),
    ],
)
def test_what_is_no_calibration_is_refused(text: str, said: str, small: Path) -> None:
    Path("camera.yml").write_text(text)
    assert refused("camera.yml") == f"calibration: {said}"


def test_files_are_beside_the_scene(small: Path) -> None:
    write_opencv("camera.yml")
    Path("inner").mkdir()
    text = Path("small.yaml").read_text().replace("render: {", "render: {camera: {eye: [0, 0, 1], calibration: PATH}, ")
    text = text.replace("speckle.png", "../speckle.png")
    Path("inner/s.yaml").write_text(text.replace("PATH", "../camera.yml"))
    with pytest.raises(SceneError) as caught:
        load_scene("inner/s.yaml", image="speckle.png")
    assert "render.camera.calibration: ../camera.yml is not below the scene's folder; put it there" in str(caught.value)
    Path("camera.yml").rename("inner/camera.yml")
    Path("inner/s.yaml").write_text(text.replace("PATH", "camera.yml"))
    assert isinstance(load_scene("inner/s.yaml", image="speckle.png").render.camera, Camera)


TUM = """\
# timestamp tx ty tz qx qy qz qw
0.0 0.0 0.0 0.4 1 0 0 0
0.2 0.1 0.0 0.4 1 0 0 0
0.4 0.1 0.0 0.5 0.6 0.8 0 0
"""


def test_a_trajectory_is_read(small: Path) -> None:
    Path("poses.txt").write_text(TUM)
    made = load_scene("small.yaml", ["render.camera={poses: poses.txt}"])
    # A camera that looks down: half a turn about x.
    np.testing.assert_allclose(view(made, 0.1).eye, [0.05, 0, 0.4])
    np.testing.assert_allclose(view(made, 0.1).axes, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(view(made, 0.3).eye, [0.1, 0, 0.45])
    # From (1, 0, 0, 0) to (0.6, 0.8, 0, 0) is a turn about z by twice the angle whose cosine is 0.6; half of it.
    angle = np.arccos(0.6)
    np.testing.assert_allclose(view(made, 0.3).axes[0], [np.cos(angle), np.sin(angle), 0], atol=1e-12)
    np.testing.assert_allclose(view(made, 0.3).axes[2], [0, 0, 1], atol=1e-12)


@pytest.mark.parametrize(
    ("lines", "said"),
    [
        (
            TUM.replace("0.4 0.1", "0.2 0.1"),
            "poses.txt:4: is at 0.2 s, the pose before it at 0.2 s; sort them, each later than the last",
        ),
        (
            TUM.replace("0.6 0.8", "0.6 0.9"),
            "poses.txt:4: its quaternion has the length 1.08167, so it is no rotation; write one of length 1",
        ),
        (
            TUM.replace("0.6 0.8", "0.6"),
            "poses.txt:4: not a pose; expected eight numbers up to 1e+30: t tx ty tz qx qy qz qw",
        ),
        ("# nothing\n", "poses.txt: no poses; expected lines t tx ty tz qx qy qz qw"),
        (
            TUM.replace("0.0 0.0 0.0", "0.1 0.0 0.0"),
            "covers 0.1 s to 0.4 s, but the scene goes from 0 s to 0.4 s; its times are those of the scene: subtract "
            "the first one from all",
        ),
        (
            TUM.replace("0.4 0.1", "0.3 0.1"),
            "covers 0 s to 0.3 s, but the scene goes from 0 s to 0.4 s; shorten time.duration or give the poses of all "
            "of it",
        ),
    ],
)  # fmt: skip
def test_a_trajectory_that_cannot_be_used_is_refused(lines: str, said: str, small: Path) -> None:
    Path("poses.txt").write_text(lines)
    with pytest.raises(SceneError) as caught:
        load_scene("small.yaml", ["render.camera={poses: poses.txt}"])
    assert str(caught.value).endswith(f"render.camera.poses: {said}")
