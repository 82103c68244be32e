"""Text file with a calibration or trajectory, and a parser of YAML, JSON, XML and ini."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Iterator, Mapping
from functools import cached_property
from itertools import islice
from typing import TYPE_CHECKING, Any

import yaml

from taichi_msm.errors import truncate
from taichi_msm.images import actual_path
from taichi_msm.system.files import read_regular

if TYPE_CHECKING:
    from xml.etree.ElementTree import Element

# Units of lengths [m].
LENGTH_UNITS = {"m": 1.0, "mm": 1e-3}

# Largest depth of nested values. Matrices are nested two or three deep.
MAX_DEPTH = 20

# Largest length of a number in YAML. PyYAML converts 1:2:3 in quadratic time, and Python prints integers of up to 4300
# digits.
MAX_DIGITS = 1000

# Errors of Python's and PyYAML's parsers for invalid content.
_PYTHON_ERRORS = ArithmeticError, AttributeError, LookupError, RecursionError, SyntaxError, TypeError, ValueError
_PARSER_ERRORS = (*_PYTHON_ERRORS, yaml.YAMLError)


class Entries(dict[str, Any]):
    """Keys and values of a file or a section, with line numbers, from 1, of its keys; empty for JSON and XML."""

    def __init__(self, values: Mapping[str, Any], lines: Mapping[str, int]) -> None:
        super().__init__(values)
        self.lines = lines


class CameraFileError(Exception):
    """Unusable file; the message has its name, the line if known, the reason and the remedy."""


class _ContentError(Exception):
    """Invalid content, with its line counted from 1."""

    def __init__(self, fault: str, line: int | None = None) -> None:
        super().__init__(fault)
        self.line = line


class CameraFile:
    """File with a calibration or a trajectory of a camera; a CameraFileError if it cannot be read.

    `picture_size` is the size of the scene's pictures [px], for files that contain only their field of view.
    """

    def __init__(self, path: str, max_bytes: int, picture_size: tuple[int, int] | None = None) -> None:
        self.path = path
        self.picture_size = picture_size
        self.content = _read(path, max_bytes)

    @cached_property
    def text(self) -> str:
        """Content of a text file; a CameraFileError for another one."""
        try:
            return self.content.decode("utf-8-sig")
        except UnicodeDecodeError:
            raise self.fault("not UTF-8; name a text file") from None

    def fault(self, fault: str, line: int | None = None) -> CameraFileError:
        """Return an error, for the caller to raise, with the number of the line, from 1, where it is known."""
        return CameraFileError(f"{self.path}{'' if line is None else f':{line}'}: {fault}")

    def entries(self, items: Iterable[tuple[Any, Any, int | None]]) -> Entries:
        """Return the entries of keys, values and lines of this file; a CameraFileError for a repeated key."""
        entries: Entries = self._parsed(lambda _: build_entries(items))
        return entries

    @cached_property
    def lines(self) -> list[tuple[int, str]]:
        """Lines that are not empty, stripped, with their numbers from 1."""
        return [(n, line) for n, raw in enumerate(self.text.splitlines(), 1) if (line := raw.strip())]

    @cached_property
    def xml(self) -> Element | None:
        """Root of an XML file; None for another format."""
        return self._parsed(_xml_root) if self.text.lstrip()[:1] == "<" else None

    @cached_property
    def data(self) -> Entries:
        """Keys and values of YAML, JSON, XML or an ini file; a CameraFileError for another format."""
        data = self._parsed(_parse)
        if not isinstance(data, Entries):
            content = "a list" if isinstance(data, list) else "no keys"
            raise self.fault(f"contains {content}; expected the keys camera_matrix and distortion_coefficients")
        return data

    def _parsed(self, parse: Callable[[str], Any]) -> Any:
        try:
            return parse(self.text)
        except _ContentError as error:
            raise self.fault(str(error), error.line) from None
        except _PARSER_ERRORS as error:
            mark = getattr(error, "problem_mark", None)
            line = mark.line + 1 if mark else getattr(error, "lineno", None)
            raise self.fault("neither YAML, XML, JSON nor ini; name a calibration file", line) from None


def listed(names: Iterable[Any]) -> str:
    """Format up to 12 names for a message."""
    shown, names = 12, list(names)
    more = f" and {len(names) - shown} more" if len(names) > shown else ""
    return ", ".join(truncate(str(name)) for name in names[:shown]) + more


def _read(name: str, max_bytes: int) -> bytes:
    try:
        return read_regular(actual_path(name), max_bytes)
    except (OSError, ValueError) as error:
        reason = error.strerror if isinstance(error, OSError) and error.strerror else "not a path"
        raise CameraFileError(f"{name}: {reason.lower()}; name a calibration or a trajectory") from None


def _parse(text: str) -> Any:
    start = text.lstrip()[:1]
    if start == "<":
        return _xml(text)
    if start == "{":
        return _json(text)
    header, entry = ([line for _, line in islice(_content(text), 2)] + ["", ""])[:2]
    is_ini = header.startswith("[") and header.endswith("]") and not {*"=,"} & {*header} and "=" in entry
    return _ini(text) if is_ini else _yaml(text)


def _content(text: str) -> Iterator[tuple[int, str]]:
    """Yield the lines that are neither empty nor comments, stripped, with their numbers from 1."""
    for n, raw in enumerate(text.splitlines(), 1):
        if (line := raw.strip()) and line[0] not in "#;":
            yield n, line


def _truncated(text: str, kind: str) -> _ContentError:
    """Return the fault of a file that ends before its last bracket or tag."""
    lines = text.rstrip().splitlines()
    fault = f"truncated {kind}, the file ends after {lines[-1][-30:].strip()!r}"
    return _ContentError(f"{fault}; copy or export the whole file again", len(lines))


def build_entries(items: Iterable[tuple[Any, Any, int | None]]) -> Entries:
    """Build the entries of keys, values and lines; a repeated key is an error."""
    values: dict[Any, Any] = {}
    lines: dict[Any, int] = {}
    for name, value, line in items:
        if name in values:
            raise _ContentError(f"{truncate(str(name))} is given twice; keep the right one", line)
        values[name] = value
        if line is not None:
            lines[name] = line
    return Entries(values, lines)


def _json(text: str) -> Any:
    try:
        return json.loads(text, object_pairs_hook=lambda pairs: build_entries((*pair, None) for pair in pairs))
    except json.JSONDecodeError as error:
        # A truncated text ends within a string or a word.
        if error.msg.startswith("Unterminated") or re.fullmatch(r"[\w.+\\-]*\s*", text[error.pos :]):
            raise _truncated(text, "JSON") from None
        place = f"invalid JSON from column {error.colno} on"
        raise _ContentError(f"{place}; correct it, or export the calibration again", error.lineno) from None


# The C parser is twenty times faster than the one in Python.
_BaseLoader: Any = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class _Loader(_BaseLoader):  # type: ignore[misc]
    """YAML loader that reads OpenCV's matrices as mappings, and rejects repeated keys."""


