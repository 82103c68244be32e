"""COLMAP's models in binary: cameras.bin and images.bin, little-endian, each with a count and its records."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, NoReturn

from taichi_msm.camera_files.calibration import CalibrationReader
from taichi_msm.camera_files.camera_file import CameraFile
from taichi_msm.camera_files.colmap import MODELS, Picture, build_camera, build_trajectory
from taichi_msm.camera_files.key_lookup import Keys
from taichi_msm.camera_files.opencv import read_camera
from taichi_msm.camera_files.trajectory import MAX_NUMBER, Trajectory, TrajectoryReader

# Models by their numbers in binary files.
MODEL_NUMBERS = {
    **dict(enumerate(("SIMPLE_PINHOLE", "PINHOLE", "SIMPLE_RADIAL", "RADIAL", "OPENCV", "OPENCV_FISHEYE"))),
    **{6: "FULL_OPENCV", 7: "FOV", 8: "SIMPLE_RADIAL_FISHEYE", 9: "RADIAL_FISHEYE", 10: "THIN_PRISM_FISHEYE"},
}


class _Records:
    """Reader of the values of a file; a CameraFileError where it ends too early."""

    def __init__(self, file: CameraFile, kind: str) -> None:
        self.file, self.kind, self.position = file, kind, 0

    def fail(self) -> NoReturn:
        raise self.file.fault(f"not a complete {self.kind} of COLMAP; name that file of the model, or export it again")

    def values(self, layout: str) -> tuple[Any, ...]:
        """Return the next values, by their `struct` layout."""
        size = struct.calcsize(f"<{layout}")
        if self.position + size > len(self.file.content):
            self.fail()
        self.position += size
        return struct.unpack_from(f"<{layout}", self.file.content, self.position - size)

    def skip(self, size: int) -> None:
        """Skip bytes."""
        self.position += size

    def name(self) -> str:
        """Return the next text, which ends with a zero byte."""
        end = self.file.content.find(b"\0", self.position)
        if end < 0:
            self.fail()
        text = self.file.content[self.position : end].decode("utf-8", "replace")
        self.position = end + 1
        return text

    def finish(self) -> None:
        """Require the end of the file."""
        if self.position != len(self.file.content):
            self.fail()


def _is_binary(file: CameraFile) -> bool:
    """Return whether a file has COLMAP's suffix; no other format is binary."""
    return file.path.lower().endswith(".bin")


def _cameras(file: CameraFile) -> Sequence[Keys]:
    """Return the cameras; an empty list for another format."""
    if not _is_binary(file):
        return []
    records, cameras = _Records(file, "cameras.bin"), []
    for _ in range(min(*records.values("Q"), len(file.content))):
        number, model, width, height = records.values("IiQQ")
        name = MODEL_NUMBERS.get(model, f"model {model}")
        count = 0
        if name in MODELS:
            focal_count, _, coefficient_count = MODELS[name]
            count = focal_count + 2 + coefficient_count
        elif not 0 <= model < 1000:
            records.fail()
        cameras.append(build_camera(file, str(number), name, (width, height), records.values(f"{count}d")))
    records.finish()
    return cameras or records.fail()


def _read_images(file: CameraFile) -> Trajectory | None:
    """Read the poses, in the order of `build_trajectory`; None for another format."""
    if not _is_binary(file):
        return None
    records, pictures = _Records(file, "images.bin"), []
    for _ in range(min(*records.values("Q"), len(file.content))):
        _, *pose, camera = records.values("I7dI")
        if not all(abs(number) <= MAX_NUMBER for number in pose):
            records.fail()
        pictures.append(Picture(records.name(), None, pose, str(camera)))
        (points,) = records.values("Q")
        records.skip(24 * points)  # x, y and the number of the point
    records.finish()
    return build_trajectory(file, pictures)


COLMAP_BINARY_CAMERAS = CalibrationReader(
    "COLMAP, binary", "cameras.bin", ("calibration: cameras.bin",), _cameras, read_camera
)
COLMAP_BINARY_IMAGES = TrajectoryReader(
    "COLMAP, binary", "images.bin; needs `poses_rate`", ("poses: images.bin, poses_rate: 25",), _read_images
)
