"""What all formats for surfaces share: the picture of a run, its normals, and the names of its frames."""

from __future__ import annotations

import io

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from taichi_msm.render.texture import load_texture
from taichi_msm.results.finished_run import FinishedRun

# The vertices are the mass points, and cells are cut as in the picture. The surface between mass points is bilinear, so
# more vertices would add nothing about the motion.
REFINE = 0

PICTURE = "picture.png"


def picture_png(run: FinishedRun) -> bytes | None:
    """Encode the picture on the sheet, cut to the scene's region; None if none is named, a SceneError if unusable."""
    if run.scene.image is None:
        return None
    file = io.BytesIO()
    Image.fromarray(load_texture(run.scene, run.sha256.get("image", ""))).save(file, "PNG")
    return file.getvalue()


def unit_normals(position: NDArray[np.floating]) -> NDArray[np.float64]:
    """Give unit normals of points at `position`, shape (rows, cols, 3), the same as for the light in pictures.

    They come from central differences, at edges from one-sided ones, have shape (rows cols, 3), and are toward the
    viewer at rest, along z where a fold leaves none.
    """
    place = position.astype(np.float64)
    normal = np.cross(np.gradient(place, axis=1), -np.gradient(place, axis=0)).reshape(-1, 3)
    length = np.linalg.norm(normal, axis=-1, keepdims=True)
    return np.divide(normal, length, out=np.tile([0.0, 0.0, 1.0], (len(normal), 1)), where=length > 0)
