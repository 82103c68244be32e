"""COLMAP's models as text: cameras.txt and images.txt."""

from __future__ import annotations

import re
from collections.abc import Sequence

from taichi_msm.camera_files.calibration import CalibrationReader
from taichi_msm.camera_files.camera_file import CameraFile, listed
from taichi_msm.camera_files.key_lookup import Keys
from taichi_msm.camera_files.opencv import read_camera
from taichi_msm.camera_files.trajectory import Trajectory, TrajectoryReader, parse_numbers, pose_fault

# A line of cameras.txt: id, model, width, height, parameters.
CAMERA = re.compile(r"^(\d+)[ \t]+([A-Z_]+)[ \t]+(\d+)[ \t]+(\d+)((?:[ \t]+[-+.\deE]+)+)[ \t\r]*$", re.MULTILINE)

# A line of images.txt: id, quaternion w, x, y, z and translation, camera, name.
IMAGE = re.compile(r"^(\d+)((?:[ \t]+[-+.\deE]+){7})[ \t]+(\d+)[ \t]+(\S.*)$", re.MULTILINE)

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


def _cameras(file: CameraFile) -> Sequence[Keys]:
    """Return the camera under OpenCV's keys, shifted by half a pixel: COLMAP's first pixel centre is (0.5, 0.5)."""
    cameras = list(CAMERA.finditer(file.text))
    lines = [1 + file.text.count("\n", 0, camera.start()) for camera in cameras]
    for camera, line in zip(cameras, lines, strict=True):
        if camera.groups()[1:] != cameras[0].groups()[1:]:
            names = listed(camera[1] for camera in cameras)
            raise file.fault(f"has several cameras, {names}; keep the line of one", line)
    return [_camera(file, line, *camera.groups()[1:]) for camera, line in zip(cameras[:1], lines, strict=False)]


def _camera(file: CameraFile, line: int, name: str, width: str, height: str, parameters: str) -> Keys:
    if name not in MODELS:
        raise file.fault(f"{name}: not a supported model; expected one of: {', '.join(MODELS)}", line)
    focal_count, model, coefficient_count = MODELS[name]
    count, lines = focal_count + 2 + coefficient_count, {"PARAMS": line}
    numbers = Keys(file, {"PARAMS": parameters}, lines=lines).require("params", count, name)
    fx, fy, (cx, cy) = numbers[0], numbers[focal_count - 1], numbers[focal_count : focal_count + 2]
    values = [*numbers[focal_count + 2 :], *[0.0] * 4][: max(4, coefficient_count)]
    matrix = [fx, 0, cx - 0.5, 0, fy, cy - 0.5, 0, 0, 1]
    data = {"K": matrix, "D": values, "model": model, "size": [width, height]}
    return Keys(file, data, lines=dict.fromkeys(data, line))


def _read_images(file: CameraFile) -> Trajectory | None:
    """Read the poses, ordered by times or final numbers in the image names, else by name; None for another format."""
    lines = [(n, line) for n, line in enumerate(file.text.splitlines(), 1) if line.strip() and line[0] != "#"]
    if not lines or _image(lines[0][1]) is None:
        return None
    from scipy.spatial.transform import Rotation

    images, follows_image = [], False
    for n, line in lines:
        if (match := _image(line)) is not None:
            images.append((match[4], n, [float(word) for word in match[2].split()], match[3]))
        elif not (follows_image and _has_points(line.split())):
            raise file.fault(
                "neither an image, IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME, nor points; export the model again",
                n,
            )
        follows_image = match is not None
    if len(cameras := {camera for *_, camera in images}) > 1:
        raise file.fault(f"has images of cameras {listed(sorted(cameras))}; keep those of one")
    stems = [name.rpartition(".")[0] or name for name, *_ in images]
    # Times as names, such as 1305031102.975304.png.
    times = [float(match[1]) for stem in stems if (match := re.fullmatch(r"(?:.*\D)??(\d+\.\d+)", stem))]
    has_times = len({*times}) == len(images)
    ends = [re.search(r"(\d+)\D*$", stem) for stem in stems]
    numbers: list[float] = times if has_times else [int(end[1]) for end in ends if end]
    if len({*numbers}) < len(images):
        images.sort()
        numbers = list(range(len(images)))
    poses: list[tuple[int, list[float]]] = []
    for number, (_, n, (w, x, y, z, *translation), _) in sorted(zip(numbers, images, strict=True)):
        if fault := pose_fault((0, 0, 0, 0, x, y, z, w), None):
            raise file.fault(fault, n)
        inverse = Rotation.from_quat((x, y, z, w)).inv()
        poses.append((n, [number, *(-inverse.apply(translation)).tolist(), *inverse.as_quat().tolist()]))
    return Trajectory([row for _, row in poses], [n for n, _ in poses], has_times)


def _image(line: str) -> re.Match[str] | None:
    """Match the line of an image, which, unlike a line of points, does not end with a number."""
    return None if parse_numbers(line.split()[-1:]) else IMAGE.match(line)


def _has_points(words: Sequence[str]) -> bool:
    """Return whether a line consists of points: X, Y and a whole number each."""
    return parse_numbers(words) is not None and len(words) % 3 == 0 and all(map(POINT_ID.fullmatch, words[2::3]))


COLMAP_CAMERAS = CalibrationReader(
    "COLMAP", "cameras.txt: a line `CAMERA_ID MODEL WIDTH HEIGHT PARAMS`", _cameras, read_camera
)
COLMAP_IMAGES = TrajectoryReader(
    "COLMAP", "images.txt: lines `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`; needs `poses_rate`", _read_images
)
