"""Readers of camera calibrations and trajectories from other programs.

Formats of calibrations: OpenCV's FileStorage in YAML, XML or JSON (camera_matrix, distortion_coefficients, image_width,
image_height); ROS's camera_info in YAML; calib.json of the STIR data set, of which the left camera is read. Keys may
have any of the spellings that are common in scripts.

Formats of trajectories: TUM's, with a pose per line, t tx ty tz qx qy qz qw, from the camera to the world; or columns
in the order of a header, as in EuRoC and TUM-VI.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import zip_longest
from typing import Any, NamedTuple

import yaml

from taichi_msm.images import actual_path, irregular_kind
from taichi_msm.scene.section import MAX_MAGNITUDE, truncate

# Limit of the size of a file.
MAX_BYTES = 2**22

# Spellings of a key, reduced to lower-case letters and digits.
MATRIX = re.compile(
    r"leftcameramat|mtx|[km]|kmat(rix)?|intrinsics?|(camera|cam|intrinsics?|calibration)(mat|matrix|mtx|k|intrinsics?)"
)
COEFFICIENTS = re.compile(
    r"leftdistortioncoeffs|"
    r"(camera|cam|lens)?(d|dist|distort|distortion)(s|coeff?s?|coefficients?|params?|parameters?|vec|vector|mat|matrix|values)?"
)
WIDTH, HEIGHT = (re.compile(rf"(image|img|picture|frame|camera|cam)?{side}") for side in ("(width|w)", "(height|h)"))
SIZE = re.compile(r"(image|img|picture|frame|camera|cam)?(size|resolution|res|dims?)")
LENS = re.compile(
    r"(camera|cam|lens|distortion|dist|projection|calibration|calib)?(model|type)(name|type)?|lens|projection"
)
LENS_OR_DEVICE = re.compile(r"lens|type|projection")
FISHEYE = re.compile(r"(is|use)?fisheye(model)?")
XI = re.compile(r"xi")
ROI = re.compile(r"roi")

# Keys that are not read but change the projection, unless they are empty or 0.
UNSUPPORTED_KEYS = re.compile(
    r"(?!right(cameramat|distortioncoeffs)$).*(distort(?!ed)|distorsion|coef|radial|tangential|prism|fisheye|omni|mirror|polynom|skew).*|kc|[kps][1-6]|"
    r"(?!new|opt|right).*(cameramat|intrinsic).*|(image|img|picture|frame|camera|cam)?(shape|dimensions?)|"
    r"(image|img|picture|frame|camera|cam)(size|resolution|width|height).*|alpha|beta|lambda|(lens|dist).*model.*|"
    r"binning|scale(factor)?|undistort(ed)?|rectified|roi|crop(ped)?"
)

# Whether a lens model, by its reduced name, is OpenCV's fisheye; None for names of both models.
MODELS = {
    **dict.fromkeys(("pinhole", "perspective", "mono", "monocular"), None),
    **dict.fromkeys(("plumbbob", "rationalpolynomial", "rational", "radtan", "radialtangential", "opencv"), False),
    **dict.fromkeys(("equidistant", "equi", "fisheye", "opencvfisheye", "kannalabrandt", "kannalabrandt4"), True),
}
FLAGS = {**dict.fromkeys(("1", "true", "yes", "on"), True), **dict.fromkeys(("0", "false", "no", "off"), False)}
NO_DISTORTION = ("none", "nodistortion", "undistorted")

# Numbers of coefficients that OpenCV writes. Those after the first 8 are not supported and must be 0.
COEFFICIENT_COUNTS, SUPPORTED_COEFFICIENTS = (0, 4, 5, 8, 12, 14), 8

# Largest number in a calibration, and smallest focal length [px].
MAX_NUMBER, MIN_FOCAL_LENGTH_PX = 1e6, 1e-3

# Largest relative difference of equal numbers that are rounded to different numbers of digits.
ROUNDING_TOLERANCE = 1e-6

# Limits of nesting and of the number of YAML events. Matrices are nested two or three deep.
MAX_DEPTH, MAX_VALUES = 20, 200_000

# Spellings of the keys of the first camera of a stereo pair.
LEFT_CAMERA = re.compile(r"left(.*)|(.*)(1|l|left)")

# Largest deviation from 1 of the norm of a quaternion.
NORM_TOLERANCE = 1e-3

_REMEDY = "write camera_matrix: [fx, 0, cx, 0, fy, cy, 0, 0, 1], distortion_coefficients: [k1, k2, p1, p2]"


class RepeatedError(Exception):
    """A key occurs twice."""


class CameraFileError(Exception):
    """The file cannot be used; the message contains its name, the reason and the remedy."""


class StereoPose(NamedTuple):
    """Pose of the right camera of a stereo pair: X_right = rotation X_left + translation.

    Attributes:
        rotation: rows of the matrix.
        translation: vector [m].
    """

    rotation: tuple[tuple[float, ...], ...]
    translation: tuple[float, ...]


class Calibration(NamedTuple):
    """Calibration of a camera, in OpenCV's conventions.

    Attributes:
        focal: focal lengths fx, fy [px].
        centre: principal point cx, cy [px]; the centre of the first pixel is at (0, 0).
        fisheye: whether the distortion is OpenCV's fisheye model, rather than its rational model.
        coefficients: distortion coefficients in OpenCV's order: k1, k2, p1, p2, k3, k4, k5, k6, of a fisheye k1 to k4;
            trailing ones may be missing.
        size: width and height of the pictures [px]; None if the file does not contain them.
        right: pose of the right camera of a stereo pair, where that was asked for.
    """

    focal: tuple[float, float]
    centre: tuple[float, float]
    fisheye: bool
    coefficients: tuple[float, ...]
    size: tuple[int, int] | None
    right: StereoPose | None = None


def read_calibration(path: str) -> Calibration:
    """Read a calibration file; raise a CameraFileError if it is invalid or not supported."""
    keys = _Keys(path, _parse(path, _read(path)))
    matrix, values = keys.numbers(MATRIX), keys.numbers(COEFFICIENTS)
    if matrix is None:
        raise CameraFileError(f"{path}: {_describe_unsupported(keys.data)}; {_REMEDY}")
    if len(matrix) != 9 or [matrix[n] for n in (1, 3, 6, 7, 8)] != [0, 0, 0, 0, 1] or min(matrix[0], matrix[4]) <= 0:
        raise CameraFileError(f"{path}: its camera matrix is not [fx, 0, cx, 0, fy, cy, 0, 0, 1]; write it like that")
    if (focal := min(matrix[0], matrix[4])) < MIN_FOCAL_LENGTH_PX:
        remedy = f"write it in pixels, {MIN_FOCAL_LENGTH_PX:g} or more"
        raise CameraFileError(f"{path}: its focal length is {focal:g}; {remedy}")
    fisheye = _is_fisheye(keys, values)
    size = _size(keys)
    values = [] if values is None and keys.has_no_distortion else values
    if values is None:
        fault = "has a camera matrix, and no distortion that is known"
        remedy = "write distortion_coefficients, [0, 0, 0, 0] where there is none"
        raise CameraFileError(f"{path}: {fault}; found {keys.names}; {remedy}")
    if len(values) not in ((4,) if fisheye else COEFFICIENT_COUNTS):
        expected = "4 of a fisheye: k1, k2, k3, k4" if fisheye else "4, 5, 8, 12 or 14: k1, k2, p1, p2, k3, ..."
        raise CameraFileError(f"{path}: {len(values)} distortion coefficients; expected {expected}")
    if any(others := values[SUPPORTED_COEFFICIENTS:]):
        number = 1 + SUPPORTED_COEFFICIENTS + next(n for n, value in enumerate(others) if value)
        fault = f"distortion coefficient {number} is not 0"
        raise CameraFileError(f"{path}: {fault}; thin prisms and tilted sensors are not modelled, calibrate without")
    keys.check_no_unread_keys()
    coefficients = tuple(values[:SUPPORTED_COEFFICIENTS])
    return Calibration((matrix[0], matrix[4]), (matrix[2], matrix[5]), fisheye, coefficients, size)


def _is_fisheye(keys: _Keys, values: Sequence[float] | None) -> bool:
    """Return whether the lens model is OpenCV's fisheye; the names of models in the file must agree."""
    sources: dict[bool, str] = {}  # names of the keys for a fisheye (True) and for another model (False)
    for name, value in keys.values(LENS).items():
        model = _folded(value)
        if LENS_OR_DEVICE.fullmatch(_folded(name)) and model not in MODELS:
            continue  # The name of a device.
        if model in NO_DISTORTION and not any(values or ()):
            keys.has_no_distortion = True
        elif model not in MODELS:
            known = "plumb_bob, radtan, rational_polynomial, equidistant, fisheye, or none without coefficients"
            raise CameraFileError(f"{keys.path}: {name}: {truncate(str(value))} is not known; expected one of: {known}")
        elif (fisheye := MODELS[model]) is not None:
            sources[fisheye] = name
    for name, value in keys.values(FISHEYE).items():
        if (flag := _folded(value)) not in FLAGS:
            raise CameraFileError(f"{keys.path}: {name}: {truncate(str(value))} is neither true nor false")
        sources[FLAGS[flag]] = name
    if len(sources) > 1:
        fault = f"{sources[True]} is a fisheye's, {sources[False]} is not"
        raise CameraFileError(f"{keys.path}: {fault}; keep the right one")
    if any(keys.numbers(XI) or ()):
        fault = "xi: of OpenCV's omnidirectional model, which is not read"
        raise CameraFileError(f"{keys.path}: {fault}; calibrate with cv2.fisheye")
    return True in sources


