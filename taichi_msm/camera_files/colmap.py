"""COLMAP's models as text: cameras.txt and images.txt."""

from __future__ import annotations

import re
from collections.abc import Sequence

from taichi_msm.camera_files.calibration import CalibrationReader
from taichi_msm.camera_files.camera_file import CameraFile, Entries, listed
from taichi_msm.camera_files.key_lookup import Keys
from taichi_msm.camera_files.opencv import read_camera
from taichi_msm.camera_files.trajectory import Trajectory, TrajectoryReader, parse_numbers, pose_fault

# A line of cameras.txt: id, model, width, height, parameters.
CAMERA = re.compile(r"(\d+)\s+([A-Z_]+)\s+(\d+)\s+(\d+)((?:\s+[-+.\deE]+)+)")

POINT_ID = re.compile(r"-1|\d+")

# Numbers in the names of images: a time, and the last number, which is matched in the reversed name. Longer numbers are
# neither times nor counts.
TIME = re.compile(r"(?:.*\D)?(\d{1,30}\.\d{1,30})")
REVERSED_END = re.compile(r"\D*(\d{1,30})")

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


def _cameras(file: CameraFile) -> Sequence[Keys]:
    """Return the camera under OpenCV's keys, shifted by half a pixel: COLMAP's first pixel centre is (0.5, 0.5)."""
    matches: list[tuple[int, re.Match[str]]] = []
    for n, line in file.lines:
        if match := CAMERA.fullmatch(line):
            matches.append((n, match))
            if match.groups()[1:] != matches[0][1].groups()[1:]:
                names = listed(match[1] for _, match in matches)
                raise file.fault(f"has several cameras, {names}; keep the line of one", n)
    return [_camera(file, n, *match.groups()[1:]) for n, match in matches[:1]]


def _camera(file: CameraFile, line: int, name: str, width: str, height: str, parameters: str) -> Keys:
    if name not in MODELS:
        raise file.fault(f"{name}: not a supported model; expected one of: {', '.join(MODELS)}", line)
    focal_count, model, coefficient_count = MODELS[name]
    keys = Keys(file, Entries({"PARAMS": parameters}, {"PARAMS": line}))
    numbers = keys.require("params", focal_count + 2 + coefficient_count, name)
    fx, fy, (cx, cy) = numbers[0], numbers[focal_count - 1], numbers[focal_count : focal_count + 2]
    values = [*numbers[focal_count + 2 :], *[0.0] * 4][: max(4, coefficient_count)]
    matrix = [fx, 0, cx - 0.5, 0, fy, cy - 0.5, 0, 0, 1]
    data = {"K": matrix, "D": values, "model": model, "size": [width, height]}
    return Keys(file, Entries(data, dict.fromkeys(data, line)))


def _read_images(file: CameraFile) -> Trajectory | None:
    """Read the poses, ordered by times or final numbers in the image names, else by name; None for another format."""
    lines = [(n, line) for n, line in file.lines if line[0] != "#"]
    if not lines or _image(lines[0][1]) is None:
        return None
    from scipy.spatial.transform import Rotation

    images, follows_image = [], False
    for n, line in lines:
        if (image := _image(line)) is not None:
            name, pose, camera = image
            images.append((name, n, pose, camera))
        elif not (follows_image and _has_points(line.split())):
            fault = "neither an image, IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, nor points"
            raise file.fault(f"{fault}; export the model again", n)
        follows_image = image is not None
    if len(cameras := {camera for *_, camera in images}) > 1:
        raise file.fault(f"has images of cameras {listed(sorted(cameras))}; keep those of one")
    stems = [name.rpartition(".")[0] or name for name, *_ in images]
    # Times as names, such as 1305031102.975304.png.
    times = [float(match[1]) for stem in stems if (match := TIME.fullmatch(stem))]
    has_times = len({*times}) == len(images)
    ends = [REVERSED_END.match(stem[::-1]) for stem in stems]
    numbers: list[float] = times if has_times else [int(end[1][::-1]) for end in ends if end]
    if len({*numbers}) < len(images):
        images.sort()
        numbers = list(range(len(images)))
    poses: list[tuple[int, list[float]]] = []
    for number, (_, n, (w, x, y, z, *translation), _) in sorted(zip(numbers, images, strict=True)):
        if fault := pose_fault((0, 0, 0, 0, x, y, z, w), None):
            raise file.fault(fault, n)
        inverse = Rotation.from_quat((x, y, z, w)).inv()
        poses.append((n, [number, *(-inverse.apply(translation)).tolist(), *inverse.as_quat().tolist()]))
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
    "COLMAP", "cameras.txt: a line `CAMERA_ID MODEL WIDTH HEIGHT PARAMS`", _cameras, read_camera
)
COLMAP_IMAGES = TrajectoryReader(
    "COLMAP", "images.txt: lines `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`; needs `poses_rate`", _read_images
)
