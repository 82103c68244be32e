"""COLMAP's models as text: cameras.txt and images.txt."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import Any, NamedTuple

from taichi_msm.camera_files.calibration import CalibrationReader
from taichi_msm.camera_files.camera_file import CameraFile, Entries, listed
from taichi_msm.camera_files.key_lookup import Keys
from taichi_msm.camera_files.opencv import build_keys, read_camera
from taichi_msm.camera_files.trajectory import (
    Row,
    Trajectory,
    TrajectoryReader,
    parse_numbers,
    picture_numbers,
    pose_fault,
)

# A line of cameras.txt: id, model, width, height, parameters.
CAMERA = re.compile(r"(\d+)\s+([A-Z_]+)\s+(\d+)\s+(\d+)((?:\s+[-+.\deE]+)+)")

POINT_ID = re.compile(r"-1|\d+")

# Models: the number of focal lengths, the lens model, and the number of its coefficients.
MODELS = {
    "SIMPLE_PINHOLE": (1, "pinhole", 0),
    "PINHOLE": (2, "pinhole", 0),
    "SIMPLE_RADIAL": (1, "pinhole", 1),
    "RADIAL": (1, "pinhole", 2),
    "OPENCV": (2, "opencv", 4),
    "FULL_OPENCV": (2, "opencv", 8),
    "OPENCV_FISHEYE": (2, "fisheye", 4),
    "SIMPLE_RADIAL_FISHEYE": (1, "fisheye", 1),
    "RADIAL_FISHEYE": (1, "fisheye", 2),
}


class Picture(NamedTuple):
    """Picture of a model."""

    name: str
    line: int | None  # number of its line; None in binary files
    pose: Sequence[float]  # quaternion w, x, y, z and translation, from the world to the camera
    camera: str  # its number


def _cameras(file: CameraFile) -> Sequence[Keys]:
    """Return the cameras; an empty list for another format."""
    matches = [(n, match) for n, line in file.lines if (match := CAMERA.fullmatch(line))]
    cameras: list[Keys] = []
    for n, match in matches:
        number, name, width, height, words = match.groups()
        parameters = Keys(file, Entries({"PARAMS": words}, {"PARAMS": n})).numbers("params") or ()
        cameras.append(build_camera(file, number, name, (width, height), parameters, n))
    return cameras


def build_camera(
    file: CameraFile,
    number: str,
    name: str,
    size: Sequence[Any],
    parameters: Sequence[float],
    line: int | None = None,
) -> Keys:
    """Return a camera under OpenCV's keys, shifted by half a pixel: COLMAP's first pixel centre is (0.5, 0.5)."""
    if name not in MODELS:
        raise file.fault(f"{name}: not a supported model; expected one of: {', '.join(MODELS)}", line)
    focal_count, model, coefficient_count = MODELS[name]
    if len(parameters) != (count := focal_count + 2 + coefficient_count):
        raise file.fault(f"{name}: {len(parameters)} numbers in place of {count}; write {count} numbers", line)
    focal = parameters[0], parameters[focal_count - 1]
    cx, cy, *coefficients = parameters[focal_count:]
    padded = [*coefficients, *[0.0] * 4][: max(4, coefficient_count)]
    return build_keys(file, focal, (cx - 0.5, cy - 0.5), padded, model, size, line, number)


def _read_images(file: CameraFile) -> Trajectory | None:
    """Read the poses, in the order of `build_trajectory`; None for another format."""
    lines = [(n, line) for n, line in file.lines if line[0] != "#"]
    if not lines or _image(lines[0][1]) is None:
        return None
    pictures, follows_picture = [], False
    for n, line in lines:
        if (image := _image(line)) is not None:
            name, pose, camera = image
            pictures.append(Picture(name, n, pose, camera))
        elif not (follows_picture and _has_points(line.split())):
            fault = "neither an image, IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, nor points"
            raise file.fault(f"{fault}; export the model again", n)
        follows_picture = image is not None
    return build_trajectory(file, pictures)


def build_trajectory(file: CameraFile, pictures: Sequence[Picture]) -> Trajectory:
    """Invert the poses of pictures, ordered by `picture_numbers`."""
    from scipy.spatial.transform import Rotation

    if len(cameras := {picture.camera for picture in pictures}) > 1:
        raise file.fault(f"has images of cameras {listed(sorted(cameras))}; keep those of one")
    numbers, has_times = picture_numbers([picture.name for picture in pictures])
    poses: list[Row] = []
    for number, (_, line, (w, x, y, z, *translation), _) in sorted(zip(numbers, pictures, strict=True)):
        if fault := pose_fault((0, 0, 0, 0, x, y, z, w), None):
            raise file.fault(fault, line)
        inverse = Rotation.from_quat((x, y, z, w)).inv()
        poses.append((line, [number, *(-inverse.apply(translation)).tolist(), *inverse.as_quat().tolist()]))
    return Trajectory(poses, has_times)


def _image(line: str) -> tuple[str, list[float], str] | None:
    """Return name, pose (quaternion w, x, y, z and translation, from the world to the camera), and camera of an image.

    The line of an image, unlike one of points, does not end with a number.
    """
    words = line.split(maxsplit=9)
    pose = parse_numbers(words[1:8])
    if pose is None or len(words) < 10 or not (words[0].isdecimal() and words[8].isdecimal()):
        return None
    return None if parse_numbers(line.split()[-1:]) else (words[9], pose, words[8])


def _has_points(words: Sequence[str]) -> bool:
    """Return whether a line consists of points: X, Y and a whole number each."""
    return parse_numbers(words) is not None and len(words) % 3 == 0 and all(map(POINT_ID.fullmatch, words[2::3]))


COLMAP_CAMERAS = CalibrationReader(
    "COLMAP",
    "cameras.txt: lines `CAMERA_ID MODEL WIDTH HEIGHT PARAMS`; of several, one is selected by `camera`",
    ("calibration: cameras.txt", "calibration: cameras.txt, camera: 1"),
    _cameras,
    read_camera,
)
COLMAP_IMAGES = TrajectoryReader(
    "COLMAP",
    "images.txt: lines `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`; needs `poses_rate`",
    ("poses: images.txt, poses_rate: 25",),
    _read_images,
)
