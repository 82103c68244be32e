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
from taichi_msm.scene.calibration import read_calibration
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
        pytest.param("K: !!python/object:numpy.ndarray {}", id="tag of an object"),
        pytest.param("K: " + 400 * "[" + 400 * "]", id="nested"),
        pytest.param('{"K": ' + 600 * "[" + "1" + 600 * "]" + "}", id="nested JSON"),
        pytest.param(f"{K}{D}x: [{'1,' * 300_000}]", id="many values"),
        pytest.param(f"{K}{D}? [1, 2]\n: 3", id="key that is no text"),
        pytest.param("", id="empty"),
        pytest.param("f: 3", id="no matrix"),
        pytest.param("K: 3", id="number as matrix"),
        pytest.param("K: [x]", id="text as matrix"),
        pytest.param("K: [1, 0, 1, 2, 1, 1, 0, 0, 1]", id="skew matrix"),
        pytest.param("K: [1, 0, 1e9, 0, 1, 1, 0, 0, 1]", id="large number"),
        pytest.param(f"K: [1{400 * '0'}]", id="huge number"),
        pytest.param(K.replace("60.5", "1e-300") + D, id="no focal length"),
        pytest.param(K + D + "width: 0\nheight: 0", id="no pixels"),
        pytest.param(K + D + "width: 40", id="width alone"),
        pytest.param(K + D + "width: 40\nheight: 30\nimage_size: [80, 60]", id="two sizes"),
        pytest.param(K + "note: 3", id="no distortion"),
        pytest.param(K + "D: [1, 2, 3]", id="three coefficients"),
        pytest.param(K + "D: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0.5, 0, 0]", id="thin prism"),
        pytest.param(K + "D: {rows: 1, cols: 4, dt: d, data: [0.1, 0, 0, 0, 0.02]}", id="rows of other length"),
        pytest.param(K + "D: {rows: 1, cols: 4, dta: [0.1, 0, 0, 0]}", id="no matrix of OpenCV"),
        pytest.param(K + D + "dist: [-0.31, 0.1, 0.001, -0.002, 0.03]", id="two distortions"),
        pytest.param(K + "dist: [0, 0, 0, 0]\ndist: [1, 0, 0, 0]\n", id="key twice"),
        pytest.param('{"dist": [0, 0, 0, 0], "dist": [1, 0, 0, 0]}', id="key twice in JSON"),
        pytest.param("<a><K><data>1</data></K><dist>0</dist><dist>1</dist></a>", id="key twice in XML"),
        pytest.param(K + "distortion_model: fov", id="unknown model"),
        pytest.param(K + D + "camera_model: ds", id="unknown model of the camera"),
        pytest.param(K + D + "distortion_model: none", id="coefficients of no model"),
        pytest.param(K + "D: [0, 0, 0, 0]\nfisheye_model: 1\ndistortion_model: plumb_bob", id="two models"),
        pytest.param(K + D + "xi: 1.27", id="omnidirectional"),
        pytest.param(K + D + "radial_distortion: [0.1]\nrms: 0.2", id="other distortion"),
        pytest.param(K + D + "image_shape: [30, 40]", id="size of unknown order"),
        pytest.param(K + D + "roi: [10, 10, 40, 40]", id="region"),
        pytest.param(K + D + "binning: 2", id="binning"),
        pytest.param(K + D + "undistorted: true", id="undistorted"),
        pytest.param(PRINTED.replace("g_x: 0", "g_x: 2"), id="binning of ROS"),
        pytest.param(PRINTED.replace("x_offset: 0", "x_offset: 4"), id="offset of ROS"),
        pytest.param(PRINTED.replace("width: 0", "width: 20"), id="width of ROS"),
        pytest.param(
            "M1: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nD1: 3\nM2: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nD2: 3", id="stereo pair"
        ),
        pytest.param("cam0: {camera_model: pinhole, intrinsics: [1, 1, 1, 1]}", id="Kalibr"),
        pytest.param("; of two\n[StereoLeft]\nfc_x = 3\n", id="ini file"),
        pytest.param("# Camera list\n1 PINHOLE 640 480 5e2 5e2 3e2 2e2\n", id="COLMAP"),
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
            for name in (
                *("dist_coeff", "DistCoeff", "distortion_coeffs", "distortion_coeff", "distortion_coefs", "dist", "d"),
                *("dist_coefs", "distCoeffs", "distortion", "DISTORTION_PARAMETERS", "dist-coefficients"),
                "distortion_vector",
            )
        ),
        *(
            K.replace("K", name) + D
            for name in ("mtx", "camera_mtx", "intrinsic_matrix", "cameraMatrix", "M", "intrinsics")
        ),
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
    assert read_calibration("camera.yml").fisheye == fisheye
    Path("camera.yml").write_text(K + "distortion_model: none")
    assert camera_of("camera.yml").distortion is None


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