def _size(keys: _Keys) -> tuple[int, int] | None:
    """Return the width and height of the pictures [px], or None if the file does not contain them."""
    width, height, both = (keys.numbers(spelling) for spelling in (WIDTH, HEIGHT, SIZE))
    if bool(width) != bool(height):
        fault = f"has only one of image_width and image_height; found {keys.names}; write both"
        raise CameraFileError(f"{keys.path}: {fault}")
    sizes = [width + height] if width and height else []
    sizes += [both] if both else []
    if any(len(size) != 2 or size != sizes[0] for size in sizes):
        listed = " and ".join(f"[{', '.join(f'{number:g}' for number in size)}]" for size in sizes)
        raise CameraFileError(f"{keys.path}: its size is {listed}; write one [width, height] of the pictures")
    size = (round(sizes[0][0]), round(sizes[0][1])) if sizes else None
    if size is not None and min(size) < 1:
        remedy = "write the size of those that were calibrated with"
        raise CameraFileError(f"{keys.path}: of pictures of {size[0]} x {size[1]} pixels; {remedy}")
    # ROS may bin or crop pictures, while its camera matrix remains that of the full picture.
    data = {_folded(name): value for name, value in keys.data.items()}
    region = keys.read_mapping(ROI)
    is_cropped = any(region.get(name) for name in ("x_offset", "y_offset"))
    is_cropped |= region.get("width") not in (None, 0, *(size or ())[:1])
    if is_cropped or any(data.get(name) not in (None, 0, 1) for name in ("binningx", "binningy")):
        fault = "of pictures that are binned or cut, while its camera matrix is of whole ones"
        remedy = "write that of the pictures, without binning_x, binning_y and roi"
        raise CameraFileError(f"{keys.path}: {fault}; {remedy}")
    return size


