"""COLMAP's models as text: cameras.txt and images.txt."""

from __future__ import annotations

import re
from collections.abc import Sequence

from taichi_msm.camera_files.calibration import Calibration, CalibrationReader, build
from taichi_msm.camera_files.keys import Keys
from taichi_msm.camera_files.text import CameraFile
from taichi_msm.camera_files.trajectory import Trajectory, TrajectoryReader, parse_numbers, pose_fault

# A line of cameras.txt: id, model, width, height, parameters.
CAMERA = re.compile(r"^(\d+) ([A-Z_]+) (\d+) (\d+)((?: [-+.\deE]+)+)[ \t\r]*$", re.MULTILINE)

# A line of images.txt: id, quaternion w, x, y, z and translation, camera, name.
IMAGE = re.compile(r"^(\d+)((?: [-+.\deE]+){7}) (\d+) (\S.*)$", re.MULTILINE)

# Models: the number of focal lengths, the lens model, and the places of the parameters after the principal point in its
# coefficients.
MODELS = {
    "SIMPLE_PINHOLE": (1, "pinhole", 0),
    "PINHOLE": (2, "pinhole", 0),
    "SIMPLE_RADIAL": (1, "pinhole", 1),
    "RADIAL": (1, "pinhole", 2),
    "OPENCV": (2, "pinhole", 4),
    "FULL_OPENCV": (2, "pinhole", 8),
    "OPENCV_FISHEYE": (2, "fisheye", 4),
    "SIMPLE_RADIAL_FISHEYE": (1, "fisheye", 1),
    "RADIAL_FISHEYE": (1, "fisheye", 2),
}


class ColmapCameras(CalibrationReader):
    """Reader of cameras.txt."""

    name = "COLMAP"
    recognised_by = "cameras.txt: a line `CAMERA_ID MODEL WIDTH HEIGHT PARAMS`"

    def recognises(self, file: CameraFile) -> bool:
        """Return whether there is a line of a camera."""
        return bool(CAMERA.search(file.text))

    def cameras(self, file: CameraFile) -> Sequence[Keys]:
        """Return the only camera."""
        cameras = CAMERA.findall(file.text)
        if any(camera[1:] != cameras[0][1:] for camera in cameras):
            ids = ", ".join(camera[0] for camera in cameras)
            raise file.fault(f"has several cameras, {ids}; keep the line of one")
        _, model, width, height, parameters = cameras[0]
        return [Keys(file, {"MODEL": model, "size": [width, height], "parameters": parameters})]

    def read(self, keys: Keys) -> Calibration:
        """Read the line; COLMAP's first pixel has its centre at (0.5, 0.5)."""
        if (name := keys.data["MODEL"]) not in MODELS:
            raise keys.file.fault(f"{name}: a model that is not known; expected one of: {', '.join(MODELS)}")
        focal_count, model, coefficient_count = MODELS[name]
        numbers = keys.require("parameters", focal_count + 2 + coefficient_count, f"parameters of {name}")
        fx, fy, cx, cy = numbers[0], numbers[focal_count - 1], *(x - 0.5 for x in numbers[focal_count:][:2])
        values = numbers[focal_count + 2 :]
        values += [0.0] * (4 - len(values)) if len(values) < 4 else []
        return build(keys.file, (fx, fy, cx, cy), keys.numbers("size"), model, values)


class ColmapImages(TrajectoryReader):
    """Reader of images.txt: a line per image, from the world to the camera, and one of its points."""

    name = "COLMAP"
    recognised_by = "images.txt: lines `IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME`; needs `poses_rate`"

    def recognises(self, file: CameraFile) -> bool:
        """Return whether the first line that is neither empty nor a comment is that of an image."""
        return bool(IMAGE.search(file.text)) and _image(_lines(file)[0][1]) is not None

    def read(self, file: CameraFile) -> Trajectory:
        """Read the images, in the order of the numbers at the end of their names, or else of their names."""
        from scipy.spatial.transform import Rotation

        images = []
        for n, line in _lines(file):
            if (match := _image(line)) is not None:
                images.append((match[4], n, [float(word) for word in match[2].split()], match[3]))
            elif parse_numbers(line.split()[-1:]) is None:
                raise file.fault("neither IMAGE_ID QW QX QY QZ TX TY TZ CAMERA_ID NAME nor points", n)
        if len(cameras := {camera for *_, camera in images}) > 1:
            raise file.fault(f"has images of cameras {', '.join(sorted(cameras))}; keep those of one")
        ends = [re.search(r"(\d+)\D*$", name.rpartition(".")[0] or name) for name, *_ in images]
        numbers = [int(end[1]) for end in ends if end]
        if len({*numbers}) < len(images):
            images.sort()
            numbers = list(range(len(images)))
        poses: list[tuple[int, list[float]]] = []
        for number, (_, n, (w, x, y, z, *translation), _) in sorted(zip(numbers, images, strict=True)):
            if fault := pose_fault((0, 0, 0, 0, x, y, z, w), None):
                raise file.fault(fault, n)
            inverse = Rotation.from_quat((x, y, z, w)).inv()
            poses.append((n, [number, *(-inverse.apply(translation)).tolist(), *inverse.as_quat().tolist()]))
        return Trajectory([row for _, row in poses], [n for n, _ in poses], has_times=False)


def _lines(file: CameraFile) -> list[tuple[int, str]]:
    """Return the lines that are neither empty nor comments, with their numbers."""
    lines = enumerate(file.text.splitlines(), 1)
    return [(n, line) for n, line in lines if line.strip() and not line.startswith("#")]


def _image(line: str) -> re.Match[str] | None:
    """Match the line of an image; the last word of a line of points is a number."""
    return None if parse_numbers(line.split()[-1:]) else IMAGE.match(line)
