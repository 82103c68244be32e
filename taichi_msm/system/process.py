"""The resources that this process may use: cores and memory; and the processor's name.

Ctrl-C and SIGTERM as a request to stop, granted only where the work can stop.

By default Python raises KeyboardInterrupt between any two bytecodes; raised in an import, a destructor or a callback of
a library, it is lost or turned into another error.

The standard streams of the process, which may be closed, full, or without a reader.
"""

from __future__ import annotations

import contextlib
import io
import math
import os
import platform
import signal
import sys
import threading
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TextIO

from taichi_msm.errors import printable

CONTROL_GROUPS, MEMBERSHIP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def available_threads() -> int:
    """Count the cores that this process may use, by its affinity and the quotas of its control groups."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    quotas = [quota for group in _control_groups("cpu") if (quota := _quota(group)) is not None]
    return max(1, min([cores, *map(math.floor, quotas)]))


def _quota(group: Path) -> float | None:
    """Read the cores that a control group may use, of version 2 or 1; None: no limit."""
    with contextlib.suppress(OSError, ValueError):
        quota, period = map(int, (group / "cpu.max").read_text().split())
        return quota / period
    with contextlib.suppress(OSError, ValueError):
        quota, period = (int((group / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period"))
        return quota / period if quota > 0 else None
    return None


def _control_groups(controller: str) -> Iterator[Path]:
    """List the control groups of this process and those above them, of version 2 and of a controller of version 1."""
    with contextlib.suppress(OSError):
        for line in MEMBERSHIP.read_text().splitlines():
            number, controllers, own = line.split(":", 2)
            if number != "0" and controller not in controllers.split(","):
                continue
            root = CONTROL_GROUPS if number == "0" else CONTROL_GROUPS / controller
            group = root / own.lstrip("/")
            yield from (each for each in (group, *group.parents) if each.is_relative_to(root))


def waited_for_cores(tasks: Path = Path("/proc/self/task")) -> float | None:
    """Add up the time that this process's threads have waited for a core that others had [s]; None: not known."""
    try:
        waits = [int((task / "schedstat").read_text().split()[1]) for task in tasks.iterdir()]
    except (OSError, ValueError, IndexError):
        return None
    return 1e-9 * sum(waits)


def processor() -> str:
    """Name the processor."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def available_memory() -> int:
    """Give the memory that a run may take [bytes]: what is free and what the control group still allows.

    Without /proc it is all physical memory; sys.maxsize if the system does not report that.
    """
    with contextlib.suppress(OSError, KeyError, ValueError, IndexError):
        free = _free_memory(Path("/proc/meminfo"))
        return min([free, *map(_group_rest, _control_groups("memory"))])
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return sys.maxsize


def _free_memory(meminfo: Path) -> int:
    """Read Linux's estimate of the memory available without swapping [bytes]."""
    fields = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
    return int(fields["MemAvailable"].split()[0]) * 1024


def _group_rest(group: Path) -> int:
    """Read the memory that a control group still allows [bytes], of version 2 or 1; sys.maxsize: no limit."""
    for limit, usage, cache in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ):
        with contextlib.suppress(OSError, ValueError):
            most, used = (int((group / name).read_text()) for name in (limit, usage))
            cached = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
            # Cached files count as used, but are dropped when memory is needed.
            return max(0, most - used + int(cached.get(cache, 0)))
    return sys.maxsize


SIGNALS = (signal.SIGINT, signal.SIGTERM)

# A descriptor of stderr that works even while libraries are kept from writing there.
_outlet = 2


class Interruption:
    """Remembers a request to stop; a second request ends the process at once.

    Attributes:
        code: exit code of a program that was stopped: 128 plus the number of the signal.
    """

    def __init__(self) -> None:
        self.code = 128 + signal.SIGINT
        self._requested = False

    def listen(self) -> None:
        """Treat the signals as requests from now on."""
        for number in SIGNALS:
            signal.signal(number, self._request)

    def grant(self) -> None:
        """Raise KeyboardInterrupt if a signal came since `listen`."""
        if self._requested:
            raise KeyboardInterrupt

    def _request(self, number: int, _frame: FrameType | None) -> None:
        self.code = 128 + number
        if self._requested:
            _end(self.code, b"interrupted twice; ended at once\n")
        self._requested = True


def leave_at_once() -> None:
    """From now on let a signal end the process at once; for use while there are no results to keep."""
    global _outlet
    _outlet = os.dup(2)
    for number in SIGNALS:
        signal.signal(number, _leave)


def _leave(number: int, _frame: FrameType | None) -> None:
    _end(128 + number, b"interrupted; nothing was written\n")


def _end(code: int, message: bytes) -> None:
    with suppress(OSError):  # nobody can read it
        os.write(_outlet, message)
    os._exit(code)


# Held while descriptors are redirected, which belong to all threads.
_redirecting = threading.RLock()


def open_missing() -> None:
    """Open standard streams that the process was started without, so that no other file gets their descriptors."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # gets the lowest free descriptor
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, io.TextIOWrapper(io.FileIO(descriptor, "w", closefd=False), "utf-8"))


def tell(lines: Iterable[str]) -> None:
    """Write lines to stderr, whatever characters they contain; discard them if nobody can read them."""
    # Imported here, as the library needs no command line.
    import click

    try:
        for line in lines:
            click.echo(printable(line), err=True)
    except OSError:
        mute(sys.stderr)


def mute(stream: TextIO) -> None:
    """Discard what is still buffered in a stream; otherwise the interpreter would try to write it when it ends."""
    with suppress(OSError, ValueError):
        nowhere = os.open(os.devnull, os.O_WRONLY)
        os.dup2(nowhere, stream.fileno())
        os.close(nowhere)


@contextmanager
def silenced(*descriptors: int, into: str = os.devnull) -> Iterator[None]:
    """Discard, or write into a file, what libraries write to some file descriptors; a closed one stays closed."""
    with _redirecting, Path(into).open("wb") as nowhere:
        kept = {}
        for descriptor in descriptors:
            with suppress(OSError):
                kept[descriptor] = os.dup(descriptor)
        for descriptor in kept:
            os.dup2(nowhere.fileno(), descriptor)
        try:
            yield
        finally:
            for descriptor, copy in kept.items():
                os.dup2(copy, descriptor)
                os.close(copy)
