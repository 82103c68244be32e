"""One run of a sweep, as a worker takes it."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import NamedTuple

from taichi_msm.errors import MsmError, SceneError
from taichi_msm.outputs.table import RUNS, numbered
from taichi_msm.scenefile.load import File, plan_file
from taichi_msm.sweeps.outcome import Outcome, Status, outcome_of


class Task(NamedTuple):
    """A run that is to be taken."""

    run: int  # its number
    scene: File
    overrides: tuple[str, ...]
    folder: Path  # of the sweep
    home: Path  # from which its paths start

    @property
    def directory(self) -> Path:
        """Where its results go."""
        return self.folder / RUNS / numbered(self.run)


def take(task: Task) -> Outcome:
    """Run a scene with its overrides on one thread, as `run --set` does; whatever fails is in the outcome."""
    os.chdir(task.home)
    try:
        plan = plan_file(task.scene, task.overrides)
    except SceneError as error:
        return _without_results(task, "refused", "; ".join(error.lines))

    from taichi_msm import runner

    try:
        record = runner.run(plan, task.directory, threads=1, overrides=task.overrides, started=time.perf_counter())
    except MsmError as error:
        return _without_results(task, "failed", str(error))
    except Exception as error:
        return _without_results(task, "failed", f"a bug, please report it: {type(error).__name__}: {error}")
    return outcome_of(task.run, record)


def _without_results(task: Task, status: Status, reason: str) -> Outcome:
    """Make the outcome of a run without results; its reason does not name the folder of the sweep."""
    said = " ".join(reason.split()).replace(str(task.directory), task.directory.name)
    return Outcome(task.run, status, said)
