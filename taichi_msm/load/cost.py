"""Estimates of the memory, disk space and duration of a run, before it starts.

The duration is the work of the run times the time of a unit of work on this machine.
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
from typing import Any, NamedTuple

import numpy as np

from taichi_msm.accuracy.companions import choose_companion_runs
from taichi_msm.errors import Problem, SceneError
from taichi_msm.images import DECODING_BYTES
from taichi_msm.model.depth import DEPTH_PIXEL_BYTES
from taichi_msm.model.plan import Plan
from taichi_msm.model.time_grid import DTYPES
from taichi_msm.render import texture
from taichi_msm.render.labels import LABELS
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.outputs import OUTPUTS
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.planning import count_work
from taichi_msm.system.process import available_memory
from taichi_msm.terms import memory_names


def format_rough_time(seconds: float) -> str:
    """Format an approximate time: 40 s, 3 min, 2.5 h."""
    if seconds < 100:
        return f"{seconds:.0f} s" if seconds >= 1 else "1 s"
    if seconds < 6000:
        return f"{seconds / 60:.0f} min"
    return f"{seconds / 3600:.2g} h" if seconds < 360000 else f"{seconds / 86400:.0f} days"


MAX_STEPS = 10**12

# Memory for drawing [bytes].
POINT_BYTES = 36  # per mass point: its projection and its normal
SAMPLE_BYTES = 48  # per sample, upper bound
BAND_ROWS = 16  # rows of samples that a thread processes at a time
PIXEL_BYTES = 3 * 12  # per pixel of the frame: its colours, as sums, averages and bytes
DISTORTION_BYTES = 100  # per sample with lens distortion, while the undistortion map is computed and copied
VIDEO_PIXEL_BYTES = 80  # per pixel of a video, mostly in the frames of the encoder's look-ahead
LABEL_PIXEL_BYTES = 60  # per pixel with labels
LABEL_PLANE_BYTES = 8  # per pixel and value of an optional label
TRACK_BYTES = 21  # per tracked point and frame, until the run ends

# Upper bounds [bytes].
FILE_BYTES = 1024  # overhead of a file; a PNG has another byte per row
RECORD_BYTES = 1 << 16  # run.json, without its scene

# Force of a probe in a frame [bytes].
FORCE_ROW_BYTES = 180  # row of forces.csv, upper bound
REST_BYTES = 11 * 8  # position, area and normal of a mass point at rest, and its places in a picture and a file
GRID_BYTES = 2 * 8  # of an even grid in the checkpoint, per mass point
FORCE_BYTES = 6 * 8  # values in the checkpoint

# Numbers in memory per mass point.
STATE_NUMBERS = 6  # displacement and last difference
CURVED_NUMBERS = 12  # with a surface or mask: mobility, rest position, stiffness and tension of four springs
CURVED_BYTES = 500  # of a curved sheet at rest, with its cells and temporary arrays
MAP_NUMBERS = {"map": 6, "foundation_map": 4}  # stiffness of three springs; factor of the foundation; temporary arrays
OUTPUT_NUMBERS = 15  # copies at the start and for output


@dataclass(frozen=True)
class Budget:
    """Memory and disk space of a run."""

    frames: int  # including the initial one
    simulation_bytes: int  # memory for the state of the sheet and its output
    drawing_bytes: int  # memory for a frame and the texture; 0 if nothing is drawn
    track_bytes: int  # memory for the tracks until the run ends, and size of their file
    picture_bytes: int  # upper bound of the size of the files with pictures and labels
    trajectory_bytes: int  # size of the file of positions
    rest_bytes: int  # size of the file of a curved sheet at rest
    force_bytes: int  # upper bound of the size of the table of forces
    record_bytes: int  # upper bound of the size of run.json and camera.json
    working_bytes: int  # additional disk space until the run ends

    @property
    def memory_bytes(self) -> int:
        """Peak memory, without the positions, which are streamed to disk."""
        return self.simulation_bytes + self.drawing_bytes + self.track_bytes

    @property
    def disk_bytes(self) -> int:
        """Upper bound of the size of all results, without `working_bytes`."""
        files = self.picture_bytes, self.track_bytes, self.trajectory_bytes, self.rest_bytes, self.force_bytes
        return sum(files) + self.record_bytes


def step_entries(plan: Plan, frames: int) -> dict[str, Any]:
    """Build the entries of run.json about the steps to a frame; only the precision in a quasi-static scene."""
    grid, limit = plan.grid, plan.stable_step
    entries = {
        "step": grid.step,
        "stable_step": limit if limit < math.inf else None,
        "steps_per_frame": grid.steps_per_frame,
        "precision": grid.precision,
        "steps": frames * grid.steps_per_frame,
    }
    return {**dict.fromkeys(entries), "precision": grid.precision} if plan.scene.time.at_rest else entries


def estimate_budget(plan: Plan) -> Budget:
    """Estimate the memory and disk space of a run."""
    scene, grid = plan.scene, plan.grid
    points, number_bytes = math.prod(scene.sheet.points), DTYPES[grid.precision].itemsize
    frames, (width, height) = grid.frames + 1, scene.render.size
    pixel_bytes = [OUTPUTS[name].pixel_bytes for folder in scene.folders.values() for name in folder]
    cameras = len(scene.render.all_cameras)
    frame_bytes = sum(width * height * size + height + FILE_BYTES for size in pixel_bytes if size)
    position_bytes = frames * points * 3 * number_bytes
    track_bytes = scene.render.tracks**2 * (frames * TRACK_BYTES + 16) + FILE_BYTES if "tracks" in scene.output else 0
    track_bytes *= cameras
    force_rows = frames * len(scene.probes)
    surface = scene.sheet.surface
    surface_bytes = surface.file.values.nbytes if surface and surface.file else 0
    surface_bytes += CURVED_BYTES * points * (surface is not None)
    if surface and surface.depth and surface.frame:
        surface_bytes += DEPTH_PIXEL_BYTES * math.prod(surface.frame.region[2:])
    mask_bytes = scene.sheet.mask.pixels.is_sheet.nbytes if scene.sheet.mask else 0
    memory_numbers, has_grid = len(memory_names(plan)), surface is not None and surface.is_even
    numbers = STATE_NUMBERS + OUTPUT_NUMBERS + memory_numbers + sum(MAP_NUMBERS[name] for name in scene.maps)
    numbers += CURVED_NUMBERS * (surface is not None or scene.sheet.mask is not None)
    numbers += sum(not probe.moved for probe in scene.probes)  # the load of each force-controlled tool
    # Companion runs add up to two sheets in f64, and with tissue two smaller ones.
    has_companions = scene.time.tolerance is not None or choose_companion_runs(plan).planned
    bytes_per_number = number_bytes + (8 * (2 + (scene.tissue is not None) * 5 / 16) if has_companions else 0)
    return Budget(
        frames=frames,
        simulation_bytes=round(points * bytes_per_number * numbers) + surface_bytes + mask_bytes,
        drawing_bytes=drawing_bytes(scene) if scene.renders else 0,
        track_bytes=track_bytes,
        picture_bytes=math.ceil(frames * frame_bytes),
        trajectory_bytes=position_bytes + 8 * frames + FILE_BYTES if "trajectory" in scene.output else 0,
        rest_bytes=REST_BYTES * points + FILE_BYTES if surface else 0,
        force_bytes=force_rows * FORCE_ROW_BYTES + FILE_BYTES if "forces" in scene.output else 0,
        record_bytes=2 * len(scene.model_dump_json(indent=2)) + RECORD_BYTES,
        # Two states (the saved one and its replacement), and the positions and forces of all frames.
        working_bytes=2 * points * ((STATE_NUMBERS + memory_numbers) * number_bytes + GRID_BYTES * has_grid)
        + (position_bytes + force_rows * FORCE_BYTES if scene.output else 0),
    )


def size_problems(plan: Plan) -> Iterator[Problem]:
    """Yield a problem for too many steps and one for too much memory, each at the key to change."""
    scene, grid, budget, available = plan.scene, plan.grid, estimate_budget(plan), available_memory()
    if grid.steps > MAX_STEPS:
        count = f"{scene.time.duration:g} s in steps of {grid.step:.6g} s is {grid.steps:.3g} steps"
        key, remedy = "step", "take a longer step or a shorter time"
        if scene.time.step == "auto":
            key, remedy = "duration", "take a shorter time, softer springs or more mass"
        yield Problem(("time", key), f"{count}, more than the limit of {MAX_STEPS:.0e}; {remedy}")
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
        f"the scene needs {_format_bytes(budget.memory_bytes)} of memory, {_format_bytes(size)} of it for {name}, "
        f"but {_format_bytes(available)} is free; reduce {section}.{key}",
    )


def require_disk(plan: Plan, directory: Path) -> None:
    """Raise a SceneError, at the key with the largest share, if the files of a run may exceed the free disk space."""
    scene, budget, free = plan.scene, estimate_budget(plan), _free_disk(directory)
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
    message = (
        f"{budget.frames} frames may need {_format_bytes(needed)} on disk, {_format_bytes(size)} of it for {name}, but "
        f"{_format_bytes(free)} is free for {directory}; reduce {key}, time.frames_per_second or output, or "
        "choose another --out"
    )
    raise SceneError([f"{key}: {message}"])


def drawing_bytes(scene: Scene) -> int:
    """Estimate the memory for drawing a frame [bytes], also for scenes without pictures in their output."""
    width, height = scene.render.size
    # The whole image is decoded, even if only a region of it is used. Its texture takes less.
    image_pixels = math.prod(texture.image_size(scene) or (0,))
    factor = scene.render.supersample
    band_rows = min(height * factor, BAND_ROWS * (os.cpu_count() or 1))
    sample_bytes = band_rows * width * factor * SAMPLE_BYTES
    cameras = scene.render.all_cameras.values()
    distorted = sum(isinstance(camera, Camera) and camera.distortion is not None for camera in cameras)
    sample_bytes += width * height * factor**2 * DISTORTION_BYTES * distorted
    pixel_bytes = PIXEL_BYTES + (LABEL_PIXEL_BYTES if scene.labels_pixels else 0)
    optional_labels = (label for name, label in LABELS.items() if label.is_optional and name in scene.output)
    pixel_bytes += sum(LABEL_PLANE_BYTES * len(label.planes) for label in optional_labels)
    pixel_bytes += VIDEO_PIXEL_BYTES if "mp4" in scene.output else 0
    pixels = width * height * len(cameras)
    point_bytes = math.prod(scene.sheet.points) * POINT_BYTES
    return point_bytes + sample_bytes + pixels * pixel_bytes + image_pixels * DECODING_BYTES


def _free_disk(directory: Path) -> int:
    """Return the free disk space for a directory [bytes], or sys.maxsize if the system does not report it."""
    for path in (directory, *directory.absolute().parents):
        with suppress(OSError):
            usage = shutil.disk_usage(path)
            # A virtual file system, such as /proc, has size 0.
            return usage.free if usage.total else sys.maxsize
    return sys.maxsize


def _format_bytes(size: int) -> str:
    unit, name = next(((unit, name) for unit, name in ((2**30, "GiB"), (2**20, "MiB")) if size >= unit), (2**10, "KiB"))
    return f"{size / unit:.3g} {name}"


# Durations of a unit of work and of the calibration on two cores of an AMD EPYC of 2024 [s].
WORK_UNIT_S, CALIBRATION_S = 1.5e-9, 1e-4


class DurationEstimate(NamedTuple):
    """Estimated duration of a run [s]."""

    seconds: float
    start: float  # time before the first step [s], included in `seconds`


def estimate_duration(plan: Plan) -> DurationEstimate:
    """Estimate the duration of a run on all cores of the CPU; the calibration takes milliseconds."""
    units = count_work(plan, choose_companion_runs(plan).cost)
    unit_s = WORK_UNIT_S * _calibrate() / CALIBRATION_S
    return DurationEstimate(unit_s * sum(units), unit_s * units.start)


@cache
def _calibrate() -> float:
    """Measure the time of a step of a small sheet in NumPy [s]: the minimum of 20, least disturbed by others."""
    field, fastest = np.zeros((256, 256), np.float32), math.inf
    for _ in range(20):
        start = time.perf_counter()
        neighbours = field[:-2, 1:-1] + field[2:, 1:-1] + field[1:-1, :-2] + field[1:-1, 2:]
        field[1:-1, 1:-1] += 0.1 * (neighbours - 4 * field[1:-1, 1:-1])
        fastest = min(fastest, time.perf_counter() - start)
    return fastest
