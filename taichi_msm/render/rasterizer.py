"""Kernel 2: bilinear subdivision, projection, rasterisation of textured triangles, shading.

The kernel computes the visible surface of each sample, the sheet or an instrument in front of it (coverage.py), and
writes the colours of pixels, their labels, or both (shading.py). On a CPU, bands of samples are divided among the
workers (cpu.py); on a GPU, every sample is a thread (gpu.py). As in kernel 1, vectors remain vectors down to the
machine code (docs/decisions/0010): hence the unusual casts, floors and absolute values of vectors.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from hashlib import sha256
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.cameras.view import View
from taichi_msm.model.pictured import PicturedRest
from taichi_msm.model.rest import rest_of
from taichi_msm.model.surface import Solid
from taichi_msm.render import uniforms as uni
from taichi_msm.render.camera import picture_view, view_at
from taichi_msm.render.config import DrawingConfig
from taichi_msm.render.cpu import Bands
from taichi_msm.render.gpu import Threads
from taichi_msm.render.labels import FrameOutputs, labels_of
from taichi_msm.render.shading import pyramid
from taichi_msm.render.undistortion import undistortion_map
from taichi_msm.scene.scene import Scene
from taichi_msm.system.array_cache import cached_arrays
from taichi_msm.system.runtime import lanes


def drawing_config(
    scene: Scene, *, picture: bool = True, labels: Collection[str] = (), lens: str | None = None
) -> DrawingConfig:
    """Return the compile-time configuration of kernel 2 for a scene, by default for its main camera's lens model.

    Labels together with a picture need one sample per pixel.
    """
    render = scene.render
    tissue = picture and render.shading == "tissue"
    rest = rest_of(scene.sheet)
    picture_lens = rest.picture.view.lens_model if isinstance(rest, PicturedRest) else None
    mesh = frozenset({"mesh"} if labels and picture_lens is not None else ())
    return DrawingConfig(
        refined=render.refine > 0,
        masked=scene.sheet.mask is not None,
        supersample=render.supersample if picture else 1,
        headlit=picture and render.shading == "headlight",
        tissue=tissue,
        relief=tissue and render.light.relief != 0,
        vignette=tissue and render.light.vignette != 0,
        wireframe=render.wireframe and picture,
        shapes=scene.shapes,
        metal=picture and bool(scene.shapes),
        picture=picture,
        labels=mesh.union(labels),
        lens=view_at(scene, 0.0).lens_model if lens is None else lens,
        lanes=lanes("f32"),
        picture_lens=picture_lens,
    )


class Rasterizer:
    """Rasteriser of the pictures and labels of a scene with a texture, shape (height, width, 3).

    Call `runtime.start` first. The configuration is by default that of the scene's pictures, and so is their size.
    """

    def __init__(
        self,
        scene: Scene,
        texture: NDArray[np.uint8],
        config: DrawingConfig | None = None,
        size: tuple[int, int] | None = None,
    ) -> None:
        self.scene = scene
        self.config = config or drawing_config(scene)
        self._view, self._picture = view_at(scene, 0.0), None
        self._optics: tuple[object, ...] = ()
        self._texture_size = texture.shape[1], texture.shape[0]
        texels, levels = pyramid(texture, minified=self.config.tissue)
        # Positions of the mass points; with a picture by a camera, also the points in its frame.
        self._points = np.empty((*scene.sheet.points, 3), np.float32)
        if self.config.is_pictured:
            self._picture = picture_view(scene, self._texture_size)
            self._points = np.dstack([self._points, self._picture.normalise(rest_of(scene.sheet).position)])
        if self.config.is_relit:
            texels = np.concatenate([texels, _reference_light(scene, texture, self.config).ravel()])
        self._size = size or scene.render.size
        self._sizes = uni.sizes_of(scene, levels, self._size)
        backend = Threads if self.config.lanes == 1 else Bands
        self._backend: Bands | Threads = backend(self.config, scene.sheet.points, self._size, texels)

    def draw(
        self, position: NDArray[Any], view: View | None = None, instruments: Sequence[Solid] = ()
    ) -> NDArray[np.uint8]:
        """Return the picture, shape (height, width, 3), as `render`."""
        picture = self.render(position, view, instruments).picture
        assert picture is not None
        return picture

    def render(
        self, position: NDArray[Any], view: View | None = None, instruments: Sequence[Solid] = ()
    ) -> FrameOutputs:
        """Draw the picture, the labels or both, as configured; `position` is in [m], shape (rows, cols, 3).

        The view is by default the scene's main camera at the start. Raise a DeviceError if the device ends a thread
        early.
        """
        config = self.config
        picture, numbers = self._draw(position, view or self._view, instruments)
        return FrameOutputs(
            np.ascontiguousarray(picture) if config.picture else None,
            labels_of(numbers, self._size, config.labels) if config.labels else None,
        )

    def light(self, position: NDArray[Any], view: View) -> NDArray[np.float32]:
        """Return the factor of the texture's colours, shape (height, width); -1 without a surface."""
        assert self.config.writes_light
        return self._draw(position, view, ())[1].reshape(self._size[::-1])

    def _draw(
        self, position: NDArray[Any], view: View, instruments: Sequence[Solid]
    ) -> tuple[NDArray[np.uint8], NDArray[np.float32]]:
        config = self.config
        if config.lens and view.optics != self._optics:
            self._optics = view.optics
            table = undistortion_map(view, config.supersample, with_steps=config.map_has_steps)
            self._backend.set_undistortion_map(table)
        self._sizes[uni.INSTRUMENT_COUNT] = len(instruments)
        uniforms = uni.view_uniforms(view, self.scene, instruments, config.supersample, self._texture_size)
        points = np.ascontiguousarray(position, np.float32)
        if self._picture is not None:
            uni.set_picture(uniforms, self._picture, view, self.scene)
            self._points[..., :3] = position
            points = self._points
        return self._backend.draw(points, uniforms.astype(np.float32), self._sizes)


def _reference_light(scene: Scene, texture: NDArray[np.uint8], config: DrawingConfig) -> NDArray[np.float32]:
    """Return the light in which the picture on a sheet was taken, shape of the texture (height, width).

    Texels without sheet have that of the nearest ones with it.
    """
    rest, render, size = rest_of(scene.sheet), scene.render, (texture.shape[1], texture.shape[0])
    view = picture_view(scene, size)
    config = config._replace(
        supersample=1, vignette=False, wireframe=False, shapes=(), metal=False, labels=frozenset(),
        lens=view.lens_model, writes_light=True,
    )  # fmt: skip

    def draw() -> tuple[NDArray[np.float32]]:
        light = Rasterizer(scene, texture, config, size).light(rest.position, view)
        is_missing = light < 0
        if is_missing.all():
            return (np.ones_like(light),)
        from scipy.ndimage import distance_transform_edt

        rows, columns = distance_transform_edt(is_missing, return_distances=False, return_indices=True)
        return (light[rows, columns],)

    hashes = [sha256(array.tobytes()).digest() for array in (rest.position, rest.present, texture, view.matrix)]
    key = "light", *hashes, texture.shape, config, render.refine, render.light, view.optics, view.distance
    return cached_arrays(key, draw)[0]
