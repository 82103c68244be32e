"""KITTI 2015 export: optical flow.

Every pair of adjacent frames is a scene of KITTI with the pictures `image_2/NNNNNN_10.png` and `_11.png`. The flow in
`flow_occ/NNNNNN_10.png` is valid on the whole sheet, that in `flow_noc/NNNNNN_10.png` only where the material point is
visible in both frames. Pairs are numbered consecutively over all runs. The folders are in a folder `training`, as KITTI
loaders expect. A flow (u, v) [px] is stored in a PNG with 16 bits per channel as

    red = 64 u + 2^15,   green = 64 v + 2^15,   blue = 1,

and 0 where it is invalid: on the background, and outside -512 to +511.98 px. The rounding error is at most 1/128 px.

Source: the development kit of KITTI's scene flow benchmark 2015, readme.txt and cpp/io_flow.h.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import FilesError, ProgressCallback
from taichi_msm.exports.formats import ExportSource
from taichi_msm.exports.inputs import read_flow, read_picture_file
from taichi_msm.runs.directory import write_new_file
from taichi_msm.runs.finished import FinishedRun
from taichi_msm.scene.outputs import OUTPUTS, zero_padded

# Folders, each with the entry of `output` that it contains.
SOURCE_OUTPUTS = {"flow_occ": "flow", "flow_noc": "occlusion", "image_2": "png"}


def write(sources: Sequence[ExportSource], folder: Path) -> Iterator[list[str]]:
    """Write the flow of runs, with pictures and occlusion if available."""
    training, first = folder / "training", 0
    for name in SOURCE_OUTPUTS:
        (training / name).mkdir(parents=True)
    for source in sources:
        yield _write_run(source.run, training, first, source.progress)
        first += source.run.frames - 1


def _write_run(run: FinishedRun, training: Path, first: int, progress: ProgressCallback) -> list[str]:
    """Write the pairs of a run, numbered from `first`."""
    pairs = run.frames - 1
    if pairs == 0:
        raise FilesError(f"{run.directory}: has only one frame, and flow needs two; run the scene to its end")
    flow_occ, flow_noc, image_2 = (training / name for name in SOURCE_OUTPUTS)
    for pair in range(pairs):
        progress(pair, pairs)
        flow, name = read_flow(run, pair), zero_padded(first + pair)
        write_new_file(flow_occ / f"{name}_10.png", png16(encode_flow(flow)))
        if run.has_output("occlusion"):
            visible = run.read_picture("occlusion", pair)[..., 0] == 0
            write_new_file(flow_noc / f"{name}_10.png", png16(encode_flow(flow, visible)))
        if run.has_output("png"):
            for number in (0, 1):
                write_new_file(image_2 / f"{name}_1{number}.png", read_picture_file(run, "png", pair + number))
    missing = {name: OUTPUTS[key].result for name, key in SOURCE_OUTPUTS.items() if not run.has_output(key)}
    remedy = run.remedy("occlusion", "png")
    return [f"{name} is left out, as the results have no {result}; {remedy}" for name, result in missing.items()]


def encode_flow(flow: NDArray[np.float32], visible: NDArray[np.bool_] | None = None) -> NDArray[np.uint16]:
    """Encode flow to the right and down [px] as the colours of KITTI, shape (height, width, 3).

    They are 0 where the flow is out of range, and where `visible` is False.
    """
    # In f32, the sum would be rounded before `rint`.
    scaled = np.rint(flow.astype(np.float64) * 64.0 + 32768.0)
    valid = ((scaled >= 0) & (scaled <= 65535.0)).all(axis=-1)
    if visible is not None:
        valid &= visible
    colours = np.zeros((*valid.shape, 3), np.uint16)
    colours[valid, :2] = scaled[valid]
    colours[valid, 2] = 1
    return colours


def png16(picture: NDArray[np.uint16]) -> bytes:
    """Encode colours, shape (height, width, 3), as a PNG with 16 bits per channel.

    Pillow does not support 16-bit colours, pypng has had no release since 2022, and OpenCV would be a dependency of
    60 MB for a single call.

    Source: the PNG specification of the W3C (third edition), sections 9 (filters) and 11 (chunks).
    """
    height, width, _ = picture.shape
    rows = picture.astype(">u2").view(np.uint8).reshape(height, -1)
    above = np.zeros_like(rows)
    above[1:] = rows[:-1]
    # Filter 2 stores the byte-wise difference from the row above.
    filtered = np.full((height, 1 + rows.shape[1]), 2, np.uint8)
    filtered[:, 1:] = rows - above
    # 16 bits per channel, and colour type 2: RGB.
    header = struct.pack(">IIBBBBB", width, height, 16, 2, 0, 0, 0)
    # For noisy flow of 512 x 512 pixels, level 1 takes 17 ms, the default 169 ms for 7 % fewer bytes.
    data = zlib.compress(filtered.tobytes(), 1)
    return b"\x89PNG\r\n\x1a\n" + _chunk(b"IHDR", header) + _chunk(b"IDAT", data) + _chunk(b"IEND", b"")


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(data, zlib.crc32(kind)))
