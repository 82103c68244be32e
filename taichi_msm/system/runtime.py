"""The only module that starts Taichi, or Quadrants, of which all that is said of Taichi here is true as well."""

from __future__ import annotations

import contextlib
import errno
import os
import re
import tempfile
import threading
import time
import weakref
from collections import defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ArgumentError, DeviceError, MsmError, did_you_mean
from taichi_msm.system import process as process_module
from taichi_msm.system.compiler import Parts, chosen
from taichi_msm.system.files import private_folder
from taichi_msm.system.process import silenced

ti = chosen().load()

_core: Any = getattr(np, "_core", None) or np.core  # NumPy 2, or 1
_features: dict[str, bool] = _core._multiarray_umath.__cpu_features__

ARCHS = ("cpu", "cuda", "vulkan")

# More than the cores of any machine; Taichi would start all of these threads.
MOST_THREADS = 1024

# A lock on Taichi's cache older than this was left behind by a process that was killed [s].
STALE_LOCK = 60.0

# Width of a processor's vectors [bits], by NumPy's names of its features.
VECTOR_BITS = {"AVX512F": 512, "AVX2": 256}

# What the kernels of a run may need in the cache: files and bytes.
CACHE_FILES, CACHE_BYTES = 64, 1 << 24

# Taichi reserves 1 GiB of address space at once, and its libraries need nearly as much again [bytes].
ADDRESS_SPACE = 1900 << 20

# Lines in which Taichi names a GPU in its log.
GPU_NAME = re.compile(r'Vulkan Device "(.+)" supports|CUDA device \[id=\d+\]: (.+)')

# Taichi gives a CPU thread at least this many iterations of a parallel loop: make_cpu_multithreaded_range_for.cpp.
ITERATIONS_PER_THREAD = 512


@dataclass(frozen=True)
class Device:
    """The device that kernels run on."""

    arch: str  # cpu, cuda or vulkan
    threads: int  # of a CPU
    name: str = field(default="", compare=False)  # of the processor or the GPU; empty if the system does not tell it


class Memory:
    """Taichi's arrays. When a `Memory` is dropped its arrays are reused, because Taichi frees none on a CPU."""

    def __init__(self) -> None:
        self._taken: list[tuple[tuple[str, int], Any]] = []
        weakref.finalize(self, _give_back, self._taken, _free)

    def array(self, precision: str, lanes: int, length: int) -> Any:
        """Allocate a one-dimensional array, or reuse a longer one; its content is arbitrary.

        Its entries are vectors of so many lanes, or numbers if that is 0.
        """
        kind = precision, lanes
        fitting = [array for array in _free[kind] if array.shape[0] >= length]
        if fitting:
            array = min(fitting, key=lambda one: one.shape[0])
            _free[kind] = [one for one in _free[kind] if one is not array]
        else:
            real = getattr(ti, precision)
            array = ti.ndarray(ti.types.vector(lanes, real) if lanes else real, length)
        self._taken.append((kind, array))
        return array


def write(array: Any, values: NDArray[Any]) -> None:
    """Set the first entries of an array of vectors to values, shape (entries, lanes), and all others to zero."""
    real = np.float32 if array.dtype == ti.f32 else np.float64
    array.from_numpy(np.pad(values.astype(real), ((0, array.shape[0] - len(values)), (0, 0))))


_free: dict[tuple[str, int], list[Any]] = defaultdict(list)


def _give_back(taken: list[tuple[tuple[str, int], Any]], free: dict[tuple[str, int], list[Any]]) -> None:
    for kind, array in taken:
        free[kind].append(array)


_device: Device | None = None
# The process and the thread that started Taichi.
_home = (0, 0)
# Held while Taichi starts, which two threads must not do at once.
_starting = threading.Lock()


def lanes(precision: str) -> int:
    """Give the numbers that a vector register of the processor holds; 1 on a GPU, where every point is a thread."""
    if started().arch != "cpu":
        return 1
    return vector_bits() // (32 if precision == "f32" else 64)


