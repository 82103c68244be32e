"""Calibrations and trajectories of cameras, as other programs write them.

Calibrations: OpenCV's FileStorage in YAML, XML or JSON (camera_matrix, distortion_coefficients, image_width,
image_height); ROS's camera_info in YAML; the calib.json of the STIR data set, of which the left camera is taken. Keys
may be spelled as scripts spell them. Trajectories: TUM's format, a line a pose: t tx ty tz qx qy qz qw, from the camera
to the world; or columns in the order of a header, as EuRoC and TUM-VI write them.
"""

from __future__ import annotations

import json
import math
import re
from collections.abc import Iterable, Mapping, Sequence
from itertools import zip_longest
from typing import Any, NamedTuple

import yaml

from taichi_msm.images import irregular, location
from taichi_msm.scene.section import LARGEST as MOST
from taichi_msm.scene.section import cut

MAX_BYTES = 2**22

# The spellings of a key, in lower case and without anything but letters and digits.
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
LENS_ALONE = re.compile(r"lens|type|projection")
FISHEYE = re.compile(r"(is|use)?fisheye(model)?")
XI = re.compile(r"xi")
ROI = re.compile(r"roi")

# Other keys that would change what a camera sees, unless they are empty or 0.
BEARING = re.compile(
    r"(?!right(cameramat|distortioncoeffs)$).*(distort(?!ed)|distorsion|coef|radial|tangential|prism|fisheye|omni|mirror|polynom|skew).*|kc|[kps][1-6]|"
    r"(?!new|opt|right).*(cameramat|intrinsic).*|(image|img|picture|frame|camera|cam)?(shape|dimensions?)|"
    r"(image|img|picture|frame|camera|cam)(size|resolution|width|height).*|alpha|beta|lambda|(lens|dist).*model.*|"
    r"binning|scale(factor)?|undistort(ed)?|rectified|roi|crop(ped)?"
)

# Names of models of lenses, spelled like keys: whether the lens is OpenCV's fisheye; None: they do not tell.
MODELS = {
    **dict.fromkeys(("pinhole", "perspective", "mono", "monocular"), None),
    **dict.fromkeys(("plumbbob", "rationalpolynomial", "rational", "radtan", "radialtangential", "opencv"), False),
    **dict.fromkeys(("equidistant", "equi", "fisheye", "opencvfisheye", "kannalabrandt", "kannalabrandt4"), True),
}
FLAGS = {**dict.fromkeys(("1", "true", "yes", "on"), True), **dict.fromkeys(("0", "false", "no", "off"), False)}
UNBENT = ("none", "nodistortion", "undistorted")

# OpenCV's numbers of coefficients: only the first of them are known here, the others must be 0.
COUNTS, KNOWN = (0, 4, 5, 8, 12, 14), 8

# No number of a calibration is larger, and no focal length smaller [px].
LARGEST, SHORTEST = 1e6, 1e-3

# Numbers that differ by less than this share are one, written with more and fewer digits.
SAME = 1e-6

# Matrices are nested two deep, in mappings three; deeper ones take any time to read.
MAX_DEPTH, MAX_VALUES = 20, 200_000

# Endings of the keys of two cameras, and how many names of keys an error shows.
PAIRS, SHOWN_NAMES = re.compile(r"left(.*)|(.*)(1|l|left)"), 12

# Quaternions whose length is farther from 1 are no rotations.
UNIT = 1e-3

_REMEDY = "write camera_matrix: [fx, 0, cx, 0, fy, cy, 0, 0, 1], distortion_coefficients: [k1, k2, p1, p2]"


