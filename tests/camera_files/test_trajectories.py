"""Trajectory files of other programs."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest

from taichi_msm import load_scene
from taichi_msm.camera_files.readers import PoseKeys, read_poses
from taichi_msm.errors import SceneError
from taichi_msm.render.camera import view
from taichi_msm.scene.camera import Camera
from tests.golden import Messages

TUM = """\
# timestamp tx ty tz qx qy qz qw
0.0 0.0 0.0 0.4 1 0 0 0
0.2 0.1 0.0 0.4 1 0 0 0
0.4 0.1 0.0 0.5 0.6 0.8 0 0
"""


def test_poses_of_a_trajectory(small: Path) -> None:
    Path("poses.txt").write_text(TUM)
    scene = load_scene("small.yaml", ["render.camera={poses: poses.txt}"])
    # Looking down: half a turn about x.
    np.testing.assert_allclose(view(scene, 0.1).eye, [0.05, 0, 0.4])
    np.testing.assert_allclose(view(scene, 0.1).axes, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(view(scene, 0.3).eye, [0.1, 0, 0.45])
    # From (1, 0, 0, 0) to (0.6, 0.8, 0, 0) is a turn about z by twice the angle whose cosine is 0.6; half of it.
    angle = np.arccos(0.6)
    np.testing.assert_allclose(view(scene, 0.3).axes[0], [np.cos(angle), np.sin(angle), 0], atol=1e-12)
    np.testing.assert_allclose(view(scene, 0.3).axes[2], [0, 0, 1], atol=1e-12)


EUROC = """\
#timestamp [ns],p_RS_R_x [m],p_RS_R_y [m],p_RS_R_z [m],q_RS_w [],q_RS_x [],q_RS_y [],q_RS_z [],v_RS_R_x [m s^-1]
0,0.0,0.0,0.4,0,1,0,0,7
200000000,0.1,0.0,0.4,0,1,0,0,7
400000000,0.1,0.0,0.5,0,0.6,0.8,0,7
"""


# Nanoseconds since 1970, as in TUM-VI.
SINCE_1970 = re.sub(r"\n(\d+),", lambda match: f"\n{1520530308000000000 + int(match[1])},", EUROC)
TABLE = TUM.replace("# timestamp tx ty tz qx qy qz qw", "time,x,y,z,qx,qy,qz,qw").replace(" ", ",")
MILLISECONDS = """\
# format: qw qx qy qz tx ty tz timestamp(ms)
0 1 0 0 0 0 0.4 0
0 1 0 0 0.1 0 0.4 200
0 0.6 0.8 0 0.1 0 0.5 400
"""


SUFFIXES = """\
t_ms,x_mm,y_mm,z_mm,qx,qy,qz,qw
0,0,0,400,1,0,0,0
200,100,0,400,1,0,0,0
400,100,0,500,0.6,0.8,0,0
"""


@pytest.mark.parametrize(
    "text",
    [EUROC, MILLISECONDS, SUFFIXES, TABLE, TABLE.replace(",", ";").replace(".", ",").replace("time", '"t"')],
    ids=["EuRoC", "milliseconds", "suffixes", "table", "table of a spreadsheet"],
)
def test_columns_of_the_header(text: str, small: Path) -> None:
    Path("tum.txt").write_text(TUM)
    Path("poses.txt").write_text(text)
    expected = load_scene("small.yaml", ["render.camera={poses: tum.txt}"])
    assert load_scene("small.yaml", ["render.camera={poses: poses.txt}"]) == expected


# The poses of TUM: two turns of the camera to the world, (1, 0, 0, 0) and (0.6, 0.8, 0, 0).
HALF_TURN, TURN = "1 0 0 {} 0 -1 0 {} 0 0 -1 {}\n", "-0.28 0.96 0 {} 0.96 0.28 0 {} 0 0 -1 {}\n"
KITTI = HALF_TURN.format(0, 0, 0.4) + HALF_TURN.format(0.1, 0, 0.4) + TURN.format(0.1, 0, 0.5)
# From the world to the camera, of every second picture of a video, in the order of their registration.
COLMAP = """\
# Image list with two lines of data per image:
#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME
#   POINTS2D[] as (X, Y, POINT3D_ID)
# Number of images: 3, mean observations per image: 1
7 0 -0.6 -0.8 0 0.028 -0.096 0.5 1 frames/00104.jp2
20 15 -1 12.5 7 3
5 0 -1 0 0 0 0 0.4 1 frames/00100.jp2

