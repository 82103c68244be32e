"""Camera files of further programs: projections against the formula of each program, and the lines of the page."""

from __future__ import annotations

import json
import re
import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from taichi_msm import load_scene
from taichi_msm.arithmetic import NUMPY
from taichi_msm.camera_files.calibration import Calibration
from taichi_msm.camera_files.readers import (
    CALIBRATION_READERS,
    TRAJECTORY_READERS,
    PoseKeys,
    read_calibration,
    read_pair_pose,
    read_poses,
)
from taichi_msm.cli.main import main
from taichi_msm.errors import SceneError
from taichi_msm.lenses import MODELS
from taichi_msm.scene.camera import Camera
from tests.camera_files.test_calibrations import C3VD as OCAMCALIB
from tests.camera_files.test_calibrations import EUROC, KALIBR, D, K, stereomis
from tests.camera_files.test_trajectories import COLMAP, KITTI, TUM
from tests.camera_files.test_trajectories import EUROC as EUROC_POSES
from tests.golden import Messages

# Points in the axes of a camera, and rays x / z, y / z to them.
POINTS = np.random.default_rng(0).uniform((-0.3, -0.2, 0.8), (0.3, 0.2, 1.2), (20, 3))
X, Y = (POINTS[:, :2] / POINTS[:, 2:]).T
RADIUS2 = X**2 + Y**2


def pixels(calibration: Calibration, points: NDArray[np.float64] = POINTS) -> NDArray[np.float64]:
    """Project points by the program's camera [px], the first pixel centre at (0, 0), shape (N, 2)."""
    model = MODELS[calibration.model]
    coefficients = [calibration.coefficients.get(name, 0.0) for name in model.coefficients]
    x, y = model.build(NUMPY)(points[:, 0] / points[:, 2], points[:, 1] / points[:, 2], *coefficients)
    assert calibration.focal is not None
    return np.stack([x, y], axis=1) * calibration.focal + calibration.centre


def opencv(points: NDArray[np.float64], matrix: Any, coefficients: Any) -> NDArray[np.float64]:
    return np.asarray(
        cv2.projectPoints(points, np.zeros(3), np.zeros(3), np.array(matrix), np.array(coefficients))[0][:, 0]
    )


def polynomial(*radial: float) -> NDArray[np.float64]:
    """Return 1 + k1 r^2 + k2 r^4 + ..."""
    return np.asarray(1 + sum(k * RADIUS2**n for n, k in enumerate(radial, 1)))


def write(name: str, content: str | bytes) -> str:
    Path(name).write_bytes(content if isinstance(content, bytes) else content.encode())
    return name


def homogeneous(rotation: Any, translation: Any) -> NDArray[np.float64]:
    return np.vstack([np.column_stack([rotation, translation]), [0, 0, 0, 1]])


def agree(found: NDArray[np.float64], expected: Any) -> None:
    """Compare pixels: both are some thirty operations in f64 on numbers up to 1e4."""
    np.testing.assert_allclose(found, expected, rtol=0, atol=1e-9)


def colmap_cameras(*cameras: tuple[int, int, int, int, tuple[float, ...]]) -> bytes:
    """Return cameras.bin of number, model, width, height and parameters."""
    records = [struct.pack(f"<IiQQ{len(last)}d", *values, *last) for *values, last in cameras]
    return struct.pack("<Q", len(cameras)) + b"".join(records)


def colmap_images(text: str) -> bytes:
    """Return images.bin of images.txt, with two points a picture."""
    images = [line.split() for line in text.splitlines() if re.match(r"\d+ .* \d+ \S+\.jp2$", line)]
    points = struct.pack("<Qddqddq", 2, 20, 15, -1, 12.5, 7, 3)
    records = [
        struct.pack("<I7dI", int(words[0]), *map(float, words[1:8]), int(words[8])) + words[9].encode() + b"\0" + points
        for words in images
    ]
    return struct.pack("<Q", len(images)) + b"".join(records)


RADIAL = (1, 3, 40, 30, (60.0, 19.75, 15.25, -0.1, 0.02))
FISHEYE = (2, 5, 40, 30, (60.0, 61.0, 19.75, 15.25, 0.1, 0.02, 0.003, 0.004))


def test_colmap_binary(small: Path, message: Messages) -> None:
    write("cameras.bin", colmap_cameras(RADIAL))
    expected = np.stack([X, Y], axis=1) * (60 * polynomial(-0.1, 0.02))[:, np.newaxis] + (19.75, 15.25)
    agree(pixels(read_calibration("cameras.bin")), expected - 0.5)
    # One of several, and two that are equal.
    write("cameras.bin", colmap_cameras(RADIAL, FISHEYE))
    assert read_calibration("cameras.bin", camera=2).model == "fisheye"
    write("cameras.bin", colmap_cameras(RADIAL, (3, *RADIAL[1:])))
    assert read_calibration("cameras.bin").focal == (60, 60)


