"""Tracks of points in space in the format of TAPVid-3D: an .npz for every run.

    images_jpeg_bytes   frames, each as the bytes of a JPEG, shape (frames,)
    queries_xyt         where to begin to track each point: x and y [px] in frame t, the first in which the point is
                        seen, shape (tracks, 3)
    tracks_XYZ          where each point is in the camera's axes of each frame, OpenCV's: x right, y down, z forward
                        [m], shape (frames, tracks, 3)
    visibility          whether it is seen, bool, shape (frames, tracks)
    fx_fy_cx_cy         focal lengths and principal point [px]
    extrinsics_w2c      from the world to the camera's axes [m], shape (frames, 4, 4), as in TAPVid-3D's samples

Pixels are counted from the picture's upper left corner, so that the centre of the first is at (0.5, 0.5). Points that
no frame shows have no query and are left out.

Source: google-deepmind/tapnet, tapnet/tapvid3d: README.md, evaluation/evaluate_model.py (evaluate_data_source),
evaluation/metrics.py, annotation_generation/adt_utils.py (filter_visibilities has the pixels).
"""

from __future__ import annotations

import io
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.errors import Count
from taichi_msm.exports.formats import ExportSource
from taichi_msm.exports.inputs import read_pinhole, read_track_positions, read_tracks
from taichi_msm.runs.arrays import write_arrays
from taichi_msm.runs.directory import create_file
from taichi_msm.runs.finished import FinishedRun
from taichi_msm.scene.outputs import numbered

FORMAT = "tapvid3d"

# Of a JPEG: nearly lossless, with colours as fine as light.
QUALITY, SUBSAMPLING = 95, 0


def write(sources: Sequence[ExportSource], folder: Path) -> Iterator[list[str]]:
    """Write the tracks of runs and their frames; raises what `read_pinhole` does."""
    for run, name, progress in sources:
        yield _write_run(run, folder / f"{name or numbered(0)}.npz", progress)


def _write_run(run: FinishedRun, path: Path, progress: Count) -> list[str]:
    camera, (points, occluded), (_, position) = read_pinhole(run, FORMAT), read_tracks(run), read_track_positions(run)
    images = []
    for frame in range(run.frames):
        progress(frame, run.frames)
        file = io.BytesIO()
        Image.fromarray(run.read_picture("png", frame)).save(file, "JPEG", quality=QUALITY, subsampling=SUBSAMPLING)
        images.append(file.getvalue())
    seen: NDArray[np.bool_] = np.any(~occluded, axis=1)
    visible = ~occluded[seen]
    first = visible.argmax(axis=1)
    queries = np.column_stack([points[seen][np.arange(len(first)), first], first])
    extrinsics = np.concatenate([camera.poses, np.tile([[[0.0, 0.0, 0.0, 1.0]]], (run.frames, 1, 1))], axis=1)
    turned = np.einsum("fij,nfj->fni", camera.poses[..., :3], position[seen].astype(np.float64))
    with create_file(path) as out:
        write_arrays(
            out,
            {
                "images_jpeg_bytes": np.array(images),
                "queries_xyt": queries.astype(np.float64),
                "tracks_XYZ": turned + camera.poses[:, None, :, 3],
                "visibility": np.ascontiguousarray(visible.T),
                "fx_fy_cx_cy": np.concatenate([camera.focal, camera.centre]),
                "extrinsics_w2c": extrinsics,
            },
        )
    unseen = len(seen) - int(seen.sum())
    return [f"{unseen} of {len(seen)} points are left out, as no frame shows them"] if unseen else []
