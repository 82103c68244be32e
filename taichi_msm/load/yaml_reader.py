"""Parser of a safe subset of YAML 1.2, which records the line and column of each key.

The data is built directly from the events of PyYAML. Anchors, aliases, tags, further documents and deep nesting are
rejected as their events arrive; no scene needs them. So no text causes unlimited recursion, expands aliases or loads
objects. Scalars follow the core schema of YAML 1.2: 1e4 is a number, 010 is ten, `yes` is a text.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from typing import Any, NamedTuple

import yaml

from taichi_msm.errors import Key, Problem, truncate

MAX_DEPTH = 20
MAX_NODES = 100_000
_TOO_DEEP = f"nested more than {MAX_DEPTH} deep; write it flatter"

# Limit of the recorded faults, as a broken file may have tens of thousands.
MAX_FAULTS = 1000

# Characters that YAML excludes, and line breaks of YAML that editors do not count, which would shift line numbers.
_NOT_ALLOWED = re.compile("[^\t\n\r\x20-\x7e\xa0-\u2027\u202a-\ud7ff\ue000-\ufffd\U00010000-\U0010ffff]")

_NUMBERS: tuple[tuple[re.Pattern[str], Callable[[str], float]], ...] = (
    (re.compile(r"[-+]?[0-9]+"), int),
    (re.compile(r"0o[0-7]+"), lambda text: int(text, 8)),
    (re.compile(r"0x[0-9a-fA-F]+"), lambda text: int(text, 16)),
    (re.compile(r"[-+]?(\.[0-9]+|[0-9]+(\.[0-9]*)?)([eE][-+]?[0-9]+)?"), float),
    (re.compile(r"[-+]?\.(inf|Inf|INF)|\.(nan|NaN|NAN)"), lambda text: float(text.replace(".", ""))),
)
_WORDS: dict[str, bool | None] = {
    **dict.fromkeys(("", "~", "null", "Null", "NULL")),
    **dict.fromkeys(("true", "True", "TRUE"), True),
    **dict.fromkeys(("false", "False", "FALSE"), False),
}


class Mark(NamedTuple):
    """Position in a text, counted from 1."""

    line: int
    column: int


class Document(NamedTuple):
    """Content of a YAML document."""

    data: Any  # None, bool, int, float, str, and lists and dicts of these; None for an empty text
    marks: dict[Key, Mark]  # positions of all keys and of all items of lists
    faults: list[tuple[Mark, Problem]]  # the first MAX_FAULTS that did not stop parsing, with their positions


class UnreadableError(Exception):
    """The text is not YAML, or has too many values or too deep nesting; the message has no position."""

    def __init__(self, mark: Mark, message: str) -> None:
        super().__init__(message)
        self.mark = mark


def read_yaml(text: str) -> Document:
    """Parse a YAML document; raise an UnreadableError if it is invalid, too long or too deeply nested."""
    if match := _NOT_ALLOWED.search(text):
        message = f"character U+{ord(match[0]):04X} is not allowed; remove it"
        raise UnreadableError(mark_at(text, match.start()), message)
    builder = _DocumentBuilder(yaml.parse(text, Loader=yaml.CSafeLoader))
    try:
        return Document(builder.document(), builder.marks, builder.faults)
    except yaml.MarkedYAMLError as error:
        raise _syntax_error(text, error) from None
    except yaml.YAMLError as error:
        raise UnreadableError(Mark(1, 1), f"not valid YAML: {error}") from None


def mark_at(text: str, index: int) -> Mark:
    """Return the position of the character at an index of a text."""
    before = text[:index]
    return Mark(before.count("\n") + 1, index - before.rfind("\n"))


def _syntax_error(text: str, error: yaml.MarkedYAMLError) -> UnreadableError:
    if error.problem == "could not find expected ':'" and error.context_mark:
        # libyaml reports the line after the fault, or the end of the text.
        line = text[error.context_mark.index :].partition("\n")[0]
        return UnreadableError(_mark(error.context_mark), f'no ":" in "{truncate(line.strip())}"; expected KEY: VALUE')
    mark = error.problem_mark or error.context_mark
    if mark and "nesting depth" in f"{error.problem} {error.context}":
        # libyaml may reach its own limit before the first event.
        return UnreadableError(_mark(mark), _TOO_DEEP)
    index = mark.index if mark else 0
    hint = "; indent with spaces, not tabs" if text[index : index + 1] == "\t" else ""
    if error.problem == "mapping values are not allowed in this context":
        hint = "; write one KEY: VALUE a line, also in the line before"
    if re.search("escape|hexdecimal", str(error.problem)):
        hint = "; put a path with \\ in single quotes, or write it with forward slashes"
    reason = " ".join(part for part in (error.problem, error.context) if part)
    return UnreadableError(_mark(mark) if mark else Mark(1, 1), f"not valid YAML: {reason}{hint}")


def _mark(mark: Any) -> Mark:
    return Mark(mark.line + 1, mark.column + 1)


def _plain_value(text: str) -> Any:
    """Convert a plain scalar."""
    if text in _WORDS:
        return _WORDS[text]
    # Longer scalars stay texts, because Python does not convert integers of several thousand digits.
    if text[0] in "+-.0123456789" and len(text) <= 100:
        for pattern, convert in _NUMBERS:
            if pattern.fullmatch(text):
                return convert(text)
    return text


class _DocumentBuilder:
    """Builder of data, positions and faults from the events of a parser."""

    def __init__(self, events: Iterator[Any]) -> None:
        self.marks: dict[Key, Mark] = {(): Mark(1, 1)}
        self.faults: list[tuple[Mark, Problem]] = []
        self._events = events
        self._nodes = 0

    def document(self) -> Any:
        """Build the first document, and reject a second one."""
        next(self._events)
        if isinstance(next(self._events), yaml.StreamEndEvent):
            return None
        data = self._node(next(self._events), ())
        next(self._events)
        end = next(self._events)
        if not isinstance(end, yaml.StreamEndEvent):
            self._add_fault(end, (), "a second document begins here; keep one")
        return data

    def _node(self, event: Any, path: Key) -> Any:
        self._check_allowed(event, path)
        if isinstance(event, yaml.AliasEvent):
            return None
        if isinstance(event, yaml.ScalarEvent):
            return _plain_value(event.value) if event.implicit[0] else event.value
        if isinstance(event, yaml.SequenceStartEvent):
            return self._items(path)
        return self._mapping(path)

    def _check_allowed(self, event: Any, path: Key) -> None:
        """Reject events outside the subset of YAML."""
        self._nodes += 1
        if self._nodes > MAX_NODES:
            raise UnreadableError(_mark(event.start_mark), f"more than {MAX_NODES} values; write fewer")
        if len(path) > MAX_DEPTH:
            raise UnreadableError(_mark(event.start_mark), _TOO_DEEP)
        if isinstance(event, yaml.AliasEvent):
            self._add_fault(event, path, f"alias *{event.anchor} is not allowed; write the value out")
            return
        if event.anchor is not None:
            self._add_fault(event, path, f"anchor &{event.anchor} is not allowed; remove it")
        if event.tag is not None:
            tag = event.tag.replace("tag:yaml.org,2002:", "!!")
            self._add_fault(event, path, f"tag {tag} is not allowed; remove it")

    def _add_fault(self, event: Any, path: Key, message: str) -> None:
        if len(self.faults) < MAX_FAULTS:
            self.faults.append((_mark(event.start_mark), Problem(path, message)))

    def _items(self, path: Key) -> list[Any]:
        items: list[Any] = []
        while not isinstance(event := next(self._events), yaml.SequenceEndEvent):
            item = (*path, len(items))
            self.marks.setdefault(item, _mark(event.start_mark))
            items.append(self._node(event, item))
        return items

    def _mapping(self, path: Key) -> dict[str, Any]:
        mapping: dict[str, Any] = {}
        while not isinstance(event := next(self._events), yaml.MappingEndEvent):
            if not isinstance(event, yaml.ScalarEvent):
                raise UnreadableError(_mark(event.start_mark), "a key must be text; put it in quotes")
            key_path = (*path, event.value)
            self.marks.setdefault(key_path, _mark(event.start_mark))
            key = self._node(event, key_path)
            value = self._node(next(self._events), key_path)
            if not isinstance(key, str):
                self._add_fault(event, key_path, "a key must be text; put it in quotes")
            elif key in mapping:
                first = self.marks[key_path].line
                self._add_fault(event, key_path, f"given twice, first in line {first}; keep one")
            else:
                mapping[key] = value
        return mapping