def test_colmap_binary_images(small: Path) -> None:
    write("images.txt", COLMAP)
    write("images.bin", colmap_images(COLMAP))
    keys = PoseKeys(poses_rate=5)
    assert read_poses("images.bin", keys) == read_poses("images.txt", keys)


TRANSFORMS: dict[str, Any] = {
    **{"fl_x": 60.0, "fl_y": 61.0, "cx": 19.75, "cy": 15.25, "w": 40, "h": 30, "camera_model": "OPENCV"},
    **{"k1": -0.1, "k2": 0.02, "k3": 0.003, "p1": 0.001, "p2": -0.002, "aabb_scale": 4},
}
MATRIX = [[60.0, 0, 19.25], [0, 61.0, 14.75], [0, 0, 1]]
# Camera to world, in OpenGL's axes: the second camera is turned about its optical axis, and out of order.
TURN = Rotation.from_euler("z", 30, degrees=True).as_matrix()
FRAMES = [
    {"file_path": f"images/frame_{n:05}.jpg", "transform_matrix": homogeneous(turn, (x, 0, 0.4)).tolist()}
    for n, turn, x in ((3, TURN, 0.02), (1, np.eye(3), 0.0), (2, np.eye(3), 0.01))
]


@pytest.mark.parametrize("name", ["shared", "by frame"])
def test_nerfstudio(name: str, small: Path) -> None:
    frames = [frame | (TRANSFORMS if name == "by frame" else {}) for frame in FRAMES]
    write("transforms.json", json.dumps({"frames": frames, **(TRANSFORMS if name == "shared" else {})}))
    calibration = read_calibration("transforms.json")
    assert calibration.size == (40, 30)
    # nerfstudio's rays go through x + 0.5, y + 0.5.
    agree(pixels(calibration), opencv(POINTS, MATRIX, [-0.1, 0.02, 0.001, -0.002, 0.003]))


def test_nerfstudio_fisheye_and_field_of_view(small: Path) -> None:
    fisheye = TRANSFORMS | {"camera_model": "OPENCV_FISHEYE", "k4": 0.004, "p1": 0, "p2": 0}
    write("transforms.json", json.dumps(fisheye))
    expected = cv2.fisheye.projectPoints(
        POINTS[np.newaxis], np.zeros(3), np.zeros(3), np.array(MATRIX), np.array([-0.1, 0.02, 0.003, 0.004])
    )[0][0]
    agree(pixels(read_calibration("transforms.json")), expected)
    # The edges of the picture, -0.5 and 39.5, are half the angle from the axis; pixels are square.
    write("transforms.json", json.dumps({"camera_angle_x": 0.7, "frames": FRAMES}))
    calibration = read_calibration("transforms.json", picture_size=(40, 30))
    edges = np.array([[-np.tan(0.35), 0, 1], [np.tan(0.35), 0, 1], [0, 0.5, 1]])
    agree(pixels(calibration, edges), [[-0.5, 14.5], [39.5, 14.5], [19.5, 14.5 + 0.5 * 20 / np.tan(0.35)]])
    camera = load_scene(
        "small.yaml", {"render.camera": {"calibration": "transforms.json", "eye": [0, 0, 1]}}
    ).render.camera
    assert isinstance(camera, Camera)
    assert camera.focal_lengths == calibration.focal


def test_nerfstudio_poses(small: Path) -> None:
    write("transforms.json", json.dumps({"frames": FRAMES}))
    rows = np.array(read_poses("transforms.json", PoseKeys(poses_rate=2)).rows)
    np.testing.assert_array_equal(rows[:, :4], [[0, 0, 0, 0.4], [0.5, 0.01, 0, 0.4], [1, 0.02, 0, 0.4]])
    # OpenCV's axes are x right, y down, z forward: OpenGL's x, -y and -z.
    axes = Rotation.from_quat(rows[2, 4:]).as_matrix()
    np.testing.assert_allclose(axes, TURN * (1, -1, -1), rtol=0, atol=1e-15)


