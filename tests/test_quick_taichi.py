"""The replacements for parts of Taichi that make it read our kernels sooner."""

# No `from __future__ import annotations` here: Taichi reads the annotations of a kernel.

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path
from textwrap import dedent
from types import CodeType

from taichi_msm.system import runtime
from taichi_msm.system.quick_taichi import lines_of, reading, ti


def codes(code: CodeType) -> Iterator[CodeType]:
    """Give a module's code and that of every function in it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from codes(constant)


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
                ours, number = lines_of(code)
                assert number == first
                assert parsed(ours) == parsed(inspect.getblock(lines[first - 1 :])), f"{path}:{first}"
    assert found > 40


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


def test_a_users_kernels_are_read_by_taichi_alone() -> None:
    before = [getattr(owner, name) for owner, name, _ in reading()]
    with runtime.our_compilation():
        assert [getattr(owner, name) for owner, name, _ in reading()] != before
    assert [getattr(owner, name) for owner, name, _ in reading()] == before