def vector_bits() -> int:
    """Give the width of the processor's vectors [bits]."""
    return next((bits for feature, bits in VECTOR_BITS.items() if _features.get(feature)), 128)


def started() -> Device:
    """Give the device that `start` started."""
    assert _device is not None, "runtime.start comes first"
    return _device


def start(arch: str = "cpu", threads: int | None = None) -> Device:
    """Start Taichi, or return the device if it was started in the same way before.

    Raises:
        ArgumentError: when the number of threads is not valid.
        DeviceError: when the arch is not supported or not available, or Taichi already runs on another device.
        MsmError: as for `require_here`.
    """
    if threads is not None and not (type(threads) is int and 1 <= threads <= MOST_THREADS):
        raise ArgumentError(f"threads: {threads!r}; take a whole number, 1 to {MOST_THREADS}, or None for every core")
    if arch not in ARCHS:
        near = did_you_mean(str(arch), ARCHS)
        raise DeviceError(f"--arch {arch}: not supported; take one of: {', '.join(ARCHS)}{near}")
    wanted = Device(arch, process_module.available_threads() if threads is None else threads)
    with _starting:
        return _start(wanted)


def _start(wanted: Device) -> Device:
    global _device, _home
    if _device is None:
        _device = replace(wanted, name=_initialise(wanted))
        _home = os.getpid(), threading.get_ident()
    require_here()
    if wanted != _device:
        raise DeviceError(
            f"{chosen().title} already runs on {_device.arch} with {_device.threads} threads in this process; "
            f"start another process for {wanted.arch} with {wanted.threads}"
        )
    return _device


def stop() -> None:
    """Destroy Taichi's program, which writes its cache of kernels; what was made with it does not work after that."""
    global _device, _free
    # The cache's folder may be gone; without it, the next process compiles anew.
    with contextlib.suppress(RuntimeError):
        ti.reset()
    _device, _free = None, defaultdict(list)


def require_here() -> None:
    """Make sure that Taichi can be used here; MsmError: another process or thread started it."""
    process, thread = _home
    if process != os.getpid():
        raise MsmError(
            f"{chosen().title} was started before this process was forked from another, and would hang here; start "
            "processes by multiprocessing's 'spawn' or 'forkserver'"
        )
    if thread != threading.get_ident():
        raise MsmError(f"{chosen().title} works in the thread that started it; simulate and draw there")


def our_compilation(*, optimised: bool = True) -> contextlib.AbstractContextManager[None]:
    """Set the compiler's options for kernels of this package, not for a user's own kernels in the same process.

    Every operation is rounded by IEEE 754, so that the bits of a result do not depend on threads, lanes or compiler
    optimisation. On a CPU vectors stay vectors (docs/decisions/0010). Taichi's optimisation of control flow is left
    out: it takes half the compile time, and LLVM does the same again. `optimised=False` leaves Taichi's other
    optimisations to LLVM too; it must be the same at every launch of a kernel.
    """
    config = ti.lang.impl.current_cfg()
    options: Parts = [
        (config, "fast_math", False),
        (config, "cfg_optimization", False),
        (config, "advanced_optimization", optimised),
        (config, "real_matrix_scalarize", started().arch != "cpu"),
    ]
    return _replaced(options + chosen().shortcuts)


@contextlib.contextmanager
def _replaced(parts: Parts) -> Iterator[None]:
    """Give attributes of objects other values for a while."""
    originals = [(owner, name, getattr(owner, name)) for owner, name, _ in parts]
    for owner, name, value in parts:
        setattr(owner, name, value)
    try:
        yield
    finally:
        for owner, name, value in originals:
            setattr(owner, name, value)


