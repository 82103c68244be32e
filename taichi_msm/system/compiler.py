"""The compiler of the kernels: Taichi, or Quadrants, its maintained fork. Only this module distinguishes them."""

from __future__ import annotations

import ast
import os
import platform
import sys
import textwrap
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import import_module
from pathlib import Path
from types import SimpleNamespace
from typing import Any

from taichi_msm.errors import DeviceError, NotInstalledError, did_you_mean
from taichi_msm.system.files import private_folder
from taichi_msm.version import __version__

# Environment variable with the name of the compiler.
COMPILER_VARIABLE = "TAICHI_MSM_COMPILER"

# Attributes to patch: object, name, value.
Patches = list[tuple[Any, str, Any]]


@dataclass(frozen=True)
class Compiler:
    """A supported compiler, which may not be installed."""

    name: str  # name of its package, also in run.json
    title: str  # name in messages
    prefix: str  # prefix of its environment variables
    cache: str  # directory of compiled kernels, relative to the home directory
    lock: str  # lock file of the cache, relative to that directory
    tested_version: str  # version with the same bits on a CPU as that of the other compiler
    python_versions: str  # versions of Python with wheels of it
    # Time to poll a counter that another thread writes [s], measured on Zen 4; Taichi fences the read by `mfence`,
    # Quadrants by a locked `or`.
    poll_s: float

    @property
    def version(self) -> str:
        """The installed version; empty if it is not installed."""
        from importlib import metadata

        try:
            return metadata.version(self.name)
        except metadata.PackageNotFoundError:
            return ""

    @property
    def remedy(self) -> str:
        """The command that installs it."""
        return f"pip install {self.name}=={self.tested_version} ({self.python_versions})"

    @property
    def folder_variable(self) -> str:
        """The environment variable that overrides the directory of compiled kernels."""
        return f"{self.prefix}_OFFLINE_CACHE_FILE_PATH"

    def folder(self) -> Path:
        """Return the directory of compiled kernels."""
        return Path(os.environ.get(self.folder_variable) or Path.home() / self.cache)

    def load(self) -> Any:
        """Import the compiler, without its banner on stdout and its check for a newer version."""
        if not os.environ.get("HOME"):
            # Taichi aborts the process if HOME is missing.
            os.environ.pop("HOME", None)
            folder = os.path.expanduser("~")  # noqa: PTH111  # Path.home raises if there is no home directory
            os.environ["HOME"] = folder if folder != "~" else private_folder()
        os.environ.setdefault(f"ENABLE_{self.name.upper()}_HEADER_PRINT", "0")
        os.environ.setdefault(f"{self.prefix}_SKIP_VERSION_CHECK", "ON")
        # In a notebook the import logs a message, and an unknown log level makes the import fail. This level applies to
        # the import only; `init` sets its own.
        level = f"{self.prefix}_LOG_LEVEL"
        previous = os.environ.get(level)
        os.environ[level] = "error"
        try:
            return import_module(self.name)
        except ImportError as error:
            raise NotInstalledError(f"{self.title} cannot be imported: {error}; {self.remedy}") from error
        finally:
            del os.environ[level]
            if previous is not None:
                os.environ[level] = previous

    @cached_property
    def patches(self) -> Patches:
        """Patches for faster parsing of the kernels of this package; empty for an untested version.

        A compiler parses all kernels in every process, because the keys of its cache depend on the parsed kernels. With
        the patches it looks up the source of a function once, not at every call, and does not prepare the source lines
        of every node for error messages.
        """
        if "TAICHI_MSM_TRACEBACK" in os.environ or self.version != self.tested_version:
            return []
        nodes = import_module(f"{self.name}.lang.ast.ast_transformer_utils")
        if self.name == "taichi":
            reader = import_module("taichi.lang.ast.ast_transformer")

            def read(context: Any, node: ast.AST) -> Any:
                return getattr(reader.ASTTransformer, f"build_{type(node).__name__}")(context, node)

            sources = import_module("taichi.lang.kernel_impl")
            return [
                (nodes.ASTTransformerContext, "get_pos_info", lambda context, node: ""),
                (reader, "build_stmt", read),
                (sources, "getsourcefile", cache(sources.getsourcefile)),
                (sources, "getsourcelines", cache(sources.getsourcelines)),
                # Taichi wraps every line at 9999 columns, which only removes trailing spaces.
                (sources, "textwrap", SimpleNamespace(fill=lambda line, **_: line.rstrip(), dedent=textwrap.dedent)),
            ]
        kernels = import_module("quadrants.lang.kernel")
        look_up = kernels.Kernel._try_load_fastcache

        def skip_dataclasses(kernel: Any, arguments: Any, key: Any) -> Any:
            look_up(kernel, arguments, key)
            return kernel.used_py_dataclass_parameters_by_key_enforcing.setdefault(key, set())

        return [
            (nodes.ASTTransformerFuncContext, "memoized_get_pos_info", lambda context, node: ""),
            # Quadrants parses every kernel twice to find the fields of dataclasses in use; these kernels have none.
            (kernels.Kernel, "_try_load_fastcache", skip_dataclasses),
            (kernels._kernel_impl_dataclass, "unpack_ast_struct_expressions", lambda tree, struct_locals: tree),
        ]


