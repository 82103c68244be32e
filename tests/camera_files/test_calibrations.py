"""Calibration files of other programs."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest
import yaml

from taichi_msm import load_scene
from taichi_msm.arithmetic import NUMPY
from taichi_msm.camera_files.calibration import Calibration
from taichi_msm.camera_files.camera_file import CameraFileError
from taichi_msm.camera_files.readers import read_calibration
from taichi_msm.cli.main import main
from taichi_msm.errors import SceneError
from taichi_msm.lenses import MODELS
from taichi_msm.render.camera import view
from taichi_msm.scene.camera import Camera
from tests.golden import Messages

MATRIX = np.array([[61.5, 0, 19.25], [0, 60.5, 14.75], [0, 0, 1]])
COEFFICIENTS = [-0.3, 0.1, 0.001, -0.002, 0.03]
READ = "render.camera={eye: [0, 0, 0.4], calibration: FILE}"


def camera_of(path: str, *overrides: str) -> Camera:
    camera = load_scene("small.yaml", [READ.replace("FILE", path), *overrides]).render.camera
    assert isinstance(camera, Camera)
    return camera


def read(text: str, eye: Literal["left", "right"] = "left", unit: Literal["mm"] | None = None) -> Calibration:
    Path("camera.yml").write_text(text)
    return read_calibration("camera.yml", eye, unit)


def write_opencv(path: str) -> None:
    storage = cv2.FileStorage(path, cv2.FILE_STORAGE_WRITE)
    storage.write("image_width", 40)
    storage.write("image_height", 30)
    storage.write("fisheye_model", 0)
    storage.write("camera_matrix", MATRIX)
    storage.write("distortion_coefficients", np.array([COEFFICIENTS]))
    storage.release()


@pytest.mark.parametrize("suffix", ["yml", "yaml", "xml", "json"])
def test_opencv_file(suffix: str, small: Path) -> None:
    path = Path(f"camera.{suffix}")
    write_opencv(str(path))
    if suffix == "yaml":
        path.write_text("# Comments before OpenCV's first line.\n\n" + path.read_text())
    camera = camera_of(str(path))
    assert camera.calibration is None, "the values replace the path"
    assert camera.intrinsics is not None
    assert camera.distortion is not None
    assert camera.intrinsics.model_dump() == {"fx": 61.5, "fy": 60.5, "cx": 19.25, "cy": 14.75}
    assert camera.distortion.coefficients == (-0.3, 0.1, 0.001, -0.002, 0.03, 0, 0, 0)
    # The first pixel of a view has its centre at (0.5, 0.5).
    centre = view(load_scene("small.yaml", [READ.replace("FILE", str(path))])).centre
    np.testing.assert_array_equal(centre, [19.75, 15.25])


ROS = """\
image_width: 40
image_height: 30
camera_matrix: {rows: 3, cols: 3, data: [61.5, 0, 19.25, 0, 60.5, 14.75, 0, 0, 1]}
distortion_model: MODEL
distortion_coefficients: {rows: 1, cols: 4, data: [0.01, 0.002, 0.0003, -0.0004]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""
# Printed by `rostopic echo`.
MESSAGE = """\
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


@pytest.mark.parametrize(
    ("text", "model"),
    [
        (ROS.replace("MODEL", "plumb_bob"), "pinhole"),
        (ROS.replace("MODEL", "equidistant"), "fisheye"),
        (2 * MESSAGE, "pinhole"),
        (MESSAGE.replace("D:", "d:").replace("K:", "k:").replace("width: 0", "width: 40"), "pinhole"),
    ],
    ids=["plumb_bob", "equidistant", "ROS 1", "ROS 2"],
)
def test_ros_camera_info(text: str, model: str, small: Path) -> None:
    calibration = read(text)
    assert (calibration.model, calibration.centre, calibration.size) == (model, (19.25, 14.75), (40, 30))
    assert [*calibration.coefficients.values()][:4] == [0.01, 0.002, 0.0003, -0.0004]


RIGHT = np.array([[62.5, 0, 20.25], [0, 61.5, 13.75], [0, 0, 1]])
ROTATION = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
TRANSLATION = np.array([-4.25, 0.0625, -0.125])  # [mm]


def stereo(matrix: str, distortion: str, *marks: str) -> str:
    """Return a file of OpenCV with names of keys, each with a mark of the camera."""
    storage = cv2.FileStorage(".yml", cv2.FILE_STORAGE_WRITE | cv2.FILE_STORAGE_MEMORY)
    storage.write("image_size", np.array([[40, 30]]))
    for mark, value, coefficients in zip(marks, (MATRIX, RIGHT), (COEFFICIENTS, [0.25, *4 * [0]]), strict=True):
        storage.write(f"{matrix}{mark}", value)
        storage.write(f"{distortion}{mark}", np.array([coefficients]))
        storage.write(f"R{mark}", np.eye(3))  # of the rectification
        storage.write(f"P{mark}", np.eye(3, 4))
    storage.write("R", ROTATION)
    storage.write("T", TRANSLATION)
    return str(storage.releaseAndGetString())


# Keys that STIRLoader.py of the data set reads; lengths are metres, and there is no size.
STIR = {
    "leftcameramat": MATRIX.tolist(),
    "rightcameramat": RIGHT.tolist(),
    "leftdistortioncoeffs": COEFFICIENTS,
    "rightdistortioncoeffs": [0.25, 0, 0, 0, 0],
    "rotation": ROTATION.tolist(),
    "translation": (TRANSLATION / 1e3).tolist(),
}
KALIBR = """\
cam0:
  cam_overlaps: [1]
  camera_model: pinhole
  distortion_coeffs: [-0.3, 0.1, 0.001, -0.002]
  distortion_model: radtan
  intrinsics: [61.5, 60.5, 19.25, 14.75]
  resolution: [40, 30]
  rostopic: /cam0/image_raw
cam1:
  T_cn_cnm1:
  - [1.0, 0.0, 0.0, -0.00425]
  - [0.0, 0.8, -0.6, 0.0000625]
  - [0.0, 0.6, 0.8, -0.000125]
  - [0.0, 0.0, 0.0, 1.0]
  cam_overlaps: [0]
  camera_model: pinhole
  distortion_coeffs: [0.25, 0, 0, 0]
  distortion_model: radtan
  intrinsics: [62.5, 61.5, 20.25, 13.75]
  resolution: [40, 30]
  rostopic: /cam1/image_raw
"""
OMNI_KALIBR = KALIBR.replace("pinhole", "omni").replace("intrinsics: [", "intrinsics: [1.25, ")


def stereomis() -> str:
    """Return StereoCalibration.ini of the data set."""
    text = "[Version]\nmajor = 1\n"
    left = "Left", MATRIX, COEFFICIENTS, np.eye(3), np.zeros(3)
    for eye, matrix, coefficients, rotation, translation in (left, ("Right", RIGHT, [0.25], ROTATION, TRANSLATION)):
        values: dict[str, float] = {"res_x": 40, "res_y": 30}
        values |= {f"kc_{n}": value for n, value in enumerate([*coefficients, *8 * [0]][:8])}
        values |= {f"R_{n}": value for n, value in enumerate(rotation.ravel())}
        values |= {f"T_{n}": value for n, value in enumerate(translation)}
        values |= {"fc_x": matrix[0, 0], "fc_y": matrix[1, 1], "cc_x": matrix[0, 2], "cc_y": matrix[1, 2]}
        text += f"[Stereo{eye}]\n" + "".join(f"{name} = {value}\n" for name, value in values.items())
    return text


def sections() -> str:
    """Return a file with a section per camera."""
    left = {"K": MATRIX.tolist(), "D": COEFFICIENTS, "size": [40, 30]}
    right = {"K": RIGHT.tolist(), "D": [0.25, 0, 0, 0], "size": [40, 30]}
    return json.dumps({"cam0": left, "cam1": right, "R": ROTATION.tolist(), "T": STIR["translation"]})


@pytest.mark.parametrize(
    ("write", "unit"),
    [
        *(
            pytest.param(partial(stereo, *names), "mm", id=names[0] + names[2])
            for names in (
                *(("K", "D", "0", "1"), ("mtx", "dist", "L", "R")),
                *(("cameraMatrix", "distCoeffs", "1", "2"), ("camera_matrix", "dist_coeffs", "_left", "_right")),
            )
        ),
        pytest.param(sections, None, id="sections"),
        pytest.param(partial(json.dumps, STIR), None, id="STIR"),
        pytest.param(lambda: KALIBR, None, id="Kalibr"),
        pytest.param(stereomis, None, id="StereoMIS"),
    ],
)
def test_stereo_pair(write: Callable[[], str], unit: Literal["mm"] | None, small: Path) -> None:
    left, right = read(write()), read(write(), "right", unit)
    assert (left.focal, left.centre) == ((61.5, 60.5), (19.25, 14.75))
    assert (right.focal, right.centre) == ((62.5, 61.5), (20.25, 13.75))
    assert [*left.coefficients.values()][:4] == COEFFICIENTS[:4]
    assert [*right.coefficients.values()][:4] == [0.25, 0, 0, 0]
    assert left.size == right.size == (None if write.__class__ is partial and "leftcameramat" in write() else (40, 30))
    assert right.right is not None
    np.testing.assert_array_equal(right.right.rotation, ROTATION)
    np.testing.assert_allclose(right.right.translation, TRANSLATION / 1e3, rtol=1e-15)


# Further results of stereoCalibrate and stereoRectify, by their names in files. F is no focal length.
FURTHER: dict[str, object] = {
    "E": [[0, -0.0002, 0.0001], [0.0002, 0, 0.0797], [-0.0001, -0.0797, 0]],
    "F": [[0, -6e-10, 1e-6], [6e-10, 0, 2e-4], [-1e-6, -2e7, 1]],
    **{"R1": np.eye(3).tolist(), "R2": np.eye(3).tolist(), "P1": np.eye(3, 4).tolist(), "P2": np.eye(3, 4).tolist()},
    **{"Q": np.eye(4).tolist(), "roi1": [0, 0, 40, 30], "roi2": [1, 0, 38, 30], "alpha": 0.5, "map1x": [[0.5]]},
    **{"rms_error": 0.3, "perViewErrors": [[0.1, 0.2]], "rvecs": [[0, 0, 1]], "tvecs": [[0, 0, 1]], "board": [9, 6]},
}
# Patterns of names in public files: matrix and distortion, with {} for the mark of a camera; marks; R; T.
NAMES = [
    ("K{}", "D{}", ("1", "2"), "R", "T"),
    ("CM{}", "D{}", ("1", "2"), "R", "T"),
    ("intrinsic{}", "distCoeffs{}", ("1", "2"), "R", "T"),
    ("{}_cameraMatrix", "{}_distCoeffs", ("l", "r"), "R", "T"),
    ("{}_Camera_Matrix", "{}_Distortion_Coefficients", ("Left", "Right"), "Rotation_Matrix", "Translation_Matrix"),
    ("camera_matrix_{}", "dist_coeffs_{}", ("left", "right"), "rotation_matrix", "translation_vector"),
    ("{}_cam_mat", "{}_distort", ("left", "right"), "R", "T"),
    ("camera_intrinsics_{}", "distortion_coefficients_{}", ("0", "1"), "rotation_matrix", "translation_vector"),
    ("{}_camera.camera_matrix", "{}_camera.dist_coeffs", ("left", "right"), "stereo.rotation", "stereo.translation"),
    ("{}_intrinsics.K", "{}_intrinsics.D", ("left", "right"), "extrinsics.R", "extrinsics.T"),
]


@pytest.mark.parametrize("names", NAMES, ids=[names[0] for names in NAMES])
def test_results_of_stereo_calibrate(names: tuple[str, str, tuple[str, str], str, str], small: Path) -> None:
    matrix, distortion, marks, rotation, translation = names
    values: dict[str, object] = {
        rotation: ROTATION.tolist(),
        translation: [[t] for t in (TRANSLATION / 1e3).tolist()],
        **FURTHER,
    }
    for mark, camera, coefficients in zip(marks, (MATRIX, RIGHT), (COEFFICIENTS, [0.25, 0, 0, 0]), strict=True):
        values |= {matrix.format(mark): camera.tolist(), distortion.format(mark): [coefficients]}
    nested: dict[str, object] = {"image_size": {"width": 40, "height": 30}}
    for name, value in values.items():
        section, _, key = name.rpartition(".")
        part = nested.setdefault(section, {}) if section else nested
        assert isinstance(part, dict)
        part[key] = value
    for text in (json.dumps(nested), yaml.safe_dump(nested)):
        left, right = read(text), read(text, "right")
        assert (left.focal, right.focal, left.size) == ((61.5, 60.5), (62.5, 61.5), (40, 30))
        assert [*left.coefficients.values()] == COEFFICIENTS
        assert right.right is not None
        np.testing.assert_array_equal(right.right.rotation, ROTATION)
        np.testing.assert_allclose(right.right.translation, TRANSLATION / 1e3, rtol=1e-15)


def test_fundamental_matrix_of_one_camera(small: Path) -> None:
    assert read(f"{K}{D}F: [[0, 0, 1], [0, 0, 2], [3, 4, 1]]\n").focal == (61.5, 60.5)


def test_stereo_pair_without_unit_or_right_camera(small: Path, message: Messages) -> None:
    with message.raises(CameraFileError, "camera.yml", "calibration_unit"):
        read(stereo("M", "D", "1", "2"), "right")
    read(K + D)
    with message.raises(SceneError, "render.camera.calibration: camera.yml", "calibration_eye"):
        camera_of("camera.yml", "render.camera.calibration_eye=right")


# Polynomial of a mirror; x is down, and the axis backward.
OCAMCALIB = """\
#polynomial coefficients for the DIRECT mapping function (ocam_model.ss in MATLAB). These are used by cam2world

5 -1.2e+02 0.000000e+00 2.5e-03 -1.5e-05 4.0e-08

#polynomial coefficients for the inverse mapping function (ocam_model.invpol in MATLAB). These are used by world2cam

3 180.0 90.0 -5.0

#center: "row" and "column", starting from 0 (C convention)

14.75 19.25

#affine parameters "c", "d", "e"

1.02 0.01 -0.02

#image size: "height" and "width"

30 40
"""


def test_ocamcalib(small: Path) -> None:
    calibration = read(OCAMCALIB)
    rows, columns = (axis.ravel().astype(float) for axis in np.mgrid[0:30:5, 0:40:5])
    # cam2world: x, y and z of OCamCalib are OpenCV's y, x and -z.
    down, across = np.linalg.solve([[1.02, 0.01], [-0.02, 1]], np.stack([rows - 14.75, columns - 19.25]))
    radius = np.hypot(down, across)
    forward = -np.polynomial.Polynomial([-120, 0, 2.5e-3, -1.5e-5, 4e-8])(radius)
    for scale_x, scale_y in ((1, 1), (2, 3)):
        scaled = calibration.scaled(scale_x, scale_y)
        lens = MODELS[scaled.model].build(NUMPY)
        focal = scaled.coefficients["a0"]
        x, y = lens(across / forward, down / forward, *scaled.coefficients.values())
        assert scaled.focal is None
        np.testing.assert_allclose(focal * x + scaled.centre[0], (columns + 0.5) * scale_x - 0.5, atol=1e-9)
        np.testing.assert_allclose(focal * y + scaled.centre[1], (rows + 0.5) * scale_y - 0.5, atol=1e-9)
    camera = camera_of("camera.yml")
    assert camera.distortion is not None
    assert camera.distortion.coefficients == tuple(calibration.coefficients.values())
    assert camera.focal_lengths == (1.02 * 120, 1.02 * 120)


# C3VD's colonoscope as calib_results.txt.
C3VD = """\
#polynomial coefficients
5 -769.243600037458 0 8.12770624150226e-4 -6.25674244578925e-7 1.19662182144280e-9
1 0
542.975887548343 678.544839263292
1 0 0
1080 1350
"""


def test_colonoscope_in_the_documentation(small: Path, root: Path) -> None:
    """The centres of C3VD and of calib_results.txt count from 0."""
    lines = (root / "docs/cameras.md").read_text(encoding="utf-8").splitlines()
    start = next(n for n, line in enumerate(lines) if "C3VD's colonoscope" in line)
    example = yaml.safe_load("\n".join(lines[start : start + 3]))
    calibration = read(C3VD)
    np.testing.assert_allclose([*example["intrinsics"].values()], calibration.centre, atol=1e-6)
    for name in ("a0", "a2", "a3", "a4"):
        assert example["distortion"][name] == pytest.approx(calibration.coefficients[name], rel=1e-6)


# Of the data set, without comments.
EUROC = """\
sensor_type: camera
T_BS:
  cols: 4
  rows: 4
  data: [0, -1, 0, -0.02, 1, 0, 0, -0.06, 0, 0, 1, 0.01, 0, 0, 0, 1]
rate_hz: 20
resolution: [40, 30]
camera_model: pinhole
intrinsics: [61.5, 60.5, 19.25, 14.75] #fu, fv, cu, cv
distortion_model: radial-tangential
distortion_coefficients: [-0.3, 0.1, 0.001, -0.002]
"""
OMNIDIR = f"camera_matrix: {MATRIX.tolist()}\ndistortion_coefficients: {COEFFICIENTS[:4]}\nxi: [[1.25]]\ndim: 40 30\n"
MEI = f"{OMNIDIR}distortion_model: mei\n"


@pytest.mark.parametrize(
    ("text", "model", "first"),
    [(EUROC, "pinhole", []), (OMNIDIR, "omnidir", [1.25]), (MEI, "omnidir", [1.25]), (OMNI_KALIBR, "omnidir", [1.25])],
    ids=["EuRoC", "OpenCV's omnidir", "Mei's model", "Kalibr's omni"],
)
def test_euroc_and_omnidirectional(text: str, model: str, first: list[float], small: Path) -> None:
    calibration = read(text)
    assert (calibration.focal, calibration.centre, calibration.size) == ((61.5, 60.5), (19.25, 14.75), (40, 30))
    assert calibration.model == model
    assert calibration.coefficients == dict(zip(MODELS[model].coefficients, [*first, *COEFFICIENTS[:4]], strict=False))


@pytest.mark.parametrize(
    ("line", "model", "focal", "coefficients"),
    [
        ("PINHOLE 40 30 60 61 19.75 15.25", "pinhole", (60, 61), {}),
        ("RADIAL 40 30 60 19.75 15.25 0.1 0.2", "pinhole", (60, 60), {"k1": 0.1, "k2": 0.2}),
        ("OPENCV 40 30 60 61 19.75 15.25 0.1 0 1e-3 2e-3", "pinhole", (60, 61), {"k1": 0.1, "p1": 1e-3, "p2": 2e-3}),
        ("FULL_OPENCV 40 30 60 61 19.75 15.25 0 0 0 0 0 0 0 0.6", "pinhole", (60, 61), {"k6": 0.6}),
        ("OPENCV_FISHEYE 40 30 60 61 19.75 15.25 0.1 0 0 0.4", "fisheye", (60, 61), {"k1": 0.1, "k4": 0.4}),
        ("RADIAL_FISHEYE 40 30 60 19.75 15.25 0.1 0.2", "fisheye", (60, 60), {"k1": 0.1, "k2": 0.2}),
    ],
)
def test_colmap_cameras(
    line: str, model: str, focal: tuple[float, float], coefficients: dict[str, float], small: Path
) -> None:
    head = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    calibration = read(f"{head}# Number of cameras: 1\n1 {line}\n")
    assert (calibration.model, calibration.focal, calibration.size) == (model, focal, (40, 30))
    # COLMAP's first pixel has its centre at (0.5, 0.5).
    assert calibration.centre == (19.25, 14.75)
    assert {name: value for name, value in calibration.coefficients.items() if value} == coefficients


def test_picture_size_and_scale(small: Path, message: Messages) -> None:
    write_opencv("camera.yml")
    with message.raises(SceneError, "render.camera.calibration: camera.yml", "40 x 30", "80 x 90"):
        camera_of("camera.yml", "render.size=[80, 90]")
    camera = camera_of("camera.yml", "render.size=[80, 90]", "render.camera.scale=true")
    assert camera.intrinsics is not None
    # The left edge is at -0.5 before and after.
    assert camera.intrinsics.model_dump() == {"fx": 123, "fy": 181.5, "cx": 39, "cy": 45.25}
    # Out of range after scaling.
    Path("camera.yml").write_text("K: [1e6, 0, 1e6, 0, 1, 1, 0, 0, 1]\nD: [0, 0, 0, 0]\nimage_size: [1, 1]")
    with message.raises(SceneError, "render.camera.scale: camera.yml"):
        camera_of("camera.yml", "render.camera.scale=true")


K = "K: [61.5, 0, 19.25, 0, 60.5, 14.75, 0, 0, 1]\n"
D = "D: [-0.3, 0.1, 0.001, -0.002, 0.03]\n"
HOMOGENEOUS = "K: [FX, 0, 19.25, 0, 0, 60.5, 14.75, 0, 0, 0, 1, 0, 0, 0, 0, 1]\n"
NORMALISED = "D: [0, 0, 0, 0]\nK: [0.837, 0, 0.5, 0, 1.1, 0.5, 0, 0, 1]\n"


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("a: b: c", id="syntax"),
        pytest.param("- 1", id="list"),
        pytest.param("", id="empty"),
        pytest.param("a: &a [1]\nb: *a", id="alias"),
        pytest.param('<!DOCTYPE a [<!ENTITY b "c">]><a/>', id="entity"),
        pytest.param("K: !sparse-matrix [1]", id="tag"),
        pytest.param("K: " + 400 * "[" + 400 * "]", id="nested"),
        pytest.param(f"{K}{D}x: [{'1,' * 300_000}]", id="many values"),
        pytest.param(f"{K}{D}? [1, 2]\n: 3", id="key that is a list"),
        pytest.param('{"K": [61.5, 0,\n"D": [0.1]}', id="syntax of JSON"),
        pytest.param("<a>\n<b></c></a>", id="syntax of XML"),
        pytest.param('{"K": [61.5, 0, 19.25,\n 0, 60.5', id="truncated JSON"),
        pytest.param('{"K": [61.5, 0, 19.25],\n "distor', id="truncated key of JSON"),
        pytest.param("<opencv_storage>\n<K>\n<data>61.5 0. 19.25</da", id="truncated XML"),
        pytest.param("%YAML:1.0\n---\nK: !!opencv-matrix\n  data: [ 61.5, 0.,\n", id="truncated YAML"),
        pytest.param("f: 3", id="no matrix"),
        pytest.param(K.replace("0, 60.5", "2, 60.5") + D, id="skew matrix"),
        pytest.param(K.replace("61.5", "1e9") + D, id="large number"),
        pytest.param(NORMALISED + "image_size: [40, 30]\n", id="normalised focal length"),
        pytest.param(NORMALISED, id="normalised focal length without size"),
        pytest.param(HOMOGENEOUS.replace("FX", "0.82") + D + "size: [1280, 1024]\n", id="normalised 4 x 4"),
        pytest.param(K + D + "width: 40", id="width alone"),
        pytest.param(K + D + "width: 40\nheight: 30\nimage_size: [80, 60]", id="two sizes"),
        pytest.param(K + "note: 3", id="no distortion"),
        pytest.param(K + "D: [1, 2, 3]", id="three coefficients"),
        pytest.param(K + "D: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0.5, 0, 0]", id="thin prism"),
        pytest.param(K + "D: {rows: 1, cols: 4, dt: d, data: [0.1, 0, 0, 0, 0.02]}", id="rows of other length"),
        pytest.param(K + "D: {rows: 1, cols: 4, dta: [0.1, 0, 0, 0]}", id="matrix without data"),
        pytest.param(K + D + "dist: [-0.31, 0.1, 0.001, -0.002, 0.03]", id="two distortions"),
        pytest.param(K + "dist: [0, 0, 0, 0]\ndist: [1, 0, 0, 0]\n", id="key twice"),
        pytest.param("[StereoLeft]\nfc_x = 3\nfc_x = 4\n", id="key of an ini file twice"),
        pytest.param(K + D + "distortion_model: division", id="unsupported model"),
        pytest.param(K + "D: [1.27, 0, 0, 0, 0]\ndistortion_model: mei", id="omnidirectional without xi"),
        pytest.param(K + D + "distortion_model: none", id="coefficients of no model"),
        pytest.param(K + "D: [0, 0, 0, 0]\nfisheye_model: 1\ndistortion_model: plumb_bob", id="two models"),
        pytest.param(K + D + "fisheye: maybe", id="flag"),
        pytest.param(K + D + "xi: 1.27", id="omnidirectional with k3"),
        pytest.param(K + "D: [0, 0, 0, 0]\nxi: -1", id="coefficient out of range"),
        pytest.param(K + "D: [0, 0, 0, 0]\nfisheye: 1\nxi: 1", id="omnidirectional and fisheye"),
        pytest.param(OMNI_KALIBR.replace("radtan", "equidistant"), id="omnidirectional of Kalibr"),
        pytest.param(OCAMCALIB.replace("-1.2e+02 0.0", "-1.2e+02 1.0"), id="OCamCalib"),
        pytest.param(K + D + "radial_distortion: [0.1]\nrms: 0.2", id="other distortion"),
        pytest.param(MESSAGE.replace("g_x: 0", "g_x: 2"), id="binning of ROS"),
        pytest.param(MESSAGE.replace("width: 0", "width: 20"), id="region of interest of ROS"),
        pytest.param(K.replace("K", "M1") + K.replace("K", "M2") + "D1: 3\nD2: [0, 0, 0, 0]", id="stereo pair"),
        pytest.param(KALIBR.replace("distortion_coeffs: [-0.3, 0.1, 0.001, -0.002]", "x: 1"), id="Kalibr"),
        pytest.param(KALIBR.replace("[61.5", "[1.25, 61.5", 1), id="intrinsics of Kalibr"),
        pytest.param(KALIBR.replace("model: pinhole", "model: ds"), id="model of Kalibr"),
        pytest.param(K + D + "fx: 50\n", id="two focal lengths"),
        pytest.param("; of two\n[StereoLeft]\nfc_x = 3\n", id="StereoMIS"),
        pytest.param("[StereoLeft]\na = 1\n[StereoRight]\nfc_x = 3\n", id="keys of StereoMIS"),
        pytest.param("[Camera]\nfc_x = 3\n", id="ini file"),
        pytest.param("[StereoLeft]\nfc_x = 3 ; of the left camera\n# fc_y\nfc_y\n", id="line of an ini file"),
        pytest.param("# Camera list\n1 FOV 40 30 5e2 5e2 3e2 2e2 0.1\n", id="COLMAP"),
        pytest.param("1 PINHOLE 40 30 5e2 5e2 3e2 2e2\n2 PINHOLE 40 30 6e2 5e2 3e2 2e2\n", id="two of COLMAP"),
        pytest.param("1 PINHOLE 40 30 5e2 5e2 3e2\n", id="parameters of COLMAP"),
    ],
)
def test_invalid_calibration(text: str, small: Path, message: Messages) -> None:
    Path("camera.yml").write_text(text)
    with message.raises(SceneError, "render.camera.calibration: camera.yml"):
        camera_of("camera.yml")


DIGITS = "1" * 5000


@pytest.mark.parametrize(
    "text",
    [
        f"{K}{D}width: 0x{5000 * 'f'}",
        f"{K}{D}0x{5000 * 'f'}: 1",
        f"{K}{D}1:{DIGITS}: 1",
        f'{{"K": {DIGITS}}}',
        f"1 PINHOLE {DIGITS} 30 60 60 20 15",
        KALIBR.replace("[61.5", f"[{DIGITS}"),
    ],
    ids=["hexadecimal", "hexadecimal key", "key", "JSON", "COLMAP", "Kalibr"],
)
def test_numbers_of_thousands_of_digits(text: str, small: Path) -> None:
    with pytest.raises(CameraFileError, match="camera"):
        read(text)


def test_names_of_thousands_of_digits(small: Path) -> None:
    cameras = json.dumps(yaml.safe_load(KALIBR)).replace('"cam1"', f'"cam{DIGITS}"')
    assert read(cameras, "right").focal == (62.5, 61.5)
    assert read(f"{DIGITS} PINHOLE 40 30 60 60 20 15").size == (40, 30)


def test_spellings(small: Path) -> None:
    keys = ("DistCoeff", "distortion_coefs", "dist", "d", "DISTORTION_PARAMETERS", "distortion_vector")
    texts = [f"{K}{key}: [[-0.3, 0.1, 0.001, -0.002, 0.03]]" for key in keys]
    texts += [K.replace("K", key) + D for key in ("mtx", "camera_mtx", "intrinsic_matrix", "cameraMatrix", "M")]
    texts += [HOMOGENEOUS.replace("FX", "61.5") + D]
    # Twice, equal up to rounding.
    texts += [f"{K}{D}mtx: [61.5, 0, 19.25, 0, 60.50000001, 14.75, 0, 0, 1]\ndist: {[COEFFICIENTS]}"]
    for text in texts:
        calibration = read(text)
        assert (calibration.focal, [*calibration.coefficients.values()]) == ((61.5, 60.5), COEFFICIENTS), text
    sizes = ["resolution: [80, 90]", "imageSize: !!python/tuple [80, 90]", "img_width: 80\nimg_height: 90"]
    for text in (*sizes, "image_size: [80, 90]\nw: 80\nh: 90", "DIM: 80 90"):
        assert read(K + D + text).size == (80, 90), text


def test_names_of_lens_models(small: Path) -> None:
    fisheye = [f"{key}: fisheye" for key in ("lens", "type", "projection", "calibration_model", "camera_model")]
    fisheye += ["fisheye: true", "camera_model: pinhole\ndistortion_model: equidistant"]
    pinhole = ["distortion_model: radtan", "xi: 0.0", "skew: 0", "lens: 25 mm\ntype: endoscope"]
    for text in fisheye + pinhole:
        calibration = read(f"{K}D: [0.01, 0.002, 0.0003, -0.0004]\n{text}\n")
        assert calibration.model == ("fisheye" if text in fisheye else "pinhole"), text
    read(K + "distortion_model: none")
    assert camera_of("camera.yml").distortion is None


def test_check_prints_the_calibration(small: Path, capsys: pytest.CaptureFixture[str], message: Messages) -> None:
    Path("pair.yml").write_text(stereo("K", "D", "1", "2"))
    right = "{eye: [0, 0, 0.4], intrinsics: {fx: 20, fy: 15, cx: 19.5, cy: 14.5}}"
    value = f"{{left: {{eye: [0, 0, 0.4], calibration: pair.yml}}, right: {right}}}"
    assert not main(["check", "small.yaml", "--set", f"render.cameras={value}", "--set", "output=[]"])
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("render.")]
    # 20 px on both sides of the centre are 45 degrees at a focal length of 20 px.
    assert "fov 90.0 x 90.0 degrees" in lines[1]
    message(lines, "render.cameras.left: pinhole, 40 x 30 px", "k1 -0.3")


def test_field_of_view_beyond_the_projection(
    small: Path, capsys: pytest.CaptureFixture[str], message: Messages
) -> None:
    # The left and right edges are 104 degrees from the axis, the upper and lower ones 78.
    Path("camera.yml").write_text("K: [11, 0, 19.5, 0, 11, 14.5, 0, 0, 1]\nD: [0, 0, 0, 0]\nfisheye: true\n")
    camera = READ.replace("FILE", "camera.yml, outside: background")
    assert not main(["check", "small.yaml", "--set", camera, "--set", "output=[]"])
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("render.camera")]
    message(lines, "156.3 degrees")


def test_focal_length_in_other_units(small: Path, message: Messages) -> None:
    """The limit is a twentieth of the picture's width or height."""
    camera = {"eye": [0, 0, 0.4], "intrinsics": {"fx": 2, "fy": 1.5, "cx": 20, "cy": 15}}
    load_scene("small.yaml", {"render.camera": camera})
    with message.raises(SceneError, "render.camera.intrinsics: fx = 1.99"):
        load_scene("small.yaml", {"render.camera": camera, "render.camera.intrinsics.fx": 1.99})


def test_calibration_path_is_relative_to_the_scene(small: Path, message: Messages) -> None:
    write_opencv("camera.yml")
    Path("inner").mkdir()
    text = Path("small.yaml").read_text().replace("render: {", "render: {camera: {eye: [0, 0, 1], calibration: PATH}, ")
    text = text.replace("speckle.png", "../speckle.png")
    Path("inner/s.yaml").write_text(text.replace("PATH", "../camera.yml"))
    with message.raises(SceneError, "render.camera.calibration: ../camera.yml"):
        load_scene("inner/s.yaml", image="speckle.png")
    Path("camera.yml").rename("inner/camera.yml")
    Path("inner/s.yaml").write_text(text.replace("PATH", "camera.yml"))
    assert isinstance(load_scene("inner/s.yaml", image="speckle.png").render.camera, Camera)


def test_camera_json(small: Path) -> None:
    camera = {"size": [40, 30], "projection": [[1.0] * 4] * 3, "intrinsics": [[60, 0, 20], [0, 61, 15], [0, 0, 1]]}
    camera |= {"calibration": [[60, 0, 19.5], [0, 61, 14.5], [0, 0, 1]], "model": "omnidir"}
    calibration = read(json.dumps({**camera, "distortion": [1.1, 0.1, 0.0, 0.01, 0.02]}))
    assert (calibration.model, calibration.focal, calibration.size) == ("omnidir", (60, 61), (40, 30))
    assert calibration.centre == (19.5, 14.5)
    assert calibration.coefficients == {"xi": 1.1, "k1": 0.1, "k2": 0.0, "p1": 0.01, "p2": 0.02}
    # A field of view of 175 degrees is allowed, and its focal length is in pixels.
    wide = {"model": "pinhole", "calibration": [[0.87, 0, 19.5], [0, 0.87, 14.5], [0, 0, 1]], "distortion": [0] * 8}
    Path("camera.json").write_text(json.dumps({**camera, **wide}))
    load_scene("small.yaml", {"render.camera": {"eye": [0, 0, 0.1], "calibration": "camera.json"}})


ONE = "KN: [60, 0, 20, 0, 60, 15, 0, 0, 1]\nDN: [0, 0, 0, 0]\n"
PAIR = ONE.replace("N", "1") + ONE.replace("N", "2")


@pytest.mark.parametrize(
    ("eye", "text"),
    [
        ("right", PAIR + "R: [2, 0, 0, 0, 1, 0, 0, 0, 1]\nT: [-0.004, 0, 0]\n"),
        ("right", PAIR + "R: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nT: [-4, 0, 0]\nunits: mm\n"),
        ("left", stereomis().replace("kc_0", "skew = 2\nkc_0", 1)),
    ],
    ids=["not a rotation", "units", "key of StereoMIS"],
)
def test_invalid_stereo_pair(eye: Literal["left", "right"], text: str, small: Path, message: Messages) -> None:
    with message.raises(CameraFileError, "camera.yml"):
        read(text, eye)
