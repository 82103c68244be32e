"""The compiler of our kernels: Taichi, or Quadrants, its maintained fork. No other module knows which of them it is.

The versions that results depend on.
"""

from __future__ import annotations

import ast
import os
import platform
import sys
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cache, cached_property
from importlib import import_module
from pathlib import Path
from typing import Any

from taichi_msm.errors import DeviceError, NotInstalledError, did_you_mean
from taichi_msm.system.files import private_folder
from taichi_msm.version import __version__

# The environment variable that chooses.
CHOICE = "TAICHI_MSM_COMPILER"

# Attributes to replace: object, name, value.
Parts = list[tuple[Any, str, Any]]


@dataclass(frozen=True)
class Compiler:
    """A compiler that can be imported."""

    name: str  # of its package, also in run.json
    title: str  # its name in a sentence
    prefix: str  # of its environment variables
    cache: str  # folder of compiled kernels, from the home directory
    lock: str  # on that folder, from the folder
    tested: str  # the version whose results on a CPU have the same bits as those of the other compiler
    pythons: str  # that it can be installed for
    # Time of a look at a counter that another thread writes [s], measured on Zen 4: Taichi's LLVM fences it by
    # `mfence`, that of Quadrants by a locked `or`.
    look: float

    @property
    def version(self) -> str:
        """The version that is installed; empty if none is."""
        from importlib import metadata

        try:
            return metadata.version(self.name)
        except metadata.PackageNotFoundError:
            return ""

    @property
    def remedy(self) -> str:
        """What to do where it is not installed."""
        return f"pip install {self.name}=={self.tested} ({self.pythons})"

    @property
    def folder_variable(self) -> str:
        """The environment variable that names another folder of compiled kernels."""
        return f"{self.prefix}_OFFLINE_CACHE_FILE_PATH"

    def folder(self) -> Path:
        """Give the folder of compiled kernels; RuntimeError: there is no home directory."""
        return Path(os.environ.get(self.folder_variable) or Path.home() / self.cache)

    def load(self) -> Any:
        """Import it, without its banner on stdout, which may be JSON, and its look for a newer version.

        Raises:
            NotInstalledError: when it cannot be imported.
        """
        if not os.environ.get("HOME"):
            # Without HOME, it aborts the process.
            os.environ.pop("HOME", None)
            folder = os.path.expanduser("~")  # noqa: PTH111  # Path.home raises where there is none
            os.environ["HOME"] = folder if folder != "~" else private_folder()
        os.environ.setdefault(f"ENABLE_{self.name.upper()}_HEADER_PRINT", "0")
        os.environ.setdefault(f"{self.prefix}_SKIP_VERSION_CHECK", "ON")
        # In a notebook, it reports on import that it is in one, and a level that it does not know ends the import. This
        # level is for the import only; `init` sets its own.
        level = f"{self.prefix}_LOG_LEVEL"
        before = os.environ.get(level)
        os.environ[level] = "error"
        try:
            return import_module(self.name)
        except ImportError as error:
            raise NotInstalledError(f"{self.title} cannot be imported: {error}; {self.remedy}") from error
        finally:
            del os.environ[level]
            if before is not None:
                os.environ[level] = before

    @cached_property
    def shortcuts(self) -> Parts:
        """What to replace while a kernel of ours is read; nothing in a version that was not tested.

        A compiler reads every kernel in every process, as the key of its cache is made from what it reads. Meanwhile it
        prepares, for every node, the source lines that an error would show: useful only to those who change a kernel.
        """
        if "TAICHI_MSM_TRACEBACK" in os.environ or self.version != self.tested:
            return []
        nodes = import_module(f"{self.name}.lang.ast.ast_transformer_utils")
        if self.name == "taichi":
            reader = import_module("taichi.lang.ast.ast_transformer")

            def read(context: Any, node: ast.AST) -> Any:
                return getattr(reader.ASTTransformer, f"build_{type(node).__name__}")(context, node)

            return [
                (nodes.ASTTransformerContext, "get_pos_info", lambda context, node: ""),
                (reader, "build_stmt", read),
            ]
        kernels = import_module("quadrants.lang.kernel")
        look_up = kernels.Kernel._try_load_fastcache

        def use_none(kernel: Any, arguments: Any, key: Any) -> Any:
            look_up(kernel, arguments, key)
            return kernel.used_py_dataclass_parameters_by_key_enforcing.setdefault(key, set())

        return [
            (nodes.ASTTransformerFuncContext, "memoized_get_pos_info", lambda context, node: ""),
            # Quadrants reads every kernel twice, to find which fields of dataclasses it uses. Ours take none.
            (kernels.Kernel, "_try_load_fastcache", use_none),
            (kernels._kernel_impl_dataclass, "unpack_ast_struct_expressions", lambda tree, struct_locals: tree),
        ]


_TAICHI = Compiler(
    name="taichi",
    title="Taichi",
    prefix="TI",
    cache=".cache/taichi/ticache",
    lock="ticache.lock",
    tested="1.7.4",
    pythons="Python 3.10 to 3.13",
    look=33e-9,
)
_QUADRANTS = Compiler(
    name="quadrants",
    title="Quadrants",
    prefix="QD",
    cache=".cache/quadrants/qdcache",
    lock="kernel_compilation_manager/qdcache.lock",
    tested="1.4.0",
    pythons="Python 3.12 to 3.14",
    look=3.4e-9,
)

# The first of them that is installed is taken.
COMPILERS = {one.name: one for one in (_TAICHI, _QUADRANTS)}


@cache
def chosen() -> Compiler:
    """Choose the compiler, without importing it.

    Raises:
        DeviceError: when the one that the environment asks for is not known.
        NotInstalledError: when it, or any, is not installed.
    """
    wanted = os.environ.get(CHOICE)
    if wanted and wanted not in COMPILERS:
        near = did_you_mean(wanted, list(COMPILERS))
        raise DeviceError(f"{CHOICE}: {wanted!r} is not a compiler; take {' or '.join(COMPILERS)}{near}")
    candidates = [COMPILERS[wanted]] if wanted else list(COMPILERS.values())
    for one in candidates:
        if one.version:
            return one
    if wanted:
        raise NotInstalledError(f"{CHOICE}: {wanted} is not installed; {candidates[0].remedy}, or unset {CHOICE}")
    raise NotInstalledError(f"no compiler is installed; {' or '.join(one.remedy for one in candidates)}")


def named(versions: Mapping[str, str]) -> str:
    """Name the compiler, and its version, that was used where these versions were: Taichi 1.7.4."""
    return next(f"{one.title} {versions[one.name]}" for one in COMPILERS.values() if one.name in versions)


def what_decides_bits(versions: Mapping[str, str], arch: str) -> dict[str, str]:
    """Leave out of some versions that of the compiler, if its results are known to have the bits of another one's."""
    return {
        name: version
        for name, version in versions.items()
        if arch != "cpu" or name not in COMPILERS or version != COMPILERS[name].tested
    }


pass  # REMOVED


def versions() -> dict[str, str]:
    """Name the versions that the results depend on."""
    # Imported here, as they take a while.
    import numpy as np
    import PIL

    return {
        "taichi-msm": __version__,
        "python": platform.python_version(),
        chosen().name: chosen().version,
        "numpy": np.__version__,
        "pillow": PIL.__version__,
        "platform": f"{sys.platform} {platform.machine()}",
    }
