"""Pictures and labels of a scene's sheet, from any camera: what a simulation and a live session draw with."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import ArgumentError, as_array, did_you_mean, is_real_array
from taichi_msm.model.surface import Rod
from taichi_msm.render.camera import View, moves, view, view_at
from taichi_msm.render.labels import Flow, Labels, Observed, Sight, Stereo, track_grid
from taichi_msm.render.texture import load_texture
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.render import PRESETS, Render
from taichi_msm.scene.scene import Scene

if TYPE_CHECKING:
    from taichi_msm.render.rasterizer import Drawing

# A camera in one of the forms that a scene may have, or the name of one of its own; or a `View`, which was set up
# already; None: the scene's main one.
CameraLike = str | Mapping[str, Any] | Camera | View | None

Array = NDArray[Any]


class Shot(NamedTuple):
    """What is in front of which camera at one time."""

    positions: Array  # of the mass points [m], shape (rows, cols, 3)
    view: View
    rods: Sequence[Rod] = ()


class Renderer:
    """Draws and labels the sheet of a scene; call `runtime.start` first. Results are those of `Simulation`'s methods.

    Raises:
        ArgumentError: in the methods, when coordinates or labels are not what they must be.

    Attributes:
        scene: the scene; may be replaced by one that differs in its probes alone.
        view: the scene's main camera, when it begins.
    """

    def __init__(self, scene: Scene, texture: NDArray[np.uint8] | None = None) -> None:
        self._given = texture
        self._loaded: tuple[object, NDArray[np.uint8]] | None = None
        self._drawings: dict[tuple[object, ...], Drawing] = {}
        self.restart(scene)

    def restart(self, scene: Scene) -> None:
        """Draw another scene from here on."""
        self._drawings.clear()
        self.scene, self.view = scene, view(scene)
        names = scene.render.all_cameras
        self._moving = any(moves(scene, name) for name in names)
        self._views = {name: self.view if name == scene.render.main else view_at(scene, 0.0, name) for name in names}

    def set_up(self, camera: CameraLike, time: float = 0.0) -> View:
        """Set up a camera at a time [s]; raises a SceneError if it is not valid, or sees nothing."""
        if isinstance(camera, View):
            return camera
        render = self.scene.render
        name = render.main if camera is None else camera
        if isinstance(name, str) and name in self._views:
            return view_at(self.scene, time, name) if self._moving else self._views[name]
        if isinstance(name, str) and render.cameras and name not in PRESETS:
            known = [*render.cameras, *PRESETS]
            said = f"camera: {name!r}; the cameras are {', '.join(known)}{did_you_mean(name, known)}"
            raise ArgumentError(said)
        # The scene is checked as a whole, so that an error names the key as a scene has it.
        alone = {**dict(render), "camera": camera}
        alone.pop("cameras")
        return view(self.scene.model_copy(update={"render": alone, "output": ()}), time)

    def draw(self, shot: Shot, style: Render | None = None) -> NDArray[np.uint8]:
        """Draw a picture; `style`: the scene's `render` with another shading, or with the mesh shown or hidden."""
        return self._drawing(style, picture=True, labels=False, camera=shot.view).draw(*shot)

    def is_compiled(self, style: Render, camera: View) -> bool:
        """Tell whether a picture in a style, as for `draw`, has been drawn before from such a camera."""
        return self._key(style, picture=True, labels=False, camera=camera) in self._drawings

    def kernels(self) -> tuple[object, ...]:
        """Give all that the kernels of `observe` are compiled for."""
        from taichi_msm.render.rasterizer import drawing_config

        scene, lenses = self.scene, [view.model for view in self._views.values()]
        wanted = partial(drawing_config, scene, picture=scene.draws, labels=scene.labels_pixels)
        return (*(wanted(lens=lens) for lens in lenses), scene.output)

    def labels(self, shot: Shot) -> Labels:
        """Give what each pixel shows at its centre."""
        return self._labels(shot, normals=True)

    def flow(self, before: Labels, shot: Shot) -> Flow:
        """Give the optical flow to a shot from another one, whose labels are given."""
        width, height = self.scene.render.size
        points = as_array(before.coordinates, "before") if isinstance(before, Labels) else np.empty(0)
        on_sheet = points.dtype.kind == "f" and not ((points < 0) | (points > 1)).any()
        if points.shape != (height, width, 2) or not on_sheet:
            raise ArgumentError(f"before: take what `labels` gave for a picture of {width} x {height} pixels")
        from taichi_msm.render.tracking import find_flow

        return find_flow(self.scene, points, *shot)

    def locate(self, coordinates: Array, shot: Shot) -> Sight:
        """Find where material points are seen, and whether anything hides them."""
        points = as_array(coordinates, "coordinates")
        if not (is_real_array(points, (*points.shape[:1], 2)) and ((points >= 0) & (points <= 1)).all()):
            raise ArgumentError(
                f"coordinates: {points.dtype} of shape {points.shape}; take numbers from 0 to 1 of shape (n, 2)"
            )
        from taichi_msm.render.tracking import find

        return find(self.scene, points, *shot)

    def observe(self, before: Labels | None, shot: Shot) -> Observed:
        """Give everything that the scene's output asks for; `before`: the labels of the frame before, if any."""
        scene = self.scene
        # Labels need one sample, at the pixel's centre; with several samples per pixel, none is there.
        together = scene.render.supersample == 1
        normals = "normals" in scene.output
        observed = Observed()
        if scene.draws:
            labels = scene.labels_pixels and together
            observed = self._drawing(picture=True, labels=labels, normals=normals, camera=shot.view).look(*shot)
        if scene.labels_pixels and observed.labels is None:
            observed = observed._replace(labels=self._labels(shot, normals=normals))
        if observed.labels is not None and scene.asks_for("stereo") and shot.view.baseline:
            observed = observed._replace(stereo=Stereo(shot.view.disparity(observed.labels.depth)))
        if before is not None and scene.asks_for("flow"):
            observed = observed._replace(flow=self.flow(before, shot))
        if scene.asks_for("tracks"):
            observed = observed._replace(tracks=self.locate(track_grid(scene.render.tracks), shot))
        return observed

    def close(self) -> None:
        """Free the memory."""
        self._drawings.clear()

    def _labels(self, shot: Shot, *, normals: bool) -> Labels:
        labels = self._drawing(picture=False, labels=True, normals=normals, camera=shot.view).look(*shot).labels
        assert labels is not None
        return labels

    def _drawing(
        self, style: Render | None = None, *, picture: bool, labels: bool, camera: View, normals: bool = False
    ) -> Drawing:
        key = self._key(style or self.scene.render, picture=picture, labels=labels, camera=camera, normals=normals)
        if key not in self._drawings:
            from taichi_msm.render.rasterizer import Drawing, drawing_config

            scene = self.scene if style is None else self.scene.model_copy(update={"render": style})
            texture = self._texture() if picture else np.zeros((1, 1, 3), np.uint8)
            config = drawing_config(scene, picture=picture, labels=labels, normals=normals, lens=camera.model)
            self._drawings[key] = Drawing(scene, texture, config)
        return self._drawings[key]

    def _key(
        self, style: Render, *, picture: bool, labels: bool, camera: View, normals: bool = False
    ) -> tuple[object, ...]:
        """Give all that tells the drawings of this scene apart."""
        wanted = picture, labels, labels and normals
        return *wanted, camera.optics, style.shading, style.wireframe, self.scene.has_instruments

    def _texture(self) -> NDArray[np.uint8]:
        """Give the picture on the sheet, which is read again only if the scene names another one."""
        if self._given is not None:
            return self._given
        source = self.scene.image, self.scene.region, self.scene.render.background
        if self._loaded is None or self._loaded[0] != source:
            self._loaded = source, load_texture(self.scene)
        return self._loaded[1]
