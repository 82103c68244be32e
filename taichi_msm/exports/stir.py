"""Tracks of points in stereo in the format of STIR, surgical tattoos in infrared.

Every run has a folder with

    calib.json                                      both cameras, and from the left to the right one
    left/seq00/frames/0ms-1200ms-visible.mp4        what the left camera sees; right/ is the same of the right one
    left/seq00/segmentation/icgstartseg.png         255 on a disc around every marked point in the first frame, else 0
    left/seq00/segmentation/icgendseg.png           the same in the last frame
    left/seq00/0ms_icgstart.png, 1200ms_icgend.png  the first and the last frame

STIR's infrared pictures show the tattoos alone; here they are the frames, by whose texture its loader pairs the points
of the left and the right picture. Marked are the tracked points that both cameras see in the first and in the last
frame, as far as their discs do not touch. A disc's centre is the pixel that the point is in.

A point X in the axes of the left camera (OpenCV's, [m]) is `rotation` X + `translation` in those of the right one, so
that the first number of `translation` is minus the baseline. Camera matrices count from the centre of the first pixel.

Source: athaddius/STIRLoader, STIRLoader/STIRLoader.py at 7e7f87c (lines 23 to 53, 69 to 80, 128 to 200, 204 to 281,
336 to 401, 582 to 587, 695 to 706).
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.errors import Count, FilesError, NotInstalledError
from taichi_msm.exports.formats import ExportSource
from taichi_msm.exports.inputs import FIRST_PIXEL_CENTRE, Pinhole, read_pinhole, read_tracks
from taichi_msm.runs import media
from taichi_msm.runs.directory import create_file, write_new_file
from taichi_msm.runs.finished import FinishedRun
from taichi_msm.scene import outputs
from taichi_msm.scene.outputs import numbered

FORMAT, CAMERAS = "stir", ("left", "right")

# What STIR's loader takes: pictures of this size, and for places in space disparities between these [px].
LOADER_SIZE, MIN_DISPARITY_PX, MAX_DISPARITY_PX = (1280, 1024), 8, 105

# The radius of a disc is the width of the picture over this.
WIDTH_PER_DISC_RADIUS = 160

# How far the cameras may be from being beside each other: cosines of angles, and shares of the baseline.
ALIGNMENT_TOLERANCE = 1e-6

Pixels = NDArray[np.int64]


def write(sources: Sequence[ExportSource], folder: Path) -> Iterator[list[str]]:
    """Write the films of runs, the marked points and the cameras.

    Raises:
        FilesError: what `read_pinhole` does, and when the cameras are not beside each other.
        NotInstalledError: when PyAV is not installed.
    """
    if not outputs.is_pyav_installed():
        raise NotInstalledError(f"--format {outputs.PYAV_NOT_INSTALLED.replace('mp4', FORMAT, 1)}")
    for run, name, progress in sources:
        yield _write_run(run, folder / (name or numbered(0)), progress)


def _write_run(run: FinishedRun, folder: Path, progress: Count) -> list[str]:
    runs = [replace(run, camera=side) for side in CAMERAS]
    folder.mkdir()
    left, right = (read_pinhole(each, FORMAT) for each in runs)
    baseline = _baseline(run, left, right)
    write_new_file(folder / "calib.json", (json.dumps(_calibration(left, right, baseline), indent=2) + "\n").encode())
    radius = max(1, round(run.scene.render.size[0] / WIDTH_PER_DISC_RADIUS))
    pixels, tracks = _choose_points(runs, radius)
    for number, each in enumerate(runs):
        sequence = folder / each.camera / "seq00"
        (sequence / "segmentation").mkdir(parents=True)
        for part, place in zip(("start", "end"), pixels[number], strict=True):
            mask = _png(_discs(place, run.scene.render.size, radius))
            write_new_file(sequence / "segmentation" / f"icg{part}seg.png", mask)
        _write_frames(each, sequence, partial(_report_progress, progress, number))
    return _notes(run.scene.render.size, pixels, tracks, baseline)


def _baseline(run: FinishedRun, left: Pinhole, right: Pinhole) -> float:
    """Tell how far the right camera is to the right of the left one [m]; a FilesError if it is anywhere else."""
    # From the axes of the left camera to those of the right one, in every frame.
    turn = right.poses[..., :3] @ left.poses[..., :3].transpose(0, 2, 1)
    shift = right.poses[..., 3] - (turn @ left.poses[..., 3:])[..., 0]
    baseline = -float(shift[0, 0])
    aligned = np.abs(turn - np.eye(3)).max() < ALIGNMENT_TOLERANCE
    aside = np.abs(shift - [-baseline, 0.0, 0.0]).max() < ALIGNMENT_TOLERANCE * baseline
    if not (aligned and aside) or (left.focal != right.focal).any():
        said = f"{FORMAT} needs the camera right beside left, to the right of it and just like it"
        raise FilesError(f"{run.directory}: {said}; run the scene with `right: {{beside: left, baseline: 0.005}}`")
    return baseline


def _calibration(left: Pinhole, right: Pinhole, baseline: float) -> dict[str, Any]:
    """Describe both cameras as STIR does."""
    matrices: dict[str, Any] = {}
    for side, camera in zip(CAMERAS, (left, right), strict=True):
        (across, down), (x, y) = camera.focal.tolist(), (camera.centre - FIRST_PIXEL_CENTRE).tolist()
        matrices[f"{side}cameramat"] = [[across, 0.0, x], [0.0, down, y], [0.0, 0.0, 1.0]]
        matrices[f"{side}distortioncoeffs"] = [0.0] * 5
    return {**matrices, "rotation": np.eye(3).tolist(), "translation": [-baseline, 0.0, 0.0]}


def _report_progress(progress: Count, before: int, done: int, total: int) -> None:
    """Report the progress of a camera, after so many others, as that of both."""
    progress(before * total + done, len(CAMERAS) * total)


def _choose_points(runs: Sequence[FinishedRun], radius: int) -> tuple[Pixels, int]:
    """Choose the points to mark: their pixels of both cameras in the first and last frame, shape (2, 2, n, 2).

    Also gives how many are tracked.
    """
    points, occluded = (np.stack(each)[:, :, [0, -1]] for each in zip(*map(read_tracks, runs), strict=True))
    pixels = np.floor(np.nan_to_num(points)).astype(np.int64).transpose(0, 2, 1, 3)
    inside = ((pixels >= radius) & (pixels < np.array(runs[0].scene.render.size) - radius)).all(axis=(0, 1, 3))
    chosen: list[int] = []
    for n in np.flatnonzero(inside & ~occluded.any(axis=(0, 2))).tolist():
        apart = np.abs(pixels[:, :, chosen] - pixels[:, :, [n]]).max(axis=-1)
        if (apart > 2 * radius + 1).all():
            chosen.append(n)
    return pixels[:, :, chosen], points.shape[1]


def _discs(pixels: Pixels, size: tuple[int, int], radius: int) -> NDArray[np.uint8]:
    """Draw discs around pixels, shape (n, 2), that are inside of a picture of this width and height."""
    mask = np.zeros(size[::-1], np.uint8)
    reach = np.arange(-radius, radius + 1)
    disc = (reach[:, None] ** 2 + reach**2 <= radius**2) * np.uint8(255)
    for x, y in pixels.tolist():
        mask[y - radius : y + radius + 1, x - radius : x + radius + 1] |= disc
    return mask


def _write_frames(run: FinishedRun, folder: Path, progress: Count) -> None:
    """Write the film of a camera, and its first and last frame."""
    render = run.scene.render
    end = round(1000 * run.time[-1])
    (folder / "frames").mkdir()
    with create_file(folder / "frames" / f"0ms-{end}ms-visible.mp4") as file:
        film = media.Mp4Writer(file, render.size, run.scene.time.frames_per_second, render.quality)
        for frame in range(run.frames):
            progress(frame, run.frames)
            film.add(run.read_picture("png", frame))
        film.close()
    write_new_file(folder / "0ms_icgstart.png", _png(run.read_picture("png", 0)))
    write_new_file(folder / f"{end}ms_icgend.png", _png(run.read_picture("png", run.frames - 1)))


def _png(picture: NDArray[np.uint8]) -> bytes:
    file = io.BytesIO()
    Image.fromarray(picture).save(file, "PNG")
    return file.getvalue()


def _notes(size: tuple[int, int], pixels: Pixels, tracks: int, baseline: float) -> list[str]:
    """Say what is left out, and what STIR's loader does not take."""
    notes, marked = [], pixels.shape[2]
    if marked < tracks:
        notes.append(
            f"{marked} of {tracks} points are marked; the others are hidden from a camera in the first or last frame, "
            "or too near to the edge or to a marked one"
        )
    if size != LOADER_SIZE:
        notes.append(
            f"STIR's loader reads films of {LOADER_SIZE[0]} x {LOADER_SIZE[1]} pixels only; these have {size[0]} x {size[1]}"
        )
    disparity = pixels[0, :, :, 0] - pixels[1, :, :, 0]
    if ((disparity < MIN_DISPARITY_PX) | (disparity > MAX_DISPARITY_PX)).any():
        notes.append(
            f"STIR's loader finds places in space for disparities of {MIN_DISPARITY_PX} to {MAX_DISPARITY_PX} px; here they are "
            f"{disparity.min()} to {disparity.max()} px with a baseline of {baseline:g} m"
        )
    return notes
