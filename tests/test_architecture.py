"""Architecture: imports point down, functions are small, and start-up is light."""

from __future__ import annotations

import ast
import subprocess
import sys
from functools import cache
from pathlib import Path

PACKAGE = Path(__file__).parent.parent / "taichi_msm"

# A module or a package imports from earlier lines, and a package from itself.
LAYERS = [
    {"arithmetic", "errors", "plot_style", "version"},
    {"dual", "system"},
    {"images", "integrators", "laws", "lenses", "shapes"},
    {"array_files"},
    {"camera_files", "surfaces"},
    {"scene"},
    {"cameras"},
    {"model"},
    {"terms"},
    {"solver"},
    {"accuracy"},
    {"render"},
    {"load"},
    {"gradients"},
    {"runs"},
    {"datasets", "exports", "machines", "study", "sweeps", "view"},
    {"fitting", "palpation"},
    {"cli"},
    {"__main__", "__init__"},
]
LAYER = {name: level for level, names in enumerate(LAYERS) for name in names}
MODULES = sorted(PACKAGE.rglob("*.py"))


def module_name(path: Path) -> str:
    """Dotted name of a module within the package; of a package that of its __init__.py."""
    parts = path.relative_to(PACKAGE).with_suffix("").parts
    return ".".join(parts[:-1] if len(parts) > 1 and parts[-1] == "__init__" else parts)


NAMES = {module_name(path) for path in MODULES}


@cache
def tree(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"))


def imports(path: Path) -> set[str]:
    """Modules of this package that a module imports anywhere."""
    names = set()
    for node in ast.walk(tree(path)):
        if isinstance(node, ast.ImportFrom) and node.module and node.module.split(".")[0] == "taichi_msm":
            inner = node.module.partition(".")[2]
            # An imported name may be that of a module, or of something in a module.
            names |= {name for alias in node.names if (name := f"{inner}.{alias.name}".strip(".")) in NAMES} or {inner}
    return names & NAMES


def third_party(path: Path) -> set[str]:
    nodes = list(ast.walk(tree(path)))
    names = {alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names}
    names |= {node.module for node in nodes if isinstance(node, ast.ImportFrom) and node.module}
    return {name.split(".")[0] for name in names}


def test_every_module_has_a_layer() -> None:
    assert {name.split(".")[0] for name in NAMES} == set(LAYER)


def test_imports_point_down() -> None:
    for path in MODULES:
        package = module_name(path).split(".")[0]
        for name in imports(path):
            imported = name.split(".")[0]
            assert imported == package or LAYER[imported] < LAYER[package], f"{path} imports {name}, not below it"


def test_no_import_cycles() -> None:
    graph = {module_name(path): imports(path) - {module_name(path)} for path in MODULES}
    while leaves := {name for name, needed in graph.items() if not needed}:
        graph = {name: needed - leaves for name, needed in graph.items() if name not in leaves}
    assert not graph, f"in an import cycle, or above one: {sorted(graph)}"


def test_only_the_compiler_module_knows_compilers() -> None:
    for path in MODULES:
        texts = {node.value for node in ast.walk(tree(path)) if isinstance(node, ast.Constant)}
        known = {"taichi", "quadrants"} & (texts | third_party(path))
        assert bool(known) == (path.stem == "compiler"), f"{path} knows {known}"


def test_only_the_command_line_prints_or_exits() -> None:
    for path in MODULES:
        if path.parent.stem != "cli" and path.stem != "__main__":
            names = {node.id for node in ast.walk(tree(path)) if isinstance(node, ast.Name)}
            assert "print" not in names, path
            assert "exit" not in names, path


def test_no_module_shadows_the_standard_library() -> None:
    assert not {path.stem for path in MODULES} & set(sys.stdlib_module_names)


# Number of arguments of Python's and of Taichi's functions, and of lines, with those of nested functions.
MOST_ARGUMENTS, MOST_ARGUMENTS_OF_TAICHI, MOST_LINES = 10, 16, 150


def test_size_of_functions() -> None:
    for path in MODULES:
        for node in ast.walk(tree(path)):
            if isinstance(node, ast.FunctionDef):
                decorators = {ast.unparse(decorator) for decorator in node.decorator_list}
                # The formula of a lens becomes a function of Taichi.
                in_kernels = {"ti.func", "ti.kernel"} & decorators or path.parent.name == "lenses"
                most = MOST_ARGUMENTS_OF_TAICHI if in_kernels else MOST_ARGUMENTS
                count = len(node.args.posonlyargs + node.args.args + node.args.kwonlyargs)
                # A command has an argument for every option.
                assert count <= most or "options.program.command()" in decorators, f"{path}: {node.name}: {count}"
                lines = (node.end_lineno or 0) - node.lineno + 1
                assert lines <= MOST_LINES, f"{path}: {node.name}: {lines} lines"


STARTS = """
import sys
import taichi_msm
assert not {"taichi", "quadrants", "numpy"} & set(sys.modules)
from taichi_msm.cli.main import main
for command in (["--help"], ["schema"], ["check", "scenes/press.yaml"]):
    main(command)
assert not {"taichi", "quadrants", "rich", "tornado"} & set(sys.modules)
"""


def test_light_commands_load_no_compiler(root: Path) -> None:
    subprocess.run([sys.executable, "-c", STARTS], cwd=root, check=True, stdout=subprocess.DEVNULL)


def test_only_the_servers_of_sessions_import_tornado() -> None:
    assert [path.stem for path in MODULES if "tornado" in third_party(path)] == ["chooser", "server", "web"]
    assert [path.stem for path in MODULES if "view.server" in imports(path)] == ["view"]
