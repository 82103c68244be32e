"""Optical flow in the format of KITTI 2015.

Every pair of frames f and f + 1 is a scene of KITTI: `image_2/NNNNNN_10.png` and `_11.png`, and its flow in
`flow_occ/NNNNNN_10.png`, valid wherever the sheet is, and `flow_noc/NNNNNN_10.png`, valid only where what is seen in f
is seen in f + 1 too. All are in a folder `training`, as loaders of KITTI look for it. A flow (u, v) [px] is a PNG of 16
bits a channel,

    red = 64 u + 2^15,   green = 64 v + 2^15,   blue = 1: valid,

and all are 0 where it is not valid: on the background, and where red or green would not fit, that is beyond -512 and
+511.98 px. Rounded to the nearest, flow is exact to 1/128 px.

Source: the development kit of KITTI's scene flow benchmark 2015, readme.txt and cpp/io_flow.h.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import FilesError
from taichi_msm.export.frames import frame_path, read_picture
from taichi_msm.export.png16 import png16
from taichi_msm.progress import Count
from taichi_msm.results.finished_run import FinishedRun, reading
from taichi_msm.results.flo import read_flo
from taichi_msm.results.folder import Folder, Tree
from taichi_msm.results.publication import FLOW, FRAMES, OCCLUSION, series_file

ROOT, PICTURES, ALL, SEEN = "training", "image_2", "flow_occ", "flow_noc"
FIRST = {r"[0-9]{6,}_10\.png": None}
FILES: Tree = {ROOT: {PICTURES: {r"[0-9]{6,}_1[01]\.png": None}, ALL: FIRST, SEEN: FIRST}}

SCALE, ZERO, LARGEST = 64.0, 32768.0, 65535.0


def write_kitti(run: FinishedRun, folder: Folder, progress: Count) -> list[str]:
    """Write the flow of a run, and its frames and occlusion if it has them.

    Raises:
        FilesError: when the run has no flow, or when a file is missing or damaged.
    """
    size, pairs = run.scene.render.size, run.frames - 1
    if pairs == 0:
        raise FilesError(f"{run.directory}: has only one frame, and flow needs two; run the scene to its end")
    has = {output: run.has(output) for output in (OCCLUSION, FRAMES)}
    with (
        folder.folder(ROOT, create=True) as root,
        root.folder(ALL, create=True) as flows,
        root.folder(SEEN, create=True) as seen,
        root.folder(PICTURES, create=True) as pictures,
    ):
        for pair in range(pairs):
            progress(pair, pairs)
            flow, name = read_flo(run.result(f"{FLOW}/{series_file(FLOW, pair)}", FLOW), size), f"{pair:06}_10.png"
            flows.add(name, png16(encode(flow)))
            if has[OCCLUSION]:
                path = run.result(f"{OCCLUSION}/{series_file(OCCLUSION, pair)}", OCCLUSION)
                seen.add(name, png16(encode(flow, ~(read_picture(path, size)[..., 0] > 0))))
            for number in (0, 1) if has[FRAMES] else ():
                _copy(run, pair + number, pictures, f"{pair:06}_1{number}.png")
    left_out = [(OCCLUSION, SEEN), (FRAMES, PICTURES)]
    return [
        f"{name} is left out: {output} is not among the results; {run.remedy(OCCLUSION, 'png')}"
        for output, name in left_out
        if not has[output]
    ]


def encode(flow: NDArray[np.float32], seen: NDArray[np.bool_] | None = None) -> NDArray[np.uint16]:
    """Turn flow into the colours of KITTI.

    Args:
        flow: to the right and down [px], shape (height, width, 2); values that do not fit are not valid.
        seen: where flow can be valid at all, shape (height, width); None: everywhere.

    Returns:
        Red, green and blue, shape (height, width, 3).
    """
    # In double precision, so that the only rounding is to the nearest whole number.
    scaled = np.rint(flow.astype(np.float64) * SCALE + ZERO)
    valid = ((scaled >= 0) & (scaled <= LARGEST)).all(axis=-1)
    if seen is not None:
        valid &= seen
    colours = np.zeros((*valid.shape, 3), np.uint16)
    colours[valid, :2] = scaled[valid]
    colours[valid, 2] = 1
    return colours


def _copy(run: FinishedRun, number: int, folder: Folder, name: str) -> None:
    """Copy a frame, after checking that it is a whole picture of the right size."""
    source = frame_path(run, number)
    read_picture(source, run.scene.render.size)
    with reading(source):
        data = source.read_bytes()
    folder.add(name, data)
