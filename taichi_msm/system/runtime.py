"""Start of Taichi, or Quadrants; its device, arrays and compilation options. No other module starts it."""

from __future__ import annotations

import atexit
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

from taichi_msm.errors import MAX_WORKERS, ArgumentError, DeviceError, MsmError, did_you_mean
from taichi_msm.system.compiler import Patches, active_compiler
from taichi_msm.system.files import private_folder
from taichi_msm.system.process import available_threads, discarded_output, processor_name

ti = active_compiler().load()

# At exit, Taichi's modules are gone before its arrays, whose destructor would raise; the memory is freed anyway.
atexit.register(setattr, ti.lang._ndarray.ScalarNdarray, "__del__", lambda array: None)

_core: Any = getattr(np, "_core", None) or np.core  # NumPy 2, or 1
_features: dict[str, bool] = _core._multiarray_umath.__cpu_features__

ARCHS = ("cpu", "cuda", "vulkan")

# Address space that Taichi needs: it reserves 1 GiB, and its libraries need nearly the same amount.
MIN_ADDRESS_SPACE_BYTES = 1900 << 20

# Smallest number of iterations of a parallel loop in a CPU thread, from make_cpu_multithreaded_range_for.cpp.
ITERATIONS_PER_THREAD = 512


@dataclass(frozen=True)
class Device:
    """Device on which kernels run."""

    arch: str  # cpu, cuda or vulkan
    threads: int  # number of CPU threads
    name: str = field(default="", compare=False)  # name of the processor or the GPU; empty if unknown


class Memory:
    """Pool of Taichi arrays: they are reused once this object is dropped, because Taichi frees no arrays on a CPU."""

    def __init__(self) -> None:
        self._arrays: list[tuple[tuple[str, int], Any]] = []
        weakref.finalize(self, _recycle, self._arrays, _free_arrays)

    def array(self, precision: str, lanes: int, length: int) -> Any:
        """Return an array, new or reused, of at least `length` vectors, or scalars if `lanes` is 0, of any content."""
        kind = precision, lanes
        fitting = [array for array in _free_arrays[kind] if array.shape[0] >= length]
        if fitting:
            array = min(fitting, key=lambda candidate: candidate.shape[0])
            _free_arrays[kind] = [candidate for candidate in _free_arrays[kind] if candidate is not array]
        else:
            real = getattr(ti, precision)
            array = ti.ndarray(ti.types.vector(lanes, real) if lanes else real, length)
        self._arrays.append((kind, array))
        return array


def write_vectors(array: Any, values: NDArray[Any]) -> None:
    """Write vectors, shape (entries, lanes), to the first entries of a Taichi array, and zeros to the others."""
    real = np.float32 if array.dtype == ti.f32 else np.float64
    array.from_numpy(np.pad(values.astype(real), ((0, array.shape[0] - len(values)), (0, 0))))


_free_arrays: dict[tuple[str, int], list[Any]] = defaultdict(list)


def _recycle(arrays: list[tuple[tuple[str, int], Any]], free: dict[tuple[str, int], list[Any]]) -> None:
    for kind, array in arrays:
        free[kind].append(array)


_device: Device | None = None
# Ids of the process and the thread that started Taichi.
_start_thread = (0, 0)
# Held during the start of Taichi: two threads must not start it at once.
_start_lock = threading.Lock()


def lanes(precision: str) -> int:
    """Return the number of f32 or f64 values in a vector register of the processor; 1 on a GPU."""
    if current_device().arch != "cpu":
        return 1
    return vector_bits() // (32 if precision == "f32" else 64)


def vector_bits() -> int:
    """Return the width of the processor's vector registers [bits]."""
    return next((bits for feature, bits in (("AVX512F", 512), ("AVX2", 256)) if _features.get(feature)), 128)


def current_device() -> Device:
    """Return the device of the last `start`."""
    assert _device is not None, "runtime.start comes first"
    return _device


