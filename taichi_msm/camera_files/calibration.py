"""Calibration of a camera, and the interface of its readers."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import NamedTuple

from taichi_msm.camera_files.camera_file import CameraFile
from taichi_msm.camera_files.key_lookup import Keys


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
        """Return the calibration for scaled pictures, edges to edges.

        Args:
            scale_x: new width over old width.
            scale_y: new height over old height.
        """
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


def focal_fault(focal: Sequence[float], size: Sequence[float]) -> str:
    """Return the fault of focal lengths that are not in pixels, and its remedy; "" for plausible ones.

    The limit is a twentieth of the picture. A perspective view would then exceed 168 degrees, where the widest lenses
    have 140; and the image circle of an equidistant fisheye that sees the whole sphere, of diameter 2 pi f, would
    cover less than a third of the picture. Focal lengths in millimetres or in widths of the picture are below it.

    Args:
        focal: focal lengths fx, fy [px].
        size: width and height of the pictures [px].
    """
    for name, extent, length, pixels in zip(("fx", "fy"), ("wide", "high"), focal, size, strict=True):
        if length < pixels / 20:
            fault = f"{name} = {length:g} is below 1/20 of a picture {pixels:g} px {extent}, shorter than of any lens"
            return f"{fault}; write it in pixels (normalised: times {pixels:g}; in mm: divided by the pixel pitch)"
    return ""


class CalibrationReader(NamedTuple):
    """Reader of a format of calibrations."""

    name: str  # name of the format, for users
    recognised_by: str  # content by which a file is recognised, for users
    cameras: Callable[[CameraFile], Sequence[Keys]]  # keys of each camera, the left one first; none in other formats
    read: Callable[[Keys], Calibration]
    # Pose of the right camera, in the unit of the file, from the keys of this camera.
    pose: Callable[[Keys], StereoPose | None] = lambda keys: None
    unit: float | None = 1.0  # unit of lengths in the file [m]; None where the format does not define it
