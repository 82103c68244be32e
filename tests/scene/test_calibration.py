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

MATRIX = np.array([[61.5, 0, 19.25], [0, 60.5, 14.75], [0, 0, 1]])
COEFFICIENTS = [-0.3, 0.1, 0.001, -0.002, 0.03]
NO_LIST = "is not a list of numbers up to 1e+06; write it as OpenCV does"
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


def test_numbers_that_scaling_makes_too_large_are_refused(small: Path) -> None:
    Path("camera.yml").write_text("K: [1e6, 0, 1e6, 0, 1, 1, 0, 0, 1]\nD: [0, 0, 0, 0]\nimage_size: [1, 1]")
    assert refused("camera.yml", "render.camera.scale=true") == (
        "scale=true: render.camera.scale: camera.yml: fx = 4e+07, fy = 30, cx = 4e+07, cy = 44.5 for pictures of this "
        "size are out of range; calibrate at a size near it"
    )


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("a: b: c", "camera.yml:1: neither YAML, XML nor JSON; name a calibration"),
        ("- 1", "camera.yml: has a list; expected camera_matrix and distortion_coefficients as keys"),
        ("a: &a [1]\nb: *a", "camera.yml: neither YAML, XML nor JSON; name a calibration"),
        ('<!DOCTYPE a [<!ENTITY b "c">]><a/>', "camera.yml: neither YAML, XML nor JSON; name a calibration"),
        ("K: 3", "camera.yml: its camera matrix is not [fx, 0, cx, 0, fy, cy, 0, 0, 1]; write it like that"),
        (
            "K: [1, 0, 1, 0, 1, 1, 0, 0, 1]\nwidth: 0\nheight: 0",
            "camera.yml: of pictures of 0 x 0 pixels; write the size of those that were calibrated with",
        ),
        (
            "K: [1, 0, 1e9, 0, 1, 1, 0, 0, 1]",
            f"camera.yml: K: [1, 0, '1e9', 0, 1, 1, 0, 0, 1] {NO_LIST}",
        ),
        (
            "f: 3",
            "camera.yml: has no camera matrix that is known; found f; write camera_matrix: [fx, 0, cx, 0, fy, cy, 0, "
            "0, 1], distortion_coefficients: [k1, k2, p1, p2]",
        ),
        ("", "camera.yml: has no keys; expected camera_matrix and distortion_coefficients as keys"),
        ('width: !!int ""', "camera.yml: neither YAML, XML nor JSON; name a calibration"),
        (
            f"K: [1{400 * '0'}]",
            f"camera.yml: K: [1{58 * '0'}... is not a list of numbers up to 1e+06; write it as OpenCV does",
        ),
        (
            "K: [1, 0, 1, 2, 1, 1, 0, 0, 1]",
            "camera.yml: its camera matrix is not [fx, 0, cx, 0, fy, cy, 0, 0, 1]; write it like that",
        ),
        (
            "K: [1, 0, 1, 0, 1, 1, 0, 0, 1]\nwidth: 40",
            "camera.yml: has only one of image_width and image_height; found K, width; write both",
        ),
        ("K: [x]", "camera.yml: K: ['x'] is not a list of numbers up to 1e+06; write it as OpenCV does"),
        (
            "K: [1, 0, 1, 0, 1, 1, 0, 0, 1]\nD: [1, 2, 3]",
            "camera.yml: 3 distortion coefficients; expected 4, 5, 8, 12 or 14: k1, k2, p1, p2, k3, ...",
        ),
        (
            "K: [1, 0, 1, 0, 1, 1, 0, 0, 1]\nD: [0, 0, 0, 0, 0, 0, 0, 0, 0, 0.5, 0, 0]",
            "camera.yml: distortion coefficient 10 is not 0; thin prisms and tilted sensors are not modelled, "
            "calibrate without",
        ),
        (
            "K: [1, 0, 1, 0, 1, 1, 0, 0, 1]\nD: {rows: 1, cols: 4, dt: d, data: [0.1, 0, 0, 0, 0.02]}",
            "camera.yml: D: has 5 numbers, and 1 rows of 4; write what belongs there",
        ),
        (
            "K: [1, 0, 1, 0, 1, 1, 0, 0, 1]\nD: {rows: 1, cols: 4, dta: [0.1, 0, 0, 0]}",
            "camera.yml: D: has rows, cols, dta; expected a matrix with rows, cols and data",
        ),
        (
            "K: [1, 0, 1, 0, 1, 1, 0, 0, 1]\ndistortion_model: fov",
            "camera.yml: distortion_model: fov is not known; expected one of: plumb_bob, radtan, rational_polynomial, "
            "equidistant, fisheye, or none without coefficients",
        ),
    ],
)
def test_what_is_no_calibration_is_refused(text: str, said: str, small: Path) -> None:
    Path("camera.yml").write_text(text)
    assert refused("camera.yml") == f"calibration: {said}"


