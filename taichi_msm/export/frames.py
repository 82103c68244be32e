"""Read the frames of a run, and other pictures of the same size."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import FilesError
from taichi_msm.picture import PictureError, read_rgb
from taichi_msm.results.finished_run import FinishedRun, damaged
from taichi_msm.results.publication import FRAMES, series_file

BLACK = (0, 0, 0)


def frame_path(run: FinishedRun, number: int) -> Path:
    """Find the picture of a frame; raises FilesError if it is not among the results."""
    return run.result(f"{FRAMES}/{series_file(FRAMES, number)}", "png")


def read_picture(path: Path, size: tuple[int, int]) -> NDArray[np.uint8]:
    """Read a picture of the results.

    Args:
        path: of the picture.
        size: width, height that it must have [px].

    Returns:
        Colours, shape (height, width, 3).

    Raises:
        FilesError: when it cannot be read, or has another size.
    """
    try:
        image = read_rgb(str(path), BLACK)
    except PictureError as error:
        raise FilesError(f"{error}, or run the scene again") from None
    if image.size != size:
        raise damaged(path)
    return np.asarray(image)
