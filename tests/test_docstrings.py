"""Docstrings: Google style for public functions, methods and kernels with two or more arguments."""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import pytest

from tests.test_architecture import MODULES, PACKAGE, tree

CLASSES = {node.name: node for path in MODULES for node in ast.walk(tree(path)) if isinstance(node, ast.ClassDef)}


def faults(node: ast.AST, class_: ast.ClassDef | None = None, *, nested: bool = False) -> Iterator[str]:
    """Yield the missing parts of the docstrings of public functions and methods, and of nested kernels."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.FunctionDef):
            decorators = {ast.unparse(decorator).split("(")[0] for decorator in child.decorator_list}
            is_private = child.name.startswith("_") or (class_ is not None and class_.name.startswith("_"))
            by_base = class_ is not None and not ast.get_docstring(child) and is_inherited(class_, child.name)
            # The options of a command have help texts.
            exempt = is_private or by_base or "options.program.command" in decorators
            if not exempt and (not nested or "ti.kernel" in decorators):
                yield from (f"{child.lineno} {child.name}: {part}" for part in missing(child))
            yield from faults(child, nested=True)
        else:
            yield from faults(child, child if isinstance(child, ast.ClassDef) else class_, nested=nested)


def is_inherited(class_: ast.ClassDef, name: str) -> bool:
    bases = [CLASSES.get(ast.unparse(base).split("[")[0].split(".")[-1]) for base in class_.bases]
    methods = {node.name for base in bases if base for node in base.body if isinstance(node, ast.FunctionDef)}
    return name in methods or any(is_inherited(base, name) for base in bases if base)


def missing(function: ast.FunctionDef) -> Iterator[str]:
    given, text = function.args, ast.get_docstring(function) or ""
    nodes = [*given.posonlyargs, *given.args, *given.kwonlyargs, *filter(None, (given.vararg, given.kwarg))]
    names = [node.arg for node in nodes if node.arg not in ("self", "cls") and not node.arg.startswith("_")]
    if len(names) < 2:
        return
    arguments = text.partition("Args:")[2].partition("Returns:")[0].partition("Raises:")[0]
    yield from (
        f"Args lacks {name}" for name in names if not re.search(rf"^ +.*\b{name}\b.*:", arguments, re.MULTILINE)
    )
    returns = function.returns is not None and ast.unparse(function.returns) not in ("None", "NoReturn")
    if returns and not re.search(r"\A(Return|Yield)|^ *(Returns|Yields):", text, re.MULTILINE):
        yield "Returns"
    if errors := raised(function) if "Raises:" not in text else set():
        yield f"Raises lacks {', '.join(sorted(errors))}"


def raised(node: ast.AST) -> set[str]:
    """Return the names of the errors that a function raises itself."""
    names = set()
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Raise) and child.exc:
            name = ast.unparse(child.exc).split("(")[0]
            names |= {name} if name[0].isupper() else set()
        if not isinstance(child, ast.FunctionDef | ast.Lambda | ast.ClassDef):
            names |= raised(child)
    return names


def test_public_functions_are_documented() -> None:
    found = [f"{path.relative_to(PACKAGE)}:{fault}" for path in MODULES for fault in faults(tree(path))]
    assert not found, "\n".join(found)


DOCSTRING = '"""Add.\n\n    Args:\n        a: first.\n        b: second.\n    """'


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        (f"def f(a, b):\n    {DOCSTRING}", []),
        ("def f(a, b): pass", ["Args lacks a", "Args lacks b"]),
        (f"def f(a, b, c):\n    {DOCSTRING}", ["Args lacks c"]),
        ("def f(a): pass\ndef _f(a, b): pass\n@options.program.command()\ndef g(a, b): pass", []),
        ("def f():\n    @ti.kernel\n    def g(a, b): pass", ["Args lacks a", "Args lacks b"]),
        (f"def f(a, b) -> int:\n    {DOCSTRING}", ["Returns"]),
        (f"def f(a, b) -> int:\n    {DOCSTRING}".replace("Add.", "Return a + b."), []),
        (f"def f(a, b):\n    {DOCSTRING}\n    raise OSError(a)", ["Raises lacks OSError"]),
        (f"class A:\n  def f(self, a, b):\n    {DOCSTRING}\nclass B(A):\n  def f(self, a, b): pass", []),
        ("class A: pass\nclass B(A):\n  def f(self, a, b): pass", ["Args lacks a", "Args lacks b"]),
    ],
)
def test_rules(source: str, expected: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    module = ast.parse(source)
    for node in module.body:
        if isinstance(node, ast.ClassDef):
            monkeypatch.setitem(CLASSES, node.name, node)
    assert [fault.partition(": ")[2] for fault in faults(module)] == expected