class RepeatedError(Exception):
    """A key that is given twice."""


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
    keys = _Keys(path, _parse(path, _read(path)))
    matrix, values = keys.numbers(MATRIX), keys.numbers(COEFFICIENTS)
    if matrix is None:
        raise CameraFileError(f"{path}: {_foreign(keys.data)}; {_REMEDY}")
    if len(matrix) != 9 or [matrix[n] for n in (1, 3, 6, 7, 8)] != [0, 0, 0, 0, 1] or min(matrix[0], matrix[4]) <= 0:
        raise CameraFileError(f"{path}: its camera matrix is not [fx, 0, cx, 0, fy, cy, 0, 0, 1]; write it like that")
    if (shortest := min(matrix[0], matrix[4])) < SHORTEST:
        raise CameraFileError(f"{path}: its focal length is {shortest:g}; write it in pixels, {SHORTEST:g} or more")
    fisheye = _is_fisheye(keys, values)
    size = _size(keys)
    values = [] if values is None and keys.has_no_distortion else values
    if values is None:
        said = "has a camera matrix, and no distortion that is known"
        remedy = "write distortion_coefficients, [0, 0, 0, 0] where there is none"
        raise CameraFileError(f"{path}: {said}; found {keys.found}; {remedy}")
    if len(values) not in ((4,) if fisheye else COUNTS):
        expected = "4 of a fisheye: k1, k2, k3, k4" if fisheye else "4, 5, 8, 12 or 14: k1, k2, p1, p2, k3, ..."
        raise CameraFileError(f"{path}: {len(values)} distortion coefficients; expected {expected}")
    if any(values[KNOWN:]):
        said = f"distortion coefficient {1 + next(n for n in range(KNOWN, len(values)) if values[n])} is not 0"
        raise CameraFileError(f"{path}: {said}; thin prisms and tilted sensors are not modelled, calibrate without")
    keys.require_all_understood()
    return Calibration((matrix[0], matrix[4]), (matrix[2], matrix[5]), fisheye, tuple(values[:KNOWN]), size)


def _is_fisheye(keys: _Keys, values: Sequence[float] | None) -> bool:
    """Return whether the lens is OpenCV's fisheye, by what the file says of its model."""
    said: dict[bool, str] = {}
    for name, value in keys.named(LENS).items():
        model = _folded(value)
        if LENS_ALONE.fullmatch(_folded(name)) and model not in MODELS:
            continue  # Of the device.
        if model in UNBENT and not any(values or ()):
            keys.has_no_distortion = True
        elif model not in MODELS:
            known = "plumb_bob, radtan, rational_polynomial, equidistant, fisheye, or none without coefficients"
            raise CameraFileError(f"{keys.path}: {name}: {cut(str(value))} is not known; expected one of: {known}")
        elif (fisheye := MODELS[model]) is not None:
            said[fisheye] = name
    for name, value in keys.named(FISHEYE).items():
        if (flag := _folded(value)) not in FLAGS:
            raise CameraFileError(f"{keys.path}: {name}: {cut(str(value))} is neither true nor false")
        said[FLAGS[flag]] = name
    if len(said) > 1:
        raise CameraFileError(f"{keys.path}: {said[True]} is a fisheye's, {said[False]} is not; keep the right one")
    if any(keys.numbers(XI) or ()):
        why = "xi: of OpenCV's omnidirectional model, which is not read; calibrate with cv2.fisheye"
        raise CameraFileError(f"{keys.path}: {why}")
    return True in said


def _size(keys: _Keys) -> tuple[int, int] | None:
    """Find the width and height of the pictures [px]; None: the file has none."""
    width, height, both = (keys.numbers(spelling) for spelling in (WIDTH, HEIGHT, SIZE))
    if bool(width) != bool(height):
        said = f"has only one of image_width and image_height; found {keys.found}; write both"
        raise CameraFileError(f"{keys.path}: {said}")
    sizes = [width + height] if width and height else []
    sizes += [both] if both else []
    if any(len(size) != 2 or size != sizes[0] for size in sizes):
        said = " and ".join(f"[{', '.join(f'{number:g}' for number in size)}]" for size in sizes)
        raise CameraFileError(f"{keys.path}: its size is {said}; write one [width, height] of the pictures")
    size = (round(sizes[0][0]), round(sizes[0][1])) if sizes else None
    if size is not None and min(size) < 1:
        said = f"of pictures of {size[0]} x {size[1]} pixels; write the size of those that were calibrated with"
        raise CameraFileError(f"{keys.path}: {said}")
    # ROS lets pictures be smaller than those that its camera matrix is of.
    data = {_folded(name): value for name, value in keys.data.items()}
    region = keys.read_mapping(ROI)
    cut_out = any(region.get(name) for name in ("x_offset", "y_offset"))
    cut_out |= region.get("width") not in (None, 0, *(size or ())[:1])
    if cut_out or any(data.get(name) not in (None, 0, 1) for name in ("binningx", "binningy")):
        said = "of pictures that are binned or cut, while its camera matrix is of whole ones"
        raise CameraFileError(f"{keys.path}: {said}; write that of the pictures, without binning_x, binning_y and roi")
    return size