K = "K: [61.5, 0, 19.25, 0, 60.5, 14.75, 0, 0, 1]\n"
D = "D: [-0.3, 0.1, 0.001, -0.002, 0.03]\n"


@pytest.mark.parametrize(
    "name",
    [
        "dist_coeff", "DistCoeff", "distortion_coeffs", "distortion_coeff", "distortion_coefs", "dist", "dist_coefs",
        "distCoeffs", "distortion", "DISTORTION_PARAMETERS", "dist-coefficients", "distortion_vector", "d",
    ],
)  # fmt: skip
def test_spellings_of_distortion_are_understood(name: str, small: Path) -> None:
    Path("camera.yml").write_text(K + f"{name}: [[-0.3, 0.1, 0.001, -0.002, 0.03]]\n")
    camera = camera_of("camera.yml")
    assert camera.distortion is not None
    assert camera.distortion.coefficients == (-0.3, 0.1, 0.001, -0.002, 0.03, 0, 0, 0)


@pytest.mark.parametrize("name", ["mtx", "camera_mtx", "intrinsic_matrix", "cameraMatrix", "M", "intrinsics"])
def test_spellings_of_the_matrix_are_understood(name: str, small: Path) -> None:
    Path("camera.yml").write_text(K.replace("K", name) + D)
    camera = camera_of("camera.yml")
    assert camera.intrinsics is not None
    assert camera.intrinsics.fy == 60.5


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
    assert "of pictures of 80 x 90 pixels, not of 40 x 30" in refused("camera.yml")


def test_models_are_honoured(small: Path) -> None:
    four = "D: [0.01, 0.002, 0.0003, -0.0004]\n"
    for text in ("camera_model: fisheye", "camera_model: pinhole\ndistortion_model: equidistant", "fisheye: true"):
        Path("camera.yml").write_text(K + four + text)
        camera = camera_of("camera.yml")
        assert camera.distortion is not None
        assert camera.distortion.model == "fisheye"
    for text in ("distortion_model: radtan", "camera_model: pinhole", "xi: 0.0", "skew: 0"):
        Path("camera.yml").write_text(K + four + text)
        camera = camera_of("camera.yml")
        assert camera.distortion is not None
        assert camera.distortion.model == "pinhole"
    Path("camera.yml").write_text(K + "distortion_model: none")
    assert camera_of("camera.yml").distortion is None


def test_values_spelled_twice_agree(small: Path) -> None:
    Path("camera.yml").write_text(
        K + D + "mtx: [61.5, 0, 19.25, 0, 60.50000001, 14.75, 0, 0, 1]\ndist: [[-0.3, 0.1, 0.001, -0.002, 0.03]]"
    )
    assert camera_of("camera.yml").intrinsics is not None
    Path("camera.yml").write_text(K + D + "dist: [-0.31, 0.1, 0.001, -0.002, 0.03]")
    assert refused("camera.yml") == "calibration: camera.yml: D and dist are not the same; keep the right one"


REST = "write camera_matrix: [fx, 0, cx, 0, fy, cy, 0, 0, 1], distortion_coefficients: [k1, k2, p1, p2]"


