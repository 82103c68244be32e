"""Reading of scene files with overrides, with file, line and column in every error; and the schema for editors."""

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

from taichi_msm.errors import ArgumentError, Key, Problem, SceneError, require_type, truncate, windows_path_hint
from taichi_msm.images import PICTURE_SUFFIXES, actual_path, file_sha256, irregular_kind
from taichi_msm.load.check import validate, value_at
from taichi_msm.load.yaml_reader import MAX_DEPTH, Document, Mark, UnreadableError, mark_at, read_yaml
from taichi_msm.model.plan import Plan
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_PATH, format_value

# Largest size of a file [bytes].
MAX_BYTES = 2**20

# Keys whose values are paths of pictures.
IMAGE_KEY: Key = ("image",)
MAP_KEYS: tuple[Key, ...] = (
    ("tissue", "map", "image"),
    ("tissue", "foundation_map", "image"),
    ("springs", "map", "image"),
)
MASK_KEYS: tuple[Key, ...] = (("sheet", "mask"), ("sheet", "mask", "image"))
PICTURE_KEYS = (IMAGE_KEY, *MAP_KEYS, *MASK_KEYS)

# Keys of the files of a surface, whose values are paths of arrays or pictures.
SURFACE_KEYS: tuple[Key, ...] = tuple(("sheet", "surface", kind, "file") for kind in ("height", "depth", "points"))

# Keys of a camera whose values are paths of files.
CAMERA_FILE_KEYS = ("calibration", "poses")

# Kind of a scene file and its required keys, for `read_file`.
SCENE = "scene", "sheet, tissue or springs, and time"

# Limit of the lines of an error, as a broken file may have tens of thousands of problems.
MAX_LINES = 100


# Replacements of values of a file, as texts "KEY=VALUE" or by key.
Overrides = Sequence[str] | Mapping[str, Any]


class ParsedFile(NamedTuple):
    """Parsed YAML file, a mapping, whose keys are not validated."""

    name: str  # path of the file, for messages
    folder: Path  # to which paths in the file are relative
    document: Document


def load_scene(path: str | Path, overrides: Overrides = (), image: str | Path | None = None) -> Scene:
    """Read and validate a scene file.

    Args:
        path: path of the scene file. Paths in the file are relative to its folder, and must be in this folder or below
            it. Paths in overrides are also relative to this folder, but may be outside it.
        overrides: replacements of values of the file, by dotted keys with indices for items of lists (probes.0.load):
            texts "KEY=VALUE" with the value in YAML (--set in messages), or a mapping from keys to values (override in
            messages).
        image: path of another image for the sheet, relative to the current directory.

    Returns:
        The scene, whose paths are relative to the current directory.

    Raises:
        ArgumentError: when the overrides are neither a sequence of texts nor a mapping from texts.
        SceneError: when the scene is invalid; contains all problems, one per line, in the order of the file.

    Example:
        >>> from taichi_msm import load_scene
        >>> scene = load_scene("scenes/press.yaml", {"sheet.points": [41, 41]}, image="photo.jpg")
        >>> scene.sheet.points, scene.image
        ((41, 41), 'photo.jpg')
    """
    return load_plan(path, overrides, image).scene


def load_plan(path: str | Path, overrides: Overrides = (), image: str | Path | None = None) -> Plan:
    """Read and validate a scene file as `load_scene`, and plan the scene for a CPU."""
    if isinstance(path, Mapping):
        raise ArgumentError("path: a mapping; take the path of a scene file, or build Scene(**mapping)")
    require_type(path, str | Path, "path", "the path of a scene file")
    require_type(image, str | Path | None, "image", "the path of a picture or None")
    return plan_file(read_file(str(path), *SCENE), overrides, image)


