"""TAPVid-3D export: 3D tracks, an .npz per run.

    images_jpeg_bytes   frames as JPEG bytes, shape (frames,)
    queries_xyt         start of each track: x and y [px] in the first frame t in which it is visible,
                        shape (tracks, 3)
    tracks_XYZ          positions in the axes of the camera in each frame, OpenCV's: x right, y down, z forward [m],
                        shape (frames, tracks, 3)
    visibility          whether the track is visible, bool, shape (frames, tracks)
    fx_fy_cx_cy         focal lengths and principal point [px]
    extrinsics_w2c      transform from world to camera axes [m], shape (frames, 4, 4), as in the samples of TAPVid-3D

Pixel coordinates count from the picture's upper left corner, so that the centre of the first pixel is (0.5, 0.5).
Tracks that are visible in no frame have no query and are omitted.

Source: google-deepmind/tapnet, tapnet/tapvid3d: README.md, evaluation/evaluate_model.py (evaluate_data_source),
evaluation/metrics.py, annotation_generation/adt_utils.py (filter_visibilities has the pixels).
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ProgressCallback
from taichi_msm.exports.formats import one_path_per_run
from taichi_msm.exports.inputs import encode_picture, read_pinhole, read_track_positions, read_tracks, scene_pinhole
from taichi_msm.runs.arrays import write_arrays
from taichi_msm.runs.directory import create_file
from taichi_msm.runs.finished import FinishedRun


def _write_run(run: FinishedRun, path: Path, progress: ProgressCallback) -> list[str]:
    camera, (pixels, occluded) = read_pinhole(run, "tapvid3d"), read_tracks(run)
    _, position = read_track_positions(run)
    images = []
    for frame in range(run.frames):
        progress(frame, run.frames)
        # Nearly lossless, without chroma subsampling.
        images.append(encode_picture(run.read_picture("png", frame), "JPEG", quality=95, subsampling=0))
    is_exported: NDArray[np.bool_] = np.any(~occluded, axis=1)
    visible = ~occluded[is_exported]
    first = visible.argmax(axis=1)
    queries = np.column_stack([pixels[is_exported][np.arange(len(first)), first], first])
    rotated = np.einsum("fij,nfj->fni", camera.poses[..., :3], position[is_exported].astype(np.float64))
    arrays = {
        "images_jpeg_bytes": np.array(images),
        "queries_xyt": queries.astype(np.float64),
        "tracks_XYZ": rotated + camera.poses[:, None, :, 3],
        "visibility": np.ascontiguousarray(visible.T),
        "fx_fy_cx_cy": np.concatenate([camera.focal, camera.centre]),
        "extrinsics_w2c": camera.matrices,
    }
    with create_file(path) as archive:
        write_arrays(archive, arrays)
    tracks, omitted = len(occluded), len(occluded) - int(is_exported.sum())
    return [f"{omitted} of {tracks} tracks are left out, as no frame shows them"] if omitted else []


write = one_path_per_run(_write_run, ".npz")


def check_camera(run: FinishedRun) -> None:
    """Raise an ArgumentError unless the camera of the run's scene is a pinhole without distortion."""
    scene_pinhole(run, "tapvid3d")
