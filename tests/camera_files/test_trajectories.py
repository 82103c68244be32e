"""Trajectories as other programs write them."""

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


# As in TUM-VI: nanoseconds since 1970.
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
# From the world to the camera, of every second picture of a film, in the order of their registration.
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
    rows = read_poses("poses.txt", PoseKeys(poses_rate=5))
    expected = np.loadtxt(TUM.splitlines())
    np.testing.assert_allclose(np.array(rows)[:, :4], expected[:, :4], atol=1e-15)
    for row, other in zip(rows, expected, strict=True):
        assert abs(abs(np.dot(row[4:], other[4:])) - 1) < 1e-12


def test_gap_in_the_picture_numbers(small: Path) -> None:
    more = COLMAP + "".join(f"9 0 -1 0 0 0 0 0.4 1 frames/{name}.jp2\n20 15 -1\n" for name in ("00110", "00108"))
    Path("poses.txt").write_text(more)
    assert [row[0] for row in read_poses("poses.txt", PoseKeys(poses_rate=5))] == [0, 0.2, 0.4, 0.8, 1]


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        (TUM.replace("0.4 1", "400 1").replace("0.1 0.0", "100 0.0").replace("0.5", "500"), {"poses_unit": "mm"}),
        (EUROC.replace("[m]", "[mm]").replace("0.4,", "400,").replace("0.1,", "100,").replace("0.5,", "500,"), {}),
        (EUROC.replace(" [ns]", ""), {"poses_time": "ns"}),
        (EUROC, {"poses_time": "ns", "poses_unit": "m"}),
        (SINCE_1970, {"poses_start": 0}),
        (SINCE_1970, {"poses_start": 1520530308}),
        (TUM.replace("\n0.", "\n1305031098."), {"poses_start": 1305031098}),
        (TUM.replace("\n0.", "\n7."), {"poses_start": 7}),
        (TUM.replace("\n0.", "\n7."), {"poses_start": 0}),
    ],
    ids=[
        "mm",
        "mm by header",
        "ns",
        "ns twice",
        "since 1970",
        "a time since 1970",
        "a time of TUM",
        "a time",
        "the first pose",
    ],
)
def test_units_and_start(text: str, keys: dict[str, object], small: Path) -> None:
    Path("poses.txt").write_text(text)
    made = load_scene("small.yaml", {"render.camera": {"poses": "poses.txt", **keys}}).render.camera
    assert isinstance(made, Camera)
    assert isinstance(made.poses, tuple)
    np.testing.assert_allclose(np.array(made.poses), np.loadtxt(TUM.splitlines()), rtol=1e-15)
    # What was read is kept, in place of the file and its keys.
    assert Camera(**made.model_dump()) == made.model_copy()


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
        pytest.param(SUFFIXES.replace("z_mm", "z_m"), "poses.txt:1", id="two units"),
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
def test_invalid_trajectory(text: str, place: str, small: Path, message: Messages) -> None:
    Path("poses.txt").write_text(text)
    with message.raises(SceneError, f"render.camera.poses: {place}"):
        load_scene("small.yaml", ["render.camera={poses: poses.txt}"])


@pytest.mark.parametrize(
    ("text", "keys"),
    [
        pytest.param(KITTI, {}, id="no rate"),
        pytest.param(KITTI, {"poses_time": "s"}, id="unit of no times"),
        pytest.param(KITTI.replace("0.5", "0.5 1"), {"poses_rate": 5}, id="13 numbers"),
        pytest.param(KITTI.replace("0.96", "0.9"), {"poses_rate": 5}, id="no rotation"),
        pytest.param(COLMAP.replace("-0.8", "-0.9"), {"poses_rate": 5}, id="no rotation of COLMAP"),
        pytest.param(COLMAP.replace("0.4 1 f", "0.4 2 f"), {"poses_rate": 5}, id="two cameras"),
        pytest.param(COLMAP.replace("20 15 -1\n", "20 15 x\n"), {"poses_rate": 5}, id="no points"),
        pytest.param(COLMAP.replace("20 15 -1\n", "20 15 0.5\n"), {"poses_rate": 5}, id="no point"),
        pytest.param(COLMAP.replace(" 0.4 1 frames/00102.jp2", ""), {"poses_rate": 5}, id="an image cut short"),
        pytest.param(COLMAP.split("\n7 ")[0], {"poses_rate": 5}, id="no images"),
        pytest.param(TUM, {"poses_rate": 5}, id="rate and times"),
        pytest.param(EUROC, {"poses_time": "ms"}, id="two units of time"),
        pytest.param(EUROC, {"poses_unit": "mm"}, id="two units of length"),
        pytest.param(SINCE_1970.replace(" [ns]", ""), {}, id="no unit"),
        pytest.param(TUM, {"poses_start": 1}, id="start after the end"),
    ],
)
def test_keys_contradicting_the_file(text: str, keys: dict[str, object], small: Path, message: Messages) -> None:
    Path("poses.txt").write_text(text)
    with message.raises(SceneError, "render.camera.poses: poses.txt"):
        load_scene("small.yaml", {"render.camera": {"poses": "poses.txt", **keys}})


def test_file_keys_without_a_file(small: Path, message: Messages) -> None:
    for keys in ({"poses_rate": 5}, {"calibration_unit": "mm"}):
        with message.raises(SceneError, f"render.camera.{next(iter(keys))}"):
            load_scene("small.yaml", {"render.camera": {"eye": [0, 0, 1], **keys}})
