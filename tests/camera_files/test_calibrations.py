"""Calibrations as other programs write them."""

from __future__ import annotations

import json
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal

import cv2
import numpy as np
import pytest

from taichi_msm import load_scene
from taichi_msm.camera_files.calibrations import read_calibration
from taichi_msm.camera_files.text import CameraFileError
from taichi_msm.cli.main import main
from taichi_msm.errors import SceneError
from taichi_msm.lenses import MODELS
from taichi_msm.lenses.model import NUMPY
from taichi_msm.render.camera import view
from taichi_msm.scene.camera import Camera
from tests.golden import Messages

MATRIX = np.array([[61.5, 0, 19.25], [0, 60.5, 14.75], [0, 0, 1]])
COEFFICIENTS = [-0.3, 0.1, 0.001, -0.002, 0.03]
READ = "render.camera={eye: [0, 0, 0.4], calibration: FILE}"


def camera_of(path: str, *more: str) -> Camera:
    found = load_scene("small.yaml", [READ.replace("FILE", path), *more]).render.camera
    assert isinstance(found, Camera)
    return found


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
    path = Path(f"camera.{suffix}")
    write_opencv(str(path))
    if suffix == "yaml":
        path.write_text("# Comments may come before OpenCV's first line.\n\n" + path.read_text())
    camera = camera_of(str(path))
    assert camera.calibration is None, "what is read is kept, not the path"
    assert camera.intrinsics is not None
    assert camera.distortion is not None
    assert camera.intrinsics.model_dump() == {"fx": 61.5, "fy": 60.5, "cx": 19.25, "cy": 14.75}
    assert camera.distortion.coefficients == (-0.3, 0.1, 0.001, -0.002, 0.03, 0, 0, 0)
    # Ours begin half a pixel earlier.
    seen = view(load_scene("small.yaml", [READ.replace("FILE", str(path))]))
    np.testing.assert_array_equal(seen.centre, [19.75, 15.25])


ROS = """\
image_width: 40
image_height: 30
camera_name: narrow_stereo
camera_matrix: {rows: 3, cols: 3, data: [61.5, 0, 19.25, 0, 60.5, 14.75, 0, 0, 1]}
distortion_model: MODEL
distortion_coefficients: {rows: 1, cols: 4, data: [0.01, 0.002, 0.0003, -0.0004]}
rectification_matrix: {rows: 3, cols: 3, data: [1, 0, 0, 0, 1, 0, 0, 0, 1]}
"""


def test_ros_is_read(small: Path) -> None:
    for model, expected in (("plumb_bob", "pinhole"), ("equidistant", "fisheye")):
        Path("ros.yaml").write_text(ROS.replace("MODEL", model))
        camera = camera_of("ros.yaml")
        assert camera.distortion is not None
        assert camera.distortion.model == expected
        assert camera.distortion.coefficients[:4] == (0.01, 0.002, 0.0003, -0.0004)


RIGHT = np.array([[62.5, 0, 20.25], [0, 61.5, 13.75], [0, 0, 1]])
ROTATION = np.array([[1, 0, 0], [0, 0.8, -0.6], [0, 0.6, 0.8]])
TRANSLATION = np.array([-4.25, 0.0625, -0.125])  # [mm]


def stereo(matrix: str, distortion: str, *marks: str) -> str:
    """A file of OpenCV with these names of keys, each with an eye's mark."""
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


# STIRLoader.py of the data set reads these keys; lengths are metres, and there is no size.
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
_SECTION = """\
[Stereo{}]
res_x = 40
res_y = 30
{}
fc_x = {}
fc_y = {}
cc_x = {}
cc_y = {}
"""


def stereomis() -> str:
    """StereoCalibration.ini of the data set."""
    text = "[Version]\nmajor = 1\n"
    for eye, matrix, coefficients in (("Left", MATRIX, COEFFICIENTS), ("Right", RIGHT, [0.25, *4 * [0]])):
        lines = [f"kc_{n} = {value}" for n, value in enumerate([*coefficients, 0, 0, 0])]
        lines += [f"R_{n} = {value}" for n, value in enumerate((ROTATION if eye == "Right" else np.eye(3)).ravel())]
        lines += [f"T_{n} = {value}" for n, value in enumerate(TRANSLATION if eye == "Right" else np.zeros(3))]
        text += _SECTION.format(eye, "\n".join(lines), *matrix[[0, 1], [0, 1]], *matrix[:2, 2])
    return text