@pytest.mark.parametrize(
    ("text", "said"),
    [
        (
            K + "note: 3",
            "has a camera matrix, and no distortion that is known; found K, note; write distortion_coefficients, "
            "[0, 0, 0, 0] where there is none",
        ),
        (
            K + D + "radial_distortion: [0.1]\nrms: 0.2",
            "radial_distortion: not understood, and may change what the camera sees; found K, D, radial_distortion, "
            f"rms; {REST}, or remove what does not matter",
        ),
        (
            K + D + "image_shape: [30, 40]",
            "image_shape: not understood, and may change what the camera sees; found K, D, image_shape; "
            f"{REST}, or remove what does not matter",
        ),
        (
            K + D + "xi: 1.27",
            "xi: of OpenCV's omnidirectional model, which is not read; calibrate with cv2.fisheye",
        ),
        (
            K + D + "camera_model: ds",
            "camera_model: ds is not known; expected one of: plumb_bob, radtan, rational_polynomial, equidistant, "
            "fisheye, or none without coefficients",
        ),
        (
            K + D + "distortion_model: none",
            "distortion_model: none is not known; expected one of: plumb_bob, radtan, rational_polynomial, "
            "equidistant, fisheye, or none without coefficients",
        ),
        (
            K + "D: [0, 0, 0, 0]\nfisheye_model: 1\ndistortion_model: plumb_bob",
            "fisheye_model is a fisheye's, distortion_model is not; keep the right one",
        ),
        (
            K + D + "width: 40\nheight: 30\nimage_size: [80, 60]",
            "its size is [40, 30] and [80, 60]; write one [width, height] of the pictures",
        ),
        (
            K.replace("60.5", "1e-300") + D,
            "its focal length is 1e-300; write it in pixels, 0.001 or more",
        ),
        (
            "M1: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nD1: 3\nM2: [1, 0, 0, 0, 1, 0, 0, 0, 1]\nD2: 3",
            "of a stereo pair, as OpenCV's stereoCalibrate and SCARED, which is not read; found M1, D1, M2, D2; "
            f"{REST}",
        ),
        (
            "cam0: {camera_model: pinhole, intrinsics: [1, 1, 1, 1], distortion_coeffs: [0, 0, 0, 0]}",
            f"a camchain of Kalibr, which is not read; found cam0; {REST}",
        ),
        ("; of two\n[StereoLeft]\nfc_x = 3\n", f"an ini file, which is not read; {REST}, in YAML"),
        (
            "# Camera list\n1 PINHOLE 640 480 5e2 5e2 3e2 2e2\n",
            f"a cameras.txt of COLMAP, which is not read; {REST}, in YAML",
        ),
        ("K: " + 400 * "[" + 400 * "]", None),
        ('{"K": ' + 600 * "[" + "1" + 600 * "]" + "}", f"K: {60 * '['}... {NO_LIST}"),
        ("K: !!python/object:numpy.ndarray {}", None),
    ],
)  # fmt: skip
def test_what_bears_on_the_camera_and_is_not_understood_is_refused(text: str, said: str | None, small: Path) -> None:
    Path("camera.yml").write_text(text)
    found = refused("camera.yml")
    if said is None:
        assert ("neither YAML" in found) or ("not plain YAML" in found)
    else:
        assert found == f"calibration: camera.yml: {said}"


def test_comments_may_precede_opencvs_first_line(small: Path) -> None:
    write_opencv("camera.yml")
    Path("camera.yml").write_text("# of the left camera\n\n" + Path("camera.yml").read_text())
    assert camera_of("camera.yml").distortion is not None


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


EUROC = """\
#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],v_RS_R_x [m s^-1]
0,0.0,0.0,0.4,0,1,0,0,7
200000000,0.1,0.0,0.4,0,1,0,0,7
400000000,0.1,0.0,0.5,0,0.6,0.8,0,7
"""


@pytest.mark.parametrize(
    "text",
    [
        EUROC,
        "".join(
            f"{line}\n"
            for line in [
                "# format: qw qx qy qz tx ty tz timestamp(ms)",
                "0 1 0 0 0 0 0.4 0",
                "0 1 0 0 0.1 0 0.4 200",
                "0 0.6 0.8 0 0.1 0 0.5 400",
            ]
        ),
        TUM.replace("# timestamp tx ty tz qx qy qz qw", "time,x,y,z,qx,qy,qz,qw").replace(" ", ","),
    ],
)
def test_a_header_decides_on_the_columns(text: str, small: Path) -> None:
    Path("tum.txt").write_text(TUM)
    Path("poses.txt").write_text(text)
    expected = load_scene("small.yaml", ["render.camera={poses: tum.txt}"])
    assert load_scene("small.yaml", ["render.camera={poses: poses.txt}"]) == expected


@pytest.mark.parametrize("separator", [";", ","])
def test_tables_of_spreadsheets_are_read(separator: str, small: Path) -> None:
    decimal = "," if separator == ";" else "."
    rows = TUM.partition("\n")[2].replace(".", decimal).replace(" ", separator)
    Path("tum.txt").write_text(TUM)
    Path("poses.txt").write_text(
        separator.join(f'"{name}"' for name in ("t", "x", "y", "z", "qx", "qy", "qz", "qw")) + "\n" + rows
    )
    expected = load_scene("small.yaml", ["render.camera={poses: tum.txt}"])
    assert load_scene("small.yaml", ["render.camera={poses: poses.txt}"]) == expected


@pytest.mark.parametrize(
    "comment",
    [
        *("t, position, quaternion (w, x, y, z)", "time, pos xyz, quat wxyz", "t x y z q0 q1 q2 q3"),
        *("quaternion, scalar first", "world to camera", "T_cw"),
    ],
)
def test_a_comment_on_another_order_is_refused(comment: str, small: Path) -> None:
    Path("poses.txt").write_text(TUM.replace("# timestamp tx ty tz qx qy qz qw", f"# {comment}"))
    with pytest.raises(SceneError, match=r"poses\.txt:1: a comment has .*, which is not understood; name the columns"):
        load_scene("small.yaml", ["render.camera={poses: poses.txt}"])