class _Keys:
    """The keys of a calibration, found by any of their spellings."""

    def __init__(self, path: str, data: Mapping[str, Any]) -> None:
        self.path = path
        self.data = data
        self.has_no_distortion = False
        self._understood: set[str] = set()

    @property
    def found(self) -> str:
        """The names of the keys."""
        return _listed(self.data)

    def named(self, spelling: re.Pattern[str]) -> dict[str, Any]:
        """Find the values whose keys have a spelling, by their names."""
        found = {name: each for name, each in self.data.items() if spelling.fullmatch(_folded(name))}
        self._understood |= found.keys()
        return {name: each for name, each in found.items() if each is not None and each != ""}

    def numbers(self, spelling: re.Pattern[str]) -> list[float] | None:
        """Find the numbers whose key has a spelling; None: there is none. Spelled twice, they must agree."""
        found = [(name, _numbers(self.path, name, value)) for name, value in self.named(spelling).items()]
        if not found:
            return None
        (first, numbers), *others = found
        for other, again in others:
            if not all(math.isclose(a, b, rel_tol=SAME) for a, b in zip_longest(numbers, again, fillvalue=0.0)):
                raise CameraFileError(f"{self.path}: {first} and {other} are not the same; keep the right one")
        return numbers

    def read_mapping(self, spelling: re.Pattern[str]) -> Mapping[str, Any]:
        """Find the mapping whose key has a spelling; empty: there is none, and anything else is not understood."""
        found = {name: each for name, each in self.data.items() if spelling.fullmatch(_folded(name))}
        mappings = {name: each for name, each in found.items() if isinstance(each, dict)}
        self._understood |= mappings.keys()
        return next(iter(mappings.values()), {})

    def require_all_understood(self) -> None:
        """Make sure that no other key changes what the camera sees."""
        names = [name for name in self.data.keys() - self._understood if BEARING.fullmatch(_folded(name))]
        if names := [name for name in self.data if name in names and any(_flat(self.data[name]))]:
            said = f"{_listed(names)}: not understood, and may change what the camera sees"
            raise CameraFileError(f"{self.path}: {said}; found {self.found}; {_REMEDY}, or remove what does not matter")


def _folded(name: object) -> str:
    """Spell a name with small letters and digits alone."""
    return re.sub(r"[^a-z0-9]", "", str(name).lower())


def _listed(names: Sequence[str] | Mapping[str, Any]) -> str:
    """List names, the first ones of many."""
    more = f" and {len(names) - SHOWN_NAMES} more" if len(names) > SHOWN_NAMES else ""
    return ", ".join(cut(str(name)) for name in list(names)[:SHOWN_NAMES]) + more


def _foreign(data: Mapping[str, Any]) -> str:
    """Describe a mapping without a camera matrix by the program that writes such files, and list its keys."""
    folded = {_folded(name): value for name, value in data.items()}
    inner = [{_folded(name) for name in value} for value in data.values() if isinstance(value, dict)]
    if any("intrinsics" in keys and {"cameramodel", "distortioncoeffs"} & keys for keys in inner):
        return f"a camchain of Kalibr, which is not read; found {_listed(data)}"
    others = {f"right{stem}" for name in folded if (found := PAIRS.fullmatch(name)) and (stem := found[1])}
    others |= {f"{found[2]}{end}" for name in folded if (found := PAIRS.fullmatch(name)) for end in ("2", "r", "right")}
    if any(name in others and len(_flat(value)) == 9 for name, value in folded.items()):
        return f"of a stereo pair, as OpenCV's stereoCalibrate and SCARED, which is not read; found {_listed(data)}"
    return f"has no camera matrix that is known; found {_listed(data)}"