def sections() -> str:
    """A file with a section per camera."""
    left = {"K": MATRIX.tolist(), "D": COEFFICIENTS, "size": [40, 30]}
    right = {"K": RIGHT.tolist(), "D": [0.25, 0, 0, 0], "size": [40, 30]}
    return json.dumps({"cam0": left, "cam1": right, "R": ROTATION.tolist(), "T": STIR["translation"]})


@pytest.mark.parametrize(
    ("write", "unit"),
    [
        *(
            pytest.param(partial(stereo, *names), "mm", id=names[0] + names[2])
            for names in (
                *(("K", "D", "1", "2"), ("M", "D", "1", "2"), ("K", "D", "0", "1"), ("mtx", "dist", "L", "R")),
                *(("cameraMatrix", "distCoeffs", "1", "2"), ("camera_matrix", "dist_coeffs", "_left", "_right")),
            )
        ),
        pytest.param(sections, None, id="sections"),
        pytest.param(partial(json.dumps, STIR), None, id="STIR"),
        pytest.param(lambda: KALIBR, None, id="Kalibr"),
        pytest.param(stereomis, None, id="StereoMIS"),
    ],
)
def test_both_cameras_of_a_pair_are_read(write: Callable[[], str], unit: Literal["mm"] | None, small: Path) -> None:
    Path("pair.yml").write_text(write())
    left, right = (read_calibration("pair.yml", eye, unit) for eye in ("left", "right"))
    assert (left.focal, left.centre) == ((61.5, 60.5), (19.25, 14.75))
    assert (right.focal, right.centre) == ((62.5, 61.5), (20.25, 13.75))
    assert [*left.coefficients.values()][:4] == COEFFICIENTS[:4]
    assert [*right.coefficients.values()][:4] == [0.25, 0, 0, 0]
    assert left.size == right.size == (None if write.__class__ is partial and "leftcameramat" in write() else (40, 30))
    assert right.right is not None
    np.testing.assert_array_equal(right.right.rotation, ROTATION)
    np.testing.assert_allclose(right.right.translation, TRANSLATION / 1e3, rtol=1e-15)


def test_a_pair_of_unknown_unit_is_refused(small: Path, message: Messages) -> None:
    Path("pair.yml").write_text(stereo("M", "D", "1", "2"))
    with message.raises(CameraFileError, "pair.yml", "calibration_unit"):
        read_calibration("pair.yml", "right")
    Path("pair.yml").write_text(K + D)
    with message.raises(SceneError, "render.camera.calibration: pair.yml", "calibration_eye"):
        camera_of("pair.yml", "render.camera.calibration_eye=right")


# As OCamCalib writes it, with a mirror's polynomial; x is down, and the axis backward.
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


def test_a_calibration_of_ocamcalib_is_read(small: Path) -> None:
    Path("calib_results.txt").write_text(OCAMCALIB)
    rows, columns = (axis.ravel().astype(float) for axis in np.mgrid[0:30:5, 0:40:5])
    # cam2world: x, y and z of OCamCalib are OpenCV's y, x and -z.
    down, across = np.linalg.solve([[1.02, 0.01], [-0.02, 1]], np.stack([rows - 14.75, columns - 19.25]))
    radius = np.hypot(down, across)
    forward = -np.polynomial.Polynomial([-120, 0, 2.5e-3, -1.5e-5, 4e-8])(radius)
    calibration = read_calibration("calib_results.txt")
    for (scale_x, scale_y), scaled in (((1, 1), calibration), ((2, 3), calibration.scaled(2, 3))):
        lens = MODELS[scaled.model].build(NUMPY)
        focal = scaled.coefficients["a0"]
        x, y = lens(across / forward, down / forward, *scaled.coefficients.values())
        assert scaled.focal is None
        np.testing.assert_allclose(focal * x + scaled.centre[0], (columns + 0.5) * scale_x - 0.5, atol=1e-9)
        np.testing.assert_allclose(focal * y + scaled.centre[1], (rows + 0.5) * scale_y - 0.5, atol=1e-9)
    camera = camera_of("calib_results.txt")
    assert camera.distortion is not None
    assert camera.distortion.coefficients == tuple(calibration.coefficients.values())
    assert camera.focal_lengths == (1.02 * 120, 1.02 * 120)


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


