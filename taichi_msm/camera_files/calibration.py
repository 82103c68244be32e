"""Calibration of a camera, the interface of its readers, and the names of lens models in files."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Mapping, Sequence
from typing import ClassVar, NamedTuple

from taichi_msm.camera_files.keys import Keys, fold
from taichi_msm.camera_files.text import CameraFile
from taichi_msm.errors import truncate
from taichi_msm.lenses import MODELS

# Smallest focal length [px].
MIN_FOCAL_LENGTH_PX = 1e-3

# Numbers of coefficients that OpenCV writes. Those after the first 8 are not supported and must be 0.
COEFFICIENT_COUNTS, SUPPORTED_COEFFICIENTS = (0, 4, 5, 8, 12, 14), 8

REMEDY = "write camera_matrix: [fx, 0, cx, 0, fy, cy, 0, 0, 1], distortion_coefficients: [k1, k2, p1, p2]"

# Lens models by their names in files; None for names of several models.
LENSES = {
    **dict.fromkeys(("pinhole", "perspective", "mono", "monocular"), None),
    **dict.fromkeys(("plumbbob", "rationalpolynomial", "rational", "radtan", "radialtangential", "opencv"), "pinhole"),
    **dict.fromkeys(("omnidir", "omnidirectional", "omni", "mei", "unified"), "omnidir"),
    **dict.fromkeys(("equidistant", "equi", "fisheye", "opencvfisheye", "kannalabrandt", "kannalabrandt4"), "fisheye"),
}
NO_DISTORTION = ("none", "nodistortion", "undistorted")


class StereoPose(NamedTuple):
    """Pose of the right camera of a stereo pair: X_right = rotation X_left + translation.

    Attributes:
        rotation: rows of the matrix.
        translation: vector [m].
    """

    rotation: tuple[tuple[float, ...], ...]
    translation: tuple[float, ...]


class Calibration(NamedTuple):
    """Calibration of a camera, in OpenCV's pixels: the centre of the first one is at (0, 0).

    Attributes:
        focal: focal lengths fx, fy [px]; None if the lens has its own.
        centre: principal point cx, cy [px].
        size: width and height of the pictures [px]; None if the file does not contain them.
        model: name of the lens model, one of `taichi_msm.lenses.MODELS`.
        coefficients: coefficients of the lens by their names; missing ones are 0.
        right: pose of the right camera of a stereo pair, where that was asked for.
    """

    focal: tuple[float, float] | None
    centre: tuple[float, float]
    size: tuple[int, int] | None
    model: str
    coefficients: Mapping[str, float]
    right: StereoPose | None = None

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


class CalibrationReader(ABC):
    """Reader of a format of calibrations.

    Attributes:
        name: name of the format, for users.
        recognised_by: content by which a file is recognised, for users.
        unit: unit of lengths in the file [m]; None where it depends on who wrote the file.
    """

    name: ClassVar[str]
    recognised_by: ClassVar[str]
    unit: ClassVar[float | None] = 1.0

    @abstractmethod
    def recognises(self, file: CameraFile) -> bool:
        """Return whether a file has this format."""

    @abstractmethod
    def cameras(self, file: CameraFile) -> Sequence[Keys]:
        """Return the keys of each camera, the left one first."""

    @abstractmethod
    def read(self, keys: Keys) -> Calibration:
        """Read a camera."""

    def pose(self, keys: Keys) -> tuple[Sequence[float], Sequence[float]] | None:  # noqa: ARG002
        """Read the pose of the right camera: nine numbers of the rotation, three of the translation in the file's unit.

        Args:
            keys: keys of the right camera.
        """
        return None


def build(
    file: CameraFile,
    intrinsics: Sequence[float],
    size: Sequence[float] | None,
    model: str,
    values: Sequence[float],
) -> Calibration:
    """Check the numbers of a calibration.

    Args:
        file: the file, for messages.
        intrinsics: fx, fy, cx, cy [px].
        size: width and height of the pictures [px].
        model: name of the lens model.
        values: coefficients in the order of the model; trailing ones may be missing.
    """
    fx, fy, cx, cy = intrinsics
    if (focal := min(fx, fy)) < MIN_FOCAL_LENGTH_PX:
        raise file.fault(f"its focal length is {focal:g}; write it in pixels, {MIN_FOCAL_LENGTH_PX:g} or more")
    counts = COEFFICIENT_COUNTS if model == "pinhole" else (len(MODELS[model].coefficients),)
    if len(values) not in counts:
        names = ", ".join(MODELS[model].coefficients)
        expected = "4, 5, 8, 12 or 14: k1, k2, p1, p2, k3, ..." if model == "pinhole" else f"{counts[0]}: {names}"
        raise file.fault(f"{len(values)} distortion coefficients; expected {expected}")
    if any(others := values[SUPPORTED_COEFFICIENTS:]):
        number = 1 + SUPPORTED_COEFFICIENTS + next(n for n, value in enumerate(others) if value)
        fault = f"distortion coefficient {number} is not 0"
        raise file.fault(f"{fault}; thin prisms and tilted sensors are not modelled, calibrate without")
    if size is not None and min(size) < 1:
        fault = f"of pictures of {size[0]:g} x {size[1]:g} pixels"
        raise file.fault(f"{fault}; write the size of those that were calibrated with")
    pixels = None if size is None else (round(size[0]), round(size[1]))
    coefficients = dict(zip(MODELS[model].coefficients, values, strict=False))
    return Calibration(None if MODELS[model].focal_length else (fx, fy), (cx, cy), pixels, model, coefficients)


def lens_model(file: CameraFile, key: str, value: object, values: Sequence[float]) -> str | None:
    """Return the lens model with a name, "none" for no distortion, or None for a name of several models.

    Args:
        file: the file, for messages.
        key: key of the name.
        value: the name.
        values: coefficients; those of a camera without distortion must be 0.
    """
    name = fold(value)
    if name in NO_DISTORTION:
        if any(values):
            listed = ", ".join(f"{number:g}" for number in values)
            remedy = "write the model of these, such as plumb_bob or equidistant, or zeros"
            raise file.fault(f"{key}: {value}, and coefficients that are not 0: {listed}; {remedy}")
        return "none"
    if name not in LENSES:
        known = "plumb_bob, radtan, rational_polynomial, equidistant, fisheye, omnidir, or none without coefficients"
        raise file.fault(f"{key}: {truncate(str(value))} is not known; expected one of: {known}")
    return LENSES[name]
