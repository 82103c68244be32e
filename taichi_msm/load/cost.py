"""The steps, memory and disk space that a scene needs, estimated before anything is computed.

Estimated duration of a run: its work, times the time that this machine takes for a unit of work.
"""

from __future__ import annotations

import math
import os
import shutil
import sys
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from taichi_msm.accuracy.companions import choose_companion_runs
from taichi_msm.errors import Problem, SceneError
from taichi_msm.model.plan import Plan
from taichi_msm.render import texture
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.outputs import OUTPUTS
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import work
from taichi_msm.system.process import available_memory
from taichi_msm.terms.contact import contact_fields

if TYPE_CHECKING:
    pass


def rough_time(seconds: float) -> str:
    """Write a time that is known only about: 40 s, 3 min, 2.5 h."""
    if seconds < 100:
        return f"{seconds:.0f} s" if seconds >= 1 else "1 s"
    if seconds < 6000:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.2g} h" if seconds < 360000 else f"{seconds / 86400:.0f} days"


MAX_STEPS = 10**12

# Memory for drawing [bytes].
POINT_BYTES = 36  # per mass point: its projection and its normal
SAMPLE_BYTES = 48  # per sample, at most
BAND_ROWS = 16  # rows of samples that a thread holds at a time
PIXEL_BYTES = 3 * 12  # per pixel of the frame: its colours, from sums to bytes
PICTURE_PIXEL_BYTES = 20  # per pixel of the picture's file, while it is decoded and converted; its texture takes less

# Bytes of a sample's place where a lens bends lines, while these are found and copied.
PLACE_BYTES = 100

# Bytes of a pixel while a film is encoded, most of them in the frames that the encoder looks ahead.
FILM_PIXEL_BYTES = 80

# The most that a file takes besides [bytes], but for a byte for every row of a PNG; and run.json besides its scene.
FILE_BYTES = 1024
RECORD_BYTES = 1 << 16

# Bytes of a pixel while its labels are found and written, and its normal; and of a tracked point in a frame, held until
# the end.
LABEL_PIXEL_BYTES = 60
NORMAL_PIXEL_BYTES = 24
TRACK_BYTES = 21

# Bytes of a row of the table of forces, at most, and of what is kept of one until the run ends.
FORCE_ROW_BYTES = 180
FORCE_BYTES = 6 * 8

# Numbers per mass point: displacement and difference; with a map of the stiffness, that of three springs, with one of
# the foundation its factor, and what these are made from; and the copies made at the start and for output.
STATE_NUMBERS = 6
MAP_NUMBERS = {"map": 6, "foundation_map": 4}
OUTPUT_NUMBERS = 15


@dataclass(frozen=True)
class Budget:
    """What a scene needs."""

    # points, steps, frames: numbers of mass points, of time steps, and of frames including that at rest
    points: int
    steps: int
    frames: int
    simulation_bytes: int  # memory for the state of the sheet and its output
    drawing_bytes: int  # memory for a frame and the texture; 0 if nothing is drawn
    track_bytes: int  # memory for the tracks, which are held until the run ends, and size of their file
    picture_bytes: int  # size of the files with pictures and labels, at most
    trajectory_bytes: int  # size of the trajectory
    force_bytes: int  # size of the table of forces, at most
    record_bytes: int  # size of the record and of the camera, at most
    working_bytes: int  # additional disk space that is used until the run ends

    @property
    def memory_bytes(self) -> int:
        """Memory in use at one time. Trajectories do not count, because they are streamed to disk."""
        return self.simulation_bytes + self.drawing_bytes + self.track_bytes

    @property
    def disk_bytes(self) -> int:
        """Size of all files, at most."""
        return self.picture_bytes + self.track_bytes + self.trajectory_bytes + self.force_bytes + self.record_bytes


