"""Scene file and overrides -> Scene, with file, line and column in every error; and the schema for editors."""

from __future__ import annotations

import codecs
import json
import re
from collections.abc import Iterable, Mapping, Sequence
from copy import deepcopy
from dataclasses import replace
from itertools import chain, starmap
from pathlib import Path
from typing import Any, NamedTuple

from taichi_msm.errors import ArgumentError, Key, Problem, SceneError
from taichi_msm.images import PICTURE_SUFFIXES, file_sha256, irregular_kind
from taichi_msm.load.check import validate
from taichi_msm.load.yaml_reader import MAX_DEPTH, Document, Mark, UnreadableError, mark_at, read
from taichi_msm.model.plan import Plan
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_PATH, format_value, truncate

MAX_BYTES = 2**20

# The keys that name pictures.
IMAGE_KEY: Key = ("image",)
MAP_KEYS: tuple[Key, ...] = (
    ("tissue", "map", "image"),
    ("tissue", "foundation_map", "image"),
    ("springs", "map", "image"),
)
PICTURE_KEYS = (IMAGE_KEY, *MAP_KEYS)

# The keys that name other files; ANY is the name of a camera.
ANY_CAMERA = "*"
CAMERA_FILE_KEYS: tuple[Key, ...] = tuple(
    ("render", *camera, key) for camera in (("camera",), ("cameras", ANY_CAMERA)) for key in ("calibration", "poses")
)

# The largest number of lines in an error: nobody reads more, and a broken file may have tens of thousands of problems.
MAX_LINES = 100


class FileKind(NamedTuple):
    """What a file should be."""

    name: str  # what it is called
    needs: str  # the keys that it must have


class ParsedFile(NamedTuple):
    """A YAML file that was read, whose keys are not checked."""

    name: str  # in messages
    folder: Path  # where it is
    document: Document


SCENE_KIND = FileKind("scene", "sheet, tissue or springs, and time")

_NO_KEY = Problem((), "expected KEY=VALUE, such as sheet.points=[61,61]")
_NO_PATH = Problem((), "expected a key such as sheet.points")
_INDEX = re.compile("[0-9]{1,9}")


def load_scene(
    path: str | Path, overrides: Sequence[str] | Mapping[str, Any] = (), image: str | Path | None = None
) -> Scene:
    """Read a scene and check all that can be checked before computing.

    Args:
        path: of the scene file. The image that it names is relative to its folder, and must be in it or below. An
            override may name an image elsewhere, also relative to this folder.
        overrides: values that replace those of the file: texts "KEY=VALUE" with a dotted key (items of a list by
            number: probes.0.load) and a value in YAML, which errors call --set; or a mapping from dotted keys to
            values, which errors call override.
        image: another picture for the sheet, relative to the current directory.

    Returns:
        The scene; its image is relative to the current directory.

    Raises:
        ArgumentError: when the overrides are neither a sequence of texts nor a mapping from texts.
        SceneError: with all problems of the scene, one line each, in the order of their places in the file.

    Example:
        >>> from taichi_msm import load_scene
        >>> scene = load_scene("scenes/press.yaml", {"sheet.points": [41, 41]}, image="photo.jpg")
        >>> scene.sheet.points, scene.image
        ((41, 41), 'photo.jpg')
    """
    return load_plan(path, overrides, image).scene


def load_plan(
    path: str | Path, overrides: Sequence[str] | Mapping[str, Any] = (), image: str | Path | None = None
) -> Plan:
    """Read and check a scene as `load_scene` does, and plan it for a CPU."""
    if isinstance(path, Mapping):
        raise ArgumentError("path: a mapping; Scene(**mapping) is its scene, and load_scene reads a file")
    return plan_file(read_file(str(path), SCENE_KIND), overrides, image)


def plan_file(
    file: ParsedFile, overrides: Sequence[str] | Mapping[str, Any] = (), image: str | Path | None = None
) -> Plan:
    """Check a scene file that was read before, and plan its scene; as `load_plan`."""
    if isinstance(overrides, str) or not (
        isinstance(overrides, (Sequence, Mapping)) and all(isinstance(one, str) for one in overrides)
    ):
        raise ArgumentError(f'overrides: {overrides!r}; take ["sheet.points=[61,61]"] or {{"sheet.points": [61, 61]}}')
    draft = Draft(file)
    if {"scene", "vary"} <= draft.data.keys():
        raise SceneError([f"{file.name}:1:1: a sweep; use `taichi-msm sweep`"])
    parsed = (
        starmap(_parse_value, overrides.items()) if isinstance(overrides, Mapping) else map(parse_override, overrides)
    )
    for override in parsed:
        draft.override(override)
    for key in (*(PICTURE_KEYS if image is None else MAP_KEYS), *(key for key, _ in camera_files(draft.data))):
        draft.find_file(key, file.folder)
    if image is not None:
        draft.override(_Override(f"--image {truncate(str(image))}", IMAGE_KEY, str(image)))
    plan, problems = validate(draft.data)
    draft.report(problems)
    if plan is None or draft.problems:
        raise SceneError(draft.lines())
    return replace(plan, sha256={".".join(map(str, key)): file_sha256(path) for key, path in camera_files(draft.data)})