SCARED: dict[str, Any] = {
    "camera-pose": [[1, 0, 0, 5.0], [0, -1, 0, 2.0], [0, 0, -1, 90.0], [0, 0, 0, 1]],
    "camera-calibration": {
        "KL": [[1035.3, 0, 597.0], [0, 1035.1, 520.4], [0, 0, 1]],
        "KR": [[1035.2, 0, 689.4], [0, 1035.0, 521.0], [0, 0, 1]],
        "DL": [[-0.0006, 0.0013, 0.0003, -0.0008, 0.0]],
        "DR": [[0.0005, -0.0021, 0.0002, -0.0008, 0.0]],
        "R": np.eye(3).tolist(),
        "T": [-4.14, -0.0236, -0.0039],
    },
    "timestamp": 0,
}


def test_scared(small: Path) -> None:
    """Lengths are in millimetres, also those of endoscope_calibration.yaml."""
    data = SCARED["camera-calibration"]
    endoscope = {"M1": data["KL"], "D1": data["DL"], "M2": data["KR"], "D2": data["DR"], "R": data["R"], "T": data["T"]}
    for path in (
        write("frame_data000000.json", json.dumps(SCARED)),
        write("endoscope_calibration.yaml", yaml.safe_dump(endoscope)),
    ):
        left, right = read_calibration(path), read_calibration(path, "right")
        agree(pixels(left), opencv(POINTS, data["KL"], data["DL"]))
        agree(pixels(right), opencv(POINTS, data["KR"], data["DR"]))
        assert right.right is not None
        np.testing.assert_allclose(right.right.translation, np.array(data["T"]) / 1e3, rtol=1e-15)


def test_scared_pose(small: Path) -> None:
    """The matrix transforms points of the keyframe to the camera; one pose without a time stands still."""
    write("frame_data000000.json", json.dumps(SCARED))
    camera = load_scene("small.yaml", {"render.camera": {"poses": "frame_data000000.json"}}).render.camera
    assert isinstance(camera, Camera)
    assert not camera.moves
    assert camera.pose is not None
    matrix = np.array(SCARED["camera-pose"])
    np.testing.assert_allclose(camera.pose.rotation, matrix[:3, :3], atol=1e-15)
    np.testing.assert_allclose(camera.pose.translation, matrix[:3, 3] / 1e3, atol=1e-15)


ADJUSTED = """\
<resolution width="400" height="300"/><f>610</f><cx>3.25</cx><cy>-2.5</cy><k1>-0.04</k1><k2>0.02</k2><k3>-0.09</k3>
<p1>-0.0013</p1><p2>0.0008</p2><b1>1.5</b1>"""
SENSOR = """\
<sensor id="0" label="camera" type="frame"><resolution width="400" height="300"/>
<calibration type="frame" class="adjusted">{}</calibration>
<calibration type="frame" class="initial"><resolution width="400" height="300"/><f>999</f></calibration></sensor>"""
DOCUMENT = '<?xml version="1.0" encoding="UTF-8"?>\n<document><chunk><sensors>{}</sensors></chunk></document>\n'
METASHAPE = DOCUMENT.format(SENSOR.format(ADJUSTED))
LENS = ADJUSTED.replace(
    '<resolution width="400" height="300"/>', "<projection>frame</projection><width>400</width><height>300</height>"
)


@pytest.mark.parametrize("text", [METASHAPE, f"<calibration>{LENS}</calibration>"], ids=["cameras", "lens"])
def test_metashape(text: str, small: Path) -> None:
    write("cameras.xml", text)
    radial = polynomial(-0.04, 0.02, -0.09)
    # The formulas of its manual, from the corner of the picture.
    x = X * radial - 0.0013 * (RADIUS2 + 2 * X**2) + 2 * 0.0008 * X * Y
    y = Y * radial + 0.0008 * (RADIUS2 + 2 * Y**2) - 2 * 0.0013 * X * Y
    u, v = 200 + 3.25 + x * 610 + x * 1.5, 150 - 2.5 + y * 610
    agree(pixels(read_calibration("cameras.xml")), np.stack([u, v], axis=1) - 0.5)


def test_metashape_sensors(small: Path) -> None:
    second = SENSOR.format(ADJUSTED.replace("610", "700")).replace('id="0"', 'id="1"')
    write("cameras.xml", DOCUMENT.format(SENSOR.format(ADJUSTED) + second))
    assert read_calibration("cameras.xml", camera=1).focal == (701.5, 700)


MIDDLEBURY = """\
cam0=[1758.23 0 953.34; 0 1758.23 552.29; 0 0 1]
cam1=[1758.23 0 963.59; 0 1758.23 552.29; 0 0 1]
doffs=10.25
baseline=111.53
width=1920
height=1080
ndisp=290
isint=0
vmin=75
"""


