"""STIR export (surgical tattoos in infrared): stereo tracks.

Every run has a folder with

    calib.json                                      both cameras, and the transform from the left to the right one
    left/seq00/frames/0ms-1200ms-visible.mp4        video of the left camera; right/ has the files of the right camera
    left/seq00/segmentation/icgstartseg.png         first frame: 255 on a disc around every marked track, else 0
    left/seq00/segmentation/icgendseg.png           the same for the last frame
    left/seq00/0ms_icgstart.png, 1200ms_icgend.png  first and last frame

The start and end pictures are frames in visible light, because the loader matches left and right tracks by texture, and
infrared pictures show only the tattoos. A track is marked if both cameras see it in the first and last frame, and its
disc touches no other disc. The centre of a disc is the pixel that contains the track.

A position X_left in the axes of the left camera (OpenCV's, [m]) is X_right = `rotation` X_left + `translation` in
those of the right one: the first component of `translation` is the negative baseline. Camera matrices count from the
centre of the first pixel.

Source: athaddius/STIRLoader, STIRLoader/STIRLoader.py at 7e7f87c (lines 23 to 53, 69 to 80, 128 to 200, 204 to 281,
336 to 401, 582 to 587, 695 to 706).
"""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import FilesError, NotInstalledError, ProgressCallback
from taichi_msm.exports.formats import one_path_per_run
from taichi_msm.exports.inputs import (
    FIRST_PIXEL_CENTRE,
    Pinhole,
    encode_picture,
    read_pinhole,
    read_tracks,
    scene_pinhole,
)
from taichi_msm.runs import media
from taichi_msm.runs.directory import create_file, write_new_file
from taichi_msm.runs.finished import FinishedRun
from taichi_msm.scene import outputs

FORMAT_NAME, CAMERAS = "stir", ("left", "right")

# Limits of STIR's loader: picture size [px], range of disparities that it triangulates.
LOADER_SIZE, MIN_DISPARITY_PX, MAX_DISPARITY_PX = (1280, 1024), 8, 105

# Tolerance of a rectified stereo pair: deviation of the rotation matrix, and offsets relative to the baseline.
ALIGNMENT_TOLERANCE = 1e-6

Pixels = NDArray[np.int64]


def _write_run(run: FinishedRun, folder: Path, progress: ProgressCallback) -> list[str]:
    if not outputs.is_pyav_installed():
        raise NotInstalledError(f"--format {outputs.PYAV_NOT_INSTALLED.replace('mp4', FORMAT_NAME, 1)}")
    runs = [replace(run, camera=side) for side in CAMERAS]
    folder.mkdir()
    left, right = (read_pinhole(camera_run, FORMAT_NAME) for camera_run in runs)
    baseline = _baseline(run, left, right)
    write_new_file(folder / "calib.json", (json.dumps(_calibration(left, right, baseline), indent=2) + "\n").encode())
    radius = max(1, round(run.scene.render.size[0] / 160))
    pixels, tracks = _choose_tracks(runs, radius)
    for number, camera_run in enumerate(runs):
        sequence = folder / camera_run.camera / "seq00"
        (sequence / "segmentation").mkdir(parents=True)
        for name, centres in zip(("start", "end"), pixels[number], strict=True):
            mask = encode_picture(_discs(centres, run.scene.render.size, radius), "PNG")
            write_new_file(sequence / "segmentation" / f"icg{name}seg.png", mask)
        _write_frames(camera_run, sequence, partial(_report_progress, progress, number))
    return _notes(run.scene.render.size, pixels, tracks, baseline)


write = one_path_per_run(_write_run)


def check_camera(run: FinishedRun) -> None:
    """Raise an ArgumentError unless the camera of the run's scene is a pinhole without distortion."""
    scene_pinhole(run, FORMAT_NAME)


def _baseline(run: FinishedRun, left: Pinhole, right: Pinhole) -> float:
    """Return the baseline of a rectified stereo pair [m]; raise a FilesError for other cameras."""
    # Transform from the axes of the left camera to those of the right one, in every frame.
    rotation = right.poses[..., :3] @ left.poses[..., :3].transpose(0, 2, 1)
    translation = right.poses[..., 3] - (rotation @ left.poses[..., 3:])[..., 0]
    baseline = -float(translation[0, 0])
    is_parallel = np.abs(rotation - np.eye(3)).max() < ALIGNMENT_TOLERANCE
    is_horizontal = np.abs(translation - [-baseline, 0.0, 0.0]).max() < ALIGNMENT_TOLERANCE * baseline
    if not (is_parallel and is_horizontal) or (left.focal != right.focal).any():
        fault = f"{FORMAT_NAME} needs a rectified stereo pair of equal cameras, left and right"
        raise FilesError(f"{run.directory}: {fault}; run the scene with `right: {{beside: left, baseline: 0.005}}`")
    return baseline


