"""The resources that this process may use: cores and memory; and the processor's name."""

from __future__ import annotations

import contextlib
import math
import os
import platform
import sys
from collections.abc import Iterator
from pathlib import Path

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