EUROC = """\
#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],v_RS_R_x [m s^-1]
0,0.0,0.0,0.4,0,1,0,0,7
200000000,0.1,0.0,0.4,0,1,0,0,7
400000000,0.1,0.0,0.5,0,0.6,0.8,0,7
"""


TABLE = TUM.replace("# timestamp tx ty tz qx qy qz qw", "time,x,y,z,qx,qy,qz,qw").replace(" ", ",")
MILLISECONDS = """\
# format: qw qx qy qz tx ty tz timestamp(ms)
0 1 0 0 0 0 0.4 0
0 1 0 0 0.1 0 0.4 200
0 0.6 0.8 0 0.1 0 0.5 400
"""


@pytest.mark.parametrize(
    "text",
    [EUROC, MILLISECONDS, TABLE, TABLE.replace(",", ";").replace(".", ",").replace("time", '"t"')],
    ids=["EuRoC", "milliseconds", "table", "table of a spreadsheet"],
)
def test_a_header_decides_on_the_columns(text: str, small: Path) -> None:
    Path("tum.txt").write_text(TUM)
    Path("poses.txt").write_text(text)
    expected = load_scene("small.yaml", ["render.camera={poses: tum.txt}"])
    assert load_scene("small.yaml", ["render.camera={poses: poses.txt}"]) == expected


HEADER = "# timestamp tx ty tz qx qy qz qw"


@pytest.mark.parametrize(
    ("text", "place"),
    [
        pytest.param(TUM.replace("0.4 0.1", "0.2 0.1"), "poses.txt:4", id="not sorted"),
        pytest.param(TUM.replace("0.6 0.8", "0.6 0.9"), "poses.txt:4", id="no rotation"),
        pytest.param(TUM.replace("0.6 0.8", "0.6"), "poses.txt:4", id="seven numbers"),
        pytest.param(TUM.partition("\n")[2].replace(" ", ","), "poses.txt:1", id="commas without a header"),
        pytest.param(TUM.replace("qx qy qz qw", "w x y z"), "poses.txt:1", id="unknown columns"),
        pytest.param(EUROC.replace("x [m]", "x [mm]"), "poses.txt:1", id="unknown units"),
        pytest.param("1 0 0 0 0 1 0 0 0 0 1 0\n", "poses.txt:1", id="KITTI"),
        pytest.param("# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n", "poses.txt:1", id="COLMAP"),
        pytest.param("# nothing\n", "poses.txt", id="no poses"),
        pytest.param(TUM.replace("0.2 0.1", "2e8 0.1").replace("0.4 0.1", "4e8 0.1"), "", id="nanoseconds"),
        pytest.param(TUM.replace("0.0 0.0 0.0 0.4", "0.0 0.0 0.0 0.0"), "", id="eye on the sheet"),
        pytest.param(TUM.replace("0.0 0.0 0.0", "0.1 0.0 0.0"), "", id="late"),
        pytest.param(TUM.replace("0.4 0.1", "0.3 0.1"), "", id="short"),
        pytest.param(f"{TUM}# t tx ty tz qw qx qy qz\n", "poses.txt:5", id="other columns than before"),
        *(
            pytest.param(TUM.replace(HEADER, f"# {comment}"), "poses.txt:1", id=comment)
            for comment in ("t, position, quaternion (w, x, y, z)", "time, pos xyz, quat wxyz", "t x y z q0 q1 q2 q3")
        ),
        *(
            pytest.param(TUM.replace(HEADER, f"# {comment}"), "poses.txt:1", id=comment)
            for comment in ("quaternion, scalar first", "world to camera", "T_cw")
        ),
    ],
)
def test_a_trajectory_that_cannot_be_used_is_refused(text: str, place: str, small: Path, message: Messages) -> None:
    Path("poses.txt").write_text(text)
    with message.raises(SceneError, f"render.camera.poses: {place}"):
        load_scene("small.yaml", ["render.camera={poses: poses.txt}"])