def names_file(key: Key) -> bool:
    """Return whether a key of a scene, whose value is a text, names a file."""
    return any(
        len(key) == len(pattern) and all(part in (str(one), ANY_CAMERA) for one, part in zip(key, pattern, strict=True))
        for pattern in (*PICTURE_KEYS, *CAMERA_FILE_KEYS)
    )


def camera_files(data: Mapping[str, Any]) -> list[tuple[Key, str]]:
    """List the keys of the cameras of a scene that name files, with their values."""
    render = data.get("render")
    cameras = render.get("cameras") if isinstance(render, dict) else None
    names = list(cameras) if isinstance(cameras, dict) else []
    keys = [
        tuple(name if part == ANY_CAMERA else part for part in pattern)
        for pattern in CAMERA_FILE_KEYS
        for name in (names if ANY_CAMERA in pattern else [ANY_CAMERA])
    ]
    return [(key, path) for key in keys if isinstance(path := _value(data, key), str)]


def _value(data: Any, key: Key) -> Any:
    """Find the value of a key; None: there is none."""
    for part in key:
        data = data.get(part) if isinstance(data, dict) else None
    return data


def schema() -> dict[str, Any]:
    """Describe the scene for editors, as JSON Schema (draft 2020-12): the rules for single keys."""
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | Scene.model_json_schema()


class _Override(NamedTuple):
    """A value that replaces one of the file; `problems` says why it cannot be read."""

    name: str
    path: Key
    value: Any = None
    problems: Sequence[Problem] = ()


def parse_override(text: str) -> _Override:
    """Read "KEY=VALUE"."""
    key, equals, value = text.partition("=")
    name = f"--set {truncate(key)}{equals}{truncate(value)}"
    path = parse_key(key.strip())
    if not equals or not path:
        return _Override(name, (), problems=[_NO_KEY])
    try:
        document = read(value)
    except UnreadableError as error:
        return _Override(name, path, problems=[Problem(path, str(error))])
    faults = [Problem(path + fault.path, fault.message) for _, fault in document.faults]
    return _Override(name, path, document.data, faults)


def _parse_value(key: str, value: Any) -> _Override:
    path = parse_key(key)
    name = f"override {truncate(key)}"
    if not path:
        return _Override(name, (), problems=[_NO_PATH])
    try:
        plain = json.loads(json.dumps(value))
    except (TypeError, ValueError, RecursionError):
        problem = Problem(path, f"a file cannot hold this {type(value).__name__}; use numbers, text, lists, dicts")
        return _Override(name, path, problems=[problem])
    return _Override(f"{name}={format_value(plain)}", path, plain)


def parse_key(key: str) -> Key:
    """Split a dotted key; returns an empty key if it is not valid."""
    parts = key.split(".")
    if len(parts) > MAX_DEPTH or not all(part and part.isprintable() for part in parts):
        return ()
    return tuple(int(part) if _INDEX.fullmatch(part) else part for part in parts)


class _Place(NamedTuple):
    """Where a key was given; places are sorted in the order of reading: the file, then the overrides."""

    source: int  # 0 for the file; 1, 2, ... for the overrides
    mark: Mark  # in the file
    name: str  # of the place in messages, such as press.yaml:7:3


