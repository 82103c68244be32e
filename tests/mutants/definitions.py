"""Definitions of the package by name, and search of their text regardless of white space."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from textwrap import dedent, indent
from typing import NamedTuple


class Definition(NamedTuple):
    """A function, a method, a class, or a constant of a module or a class."""

    name: str  # qualified, with the names of package and modules
    file: Path  # relative to the root of the project
    start: int  # of the source in the file [characters]
    source: str  # with decorators

    def spans(self, text: str) -> list[tuple[int, int]]:
        """Find text in the source, regardless of white space and of commas before closing brackets."""
        matches = _pattern(text).finditer(self.source)
        return [(self.start + match.start(), self.start + match.end()) for match in matches]


def definitions(root: Path, package: str) -> tuple[Definition, ...]:
    """Read all definitions of a package."""
    return tuple(
        definition
        for path in sorted((root / package).rglob("*.py"))
        for definition in _definitions(root, path.relative_to(root), path.stat().st_mtime_ns)
    )


def named(name: str, known: tuple[Definition, ...]) -> list[Definition]:
    """Return the definitions whose qualified name is `name` or ends with it."""
    return [definition for definition in known if f".{definition.name}".endswith(f".{name}")]


def replaced(source: str, span: tuple[int, int], text: str) -> str:
    """Return the source with a span replaced; further lines are indented like the first line of the span."""
    begin, end = span
    line = source[source.rfind("\n", 0, begin) + 1 : begin]
    margin = line[: len(line) - len(line.lstrip())]
    return source[:begin] + indent(dedent(text).strip(), margin).removeprefix(margin) + source[end:]


@cache
def _definitions(root: Path, file: Path, _changed: int) -> tuple[Definition, ...]:
    source = (root / file).read_text(encoding="utf-8")
    starts = [0]
    for line in source.splitlines(keepends=True):
        starts.append(starts[-1] + len(line))

    def within(body: ast.AST, prefix: str, *, in_function: bool) -> Iterator[Definition]:
        for node in ast.iter_child_nodes(body):
            inner, is_function = prefix, isinstance(node, ast.FunctionDef)
            for name, lines in _names(node, constants=not in_function):
                inner = f"{prefix}.{name}"
                begin, end = starts[lines.start], starts[lines.stop]
                yield Definition(inner, file, begin, source[begin:end])
            yield from within(node, inner, in_function=in_function or is_function)

    module = ".".join(file.with_suffix("").parts).removesuffix(".__init__")
    return tuple(within(ast.parse(source), module, in_function=False))


def _names(node: ast.AST, *, constants: bool) -> Iterator[tuple[str, slice]]:
    """Yield the names that a node defines, and its lines, counted from 0."""
    if isinstance(node, ast.FunctionDef | ast.ClassDef):
        first = min((decorator.lineno for decorator in node.decorator_list), default=node.lineno)
        yield node.name, slice(first - 1, node.end_lineno)
    elif constants and isinstance(node, ast.Assign | ast.AnnAssign):
        targets = node.targets if isinstance(node, ast.Assign) else [node.target]
        names = [part.id for target in targets for part in ast.walk(target) if isinstance(part, ast.Name)]
        yield from ((name, slice(node.lineno - 1, node.end_lineno)) for name in names)


def _pattern(text: str) -> re.Pattern[str]:
    tokens = re.findall(r"\w+|[^\w\s]", re.sub(r",\s*([)\]}])", r"\1", text))
    parts = [rf",?\s*{re.escape(token)}" if token in ")]}" else re.escape(token) for token in tokens]
    first, last = (r"\b" if re.match(r"\w", token) else "" for token in (tokens[0], tokens[-1]))
    return re.compile(first + r"\s*".join(parts) + last)
