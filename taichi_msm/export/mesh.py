"""What programs for surfaces need of a run: its picture, normals, and the names of its frames."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.reference.shading import normals
from taichi_msm.render.texture import load_texture
from taichi_msm.results.finished_run import FinishedRun

# The mass points themselves, cut as the picture cuts them: what is drawn between them is bilinear, so that more
# vertices would tell no more of the motion.
REFINE = 0

PICTURE = "picture.png"


def picture_png(run: FinishedRun) -> bytes | None:
    """Encode the picture on the sheet, cut to the scene's region; None where the scene names none.

    Raises:
        SceneError: when it is gone, or cannot be used any more.
    """
    if run.scene.image is None:
        return None
    file = io.BytesIO()
    Image.fromarray(load_texture(run.scene)).save(file, "PNG")
    return file.getvalue()


def unit_normals(position: NDArray[np.floating]) -> NDArray[np.float64]:
    """Give unit normals of the points, as pictures are lit; along z where a fold leaves none.

    Args:
        position: positions [m], shape (rows, cols, 3).

    Returns:
        Normals, toward the viewer at rest, shape (rows cols, 3).
    """
    found = normals(position.astype(np.float64)).reshape(-1, 3)
    found[~found.any(axis=-1)] = 0, 0, 1
    return found
