"""The imports go one way, and start-up stays light."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parent.parent / "taichi_msm"

# A module imports from earlier lines only.
ORDER = [
    {"errors", "look", "interruption", "silence", "sealed", "npz"},
    {"faults"},
    {"scene", "folder", "outlets"},
    {"lattice", "camera", "texture", "surface", "player"},
    {"picking"},
    {"stability"},
    {"loads", "budget", "yaml_reader"},
    {"validation"},
    {"scene_file", "reference", "runtime"},
    {"forces", "samples"},
    {"sweep", "gather", "coverage", "shading"},
    {"dynamics", "drawing", "gif", "publication", "trajectory"},
    {"course", "encoding"},
    {"divergence"},
    {"accuracy", "diagnosis", "checkpoint"},
    {"simulation", "notes", "plan"},
    {"files"},
    {"runner", "console"},
    {"study", "live"},
    {"cli"},
    {"__main__", "__init__"},
]
LEVEL = {name: level for level, names in enumerate(ORDER) for name in names}
MODULES = sorted(PACKAGE.rglob("*.py"))


def name_of(path: Path) -> str:
    """Name of a module, or of the package that it is a part of."""
    return path.relative_to(PACKAGE).parts[0].removesuffix(".py")


def imports(path: Path) -> set[str]:
    """Modules of this package that a module imports anywhere."""
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "taichi_msm":
            inner = node.module.split(".")[1:]
            found |= {inner[0]} if inner else {alias.name for alias in node.names}
    return found & set(LEVEL)


def third_party(path: Path) -> set[str]:
    found = set()
    for node in ast.walk(ast.parse(path.read_text(encoding="utf-8"))):
        if isinstance(node, ast.Import):
            found |= {alias.name.split(".")[0] for alias in node.names}
        elif isinstance(node, ast.ImportFrom) and node.module:
            found.add(node.module.split(".")[0])
    return found


def test_every_module_has_its_place() -> None:
    assert {name_of(path) for path in MODULES} == set(LEVEL)


@pytest.mark.parametrize("path", MODULES, ids=lambda path: str(path.relative_to(PACKAGE)))
def test_imports_go_one_way(path: Path) -> None:
    own = name_of(path)
    later = {name for name in imports(path) - {own} if LEVEL[name] >= LEVEL[own]}
    assert not later, f"{path} imports {later}, which is not below it"


def test_only_runtime_imports_taichi() -> None:
    assert [path.stem for path in MODULES if "taichi" in third_party(path)] == ["runtime"]


def test_only_the_command_line_prints_or_exits() -> None:
    for path in MODULES:
        if path.stem not in ("cli", "__main__"):
            names = {node.id for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Name)}
            assert "print" not in names, path
            assert "exit" not in names, path


@pytest.mark.parametrize("arguments", [["--help"], ["check", "scenes/press.yaml"], ["schema"]])
def test_light_commands_do_not_import_taichi(arguments: list[str], root: Path) -> None:
    code = (
        "import sys; from taichi_msm.cli import main; main(sys.argv[1:]); "
        "sys.exit('taichi' in sys.modules or 'rich' in sys.modules)"
    )
    subprocess.run([sys.executable, "-c", code, *arguments], cwd=root, check=True, stdout=subprocess.DEVNULL)


def test_importing_the_package_starts_nothing() -> None:
    code = "import sys, taichi_msm; sys.exit('numpy' in sys.modules or 'taichi' in sys.modules)"
    subprocess.run([sys.executable, "-c", code], check=True)
