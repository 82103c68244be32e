"""What a sweep will take, from some of its runs, and how many processes to share it among."""

from __future__ import annotations

from typing import NamedTuple

from taichi_msm.errors import SceneError
from taichi_msm.physics.plan import Plan
from taichi_msm.scenefile import budget, duration
from taichi_msm.scenefile.load import plan_file
from taichi_msm.sweeps.sweepfile import Sweep
from taichi_msm.system.resources import available_memory, available_threads

# The runs that are planned for the estimate, evenly spread over all; each takes milliseconds.
LOOKED_AT = 64

# Memory of a process besides that of its run: Python, the compiler, kernels [bytes].
PROCESS_BYTES = 400 << 20

# What a run takes besides its work, and each of its frames [s]: folders, files, calls; measured on Zen 4.
RUN_SECONDS, FRAME_SECONDS = 0.04, 0.003


class Cost(NamedTuple):
    """What all runs take, about."""

    seconds: float  # on this machine, with every core
    disk_bytes: int  # at most
    memory_bytes: int  # of one process
    looked_at: int  # how many runs this follows from
    refused: int  # how many of them are
    example: str  # why one of them is

    def of(self, share: float) -> Cost:
        """Give the cost of a share of the runs."""
        return self._replace(seconds=share * self.seconds, disk_bytes=round(share * self.disk_bytes))


class Workers(NamedTuple):
    """How many processes take runs."""

    number: int
    cores: int  # that this program may use
    fitting: int  # processes whose memory is free


def estimate(sweep: Sweep) -> Cost:
    """Estimate what the runs of a sweep take."""
    plans: list[Plan] = []
    reasons: list[str] = []
    for values in sweep.some_values(LOOKED_AT):
        try:
            plans.append(plan_file(sweep.scene, sweep.overrides(values)))
        except SceneError as error:
            reasons.append(error.lines[0])
    times, needs = list(map(duration.estimate, plans)), list(map(budget.estimate, plans))
    looked_at = len(plans) + len(reasons)
    share, cores = sweep.runs / looked_at, available_threads()
    seconds = sum(one.seconds - one.start for one in times)
    seconds += sum(RUN_SECONDS + FRAME_SECONDS * need.frames for need in needs) / cores
    return Cost(
        # A process starts once, for many runs.
        seconds=max((one.start for one in times), default=0.0) + share * seconds,
        disk_bytes=round(share * sum(need.disk_bytes for need in needs)),
        memory_bytes=PROCESS_BYTES + max((need.memory_bytes for need in needs), default=0),
        looked_at=looked_at,
        refused=len(reasons),
        example=next(iter(reasons), ""),
    )


def choose_workers(cost: Cost, runs: int, asked: int | None = None) -> Workers:
    """Choose a process for each core, as far as the free memory goes, or as many as are asked for."""
    cores, fitting = available_threads(), available_memory() // cost.memory_bytes
    return Workers(asked or max(1, min(cores, fitting, runs)), cores, fitting)