def test_middlebury(small: Path) -> None:
    write("calib.txt", MIDDLEBURY)
    left, right = read_calibration("calib.txt"), read_calibration("calib.txt", "right")
    assert left.size == (1920, 1080)
    assert right.right is not None
    disparity = pixels(left) - pixels(right, POINTS @ np.array(right.right.rotation).T + right.right.translation)
    # Z = baseline f / (d + doffs), in metres.
    agree(disparity, np.stack([0.11153 * 1758.23 / POINTS[:, 2] - 10.25, np.zeros(len(POINTS))], axis=1))


ZED = """\
[LEFT_CAM_2K]
fx=1059.35
fy=1058.96
cx=1110.06
cy=649.94
k1=-0.0393
k2=0.0088
k3=-0.0047

[LEFT_CAM_HD]
fx=529.67
fy=529.48
cx=639.03
cy=361.47
k1=-0.0393
k2=0.0088
p1=0.0002
p2=0.0001
k3=-0.0047
k4=0.001

[RIGHT_CAM_HD]
fx=530.1
fy=529.9
cx=641.5
cy=358.2
k1=-0.041
k2=0.0099
p1=0.0003
p2=-0.0001
k3=-0.005

[STEREO]
Baseline=119.905
TY=0.0459
TZ=-0.4679
TZ_HD=-0.5
CV_HD=0.00698
RX_HD=0.0024
RZ_HD=-0.0021
CV_2K=0.1

[MISC]
Sensor_ID=0
"""


def test_zed(small: Path) -> None:
    write("SN1234.conf", ZED)
    left, right = (read_calibration("SN1234.conf", camera=f"{side}_CAM_HD") for side in ("LEFT", "RIGHT"))
    assert left.size == (1280, 720)
    matrix = [[529.67, 0, 639.03], [0, 529.48, 361.47], [0, 0, 1]]
    agree(pixels(left), opencv(POINTS, matrix, [-0.0393, 0.0088, 0.0002, 0.0001, -0.0047, 0.001, 0, 0]))
    # As the rectification of Stereolabs: Rodrigues of (RX, CV, RZ), and (-Baseline, TY, TZ) in millimetres.
    vector, shift = np.array([0.0024, 0.00698, -0.0021]), np.array([-119.905, 0.0459, -0.5]) / 1e3
    matrix = [[530.1, 0, 641.5], [0, 529.9, 358.2], [0, 0, 1]]
    coefficients = np.array([-0.041, 0.0099, 0.0003, -0.0001, -0.005])
    expected = cv2.projectPoints(POINTS, vector, shift, np.array(matrix), coefficients)[0][:, 0]
    assert right.right is not None
    agree(pixels(right, POINTS @ np.array(right.right.rotation).T + right.right.translation), expected)


DSO_TAIL = "400 300\ncrop\n320 240\n"
DSO: dict[str, tuple[str, Any]] = {
    "RadTan": ("RadTan 610 608 198.5 151.25 -0.2 0.05 0.001 -0.002\n", (610, 608, 198.5, 151.25)),
    "eight numbers": ("610 608 198.5 151.25 -0.2 0.05 0.001 -0.002\n", (610, 608, 198.5, 151.25)),
    "relative": ("RadTan 1.525 2.05 0.5 0.51 -0.2 0.05 0.001 -0.002\n", (610, 615, 199.5, 152.5)),
    "Pinhole": ("Pinhole 610 608 198.5 151.25 0\n", (610, 608, 198.5, 151.25)),
    "five numbers": ("1.525 2.05 0.5 0.51 0\n", (610, 615, 199.5, 152.5)),
    "EquiDistant": ("EquiDistant 610 608 198.5 151.25 -0.02 0.005 0.001 -0.0002\n", (610, 608, 198.5, 151.25)),
}


@pytest.mark.parametrize("name", DSO)
def test_dso(name: str, small: Path) -> None:
    line, (fx, fy, cx, cy) = DSO[name]
    write("camera.txt", line + DSO_TAIL)
    x, y = X, Y
    if "-0.2" in line:  # RadTan, as in its source.
        radial = -0.2 * RADIUS2 + 0.05 * RADIUS2**2
        x = X + X * radial + 2 * 0.001 * X * Y - 0.002 * (RADIUS2 + 2 * X**2)
        y = Y + Y * radial - 2 * 0.002 * X * Y + 0.001 * (RADIUS2 + 2 * Y**2)
    elif "-0.02" in line:
        theta = np.arctan(np.sqrt(RADIUS2))
        scale = (theta - 0.02 * theta**3 + 0.005 * theta**5 + 0.001 * theta**7 - 0.0002 * theta**9) / np.sqrt(RADIUS2)
        x, y = X * scale, Y * scale
    calibration = read_calibration("camera.txt")
    assert calibration.size == (400, 300)
    agree(pixels(calibration), np.stack([fx * x + cx, fy * y + cy], axis=1))