def test_a_sensor_of_euroc_is_read(small: Path) -> None:
    Path("sensor.yaml").write_text(EUROC)
    calibration = read_calibration("sensor.yaml")
    assert (calibration.focal, calibration.centre, calibration.size) == ((61.5, 60.5), (19.25, 14.75), (40, 30))
    assert calibration.coefficients == dict(zip(("k1", "k2", "p1", "p2"), COEFFICIENTS, strict=False))


def test_an_omnidirectional_calibration_is_read(small: Path) -> None:
    storage = cv2.FileStorage("omni.yml", cv2.FILE_STORAGE_WRITE)
    storage.write("camera_matrix", MATRIX)
    storage.write("distortion_coefficients", np.array([COEFFICIENTS[:4]]))
    storage.write("xi", np.array([[1.25]]))
    storage.write("image_size", np.array([[40, 30]]))
    storage.release()
    Path("chain.yml").write_text(OMNI_KALIBR)
    expected = dict(zip(("xi", "k1", "k2", "p1", "p2"), [1.25, *COEFFICIENTS], strict=False))
    for path in ("omni.yml", "chain.yml"):
        calibration = read_calibration(path)
        assert (calibration.model, calibration.coefficients) == ("omnidir", expected)
        assert (calibration.focal, calibration.centre) == ((61.5, 60.5), (19.25, 14.75))


@pytest.mark.parametrize(
    ("line", "model", "focal", "coefficients"),
    [
        ("SIMPLE_PINHOLE 40 30 60 19.75 15.25", "pinhole", (60, 60), {}),
        ("PINHOLE 40 30 60 61 19.75 15.25", "pinhole", (60, 61), {}),
        ("SIMPLE_RADIAL 40 30 60 19.75 15.25 0.1", "pinhole", (60, 60), {"k1": 0.1}),
        ("RADIAL 40 30 60 19.75 15.25 0.1 0.2", "pinhole", (60, 60), {"k1": 0.1, "k2": 0.2}),
        ("OPENCV 40 30 60 61 19.75 15.25 0.1 0 1e-3 2e-3", "pinhole", (60, 61), {"k1": 0.1, "p1": 1e-3, "p2": 2e-3}),
        ("FULL_OPENCV 40 30 60 61 19.75 15.25 0 0 0 0 0 0 0 0.6", "pinhole", (60, 61), {"k6": 0.6}),
        ("OPENCV_FISHEYE 40 30 60 61 19.75 15.25 0.1 0 0 0.4", "fisheye", (60, 61), {"k1": 0.1, "k4": 0.4}),
        ("RADIAL_FISHEYE 40 30 60 19.75 15.25 0.1 0.2", "fisheye", (60, 60), {"k1": 0.1, "k2": 0.2}),
    ],
)
def test_cameras_of_colmap_are_read(
    line: str, model: str, focal: tuple[float, float], coefficients: dict[str, float], small: Path
) -> None:
    head = "# Camera list with one line of data per camera:\n#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[]\n"
    Path("cameras.txt").write_text(f"{head}# Number of cameras: 1\n1 {line}\n")
    calibration = read_calibration("cameras.txt")
    assert (calibration.model, calibration.focal, calibration.size) == (model, focal, (40, 30))
    # COLMAP's first pixel has its centre at (0.5, 0.5).
    assert calibration.centre == (19.25, 14.75)
    assert {name: value for name, value in calibration.coefficients.items() if value} == coefficients


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


