"""Key frames, which represent a motion: between two of them every point moves in a straight line at constant speed."""

from __future__ import annotations

import heapq
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.progress import Count


class KeyFrames(NamedTuple):
    """Key frames of a motion."""

    frames: list[int]  # their numbers, in order; the first and the last frame are among them
    error: float  # the largest distance between a point in any frame and where the key frames beside it place it [m]


def key_frames(position: NDArray[np.floating], most: int, progress: Count = lambda done, total: None) -> KeyFrames:
    """Choose the key frames of a motion: all frames, unless they are too many.

    If they are, the first and the last frame are key frames to begin with. Then the frame that the key frames represent
    worst becomes a key frame too, up to `most`, 2 or more. So key frames are close together where the motion is sudden.
    Positions [m] are at equal distances in time, shape (frames, rows, cols, 3).

    Source: Douglas and Peucker 1973, for all points together and with a given number instead of a tolerance.
    """
    count = len(position)
    if count <= most:
        return KeyFrames(list(range(count)), 0.0)
    chosen = [0, count - 1]
    spans = [_farthest(position, 0, count - 1)]
    while len(chosen) < most and -spans[0].error > 0:
        progress(len(chosen), most)
        span = heapq.heappop(spans)
        chosen.append(span.frame)
        heapq.heappush(spans, _farthest(position, span.first, span.frame))
        heapq.heappush(spans, _farthest(position, span.frame, span.last))
    return KeyFrames(sorted(chosen), -spans[0].error)


class _Span(NamedTuple):
    """The frames from one key frame to the next; the span with the largest error sorts first."""

    error: float  # minus the largest distance between a point in any frame and where the key frames place it [m]
    frame: int  # the frame with this error
    first: int  # the key frames
    last: int


def _farthest(position: NDArray[np.floating], first: int, last: int) -> _Span:
    """Find the frame between two key frames that is farthest from the straight line between them."""
    start, end = position[first].astype(np.float64), position[last].astype(np.float64)
    worst = _Span(0.0, first, first, last)
    for frame in range(first + 1, last):
        share = (frame - first) / (last - first)
        apart = position[frame] - (start + share * (end - start))
        worst = min(worst, _Span(-float(np.linalg.norm(apart, axis=-1).max()), frame, first, last))
    return worst