class _Keys:
    """Keys of a calibration file, which are looked up by any of their spellings.

    Attributes:
        path: path of the file.
        data: content of the file.
        has_no_distortion: whether the file states that there is no distortion.
    """

    def __init__(self, path: str, data: Mapping[str, Any]) -> None:
        self.path = path
        self.data = data
        self.has_no_distortion = False
        self._read_names: set[str] = set()

    @property
    def names(self) -> str:
        """Names of the keys, for messages."""
        return _listed(self.data)

    def values(self, spelling: re.Pattern[str]) -> dict[str, Any]:
        """Return the values, by name, of the keys whose names match a spelling, without empty values."""
        matches = {name: value for name, value in self.data.items() if spelling.fullmatch(_folded(name))}
        self._read_names |= matches.keys()
        return {name: value for name, value in matches.items() if value is not None and value != ""}

    def numbers(self, spelling: re.Pattern[str]) -> list[float] | None:
        """Return the numbers of a key, or None if it is missing; the values of several matching keys must agree."""
        matches = [(name, _numbers(self.path, name, value)) for name, value in self.values(spelling).items()]
        if not matches:
            return None
        (first, numbers), *others = matches
        for name, values in others:
            pairs = zip_longest(numbers, values, fillvalue=0.0)
            if not all(math.isclose(a, b, rel_tol=ROUNDING_TOLERANCE) for a, b in pairs):
                raise CameraFileError(f"{self.path}: {first} and {name} are not the same; keep the right one")
        return numbers

    def read_mapping(self, spelling: re.Pattern[str]) -> Mapping[str, Any]:
        """Return the mapping of a key, or an empty one if it is missing or not a mapping."""
        matches = {name: value for name, value in self.data.items() if spelling.fullmatch(_folded(name))}
        mappings = {name: value for name, value in matches.items() if isinstance(value, dict)}
        self._read_names |= mappings.keys()
        return next(iter(mappings.values()), {})

    def check_no_unread_keys(self) -> None:
        """Raise a CameraFileError if an unread key changes the projection."""
        unread = [
            name for name in self.data if name not in self._read_names and UNSUPPORTED_KEYS.fullmatch(_folded(name))
        ]
        if names := [name for name in unread if any(_flat(self.data[name]))]:
            fault = f"{_listed(names)}: not understood, and may change what the camera sees"
            remedy = f"{_REMEDY}, or remove what does not matter"
            raise CameraFileError(f"{self.path}: {fault}; found {self.names}; {remedy}")