def start(arch: str = "cpu", threads: int | None = None) -> Device:
    """Start Taichi on a device, unless it already runs on it; it cannot run on two devices in a process.

    None for `threads` is one per available core.
    """
    global _device, _start_thread
    if threads is not None and not (type(threads) is int and 1 <= threads <= MAX_WORKERS):
        raise ArgumentError(f"threads: {threads!r}; take a whole number, 1 to {MAX_WORKERS}, or None for every core")
    if arch not in ARCHS:
        hint = did_you_mean(str(arch), ARCHS)
        raise DeviceError(f"--arch {arch}: not supported; take one of: {', '.join(ARCHS)}{hint}")
    wanted = Device(arch, available_threads() if threads is None else threads)
    with _start_lock:
        if _device is None:
            _device = replace(wanted, name=_initialise(wanted))
            _start_thread = os.getpid(), threading.get_ident()
        require_start_thread()
        if wanted != _device:
            running = f"already runs on {_device.arch} with {_device.threads} threads in this process"
            remedy = f"start another process for {wanted.arch} with {wanted.threads}"
            raise DeviceError(f"{active_compiler().title} {running}; {remedy}")
        return _device


def stop() -> None:
    """Stop Taichi, which writes its cache of kernels; existing arrays and kernels become unusable."""
    global _device, _free_arrays
    # The directory of the cache may have been removed; the next process then compiles again.
    with contextlib.suppress(RuntimeError):
        ti.reset()
    _device, _free_arrays = None, defaultdict(list)


def require_start_thread() -> None:
    """Require the process and thread that started Taichi, the only ones that can use it; else raise an MsmError."""
    (process, thread), title = _start_thread, active_compiler().title
    if process != os.getpid():
        raise MsmError(
            f"{title} was started before this process was forked from another, and would hang here; start processes by "
            "multiprocessing's 'spawn' or 'forkserver'"
        )
    if thread != threading.get_ident():
        raise MsmError(f"{title} only works in the thread that started it; simulate and draw in that thread")


def compilation_options(*, optimised: bool = True) -> contextlib.AbstractContextManager[None]:
    """Return a context with the compiler's options for the kernels of this package; other kernels keep theirs.

    Every operation is rounded by IEEE 754, so that the bits of a result do not depend on threads, lanes or compiler
    optimisation. On a CPU vectors are not split into scalars (docs/decisions/0010). Taichi's control-flow optimisation
    is off: it takes half the compile time, and LLVM repeats it. Its other optimisations before LLVM are on if
    `optimised`, which must be equal at all launches of a kernel.
    """
    config = ti.lang.impl.current_cfg()
    options: Patches = [
        (config, "fast_math", False),
        (config, "cfg_optimization", False),
        (config, "advanced_optimization", optimised),
        (config, "real_matrix_scalarize", current_device().arch != "cpu"),
    ]
    return _patched(options + active_compiler().patches)


@contextlib.contextmanager
def _patched(patches: Patches) -> Iterator[None]:
    originals = [(owner, name, getattr(owner, name)) for owner, name, _ in patches]
    for owner, name, value in patches:
        setattr(owner, name, value)
    try:
        yield
    finally:
        for owner, name, value in originals:
            setattr(owner, name, value)


def _cache_options() -> dict[str, Any]:
    """Prepare the cache of kernels; return the arguments of `ti.init` that replace it if it is unusable."""
    try:
        folder = active_compiler().folder()
        folder.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryFile(dir=folder):
            pass
        if hasattr(os, "statvfs"):
            free = os.statvfs(folder)
            # The kernels of a run need at most 64 files and 16 MiB. File systems without a limit on files report 0.
            if (free.f_files > 0 and free.f_favail < 64) or free.f_bavail * free.f_frsize < 1 << 24:
                raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    except OSError:
        # Taichi crashes at exit if it cannot write to the directory, even if the cache is off.
        os.environ.pop(active_compiler().folder_variable, None)
        return {"offline_cache": False, "offline_cache_file_path": private_folder()}
    # Taichi holds the lock for milliseconds. A lock older than 60 s is of a killed process, and would block the cache
    # for all others.
    lock = folder / active_compiler().lock
    with contextlib.suppress(OSError):
        if time.time() - lock.stat().st_mtime > 60:
            lock.unlink()
    return {}