BODY = [0, -1, 0, -0.02, 1, 0, 0, 0.04, 0, 0, 1, 0.01, 0, 0, 0, 1]
EUROC_RIGHT = re.sub(r"data: \[0.*\]", f"data: {BODY}", EUROC).replace("61.5", "62.5")


def test_pair_of_euroc(small: Path) -> None:
    """X_1 = inv(T_BS1) T_BS0 X_0."""
    tilt = Rotation.from_euler("xyz", [1, -2, 3], degrees=True).as_matrix()
    second = homogeneous(tilt, (-0.02, 0.05, 0.008))
    write("cam0.yaml", EUROC)
    write("cam1.yaml", re.sub(r"data: \[0.*\]", f"data: {second.ravel().tolist()}", EUROC))
    pose = read_pair_pose("cam0.yaml", "cam1.yaml")
    assert pose is not None
    first = np.array([0, -1, 0, -0.02, 1, 0, 0, -0.06, 0, 0, 1, 0.01, 0, 0, 0, 1]).reshape(4, 4)
    expected = np.linalg.inv(second) @ first
    np.testing.assert_allclose(np.column_stack([pose.rotation, pose.translation]), expected[:3], atol=1e-15)


def ros(matrix: Any, rectification: Any, projection: Any) -> str:
    return yaml.safe_dump(
        {
            **{"image_width": 40, "image_height": 30, "distortion_model": "plumb_bob"},
            "camera_matrix": {"rows": 3, "cols": 3, "data": np.ravel(matrix).tolist()},
            "distortion_coefficients": {"rows": 1, "cols": 5, "data": [0.0] * 5},
            "rectification_matrix": {"rows": 3, "cols": 3, "data": np.ravel(rectification).tolist()},
            "projection_matrix": {"rows": 3, "cols": 4, "data": np.ravel(projection).tolist()},
        }
    )


def ros_pair(shift: tuple[float, float, float]) -> tuple[str, str, NDArray[np.float64]]:
    """Return the files of a pair, as rectified by OpenCV, and its rotation."""
    matrix, rotation = np.array(MATRIX), Rotation.from_euler("xyz", [0.5, -2, 1], degrees=True).as_matrix()
    left, right, left_projection, right_projection, *_ = cv2.stereoRectify(
        matrix, np.zeros(5), matrix, np.zeros(5), (40, 30), rotation, np.array(shift)[:, np.newaxis]
    )
    return ros(matrix, left, left_projection), ros(matrix, right, right_projection), rotation


def test_pair_of_files_with_a_rotation(small: Path) -> None:
    """The keys of the camera count before the files."""
    write("cam0.yaml", EUROC)
    write("cam1.yaml", EUROC_RIGHT)
    pose = {"rotation": np.eye(3).tolist(), "translation": [-0.01, 0, 0]}
    cameras = {
        "left": {"calibration": "cam0.yaml", **EYE},
        "right": {"beside": "left", "calibration": "cam1.yaml", **pose},
    }
    right = load_scene("small.yaml", {"render.cameras": cameras}).render.all_cameras["right"]
    assert isinstance(right, Camera)
    assert right.translation == (-0.01, 0, 0)


def test_pair_of_ros(small: Path) -> None:
    """The rectified matrices P and R determine R and T of stereoCalibrate."""
    shift = (-0.0054, 0.0003, -0.0002)
    left, right, rotation = ros_pair(shift)
    pose = read_pair_pose(write("left.yaml", left), write("right.yaml", right))
    assert pose is not None
    np.testing.assert_allclose(pose.rotation, rotation, atol=1e-12)
    np.testing.assert_allclose(pose.translation, shift, atol=1e-12)


def test_c3vd_poses(small: Path) -> None:
    """Sixteen numbers are the transpose of the matrix from the camera to the world, in millimetres."""
    matrices = [homogeneous(TURN, (1.5 + n, 2.5, 90)) for n in range(3)]
    write("pose.txt", "".join(",".join(map(str, matrix.T.ravel().tolist())) + "\n" for matrix in matrices))
    rows = np.array(read_poses("pose.txt", PoseKeys(poses_rate=30)).rows)
    np.testing.assert_allclose(rows[:, 0], np.arange(3) / 30)
    np.testing.assert_allclose(rows[:, 1:4], [[0.0015, 0.0025, 0.09], [0.0025, 0.0025, 0.09], [0.0035, 0.0025, 0.09]])
    np.testing.assert_allclose(Rotation.from_quat(rows[:, 4:]).as_matrix(), [TURN] * 3, atol=1e-15)
    # The key counts before the unit of the format.
    assert read_poses("pose.txt", PoseKeys(poses_rate=30, poses_unit="m")).rows[0][1] == 1.5


