"""Calibrations of one camera by OpenCV (YAML, XML, JSON) and ROS (camera_info), with common spellings of their keys.

The readers of other formats convert to these keys.
"""

from __future__ import annotations

import math
import re
from collections.abc import Sequence
from typing import Any

from taichi_msm.camera_files.calibration import Calibration, CalibrationReader, StereoPose, focal_fault
from taichi_msm.camera_files.camera_file import CameraFile, Entries, listed
from taichi_msm.camera_files.key_lookup import ROUNDING_TOLERANCE, Keys, flat, fold
from taichi_msm.errors import truncate
from taichi_msm.lenses import MODELS

# Spellings of the keys, reduced to lower-case letters and digits; with examples.
_PICTURE = "(image|img|picture|frame|camera|cam)"
# K, mtx, camera_matrix, intrinsics
MATRIX = (
    r"mtx|[km]|cm|kmat(rix)?|intrinsics?(mat|matrix)?(mtx)?|"
    r"(camera|cam|calibration)(mat|matrix|mtx|k|intrinsics?)(mtx|matrix)?"
)
# D, dist, distortion_coefficients
COEFFICIENTS = (
    r"(camera|cam|lens)?(d|dist|distort|distortion)"
    r"(s|coeff?s?|coefficients?|params?|parameters?|vec|vector|mat|matrix|values)?"
)
# image_width, image_height, or width and height in a section image_size; image_size, resolution
WIDTH, HEIGHT = f"{_PICTURE}?(size)?(width|w)", f"{_PICTURE}?(size)?(height|h)"
SIZE = f"{_PICTURE}?(size|resolution|res|dims?)"
# distortion_model, lens_type; of these, keys whose value may also be the type of a device
LENS = r"(camera|cam|lens|distortion|dist|projection|calibration|calib)?(model|type)(name|type)?|lens|projection"
LENS_OR_DEVICE = r"lens|type|projection"
# is_fisheye
FISHEYE = r"(is|use)?fisheye(model)?"
# R, rotation_matrix; T, tvec; in a section for both cameras, such as stereo or extrinsics
_BOTH = "(stereo)?(extrinsics?|params|parameters|calib|calibration|results?)?"
ROTATION = rf"{_BOTH}(r|rot|rotation|rmat|(rot|rotation)(mat|matrix))"
TRANSLATION = rf"{_BOTH}(t|tvec|trans|translation|(trans|translation)(vec|vector|mat|matrix))"

# Other keys that could change the projection; an error unless empty or 0.
UNSUPPORTED = "|".join(
    (
        # Distortion.
        r".*(distort(?!ed)|distorsion|coef|radial|tangential|prism|fisheye|omni|mirror|polynom|skew).*",
        r"(lens|dist).*model.*|kc|[kps][1-6]|alpha|beta|lambda|tau[xy]?|tilt.*",
        # Camera matrix, but not the new or optimal one of rectified pictures.
        r"(?!new|opt|rect).*(cameramat|intrinsic).*|alphac|calibration",
        # Size and processing of the pictures.
        rf"{_PICTURE}?(shape|dimensions?)|{_PICTURE}(size|resolution|width|height).*",
        r"binning|scale(factor)?|undistort(ed)?|rectified|roi|crop(ped|[xywh])?|offset[xy]",
    )
)

# Name of a lens in files, and its model; empty for an ambiguous name.
NO_DISTORTION = "none"
LENSES = {
    **dict.fromkeys(("pinhole", "perspective", "mono", "monocular"), ""),
    **dict.fromkeys(("plumbbob", "rationalpolynomial", "rational", "radtan", "radialtangential", "opencv"), "pinhole"),
    **dict.fromkeys(("equidistant", "equi", "fisheye", "opencvfisheye", "kannalabrandt", "kannalabrandt4"), "fisheye"),
    **dict.fromkeys(("omnidir", "omnidirectional", "omni", "mei", "unified"), "omnidir"),
    **dict.fromkeys(("none", "nodistortion", "undistorted"), NO_DISTORTION),
}
# Values of FISHEYE.
FLAGS = {
    **dict.fromkeys(("1", "true", "yes", "on"), "fisheye"),
    **dict.fromkeys(("0", "false", "no", "off"), "pinhole"),
}

_REMEDY = "write camera_matrix: [fx, 0, cx, 0, fy, cy, 0, 0, 1], distortion_coefficients: [k1, k2, p1, p2]"


def build_keys(
    file: CameraFile,
    focal: Sequence[float],
    centre: Sequence[float],
    coefficients: Sequence[float],
    model: str,
    size: Sequence[Any] | None,
    line: int | None = None,
    camera: str = "",
) -> Keys:
    """Return the keys of a camera: focal lengths and centre in OpenCV's pixels, coefficients in OpenCV's order."""
    data: dict[str, Any] = {"K": [focal[0], 0, centre[0], 0, focal[1], centre[1], 0, 0, 1], "D": [*coefficients]}
    data |= {"model": model} | ({} if size is None else {"size": [*size]})
    return Keys(file, Entries(data, {} if line is None else dict.fromkeys(data, line)), camera=camera)


