"""Resources and signals of this process: cores, memory, interruption, standard streams.

By default Python raises KeyboardInterrupt between any two bytecodes. Imports, destructors and callbacks of libraries
lose it or convert it to another error. So Ctrl-C, SIGTERM and SIGHUP only record a request, and the program raises
KeyboardInterrupt at places where it can stop.
"""

from __future__ import annotations

import io
import math
import os
import platform
import signal
import sys
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from pathlib import Path
from types import FrameType
from typing import TextIO

from taichi_msm.errors import printable

CONTROL_GROUPS, MEMBERSHIP = Path("/sys/fs/cgroup"), Path("/proc/self/cgroup")


def available_threads() -> int:
    """Return the number of cores that affinity and the quotas of control groups permit to this process."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    return max(1, math.floor(min([cores, *map(_quota, _control_groups("cpu"))])))


def _quota(group: Path) -> float:
    """Read the number of cores that a control group (version 2 or 1) may use; infinite without a limit."""
    with suppress(OSError, ValueError):
        quota, period = map(int, (group / "cpu.max").read_text().split())
        return quota / period
    with suppress(OSError, ValueError):
        quota, period = (int((group / f"cpu.cfs_{name}_us").read_text()) for name in ("quota", "period"))
        return quota / period if quota > 0 else math.inf
    return math.inf


def _control_groups(controller: str) -> Iterator[Path]:
    """Yield the control groups of this process and their ancestors: of version 2, and a controller's of version 1."""
    with suppress(OSError):
        for line in MEMBERSHIP.read_text().splitlines():
            number, controllers, path = line.split(":", 2)
            if number != "0" and controller not in controllers.split(","):
                continue
            root = CONTROL_GROUPS if number == "0" else CONTROL_GROUPS / controller
            group = root / path.lstrip("/")
            yield from (ancestor for ancestor in (group, *group.parents) if ancestor.is_relative_to(root))


def core_wait_s(tasks: Path = Path("/proc/self/task")) -> float | None:
    """Return the total time that the threads of this process have waited for a core [s]; None if unknown."""
    try:
        waits = [int((task / "schedstat").read_text().split()[1]) for task in tasks.iterdir()]
    except (OSError, ValueError, IndexError):
        return None
    return 1e-9 * sum(waits)


def processor_name() -> str:
    """Return the name of the processor."""
    with suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def available_memory() -> int:
    """Return the memory that a run may use [bytes]: the free memory, limited by the control groups.

    Without /proc, returns the physical memory, or sys.maxsize if the system does not report it.
    """
    with suppress(OSError, KeyError, ValueError, IndexError):
        free = _free_memory(Path("/proc/meminfo"))
        return min([free, *map(_group_memory, _control_groups("memory"))])
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return sys.maxsize


def _free_memory(meminfo: Path) -> int:
    """Read Linux's estimate of the memory available without swapping [bytes]."""
    fields = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
    return int(fields["MemAvailable"].split()[0]) * 1024


def _group_memory(group: Path) -> int:
    """Read the free memory of a control group (version 2 or 1) [bytes]; sys.maxsize without a limit."""
    for limit, usage, cache in (
        ("memory.max", "memory.current", "inactive_file"),
        ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
    ):
        with suppress(OSError, ValueError):
            maximum, used = (int((group / name).read_text()) for name in (limit, usage))
            cached = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
            # Cached files count as used, but the kernel drops them on demand.
            return max(0, maximum - used + int(cached.get(cache, 0)))
    return sys.maxsize


# Ctrl-C, the end of a service, and that of a terminal, which Windows lacks.
SIGNALS = tuple(getattr(signal, name) for name in ("SIGINT", "SIGTERM", "SIGHUP") if hasattr(signal, name))

# A descriptor of stderr that works even while `discarded_output` redirects stderr.
_stderr_copy = 2


class Interruption:
    """A pending interruption by a signal; a second signal ends the process at once."""

    def __init__(self) -> None:
        self.code = 128 + signal.SIGINT  # exit code of an interrupted program
        self._requested = False

    def listen(self) -> None:
        """Record signals from now on, instead of ending the process."""
        _handle_signals(self._request)

    def raise_if_requested(self) -> None:
        """Raise KeyboardInterrupt if a signal arrived since `listen`."""
        if self._requested:
            raise KeyboardInterrupt

    def _request(self, number: int, _frame: FrameType | None) -> None:
        self.code = 128 + number
        if self._requested:
            _exit(self.code, "interrupted twice; ended at once")
        self._requested = True


def exit_on_signals(message: str) -> None:
    """End the process at once on a signal, with a message, for the time before any results exist."""
    global _stderr_copy
    _stderr_copy = os.dup(2)
    _handle_signals(lambda number, _frame: _exit(128 + number, message))


def ignore_signals() -> None:
    """Ignore the signals of a terminal or a service to all processes, for one that ends with its parent."""
    for number in SIGNALS:
        signal.signal(number, signal.SIG_IGN)


def _handle_signals(handler: Callable[[int, FrameType | None], None]) -> None:
    """Set the handler of all signals, except those that nohup or a shell's background ignores."""
    for number in SIGNALS:
        if signal.getsignal(number) is not signal.SIG_IGN:
            signal.signal(number, handler)


def _exit(code: int, message: str) -> None:
    with suppress(OSError):  # stderr may be closed
        os.write(_stderr_copy, f"{message}\n".encode())
    os._exit(code)


# Held while descriptors are redirected, as all threads share them.
_redirection_lock = threading.RLock()


def open_standard_streams() -> None:
    """Open missing standard streams, so that no other file gets their descriptors."""
    for descriptor in (0, 1, 2):
        try:
            os.fstat(descriptor)
        except OSError:
            os.open(os.devnull, os.O_RDWR)  # This gets the lowest free descriptor.
    for name, descriptor in (("stdout", 1), ("stderr", 2)):
        if getattr(sys, name) is None:
            setattr(sys, name, io.TextIOWrapper(io.FileIO(descriptor, "w", closefd=False), "utf-8"))


def write_stderr(lines: Iterable[str]) -> None:
    """Write lines with any characters to stderr; errors of the stream are ignored."""
    # Imported here, so that the Python API does not load click.
    import click

    try:
        for line in lines:
            click.echo(printable(line), err=True)
    except OSError:
        discard_buffer(sys.stderr)


def discard_buffer(stream: TextIO) -> None:
    """Discard the buffered text of a stream, which the interpreter would write at exit."""
    with suppress(OSError, ValueError):
        sink = os.open(os.devnull, os.O_WRONLY)
        os.dup2(sink, stream.fileno())
        os.close(sink)


@contextmanager
def discarded_output(*descriptors: int, into: str = os.devnull) -> Iterator[None]:
    """Return a context that redirects file descriptors, such as 2 for stderr, into a file; closed ones stay closed."""
    with _redirection_lock, Path(into).open("wb") as sink:
        copies = {}
        for descriptor in descriptors:
            with suppress(OSError):
                copies[descriptor] = os.dup(descriptor)
        for descriptor in copies:
            os.dup2(sink.fileno(), descriptor)
        try:
            yield
        finally:
            for descriptor, copy in copies.items():
                os.dup2(copy, descriptor)
                os.close(copy)
