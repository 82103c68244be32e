"""Import Taichi, and have it read our kernels, sooner.

Taichi reads a kernel in every process, as the key of its cache is made from what it reads. For a short run this is a
large part of all work. The replacements here are in place only while Taichi is imported or a kernel of ours is read.
"""

from __future__ import annotations

import ast
import contextlib
import inspect
import linecache
import os
import tempfile
import textwrap
from collections.abc import Callable, Iterator
from functools import cache, wraps
from types import CodeType, FrameType, FunctionType, SimpleNamespace, TracebackType
from typing import TYPE_CHECKING, Any, TypeVar

if TYPE_CHECKING:
    from functools import _lru_cache_wrapper

__all__ = ["ALLOCATING", "READING", "Parts", "defined_once", "replaced", "source_lines", "ti"]

Code = TypeVar("Code")
Kernels = TypeVar("Kernels")

# Attributes to replace: object, name, value.
Parts = list[tuple[Any, str, Any]]


@contextlib.contextmanager
def replaced(parts: Parts) -> Iterator[None]:
    """Give attributes of objects other values for a while."""
    found = [(owner, name, getattr(owner, name)) for owner, name, _ in parts]
    for owner, name, value in parts:
        setattr(owner, name, value)
    try:
        yield
    finally:
        for owner, name, value in found:
            setattr(owner, name, value)


def _frame_info(frame: FrameType | TracebackType, context: int = 1) -> inspect.Traceback:
    """Describe a frame as `inspect.getframeinfo` does, which searches all modules for that of the frame.

    Taichi asks for the frame above every function that it defines, and reads its line.
    """
    if context != 1 or not isinstance(frame, FrameType):
        return _get_frame_info(frame, context)
    code = frame.f_code
    line = linecache.getline(code.co_filename, frame.f_lineno)
    return inspect.Traceback(code.co_filename, frame.f_lineno, code.co_name, [line], 0)


_get_frame_info = inspect.getframeinfo
_DEFINING: Parts = [(inspect, "getframeinfo", _frame_info)]

if not os.environ.get("HOME"):
    # Without HOME, Taichi aborts the process.
    os.environ.pop("HOME", None)
    _folder = os.path.expanduser("~")  # noqa: PTH111  # Path.home raises where there is none
    os.environ["HOME"] = _folder if _folder != "~" else tempfile.gettempdir()

# No banner on stdout, which may be JSON, and no check for a newer version over the network.
os.environ.setdefault("ENABLE_TAICHI_HEADER_PRINT", "0")
os.environ.setdefault("TI_SKIP_VERSION_CHECK", "ON")

# In a notebook, Taichi reports on import that it is in one. This level is for the import only; ti.init sets its own.
os.environ.setdefault("TI_LOG_LEVEL", "error")

with replaced(_DEFINING):
    import taichi as ti
    from taichi.lang import _ndarray, kernel_impl, matrix, matrix_ops  # noqa: F401  # imported with the first kernel
    from taichi.lang._wrap_inspect import getsourcelines
    from taichi.lang.ast import ast_transformer
    from taichi.lang.ast.ast_transformer_utils import ASTTransformerContext

if os.environ["TI_LOG_LEVEL"] == "error":
    del os.environ["TI_LOG_LEVEL"]


# What to replace while an array is made: Taichi keeps a formatted traceback with each.
ALLOCATING: Parts = [(module, "get_traceback", lambda: "") for module in (matrix, _ndarray)]


def defined_once(define: Callable[[Code], Kernels]) -> _lru_cache_wrapper[Kernels]:
    """Cache a function that defines kernels, in which Taichi is to define them sooner."""

    @cache
    @wraps(define)
    def quickly(code: Code) -> Kernels:
        with replaced(_DEFINING):
            return define(code)

    return quickly


def source_lines(function: FunctionType) -> tuple[list[str], int]:
    """Give the lines of a function, and the number of the first, as `inspect.getsourcelines` does, but find them once.

    Taichi asks for them whenever it reads a call, and `inspect` takes them apart into tokens to find the end.
    """
    code = function.__code__
    if code not in _lines:
        linecache.checkcache(code.co_filename)
        following = linecache.getlines(code.co_filename, function.__globals__)[code.co_firstlineno - 1 :]
        found = _until_end(following), code.co_firstlineno
        _lines[code] = found if following else getsourcelines(function)
    return _lines[code]


_lines: dict[CodeType, tuple[list[str], int]] = {}


def _until_end(lines: list[str]) -> list[str]:
    """Cut lines that begin with a function after its end.

    In code formatted by ruff, the next line that is indented no more than the first is not of the function any more,
    unless it is the closing parenthesis of the arguments.
    """
    margin = len(lines[0]) - len(lines[0].lstrip()) if lines else 0
    body = next((n + 1 for n, line in enumerate(lines) if line.lstrip().startswith("def ")), len(lines))
    end = (n for n in range(body, len(lines)) if lines[n][: margin + 1].strip(" )\n"))
    return lines[: next(end, len(lines))]


def _parse(source: str) -> ast.Module:
    """Parse a kernel, or a function, once: Taichi parses it for every call, and looks at nothing left of another call.

    Of a kernel, which it parses once anyway, it removes the arguments.
    """
    return ast.parse(source) if source.startswith("@ti.kernel") else _parse_function(source)


_parse_function = cache(ast.parse)


def _read_node(context: Any, node: ast.AST) -> Any:
    """Read a node of a kernel's syntax tree, as Taichi's `build_stmt` does, but keep nothing for an error message."""
    return getattr(ast_transformer.ASTTransformer, f"build_{type(node).__name__}")(context, node)


# What to replace while a kernel of ours is read.
READING: Parts = [
    (kernel_impl, "getsourcefile", lambda function: function.__code__.co_filename),
    (kernel_impl, "getsourcelines", source_lines),
    # Taichi expands tabs by `textwrap.fill`, which takes each line apart into words. We use no tabs.
    (kernel_impl, "textwrap", SimpleNamespace(fill=lambda line, **how: line.rstrip(), dedent=textwrap.dedent)),
    (kernel_impl, "ast", SimpleNamespace(parse=_parse)),
]
if "TAICHI_MSM_TRACEBACK" not in os.environ:
    # For every node of a kernel, Taichi prepares the source line that an error would show. It is useful only to those
    # who change a kernel.
    READING += [
        (ASTTransformerContext, "get_pos_info", lambda self, node: ""),
        (ast_transformer, "build_stmt", _read_node),
    ]