def _folded(name: object) -> str:
    """Reduce a name to its lower-case letters and digits."""
    return re.sub(r"[^a-z0-9]", "", str(name).lower())


def _listed(names: Sequence[str] | Mapping[str, Any]) -> str:
    """Format up to 12 names for a message."""
    shown = 12
    more = f" and {len(names) - shown} more" if len(names) > shown else ""
    return ", ".join(truncate(str(name)) for name in list(names)[:shown]) + more


def _describe_unsupported(data: Mapping[str, Any]) -> str:
    """Describe a file without a camera matrix by its format, if known, and its keys."""
    folded = {_folded(name): value for name, value in data.items()}
    inner = [{_folded(name) for name in value} for value in data.values() if isinstance(value, dict)]
    if any("intrinsics" in keys and {"cameramodel", "distortioncoeffs"} & keys for keys in inner):
        return f"a camchain of Kalibr, which is not read; found {_listed(data)}"
    left = [match for name in folded if (match := LEFT_CAMERA.fullmatch(name))]
    right = {f"right{match[1]}" for match in left if match[1]}
    right |= {f"{match[2]}{suffix}" for match in left for suffix in ("2", "r", "right")}
    if any(name in right and len(_flat(value)) == 9 for name, value in folded.items()):
        return f"of a stereo pair, as OpenCV's stereoCalibrate and SCARED, which is not read; found {_listed(data)}"
    return f"has no camera matrix that is known; found {_listed(data)}"


def read_poses(path: str) -> tuple[tuple[float, ...], ...]:
    """Read a trajectory of a camera; without a header, its columns are those of TUM's format.

    Returns:
        Rows of time [s], position x, y, z [m] and quaternion x, y, z, w, from the camera to the world.

    Raises:
        CameraFileError: when the file is invalid or not supported; the message contains the line.
    """
    rows: list[tuple[float, ...]] = []
    columns = None
    for n, line in enumerate(_read(path).splitlines(), 1):
        text, _, comment = line.strip().replace('"', "").partition("#")
        if ";" in text:
            text = text.replace(",", ".").replace(";", ",")  # Spreadsheets write this where decimals have commas.
        words = text.replace(",", " ").split()
        if (header := _header(text or comment, is_comment=not words)) and not rows:
            columns = _columns(f"{path}:{n}", header)
        elif header and _columns(f"{path}:{n}", header) != (columns or TUM):
            raise CameraFileError(f"{path}:{n}: other columns than before; write a file of one order")
        elif not words and not header and (match := OTHER_CONVENTION.search(comment)):
            fault = f"a comment has {truncate(match[0])}, which is not understood"
            raise CameraFileError(f"{path}:{n}: {fault}; name the columns in the first line: # {', '.join(ROLES)}")
        elif words:
            row = _row(f"{path}:{n}", words, columns, separated="," in text)
            if fault := pose_fault(row, rows[-1] if rows else None):
                raise CameraFileError(f"{path}:{n}: {fault}")
            rows.append(row)
    if not rows:
        raise CameraFileError(f"{path}: no poses; expected lines t tx ty tz qx qy qz qw")
    return tuple(rows)


class _Columns(NamedTuple):
    """Columns of a trajectory file.

    Attributes:
        indices: columns of t, tx, ty, tz, qx, qy, qz, qw.
        column_count: number of all columns.
        units_per_second: number of units of t in a second.
    """

    indices: tuple[int, ...]
    column_count: int
    units_per_second: float


