"""Docstrings: sections of arguments on public names and interfaces, and nowhere else.

`Args:`, `Returns:` and `Raises:` are read where somebody calls or implements a function from its page. Elsewhere names
and signature carry the meaning, and one line adds shapes and units.
"""

from __future__ import annotations

import ast
import re
from collections.abc import Iterator

import pytest

from taichi_msm import _NAMES
from tests.test_architecture import MODULES, PACKAGE, tree

CLASSES = {node.name: node for path in MODULES for node in ast.walk(tree(path)) if isinstance(node, ast.ClassDef)}


PUBLIC = {(f"{module.replace('.', '/')}.py", name) for module, names in _NAMES.items() for name in names.split()}

# Interfaces that others implement.
INTERFACES = {"Term", "Law", "LensModel", "Shape", "Observation", "ObservationModel", "FormatWriter", "RunWriter"}
INTERFACES |= {"CalibrationReader", "TrajectoryReader"}

SECTIONS = re.compile(r"^ *(Args|Returns|Raises|Yields):", re.MULTILINE)


def faults(node: ast.AST, file: str, owner: str | None = None) -> Iterator[str]:
    """Yield missing and superfluous sections of the functions of a file; `owner` is the class or function around."""
    for child in ast.iter_child_nodes(node):
        name = getattr(child, "name", None)
        if isinstance(child, ast.FunctionDef):
            is_documented = owner in INTERFACES or (file, owner or child.name) in PUBLIC
            by_base = owner in CLASSES and not ast.get_docstring(child) and is_inherited(CLASSES[owner], child.name)
            if not is_documented and SECTIONS.search(ast.get_docstring(child) or ""):
                yield f"{child.lineno} {child.name}: sections"
            elif is_documented and not by_base and not child.name.startswith("_"):
                yield from (f"{child.lineno} {child.name}: {part}" for part in missing(child))
            yield from faults(child, file, "<function>")
        else:
            yield from faults(child, file, name if isinstance(child, ast.ClassDef) else owner)


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


def test_sections_stand_on_public_names_and_interfaces() -> None:
    files = [(path, path.relative_to(PACKAGE).as_posix()) for path in MODULES]
    found = [f"{file}:{fault}" for path, file in files for fault in faults(tree(path), file)]
    assert not found, "\n".join(found)


DOCSTRING = '"""Add.\n\n    Args:\n        a: first.\n        b: second.\n    """'


@pytest.mark.parametrize(
    ("source", "expected"),
    [
        (f"def fit(a, b):\n    {DOCSTRING}", []),
        ("def fit(a, b): pass", ["Args lacks a", "Args lacks b"]),
        (f"def fit(a, b, c):\n    {DOCSTRING}", ["Args lacks c"]),
        ("def fit(a): pass\ndef f(a, b): pass", []),
        (f"def f(a, b):\n    {DOCSTRING}", ["sections"]),
        (f"def fit(a):\n    def g(a, b):\n        {DOCSTRING}", ["sections"]),
        (f"def fit(a, b) -> int:\n    {DOCSTRING}", ["Returns"]),
        (f"def fit(a, b) -> int:\n    {DOCSTRING}".replace("Add.", "Return a + b."), []),
        (f"def fit(a, b):\n    {DOCSTRING}\n    raise OSError(a)", ["Raises lacks OSError"]),
        (f"class Law:\n  def f(self, a, b):\n    {DOCSTRING}\nclass B(Law):\n  def f(self, a, b): pass", []),
        ("class Law:\n  def f(self, a, b): pass\n  def _g(self, a, b): pass", ["Args lacks a", "Args lacks b"]),
    ],
)
def test_rules(source: str, expected: list[str], monkeypatch: pytest.MonkeyPatch) -> None:
    module = ast.parse(source)
    for node in module.body:
        if isinstance(node, ast.ClassDef):
            monkeypatch.setitem(CLASSES, node.name, node)
    assert [fault.partition(": ")[2] for fault in faults(module, "fitting/fit.py")] == expected
