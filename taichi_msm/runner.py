"""The loop over the frames of a scene, and nothing but the loop."""

from __future__ import annotations

import math
import platform
import sys
import time
from collections.abc import Callable, Sequence
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import numpy
import PIL

from taichi_msm import __version__, accuracy, runtime
from taichi_msm.accuracy import Estimate
from taichi_msm.errors import DivergedError
from taichi_msm.files import ResultWriter
from taichi_msm.notes import notes
from taichi_msm.scene import Scene
from taichi_msm.simulation import Simulation
from taichi_msm.stability import stable_step, step, steps_per_frame
from taichi_msm.texture import load_texture

# Encoding a pixel takes as long as so many steps of a point.
STEPS_PER_PIXEL = 40

Progress = Callable[[str, int, int], None]


class Stopwatch:
    """Adds up the seconds of every stage."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = {}
        self._last = time.perf_counter()

    def lap(self, stage: str) -> None:
        """Count the time since the last lap for a stage."""
        now = time.perf_counter()
        self.seconds[stage] = self.seconds.get(stage, 0.0) + now - self._last
        self._last = now


def run(
    scene: Scene,
    directory: str | Path,
    *,
    arch: str = "cpu",
    threads: int | None = None,
    overrides: Sequence[str] = (),
    estimate_error: bool = False,
    started: float | None = None,
    progress: Progress = lambda stage, done, total: None,
) -> dict[str, Any]:
    """Simulate a scene and write its results: whole or not at all.

    Args:
        scene: what `load_scene` returned.
        directory: where frames/, animation.gif, trajectory.npz and run.json go.
        arch: cpu or cuda.
        threads: number of CPU threads; None takes every core.
        overrides: the overrides that made the scene, for the record.
        estimate_error: whether to estimate the error of the step; a tolerance in the scene does in any case.
        started: `time.perf_counter()` when the program began; None: now.
        progress: called with the stage, the frames done and the frames in all; what it raises stops the run there,
            KeyboardInterrupt keeping the frames done.

    Returns:
        What is in run.json; its "status" is "complete", "diverged" (then "error" says where and why) or "interrupted".

    Raises:
        SceneError: when the scene's picture cannot be decoded, or no step meets its tolerance.
        DeviceError: when the arch is not there.
        FilesError: when the results cannot be written.
        KeyboardInterrupt: when interrupted before the first frame; nothing is written then.
    """
    started = time.perf_counter() if started is None else started
    device = runtime.start(arch, threads)
    texture = load_texture(scene) if scene.draws else None
    frames = scene.time.frames + 1
    ending: dict[str, Any] = {"status": "complete"}
    watch = Stopwatch()
    given, estimate = scene, None
    if scene.time.tolerance is not None:
        scene, estimate = accuracy.choose_step(scene, device, partial(progress, "pilot"))
    elif estimate_error:
        estimate = accuracy.estimate_error(scene, device, partial(progress, "pilot"))
    watch.lap("pilot")
    progress("compile", 0, frames)
    # In this order, so that the encoder starts up while kernels are compiled.
    cores = free_cores(scene)
    with ResultWriter(Path(directory), scene) as writer, Simulation(scene, arch, threads, texture, cores) as simulation:
        startup = time.perf_counter() - started - watch.seconds["pilot"]
        watch.lap("startup")
        try:
            simulation.compile()
            watch.lap("compile")
            progress("frames", 0, frames)
            for frame in range(frames):
                if frame:
                    simulation.advance()
                watch.lap("simulate")
                progress("frames", frame, frames)
                picture = simulation.draw() if scene.draws else None
                watch.lap("render")
                writer.add(simulation.positions(), picture)
                watch.lap("hand over")
        except KeyboardInterrupt:
            if not writer.frames:
                raise
            ending = {"status": "interrupted"}
        except DivergedError as error:
            ending = {"status": "diverged", "error": str(error)}
        progress("write", writer.frames, frames)
        writer.finish()
        limit = stable_step(scene)
        record = {
            **ending,
            "scene": given.model_dump(mode="json"),
            "overrides": list(overrides),
            "step": step(scene),
            "stable_step": limit if limit < math.inf else None,
            "steps_per_frame": steps_per_frame(scene),
            "steps": simulation.steps,
            "frames": writer.frames,
            "max_displacement": simulation.max_displacement,
            "shortest_spring": simulation.shortest_spring,
            "notes": list(notes(scene, simulation.max_displacement, simulation.shortest_spring, estimate)),
            "error_estimate": None if estimate is None else error_record(estimate),
            "timings": {
                "startup": startup,
                **({"pilot": watch.seconds["pilot"]} if estimate is not None else {}),
                "compile": watch.seconds.get("compile", 0.0),
                "simulate": watch.seconds.get("simulate", 0.0),
                "render": watch.seconds.get("render", 0.0),
                "encode": writer.encode_seconds,
                "total": time.perf_counter() - started,
            },
            "arch": device.arch,
            "threads": device.threads,
            "versions": versions(),
        }
        outputs = writer.publish(record)
    return {**record, "outputs": outputs}


def free_cores(scene: Scene) -> int:
    """Count the cores that are free for stepping: the encoder needs one of them, unless it mostly waits for frames."""
    width, height = scene.render.size
    rows, cols = scene.sheet.points
    encoding = width * height * STEPS_PER_PIXEL if scene.draws else 0
    busy = encoding > rows * cols * steps_per_frame(scene)
    return max(1, runtime.available_threads() - busy)


def error_record(estimate: Estimate) -> dict[str, Any]:
    """Write an estimate down for run.json, where null stands for a pilot run that diverged."""
    known = {key: value if value < math.inf else None for key, value in asdict(estimate).items()}
    return {key: known[key] for key in ("error", "rounding", "in_f64", "order")}


def versions() -> dict[str, str]:
    """Name the versions that the results depend on."""
    return {
        "taichi-msm": __version__,
        "python": platform.python_version(),
        "taichi": ".".join(str(part) for part in runtime.ti.__version__),
        "numpy": numpy.__version__,
        "pillow": PIL.__version__,
        "platform": f"{sys.platform} {platform.machine()}",
    }
