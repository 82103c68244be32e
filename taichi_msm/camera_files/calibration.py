"""Calibration of a camera, and the interface of its readers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from taichi_msm.camera_files.keys import Keys
from taichi_msm.camera_files.text import CameraFile


class StereoPose(NamedTuple):
    """Pose of the right camera of a stereo pair: X_right = rotation X_left + translation."""

    rotation: tuple[tuple[float, ...], ...]  # rows of the matrix
    translation: tuple[float, ...]  # vector [m]


class Calibration(NamedTuple):
    """Calibration of a camera, in OpenCV's pixels: the centre of the first one is at (0, 0)."""

    focal: tuple[float, float] | None  # focal lengths fx, fy [px]; None if the lens has its own
    centre: tuple[float, float]  # principal point cx, cy [px]
    size: tuple[int, int] | None  # width and height of the pictures [px]; None if the file does not contain them
    model: str  # name of the lens model, one of `taichi_msm.lenses.MODELS`
    coefficients: Mapping[str, float]  # coefficients of the lens by their names; missing ones are 0
    right: StereoPose | None = None  # pose of the right camera of a stereo pair, where that was asked for

    def scaled(self, scale_x: float, scale_y: float) -> Calibration:
        """Return the calibration for pictures that are scaled by these factors, edges to edges."""
        (cx, cy), lens = self.centre, dict(self.coefficients)
        focal = None if self.focal is None else (self.focal[0] * scale_x, self.focal[1] * scale_y)
        if self.model == "scaramuzza":
            # In pixels; its matrix [[c, d], [e, 1]] has the ratio of the factors.
            powers = {"a0": 1, "a2": -1, "a3": -2, "a4": -3}
            lens |= {name: lens[name] * scale_y**power for name, power in powers.items()}
            lens |= {name: lens[name] * scale_x / scale_y for name in ("c", "d")}
        # The edges of a picture are half a pixel from the centres of the outer pixels.
        centre = (cx + 0.5) * scale_x - 0.5, (cy + 0.5) * scale_y - 0.5
        return self._replace(focal=focal, centre=centre, coefficients=lens)


class CalibrationReader(NamedTuple):
    """Reader of a format of calibrations."""

    name: str  # name of the format, for users
    recognised_by: str  # content by which a file is recognised, for users
    cameras: Callable[[CameraFile], Sequence[Keys]]  # keys of each camera, the left one first; none in other formats
    read: Callable[[Keys], Calibration]
    # Pose of the right camera, in the unit of the file, from the keys of this camera.
    pose: Callable[[Keys], StereoPose | None] = lambda keys: None
    unit: float | None = 1.0  # unit of lengths in the file [m]; None where it depends on who wrote the file