def read_poses(path: str) -> tuple[tuple[float, ...], ...]:
    """Read a trajectory: rows of t [s], the camera's place [m] and its rotation, a quaternion x, y, z, w.

    A header tells which columns these are, else they are TUM's. Raises a CameraFileError that names the line.
    """
    rows: list[tuple[float, ...]] = []
    columns = None
    for n, line in enumerate(_read(path).splitlines(), 1):
        text, _, comment = line.strip().replace('"', "").partition("#")
        if ";" in text:
            text = text.replace(",", ".").replace(";", ",")  # As spreadsheets write where decimals have commas.
        words = text.replace(",", " ").split()
        if (header := _header(text or comment, is_comment=not words)) and not rows:
            columns = _columns(f"{path}:{n}", header)
        elif header and _columns(f"{path}:{n}", header) != (columns or TUM):
            raise CameraFileError(f"{path}:{n}: other columns than before; write a file of one order")
        elif not words and not header and (found := OTHER_ORDER.search(comment)):
            said = f"a comment has {cut(found[0])}, which is not understood"
            raise CameraFileError(f"{path}:{n}: {said}; name the columns in the first line: # {', '.join(ROLES)}")
        elif words:
            row = _row(f"{path}:{n}", words, columns, separated="," in text)
            if fault := pose_fault(row, rows[-1] if rows else None):
                raise CameraFileError(f"{path}:{n}: {fault}")
            rows.append(row)
    if not rows:
        raise CameraFileError(f"{path}: no poses; expected lines t tx ty tz qx qy qz qw")
    return tuple(rows)


class _Columns(NamedTuple):
    """Where a line of a trajectory has the numbers of a pose."""

    places: tuple[int, ...]  # of t, tx, ty, tz, qx, qy, qz, qw
    width: int  # the number of all columns
    second: float  # a second in the unit of t


# The longest header, and name of a column in it.
MAX_HEADER, MAX_NAME = 2000, 80

TUM = _Columns(tuple(range(8)), 8, 1.0)

# The names of columns, in small letters, by what they hold; their units, and seconds in those of time.
_PLACE = r"(t|p|pos|(.*[^a-z])?position|trans|translation|[tp][^a-z].*[^a-z])?"
_TURN = r"(q|quat|quaternion|(.*[^a-z])?orientation|rot|rotation|q[^a-z].*)"
ROLES = {
    "t": r"t|ts|secs?|seconds|(.*[^a-z])?time([^a-z].*)?|.*(timestamp|stamp)([^a-z].*)?",
    **{f"t{axis}": rf"{_PLACE}[^a-z]*{axis}" for axis in "xyz"},
    **{f"q{axis}": rf"{_TURN}[^a-z]*{axis}" for axis in "xyzw"},
}
UNIT_OF = re.compile(r"\s*[\[(]([^\])]*)[\])]|[^a-z](m?u?n?s|nsecs?)$")
SECONDS = {
    **dict.fromkeys(("", "s", "sec", "seconds"), 1.0),
    **dict.fromkeys(("ms", "milliseconds"), 1e3),
    **dict.fromkeys(("us", "\u00b5s", "\u03bcs", "microseconds"), 1e6),
    **dict.fromkeys(("ns", "nsec", "nsecs", "nanoseconds"), 1e9),
}

# Comments on another order of a quaternion, or on the inverse of a pose.
OTHER_ORDER = re.compile(
    r"\bw[\s,]*x[\s,]*y[\s,]*z\b|scalar[\s-]*first|\bq_?0\b|world[\s-]*(to|2)[\s-]*cam\w*|\bw2c\b|\bT_?cw\b",
    re.IGNORECASE,
)


def _header(text: str, *, is_comment: bool) -> list[str]:
    """Split a line into the names of columns; empty if it is a row or another comment."""
    text = text.rpartition(":")[2].lower()
    names = [name.strip() for name in text.split(",")] if "," in text else re.sub(r"\s+(?=[\[(])", "", text).split()
    if len(text) > MAX_HEADER or max(map(len, names), default=0) > MAX_NAME:
        return []
    bare = [UNIT_OF.sub("", name) for name in names]
    turns = sum(bool(re.fullmatch(rf"(.*[^a-z])?{_TURN}[^a-z]*[wxyz]", name)) for name in bare)
    is_table = len(names) >= 7 and ("," in text or not is_comment)
    is_header = turns >= 4 or {*"wxyz"} <= {*bare} or is_table
    return names if is_header and not any(re.match(r"[-+.]?\d", name) for name in names) else []


