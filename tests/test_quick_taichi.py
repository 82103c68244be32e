"""The replacements for parts of Taichi that make it read our kernels sooner."""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import ast
import importlib
import inspect
import os
import subprocess
import sys
import zipfile
from collections import defaultdict
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent
from types import CodeType, FunctionType

import pytest

from taichi_msm.system import quick_taichi, runtime
from taichi_msm.system.quick_taichi import ALLOCATING, READING, replaced, source_lines, ti

# Run kernels with an error: one of a user, after one of ours was read; and one in the place of ours.
ERRORS = """
import sys, numpy as np
from taichi_msm.system import runtime
from taichi_msm.system.runtime import ti
runtime.start("cpu", 1)

@ti.kernel
def good(out: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    out[0] = 1.0

@ti.kernel
def wrong(out: ti.types.ndarray(dtype=ti.f32, ndim=1)):
    for n in range(2):
        out[n] = nowhere

array = np.zeros(2, np.float32)
with runtime.our_compilation():
    good(array)
try:
    if sys.argv[1] == "ours":
        with runtime.our_compilation():
            wrong(array)
    else:
        wrong(array)
except ti.TaichiCompilationError as error:
    print(error)
"""


def codes(code: CodeType) -> Iterator[CodeType]:
    """Give a module's code and that of every function in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from codes(constant)


def function(code: CodeType) -> FunctionType:
    """Make a function of a code, to be looked at and not to be called."""
    return FunctionType(code.replace(co_freevars=()), {})


def parsed(lines: list[str]) -> str:
    return ast.dump(ast.parse(dedent("".join(lines))))


def test_the_lines_of_a_function_are_those_that_python_finds(root: Path) -> None:
    found = 0
    for path in sorted((root / "taichi_msm").rglob("*.py")):
        lines = path.read_text().splitlines(keepends=True)
        for code in codes(compile("".join(lines), str(path), "exec")):
            first = code.co_firstlineno
            if lines and lines[first - 1].strip() in ("@ti.func", "@ti.kernel"):
                found += 1
                ours, number = source_lines(function(code))
                assert number == first
                assert parsed(ours) == parsed(inspect.getblock(lines[first - 1 :])), f"{path}:{first}"
    assert found > 40


def test_lines_are_read_again_after_a_change(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.syspath_prepend(str(tmp_path))
    (tmp_path / "changing.py").write_text("def one():\n    return 1\n")
    changing = importlib.import_module("changing")
    assert source_lines(changing.one) == (["def one():\n", "    return 1\n"], 1)
    (tmp_path / "changing.py").write_text("# Changed.\n\n\ndef one():\n    return 1 + 1\n")
    importlib.reload(changing)
    assert source_lines(changing.one) == (["def one():\n", "    return 1 + 1\n"], 4)


def test_lines_are_found_in_an_archive(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    with zipfile.ZipFile(tmp_path / "archive.zip", "w") as archive:
        archive.writestr("zipped.py", "def one():\n    return 1\n")
    monkeypatch.syspath_prepend(str(tmp_path / "archive.zip"))
    assert source_lines(importlib.import_module("zipped").one) == (["def one():\n", "    return 1\n"], 1)


def test_a_function_without_source_is_left_to_taichi() -> None:
    with pytest.raises(OSError, match="source"):
        source_lines(function(compile("1", "<nowhere>", "exec")))


def test_a_function_that_is_called_twice_is_read_like_two(device: runtime.Device) -> None:
    @ti.func
    def larger(value, step: ti.template()):
        result = value + step
        if ti.static(step > 1):
            result *= 10
        return result

    @ti.kernel
    def add(out: ti.types.ndarray(dtype=ti.i32, ndim=1)):
        for n in range(out.shape[0]):
            out[n] = larger(larger(n, 1), 2) + larger(n, 3)

    out = ti.ndarray(ti.i32, 3)
    with runtime.our_compilation():
        add(out)
    assert out.to_numpy().tolist() == [(n + 1 + 2) * 10 + (n + 3) * 10 for n in range(3)]


def test_replacements_are_in_place_for_a_while(device: runtime.Device) -> None:
    before = [getattr(owner, name) for owner, name, _ in READING]
    with runtime.our_compilation():
        assert all(getattr(owner, name) is value for owner, name, value in READING)
    assert [getattr(owner, name) for owner, name, _ in READING] == before


def test_an_interruption_takes_replacements_back() -> None:
    with pytest.raises(KeyboardInterrupt), replaced(ALLOCATING):
        raise KeyboardInterrupt
    assert not any(getattr(owner, name) is value for owner, name, value in ALLOCATING)


def test_arrays_are_made_without_tracebacks(device: runtime.Device, monkeypatch: pytest.MonkeyPatch) -> None:
    def traceback() -> str:
        raise AssertionError

    for owner, name, _ in ALLOCATING:
        monkeypatch.setattr(owner, name, traceback)
    monkeypatch.setattr(runtime, "_free", defaultdict(list))  # so that none is reused
    assert runtime.Memory().array("f32", 4, 12345).shape == (12345,)
    assert runtime.Memory().array("f64", 0, 12345).shape == (12345,)


def test_kernels_are_defined_once_and_described_like_by_python() -> None:
    described = inspect.getframeinfo

    @quick_taichi.defined_once
    def define(code: int) -> list[int]:
        frame = inspect.currentframe()
        assert frame is not None
        assert inspect.getframeinfo is not described
        mine, pythons = inspect.getframeinfo(frame), described(frame)
        # They are on two lines, or on one: the frame moves on between the calls.
        assert (mine.filename, mine.function, mine.index) == (pythons.filename, pythons.function, pythons.index)
        assert mine.code_context == pythons.code_context
        # Others may look at frames meanwhile, such as debuggers in other threads.
        assert len(inspect.stack(3)[0].code_context or ()) == 3
        return [code]

    assert define(1) is define(1)
    assert inspect.getframeinfo is described


@pytest.mark.parametrize(
    ("whose", "variables", "told"),
    [("users", {}, True), ("ours", {}, False), ("ours", {"TAICHI_MSM_TRACEBACK": "1"}, True)],
)
def test_an_error_names_its_line_where_somebody_changes_kernels(
    whose: str, variables: dict[str, str], told: bool, tmp_path: Path, root: Path
) -> None:
    (tmp_path / "kernels.py").write_text(ERRORS)
    done = subprocess.run(
        [sys.executable, tmp_path / "kernels.py", whose],
        env={**os.environ, "PYTHONPATH": str(root), **variables},
        capture_output=True,
        text=True,
        check=True,
    )
    assert 'Name "nowhere" is not defined' in done.stdout
    assert ("kernels.py" in done.stdout and "^^^^" in done.stdout) == told