def test_simcol_poses(small: Path) -> None:
    """As in read_poses.py of the data set: S P S with S = diag(1, -1, 1, 1) between the worlds."""
    rotations = Rotation.random(3, random_state=0)
    positions = np.array([[1.0, 2, 3], [1.5, 2, 3], [2, 2, 3.5]])  # [cm]
    np.savetxt("SavedPosition_S1.txt", positions)
    np.savetxt("SavedRotationQuaternion_S1.txt", rotations.as_quat())
    rows = np.array(read_poses("SavedPosition_S1.txt", PoseKeys(poses_rate=30)).rows)
    mirror = np.diag([1, -1, 1])
    np.testing.assert_allclose(rows[:, 1:4], positions @ mirror / 100, rtol=1e-15)
    np.testing.assert_allclose(
        Rotation.from_quat(rows[:, 4:]).as_matrix(), mirror @ rotations.as_matrix() @ mirror, atol=1e-12
    )


def test_time_twice(small: Path, capsys: pytest.CaptureFixture[str], message: Messages) -> None:
    lines = TUM.splitlines(keepends=True)
    write("twice.txt", "".join([*lines[:3], lines[2].replace("0.1", "0.3"), *lines[3:]]))
    write("once.txt", TUM)
    assert read_poses("twice.txt").rows == read_poses("once.txt").rows
    assert not main(["check", "small.yaml", "--set", "render.camera={poses: twice.txt}", "--set", "output=[]"])
    message([line for line in capsys.readouterr().out.splitlines() if "twice.txt" in line], "0.2 s (line 4)")


def stereo() -> str:
    values: dict[str, Any] = {"K1": MATRIX, "K2": MATRIX, "D1": [0.1, 0, 0, 0], "D2": [0.1, 0, 0, 0]}
    return json.dumps({**values, "R": np.eye(3).tolist(), "T": [-0.004, 0, 0], "image_size": [40, 30]})


CAMERA_JSON = {
    **{"size": [40, 30], "projection": [[1.0] * 4] * 3, "model": "pinhole", "distortion": [0] * 8},
    "calibration": [[60, 0, 19.5], [0, 61, 14.5], [0, 0, 1]],
}
# Files that the lines of the page name.
FILES: dict[str, str | bytes] = {
    "cameras.bin": colmap_cameras(RADIAL),
    "cameras.txt": "1 PINHOLE 40 30 60 61 19.75 15.25\n",
    "calib_results.txt": OCAMCALIB,
    "camera.txt": "Pinhole 60 61 19.5 14.5 0\n40 30\nnone\n40 30\n",
    "calib.txt": MIDDLEBURY,
    "cameras.xml": METASHAPE,
    "SN1234.conf": ZED,
    "StereoCalibration.ini": stereomis(),
    "camchain.yaml": KALIBR,
    "sensor.yaml": EUROC,
    "camera.json": json.dumps(CAMERA_JSON),
    "transforms.json": json.dumps({**TRANSFORMS, "frames": FRAMES}),
    "frame_data000000.json": json.dumps(SCARED),
    "endoscope_calibration.yaml": yaml.safe_dump(SCARED["camera-calibration"]),
    "stereo.yaml": stereo(),
    "camera.yaml": K + D,
    "cam0.yaml": EUROC,
    "cam1.yaml": EUROC_RIGHT,
    "images.bin": colmap_images(COLMAP),
    "images.txt": COLMAP,
    "SavedPosition_S1.txt": "0 0 40\n" * 100,
    "SavedRotationQuaternion_S1.txt": "1 0 0 0\n" * 100,
    "00.txt": KITTI + KITTI.splitlines()[0] + "\n" + KITTI * 3,
    "pose.txt": "1,0,0,0,0,-1,0,0,0,0,-1,0,1.5,2.5,400,1\n" * 100,
    "groundtruth.txt": TUM,
    "data.csv": EUROC_POSES,
}


def page_lines(root: Path) -> list[tuple[str, dict[str, Any]]]:
    """Return program and keys of every line of the page's tables."""
    text = (root / "docs/cameras.md").read_text(encoding="utf-8")
    rows = re.findall(r"^\| ([^|]+) \| [^|]+ \| (`(?:calibration|poses): [^|]+) \|$", text, flags=re.MULTILINE)
    return [(name, yaml.safe_load(f"{{{keys}}}")) for name, cell in rows for keys in re.findall("`([^`]+)`", cell)]


