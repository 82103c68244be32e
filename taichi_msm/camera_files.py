"""Calibrations and trajectories of cameras, as other programs write them.

Calibrations: OpenCV's FileStorage in YAML, XML or JSON (camera_matrix, distortion_coefficients, image_width,
image_height); ROS's camera_info in YAML; the calib.json of the STIR data set, of which the left camera is taken.
Trajectories: TUM's format, a line a pose: t tx ty tz qx qy qz qw, from the camera to the world.
"""

from __future__ import annotations

import json
import math
from collections.abc import Mapping, Sequence
from typing import Any, NamedTuple

import yaml

from taichi_msm.faults import LARGEST as MOST
from taichi_msm.picture import irregular, location

MAX_BYTES = 2**22

# The names that programs give to a number or a matrix.
MATRIX = ("camera_matrix", "cameraMatrix", "Camera_Matrix", "K", "k", "leftcameramat")
COEFFICIENTS = (
    "distortion_coefficients", "dist_coeffs", "distCoeffs", "Distortion_Coefficients", "D", "d", "leftdistortioncoeffs",
)  # fmt: skip
WIDTH, HEIGHT = ("image_width", "image_Width", "width"), ("image_height", "image_Height", "height")

# ROS's names of distortions with OpenCV's coefficients; the last two are OpenCV's fisheye.
MODELS = ("plumb_bob", "rational_polynomial", "equidistant", "fisheye")

# OpenCV's numbers of coefficients: only the first of them are known here, the others must be 0.
COUNTS, KNOWN = (0, 4, 5, 8, 12, 14), 8

# No number of a calibration is larger.
LARGEST = 1e6

# Quaternions whose length is farther from 1 are no rotations.
UNIT = 1e-3


class CameraFileError(Exception):
    """The file cannot be used; the message names it, says why, and what to do."""


class Calibration(NamedTuple):
    """A calibrated camera, in OpenCV's terms."""

    focal: tuple[float, float]  # fx, fy [px]
    centre: tuple[float, float]  # cx, cy [px]; the centre of the first pixel is at (0, 0)
    fisheye: bool
    coefficients: tuple[float, ...]  # in OpenCV's order: k1, k2, p1, p2, k3, k4, k5, k6; of a fisheye k1 to k4
    size: tuple[int, int] | None  # width, height of the pictures [px]; None: the file does not tell


def read_calibration(path: str) -> Calibration:
    """Read a calibration; raises a CameraFileError."""
    data = _parse(path, _read(path))
    matrix, values = _numbers(path, data, MATRIX), _numbers(path, data, COEFFICIENTS, required=False)
    if len(matrix) != 9 or [matrix[n] for n in (1, 3, 6, 7, 8)] != [0, 0, 0, 0, 1] or min(matrix[0], matrix[4]) <= 0:
        raise CameraFileError(f"{path}: its camera matrix is not [fx, 0, cx, 0, fy, cy, 0, 0, 1]; write it like that")
    model = data.get("distortion_model", "")
    if model and model not in MODELS:
        raise CameraFileError(f"{path}: distortion_model: {model} is not known; expected one of: {', '.join(MODELS)}")
    fisheye = model in MODELS[2:] or any(_numbers(path, data, ("fisheye_model",), required=False))
    if len(values) not in ((4,) if fisheye else COUNTS) or any(values[KNOWN:]):
        expected = "4 of a fisheye" if fisheye else "k1, k2, p1, p2, k3, k4, k5, k6, and 0 after them"
        raise CameraFileError(f"{path}: {len(values)} distortion coefficients that are not known; expected {expected}")
    width, height = (_numbers(path, data, names, required=False) for names in (WIDTH, HEIGHT))
    if bool(width) != bool(height):
        raise CameraFileError(f"{path}: has only one of {WIDTH[0]} and {HEIGHT[0]}; write both")
    size = (round(width[0]), round(height[0])) if width else None
    if size is not None and min(size) < 1:
        said = f"of pictures of {size[0]} x {size[1]} pixels; write the size of those that were calibrated with"
        raise CameraFileError(f"{path}: {said}")
    # ROS lets pictures be smaller than those that its camera matrix is of.
    region = data["roi"] if isinstance(data.get("roi"), dict) else {}
    cut = any(region.get(name) for name in ("x_offset", "y_offset")) or region.get("width") not in (None, 0, *width)
    if cut or any(data.get(name) not in (None, 0, 1) for name in ("binning_x", "binning_y")):
        said = "of pictures that are binned or cut, while its camera matrix is of whole ones"
        raise CameraFileError(f"{path}: {said}; write that of the pictures, without binning_x, binning_y and roi")
    return Calibration((matrix[0], matrix[4]), (matrix[2], matrix[5]), fisheye, tuple(values[:KNOWN]), size)


