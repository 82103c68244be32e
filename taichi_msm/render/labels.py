"""Labels, which tell what each pixel shows: the types of their values, without Taichi."""

from __future__ import annotations

import math
from itertools import accumulate
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

# The value for "no flow" in the Middlebury format.
NO_FLOW = 1e10


class Labels(NamedTuple):
    """What each pixel of a frame shows at its centre.

    Attributes:
        coordinates: of the material point, fractions of the sheet's width from its left and of its height from its top,
            shape (height, width, 2); NaN where no sheet is seen.
        depth: distance from the eye along the direction of view [m], shape (height, width); 0 where nothing is seen.
            The orthographic camera's eye is as far above the sheet at rest as the sheet's larger side is long; what
            is above the eye has a depth below 0.
        instrument: 255 where an instrument is seen, else 0, shape (height, width).
        normals: unit, of the drawn triangle or the instrument's surface, toward the camera, in OpenCV's axes of the
            camera (x right, y down, z forward), shape (height, width, 3); NaN where nothing is seen. Of a frame that
            is observed for a scene whose output has no normals: of shape (0, 0, 3).
    """

    coordinates: NDArray[np.float32]
    depth: NDArray[np.float32]
    instrument: NDArray[np.uint8]
    normals: NDArray[np.float32] = np.empty((0, 0, 3), np.float32)


class Label(NamedTuple):
    """How kernel 2 writes a label: one number or several for every pixel, row by row."""

    planes: tuple[str, ...]  # where a tile of samples has the numbers (samples.py)
    nothing: float  # the number where nothing is seen
    of_sheet: bool  # whether it tells of the sheet alone; then it is `nothing` too where an instrument is seen
    dtype: type[np.generic]  # of its values
    first: int = 0  # numbers per pixel of the labels before it


def _in_turn(**labels: Label) -> dict[str, Label]:
    """Let the kernel write the labels one after the other."""
    taken = accumulate((len(label.planes) for label in labels.values()), initial=0)
    return {name: label._replace(first=first) for (name, label), first in zip(labels.items(), taken, strict=False)}


# The fields of `Labels`. Normals are last, as they are written only where they are asked for.
LABELS = _in_turn(
    coordinates=Label(("across", "down"), math.nan, of_sheet=True, dtype=np.float32),
    depth=Label(("depth",), 0.0, of_sheet=False, dtype=np.float32),
    instrument=Label(("instrument",), 0.0, of_sheet=False, dtype=np.uint8),
    normals=Label(("facet_x", "facet_y", "facet_z"), math.nan, of_sheet=False, dtype=np.float32),
)


def label_numbers(*, normals: bool) -> int:
    """Count the numbers per pixel that the kernel writes."""
    return LABELS["normals"].first + normals * len(LABELS["normals"].planes)


def label_channels(plane: Any) -> list[tuple[int, int, int, Label]]:
    """List the planes that labels are written from, each with which of how many numbers of which label it is.

    A label whose planes are missing stays 0.
    """
    return [
        (getattr(plane, name), n, len(label.planes), label)
        for label in LABELS.values()
        for n, name in enumerate(label.planes)
        if hasattr(plane, name)
    ]


def labels_of(numbers: NDArray[np.float32], size: tuple[int, int]) -> Labels:
    """Split the numbers that the kernel wrote of a picture of this width and height [px]."""
    (width, height), arrays = size, {}
    for name, label in LABELS.items():
        count = len(label.planes)
        values = numbers.reshape(-1, width * height)[label.first : label.first + count]
        if len(values):
            arrays[name] = values.reshape((height, width, count)[: 2 + (count > 1)]).astype(label.dtype, copy=False)
    # At the sheet's edge they may be outside by rounding.
    arrays["coordinates"] = arrays["coordinates"].clip(0, 1)
    return Labels(**arrays)


class Flow(NamedTuple):
    """How the material that one frame shows moves in the picture from this frame to another.

    Attributes:
        flow: to the right and down [px], shape (height, width, 2); NO_FLOW where no sheet is seen, and where the
            material goes behind the eye.
        occlusion: 255 where the sheet is seen in the first frame, but in the other something is in front of it or it
            is outside the picture; else 0; shape (height, width).
    """

    flow: NDArray[np.float32]
    occlusion: NDArray[np.uint8]


class Stereo(NamedTuple):
    """What a pair of cameras that are beside each other see differently.

    Attributes:
        disparity: how far to the left what a pixel shows is in the other picture [px], shape (height, width); 0 where
            nothing is seen.
    """

    disparity: NDArray[np.float32]


class Sight(NamedTuple):
    """Where material points are seen.

    Attributes:
        pixels: x to the right and y down from the picture's upper left corner [px], shape (n, 2); NaN behind the eye.
        hidden: whether something is in front of a point, or it is outside the picture, shape (n,).
    """

    pixels: NDArray[np.float32]
    hidden: NDArray[np.bool_]


class FrameOutputs(NamedTuple):
    """The outputs of one frame; None for those that were not asked for."""

    picture: NDArray[np.uint8] | None = None  # colours, shape (height, width, 3)
    labels: Labels | None = None
    flow: Flow | None = None  # from the frame before to this one
    stereo: Stereo | None = None
    tracks: Sight | None = None  # where the tracked points are


def track_grid(count: int) -> NDArray[np.float32]:
    """Give the coordinates of the centres of count^2 equal fields of the sheet, row by row, shape (count^2, 2)."""
    middle = (np.arange(count) + 0.5) / count
    down, across = np.meshgrid(middle, middle, indexing="ij")
    return np.stack([across, down], axis=-1).reshape(-1, 2).astype(np.float32)
