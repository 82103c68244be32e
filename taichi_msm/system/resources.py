"""The resources that this process may use: cores and memory; and the processor's name."""

from __future__ import annotations

import contextlib
import os
import platform
import sys
from pathlib import Path

CONTROL_GROUPS = Path("/sys/fs/cgroup")


def available_threads() -> int:
    """Count the cores that this process may use, by its affinity and the quota of its control group."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with contextlib.suppress(OSError, ValueError):
        quota, period = (CONTROL_GROUPS / "cpu.max").read_text().split()
        cores = min(cores, max(1, int(quota) // int(period)))
    return cores


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
        return min(free, _control_group_rest(Path("/proc/self/cgroup"), CONTROL_GROUPS))
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return sys.maxsize


def _free_memory(meminfo: Path) -> int:
    """Read Linux's estimate of the memory available without swapping [bytes]."""
    fields = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
    return int(fields["MemAvailable"].split()[0]) * 1024


def _control_group_rest(membership: Path, root: Path) -> int:
    """Find the memory that this process's control groups (version 2) still allow [bytes]; sys.maxsize: no limit."""
    lines = membership.read_text().splitlines()
    own = next((line[len("0::/") :] for line in lines if line.startswith("0::/")), "")
    group = root / own
    return min(_group_rest(each) for each in (group, *group.parents) if each.is_relative_to(root))


def _group_rest(group: Path) -> int:
    try:
        limit = (group / "memory.max").read_text().strip()
        used = int((group / "memory.current").read_text())
        cached = dict(line.split() for line in (group / "memory.stat").read_text().splitlines())
    except OSError:
        return sys.maxsize
    # Cached files count as used, but are dropped when memory is needed.
    return sys.maxsize if limit == "max" else max(0, int(limit) - used + int(cached.get("inactive_file", 0)))