def test_pictures_of_another_size_are_refused_or_scaled(small: Path, message: Messages) -> None:
    write_opencv("camera.yml")
    with message.raises(SceneError, "render.camera.calibration: camera.yml", "40 x 30", "80 x 90"):
        camera_of("camera.yml", "render.size=[80, 90]")
    camera = camera_of("camera.yml", "render.size=[80, 90]", "render.camera.scale=true")
    assert camera.intrinsics is not None
    # The left edge is at -0.5 in both.
    assert camera.intrinsics.model_dump() == {"fx": 123, "fy": 181.5, "cx": 39, "cy": 45.25}
    # What scaling makes too large.
    Path("camera.yml").write_text("K: [1e6, 0, 1e6, 0, 1, 1, 0, 0, 1]\nD: [0, 0, 0, 0]\nimage_size: [1, 1]")
    with message.raises(SceneError, "render.camera.scale: camera.yml"):
        camera_of("camera.yml", "render.camera.scale=true")


K = "K: [61.5, 0, 19.25, 0, 60.5, 14.75, 0, 0, 1]\n"
D = "D: [-0.3, 0.1, 0.001, -0.002, 0.03]\n"


@pytest.mark.parametrize(
    "text",
    [
        pytest.param("a: b: c", id="syntax"),
        pytest.param("- 1", id="list"),
        pytest.param("a: &a [1]\nb: *a", id="alias"),
        pytest.param('<!DOCTYPE a [<!ENTITY b "c">]><a/>', id="entity"),
        pytest.param('width: !!int ""', id="tag"),
        pytest.param("K: " + 400 * "[" + 400 * "]", id="nested"),
        pytest.param(f"{K}{D}x: [{'1,' * 300_000}]", id="many values"),
        pytest.param(f"{K}{D}? [1, 2]\n: 3", id="key that is no text"),
        pytest.param("", id="empty"),
        pytest.param("f: 3", id="no matrix"),
        pytest.param("K: [1, 0, 1, 2, 1, 1, 0, 0, 1]", id="skew matrix"),
        pytest.param("K: [1, 0, 1e9, 0, 1, 1, 0, 0, 1]", id="large number"),
        pytest.param(K.replace("60.5", "1e-300") + D, id="no focal length"),
        pytest.param(K + D + "width: 40", id="width alone"),
        pytest.param(K + D + "width: 40\nheight: 30\nimage_size: [80, 60]", id="two sizes"),
        pytest.param(K + "note: 3", id="no distortion"),
        pytest.param(K + "D: [1, 2, 3]", id="three coefficients"),
        pytest.param(K + "D: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0.5, 0, 0]", id="thin prism"),
        pytest.param(K + "D: {rows: 1, cols: 4, dt: d, data: [0.1, 0, 0, 0, 0.02]}", id="rows of other length"),
        pytest.param(K + "D: {rows: 1, cols: 4, dta: [0.1, 0, 0, 0]}", id="no matrix of OpenCV"),
        pytest.param(K + D + "dist: [-0.31, 0.1, 0.001, -0.002, 0.03]", id="two distortions"),
        pytest.param(K + "dist: [0, 0, 0, 0]\ndist: [1, 0, 0, 0]\n", id="key twice"),
        pytest.param(K + "distortion_model: fov", id="unknown model"),
        pytest.param(K + D + "distortion_model: none", id="coefficients of no model"),
        pytest.param(K + "D: [0, 0, 0, 0]\nfisheye_model: 1\ndistortion_model: plumb_bob", id="two models"),
        pytest.param(K + D + "xi: 1.27", id="omnidirectional with k3"),
        pytest.param(K + "D: [0, 0, 0, 0]\nxi: -1", id="coefficient out of range"),
        pytest.param(K + "D: [0, 0, 0, 0]\nmodel: omnidir", id="omnidirectional without xi"),
        pytest.param(K + "D: [0, 0, 0, 0]\nfisheye: 1\nxi: 1", id="omnidirectional and fisheye"),
        pytest.param(OMNI_KALIBR.replace("radtan", "equidistant"), id="omnidirectional of Kalibr"),
        pytest.param(OCAMCALIB.replace("-1.2e+02 0.0", "-1.2e+02 1.0"), id="OCamCalib"),
        pytest.param(K + D + "radial_distortion: [0.1]\nrms: 0.2", id="other distortion"),
        pytest.param(K + D + "image_shape: [30, 40]", id="size of unknown order"),
        pytest.param(PRINTED.replace("g_x: 0", "g_x: 2"), id="binning of ROS"),
        pytest.param(K.replace("K", "M1") + K.replace("K", "M2") + "D1: 3\nD2: [0, 0, 0, 0]", id="stereo pair"),
        pytest.param(KALIBR.replace("distortion_coeffs: [-0.3, 0.1, 0.001, -0.002]", "x: 1"), id="Kalibr"),
        pytest.param(KALIBR.replace("[61.5", "[1.25, 61.5", 1), id="intrinsics of Kalibr"),
        pytest.param("StereoLeft:\nStereoRight:\n", id="StereoMIS without keys"),
        pytest.param("K: [60, 0, 20, 0, 60, 15, 0, 0, 1]\nD: [0, 0, 0, 0]\nfx: 50\n", id="another focal length"),
        pytest.param("; of two\n[StereoLeft]\nfc_x = 3\n", id="StereoMIS"),
        pytest.param("[Camera]\nfc_x = 3\n", id="ini file"),
        pytest.param("# Camera list\n1 FOV 40 30 5e2 5e2 3e2 2e2 0.1\n", id="COLMAP"),
        pytest.param("1 PINHOLE 40 30 5e2 5e2 3e2 2e2\n2 PINHOLE 40 30 6e2 5e2 3e2 2e2\n", id="two of COLMAP"),
        pytest.param("1 PINHOLE 40 30 5e2 5e2 3e2\n", id="parameters of COLMAP"),
    ],
)
def test_what_is_no_calibration_is_refused(text: str, small: Path, message: Messages) -> None:
    Path("camera.yml").write_text(text)
    with message.raises(SceneError, "render.camera.calibration: camera.yml"):
        camera_of("camera.yml")