def test_lines_of_the_page(small: Path, root: Path) -> None:
    """Every line reads a file of its program."""
    for name, content in FILES.items():
        write(name, content)
    lines = page_lines(root)
    programs = {*(reader.name for reader in CALIBRATION_READERS), *(reader.name for reader in TRAJECTORY_READERS)}
    assert {name for name, _ in lines} == programs
    for name, keys in lines:
        lens = {"eye": [0, 0, 0.4], "outside": "background"} if "calibration" in keys else {}
        overrides: dict[str, Any] = {"time.duration": 0.05, "time.frames_per_second": 20}
        if "calibration" in keys:
            calibration = read_calibration(keys["calibration"], camera=keys.get("camera"))
            overrides["render.size"] = calibration.size or (40, 30)
        scene = load_scene("small.yaml", {"render.camera": keys | lens, **overrides})
        assert isinstance(scene.render.camera, Camera), name


def test_pairs_of_the_page(small: Path, root: Path) -> None:
    for name, content in FILES.items():
        write(name, content)
    text = (root / "docs/cameras.md").read_text(encoding="utf-8")
    blocks = re.findall(r"    cameras:\n(?:      \w+: \{calibration.*\n)+", text)
    assert len(blocks) == 3
    for block in blocks:
        size = [1280, 720] if "SN1234" in block else [40, 30]
        cameras = yaml.safe_load(block)["cameras"]
        right = load_scene("small.yaml", {"render.cameras": cameras, "render.size": size}).render.all_cameras["right"]
        assert isinstance(right, Camera)
        assert right.translation is not None
        assert 0.003 < np.linalg.norm(right.translation) < 0.15


def transforms(**changed: Any) -> str:
    return json.dumps({**TRANSFORMS, **changed})


EYE = {"eye": [0, 0, 0.4]}
# Content of a file, its name, and keys of the camera.
REFUSED: dict[str, tuple[str | bytes, str, dict[str, Any]]] = {
    "truncated cameras.bin": (colmap_cameras(RADIAL)[:-8], "cameras.bin", {}),
    "other model in cameras.bin": (colmap_cameras((1, 77, 40, 30, ())), "cameras.bin", {}),
    "images.bin as calibration": (colmap_images(COLMAP), "images.bin", {}),
    "DSO, size": (f"Pinhole 60 61 19.5 14.5 0\n{'4' * 5000} 30\nnone\n", "camera.txt", {}),
    "two in cameras.bin": (colmap_cameras(RADIAL, FISHEYE), "cameras.bin", {}),
    "no such camera": (colmap_cameras(RADIAL, FISHEYE), "cameras.bin", {"camera": 7}),
    "camera of a file without names": (stereo(), "stereo.yaml", {"camera": "left"}),
    "camera and eye": (ZED, "SN.conf", {"camera": "LEFT_CAM_HD", "calibration_eye": "right"}),
    "sections of ZED": (ZED, "SN.conf", {}),
    "prism of ZED": (ZED.replace("k4=0.001", "s1=0.001"), "SN.conf", {"camera": "LEFT_CAM_HD"}),
    "nerfstudio without a focal length": (json.dumps({"frames": FRAMES}), "transforms.json", {}),
    "nerfstudio, angle": (json.dumps({"camera_angle_x": 0, "w": 40, "h": 30}), "transforms.json", {}),
    "nerfstudio, two focal lengths": (transforms(camera_angle_x=0.7), "transforms.json", {}),
    "nerfstudio, k4": (transforms(k4=0.1), "transforms.json", {}),
    "nerfstudio, other model": (transforms(camera_model="EQUIRECTANGULAR"), "transforms.json", {}),
    "nerfstudio, two cameras": (
        json.dumps({"frames": [frame | TRANSFORMS | {"k1": n} for n, frame in enumerate(FRAMES)]}),
        "transforms.json",
        {},
    ),
    "Metashape, k4": (METASHAPE.replace("<b1>1.5</b1>", "<k4>0.1</k4>"), "cameras.xml", {}),
    "Metashape, fisheye": (METASHAPE.replace('type="frame"><res', 'type="fisheye"><res'), "cameras.xml", {}),
    "Metashape, key twice": (METASHAPE.replace("<b1>", "<k1>0</k1><b1>"), "cameras.xml", {}),
    "Middlebury, key twice": (MIDDLEBURY + "doffs=1\n", "calib.txt", {}),
    "Middlebury, doffs": (MIDDLEBURY.replace("10.25", "0"), "calib.txt", {}),
    "DSO, FOV": ("0.5 0.6 0.49 0.5 0.9\n40 30\ncrop\n40 30\n", "camera.txt", {}),
    "DSO, other model": ("Omni 60 61 19.5 14.5 0 1 2\n40 30\nnone\n40 30\n", "camera.txt", {}),
    "DSO, not numbers": ("Pinhole 60 61 19.5 14.5 a\n40 30\nnone\n40 30\n", "camera.txt", {}),
    "4 x 4 matrix with other rows": ("K: [60, 0, 1, 2, 0, 60, 1, 2, 0, 0, 1, 0, 0, 0, 0, 1]\n" + D, "camera.yaml", {}),
}