6 0 -1 0 0 -0.1 0 0.4 1 frames/00102.jp2
20 15 -1
"""


@pytest.mark.parametrize("text", [KITTI, COLMAP, COLMAP.replace("/0010", "/x")], ids=["KITTI", "COLMAP", "names"])
def test_poses_rate(text: str, small: Path) -> None:
    Path("poses.txt").write_text(text)
    rows = read_poses("poses.txt", PoseKeys(poses_rate=5)).rows
    expected = np.loadtxt(TUM.splitlines())
    np.testing.assert_allclose(np.array(rows)[:, :4], expected[:, :4], atol=1e-15)
    # A quaternion and its negative are the same rotation.
    np.testing.assert_allclose(abs((np.array(rows) * expected)[:, 4:].sum(axis=1)), 1, atol=1e-12)


def test_picture_names_of_thousands_of_digits(small: Path) -> None:
    """The last digits count, or the order of the names."""
    for prefix in ("1" * 5000, f"{'1' * 5000}.", f"1.{'1' * 5000}a"):
        Path("poses.txt").write_text(COLMAP.replace("frames/", prefix))
        rows = read_poses("poses.txt", PoseKeys(poses_rate=5)).rows
        np.testing.assert_allclose([row[1] for row in rows], [0, 0.1, 0.1], atol=1e-15)


def test_gap_in_the_picture_numbers(small: Path) -> None:
    more = COLMAP + "".join(f"9 0 -1 0 0 0 0 0.4 1 frames/{name}.jp2\n20 15 -1\n" for name in ("00110", "00108"))
    Path("poses.txt").write_text(more)
    assert [row[0] for row in read_poses("poses.txt", PoseKeys(poses_rate=5)).rows] == [0, 0.2, 0.4, 0.8, 1]


DESCRIBED: dict[str, tuple[str, dict[str, object]]] = {
    "mm": (TUM.replace("0.4 1", "400 1").replace("0.1 0", "100 0").replace("0.5", "500"), {"poses_unit": "mm"}),
    "ns": (EUROC.replace(" [ns]", ""), {"poses_time": "ns"}),
    "units of the header": (EUROC, {"poses_time": "ns", "poses_unit": "m"}),
    "since 1970": (SINCE_1970, {"poses_start": 0}),
    "start since 1970": (SINCE_1970, {"poses_start": 1520530308}),
    "start": (TUM.replace("\n0.", "\n7."), {"poses_start": 7}),
    "start at the first pose": (TUM.replace("\n0.", "\n7."), {"poses_start": 0}),
}


@pytest.mark.parametrize(("text", "keys"), DESCRIBED.values(), ids=DESCRIBED)
def test_units_and_start(text: str, keys: dict[str, object], small: Path) -> None:
    Path("poses.txt").write_text(text)
    camera = load_scene("small.yaml", {"render.camera": {"poses": "poses.txt", **keys}}).render.camera
    assert isinstance(camera, Camera)
    assert isinstance(camera.poses, tuple)
    np.testing.assert_allclose(np.array(camera.poses), np.loadtxt(TUM.splitlines()), rtol=1e-15)
    # The rows replace the file and its keys.
    assert Camera(**camera.model_dump()) == camera.model_copy()


RATE: dict[str, object] = {"poses_rate": 5}
INVALID: dict[str, tuple[str, dict[str, object]]] = {
    "not sorted": (TUM.replace("0.4 0.1", "0.1 0.1"), {}),
    "not a rotation": (TUM.replace("0.6 0.8", "0.6 0.9"), {}),
    "seven numbers": (TUM.replace("0.6 0.8", "0.6"), {}),
    "EuRoC without a header": (",".join("1" * 17), {}),
    "decimal commas": (TUM.partition("\n")[2].replace(".", ","), {}),
    "a number more than columns": (EUROC.rstrip("\n") + ",1\n", {}),
    "commas without a header": (TUM.partition("\n")[2].replace(" ", ","), {}),
    "unknown columns": (TUM.replace("qx qy qz qw", "w x y z"), {}),
    "unknown units": (EUROC.replace("x [m]", "x [mm]"), {}),
    "two units": (SUFFIXES.replace("z_mm", "z_m"), {}),
    "no poses": ("# nothing\n", {}),
    "nanoseconds": (TUM.replace("0.2 0.1", "2e8 0.1").replace("0.4 0.1", "4e8 0.1"), {}),
    "eye on the sheet": (TUM.replace("0.0 0.0 0.0 0.4", "0.0 0.0 0.0 0.0"), {}),
    "late": (TUM.replace("0.0 0.0 0.0", "0.1 0.0 0.0"), {}),
    "short": (TUM.replace("0.4 0.1", "0.3 0.1"), {}),
    "second header": (f"{TUM}# t tx ty tz qw qx qy qz\n", {}),
    **{
        comment: (TUM.replace("timestamp tx ty tz qx qy qz qw", comment), {})
        for comment in (
            *("t, position, quaternion (w, x, y, z)", "t x y z q0 q1 q2 q3"),
            *("quaternion, scalar first", "world to camera", "T_cw"),
        )
    },
    "no rate": (KITTI, {}),
    "unit without times": (KITTI, {"poses_time": "s"}),
    "13 numbers": (KITTI.replace("0.5", "0.5 1"), RATE),
    "not a rotation, of KITTI": (KITTI.replace("0.96", "0.9"), RATE),
    "not a rotation, of COLMAP": (COLMAP.replace("-0.8", "-0.9"), RATE),
    "two cameras": (COLMAP.replace("0.4 1 f", "0.4 2 f"), RATE),
    "not a point": (COLMAP.replace("20 15 -1\n", "20 15 0.5\n"), RATE),
    "truncated image": (COLMAP.replace(" 0.4 1 frames/00102.jp2", ""), RATE),
    "rate and times": (TUM, RATE),
    "two units of time": (EUROC, {"poses_time": "ms"}),
    "no unit": (SINCE_1970.replace(" [ns]", ""), {}),
    "start after the end": (TUM, {"poses_start": 1}),
}


@pytest.mark.parametrize(("text", "keys"), INVALID.values(), ids=INVALID)
def test_invalid_trajectory(text: str, keys: dict[str, object], small: Path, message: Messages) -> None:
    Path("poses.txt").write_text(text)
    with message.raises(SceneError, "render.camera.poses: "):
        load_scene("small.yaml", {"render.camera": {"poses": "poses.txt", **keys}})


def test_file_keys_without_a_file(small: Path, message: Messages) -> None:
    for keys in ({"poses_rate": 5}, {"calibration_unit": "mm"}):
        with message.raises(SceneError, f"render.camera.{next(iter(keys))}"):
            load_scene("small.yaml", {"render.camera": {"eye": [0, 0, 1], **keys}})