@pytest.mark.parametrize(
    "text",
    [
        *(
            f"{K}{name}: [[-0.3, 0.1, 0.001, -0.002, 0.03]]"
            for name in ("DistCoeff", "distortion_coefs", "dist", "d", "DISTORTION_PARAMETERS", "distortion_vector")
        ),
        *(K.replace("K", name) + D for name in ("mtx", "camera_mtx", "intrinsic_matrix", "cameraMatrix", "M")),
        # Twice, and the same but for rounding.
        K + D + "mtx: [61.5, 0, 19.25, 0, 60.50000001, 14.75, 0, 0, 1]\ndist: [[-0.3, 0.1, 0.001, -0.002, 0.03]]",
    ],
)
def test_spellings_of_matrix_and_distortion_are_understood(text: str, small: Path) -> None:
    Path("camera.yml").write_text(text)
    camera = camera_of("camera.yml")
    assert camera.intrinsics is not None
    assert camera.intrinsics.fy == 60.5
    assert camera.distortion is not None
    assert camera.distortion.coefficients == (-0.3, 0.1, 0.001, -0.002, 0.03, 0, 0, 0)


@pytest.mark.parametrize(
    "text",
    [
        "image_size: [80, 90]",
        "resolution: [80, 90]",
        "imageSize: !!python/tuple [80, 90]",
        "img_width: 80\nimg_height: 90",
        "w: 80\nh: 90",
        "image_size: [80, 90]\nwidth: 80\nheight: 90",
        "DIM: 80 90",
    ],
)
def test_spellings_of_the_size_are_understood(text: str, small: Path) -> None:
    Path("camera.yml").write_text(K + D + text)
    assert read_calibration("camera.yml").size == (80, 90)