def _columns(place: str, names: Sequence[str]) -> _Columns:
    """Find the columns of a pose by the names in a header; `place` is that of its line."""
    bare = [UNIT_OF.sub("", name) for name in names]
    if "image_id" in bare:
        raise CameraFileError(f"{place}: an images.txt of COLMAP, which is not read; write lines {' '.join(ROLES)}")
    found = [[n for n, name in enumerate(bare) if re.fullmatch(role, name)] for role in ROLES.values()]
    if any(len(places) != 1 for places in found):
        said = f"columns {_listed(names)} are not understood; name them {', '.join(ROLES)}"
        raise CameraFileError(f"{place}: {said}")
    places = tuple(each[0] for each in found)
    units = [(match[1] or match[2] or "") if (match := UNIT_OF.search(names[n])) else "" for n in places[:4]]
    if units[0] not in SECONDS or not {*units[1:]} <= {"", "m"}:
        said = f"{', '.join(names[n] for n in places[:4])}: units that are not understood"
        raise CameraFileError(f"{place}: {said}; write [s], [ms], [us] or [ns] for t, and metres, [m], for the others")
    return _Columns(places, len(names), SECONDS[units[0]])


def _row(place: str, words: Sequence[str], columns: _Columns | None, *, separated: bool) -> tuple[float, ...]:
    """Read a pose from the words of a line."""
    expected = columns or TUM
    try:
        numbers = [math.nan if "_" in word else float(word) for word in words]
    except ValueError:
        numbers = []
    if len(numbers) != expected.width or not all(abs(number) <= MOST for number in numbers):
        said = f"eight numbers up to {MOST:g}: {' '.join(ROLES)}"
        if expected.width != len(TUM.places):
            said = f"{expected.width} numbers up to {MOST:g}, one a column of the header"
        shape = SHAPES.get(len(words), "") if columns is None else ""
        if columns is None and separated and len(words) != EUROC_WIDTH:
            shape = "; numbers with decimal commas need ; between them"
        raise CameraFileError(f"{place}: not a pose{shape}; expected {said}")
    if separated and columns is None:
        said = "commas without a header, and w comes first in EuRoC's rows, last in TUM's"
        raise CameraFileError(f"{place}: {said}; name the columns in a first line: # {', '.join(ROLES)}")
    row = [numbers[n] for n in expected.places]
    return (row[0] / expected.second, *row[1:])


EUROC_WIDTH = 17

# Rows of other formats by how many words they have.
SHAPES = {
    10: ", but ten words, as in COLMAP's images.txt, which is not read",
    12: ", but twelve numbers, as KITTI's, which are not read",
    EUROC_WIDTH: ", but 17 numbers, as EuRoC's; keep their header",
}


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
    except RepeatedError as error:
        raise CameraFileError(f"{path}: {cut(str(error))} is given twice; keep the right one") from None
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
            where = f":{mark.line + 1}" if mark else ""
            said = "neither YAML, XML nor JSON; name a calibration"
            if isinstance(error, yaml.constructor.ConstructorError) and str(error.problem).startswith("could not det"):
                said = f"{cut(str(error.problem)).partition(' for the ')[2]}: not plain YAML; write numbers and lists"
            raise CameraFileError(f"{path}{where}: {said}") from None
    if not isinstance(data, dict):
        what = "a list" if isinstance(data, list) else "no keys"
        said = f"has {what}; expected camera_matrix and distortion_coefficients as keys"
        if _INI.match(text):
            said = f"an ini file, which is not read; {_REMEDY}, in YAML"
        elif _COLMAP.search(text):
            said = f"a cameras.txt of COLMAP, which is not read; {_REMEDY}, in YAML"
        raise CameraFileError(f"{path}: {said}")
    return data


