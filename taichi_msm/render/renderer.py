"""Pictures and labels of a scene from any camera, for simulations and live sessions."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from functools import partial
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from taichi_msm.cameras.view import View
from taichi_msm.errors import ArgumentError, as_array, did_you_mean, is_real_array
from taichi_msm.model.rest import rest_of
from taichi_msm.render.camera import Shot, is_moving, view, view_at
from taichi_msm.render.labels import LABELS, Flow, FrameOutputs, Labels, Sight, Stereo, requested_labels, track_grid
from taichi_msm.render.texture import load_texture
from taichi_msm.scene.camera import Camera
from taichi_msm.scene.render import PRESETS, Render
from taichi_msm.scene.scene import Scene

if TYPE_CHECKING:
    from taichi_msm.render.config import DrawingConfig
    from taichi_msm.render.rasterizer import Rasterizer

# A camera in any form that a scene accepts, the name of one of its cameras, a resolved `View`, or None for the scene's
# main camera.
CameraLike = str | Mapping[str, Any] | Camera | View | None

Array = NDArray[Any]


class Renderer:
    """Renderer of the pictures and labels of a scene; call `runtime.start` first.

    The texture, shape (height, width, 3), is by default the picture that the scene names. `scene` may be replaced by
    one that differs only in its probes; `view` is its main camera at the start.
    """

    def __init__(self, scene: Scene, texture: NDArray[np.uint8] | None = None) -> None:
        self._custom_texture = texture
        self._rasterizers: dict[tuple[object, ...], Rasterizer] = {}
        self.restart(scene)

    def restart(self, scene: Scene) -> None:
        """Replace the scene, and discard its rasterisers."""
        self._rasterizers.clear()
        self._texture = self._custom_texture
        self.scene, self.view = scene, view_at(scene, 0.0)
        names = scene.render.all_cameras
        self._has_moving_camera = any(is_moving(scene, name) for name in names)
        self._views = {name: self.view if name == scene.render.main else view_at(scene, 0.0, name) for name in names}

    def resolve_camera(self, camera: CameraLike, time: float = 0.0) -> View:
        """Return the view of a camera at a time [s]; raise an ArgumentError for an unknown name.

        An invalid camera raises a SceneError.
        """
        if isinstance(camera, View):
            return camera
        render = self.scene.render
        name = render.main if camera is None else camera
        if isinstance(name, str) and name in self._views:
            return view_at(self.scene, time, name) if self._has_moving_camera else self._views[name]
        if isinstance(name, str) and render.cameras and name not in PRESETS:
            names = [*render.cameras, *PRESETS]
            message = f"camera: {name!r}; the cameras are {', '.join(names)}{did_you_mean(name, names)}"
            raise ArgumentError(message)
        # The complete scene is validated, so that errors name the keys of a scene.
        single_camera = {**dict(render), "camera": camera}
        single_camera.pop("cameras")
        # Another camera does not change the surface.
        sheet = self.scene.sheet.with_kept_frame()
        return view(self.scene.model_copy(update={"render": single_camera, "sheet": sheet, "output": ()}), time)

    def draw(self, shot: Shot, style: Render | None = None) -> NDArray[np.uint8]:
        """Draw a picture, shape (height, width, 3); `style` may differ from the scene.

        It differs in `shading`, `wireframe` and, with a view of that size, `size`; one other size is kept.
        """
        return self._rasterizer(style, picture=True, view=shot.view).draw(*shot)

    def is_compiled(self, style: Render, view: View) -> bool:
        """Return whether the kernel of `draw` is compiled already."""
        config = self._config(style, picture=True, view=view)
        return any(rasterizer.config == config for rasterizer in self._rasterizers.values())

    def kernels(self) -> tuple[object, ...]:
        """Return the compile-time settings of all kernels of `observe`, as a cache key."""
        from taichi_msm.render.rasterizer import drawing_config

        scene, lenses = self.scene, [view.lens_model for view in self._views.values()]
        labels = requested_labels(scene.output) if scene.labels_pixels else ()
        config_of = partial(drawing_config, scene, picture=scene.draws, labels=labels)
        return (*(config_of(lens=lens) for lens in lenses), scene.output)

    def labels(self, shot: Shot, names: Collection[str] = tuple(LABELS)) -> Labels:
        """Return the labels of a shot of these names, by default all."""
        labels = self._rasterizer(picture=False, labels=names, view=shot.view).render(*shot).labels
        assert labels is not None
        return labels

    def flow(self, before: Labels, shot: Shot) -> Flow:
        """Compute the optical flow to a shot from the one with the labels `before`.

        Labels that do not fit the scene raise an ArgumentError.
        """
        width, height = self.scene.render.size
        points = as_array(before.coordinates, "before") if isinstance(before, Labels) else np.empty(0)
        on_sheet = points.dtype.kind == "f" and not ((points < 0) | (points > 1)).any()
        if points.shape != (height, width, 2) or not on_sheet:
            raise ArgumentError(f"before: take the result of `labels` for a picture of {width} x {height} pixels")
        from taichi_msm.render.tracking import compute_flow, mesh_of

        return compute_flow(self.scene, mesh_of(self.scene, before), shot)

    def locate(self, coordinates: Array, shot: Shot) -> Sight:
        """Project material points, with coordinates on the sheet, shape (n, 2), and determine their occlusion.

        Coordinates that are not numbers from 0 to 1 raise an ArgumentError.
        """
        points = as_array(coordinates, "coordinates")
        if not (is_real_array(points, (*points.shape[:1], 2)) and ((points >= 0) & (points <= 1)).all()):
            fault = f"{points.dtype} of shape {points.shape}"
            raise ArgumentError(f"coordinates: {fault}; take numbers from 0 to 1 of shape (n, 2)")
        from taichi_msm.render.tracking import locate_points

        return locate_points(self.scene, points, shot)

    def observe(self, before: Labels | None, shot: Shot) -> FrameOutputs:
        """Render all outputs that the scene requests; `before` are the labels of the previous frame, if any."""
        scene = self.scene
        # Labels require a sample at the centre of each pixel; supersampling has none there.
        is_single_sample = scene.render.supersample == 1
        requested = requested_labels(scene.output)
        observed = FrameOutputs()
        if scene.draws:
            labels = requested if scene.labels_pixels and is_single_sample else frozenset[str]()
            observed = self._rasterizer(picture=True, labels=labels, view=shot.view).render(*shot)
        if scene.labels_pixels and observed.labels is None:
            observed = observed._replace(labels=self.labels(shot, requested))
        if observed.labels is not None and scene.asks_for("stereo") and shot.view.companion is not None:
            observed = observed._replace(stereo=self._stereo(observed.labels, shot))
        if before is not None and scene.asks_for("flow"):
            observed = observed._replace(flow=self.flow(before, shot))
        if scene.asks_for("tracks"):
            grid = track_grid(scene.render.tracks, rest_of(scene.sheet))
            observed = observed._replace(tracks=self.locate(grid, shot))
        return observed

    def close(self) -> None:
        """Free the memory."""
        self._rasterizers.clear()

    def _stereo(self, labels: Labels, shot: Shot) -> Stereo:
        """Return the requested labels of a stereo pair."""
        disparity = shot.view.disparity(labels.depth) if "disparity" in self.scene.output else None
        if "stereo" not in self.scene.output:
            return Stereo(disparity)
        from taichi_msm.render.tracking import compute_stereo

        return Stereo(disparity, *compute_stereo(self.scene, labels, shot))

    def _rasterizer(
        self, style: Render | None = None, *, picture: bool, labels: Collection[str] = (), view: View
    ) -> Rasterizer:
        key = self._key(style or self.scene.render, picture=picture, labels=labels, view=view)
        if key not in self._rasterizers:
            from taichi_msm.render.rasterizer import Rasterizer

            texture = np.zeros((1, 1, 3), np.uint8)
            if picture:
                texture = self._texture = load_texture(self.scene) if self._texture is None else self._texture
            config = self._config(style, picture=picture, labels=labels, view=view)
            kept_sizes = key[-1], self.scene.render.size
            self._rasterizers = {each: kept for each, kept in self._rasterizers.items() if each[-1] in kept_sizes}
            self._rasterizers[key] = Rasterizer(self._styled(style), texture, config)
        return self._rasterizers[key]

    def _config(
        self, style: Render | None, *, picture: bool, labels: Collection[str] = (), view: View
    ) -> DrawingConfig:
        from taichi_msm.render.rasterizer import drawing_config

        return drawing_config(self._styled(style), picture=picture, labels=labels, lens=view.lens_model)

    def _styled(self, style: Render | None) -> Scene:
        """Return the scene with other drawing settings, which do not change its surface."""
        sheet = self.scene.sheet.with_kept_frame()
        return self.scene if style is None else self.scene.model_copy(update={"render": style, "sheet": sheet})

    def _key(self, style: Render, *, picture: bool, labels: Collection[str] = (), view: View) -> tuple[object, ...]:
        """Return the cache key of a rasteriser: all settings that differ among the rasterisers of a scene."""
        return picture, frozenset(labels), view.optics, style.shading, style.wireframe, self.scene.shapes, style.size