@pytest.mark.parametrize(
    ("text", "fisheye"),
    [
        *((f"{key}: fisheye", True) for key in ("lens", "type", "projection", "calibration_model", "model_name")),
        ("fisheye: true", True),
        ("camera_model: fisheye", True),
        ("camera_model: pinhole\ndistortion_model: equidistant", True),
        ("distortion_model: radtan", False),
        ("camera_model: pinhole", False),
        ("xi: 0.0", False),
        ("skew: 0", False),
        ("lens: 25 mm\ntype: endoscope", False),
    ],
)
def test_models_are_honoured(text: str, fisheye: bool, small: Path) -> None:
    Path("camera.yml").write_text(f"{K}D: [0.01, 0.002, 0.0003, -0.0004]\n{text}\n")
    assert read_calibration("camera.yml").model == ("fisheye" if fisheye else "pinhole")
    Path("camera.yml").write_text(K + "distortion_model: none")
    assert camera_of("camera.yml").distortion is None


def test_check_prints_what_was_read(small: Path, capsys: pytest.CaptureFixture[str], message: Messages) -> None:
    Path("pair.yml").write_text(stereo("K", "D", "1", "2"))
    cameras = "{left: {eye: [0, 0, 0.4], calibration: pair.yml}, right: {eye: [0, 0, 0.4], intrinsics: INTRINSICS}}"
    intrinsics = "{fx: 20, fy: 15, cx: 19.5, cy: 14.5}"
    value = cameras.replace("INTRINSICS", intrinsics)
    assert not main(["check", "small.yaml", "--set", f"render.cameras={value}", "--set", "output=[]"])
    lines = [line for line in capsys.readouterr().out.splitlines() if line.startswith("render.")]
    # 20 px on both sides of the centre are 45 degrees at a focal length of 20 px.
    assert "fov 90.0 x 90.0 degrees" in lines[1]
    message(lines, "render.cameras.left: pinhole, 40 x 30 px", "k1 -0.3")


def test_a_field_of_view_beyond_the_limit_is_that_of_the_lens(small: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The left and right edges are 104 degrees from the axis, the upper and lower ones 78."""
    Path("camera.yml").write_text("K: [11, 0, 19.5, 0, 11, 14.5, 0, 0, 1]\nD: [0, 0, 0, 0]\nfisheye: true\n")
    camera = READ.replace("FILE", "camera.yml, outside: background")
    assert not main(["check", "small.yaml", "--set", camera, "--set", "output=[]"])
    assert "40 x 30 px, fov (limited by the lens) x 156.3 degrees" in capsys.readouterr().out


def test_files_are_in_the_folder_of_the_scene(small: Path, message: Messages) -> None:
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


def test_the_camera_of_a_run_is_read_in_opencvs_pixels(small: Path) -> None:
    camera = {"size": [40, 30], "projection": [[1.0] * 4] * 3, "intrinsics": [[60, 0, 20], [0, 61, 15], [0, 0, 1]]}
    camera |= {"calibration": [[60, 0, 19.5], [0, 61, 14.5], [0, 0, 1]], "model": "omnidir"}
    Path("camera.json").write_text(json.dumps({**camera, "distortion": [1.1, 0.1, 0.0, 0.01, 0.02]}))
    found = read_calibration("camera.json")
    assert (found.model, found.focal, found.centre, found.size) == ("omnidir", (60, 61), (19.5, 14.5), (40, 30))
    assert found.coefficients == {"xi": 1.1, "k1": 0.1, "k2": 0.0, "p1": 0.01, "p2": 0.02}


ONE = "KN: [60, 0, 20, 0, 60, 15, 0, 0, 1]\nDN: [0, 0, 0, 0]\n"
PAIR = ONE.replace("N", "1") + ONE.replace("N", "2")


@pytest.mark.parametrize(
    ("eye", "text"),
    [
        ("right", PAIR + "R: [2, 0, 0, 0, 1, 0, 0, 0, 1]\nT: [-0.004, 0, 0]\n"),
        ("right", PAIR + "R: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nT: [-4, 0, 0]\nunits: mm\n"),
        ("left", stereomis().replace("kc_0", "skew = 2\nkc_0", 1)),
    ],
    ids=["no rotation", "units", "key of StereoMIS"],
)
def test_what_is_no_pair_is_refused(eye: Literal["left", "right"], text: str, small: Path, message: Messages) -> None:
    Path("pair.yml").write_text(text)
    with message.raises(CameraFileError, "pair.yml: "):
        read_calibration("pair.yml", eye)
