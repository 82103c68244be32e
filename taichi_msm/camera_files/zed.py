"""SN*.conf of the ZED cameras of Stereolabs: two sections per picture size, and the pose of the right camera [mm]."""

from __future__ import annotations

import re
from collections.abc import Sequence

from taichi_msm.camera_files.calibration import Calibration, CalibrationReader, StereoPose
from taichi_msm.camera_files.camera_file import CameraFile, Entries
from taichi_msm.camera_files.key_lookup import Keys
from taichi_msm.camera_files.opencv import build_keys, read_camera

# Sizes of pictures [px] by the last word of a section.
SIZES = {
    **{"2K": (2208, 1242), "FHD": (1920, 1080), "HD": (1280, 720), "VGA": (672, 376)},
    **{"FHD1200": (1920, 1200), "SVGA": (960, 600)},
}
SECTION = re.compile(rf"(LEFT|RIGHT)_CAM_({'|'.join(SIZES)})")
# In the order of the SDK's `CameraParameters.disto`, which is OpenCV's; the first two are in all files.
COEFFICIENTS = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")
PRISM = ("p3", "s1", "s2", "s3", "s4")


def _cameras(file: CameraFile) -> Sequence[Keys]:
    """Return the sections of cameras, with the keys of the pose, by their names; an empty list for another format."""
    names = [name for name, section in file.data.items() if SECTION.fullmatch(name) and isinstance(section, Entries)]
    stereo = file.data.get("STEREO")
    pose = stereo if isinstance(stereo, Entries) else Entries({}, {})
    return [Keys(file, _merge(file.data[name], pose), camera=name) for name in names]


def _merge(section: Entries, pose: Entries) -> Entries:
    """Return the keys of a section, and those of the pose with the name of its section."""
    data = {**section, **{f"stereo_{name}": value for name, value in pose.items()}}
    return Entries(data, {**section.lines, **{f"stereo_{name}": line for name, line in pose.lines.items()}})


def _read(keys: Keys) -> Calibration:
    fx, fy, cx, cy = (keys.number(name) for name in ("fx", "fy", "cx", "cy"))
    coefficients = [keys.number(name, None if n < 2 else 0.0) for n, name in enumerate(COEFFICIENTS)]
    if others := [name for name in PRISM if keys.number(name, 0.0)]:
        raise keys.fault(f"{others[0]} is not 0, and not supported; calibrate without it", others[0])
    size = SIZES[keys.camera.rpartition("_")[2]]
    line = keys.data.lines.get("fx")
    return read_camera(build_keys(keys.file, (fx, fy), (cx, cy), coefficients, "opencv", size, line))


def _pose(keys: Keys) -> StereoPose | None:
    """Read the pose of a right camera, by the formula of Stereolabs, in which missing values are 0."""
    side, suffix = keys.camera.split("_CAM_")
    if side == "LEFT":
        return None
    from scipy.spatial.transform import Rotation

    vector = [keys.number(f"stereo_{name}_{suffix}", 0.0) for name in ("rx", "cv", "rz")]
    # The shifts are of a size of pictures, or, in older files, of all of them.
    shifts = [keys.number(f"stereo_{name}_{suffix}", keys.number(f"stereo_{name}", 0.0)) for name in ("ty", "tz")]
    rotation = Rotation.from_rotvec(vector).as_matrix().tolist()
    return StereoPose(tuple(map(tuple, rotation)), (-keys.number("stereo_baseline"), *shifts))


ZED = CalibrationReader(
    "ZED",
    "SN*.conf: sections `[LEFT_CAM_HD]`, `[RIGHT_CAM_HD]`, ..., of which one is selected by `camera`",
    ("calibration: SN1234.conf, camera: LEFT_CAM_HD",),
    _cameras,
    _read,
    _pose,
    unit=1e-3,
)