def _require_address_space() -> None:
    try:
        import resource
    except ImportError:  # Windows
        return
    limit = resource.getrlimit(resource.RLIMIT_AS)[0]
    if limit != resource.RLIM_INFINITY and limit < MIN_ADDRESS_SPACE_BYTES:
        raise DeviceError(
            f"{active_compiler().title} needs {MIN_ADDRESS_SPACE_BYTES >> 20} MiB of address space, and this process "
            f"may have {limit >> 20} MiB; raise its limit (ulimit -v)"
        )


def _thread_ids() -> list[int]:
    """Return the ids of the threads of this process, mostly in the order of their start; empty without /proc."""
    return sorted(int(task.name) for task in Path("/proc/self/task").glob("*"))


def _pin(pool: list[int]) -> None:
    """Pin Taichi's threads to the cores if their numbers are equal; threads that share a core would spin for 10 ms."""
    if hasattr(os, "sched_setaffinity") and len(pool) == len(os.sched_getaffinity(0)):
        for thread, core in zip(pool, sorted(os.sched_getaffinity(0)), strict=True):
            with contextlib.suppress(OSError):
                os.sched_setaffinity(thread, {core})


@contextlib.contextmanager
def _isolated_environment() -> Iterator[None]:
    """Hide environment variables that override arguments of `ti.init`, and suppress its line on stdout.

    stdout itself is not redirected, because other threads may print to it.
    """
    prefix, namespace = f"{active_compiler().prefix}_", vars(ti.lang.misc)
    # Directories and the choice of a GPU are not arguments.
    kept = tuple(prefix + name for name in ("OFFLINE_CACHE_FILE_PATH", "VISIBLE_DEVICE", "LIB_DIR", "SKIP_"))
    names = [name for name in os.environ if name.startswith(prefix) and not name.startswith(kept)]
    hidden = {name: os.environ.pop(name) for name in names}
    namespace["print"] = lambda *_: None
    try:
        yield
    finally:
        del namespace["print"]
        os.environ.update(hidden)


def _initialise(device: Device) -> str:
    """Start Taichi; return the name of the processor or the GPU."""
    _require_address_space()
    cache = _cache_options()
    earlier_threads = _thread_ids()
    on_cpu = device.arch == "cpu"
    try:
        # Only Taichi's log contains the name of the GPU. The log of a failed start is replaced by the error below.
        with tempfile.NamedTemporaryFile("r", errors="replace") as log:
            with _isolated_environment(), discarded_output(*(() if on_cpu else (2,)), into=log.name):
                ti.init(
                    arch=getattr(ti, device.arch),
                    cpu_max_num_threads=device.threads,
                    enable_fallback=False,
                    **cache,
                    # This suppresses a warning about unrolled loops over the samples of a pixel.
                    unrolling_limit=0,
                    log_level=ti.ERROR if on_cpu else ti.TRACE,
                )
                ti.set_logging_level(ti.ERROR)
            gpu_name = re.search(r'Vulkan Device "(.+)" supports|CUDA device \[id=\d+\]: (.+)', log.read())
    except Exception as error:
        remedy = f"{active_compiler().title} reports: {' '.join(str(error).split())}" if on_cpu else "take --arch cpu"
        raise DeviceError(f"--arch {device.arch}: not available on this machine; {remedy}") from error
    # Taichi starts the threads of its pool last.
    _pin([thread for thread in _thread_ids() if thread not in earlier_threads][-device.threads :])
    if on_cpu:
        return processor_name()
    return next(filter(None, gpu_name.groups())) if gpu_name else ""
