"""The texture of the sheet: the scene's picture."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ArgumentError, Problem, SceneError, as_array
from taichi_msm.images import MAX_SIDE_PX, PictureError, file_sha256, has_transparency, picture_size, read_rgb
from taichi_msm.scene.framing import region_fault
from taichi_msm.scene.scene import Scene
from taichi_msm.system.array_cache import cached_arrays


def load_texture(scene: Scene, sha256: str | None = None) -> NDArray[np.uint8]:
    """Read the scene's picture: upright, in 8-bit RGB, cropped to the scene's region, shape (height, width, 3).

    Only the first picture of a file is read. Transparent pixels are composited onto the scene's background. A missing
    or invalid picture, or one with another SHA-256 than `sha256`, raises a SceneError. The array is read-only, and the
    same while the file has the same content.
    """
    if scene.image is None:
        raise SceneError(["image: no picture is named"])
    try:
        digest = file_sha256(scene.image)
        # With another digest than the required one, reading fails, and nothing is cached.
        key = digest, digest if sha256 is None else sha256, scene.render.background, scene.region
        (texture,) = cached_arrays(("texture", *key), lambda: (_read(scene, key[1]),))
    except PictureError as error:
        raise SceneError([f"image: {error}"]) from error
    return texture


def _read(scene: Scene, sha256: str) -> NDArray[np.uint8]:
    assert scene.image is not None
    image = read_rgb(scene.image, scene.render.background, sha256)
    x, y, width, height = region = scene.region or (0, 0, *image.size)
    if outside := [str(problem) for problem in _region_problems(region, image.size)]:
        raise SceneError(outside)
    return np.array(image.crop((x, y, x + width, y + height)))


def require_texture(texture: Any) -> NDArray[np.uint8]:
    """Return an argument as a texture, shape (height, width, 3), or raise an ArgumentError."""
    picture = as_array(texture, "texture")
    is_picture = picture.dtype == np.uint8 and picture.ndim == 3 and picture.shape[2] == 3
    if not (is_picture and min(picture.shape) > 0 and max(picture.shape) <= MAX_SIDE_PX):
        raise ArgumentError(
            f"texture: {picture.dtype} of shape {picture.shape} is not a picture; take uint8 of shape "
            f"(height, width, 3), up to {MAX_SIDE_PX} a side, such as numpy.asarray(image.convert('RGB'))"
        )
    return picture


def image_size(scene: Scene) -> tuple[int, int] | None:
    """Return the picture's width and height [px] without decoding it; None if there is no valid picture."""
    try:
        return None if scene.image is None else picture_size(scene.image)
    except PictureError:
        return None


def is_see_through(scene: Scene) -> bool:
    """Return whether the scene's picture has transparent pixels; False if there is no valid picture."""
    try:
        return scene.image is not None and has_transparency(scene.image)
    except PictureError:
        return False


def image_problems(scene: Scene) -> Iterator[Problem]:
    """Yield the problems of the scene's picture and region; only the header of the file is read."""
    if scene.image is not None:
        yield from picture_problems(scene.image)
    if scene.region is not None:
        yield from _region_problems(scene.region, image_size(scene))


def picture_problems(image: Any) -> Iterator[Problem]:
    """Yield the problem of the path of a picture; that of another type is one of its key."""
    try:
        if isinstance(image, str):
            picture_size(image)
    except PictureError as error:
        yield Problem(("image",), str(error))


def _region_problems(region: tuple[int, int, int, int], size: tuple[int, int] | None) -> Iterator[Problem]:
    if fault := region_fault(region, size):
        yield Problem(("region",), fault)