def read_poses(path: str) -> tuple[tuple[float, ...], ...]:
    """Read a trajectory: rows of t [s], the camera's place [m] and its rotation, a quaternion x, y, z, w.

    Raises a CameraFileError that names the line.
    """
    rows: list[tuple[float, ...]] = []
    for n, line in enumerate(_read(path).splitlines(), 1):
        words = line.partition("#")[0].replace(",", " ").split()
        if not words:
            continue
        try:
            row = tuple(float(word) for word in words)
        except ValueError:
            row = ()
        if len(row) != 8 or not all(abs(number) <= MOST for number in row):
            said = f"not a pose; expected eight numbers up to {MOST:g}: t tx ty tz qx qy qz qw"
            raise CameraFileError(f"{path}:{n}: {said}")
        if fault := pose_fault(row, rows[-1] if rows else None):
            raise CameraFileError(f"{path}:{n}: {fault}")
        rows.append(row)
    if not rows:
        raise CameraFileError(f"{path}: no poses; expected lines t tx ty tz qx qy qz qw")
    return tuple(rows)


def pose_fault(row: Sequence[float], before: Sequence[float] | None) -> str:
    """Say what is wrong with a row of a trajectory after another one; nothing: an empty text."""
    if before is not None and row[0] <= before[0]:
        return f"is at {row[0]:.15g} s, the pose before it at {before[0]:.15g} s; sort them, each later than the last"
    if abs(math.hypot(*row[4:]) - 1) > UNIT:
        return f"its quaternion has the length {math.hypot(*row[4:]):g}, so it is no rotation; write one of length 1"
    return ""


def _read(name: str) -> str:
    path = location(name)
    try:
        if what := irregular(path):
            raise CameraFileError(f"{name}: {what}; name a file")
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
        if len(raw) > MAX_BYTES:
            raise CameraFileError(f"{name}: larger than {MAX_BYTES >> 20} MiB; name a calibration or a trajectory")
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise CameraFileError(f"{name}: not UTF-8; name a text file") from None
    except (OSError, ValueError) as error:
        said = error.strerror if isinstance(error, OSError) and error.strerror else "not a path"
        raise CameraFileError(f"{name}: {said.lower()}") from None


def _parse(path: str, text: str) -> Mapping[str, Any]:
    """Parse YAML, XML or JSON into a mapping."""
    try:
        data = _xml(text) if text.lstrip().startswith("<") else _yaml(text)
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        RecursionError,
        SyntaxError,
        ValueError,
        yaml.YAMLError,
    ) as error:
        mark = getattr(error, "problem_mark", None)
        where = f":{mark.line + 1}" if mark else ""
        raise CameraFileError(f"{path}{where}: neither YAML, XML nor JSON; name a calibration") from None
    if not isinstance(data, dict):
        raise CameraFileError(f"{path}: has no keys; expected camera_matrix and distortion_coefficients")
    return data


class _Loader(yaml.SafeLoader):
    """Reads OpenCV's matrices as mappings."""


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    return loader.construct_mapping(node, deep=True)


_Loader.add_constructor("tag:yaml.org,2002:opencv-matrix", _mapping)


def _yaml(text: str) -> Any:
    """Read YAML or JSON, also with OpenCV's first line, which is not YAML."""
    if text.lstrip().startswith("{"):
        return json.loads(text)
    if text.startswith("%YAML"):
        text = "\n" + text.partition("\n")[2]
    # Aliases of aliases take any time, and no calibration has one.
    if any(isinstance(event, yaml.AliasEvent) for event in yaml.parse(text)):
        raise ValueError
    # What ROS prints of a topic is a document for each message, and all are alike.
    return next(yaml.load_all(text, _Loader), None)


def _xml(text: str) -> dict[str, Any]:
    """Read OpenCV's XML: matrices have `data`, numbers are text."""
    from xml.etree import ElementTree

    # Without declarations there are no entities, which could be expanded to any size.
    if "<!" in text.replace("<!--", ""):
        raise ValueError
    found: dict[str, Any] = {}
    for element in ElementTree.fromstring(text):
        data = element.find("data")
        words = (element.text or "") if data is None else (data.text or "")
        found[element.tag] = words.strip() if data is None else {"data": words.split()}
    return found


def _numbers(path: str, data: Mapping[str, Any], names: Sequence[str], *, required: bool = True) -> list[float]:
    """Find numbers, or the data of a matrix, under one of some names."""
    name = next((name for name in names if name in data), None)
    if name is None:
        if required:
            raise CameraFileError(f"{path}: has no {names[0]}; name a calibration of OpenCV, ROS or STIR")
        return []
    value = data[name]
    value = value.get("data") if isinstance(value, dict) else value
    flat = _flat(value)
    try:
        numbers = [float(one) for one in flat]
    except (TypeError, ValueError, OverflowError):
        numbers = [math.nan]
    # Written so that NaN is found too.
    if not all(abs(number) <= LARGEST for number in numbers):
        raise CameraFileError(f"{path}: {name}: not numbers up to {LARGEST:g}; write them as OpenCV does")
    return numbers


def _flat(value: Any) -> list[Any]:
    return [one for item in value for one in _flat(item)] if isinstance(value, list) else [value]
