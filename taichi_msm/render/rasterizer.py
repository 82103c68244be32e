"""Kernel 2: bilinear refinement, projection, rasterisation of textured triangles, shading.

It finds what each sample of the picture shows: the sheet (coverage.py) or an instrument in front of it
(coverage.py). From that it writes the colours of pixels, their labels, or both (shading.py). Samples are
shared among the workers of a CPU in bands (cpu.py), and are threads of a GPU (gpu.py). As in
kernel 1, vectors stay vectors down to the machine code (docs/decisions/0010), and casts, floor and abs of vectors are
written to allow this.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.model.surface import Rod
from taichi_msm.render import uniforms as uni
from taichi_msm.render.camera import View, view, view_at
from taichi_msm.render.config import DrawingConfig
from taichi_msm.render.cpu import Bands
from taichi_msm.render.gpu import Threads
from taichi_msm.render.labels import FrameOutputs, labels_of
from taichi_msm.render.lens_table import undistortion_map
from taichi_msm.render.shading import pyramid
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import lanes


def drawing_config(
    scene: Scene, *, picture: bool = True, labels: bool = False, normals: bool = False, lens: str | None = None
) -> DrawingConfig:
    """Decide what the kernel must be compiled for; `picture` and `labels` together take one sample per pixel.

    Args:
        scene: the scene.
        picture: whether colours are drawn.
        labels: whether labels are written.
        normals: whether normals are among them.
        lens: the model of the camera's lens, `View.model`; None: of the scene's own camera.
    """
    render = scene.render
    tissue = picture and render.shading == "tissue"
    return DrawingConfig(
        refined=render.refine > 0,
        supersample=render.supersample if picture else 1,
        headlit=picture and render.shading == "headlight",
        tissue=tissue,
        relief=tissue and render.light.relief != 0,
        vignette=tissue and render.light.vignette != 0,
        wireframe=render.wireframe and picture,
        instruments=scene.has_instruments,
        metal=picture and scene.has_instruments,
        picture=picture,
        labels=labels,
        normals=labels and normals,
        lens=view_at(scene, 0.0).model if lens is None else lens,
        lanes=lanes("f32"),
    )


class Rasterizer:
    """Draws one scene's sheet with a texture, shape (height, width, 3); call `runtime.start` first."""

    def __init__(self, scene: Scene, texture: NDArray[np.uint8], config: DrawingConfig | None = None) -> None:
        self.scene = scene
        self.config = config or drawing_config(scene)
        self._view = view(scene)
        self._known: tuple[View, NDArray[np.float32]] | None = None
        self._optics: tuple[object, ...] = ()
        self._texture_size = texture.shape[1], texture.shape[0]
        texels, levels = pyramid(texture, minified=self.config.tissue)
        self._sizes = uni.sizes_of(scene, levels)
        form = Threads if self.config.lanes == 1 else Bands
        self._form: Bands | Threads = form(self.config, scene.sheet.points, scene.render.size, texels)

    def draw(self, position: NDArray[Any], camera: View | None = None, rods: Sequence[Rod] = ()) -> NDArray[np.uint8]:
        """Draw the picture alone, shape (height, width, 3); arguments as for `look`."""
        picture = self.look(position, camera, rods).picture
        assert picture is not None
        return picture

    def look(self, position: NDArray[Any], camera: View | None = None, rods: Sequence[Rod] = ()) -> FrameOutputs:
        """Draw the picture, the labels or both, as the config says, of points [m] at `position`, shape (rows, cols, 3).

        The scene's own camera is taken if none is given.
        """
        self._sizes[uni.CAPSULE_COUNT] = len(rods)
        camera = camera or self._view
        uniforms = self._numbers(camera, rods)
        self._place(camera)
        picture, labels = self._form.draw(np.ascontiguousarray(position, np.float32), uniforms, self._sizes)
        return FrameOutputs(
            np.ascontiguousarray(picture) if self.config.picture else None,
            labels_of(labels, self.scene.render.size) if self.config.labels else None,
        )

    def _place(self, camera: View) -> None:
        """Find the places of the samples, where a lens bends lines, again only if its view of them changes."""
        if not self.config.lens:
            return
        if camera.optics != self._optics:
            self._optics = camera.optics
            self._form.place(undistortion_map(camera, self.config.supersample, steps=self.config.map_has_steps))

    def _numbers(self, camera: View, rods: Sequence[Rod]) -> NDArray[np.float32]:
        """Give the numbers of a view; without instruments they are computed again only when the camera changes."""
        if rods or self._known is None or self._known[0] is not camera:
            render, size = self.scene.render, self.scene.sheet.size
            uniforms = uni.view_numbers(camera, render, self.config.supersample, size, self._texture_size, rods)
            if rods:
                return uniforms.astype(np.float32)
            self._known = camera, uniforms.astype(np.float32)
        return self._known[1]