def read_camera(keys: Keys) -> Calibration:
    """Read a calibration from the keys of a camera."""
    file, numbers, values = keys.file, keys.numbers(MATRIX), keys.numbers(COEFFICIENTS)
    if numbers is None:
        raise file.fault(f"has no known camera matrix; found {keys}; {_REMEDY}")
    name = keys.find(MATRIX)
    matrix = numbers
    if matrix[12:] == [0, 0, 0, 1] and matrix[3:12:4] == [0, 0, 0]:  # 4 x 4, for homogeneous coordinates
        matrix = [*matrix[:3], *matrix[4:7], *matrix[8:11]]
    label = f"{name}, a 4 x 4 matrix" if len(numbers) == 16 else name
    if len(matrix) != 9 or [matrix[n] for n in (1, 3, 6, 7, 8)] != [0, 0, 0, 0, 1] or min(matrix[::4]) <= 0:
        raise keys.fault(f"{label}: is not [fx, 0, cx, 0, fy, cy, 0, 0, 1]; write the camera matrix like that", name)
    (fx, _, cx), (_, fy, cy) = matrix[:3], matrix[3:6]
    _require_agreement(keys, (fx, fy), (cx, cy))
    xi = keys.numbers("xi") or []
    model = _model(keys, values or (), has_xi=any(xi))
    if values is None and model != NO_DISTORTION:
        fault = "has a camera matrix, but no known distortion"
        remedy = "write distortion_coefficients, [0, 0, 0, 0] where there is none"
        raise file.fault(f"{fault}; found {keys}; {remedy}")
    size = _size(keys)
    if size and (fault := focal_fault((fx, fy), size)):
        raise keys.fault(f"{label}: {fault}", name)
    if names := keys.unread(UNSUPPORTED):
        fault = f"{listed(names)}: unknown, and may change the projection"
        raise keys.fault(f"{fault}; found {keys}; {_REMEDY}, or remove the keys that do not matter", names[0])
    model, values = ("pinhole", []) if model == NO_DISTORTION else (model, values or [])
    if model == "omnidir":
        if not xi:
            raise keys.fault("an omnidirectional lens without xi; add xi", keys.find(COEFFICIENTS))
        values = [*xi, *values]
    lens = _coefficients(keys, model, values)
    return Calibration((fx, fy), (cx, cy), size, model, lens)


def read_pose(keys: Keys) -> StereoPose | None:
    """Read R and T; None if the file has neither. R1 and R2 are ignored, as they belong to a rectification."""
    unmarked = {name: value for name, value in keys.data.items() if keys.folded[name] == fold(name)}
    shared = Keys(keys.file, Entries(unmarked, keys.data.lines))
    if not shared.values(ROTATION) and not shared.values(TRANSLATION):
        return None
    rotation = shared.require(ROTATION, 9, "rotation R")
    rows = tuple(tuple(rotation[n : n + 3]) for n in (0, 3, 6))
    return StereoPose(rows, tuple(shared.require(TRANSLATION, 3, "translation T")))


def read_rig_pose(keys: Keys) -> StereoPose | None:
    """Read P and R of ROS: the pose relative to the rectified axes of the left camera; None if the file lacks them.

    With P = K' [I, t] and the rectification R, X_camera = R^T (X_rectified + t).
    """
    projection, rectification = keys.numbers("p|projection(matrix)?"), keys.numbers("r|rectification(matrix)?")
    if projection is None or rectification is None or len(projection) != 12 or len(rectification) != 9:
        return None
    import numpy as np

    matrix, rotation = np.array(projection).reshape(3, 4), np.array(rectification).reshape(3, 3).T
    if not (abs(np.linalg.det(matrix[:, :3])) > 0):
        return None
    translation = rotation @ np.linalg.solve(matrix[:, :3], matrix[:, 3])
    return StereoPose(tuple(map(tuple, rotation.tolist())), tuple(translation.tolist()))


def _require_agreement(keys: Keys, focal: Sequence[float], centre: Sequence[float]) -> None:
    """Require that other keys of focal lengths and principal point agree with the camera matrix."""
    expected = {"fx": focal[:1], "fy": focal[1:], "cx": centre[:1], "cy": centre[1:]}
    # F with nine numbers is the fundamental matrix.
    is_matrix = any(len(flat(value)) > len(focal) for value in keys.values("f").values())
    expected |= {f"focal(length)?s?{'' if is_matrix else '|f'}": focal, "principalpoint|pp|centre|center": centre}
    for spelling, values in expected.items():
        numbers = keys.numbers(spelling)
        pairs = zip(numbers or (), values, strict=False)
        if not all(math.isclose(a, b, rel_tol=ROUNDING_TOLERANCE) for a, b in pairs):
            names, found = listed(keys.values(spelling)), ", ".join(f"{number:g}" for number in numbers or ())
            raise keys.fault(f"{names}: {found} differs from the camera matrix; keep one", keys.find(spelling))


