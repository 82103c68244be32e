"""One run of a sweep, as a worker takes it."""

from __future__ import annotations

import os
import time
from pathlib import Path
from typing import NamedTuple

from taichi_msm.errors import MsmError, SceneError
from taichi_msm.outputs.table import RUNS, numbered
from taichi_msm.progress import Progress
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


def take(task: Task, progress: Progress = lambda stage, done, total: None) -> Outcome:
    """Run a scene with its overrides on one thread, as `run --set` does; whatever fails is in the outcome.

    `progress` is called some times a second; it may raise a KeyboardInterrupt, as from `runner.run`.
    """
    os.chdir(task.home)
    try:
        plan = plan_file(task.scene, task.overrides)
    except SceneError as error:
        return _without_results(task, "refused", "; ".join(error.lines))

    from taichi_msm import runner
    from taichi_msm.scenefile import budget

    try:
        budget.require_disk(plan, task.directory)
    except SceneError as error:
        return _without_results(task, "failed", str(error))
    try:
        record = runner.run(
            plan, task.directory, threads=1, overrides=task.overrides, started=time.perf_counter(), progress=progress
        )
    except SceneError as error:  # found only now, such as a picture that cannot be decoded
        return _without_results(task, "refused", "; ".join(error.lines))
    except MsmError as error:
        return _without_results(task, "failed", str(error))
    except Exception as error:
        return _without_results(task, "failed", f"a bug, please report it: {type(error).__name__}: {error}")
    return outcome_of(task.run, record)


def _without_results(task: Task, status: Status, reason: str) -> Outcome:
    """Make the outcome of a run without results; its reason names neither the folder of the sweep nor the scene's."""
    said = " ".join(reason.split()).replace(str(task.directory), task.directory.name)
    # The path of a picture follows a blank.
    return Outcome(task.run, status, said.replace(f" {task.scene.folder / '_'}"[:-1], " "))