@pytest.mark.parametrize("name", REFUSED)
def test_refused_calibrations(name: str, small: Path, message: Messages) -> None:
    content, path, keys = REFUSED[name]
    write(path, content)
    with message.raises(SceneError, "render.camera.calibration"):
        load_scene("small.yaml", {"render.camera": {"calibration": path, **EYE, **keys}})


def test_field_of_view_without_size(small: Path, message: Messages) -> None:
    write("transforms.json", json.dumps({"camera_angle_x": 0.7}))
    with message.raises(Exception, "transforms.json"):
        read_calibration("transforms.json")


ROWS = "1 0 0 0 0 1 0 0 0 0 1 0.4 0 0 0 1\n"
REFUSED_POSES: dict[str, tuple[str | bytes, str]] = {
    "4 x 4 matrices by rows": (ROWS, "poses.txt"),
    "4 x 4 matrices by rows with commas": (ROWS.replace(" ", ","), "poses.txt"),
    "4 x 4 matrix in lines": ("1 0 0 0\n0 1 0 0\n0 0 1 0.4\n0 0 0 1\n", "poses.txt"),
    "not a number in images.bin": (
        colmap_images("5 0 -1 0 0 0 nan 0.4 1 00100.jp2"),
        "images.bin",
    ),
    "truncated images.bin": (colmap_images(COLMAP)[:-1], "images.bin"),
    "name in images.bin": (struct.pack("<QI7dI4s", 1, 1, *[0.0] * 7, 1, b"name"), "images.bin"),
    "JSON": (transforms(), "transforms.json"),
    "nerfstudio, pose": (json.dumps({"frames": [{"transform_matrix": [[1, 0], [0, 1]]}]}), "transforms.json"),
    "SCARED, pose": (json.dumps({"camera-pose": [1, 2]}), "frame_data000000.json"),
    "SimCol3D, other length": ("0 0 1\n0 0 2\n", "SavedPosition_S1.txt"),
    "SimCol3D, four numbers": ("0 0 1 1\n", "SavedPosition_S1.txt"),
}


@pytest.mark.parametrize("name", REFUSED_POSES)
def test_refused_trajectories(name: str, small: Path, message: Messages) -> None:
    content, path = REFUSED_POSES[name]
    write("SavedRotationQuaternion_S1.txt", "0 0 0 1\n")
    write(path, content)
    with message.raises(SceneError, "render.camera.poses"):
        load_scene("small.yaml", {"render.camera": {"poses": path, "poses_rate": 5}})


NO_POSE = "distortion_model: none\nimage_size: [40, 30]\nK: [60, 0, 19.5, 0, 60, 14.5, 0, 0, 1]\n"
LEFT, RIGHT_ROS, _ = ros_pair((-5.4, 0.3, -0.2))
# Files of the left and the right camera, and keys of the right one.
PAIRS: dict[str, tuple[str, str, dict[str, Any]]] = {
    "two files of one camera": (NO_POSE, NO_POSE, {}),
    "two kinds of files": (EUROC, LEFT, {}),
    "left file twice": (EUROC, EUROC, {}),
    "one file of a pair": (stereo(), stereo(), {}),
    "millimetres": (LEFT, RIGHT_ROS, {}),
    "not a rotation": (EUROC, EUROC_RIGHT.replace("[0, -1, 0,", "[0, -2, 0,"), {}),
    "metres in SCARED's file": ("", "", {"calibration_eye": "right"}),
    "ZED": ("", ZED.replace("2K", "VGA"), {"camera": "LEFT_CAM_HD", "scale": True}),
}


@pytest.mark.parametrize("name", PAIRS)
def test_refused_pairs(name: str, small: Path, message: Messages) -> None:
    left, right, keys = PAIRS[name]
    metres = {**SCARED["camera-calibration"], "T": [-0.00414, 0, 0]}
    write("left.yaml", left or NO_POSE)
    path = write("right.yaml" if right else "endoscope_calibration.yaml", right or yaml.safe_dump(metres))
    cameras = {"left": {"calibration": "left.yaml", **EYE}, "right": {"beside": "left", "calibration": path, **keys}}
    with message.raises(SceneError, "render.cameras.right.calibration"):
        load_scene("small.yaml", {"render.cameras": cameras})
