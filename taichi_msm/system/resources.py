"""What the machine has for this process: its cores, its memory, its processor's name."""

from __future__ import annotations

import contextlib
import os
import platform
import sys
from pathlib import Path

CONTROL_GROUPS = Path("/sys/fs/cgroup")


def available_threads() -> int:
    """Count the cores this process may use: its affinity, and the quota of its control group."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    with contextlib.suppress(OSError, ValueError):
        quota, period = (CONTROL_GROUPS / "cpu.max").read_text().split()
        cores = min(cores, max(1, int(quota) // int(period)))
    return cores


def processor() -> str:
    """Name the processor."""
    with contextlib.suppress(OSError):
        for line in Path("/proc/cpuinfo").read_text(encoding="utf-8").splitlines():
            if line.startswith("model name"):
                return line.split(":", 1)[1].strip()
    return platform.processor() or platform.machine()


def available_memory() -> int:
    """Tell how much memory a run may take [bytes]: what is free and what the control group still allows.

    Without /proc it is all the memory there is, and sys.maxsize where the system does not tell.
    """
    try:
        free = _free_memory(Path("/proc/meminfo"))
        return min(free, _control_group_rest(Path("/proc/self/cgroup"), CONTROL_GROUPS))
    except (OSError, KeyError, ValueError, IndexError):
        return _physical_memory()


def _free_memory(meminfo: Path) -> int:
    """Read Linux's estimate of what can be taken without swapping [bytes]."""
    fields = dict(line.split(":", 1) for line in meminfo.read_text().splitlines())
    return int(fields["MemAvailable"].split()[0]) * 1024


def _control_group_rest(membership: Path, root: Path) -> int:
    """Find what the control groups (version 2) of this process still allow [bytes]; sys.maxsize: no limit."""
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
    # Cached files count as used, but make room when memory is asked for.
    return sys.maxsize if limit == "max" else max(0, int(limit) - used + int(cached.get("inactive_file", 0)))


def _physical_memory() -> int:
    try:
        return os.sysconf("SC_PHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    except (AttributeError, OSError, ValueError):
        return sys.maxsize