def estimate_memory(plan: Plan) -> Budget:
    """Estimate what a run needs."""
    scene, grid = plan.scene, plan.grid
    rows, cols = scene.sheet.points
    points, number_bytes = rows * cols, 4 if grid.precision == "f32" else 8
    frames, (width, height) = grid.frames + 1, scene.render.size
    pixel_bytes = [OUTPUTS[name].pixel_bytes for folder in scene.folders.values() for name in folder]
    cameras = len(scene.render.all_cameras)
    picture = sum(width * height * each + height + FILE_BYTES for each in pixel_bytes if each)
    positions = frames * points * 3 * number_bytes
    tracks = scene.render.tracks**2 * (frames * TRACK_BYTES + 16) + FILE_BYTES if "tracks" in scene.output else 0
    tracks *= cameras
    forces = frames * len(scene.probes) if "forces" in scene.output else 0
    contact = contact_fields(scene.probes)
    loads = sum(not probe.moved for probe in scene.probes)
    numbers = STATE_NUMBERS + OUTPUT_NUMBERS + loads + contact + sum(MAP_NUMBERS[name] for name in scene.maps)
    # Pilots are up to two more sheets in f64; with tissue also two smaller ones.
    pilot = scene.time.tolerance is not None or choose_companion_runs(plan).planned
    sheets = number_bytes + (8 * (2 + (scene.tissue is not None) * 5 / 16) if pilot else 0)
    return Budget(
        points=points,
        steps=grid.steps,
        frames=frames,
        simulation_bytes=round(points * sheets * numbers),
        drawing_bytes=drawing_bytes(scene) if scene.renders else 0,
        track_bytes=tracks,
        picture_bytes=math.ceil(frames * picture),
        trajectory_bytes=positions + 8 * frames + FILE_BYTES if "trajectory" in scene.output else 0,
        force_bytes=forces * FORCE_ROW_BYTES + FILE_BYTES if "forces" in scene.output else 0,
        record_bytes=2 * len(scene.model_dump_json(indent=2)) + RECORD_BYTES,
        # Two saved states from which the run could continue, and all positions and forces so far.
        working_bytes=2 * points * (STATE_NUMBERS + contact) * number_bytes
        + (positions if scene.output else 0)
        + forces * FORCE_BYTES,
    )


def size_problems(plan: Plan) -> Iterator[Problem]:
    """Find what makes a scene too large, with the numbers and the key to change."""
    scene, grid, budget, available = plan.scene, plan.grid, estimate_memory(plan), available_memory()
    if grid.steps > MAX_STEPS:
        count = f"{scene.time.duration:g} s in steps of {grid.step:.6g} s is {grid.steps:.3g} steps"
        key, remedy = "step", "take a longer step or a shorter time"
        if scene.time.step == "auto":
            key, remedy = "duration", "take a shorter time, softer springs or more mass"
        yield Problem(("time", key), f"{count}, more than the {MAX_STEPS:.0e} that can be taken; {remedy}")
    if budget.memory_bytes <= available:
        return
    rows, cols = scene.sheet.points
    (width, height), tracks = scene.render.size, scene.render.tracks
    size, section, key, name = max(
        (budget.simulation_bytes, "sheet", "points", f"{rows} x {cols} points"),
        (budget.track_bytes, "render", "tracks", f"tracks of {tracks} x {tracks} points in {budget.frames} frames"),
        (budget.drawing_bytes, "render", "size", f"frames of {width} x {height} pixels and their texture"),
    )
    yield Problem(
        (section, key),
        f"the scene needs {_in_words(budget.memory_bytes)} of memory, {_in_words(size)} of it for {name}, "
        f"but {_in_words(available)} is free; reduce it",
    )


