"""Kernel 2: bilinear refinement, projection, rasterisation of textured triangles, shading.

It finds what each sample of the picture shows: the sheet (coverage.py) or an instrument in front of it
(instrument_coverage.py). From that it writes the colours of pixels, their labels, or both (shading.py). Samples are
shared among the workers of a CPU in bands (rasterizer_cpu.py), and are threads of a GPU (rasterizer_gpu.py). As in
kernel 1, vectors stay vectors down to the machine code (docs/decisions/0010), and casts, floor and abs of vectors are
written to allow this.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.render import uniforms as uni
from taichi_msm.render.camera import View, view
from taichi_msm.render.instrument import Rod
from taichi_msm.render.labels import Labels, labels_of
from taichi_msm.render.pyramid import pyramid
from taichi_msm.render.rasterizer_cpu import Bands
from taichi_msm.render.rasterizer_gpu import Threads
from taichi_msm.render.samples import DrawingConfig
from taichi_msm.render.uniforms import sizes_of, view_numbers
from taichi_msm.scene import Scene
from taichi_msm.system.runtime import lanes


class Drawn(NamedTuple):
    """What was drawn of one frame."""

    picture: NDArray[np.uint8] | None  # colours, shape (height, width, 3); None where only labels are drawn
    labels: Labels | None  # what each pixel shows; None where only the picture is drawn


def drawing_config(scene: Scene, *, picture: bool = True, labels: bool = False) -> DrawingConfig:
    """Decide what the kernel must be compiled for to draw a scene.

    Args:
        scene: the scene.
        picture: whether colours are wanted.
        labels: whether labels are wanted; for both together, the scene must have one sample per pixel.
    """
    render = scene.render
    return DrawingConfig(
        refined=render.refine > 0,
        supersample=render.supersample if picture else 1,
        shading=render.shading,
        relief=render.shading == "tissue" and picture and render.light.relief != 0,
        vignette=render.shading == "tissue" and picture and render.light.vignette != 0,
        wireframe=render.wireframe and picture,
        instruments=scene.has_instruments,
        picture=picture,
        labels=labels,
        lanes=lanes("f32"),
    )


class Drawing:
    """Draws one scene's sheet; call `runtime.start` first.

    Args:
        scene: a checked scene.
        texture: the picture on the sheet, shape (height, width, 3).
        config: what the kernel is compiled for; None: what the scene's picture needs.
    """

    def __init__(self, scene: Scene, texture: NDArray[np.uint8], config: DrawingConfig | None = None) -> None:
        self.scene = scene
        self.config = config or drawing_config(scene)
        self._view = view(scene)
        self._known: tuple[View, NDArray[np.float32]] | None = None
        self._texture_size = texture.shape[1], texture.shape[0]
        texels, levels = pyramid(texture, minified=self.config.tissue)
        self._sizes = sizes_of(scene, levels)
        form = Threads if self.config.lanes == 1 else Bands
        self._form: Bands | Threads = form(self.config, scene.sheet.points, scene.render.size, texels)

    def draw(self, position: NDArray[Any], camera: View | None = None, rods: Sequence[Rod] = ()) -> NDArray[np.uint8]:
        """Draw the sheet, where the config has a picture.

        Args:
            position: positions of the mass points [m], shape (rows, cols, 3).
            camera: another view than the scene's.
            rods: the instruments.

        Returns:
            Colours, shape (height, width, 3).
        """
        picture = self.look(position, camera, rods).picture
        assert picture is not None
        return picture

    def look(self, position: NDArray[Any], camera: View | None = None, rods: Sequence[Rod] = ()) -> Drawn:
        """Draw the picture, the labels or both, as the config says; arguments as for `draw`."""
        self._sizes[uni.ROD_COUNT] = len(rods)
        numbers = self._numbers(camera or self._view, rods)
        picture, labels = self._form.draw(np.ascontiguousarray(position, np.float32), numbers, self._sizes)
        return Drawn(
            np.ascontiguousarray(picture) if self.config.picture else None,
            labels_of(labels, self.scene.render.size) if self.config.labels else None,
        )

    def _numbers(self, camera: View, rods: Sequence[Rod]) -> NDArray[np.float32]:
        """Give the numbers of a view; without instruments they are computed again only when the camera changes."""
        if rods or self._known is None or self._known[0] is not camera:
            render, size = self.scene.render, self.scene.sheet.size
            numbers = view_numbers(camera, render, self.config.supersample, size, self._texture_size, rods)
            if rods:
                return numbers.astype(np.float32)
            self._known = camera, numbers.astype(np.float32)
        return self._known[1]