def _mapping(loader: _Loader, node: yaml.MappingNode) -> Entries:
    pairs = [[loader.construct_object(item, deep=True) for item in pair] for pair in node.value]
    lines = (name.start_mark.line + 1 for name, _ in node.value)
    return build_entries((name, value, line) for (name, value), line in zip(pairs, lines, strict=True))


for _kind in ("opencv-matrix", "opencv-nd-matrix", "map"):
    _Loader.add_constructor(f"tag:yaml.org,2002:{_kind}", _mapping)
# PyYAML's own tag of tuples.
_Loader.add_constructor("tag:yaml.org,2002:python/tuple", lambda loader, node: loader.construct_sequence(node, True))


def _yaml(text: str) -> Any:
    """Parse YAML, also with OpenCV's directive in the first line, which is not valid YAML."""
    number, first = next(_content(text), (0, ""))
    if first.startswith("%YAML"):
        # Only empty lines and comments come before it.
        text = "\n" * number + "".join(text.splitlines(keepends=True)[number:])
    # Nested aliases, deep nesting and huge files take unlimited time; no calibration has them.
    depth, max_events = 0, 200_000
    try:
        for count, event in enumerate(yaml.parse(text, _BaseLoader)):
            depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
            if isinstance(event, yaml.AliasEvent) or depth > MAX_DEPTH or count > max_events or _is_too_long(event):
                raise ValueError
        # The output of a ROS topic has a document for every message, all with equal content.
        return next(yaml.load_all(text, _Loader), None)
    except yaml.constructor.ConstructorError as error:
        if not str(error.problem).startswith("could not det"):
            raise
        tag = truncate(str(error.problem)).partition(" for the ")[2]
        line = error.problem_mark.line + 1 if error.problem_mark else None
        raise _ContentError(f"{tag}: not plain YAML; write numbers and lists", line) from None
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        if mark and not "\n".join(text.splitlines()[mark.line :])[mark.column :].strip():
            raise _truncated(text, "YAML") from None
        raise


def _xml_root(text: str) -> Element:
    from xml.etree import ElementTree
    from xml.parsers.expat.errors import XML_ERROR_NO_ELEMENTS, XML_ERROR_UNCLOSED_TOKEN, messages

    # Declarations could define entities that expand to any size.
    if "<!" in text.replace("<!--", ""):
        raise ValueError
    try:
        return ElementTree.fromstring(text)
    except ElementTree.ParseError as error:
        if messages[error.code] in (XML_ERROR_NO_ELEMENTS, XML_ERROR_UNCLOSED_TOKEN):
            raise _truncated(text, "XML") from None
        fault = f"invalid XML from column {error.position[1] + 1} on; correct it, or export the calibration again"
        raise _ContentError(fault, error.position[0]) from None


def _xml(text: str) -> Entries:
    """Parse OpenCV's XML, in which matrices have `data` and numbers are text."""
    items: list[tuple[str, Any, None]] = []
    for element in _xml_root(text):
        data = element.find("data")
        words = (element.text or "") if data is None else (data.text or "")
        items.append((element.tag, words.strip() if data is None else {"data": words.split()}, None))
    return build_entries(items)


def _is_too_long(event: yaml.Event) -> bool:
    """Return whether an event is a number of more than MAX_DIGITS characters."""
    if not (isinstance(event, yaml.ScalarEvent) and event.implicit[0]):
        return False
    return len(event.value) > MAX_DIGITS and event.value[0] in "+-.0123456789"


def _ini(text: str) -> Entries:
    """Parse an ini file; its keys are in lower case, and # or ; after a blank begin a comment."""
    sections: list[tuple[str, list[tuple[str, str, int]], int]] = []
    for n, line in _content(text):
        content = re.split(r"\s[#;]", line, maxsplit=1)[0].rstrip()
        if content.startswith("[") and content.endswith("]"):
            sections.append((content[1:-1], [], n))
        elif len(entry := re.split("[=:]", content, maxsplit=1)) == 2:
            sections[-1][1].append((entry[0].strip().lower(), entry[1].strip(), n))
        else:
            raise _ContentError(f"{truncate(content)}: neither [SECTION] nor KEY = VALUE; correct the line", n)
    return build_entries((name, build_entries(items), n) for name, items, n in sections)