# Limits of the lengths of a header and of a name in it.
MAX_HEADER_LENGTH, MAX_NAME_LENGTH = 2000, 80

TUM = _Columns(tuple(range(8)), 8, 1.0)

# Lower-case spellings of the names of columns, and of their units.
_POSITION = r"(t|p|pos|(.*[^a-z])?position|trans|translation|[tp][^a-z].*[^a-z])?"
_ROTATION = r"(q|quat|quaternion|(.*[^a-z])?orientation|rot|rotation|q[^a-z].*)"
ROLES = {
    "t": r"t|ts|secs?|seconds|(.*[^a-z])?time([^a-z].*)?|.*(timestamp|stamp)([^a-z].*)?",
    **{f"t{axis}": rf"{_POSITION}[^a-z]*{axis}" for axis in "xyz"},
    **{f"q{axis}": rf"{_ROTATION}[^a-z]*{axis}" for axis in "xyzw"},
}
UNIT = re.compile(r"\s*[\[(]([^\])]*)[\])]|[^a-z](m?u?n?s|nsecs?)$")
UNITS_PER_SECOND = {
    **dict.fromkeys(("", "s", "sec", "seconds"), 1.0),
    **dict.fromkeys(("ms", "milliseconds"), 1e3),
    **dict.fromkeys(("us", "\u00b5s", "\u03bcs", "microseconds"), 1e6),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanoseconds"), 1e9),
}

# Comments that state another order of the quaternion, or the inverse transform.
OTHER_CONVENTION = re.compile(
    r"\bw[\s,]*x[\s,]*y[\s,]*z\b|scalar[\s-]*first|\bq_?0\b|world[\s-]*(to|2)[\s-]*cam\w*|\bw2c\b|\bT_?cw\b",
    re.IGNORECASE,
)


def _header(text: str, *, is_comment: bool) -> list[str]:
    """Split a header into the names of columns; return an empty list for other lines."""
    text = text.rpartition(":")[2].lower()
    names = [name.strip() for name in text.split(",")] if "," in text else re.sub(r"\s+(?=[\[(])", "", text).split()
    if len(text) > MAX_HEADER_LENGTH or max(map(len, names), default=0) > MAX_NAME_LENGTH:
        return []
    bare = [UNIT.sub("", name) for name in names]
    rotations = sum(bool(re.fullmatch(rf"(.*[^a-z])?{_ROTATION}[^a-z]*[wxyz]", name)) for name in bare)
    is_table = len(names) >= 7 and ("," in text or not is_comment)
    is_header = rotations >= 4 or {*"wxyz"} <= {*bare} or is_table
    return names if is_header and not any(re.match(r"[-+.]?\d", name) for name in names) else []


def _columns(line: str, names: Sequence[str]) -> _Columns:
    """Identify the columns of a header; `line` is its file and line number, for messages."""
    bare = [UNIT.sub("", name) for name in names]
    if "image_id" in bare:
        raise CameraFileError(f"{line}: an images.txt of COLMAP, which is not read; write lines {' '.join(ROLES)}")
    matches = [[n for n, name in enumerate(bare) if re.fullmatch(role, name)] for role in ROLES.values()]
    if any(len(columns) != 1 for columns in matches):
        fault = f"columns {_listed(names)} are not understood"
        raise CameraFileError(f"{line}: {fault}; name them {', '.join(ROLES)}")
    indices = tuple(columns[0] for columns in matches)
    units = [(match[1] or match[2] or "") if (match := UNIT.search(names[n])) else "" for n in indices[:4]]
    if units[0] not in UNITS_PER_SECOND or not {*units[1:]} <= {"", "m"}:
        fault = f"{', '.join(names[n] for n in indices[:4])}: units that are not understood"
        raise CameraFileError(f"{line}: {fault}; write [s], [ms], [us] or [ns] for t, and metres, [m], for the others")
    return _Columns(indices, len(names), UNITS_PER_SECOND[units[0]])