def plan_file(file: ParsedFile, overrides: Overrides = (), image: str | Path | None = None) -> Plan:
    """Validate a parsed scene file as `load_scene`, and plan the scene for a CPU, with the SHA-256 of camera files."""
    if isinstance(overrides, str) or not (
        isinstance(overrides, (Sequence, Mapping)) and all(isinstance(item, str) for item in overrides)
    ):
        raise ArgumentError(f'overrides: {overrides!r}; take ["sheet.points=[61,61]"] or {{"sheet.points": [61, 61]}}')
    draft = Draft(file)
    if "scene" in draft.data and {"vary", "variables", "together"} & draft.data.keys():
        raise SceneError([f"{file.name}:1:1: a sweep; use `taichi-msm sweep`"])
    parsed = (
        starmap(_to_override, overrides.items()) if isinstance(overrides, Mapping) else map(parse_override, overrides)
    )
    for override in parsed:
        draft.override(override)
    for key in (*PICTURE_KEYS[image is not None :], *SURFACE_KEYS, *(key for key, _ in camera_files(draft.data))):
        draft.resolve_path(key, file.folder)
    if image is not None:
        draft.override(Override(f"--image {truncate(str(image))}", IMAGE_KEY, str(image)))
    plan, problems = validate(draft.data)
    draft.report(problems)
    if plan is None or draft.problems:
        raise SceneError(draft.lines())
    return replace(plan, sha256={".".join(map(str, key)): file_sha256(path) for key, path in camera_files(draft.data)})


def names_file(key: Key) -> bool:
    """Return whether a text at a key is the path of a file."""
    is_camera = key[:-1] == ("render", "camera") or (key[:2] == ("render", "cameras") and len(key) == 4)
    return key in (*PICTURE_KEYS, *SURFACE_KEYS) or (is_camera and key[-1] in CAMERA_FILE_KEYS)


def camera_files(data: Mapping[str, Any]) -> list[tuple[Key, str]]:
    """List the keys and paths of camera files."""
    cameras = value_at(data, ("render", "cameras"))
    sections: list[Key] = [("render", "camera")]
    sections += [("render", "cameras", name) for name in (cameras if isinstance(cameras, dict) else ())]
    keys = [(*section, name) for name in CAMERA_FILE_KEYS for section in sections]
    return [(key, path) for key in keys if isinstance(path := value_at(data, key), str)]


def schema() -> dict[str, Any]:
    """Return the JSON Schema (draft 2020-12) of a scene, with the rules for single keys, not for combinations."""
    described = {"$schema": "https://json-schema.org/draft/2020-12/schema"} | Scene.model_json_schema()
    _separate_sections(described)
    return described


_NULL = {"type": "null"}


def _separate_sections(part: Any) -> None:
    """Replace unions with null or with a section in a JSON Schema, so that errors name a key or an item within."""
    if isinstance(part, list):
        for item in part:
            _separate_sections(item)
    elif isinstance(part, dict):
        for value in part.values():
            _separate_sections(value)
        members = part.get("anyOf", ())
        sections = [member for member in members if member.keys() == {"$ref"}]
        others = [member for member in members if member not in sections]
        if len(sections) == 1:
            del part["anyOf"]
            part |= {"if": {"type": "object"}, "then": sections[0]}
            part |= {"type": ["object", "null"]} if others == [_NULL] else {"else": {"anyOf": others}}
        elif len(others) == 2 and others[1] == _NULL and "type" in others[0]:
            # The other rules of a type do not apply to null, except for a list of values.
            del part["anyOf"]
            part |= others[0] | {"type": [others[0]["type"], "null"]}
            if "enum" in part:
                part["enum"] = [*part["enum"], None]


class Override(NamedTuple):
    """Replacement of a value of the file."""

    name: str  # as in messages
    path: Key
    value: Any = None
    problems: Sequence[Problem] = ()  # with any, the override is not applied


def parse_override(text: str) -> Override:
    """Parse an override "KEY=VALUE"."""
    key, equals, value = text.partition("=")
    name = f"--set {truncate(key)}{equals}{truncate(value)}"
    path = parse_key(key.strip())
    if not equals or not path:
        return Override(name, (), problems=[Problem((), "expected KEY=VALUE, such as sheet.points=[61,61]")])
    try:
        document = read_yaml(value)
    except UnreadableError as error:
        return Override(name, path, problems=[Problem(path, str(error))])
    faults = [Problem(path + fault.path, fault.message) for _, fault in document.faults]
    return Override(name, path, document.data, faults)