def _calibration(left: Pinhole, right: Pinhole, baseline: float) -> dict[str, Any]:
    matrices: dict[str, Any] = {}
    for side, camera in zip(CAMERAS, (left, right), strict=True):
        (across, down), (x, y) = camera.focal.tolist(), (camera.centre - FIRST_PIXEL_CENTRE).tolist()
        matrices[f"{side}cameramat"] = [[across, 0.0, x], [0.0, down, y], [0.0, 0.0, 1.0]]
        matrices[f"{side}distortioncoeffs"] = [0.0] * 5
    return {**matrices, "rotation": np.eye(3).tolist(), "translation": [-baseline, 0.0, 0.0]}


def _report_progress(progress: ProgressCallback, before: int, done: int, total: int) -> None:
    """Report the progress of a camera as progress of both, of which `before` are finished."""
    progress(before * total + done, len(CAMERAS) * total)


def _choose_tracks(runs: Sequence[FinishedRun], radius: int) -> tuple[Pixels, int]:
    """Choose the tracks to mark; return their pixels and the number of all tracks.

    The pixels are those per camera in the first and last frame, shape (2, 2, tracks, 2).
    """
    tracks, occluded = (np.stack(each)[:, :, [0, -1]] for each in zip(*map(read_tracks, runs), strict=True))
    # From the axes camera, track, frame, component to camera, frame, track, component.
    pixels = np.floor(np.nan_to_num(tracks)).astype(np.int64).transpose(0, 2, 1, 3)
    inside = ((pixels >= radius) & (pixels < np.array(runs[0].scene.render.size) - radius)).all(axis=(0, 1, 3))
    chosen: list[int] = []
    for n in np.flatnonzero(inside & ~occluded.any(axis=(0, 2))).tolist():
        distance = np.abs(pixels[:, :, chosen] - pixels[:, :, [n]]).max(axis=-1)
        if (distance > 2 * radius + 1).all():
            chosen.append(n)
    return pixels[:, :, chosen], tracks.shape[1]


def _discs(pixels: Pixels, size: tuple[int, int], radius: int) -> NDArray[np.uint8]:
    """Draw discs around pixels, shape (n, 2), in a mask of `size` (width, height)."""
    mask = np.zeros(size[::-1], np.uint8)
    offset = np.arange(-radius, radius + 1)
    disc = (offset[:, None] ** 2 + offset**2 <= radius**2) * np.uint8(255)
    for x, y in pixels.tolist():
        mask[y - radius : y + radius + 1, x - radius : x + radius + 1] |= disc
    return mask


def _write_frames(run: FinishedRun, folder: Path, progress: ProgressCallback) -> None:
    render = run.scene.render
    end = round(1000 * run.time[-1])
    (folder / "frames").mkdir()
    with create_file(folder / "frames" / f"0ms-{end}ms-visible.mp4") as file:
        video = media.Mp4Writer(file, render.size, run.scene.time.frames_per_second, render.quality)
        for frame in range(run.frames):
            progress(frame, run.frames)
            video.add(run.read_picture("png", frame))
        video.close()
    for name, frame in (("0ms_icgstart.png", 0), (f"{end}ms_icgend.png", run.frames - 1)):
        write_new_file(folder / name, encode_picture(run.read_picture("png", frame), "PNG"))


def _notes(size: tuple[int, int], pixels: Pixels, tracks: int, baseline: float) -> list[str]:
    notes, marked = [], pixels.shape[2]
    if marked < tracks:
        notes.append(
            f"{marked} of {tracks} tracks are marked; the others are occluded in the first or last frame of a camera, "
            "or too close to the edge or to a marked one"
        )
    if size != LOADER_SIZE:
        width, height = LOADER_SIZE
        notes.append(f"STIR's loader reads videos of {width} x {height} pixels only; these have {size[0]} x {size[1]}")
    disparity = pixels[0, :, :, 0] - pixels[1, :, :, 0]
    if ((disparity < MIN_DISPARITY_PX) | (disparity > MAX_DISPARITY_PX)).any():
        notes.append(
            f"STIR's loader triangulates disparities of {MIN_DISPARITY_PX} to {MAX_DISPARITY_PX} px only; "
            f"these are {disparity.min()} to {disparity.max()} px, with a baseline of {baseline:g} m"
        )
    return notes
