"""Kernel 2: bilinear subdivision, projection, rasterisation of textured triangles, shading.

The kernel computes the visible surface of each sample, the sheet or an instrument in front of it (coverage.py), and
writes the colours of pixels, their labels, or both (shading.py). On a CPU, bands of samples are divided among the
workers (cpu.py); on a GPU, every sample is a thread (gpu.py). As in kernel 1, vectors remain vectors down to the
machine code (docs/decisions/0010): hence the unusual casts, floors and absolute values of vectors.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.cameras.view import View
from taichi_msm.model.surface import Solid
from taichi_msm.render import uniforms as uni
from taichi_msm.render.camera import view_at
from taichi_msm.render.config import DrawingConfig
from taichi_msm.render.cpu import Bands
from taichi_msm.render.gpu import Threads
from taichi_msm.render.labels import FrameOutputs, labels_of
from taichi_msm.render.shading import pyramid
from taichi_msm.render.undistortion import undistortion_map
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import lanes


def drawing_config(
    scene: Scene, *, picture: bool = True, labels: Collection[str] = (), lens: str | None = None
) -> DrawingConfig:
    """Return the compile-time configuration of kernel 2 for a scene, by default for its main camera's lens model.

    Labels together with a picture need one sample per pixel.
    """
    render = scene.render
    tissue = picture and render.shading == "tissue"
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
        labels=frozenset(labels),
        lens=view_at(scene, 0.0).lens_model if lens is None else lens,
        lanes=lanes("f32"),
    )


class Rasterizer:
    """Rasteriser of the pictures and labels of a scene with a texture, shape (height, width, 3).

    Call `runtime.start` first. The configuration is by default that of the scene's pictures.
    """

    def __init__(self, scene: Scene, texture: NDArray[np.uint8], config: DrawingConfig | None = None) -> None:
        self.scene = scene
        self.config = config or drawing_config(scene)
        self._view = view_at(scene, 0.0)
        self._optics: tuple[object, ...] = ()
        self._texture_size = texture.shape[1], texture.shape[0]
        texels, levels = pyramid(texture, minified=self.config.tissue)
        self._sizes = uni.sizes_of(scene, levels)
        backend = Threads if self.config.lanes == 1 else Bands
        self._backend: Bands | Threads = backend(self.config, scene.sheet.points, scene.render.size, texels)

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
        config, view = self.config, view or self._view
        if config.lens and view.optics != self._optics:
            self._optics = view.optics
            table = undistortion_map(view, config.supersample, with_steps=config.map_has_steps)
            self._backend.set_undistortion_map(table)
        self._sizes[uni.INSTRUMENT_COUNT] = len(instruments)
        uniforms = uni.view_uniforms(view, self.scene, instruments, config.supersample, self._texture_size)
        picture, labels = self._backend.draw(
            np.ascontiguousarray(position, np.float32), uniforms.astype(np.float32), self._sizes
        )
        return FrameOutputs(
            np.ascontiguousarray(picture) if config.picture else None,
            labels_of(labels, self.scene.render.size, config.labels) if config.labels else None,
        )