def _to_override(key: str, value: Any) -> Override:
    path = parse_key(key)
    name = f"override {truncate(key)}"
    if not path:
        return Override(name, (), problems=[Problem((), "expected a key such as sheet.points")])
    try:
        plain = json.loads(json.dumps(value))
    except (TypeError, ValueError, RecursionError):
        problem = Problem(path, f"{type(value).__name__} is not a type of YAML; use numbers, texts, lists or dicts")
        return Override(name, path, problems=[problem])
    return Override(f"{name}={format_value(plain)}", path, plain)


def parse_key(key: str) -> Key:
    """Split a dotted key; return an empty key if it is invalid."""
    parts = key.split(".")
    if len(parts) > MAX_DEPTH or not all(part and part.isprintable() for part in parts):
        return ()
    return tuple(int(part) if re.fullmatch("[0-9]{1,9}", part) else part for part in parts)


class _Origin(NamedTuple):
    """Location of a key in the file or the overrides, sortable in the order of reading."""

    source: int  # 0 for the file, or the number of the override
    mark: Mark
    name: str  # as in messages, such as press.yaml:7:3


class Draft:
    """Unvalidated content of a parsed file, with overrides applied, and its problems with their origins."""

    def __init__(self, file: ParsedFile) -> None:
        document = file.document
        self._name, self._marks = file.name, document.marks
        self._overrides = 0
        self._overridden: dict[Key, _Origin] = {}
        self.data: dict[str, Any] = deepcopy(document.data)
        self.problems = [(self._in_file(mark), problem) for mark, problem in document.faults]

    def override(self, override: Override) -> None:
        """Apply an override."""
        self._overrides += 1
        origin = _Origin(self._overrides, Mark(1, 1), override.name)
        mask = value_at(self.data, MASK_KEYS[0])
        if isinstance(mask, str) and override.path[:2] == MASK_KEYS[0] != override.path:
            self.data["sheet"]["mask"] = {"image": mask}
        if override.problems:
            self.problems += [(origin, problem) for problem in override.problems]
        elif problem := self._set_value(override.path, override.value, origin):
            self.problems.append((origin, problem))

    def resolve_path(self, key: Key, folder: Path) -> None:
        """Rewrite a path in the file, relative to its folder, to be relative to the current directory.

        A path outside the folder, unless from an override, and a missing camera file are recorded as problems.
        """
        section, path = value_at(self.data, key[:-1]), value_at(self.data, key)
        if not (isinstance(path, str) and 0 < len(path) <= MAX_PATH):
            return
        section[key[-1]] = str(folder / path)
        # A scene may be from an untrusted source, so it may only read files that came with it.
        is_overridden = any(key[:n] in self._overridden for n in range(1, len(key) + 1))
        if not is_overridden and not is_below(folder / path, folder):
            remedy = ", or name it with --image" if key == IMAGE_KEY else ""
            noun = "the picture" if key in PICTURE_KEYS else "it"
            message = f"{path} is not below the scene's folder; put {noun} there{remedy}"
            self.problems.append((self._origin(key), Problem(key, message)))
            section[key[-1]] = ""  # Invalid, at the same key; without the key, others would be reported as missing.
        elif key[-1] in CAMERA_FILE_KEYS:
            # Validation would report only the first missing camera file.
            try:
                actual_path(str(folder / path)).stat()
            except OSError as error:
                kind = "trajectory" if key[-1] == "poses" else "calibration"
                message = f"{folder / path}: {(error.strerror or str(error)).lower()}; name a {kind} that can be read"
                message += windows_path_hint(path)
                self.problems.append((self._origin(key), Problem(key, message)))
            except ValueError:
                pass  # Validation refuses the path.

    def report(self, problems: Iterable[Problem]) -> None:
        """Add problems with their origins, except those of keys that already have a problem."""
        keys = {problem.path for _, problem in self.problems}
        for problem in problems:
            if problem.path not in keys:
                keys.add(problem.path)
                self.problems.append((self._origin(problem.path), problem))

    def lines(self) -> list[str]:
        """Format the problems in the order of their origins."""
        ordered = sorted(self.problems, key=lambda item: item[0][:2])
        shown = [
            f"{origin.name}: {Problem(tuple(truncate(str(part)) for part in problem.path), problem.message)}"
            for origin, problem in ordered[:MAX_LINES]
        ]
        return shown if len(shown) == len(ordered) else [*shown, "and more"]

    def _in_file(self, mark: Mark) -> _Origin:
        return _Origin(0, mark, f"{self._name}:{mark.line}:{mark.column}")

    def _origin(self, path: Key) -> _Origin:
        """Return the origin of a key, or that of the innermost section or list that contains it."""
        containers = [path[:n] for n in range(len(path), -1, -1)]
        overridden = (self._overridden[key] for key in containers if key in self._overridden)
        in_file = (self._in_file(self._marks[key]) for key in containers if key in self._marks)
        return next(chain(overridden, in_file))

    def _set_value(self, path: Key, value: Any, origin: _Origin) -> Problem | None:
        """Set a key, and create missing sections above it."""
        container: Any = self.data
        key: Key = ()
        for n, part in enumerate(path):
            if isinstance(container, dict):
                part = str(part)
            elif not isinstance(container, list):
                return Problem(key, f"{format_value(container)} is not a section; set it as a whole")
            elif not (isinstance(part, int) and part < len(container)):
                is_number = str(part).isdecimal()  # in any script, or of any length
                example = ".".join(map(str, (*key, 0, *path[n:][is_number:])))
                message = f"no such item; the list has {len(container)}, counted from 0; an example is {example}"
                if not container:
                    message = "no such item; the list is empty, so set it as a whole"
                return Problem((*key, part), message)
            key = (*key, part)
            if n == len(path) - 1:
                container[part] = value
                self._overridden = {path: at for path, at in self._overridden.items() if path[: len(key)] != key}
                self._overridden[key] = origin
            elif isinstance(container, dict) and part not in container:
                container[part] = [] if isinstance(path[n + 1], int) else {}
                self._overridden[key] = origin
            container = container[part]
        return None