# Supported compilers, in the order of preference.
COMPILERS = {
    "taichi": Compiler(
        name="taichi",
        title="Taichi",
        prefix="TI",
        cache=".cache/taichi/ticache",
        lock="ticache.lock",
        tested_version="1.7.4",
        python_versions="Python 3.10 to 3.13",
        poll_s=33e-9,
    ),
    "quadrants": Compiler(
        name="quadrants",
        title="Quadrants",
        prefix="QD",
        cache=".cache/quadrants/qdcache",
        lock="kernel_compilation_manager/qdcache.lock",
        tested_version="1.4.0",
        python_versions="Python 3.12 to 3.14",
        poll_s=3.4e-9,
    ),
}


@cache
def active_compiler() -> Compiler:
    """Return the compiler that this process uses, without importing it."""
    wanted = os.environ.get(COMPILER_VARIABLE)
    if wanted and wanted not in COMPILERS:
        hint = did_you_mean(wanted, list(COMPILERS))
        raise DeviceError(f"{COMPILER_VARIABLE}: {wanted!r} is not a compiler; take {' or '.join(COMPILERS)}{hint}")
    candidates = [COMPILERS[wanted]] if wanted else list(COMPILERS.values())
    for compiler in candidates:
        if compiler.version:
            return compiler
    if wanted:
        raise NotInstalledError(
            f"{COMPILER_VARIABLE}: {wanted} is not installed; {candidates[0].remedy}, or unset {COMPILER_VARIABLE}"
        )
    raise NotInstalledError(f"no compiler is installed; {' or '.join(compiler.remedy for compiler in candidates)}")


def compiler_label(versions: Mapping[str, str]) -> str:
    """Return title and version of the compiler among recorded versions, such as "Taichi 1.7.4"."""
    return next(
        f"{compiler.title} {versions[compiler.name]}" for compiler in COMPILERS.values() if compiler.name in versions
    )


def result_versions(versions: Mapping[str, str], arch: str) -> dict[str, str]:
    """Return the versions that determine the bits of results: all except that of a tested compiler on a CPU."""
    return {
        name: version
        for name, version in versions.items()
        if arch != "cpu" or name not in COMPILERS or version != COMPILERS[name].tested_version
    }


def versions() -> dict[str, str]:
    """Return the versions of all software that affects the results, by name."""
    # These imports are slow, and most commands do not need them.
    import numpy as np
    import PIL

    return {
        "taichi-msm": __version__,
        "python": platform.python_version(),
        active_compiler().name: active_compiler().version,
        "numpy": np.__version__,
        "pillow": PIL.__version__,
        "platform": f"{sys.platform} {platform.machine()}",
    }