def require_disk(plan: Plan, directory: Path) -> None:
    """Raise SceneError, with the numbers and the key to change, where the disk has too little room for the results.

    The directory need not exist yet.
    """
    scene, budget, free = plan.scene, estimate_memory(plan), _free_disk(directory)
    needed = budget.disk_bytes + budget.working_bytes
    if needed <= free:
        return
    rows, cols = scene.sheet.points
    (width, height), tracks = scene.render.size, scene.render.tracks
    size, key, name = max(
        (budget.trajectory_bytes + budget.working_bytes, "sheet.points", f"positions of {rows} x {cols} points"),
        (budget.track_bytes, "render.tracks", f"tracks of {tracks} x {tracks} points"),
        (budget.picture_bytes, "render.size", f"pictures of {width} x {height} pixels"),
    )
    said = (
        f"{budget.frames} frames may need {_in_words(needed)} on disk, {_in_words(size)} of it for {name}, but "
        f"{_in_words(free)} is free for {directory}; reduce it, time.frames_per_second or output, or choose "
        "another --out"
    )
    raise SceneError([f"{key}: {said}"])


def drawing_bytes(scene: Scene) -> int:
    """Estimate the memory for drawing a frame [bytes], even if the scene's output has no pictures."""
    rows, cols = scene.sheet.points
    width, height = scene.render.size
    # The whole picture is decoded, even if only a region of it is used.
    picture = math.prod(texture.image_size(scene) or (0,))
    factor = scene.render.supersample
    band_rows = min(height * factor, BAND_ROWS * (os.cpu_count() or 1))
    samples = band_rows * width * factor * SAMPLE_BYTES
    cameras = scene.render.all_cameras.values()
    bent = sum(isinstance(camera, Camera) and camera.distortion is not None for camera in cameras)
    samples += width * height * factor**2 * PLACE_BYTES * bent
    pixel = PIXEL_BYTES + (LABEL_PIXEL_BYTES if scene.labels_pixels else 0)
    pixel += NORMAL_PIXEL_BYTES if "normals" in scene.output else 0
    pixel += FILM_PIXEL_BYTES if "mp4" in scene.output else 0
    pixels = width * height * len(cameras)
    return rows * cols * POINT_BYTES + samples + pixels * pixel + picture * PICTURE_PIXEL_BYTES


def _free_disk(directory: Path) -> int:
    """Give the free disk space for a directory [bytes]; sys.maxsize if the system does not report it."""
    for path in (directory, *directory.absolute().parents):
        with suppress(OSError):
            usage = shutil.disk_usage(path)
            # A file system that is not on a disk, such as /proc, has no size.
            return usage.free if usage.total else sys.maxsize
    return sys.maxsize


def _in_words(size: int) -> str:
    unit, name = next(((unit, name) for unit, name in ((2**30, "GiB"), (2**20, "MiB")) if size >= unit), (2**10, "KiB"))
    return f"{size / unit:.3g} {name}"


# Time of a unit of work [s], and of the calibration, on two cores of an AMD EPYC of 2024.
UNIT, CALIBRATION = 1.5e-9, 1e-4


class Duration(NamedTuple):
    """How long a run will take."""

    seconds: float  # from start to end [s]
    start: float  # the part of it before the first step [s]


def estimate_duration(plan: Plan) -> Duration:
    """Estimate how long a run takes on a CPU, with every core; computing it takes milliseconds."""
    parts = work(plan, choose_companion_runs(plan).cost)
    unit = UNIT * _calibrate() / CALIBRATION
    return Duration(unit * sum(parts), unit * parts.start)


@cache
def _calibrate() -> float:
    """Time a step of a small sheet in NumPy [s]: the fastest of some, which other programs disturb least."""
    field, fastest = np.zeros((256, 256), np.float32), math.inf
    for _ in range(20):
        start = time.perf_counter()
        around = field[:-2, 1:-1] + field[2:, 1:-1] + field[1:-1, :-2] + field[1:-1, 2:]
        field[1:-1, 1:-1] += 0.1 * (around - 4 * field[1:-1, 1:-1])
        fastest = min(fastest, time.perf_counter() - start)
    return fastest