def _row(line: str, words: Sequence[str], columns: _Columns | None, *, separated: bool) -> tuple[float, ...]:
    """Convert the words of a line to a pose; `separated` states whether commas separate them."""
    expected = columns or TUM
    try:
        numbers = [math.nan if "_" in word else float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != expected.column_count or not all(abs(number) <= MAX_MAGNITUDE for number in numbers):
        needed = f"eight numbers up to {MAX_MAGNITUDE:g}: {' '.join(ROLES)}"
        if expected.column_count != TUM.column_count:
            needed = f"{expected.column_count} numbers up to {MAX_MAGNITUDE:g}, one a column of the header"
        origin = OTHER_FORMATS.get(len(words), "") if columns is None else ""
        if columns is None and separated and len(words) != EUROC_COLUMNS:
            origin = "; numbers with decimal commas need ; between them"
        raise CameraFileError(f"{line}: not a pose{origin}; expected {needed}")
    if separated and columns is None:
        fault = "commas without a header, and w comes first in EuRoC's rows, last in TUM's"
        raise CameraFileError(f"{line}: {fault}; name the columns in a first line: # {', '.join(ROLES)}")
    row = [numbers[n] for n in expected.indices]
    return (row[0] / expected.units_per_second, *row[1:])


EUROC_COLUMNS = 17

# Endings of the message about other formats, by the number of words of a row.
OTHER_FORMATS = {
    10: ", but ten words, as in COLMAP's images.txt, which is not read",
    12: ", but twelve numbers, as KITTI's, which are not read",
    EUROC_COLUMNS: ", but 17 numbers, as EuRoC's; keep their header",
}


def pose_fault(row: Sequence[float], previous: Sequence[float] | None) -> str:
    """Check a row of a trajectory.

    Args:
        row: time [s], position [m] and quaternion.
        previous: previous row; None for the first.

    Returns:
        The fault and its remedy, or an empty text.
    """
    if previous is not None and row[0] <= previous[0]:
        times = f"is at {row[0]:.15g} s, the pose before it at {previous[0]:.15g} s"
        return f"{times}; sort them, each later than the last"
    if abs(math.hypot(*row[4:]) - 1) > NORM_TOLERANCE:
        return f"its quaternion has the length {math.hypot(*row[4:]):g}, so it is no rotation; write one of length 1"
    return ""


def _read(name: str) -> str:
    path = actual_path(name)
    try:
        if kind := irregular_kind(path):
            raise CameraFileError(f"{name}: {kind}; name a file")
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1)
        if len(raw) > MAX_BYTES:
            raise CameraFileError(f"{name}: larger than {MAX_BYTES >> 20} MiB; name a calibration or a trajectory")
        return raw.decode("utf-8-sig")
    except UnicodeDecodeError:
        raise CameraFileError(f"{name}: not UTF-8; name a text file") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "not a path"
        raise CameraFileError(f"{name}: {reason.lower()}") from None


def _parse(path: str, text: str) -> Mapping[str, Any]:
    """Parse YAML, XML or JSON into a mapping."""
    try:
        data = _xml(text) if text.lstrip().startswith("<") else _yaml(text)
    except RepeatedError as error:
        raise CameraFileError(f"{path}: {truncate(str(error))} is given twice; keep the right one") from None
    except (
        ArithmeticError,
        AttributeError,
        LookupError,
        RecursionError,
        SyntaxError,
        TypeError,
        ValueError,
        yaml.YAMLError,
    ) as error:
        if _INI.match(text):
            data = None
        else:
            mark = getattr(error, "problem_mark", None)
            line = f":{mark.line + 1}" if mark else ""
            fault = "neither YAML, XML nor JSON; name a calibration"
            if isinstance(error, yaml.constructor.ConstructorError) and str(error.problem).startswith("could not det"):
                tag = truncate(str(error.problem)).partition(" for the ")[2]
                fault = f"{tag}: not plain YAML; write numbers and lists"
            raise CameraFileError(f"{path}{line}: {fault}") from None
    if not isinstance(data, dict):
        content = "a list" if isinstance(data, list) else "no keys"
        fault = f"has {content}; expected camera_matrix and distortion_coefficients as keys"
        if _INI.match(text):
            fault = f"an ini file, which is not read; {_REMEDY}, in YAML"
        elif _COLMAP.search(text):
            fault = f"a cameras.txt of COLMAP, which is not read; {_REMEDY}, in YAML"
        raise CameraFileError(f"{path}: {fault}")
    return data


