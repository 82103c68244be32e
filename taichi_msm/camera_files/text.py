"""Text of a camera file, and its keys where it is YAML, JSON, XML or an ini file."""

from __future__ import annotations

import json
import re
from collections.abc import Iterable, Mapping, Sequence
from configparser import ConfigParser
from configparser import Error as ConfigError
from functools import cached_property
from typing import Any

import yaml

from taichi_msm.errors import truncate
from taichi_msm.images import actual_path
from taichi_msm.system.files import read_regular

# Units of lengths [m].
LENGTH_UNITS = {"m": 1.0, "mm": 1e-3}

# Limits of nesting and of the number of YAML events. Matrices are nested two or three deep.
MAX_DEPTH, MAX_VALUES = 20, 200_000

# Comments and empty lines; a section of an ini file after them; OpenCV's directive, which is not valid YAML.
_COMMENTS = r"((?:[ \t]*(?:[#;][^\n]*)?\r?\n)*)"
_INI = re.compile(_COMMENTS + r"[ \t]*\[[^\]\n=,]*\][ \t]*\r?\n" + _COMMENTS + r"[^\n]*=")
_DIRECTIVE = re.compile(_COMMENTS + r"%YAML[^\n]*")

# Errors of Python's and PyYAML's parsers for invalid content.
_PARSER_ERRORS = (
    *(ArithmeticError, AttributeError, LookupError, RecursionError, SyntaxError, TypeError, ValueError),
    *(ConfigError, yaml.YAMLError),
)


class RepeatedError(Exception):
    """A key occurs twice."""


class CameraFileError(Exception):
    """The file cannot be used; the message contains its name, the reason and the remedy."""


class CameraFile:
    """A text file of a camera.

    Raises:
        CameraFileError: when the file cannot be read.
    """

    def __init__(self, path: str, max_bytes: int) -> None:
        self.path = path
        self.text = _read(path, max_bytes)

    def fault(self, fault: str, line: int | None = None) -> CameraFileError:
        """Return an error with the path of the file, and the number of a line."""
        return CameraFileError(f"{self.path}{'' if line is None else f':{line}'}: {fault}")

    @cached_property
    def data(self) -> Mapping[str, Any]:
        """Keys and values of YAML, JSON, XML or an ini file.

        Raises:
            CameraFileError: when the file has another format.
        """
        try:
            data = _parse(self.text)
        except RepeatedError as error:
            raise self.fault(f"{truncate(str(error))} is given twice; keep the right one") from None
        except _PARSER_ERRORS as error:
            mark = getattr(error, "problem_mark", None)
            fault = "neither YAML, XML, JSON nor an ini file; name a calibration"
            if isinstance(error, yaml.constructor.ConstructorError) and str(error.problem).startswith("could not det"):
                tag = truncate(str(error.problem)).partition(" for the ")[2]
                fault = f"{tag}: not plain YAML; write numbers and lists"
            raise self.fault(fault, mark.line + 1 if mark else None) from None
        if not isinstance(data, dict):
            content = "a list" if isinstance(data, list) else "no keys"
            raise self.fault(f"has {content}; expected camera_matrix and distortion_coefficients as keys")
        return data


def _read(name: str, max_bytes: int) -> str:
    try:
        return read_regular(actual_path(name), max_bytes).decode("utf-8-sig")
    except UnicodeDecodeError:
        raise CameraFileError(f"{name}: not UTF-8; name a text file") from None
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "not a path"
        raise CameraFileError(f"{name}: {reason.lower()}; name a calibration or a trajectory") from None


def _parse(text: str) -> Any:
    if text.lstrip().startswith("<"):
        return _xml(text)
    if text.lstrip().startswith("{"):
        return json.loads(text, object_pairs_hook=_distinct)
    return _ini(text) if _INI.match(text) else _yaml(text)


# The C parser is twenty times faster than the one in Python.
_BaseLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_BaseLoader):  # type: ignore[misc]
    """YAML loader that reads OpenCV's matrices as mappings, and rejects repeated keys."""


def _distinct(pairs: Iterable[Sequence[Any]]) -> dict[Any, Any]:
    """Build a mapping; raise a RepeatedError for a repeated key."""
    mapping: dict[Any, Any] = {}
    for name, value in pairs:
        if name in mapping:
            raise RepeatedError(name)
        mapping[name] = value
    return mapping


def _mapping(loader: _Loader, node: yaml.MappingNode) -> dict[Any, Any]:
    return _distinct([loader.construct_object(item, deep=True) for item in pair] for pair in node.value)


for _kind in ("opencv-matrix", "opencv-nd-matrix", "map"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _mapping)
# PyYAML's own tag of tuples.
_Loader.add_constructor("tag:yaml.org,2002:python/tuple", lambda loader, node: loader.construct_sequence(node, True))


def _yaml(text: str) -> Any:
    """Parse YAML, also with OpenCV's directive in the first line, which is not valid YAML."""
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


def _ini(text: str) -> dict[str, dict[str, str]]:
    parser = ConfigParser(interpolation=None, inline_comment_prefixes=("#", ";"))
    parser.read_string(text)
    return {name: dict(parser[name]) for name in parser.sections()}
