"""Calibrations by OpenCV (YAML, XML, JSON) and ROS (camera_info), of one camera, in the spellings of many scripts."""

from __future__ import annotations

import re
from collections.abc import Sequence

from taichi_msm.camera_files.calibration import LENSES, REMEDY, Calibration, CalibrationReader, build, lens_model
from taichi_msm.camera_files.keys import Keys, fold, listed
from taichi_msm.camera_files.text import CameraFile

# Spellings of a key, reduced to lower-case letters and digits.
_PICTURE = "(image|img|picture|frame|camera|cam)"
MATRIX = (
    r"mtx|[km]|kmat(rix)?|intrinsics?(mat|matrix)?(mtx)?|"
    r"(camera|cam|calibration)(mat|matrix|mtx|k|intrinsics?)(mtx|matrix)?"
)
COEFFICIENTS = (
    r"(camera|cam|lens)?(d|dist|distort|distortion)"
    r"(s|coeff?s?|coefficients?|params?|parameters?|vec|vector|mat|matrix|values)?"
)
WIDTH, HEIGHT = f"{_PICTURE}?(width|w)", f"{_PICTURE}?(height|h)"
SIZE = f"{_PICTURE}?(size|resolution|res|dims?)"
LENS = r"(camera|cam|lens|distortion|dist|projection|calibration|calib)?(model|type)(name|type)?|lens|projection"
LENS_OR_DEVICE = r"lens|type|projection"
FISHEYE = r"(is|use)?fisheye(model)?"
FLAGS = {**dict.fromkeys(("1", "true", "yes", "on"), True), **dict.fromkeys(("0", "false", "no", "off"), False)}

# Keys that are not read but change the projection, unless they are empty or 0.
UNSUPPORTED = (
    r".*(distort(?!ed)|distorsion|coef|radial|tangential|prism|fisheye|omni|mirror|polynom|skew).*|kc|[kps][1-6]|"
    rf"(?!new|opt).*(cameramat|intrinsic).*|{_PICTURE}?(shape|dimensions?)|"
    rf"{_PICTURE}(size|resolution|width|height).*|alpha|beta|lambda|(lens|dist).*model.*|"
    r"binning|scale(factor)?|undistort(ed)?|rectified|roi|crop(ped)?"
)


class OpenCV(CalibrationReader):
    """Reader of the keys of one camera."""

    name = "OpenCV, ROS"
    recognised_by = "a matrix `camera_matrix`, `K`, `mtx`, ..., with `distortion_coefficients`, `D`, `dist`, ..."

    def recognises(self, file: CameraFile) -> bool:
        """Return whether the file has keys."""
        return bool(file.data)

    def cameras(self, file: CameraFile) -> Sequence[Keys]:
        """Return all keys as those of the only camera."""
        return [Keys(file, file.data)]

    def read(self, keys: Keys) -> Calibration:
        """Read the keys of a camera."""
        file = keys.file
        matrix, values = keys.numbers(MATRIX), keys.numbers(COEFFICIENTS)
        if matrix is None:
            raise file.fault(f"has no camera matrix that is known; found {keys}; {REMEDY}")
        if len(matrix) != 9 or [matrix[n] for n in (1, 3, 6, 7, 8)] != [0, 0, 0, 0, 1] or min(matrix[::4]) <= 0:
            raise file.fault("its camera matrix is not [fx, 0, cx, 0, fy, cy, 0, 0, 1]; write it like that")
        xi = keys.numbers("xi") or []
        model = _model(keys, values or (), has_xi=any(xi))
        size = _size(keys)
        if values is None and model != "none":
            fault = "has a camera matrix, and no distortion that is known"
            remedy = "write distortion_coefficients, [0, 0, 0, 0] where there is none"
            raise file.fault(f"{fault}; found {keys}; {remedy}")
        values = [*xi, *(values or ())] if model == "omnidir" else values or []
        model = "pinhole" if model == "none" else model
        calibration = build(file, (matrix[0], matrix[4], matrix[2], matrix[5]), size, model, values)
        _check_no_unread_keys(keys)
        return calibration


def _model(keys: Keys, values: Sequence[float], *, has_xi: bool) -> str:
    """Return the lens model, or "none" where the file states that; all names of models in the file must agree."""
    sources: dict[str, str] = {}  # names of keys by their models
    for name, value in keys.values(LENS).items():
        if re.fullmatch(LENS_OR_DEVICE, fold(name)) and fold(value) not in LENSES:
            continue  # The name of a device.
        if model := lens_model(keys.file, name, value, values):
            sources[model] = name
    for name, value in keys.values(FISHEYE).items():
        if (flag := fold(value)) not in FLAGS:
            raise keys.file.fault(f"{name}: {value} is neither true nor false")
        sources["fisheye" if FLAGS[flag] else "pinhole"] = name
    if has_xi:
        sources = {**sources, "omnidir": "xi"}
        sources.pop("pinhole", None)  # The distortion of the omnidirectional model.
    if len(sources) > 1:
        (one, first), (other, second), *_ = sources.items()
        raise keys.file.fault(f"{first} is {one}, {second} is {other}; keep the right one")
    return next(iter(sources), "pinhole")


def _size(keys: Keys) -> list[float] | None:
    """Return the width and height of the pictures [px], or None if the file does not contain them."""
    width, height, both = (keys.numbers(spelling) for spelling in (WIDTH, HEIGHT, SIZE))
    if bool(width) != bool(height):
        fault = f"has only one of image_width and image_height; found {keys}; write both"
        raise keys.file.fault(fault)
    sizes = [width + height] if width and height else []
    sizes += [both] if both else []
    if any(len(size) != 2 or size != sizes[0] for size in sizes):
        text = " and ".join(f"[{', '.join(f'{number:g}' for number in size)}]" for size in sizes)
        raise keys.file.fault(f"its size is {text}; write one [width, height] of the pictures")
    size = sizes[0] if sizes else None
    # ROS may bin or crop pictures, while its camera matrix remains that of the full picture.
    regions = keys.values("roi", dict).values()
    is_cropped = any(region.get(name) for region in regions for name in ("x_offset", "y_offset"))
    is_cropped |= any(region.get("width") not in (None, 0, *(size or ())[:1]) for region in regions)
    if is_cropped or any(value not in (0, 1) for value in keys.values("binning[xy]").values()):
        fault = "of pictures that are binned or cut, while its camera matrix is of whole ones"
        raise keys.file.fault(f"{fault}; write that of the pictures, without binning_x, binning_y and roi")
    return size


def _check_no_unread_keys(keys: Keys) -> None:
    """Raise a CameraFileError if an unread key changes the projection."""
    if names := keys.unread(UNSUPPORTED):
        fault = f"{listed(names)}: not understood, and may change what the camera sees"
        remedy = f"{REMEDY}, or remove what does not matter"
        raise keys.file.fault(f"{fault}; found {keys}; {remedy}")