# Comments and empty lines, with a section of an ini file, or OpenCV's first line, which is not YAML; a line of COLMAP.
_COMMENTS = r"((?:[ \t]*(?:[#;][^\n]*)?\r?\n)*)"
_INI = re.compile(_COMMENTS + r"[ \t]*\[[^\]\n=,]*\][ \t]*\r?\n" + _COMMENTS + r"[^\n]*=")
_DIRECTIVE = re.compile(_COMMENTS + r"%YAML[^\n]*")
_COLMAP = re.compile(r"^\d+ [A-Z_]+ \d+ \d+ [-+.\de]+ ", re.MULTILINE)


# The C parser is twenty times faster than PyYAML's own.
_Fast: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_Fast):  # type: ignore[misc]
    """Reads OpenCV's matrices as mappings, and refuses keys given twice."""


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    return _distinct([loader.construct_object(each, deep=True) for each in pair] for pair in node.value)


def _distinct(pairs: Iterable[Sequence[Any]]) -> dict[Any, Any]:
    """Make a mapping; RepeatedError: a key is given twice."""
    found: dict[Any, Any] = {}
    for name, value in pairs:
        if name in found:
            raise RepeatedError(name)
        found[name] = value
    return found


def _sequence(loader: _Loader, node: yaml.SequenceNode) -> list[Any]:
    return loader.construct_sequence(node, deep=True)


for _kind in ("opencv-matrix", "map"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _mapping)
# Python's yaml writes tuples so.
_Loader.add_constructor("tag:yaml.org,2002:python/tuple", _sequence)


def _yaml(text: str) -> Any:
    """Read YAML or JSON, also with OpenCV's first line, which is not YAML."""
    if text.lstrip().startswith("{"):
        return json.loads(text, object_pairs_hook=_distinct)
    text = _DIRECTIVE.sub(r"\1", text, count=1)
    # Aliases of aliases take any time, what is nested deeply or has many values a long one; no calibration has these.
    depth = 0
    for count, event in enumerate(yaml.parse(text, _Fast)):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if isinstance(event, yaml.AliasEvent) or depth > MAX_DEPTH or count > MAX_VALUES:
            raise ValueError
    # What ROS prints of a topic is a document for each message, and all are alike.
    return next(yaml.load_all(text, _Loader), None)


def _xml(text: str) -> dict[str, Any]:
    """Read OpenCV's XML: matrices have `data`, numbers are text."""
    from xml.etree import ElementTree

    # Without declarations there are no entities, which could be expanded to any size.
    if "<!" in text.replace("<!--", ""):
        raise ValueError
    pairs = []
    for element in ElementTree.fromstring(text):
        data = element.find("data")
        words = (element.text or "") if data is None else (data.text or "")
        pairs.append((element.tag, words.strip() if data is None else {"data": words.split()}))
    return _distinct(pairs)


def _numbers(path: str, name: str, value: Any) -> list[float]:
    """Read numbers, or the data of a matrix."""
    try:
        numbers = [math.nan if isinstance(one, bool) else float(one) for one in _flat(value)]
    except (TypeError, ValueError, OverflowError):
        numbers = [math.nan]
    if isinstance(value, dict) and "data" not in value:
        raise CameraFileError(f"{path}: {name}: has {_listed(value)}; expected a matrix with rows, cols and data")
    # Written so that NaN is found too.
    if not all(abs(number) <= LARGEST for number in numbers):
        said = f"{cut(str(value))} is not a list of numbers up to {LARGEST:g}; write it as OpenCV does"
        raise CameraFileError(f"{path}: {name}: {said}")
    rows, cols = (value.get(side) if isinstance(value, dict) else None for side in ("rows", "cols"))
    if isinstance(rows, int) and isinstance(cols, int) and rows * cols != len(numbers):
        said = f"has {len(numbers)} numbers, and {rows} rows of {cols}; write what belongs there"
        raise CameraFileError(f"{path}: {name}: {said}")
    return numbers


def _flat(value: Any) -> list[Any]:
    """List the words of a text, and the items of a list in lists, or of a matrix with data, up to some depth."""
    flat = [value["data"]] if isinstance(value, dict) and "data" in value else [value]
    for _ in range(MAX_DEPTH):
        if not any(isinstance(item, list) for item in flat):
            break
        flat = [one for item in flat for one in (item if isinstance(item, list) else [item])]
    return [one for item in flat for one in (item.split() if isinstance(item, str) else [item])]
