"""The picture of all drawing peers: the paper's sheet, pressed and dragged, from the top.

31 x 31 mass points, refined to 331 x 331 vertices, with a texture. The timed work leads from positions of mass points
to a picture in a NumPy array.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from benchmarks.process import CACHE, ROOT
from taichi_msm.model.sheet import rest_positions
from taichi_msm.render.texture import load_texture
from taichi_msm.scene.scene import Scene
from tests import reference

POINTS, SIDE = 31, 0.33

Picture = NDArray[np.uint8]


class Artist(Protocol):
    """A peer that draws a problem; the module of each peer has `prepare(problem, threads)`, which returns one."""

    def draw(self, position: NDArray[np.float32]) -> Picture:
        """Draw the sheet from the positions of its mass points [m], shape (rows, cols, 3)."""


@dataclass(frozen=True)
class Problem:
    """The parameters of a problem."""

    pixels: int  # width and height of the picture
    refine: int  # vertices between two mass points
    lit: bool  # with a headlight

    @cached_property
    def scene(self) -> Scene:
        """The problem as a scene of this program."""
        return Scene.model_validate(
            {
                "image": str(ROOT / "scenes" / "textures" / "mucosa.png"),
                "sheet": {"points": [POINTS, POINTS], "size": [SIDE, SIDE], "mass": 1e-3},
                "springs": {"structural": 20, "shear": 20, "virtual": 0.5},
                "damping": 0.02,
                "probes": [{"force": [1500, 500, -3000], "load": [[0, 0], [0.2, 100]], "falloff": 60}],
                "time": {"duration": 0.4},
                "render": {
                    "size": [self.pixels, self.pixels],
                    "refine": self.refine,
                    "shading": "headlight" if self.lit else "none",
                },
            }
        )

    @property
    def vertices(self) -> int:
        """Vertices along a side."""
        return (POINTS - 1) * (self.refine + 1) + 1

    @cached_property
    def texture(self) -> Picture:
        """The picture on the sheet."""
        return load_texture(self.scene)

    @cached_property
    def position(self) -> NDArray[np.float32]:
        """Positions of the pressed sheet's mass points, computed once [m], shape (rows, cols, 3)."""
        cached = CACHE / "pressed.npy"
        if not cached.exists():
            CACHE.mkdir(parents=True, exist_ok=True)
            np.save(cached, reference.simulate(self.scene)[-1].astype(np.float32))
        return np.load(cached)

    @cached_property
    def rest(self) -> NDArray[np.float32]:
        """Rest positions of the mass points [m], shape (rows, cols, 3)."""
        return rest_positions(self.scene.sheet).astype(np.float32)

    @cached_property
    def refinement(self) -> NDArray[np.float32]:
        """The matrix that inserts vertices along one axis, shape (vertices, mass points)."""
        index = np.arange(self.vertices) / (self.refine + 1)
        return np.maximum(0, 1 - np.abs(index[:, None] - np.arange(POINTS))).astype(np.float32)