def is_below(path: Path, folder: Path) -> bool:
    """Return whether a path, with symbolic links resolved, is inside a folder or the folder itself."""
    try:
        return path.resolve().is_relative_to(folder.resolve())
    except (OSError, RuntimeError, ValueError):
        # A loop of links or an invalid path: reading the file later raises the error.
        return True


def read_file(name: str, kind: str, needs: str) -> ParsedFile:
    """Read and parse a YAML file, which must contain a mapping; `kind` and `needs`, its keys, are for messages."""
    try:
        document = read_yaml(_read_text(name, kind))
    except UnreadableError as error:
        raise SceneError([f"{name}:{error.mark.line}:{error.mark.column}: {error}"]) from None
    if document.data is None:
        raise SceneError([f"{name}:1:1: no keys; a {kind} needs at least {needs}"])
    if not isinstance(document.data, dict):
        message = f"{format_value(document.data)} is not a {kind}; expected keys such as {needs}"
        raise SceneError([f"{name}:1:1: {message}"])
    return ParsedFile(name, Path(name).parent, document)


def _read_text(name: str, kind: str) -> str:
    path = Path(name)
    try:
        if irregular := irregular_kind(path):
            raise SceneError([f"{name}: {irregular}; name a {kind} file"])
        with path.open("rb") as file:
            raw = file.read(MAX_BYTES + 1).removeprefix(codecs.BOM_UTF8)
    except ValueError:
        raise SceneError([f"{name}: not a path; name a {kind} file"]) from None
    except OSError as error:
        scenes = path.parent.glob("*.y*ml") if isinstance(error, FileNotFoundError) else ()
        hint = next(
            (f"; did you mean '{scene}'?" for scene in scenes if scene.stem == path.stem), windows_path_hint(name)
        )
        raise SceneError([f"{name}: {(error.strerror or str(error)).lower()}{hint}"]) from None
    if len(raw) > MAX_BYTES:
        raise SceneError([f"{name}: larger than {MAX_BYTES // 2**20} MiB; a {kind} is smaller"])
    try:
        return raw.decode()
    except UnicodeDecodeError as error:
        if path.suffix.lower() in PICTURE_SUFFIXES:
            hint = " file, and pass the picture with --image" if kind == "scene" else ""
            raise SceneError([f"{name}: a picture; name a {kind}{hint}"]) from None
        valid = raw[: error.start].decode()
        mark = mark_at(valid, len(valid))
        raise SceneError([f"{name}:{mark.line}:{mark.column}: not UTF-8; save the file as UTF-8"]) from None
