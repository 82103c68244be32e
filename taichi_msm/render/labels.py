"""Ground-truth labels of pixels: types and layout, without Taichi."""

from __future__ import annotations

import math
from collections.abc import Collection, Iterator
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.geometry import Rest

# Unknown flow in the Middlebury format.
NO_FLOW = 1e10


class Labels(NamedTuple):
    """Ground-truth labels of the pixels of a frame, at their centres.

    Attributes:
        coordinates: coordinates of the material point, as fractions of the sheet's width from its left and of its
            height from its top, shape (height, width, 2); NaN where the sheet is not visible.
        depth: distance from the eye along the optical axis [m], shape (height, width); 0 where nothing is visible. The
            height of the orthographic camera's eye is the sheet's larger side; surfaces above it have negative depth.
        instrument: 255 where an instrument is visible, else 0, shape (height, width).
        normals: unit normals of the drawn triangle or the instrument's surface, toward the camera, in OpenCV's axes (x
            right, y down, z forward), shape (height, width, 3); NaN where nothing is visible. Shape (0, 0, 3) if the
            scene does not request normals.
    """

    coordinates: NDArray[np.float32]
    depth: NDArray[np.float32]
    instrument: NDArray[np.uint8]
    normals: NDArray[np.float32] = np.empty((0, 0, 3), np.float32)


class PicturedLabels(Labels):
    """Labels of a sheet with a picture by a camera, whose fractions are the coordinates.

    `mesh` are the fractions (u, v) of columns and rows, shape (height, width, 2), NaN where the sheet is not visible.
    """

    mesh: NDArray[np.float32]


class Label(NamedTuple):
    """Layout of a label in the output of kernel 2: one or several values per pixel, row by row."""

    planes: tuple[str, ...]  # names of the G-buffer planes with the values (config.py)
    missing_value: float  # in pixels without a visible surface
    sheet_only: bool  # whether pixels of instruments also have the missing value
    dtype: type[np.generic]
    is_optional: bool = False  # whether the label is written only on request


# The fields of `Labels`.
LABELS = {
    "coordinates": Label(("across", "down"), math.nan, sheet_only=True, dtype=np.float32),
    "depth": Label(("depth",), 0.0, sheet_only=False, dtype=np.float32),
    "instrument": Label(("instrument",), 0.0, sheet_only=False, dtype=np.uint8),
    "normals": Label(("facet_x", "facet_y", "facet_z"), math.nan, sheet_only=False, dtype=np.float32, is_optional=True),
}

# All labels that kernel 2 writes: with a picture by a camera also `PicturedLabels.mesh`.
WRITTEN = {**LABELS, "mesh": Label(("mesh_across", "mesh_down"), math.nan, sheet_only=True, dtype=np.float32)}


def requested_labels(outputs: Collection[str]) -> frozenset[str]:
    """Return the names of the labels to write: the optional ones only if they are among the outputs."""
    return frozenset(name for name, label in LABELS.items() if name in outputs or not label.is_optional)


def _label_offsets(names: Collection[str]) -> Iterator[tuple[str, Label, int]]:
    """Yield the name, the label and its offset [values per pixel] of the labels of these names."""
    offset = 0
    for name, label in WRITTEN.items():
        if name in names:
            yield name, label, offset
            offset += len(label.planes)


def values_per_pixel(names: Collection[str]) -> int:
    """Return the number of values per pixel of labels."""
    return sum(len(WRITTEN[name].planes) for name in names)


class Channel(NamedTuple):
    """Plane of the G-buffer with a value of a label."""

    plane: int  # index of the plane
    label: Label
    offset: int  # of the label [values per pixel]
    number: int  # of the value in the label


def label_channels(plane: Any, names: Collection[str]) -> list[Channel]:
    """Return the channels of labels; a label without planes has none, and is 0."""
    return [
        Channel(getattr(plane, plane_name), label, offset, n)
        for _, label, offset in _label_offsets(names)
        for n, plane_name in enumerate(label.planes)
        if hasattr(plane, plane_name)
    ]


def labels_of(numbers: NDArray[np.float32], size: tuple[int, int], names: Collection[str]) -> Labels:
    """Return the labels of a picture of `size` (width, height) [px] from the values that kernel 2 writes."""
    (width, height), arrays = size, {}
    for name, label, offset in _label_offsets(names):
        count = len(label.planes)
        values = numbers.reshape(-1, width * height)[offset : offset + count]
        arrays[name] = values.reshape((height, width, count)[: 2 + (count > 1)]).astype(label.dtype, copy=False)
    # Rounding may move coordinates beyond the sheet's edge.
    for name in ("coordinates", "mesh"):
        if name in arrays:
            arrays[name] = arrays[name].clip(0, 1)
    mesh = arrays.pop("mesh", None)
    if mesh is None:
        return Labels(**arrays)
    labels = PicturedLabels(**arrays)
    labels.mesh = mesh
    return labels


class Flow(NamedTuple):
    """Optical flow from one frame to another, in the pixels of the first one.

    Attributes:
        flow: displacement of the material to the right and down [px], shape (height, width, 2); NO_FLOW where the sheet
            is not visible, and where the material moves behind the eye.
        occlusion: 255 where the sheet is visible in the first frame, but occluded in the second one; else 0; shape
            (height, width).
    """

    flow: NDArray[np.float32]
    occlusion: NDArray[np.uint8]


class Stereo(NamedTuple):
    """Labels of a stereo pair in the pixels of the first camera; None for those that were not requested."""

    # Displacement from the first to the second picture, to the left [px], shape (height, width); 0 where nothing is
    # visible.
    disparity: NDArray[np.float32] | None = None
    # Displacement from the first to the second picture, to the right and down [px], shape (height, width, 2); NO_FLOW
    # where nothing is visible, and where the visible point is behind the second eye.
    stereo: NDArray[np.float32] | None = None
    # 255 where the visible point is occluded in the second picture or outside it, else 0, shape (height, width).
    stereo_occlusion: NDArray[np.uint8] | None = None


class Sight(NamedTuple):
    """Pixels and occlusion of material points.

    Attributes:
        pixels: x to the right and y down from the picture's upper left corner [px], shape (n, 2); NaN behind the eye,
            and for points in cells without sheet.
        hidden: whether a point is occluded, outside the picture or without sheet, shape (n,).
    """

    pixels: NDArray[np.float32]
    hidden: NDArray[np.bool_]


class FrameOutputs(NamedTuple):
    """Outputs of a frame; None for those that were not requested."""

    picture: NDArray[np.uint8] | None = None  # colours, shape (height, width, 3)
    labels: Labels | None = None
    flow: Flow | None = None  # from the previous frame to this one
    stereo: Stereo | None = None
    tracks: Sight | None = None


def track_grid(count: int, rest: Rest | None = None) -> NDArray[np.float32]:
    """Return the coordinates of the centres of count^2 equal parts of the rectangle, row by row, shape (n, 2).

    With a sheet, those on it.
    """
    centres = (np.arange(count) + 0.5) / count
    down, across = np.meshgrid(centres, centres, indexing="ij")
    coordinates = np.stack([across, down], axis=-1).reshape(-1, 2)
    return (coordinates if rest is None else coordinates[rest.covers(coordinates)]).astype(np.float32)