def _cache() -> dict[str, Any]:
    """Give Taichi's options for the cache of compiled kernels, which later processes use."""
    try:
        folder = chosen().folder()
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        if hasattr(os, "statvfs"):
            free = os.statvfs(folder)
            # Some file systems without a limit of files report a limit of 0.
            if (free.f_files > 0 and free.f_favail < CACHE_FILES) or free.f_bavail * free.f_frsize < CACHE_BYTES:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError:
        # When a process ends, Taichi crashes if it cannot write to the folder, even if the cache is off.
        os.environ.pop(chosen().folder_variable, None)
        return {"offline_cache": False, "offline_cache_file_path": private_folder()}
    # The lock is held for milliseconds. A killed process leaves it behind, which blocks the cache for all others.
    lock = folder / chosen().lock
    with contextlib.suppress(OSError):
        if time.time() - lock.stat().st_mtime > STALE_LOCK:
            lock.unlink()
    return {}


def _require_address_space() -> None:
    """Raise DeviceError if Taichi could not get the address space that it reserves at once."""
    try:
        import resource
    except ImportError:  # Windows
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < ADDRESS_SPACE:
        raise DeviceError(
            f"{chosen().title} needs {ADDRESS_SPACE >> 20} MiB of address space, and this process may have "
            f"{limit >> 20} MiB; raise its limit (ulimit -v)"
        )


def _threads() -> list[int]:
    """List the ids of this process's threads, mostly in the order of their start; empty if the system has no list."""
    with contextlib.suppress(OSError):
        return sorted(int(task.name) for task in Path("/proc/self/task").iterdir())
    return []


def _pin(pool: list[int]) -> None:
    """Pin every thread of Taichi's pool to a core of its own, if there are as many threads as usable cores.

    Otherwise the system may let two threads share a core for about 10 ms, while one spins and waits for the other.
    """
    if hasattr(os, "sched_setaffinity") and len(pool) == len(os.sched_getaffinity(0)):
        for thread, core in zip(pool, sorted(os.sched_getaffinity(0)), strict=True):
            with contextlib.suppress(OSError):
                os.sched_setaffinity(thread, {core})


@contextlib.contextmanager
def _alone() -> Iterator[None]:
    """Keep settings of the environment away from `ti.init`, where they come before ours, and its line from stdout.

    Other threads may print meanwhile, so that stdout itself stays as it is.
    """
    prefix, said = f"{chosen().prefix}_", vars(ti.lang.misc)
    hidden = {name: os.environ.pop(name) for name in list(os.environ) if _overrides(name.removeprefix(prefix), name)}
    said["print"] = lambda *_: None
    try:
        yield
    finally:
        del said["print"]
        os.environ.update(hidden)


def _overrides(setting: str, name: str) -> bool:
    """Return whether a variable of the environment changes how Taichi starts, other than its folders and its GPU."""
    kept = "OFFLINE_CACHE_FILE_PATH", "VISIBLE_DEVICE", "LIB_DIR", "SKIP_"
    return setting != name and not setting.startswith(kept)


def _initialise(device: Device) -> str:
    """Start Taichi, and name what it runs on."""
    _require_address_space()
    cache = _cache()
    before = _threads()
    on_cpu = device.arch == "cpu"
    try:
        # Taichi prints the arch and, if a driver is missing, its search for it, which our error says in a line. Only
        # its log has the name of a GPU.
        with tempfile.NamedTemporaryFile("r", errors="replace") as told:
            with _alone(), silenced(*(() if on_cpu else (2,)), into=told.name):
                ti.init(
                    arch=getattr(ti, device.arch),
                    cpu_max_num_threads=device.threads,
                    enable_fallback=False,
                    **cache,
                    # No warning about unrolled loops over the samples of a pixel.
                    unrolling_limit=0,
                    log_level=ti.ERROR if on_cpu else ti.TRACE,
                )
                ti.set_logging_level(ti.ERROR)
            named = GPU_NAME.search(told.read())
    except Exception as error:
        said = f"{chosen().title} says: {' '.join(str(error).split())}" if on_cpu else "take --arch cpu"
        raise DeviceError(f"--arch {device.arch}: not available on this machine; {said}") from error
    # The threads of the pool are the last that Taichi starts.
    _pin([thread for thread in _threads() if thread not in before][-device.threads :])
    if on_cpu:
        return process_module.processor()
    return next(filter(None, named.groups())) if named else ""