def _model(keys: Keys, values: Sequence[float], *, has_xi: bool) -> str:
    """Return the lens model, or "none" for the absence of distortion; all keys of lens models must agree."""
    sources = {"omnidir": "xi"} if has_xi else {}  # for each model, a key that names it
    for name, value in keys.values(LENS).items():
        model = LENSES.get(fold(value))
        if model is None:
            if re.fullmatch(LENS_OR_DEVICE, keys.folded[name]):
                continue  # The type of a device.
            known = "plumb_bob, radtan, rational_polynomial, equidistant, fisheye, omnidir, none"
            raise keys.fault(f"{name}: {truncate(str(value))} is not supported; expected one of: {known}", name)
        if model == NO_DISTORTION and any(values):
            coefficients = ", ".join(f"{number:g}" for number in values)
            remedy = "write their model, such as plumb_bob or equidistant, or zeros"
            raise keys.fault(f"{name}: {value}, but the coefficients are not 0: {coefficients}; {remedy}", name)
        sources |= {model: name} if model else {}
    for name, value in keys.values(FISHEYE).items():
        if (flag := fold(value)) not in FLAGS:
            raise keys.fault(f"{name}: {truncate(str(value))} is neither true nor false; write one of them", name)
        sources[FLAGS[flag]] = name
    if {"omnidir", NO_DISTORTION} & sources.keys():
        sources.pop("pinhole", None)  # Files with these models may also name pinhole.
    if len(sources) > 1:
        (model, name), (model_2, name_2), *_ = sources.items()
        raise keys.fault(f"{name} is {model}, {name_2} is {model_2}; keep the right one", name_2)
    return next(iter(sources), "pinhole")


def _coefficients(keys: Keys, model: str, values: Sequence[float]) -> dict[str, float]:
    """Return the coefficients of a lens model by their names; the last ones may be missing."""
    names = tuple(MODELS[model].coefficients)
    counts, expected = [len(names)], f"those of {model}: {', '.join(names)}"
    if model == "pinhole":
        counts, expected = [0, 4, 5, 8, 12, 14], "4, 5, 8, 12 or 14: k1, k2, p1, p2, k3, ..."
    if len(values) not in counts:
        raise keys.fault(f"{len(values)} distortion coefficients; expected {expected}", keys.find(COEFFICIENTS))
    # Thin prism and tilt follow the 8 coefficients of the model.
    if others := [n for n, value in enumerate(values, 1) if n > 8 and value]:
        fault = f"distortion coefficient {others[0]} is not 0"
        remedy = "thin prisms and tilted sensors are not modelled, calibrate without"
        raise keys.fault(f"{fault}; {remedy}", keys.find(COEFFICIENTS))
    return dict(zip(names, values, strict=False))


def _size(keys: Keys) -> tuple[int, int] | None:
    """Return the width and height of the pictures [px]; None if the file has no size."""
    width, height, both = (keys.numbers(spelling) for spelling in (WIDTH, HEIGHT, SIZE))
    if bool(width) != bool(height):
        name = keys.find(WIDTH) or keys.find(HEIGHT)
        raise keys.fault(f"has only one of image_width and image_height; found {keys}; write both", name)
    sizes = [width + height] if width and height else []
    sizes += [both] if both else []
    if any(len(size) != 2 or size != sizes[0] or min(size) < 1 for size in sizes):
        text = " and ".join(f"[{', '.join(f'{number:g}' for number in size)}]" for size in sizes)
        name = keys.find(SIZE) or keys.find(WIDTH)
        raise keys.fault(f"its size is {text}; write one [width, height] of the pictures", name)
    size = (round(sizes[0][0]), round(sizes[0][1])) if sizes else None
    # In ROS, pictures may be binned or cropped, and the camera matrix is that of the full picture.
    regions = keys.values("roi", dict)
    faults = [name for name, value in keys.values("binning[xy]").items() if value not in (0, 1)]
    for name, region in regions.items():
        is_narrower = region.get("width") not in (None, 0, *(size or ())[:1])
        if is_narrower or any(region.get(offset) for offset in ("x_offset", "y_offset")):
            faults.append(name)
    if faults:
        fault = f"{listed(faults)}: pictures are binned or cropped, and the camera matrix is that of full pictures"
        remedy = "write the matrix of the binned or cropped ones, and remove binning_x, binning_y and roi"
        raise keys.fault(f"{fault}; {remedy}", faults[0])
    return size


OPENCV = CalibrationReader(
    "OpenCV, ROS",
    "a matrix `camera_matrix`, `K`, `mtx`, ..., with `distortion_coefficients`, `D`, `dist`, ...",
    ("calibration: camera.yaml",),
    lambda file: [Keys(file, file.data)],
    read_camera,
    read_pose,
    read_rig_pose,
)