# A section of an ini file, OpenCV's directive, which is not valid YAML, both after comments and empty lines; a line of
# COLMAP.
_COMMENTS = r"((?:[ \t]*(?:[#;][^\n]*)?\r?\n)*)"
_INI = re.compile(_COMMENTS + r"[ \t]*\[[^\]\n=,]*\][ \t]*\r?\n" + _COMMENTS + r"[^\n]*=")
_DIRECTIVE = re.compile(_COMMENTS + r"%YAML[^\n]*")
_COLMAP = re.compile(r"^\d+ [A-Z_]+ \d+ \d+ [-+.\de]+ ", re.MULTILINE)


# The C parser is twenty times faster than the one in Python.
_BaseLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_BaseLoader):  # type: ignore[misc]
    """YAML loader that reads OpenCV's matrices as mappings, and rejects repeated keys."""


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    return _distinct([loader.construct_object(item, deep=True) for item in pair] for pair in node.value)


def _distinct(pairs: Iterable[Sequence[Any]]) -> dict[Any, Any]:
    """Build a mapping; raise a RepeatedError for a repeated key."""
    mapping: dict[Any, Any] = {}
    for name, value in pairs:
        if name in mapping:
            raise RepeatedError(name)
        mapping[name] = value
    return mapping


def _sequence(loader: _Loader, node: yaml.SequenceNode) -> list[Any]:
    return loader.construct_sequence(node, deep=True)


for _kind in ("opencv-matrix", "map"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _mapping)
# PyYAML's own tag of tuples.
_Loader.add_constructor("tag:yaml.org,2002:python/tuple", _sequence)


def _yaml(text: str) -> Any:
    """Parse YAML or JSON, also with OpenCV's directive in the first line, which is not valid YAML."""
    if text.lstrip().startswith("{"):
        return json.loads(text, object_pairs_hook=_distinct)
    text = _DIRECTIVE.sub(r"\1", text, count=1)
    # Nested aliases, deep nesting and very many values would take unlimited time, and no calibration has them.
    depth = 0
    for count, event in enumerate(yaml.parse(text, _BaseLoader)):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if isinstance(event, yaml.AliasEvent) or depth > MAX_DEPTH or count > MAX_VALUES:
            raise ValueError
    # The output of a ROS topic has a document for every message, all with equal content.
    return next(yaml.load_all(text, _Loader), None)


def _xml(text: str) -> dict[str, Any]:
    """Parse OpenCV's XML, in which matrices have `data` and numbers are text."""
    from xml.etree import ElementTree

    # Declarations could define entities that expand to any size.
    if "<!" in text.replace("<!--", ""):
        raise ValueError
    pairs = []
    for element in ElementTree.fromstring(text):
        data = element.find("data")
        words = (element.text or "") if data is None else (data.text or "")
        pairs.append((element.tag, words.strip() if data is None else {"data": words.split()}))
    return _distinct(pairs)


def _numbers(path: str, name: str, value: Any) -> list[float]:
    """Convert a value to numbers; `path` and `name` are for the message."""
    try:
        numbers = [math.nan if isinstance(item, bool) else float(item) for item in _flat(value)]
    except (TypeError, ValueError, OverflowError):
        numbers = [math.nan]
    if isinstance(value, dict) and "data" not in value:
        raise CameraFileError(f"{path}: {name}: has {_listed(value)}; expected a matrix with rows, cols and data")
    # The comparison is false for NaN.
    if not all(abs(number) <= MAX_NUMBER for number in numbers):
        fault = f"{truncate(str(value))} is not a list of numbers up to {MAX_NUMBER:g}"
        raise CameraFileError(f"{path}: {name}: {fault}; write it as OpenCV does")
    rows, cols = (value.get(side) if isinstance(value, dict) else None for side in ("rows", "cols"))
    if isinstance(rows, int) and isinstance(cols, int) and rows * cols != len(numbers):
        fault = f"has {len(numbers)} numbers, and {rows} rows of {cols}; write what belongs there"
        raise CameraFileError(f"{path}: {name}: {fault}")
    return numbers


def _flat(value: Any) -> list[Any]:
    """Flatten nested lists, the data of a matrix or the words of a text, up to MAX_DEPTH."""
    flat = [value["data"]] if isinstance(value, dict) and "data" in value else [value]
    for _ in range(MAX_DEPTH):
        if not any(isinstance(item, list) for item in flat):
            break
        flat = [inner for item in flat for inner in (item if isinstance(item, list) else [item])]
    return [word for item in flat for word in (item.split() if isinstance(item, str) else [item])]