def test_columns_stay_as_they_are(small: Path) -> None:
    Path("poses.txt").write_text(f"{TUM}# t tx ty tz qw qx qy qz\n")
    with pytest.raises(SceneError, match=r"poses\.txt:5: other columns than before"):
        load_scene("small.yaml", ["render.camera={poses: poses.txt}"])


@pytest.mark.parametrize("key", ["lens", "type", "projection", "calibration_model", "model_name", "fisheye"])
def test_any_key_may_name_the_lens(key: str, small: Path) -> None:
    Path("camera.yml").write_text(f"{K}D: [0.1, 0, 0, 0]\n{key}: {'true' if key == 'fisheye' else 'fisheye'}\n")
    assert read_calibration("camera.yml").fisheye


def test_the_name_of_a_device_is_no_lens(small: Path) -> None:
    Path("camera.yml").write_text(f"{K}D: [0.1, 0, 0, 0]\nlens: 25 mm\ntype: endoscope\n")
    assert not read_calibration("camera.yml").fisheye


@pytest.mark.parametrize(
    "text",
    [
        "dist: [0, 0, 0, 0]\ndist: [1, 0, 0, 0]\n" + K,
        '{"dist": [0, 0, 0, 0], "dist": [1, 0, 0, 0], "K": [1, 0, 0, 0, 1, 0, 0, 0, 1]}',
        "<a><K><data>1 0 0 0 1 0 0 0 1</data></K><dist>0</dist><dist>1</dist></a>",
    ],
)
def test_a_key_given_twice_is_refused(text: str, small: Path) -> None:
    Path("camera.yml").write_text(text)
    assert refused("camera.yml") == "calibration: camera.yml: dist is given twice; keep the right one"


@pytest.mark.parametrize("line", ["roi: [10, 10, 40, 40]", "binning: 2", "scale: 0.5", "undistorted: true", "crop: 1"])
def test_pictures_that_were_changed_are_refused(line: str, small: Path) -> None:
    Path("camera.yml").write_text(f"{K}D: [0.1, 0, 0, 0]\n{line}\n")
    assert f"{line.partition(':')[0]}: not understood, and may change what the camera sees" in refused("camera.yml")


@pytest.mark.parametrize("line", [f"x: [{'1,' * 300_000}]", "? [1, 2]\n: 3"])
def test_many_values_and_keys_that_are_no_text_are_refused(line: str, small: Path) -> None:
    Path("camera.yml").write_text(f"{K}D: [0.1, 0, 0, 0]\n{line}\n")
    assert "neither YAML, XML nor JSON" in refused("camera.yml")


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
        (
            TUM.partition("\n")[2].replace(" ", ","),
            "poses.txt:1: commas without a header, and w comes first in EuRoC's rows, last in TUM's; name the columns "
            "in a first line: # t, tx, ty, tz, qx, qy, qz, qw",
        ),
        (
            TUM.replace("qx qy qz qw", "w x y z"),
            "poses.txt:1: columns timestamp, tx, ty, tz, w, x, y, z are not understood; name them t, tx, ty, tz, qx, "
            "qy, qz, qw",
        ),
        (
            EUROC.replace("x [m]", "x [mm]"),
            "poses.txt:1: timestamp [ns], p_rs_r_x [mm], p_rs_r_y [m], p_rs_r_z [m]: units that are not understood; "
            "write [s], [ms], [us] or [ns] for t, and metres, [m], for the others",
        ),
        (
            "1 0 0 0 0 1 0 0 0 0 1 0\n",
            "poses.txt:1: not a pose, but twelve numbers, as KITTI's, which are not read; expected eight numbers up to "
            "1e+30: t tx ty tz qx qy qz qw",
        ),
        (
            "# IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME\n",
            "poses.txt:1: an images.txt of COLMAP, which is not read; write lines t tx ty tz qx qy qz qw",
        ),
        (
            TUM.replace("0.2 0.1", "2e8 0.1").replace("0.4 0.1", "4e8 0.1"),
            "its first poses are 2e+08 s apart, and the scene lasts 0.4 s; write times in seconds, nanoseconds divided "
            "by 1e9, or name the columns in a header, with t [ns]",
        ),
        (
            TUM.replace("0.0 0.0 0.0 0.4", "0.0 0.0 0.0 0.0"),
            "puts the eye on the middle of the sheet, which the light's strength depends on; move it away",
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