class Draft:
    """The content of a file, a mapping whose keys are not checked, while overrides are applied to it.

    Attributes:
        data: its content, with the overrides applied so far.
        problems: found so far, each with its place.
    """

    def __init__(self, file: ParsedFile) -> None:
        document = file.document
        self._name, self._marks = file.name, document.marks
        self._overrides = 0
        self._overridden: dict[Key, _Place] = {}
        self.data: dict[str, Any] = deepcopy(document.data)
        self.problems = [(self._in_file(mark), problem) for mark, problem in document.faults]

    def override(self, override: _Override) -> None:
        """Apply an override."""
        self._overrides += 1
        place = _Place(self._overrides, Mark(1, 1), override.name)
        if override.problems:
            self.problems += [(place, problem) for problem in override.problems]
        elif problem := self._put(override.path, override.value, place):
            self.problems.append((place, problem))

    def find_file(self, key: Key, folder: Path) -> None:
        """Change the path of a file, given relative to a folder, to one from the current directory."""
        holder, image = _value(self.data, key[:-1]), _value(self.data, key)
        if not (isinstance(image, str) and 0 < len(image) <= MAX_PATH):
            return
        holder[key[-1]] = str(folder / image)
        # A scene may come from anybody, so it may only read files that came with it.
        given = any(key[:n] in self._overridden for n in range(1, len(key) + 1))
        if not given and not is_below(folder / image, folder):
            remedy = ", or name it with --image" if key == IMAGE_KEY else ""
            said = (
                f"{image} is not below the scene's folder; put {'the picture' if key in PICTURE_KEYS else 'it'} there"
            )
            self.problems.append((self._place(key), Problem(key, said + remedy)))
            del holder[key[-1]]

    def report(self, problems: Iterable[Problem]) -> None:
        """Add problems with their places, except those of keys that already have a problem."""
        keys = {problem.path for _, problem in self.problems}
        for problem in problems:
            if problem.path not in keys:
                keys.add(problem.path)
                self.problems.append((self._place(problem.path), problem))

    def lines(self) -> list[str]:
        """Format the problems in the order of their places."""
        ordered = sorted(self.problems, key=lambda item: item[0][:2])
        shown = [
            f"{place.name}: {Problem(tuple(truncate(str(part)) for part in problem.path), problem.message)}"
            for place, problem in ordered[:MAX_LINES]
        ]
        return shown if len(shown) == len(ordered) else [*shown, "and more"]

    def _in_file(self, mark: Mark) -> _Place:
        return _Place(0, mark, f"{self._name}:{mark.line}:{mark.column}")

    def _place(self, path: Key) -> _Place:
        """Find where a key was given, or else the innermost section or list around it that was."""
        around = [path[:n] for n in range(len(path), -1, -1)]
        overridden = (self._overridden[key] for key in around if key in self._overridden)
        given = (self._in_file(self._marks[key]) for key in around if key in self._marks)
        return next(chain(overridden, given))

    def _put(self, path: Key, value: Any, place: _Place) -> Problem | None:
        """Set a key, creating the sections above it that do not exist yet."""
        holder: Any = self.data
        here: Key = ()
        for n, part in enumerate(path):
            if isinstance(holder, dict):
                part = str(part)
            elif not isinstance(holder, list):
                return Problem(here, f"{format_value(holder)} has no keys to set one of; set it as a whole")
            elif not (isinstance(part, int) and part < len(holder)):
                example = ".".join(str(one) for one in (*here, 0, *path[n:][isinstance(part, int) :]))
                said = f"no such item; the list has {len(holder)}, numbered from 0, as in {example}"
                if not holder:
                    said = "no such item; the list is empty, so set it as a whole"
                return Problem((*here, part), said)
            here = (*here, part)
            if n == len(path) - 1:
                holder[part] = value
                self._overridden = {key: at for key, at in self._overridden.items() if key[: len(here)] != here}
                self._overridden[here] = place
            elif isinstance(holder, dict) and part not in holder:
                holder[part] = [] if isinstance(path[n + 1], int) else {}
                self._overridden[here] = place
            holder = holder[part]
        return None


def is_below(path: Path, folder: Path) -> bool:
    """Tell whether a path is in a folder or below it, with symbolic links resolved."""
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):
        # A loop of links, or not a valid path: reading it will say so.
        return True


def read_file(name: str, kind: FileKind) -> ParsedFile:
    """Read a file that should be of a kind; SceneError: it contains no mapping, or cannot be read."""
    try:
        document = read(_read_text(name, kind))
    except UnreadableError as error:
        raise SceneError([f"{name}:{error.mark.line}:{error.mark.column}: {error}"]) from None
    if document.data is None:
        raise SceneError([f"{name}:1:1: no keys; a {kind.name} needs at least {kind.needs}"])
    if not isinstance(document.data, dict):
        said = f"{format_value(document.data)} is not a {kind.name}; expected keys such as {kind.needs}"
        raise SceneError([f"{name}:1:1: {said}"])
    return ParsedFile(name, Path(name).parent, document)


def _read_text(name: str, kind: FileKind) -> str:
    path = Path(name)
    try:
        if what := irregular_kind(path):
            raise SceneError([f"{name}: {what}; name a {kind.name} file"])
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1).removeprefix(codecs.BOM_UTF8)
    except ValueError:
        raise SceneError([f"{name}: not a path; name a {kind.name} file"]) from None
    except OSError as error:
        raise SceneError([f"{name}: {(error.strerror or str(error)).lower()}"]) from None
    if len(raw) > MAX_BYTES:
        raise SceneError([f"{name}: larger than {MAX_BYTES // 2**20} MiB; a {kind.name} is smaller"])
    try:
        return raw.decode()
    except UnicodeDecodeError as error:
        if path.suffix.lower() in PICTURE_SUFFIXES:
            by = ", and the picture by --image" if kind is SCENE_KIND else ""
            raise SceneError([f"{name}: a picture; name a {kind.name}{by}"]) from None
        before = raw[: error.start].decode()
        mark = mark_at(before, len(before))
        raise SceneError([f"{name}:{mark.line}:{mark.column}: not UTF-8; save the file as UTF-8"]) from None
