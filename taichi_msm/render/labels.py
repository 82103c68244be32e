"""Labels, which tell what each pixel shows: the types of their values, without Taichi."""

from __future__ import annotations

import math
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
    """

    coordinates: NDArray[np.float32]
    depth: NDArray[np.float32]
    instrument: NDArray[np.uint8]


class Label(NamedTuple):
    """How kernel 2 writes a label: a number or several for every pixel, row by row.

    Attributes:
        planes: where a tile of samples has the numbers (samples.py).
        nothing: the number where nothing is seen.
        of_sheet: whether it tells of the sheet alone; then it is `nothing` too where an instrument is seen.
        dtype: of its values.
    """

    planes: tuple[str, ...]
    nothing: float
    of_sheet: bool
    dtype: type[np.generic]


# The fields of `Labels`. The kernel writes one after the other.
LABELS = {
    "coordinates": Label(("across", "down"), math.nan, of_sheet=True, dtype=np.float32),
    "depth": Label(("depth",), 0.0, of_sheet=False, dtype=np.float32),
    "instrument": Label(("instrument",), 0.0, of_sheet=False, dtype=np.uint8),
}
LABEL_NUMBERS = sum(len(label.planes) for label in LABELS.values())


class Channel(NamedTuple):
    """One number of a label; that of a pixel is entry first * pixels + stride * pixel + offset."""

    plane: int
    nothing: float
    of_sheet: bool
    first: int
    stride: int
    offset: int


def label_channels(plane: Any) -> list[Channel]:
    """List what is written of a tile that has these planes; a label whose plane it lacks stays 0."""
    channels, first = [], 0
    for label in LABELS.values():
        channels += [
            Channel(getattr(plane, name), label.nothing, label.of_sheet, first, len(label.planes), offset)
            for offset, name in enumerate(label.planes)
            if hasattr(plane, name)
        ]
        first += len(label.planes)
    return channels


def labels_of(numbers: NDArray[np.float32], size: tuple[int, int]) -> Labels:
    """Split what the kernel wrote into labels.

    Args:
        numbers: of all labels of all pixels.
        size: width and height of the picture [px].
    """
    (width, height), first, values = size, 0, []
    for label in LABELS.values():
        count = len(label.planes)
        value = numbers[first * width * height : (first + count) * width * height]
        shape = (height, width, count) if count > 1 else (height, width)
        values.append(value.reshape(shape).astype(label.dtype, copy=False))
        first += count
    return Labels(*values)


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


class Sight(NamedTuple):
    """Where material points are seen.

    Attributes:
        pixels: x to the right and y down from the picture's upper left corner [px], shape (n, 2); NaN behind the eye.
        hidden: whether something is in front of a point, or it is outside the picture, shape (n,).
    """

    pixels: NDArray[np.float32]
    hidden: NDArray[np.bool_]


class Observed(NamedTuple):
    """The outputs of one frame; None for those that were not asked for.

    Attributes:
        picture: colours, shape (height, width, 3).
        labels: what each pixel shows.
        flow: from the frame before to this one.
        tracks: where the tracked points are.
    """

    picture: NDArray[np.uint8] | None = None
    labels: Labels | None = None
    flow: Flow | None = None
    tracks: Sight | None = None


def track_grid(count: int) -> NDArray[np.float32]:
    """Give the coordinates of the centres of count^2 equal fields of the sheet, row by row, shape (count^2, 2)."""
    middle = (np.arange(count) + 0.5) / count
    down, across = np.meshgrid(middle, middle, indexing="ij")
    return np.stack([across, down], axis=-1).reshape(-1, 2).astype(np.float32)
