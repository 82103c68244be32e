"""Calibration of a camera, and the interface of its readers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from taichi_msm.camera_files.camera_file import CameraFile
from taichi_msm.camera_files.key_lookup import Keys


class StereoPose(NamedTuple):
    """Pose of a camera of a stereo pair: X = rotation X_left + translation, or relative to other axes."""

    rotation: tuple[tuple[float, ...], ...]  # rows of the matrix
    translation: tuple[float, ...]  # vector [m]


class Calibration(NamedTuple):
    """Calibration of a camera in OpenCV's pixel coordinates, in which the centre of the first pixel is (0, 0)."""

    focal: tuple[float, float] | None  # focal lengths fx, fy [px]; None if the lens has its own
    centre: tuple[float, float]  # principal point cx, cy [px]
    size: tuple[int, int] | None  # width and height of the pictures [px]; None if the file does not contain them
    model: str  # name of the lens model, one of `taichi_msm.lenses.MODELS`
    coefficients: Mapping[str, float]  # coefficients of the lens by their names; missing ones are 0
    right: StereoPose | None = None  # pose relative to the left camera, of the right camera of a stereo pair only
    other_key: str = ""  # key that reads the right camera, in files with both cameras of a stereo pair

    def scaled(self, scale_x: float, scale_y: float) -> Calibration:
        """Return the calibration for pictures resized edge to edge, by factors of their width and height."""
        (cx, cy), lens = self.centre, dict(self.coefficients)
        focal = None if self.focal is None else (self.focal[0] * scale_x, self.focal[1] * scale_y)
        if self.model == "scaramuzza":
            # The polynomial is in pixels; the matrix [[c, d], [e, 1]] takes the ratio of the factors.
            powers = {"a0": 1, "a2": -1, "a3": -2, "a4": -3}
            lens |= {name: lens[name] * scale_y**power for name, power in powers.items()}
            lens |= {name: lens[name] * scale_x / scale_y for name in ("c", "d")}
        # The edges of a picture are half a pixel from the centres of the outer pixels.
        centre = (cx + 0.5) * scale_x - 0.5, (cy + 0.5) * scale_y - 0.5
        return self._replace(focal=focal, centre=centre, coefficients=lens)


def focal_fault(focal: Sequence[float], size: Sequence[float]) -> str:
    """Return fault and remedy of focal lengths fx, fy [px] too short for a picture size [px]; "" for plausible ones.

    The limit is a twentieth of the picture. At the limit, a perspective camera has a field of view of 168 degrees (the
    widest lenses have 140), and the image circle of a 360-degree equidistant fisheye, of diameter 2 pi f, fills less
    than a third of the picture. Focal lengths in millimetres or in picture widths are below the limit.
    """
    for name, extent, length, pixels in zip(("fx", "fy"), ("width", "height"), focal, size, strict=True):
        if length < pixels / 20:
            fault = f"{name} = {length:g} is below 1/20 of the picture {extent}, {pixels:g} px"
            remedy = f"convert it to pixels (normalised: multiply by {pixels:g}; mm: divide by the pixel pitch)"
            return f"{fault}, too short to be in pixels; {remedy}"
    return ""


class CalibrationReader(NamedTuple):
    """Reader of a format of calibrations."""

    name: str  # name of the format, for users
    recognised_by: str  # content by which a file is recognised, for users
    examples: tuple[str, ...]  # keys of a camera that read such files, for users
    cameras: Callable[[CameraFile], Sequence[Keys]]  # keys of each camera, the left one first; empty for another format
    read: Callable[[Keys], Calibration]
    # Function that returns the pose of the right camera from its keys, in the unit of the file.
    pose: Callable[[Keys], StereoPose | None] = lambda keys: None
    # Function that returns the pose relative to axes that both files of a pair share, in the unit of the file.
    rig_pose: Callable[[Keys], StereoPose | None] = lambda keys: None
    unit: float | None = 1.0  # unit of lengths in the file [m]; None where the format does not define it
