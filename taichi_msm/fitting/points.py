"""Observed points: their positions, or their pixels in the scene's main camera, over time.

A point on the drawn surface is a weighted mean of four mass points, moves in a straight line between frames, and is
projected by the camera. The first two maps are linear, with their transposes as adjoints; the derivative of the
projection is a central difference.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from taichi_msm.fitting import conventions, rejection
from taichi_msm.fitting.observation import (
    MAX_RESIDUAL_SHARE,
    MAX_RESIDUAL_SIGMAS,
    Array,
    ErrorCorrelation,
    Observation,
    ObservationModel,
    time_weights,
)
from taichi_msm.model.surface import surface_weights
from taichi_msm.render.camera import view_at
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene

# Largest ratio of the observed extent to that at rest, or its inverse, with correct units.
MAX_EXTENT_RATIO = 30.0

# Smallest root mean square of the motion of a point that is significant [sigma].
MIN_MOTION_SIGMAS = 1.5

# Motion below this share of the coordinates is rounding.
ROUNDING_SHARE = 1e-9

# Largest offset of the first observed points from rest, with the correct camera and origin: in pixels, or as a share
# of the sheet.
MAX_OFFSET_PX, MAX_OFFSET_SHARE = 3.0, 0.02

# Smallest correlation of residuals for a warning.
MIN_ERROR_CORRELATION = 0.3


class PointModel(ObservationModel):
    """Map from the mass points of a scene to observed points, and its adjoint.

    Args:
        scene: the scene, with its camera.
        observed: the observed points and times.
        frames: number of frames, from the first one.
    """

    def __init__(self, scene: Scene, observed: PointObservation, frames: int) -> None:
        from scipy.sparse import csr_matrix

        self.scene, self._observed = scene, observed
        corners, weights = surface_weights(observed.coordinates, scene.sheet, scene.render.refine)
        number, (rows, cols) = np.arange(len(corners)), scene.sheet.points
        self._surface = csr_matrix((weights.ravel(), (number.repeat(4), corners.ravel())), (len(corners), rows * cols))
        self._time_weights = time_weights(scene, observed.time, frames)

    def record(self, simulation: Simulation) -> Array:
        """Return the observed points in the current frame [m], shape (N, 3)."""
        return self.points_on_sheet(simulation.positions())

    def predict(self, recorded: Array) -> Array:
        """Return the observations of points, shape (frames, N, 3), as `observe` does."""
        return self.observe(self.interpolate(recorded))

    def motion(self, recorded: Array) -> Array:
        """Return the largest displacement of points, shape (frames, N, 3), at each frame [m], shape (frames,)."""
        moved = recorded - self._observed.rest_positions(self.scene)
        return np.asarray(np.linalg.norm(moved, axis=2).max(axis=1))

    def points_on_sheet(self, position: Array) -> Array:
        """Interpolate the positions of a frame, shape (rows, cols, 3), at the observed points [m], shape (N, 3)."""
        return np.asarray(self._surface @ position.reshape(-1, 3))

    def interpolate(self, at_frames: Array) -> Array:
        """Interpolate points, shape (frames, N, 3), at the observed times, shape (N, T, 3)."""
        at_times = self._time_weights @ at_frames.reshape(len(at_frames), -1)
        return np.asarray(at_times.reshape(-1, *at_frames.shape[1:]).swapaxes(0, 1))

    def points(self, position: Array) -> Array:
        """Interpolate positions [m], shape (frames, rows, cols, 3), in space and time; returns shape (N, T, 3)."""
        return self.interpolate(np.array([self.points_on_sheet(frame) for frame in position]))

    def observe(self, points: Array) -> Array:
        """Convert points [m], shape (N, T, 3), to observations, shape (N, T, 3 or 2); NaN behind the camera."""
        return self._observed.observe(self.scene, points)

    def backward(self, points: Array, gradient: Array) -> Array:
        """Return the gradient of a loss by the positions of every frame.

        Args:
            points: observed points [m], shape (N, T, 3).
            gradient: by the observations, shape (N, T, 3 or 2).

        Returns:
            Gradient by the positions, shape (frames, rows, cols, 3).
        """
        gradient = self._observed.backward(self.scene, points, gradient)
        at_frames = self._time_weights.T @ gradient.swapaxes(0, 1).reshape(gradient.shape[1], -1)
        shape = *self.scene.sheet.points, 3
        return np.array([(self._surface.T @ frame.reshape(-1, 3)).reshape(shape) for frame in at_frames])


@dataclass(frozen=True, eq=False)
class PointObservation(Observation):
    """Points over time; values of shape (N, T, 3 or 2), times of shape (T,).

    Attributes:
        kind: name of the array of values.
        correlation_remedy: option that gives the correlation of the errors of neighbouring points.
    """

    noun: ClassVar[str] = "coordinates"
    kind: ClassVar[str]
    correlation_remedy: ClassVar[str]

    sigma: float | None
    coordinates: Array  # across and down as fractions of the sheet, shape (N, 2)

    @property
    def is_observed(self) -> NDArray[np.bool_]:
        """Mask of the observed points over time, shape (N, T)."""
        return self.known[..., 0]

    @property
    def subject(self) -> str:
        """Name of the values, in messages."""
        return f"{self.name}: {self.kind}"

    def build_model(self, scene: Scene, frames: int) -> PointModel:
        """Build the map from a run of a scene; `frames`: their number, from the first one."""
        return PointModel(scene, self, frames)

    @abstractmethod
    def observe(self, scene: Scene, points: Array) -> Array:
        """Convert points [m], shape (N, T, 3), to values; NaN where they are not seen."""

    @abstractmethod
    def backward(self, scene: Scene, points: Array, gradient: Array) -> Array:
        """Convert the gradient of a loss by the values to that by points [m], shape (N, T, 3)."""

    @abstractmethod
    def tolerance(self, scene: Scene) -> float:
        """Return the largest offset from rest with the correct camera and origin."""

    @abstractmethod
    def mirror_remedies(self, scene: Scene) -> tuple[str, str]:
        """Return the remedies of a mirrored x and y."""

    @abstractmethod
    def place_remedy(self, scene: Scene) -> tuple[str, str]:
        """Return where the points are expected at rest, and the remedy where they are not."""

    def rest_positions(self, scene: Scene) -> Array:
        """Return the rest positions of the points [m], shape (N, 3)."""
        height, width = scene.sheet.size
        across, down = self.coordinates.T
        return np.stack([(across - 0.5) * width, (0.5 - down) * height, np.zeros_like(across)], axis=1)

    def at_rest(self, scene: Scene) -> Array:
        """Return the values of a sheet at rest."""
        return self.observe(scene, np.repeat(self.rest_positions(scene)[:, None], len(self.time), axis=1))

    def signal(self, scene: Scene) -> float:
        """Return the largest root mean square of the motion of a point."""
        motion = self._motion(scene)
        return float(np.sqrt(np.nanmean(motion**2, axis=(1, 2)).max())) if len(motion) else math.inf

    def fits_well(self, residuals: Array, deviation: float, signal: float) -> bool:
        """Return whether the deviation is small, in sigma or as a share of the motion; see `Observation.fits_well`."""
        return deviation <= (MAX_RESIDUAL_SHARE * signal if self.sigma is None else MAX_RESIDUAL_SIGMAS * self.sigma)

    def summary(self, residuals: Array, sigma: float | Array) -> dict[str, Any]:
        """Return residual, sigma and unit."""
        return {"residual": float(np.sqrt(np.mean(residuals**2))), "sigma": sigma, "unit": self.unit}

    def faults(self, scene: Scene) -> Iterator[str]:
        """Yield sentinel values of lost points."""
        rest = self.at_rest(scene)
        is_sentinel = (self.values == self.values[..., :1]).all(axis=2)
        is_sentinel &= ~(np.linalg.norm(rest - self.values[..., :1], axis=-1) < self.tolerance(scene))
        for sentinel, count in zip(*np.unique(self.values[is_sentinel][:, 0], return_counts=True), strict=True):
            if sentinel in (0, -1) or count > 1:
                fault = f"{sentinel:g} in all numbers of {count} points and times"
                yield f"{self.subject}: {fault}; are they lost points? take NaN for them"
                return

    def is_still(self, scene: Scene) -> bool:
        """Return whether the observed motion is within its errors."""
        if self.sigma is None:
            return self.signal(scene) <= ROUNDING_SHARE * float(np.nanmax(np.abs(self.values)))
        chi_square = float(np.nansum((self._motion(scene) / self.sigma) ** 2))
        freedom = self.known.sum() - self.known.any(axis=1).sum()
        # Five standard deviations of chi-square above its mean.
        is_significant = chi_square > freedom + 5.0 * math.sqrt(2 * freedom) > 0
        return not (is_significant or self.signal(scene) > MIN_MOTION_SIGMAS * self.sigma)

    def faults_at_start(self, scene: Scene, predicted: Array, *, same_camera: bool) -> Iterator[str]:
        """Yield invisible points, mirrored axes, and a wrong camera or origin."""
        if invisible := int((self.known & ~np.isfinite(predicted)).any(axis=(1, 2)).sum()):
            fault = "are behind the eye of the scene's camera, or beyond its lens, where the search begins"
            remedy = "give the scene the camera that saw them, or NaN in their place"
            yield f"{self.subject}: {invisible} of the observed points {fault}; {remedy}"
        elif same_camera:
            yield from self._faults_at_rest(scene, predicted)

    def opposed(self, scene: Scene, *predictions: Array) -> Iterator[str]:
        """Yield components of the motion that all predictions have with the other sign."""
        rest = self.at_rest(scene)
        moved = [prediction - rest for prediction in predictions]
        for axis in conventions.opposed_axes(self.values - rest, moved, self.sigma):
            fault = f"{'xyz'[axis]} changes against the scene's; is its sign, or that of a tool's force or path, wrong?"
            yield f"{self.subject}: {fault} change the sign of either"

    def pattern(self, residuals: Array, signal: float, correlation: ErrorCorrelation) -> str | None:
        """Return the reason to reject a model by correlated residuals, or None; see `Observation.pattern`."""
        return rejection.by_pattern(
            residuals, self.time, self.coordinates, signal, correlation, self.correlation_remedy or "give --sigma"
        )

    def correlated(self, rows: Array, correlation: ErrorCorrelation) -> tuple[Array, float]:
        """Return R^T K R, and tr(K^2); see `Observation.correlated`."""
        # Distances are those of mean observed positions; tracks without observations are left out.
        is_tracked: NDArray[np.bool_] = np.any(self.is_observed, axis=1)
        space, time = self._correlations(is_tracked, correlation)
        by_track = np.zeros((*self.values.shape, rows.shape[1]))
        by_track[self.known] = rows
        by_track = by_track[is_tracked]
        correlated = np.einsum("st,ntcp->nscp", time, np.tensordot(space, by_track, 1))
        is_observed = self.is_observed[is_tracked].astype(float)
        square = self.values.shape[2] * float(np.sum(space**2 * (is_observed @ time**2 @ is_observed.T)))
        return np.tensordot(by_track, correlated, ((0, 1, 2), (0, 1, 2))), square

    def residual_notes(self, predicted: Array, signal: float, correlation: ErrorCorrelation) -> Iterator[str]:
        """Yield warnings about residuals next to 0, and correlated residuals."""
        residuals = predicted - self.values
        if np.sqrt(np.nanmean(residuals**2)) < max(1e-6 * signal, 0.1 * (self.sigma or 0.0)):
            if self.sigma is None:
                yield "the residual is next to 0, and so are the intervals; give the standard deviation by --sigma"
            return
        in_space, in_time = _residual_correlations(residuals, self.coordinates)
        if in_space > MIN_ERROR_CORRELATION and correlation.correlation is None:
            remedy = f"; {self.correlation_remedy}" if self.correlation_remedy else ""
            fault = f"the residuals of neighbouring points are correlated (by {in_space:.2f})"
            yield f"{fault}, so that the intervals are too narrow{remedy}"
        elif in_time > MIN_ERROR_CORRELATION and correlation.drift is None:
            fault = f"the residuals of a point are correlated in time (by {in_time:.2f})"
            yield f"{fault}, so that the intervals are too narrow; give --drift SECONDS"

    def _motion(self, scene: Scene) -> Array:
        """Return observed minus mean positions, or minus rest positions if every point was observed once."""
        known = self.is_observed.any(axis=1)
        values, is_repeated = self.values[known], self.is_observed.sum(axis=1).max() > 1
        motion = values - (np.nanmean(values, axis=1, keepdims=True) if is_repeated else self.at_rest(scene)[known])
        # Rest positions may be behind the camera.
        return motion[np.isfinite(motion).any(axis=(1, 2))]

    def _faults_at_rest(self, scene: Scene, predicted: Array) -> Iterator[str]:
        """Yield the faults of the points at rest: mirrored axes, a wrong camera or origin."""
        if axes := conventions.mirrored_axes(self.values, self.at_rest(scene), self.known):
            remedies = self.mirror_remedies(scene)
            remedy = " and ".join(remedies[axis] for axis in axes)
            names = " and ".join("xy"[axis] for axis in axes)
            yield f"{self.subject}: {names} of the points at rest has the other sign in the scene; take {remedy}"
            return
        yield from self._misplaced(scene, predicted)
        yield from self._common_offset(scene, predicted)

    def _common_offset(self, scene: Scene, predicted: Array) -> Iterator[str]:
        """Yield an offset of all points at rest."""
        yield from ()

    def _misplaced(self, scene: Scene, predicted: Array) -> Iterator[str]:
        """Compare the first observed points with their rest positions: the camera or origin may differ."""
        rest, start = self.at_rest(scene), int(np.argmax(self.is_observed.any(axis=0)))
        offsets = np.linalg.norm((self.values - rest)[:, start], axis=1)[self.is_observed[:, start]]
        offset = float(np.median(np.where(np.isfinite(offsets), offsets, math.inf)))
        motion = float(np.nanmax(np.linalg.norm(predicted - rest, axis=2)))
        if offset > max(self.tolerance(scene), 5 * (self.sigma or 0.0), 3.0 * max(motion, self.signal(scene))):
            expected, remedy = self.place_remedy(scene)
            fault = f"half of the points are {offset:.3g} {self.unit} or more from where {expected}"
            yield f"{self.subject}: {fault}; {remedy}"

    def _correlations(self, is_tracked: NDArray[np.bool_], correlation: ErrorCorrelation) -> tuple[Array, Array]:
        """Return the correlations of the errors of tracks, shape (tracks, tracks), and of times, shape (T, T)."""
        from scipy.spatial.distance import cdist

        space, time = np.eye(int(is_tracked.sum())), np.eye(len(self.time))
        if correlation.correlation is not None:
            pixels = np.nanmean(self.values[is_tracked], axis=1)
            space = np.exp(-cdist(pixels, pixels) / correlation.correlation)
        if correlation.drift is not None:
            time = np.exp(-np.abs(self.time[:, None] - self.time) / correlation.drift)
        return space, time


@dataclass(frozen=True, eq=False)
class Positions(PointObservation):
    """Positions of points [m], from the middle of the sheet at rest."""

    kind: ClassVar[str] = "position"
    unit: ClassVar[str] = "m"
    correlation_remedy: ClassVar[str] = ""

    def observe(self, scene: Scene, points: Array) -> Array:
        """Return the points."""
        return points

    def backward(self, scene: Scene, points: Array, gradient: Array) -> Array:
        """Return the gradient."""
        return gradient

    def tolerance(self, scene: Scene) -> float:
        """Return a share of the sheet [m]."""
        return MAX_OFFSET_SHARE * max(scene.sheet.size)

    def mirror_remedies(self, scene: Scene) -> tuple[str, str]:
        """Return the remedies of a mirrored x and y."""
        return "-x, right of the middle above 0", "-y, above the middle above 0"

    def place_remedy(self, scene: Scene) -> tuple[str, str]:
        """Return where the points are expected at rest, and the remedy where they are not."""
        return "they are at rest in the scene", "count from the sheet's middle, x right, y up, z toward the viewer"

    def faults(self, scene: Scene) -> Iterator[str]:
        """Compare the extent of the observed points with that at rest; yield sentinel values of lost points."""
        is_observed = self.is_observed
        rest = self.rest_positions(scene)[is_observed.any(axis=1)]
        if len(rest) > 1:
            centres = np.nanmedian(self.values[is_observed.any(axis=1)], axis=1)[:, :2]
            extent, rest_extent = (
                float(np.linalg.norm(points - points.mean(axis=0), axis=1).max()) for points in (centres, rest[:, :2])
            )
            if rest_extent > 0 and extent > 0 and not 1 / MAX_EXTENT_RATIO < extent / rest_extent < MAX_EXTENT_RATIO:
                fault = f"the points are {extent:.3g} m from their middle, and {rest_extent:.3g} m at rest; give metres"
                unit = {3: ": are they in mm? divide them by 1000", 2: ": are they in cm? divide them by 100"}
                yield f"{self.subject}: {fault}{unit.get(round(math.log10(extent / rest_extent)), '')}"
        yield from super().faults(scene)


@dataclass(frozen=True, eq=False)
class Pixels(PointObservation):
    """Pixels of points [px], from the upper left corner of the picture."""

    kind: ClassVar[str] = "pixel"
    unit: ClassVar[str] = "px"
    correlation_remedy: ClassVar[str] = "give --correlation PX"

    def observe(self, scene: Scene, points: Array) -> Array:
        """Project points by the scene's main camera; NaN behind the eye, or beyond the lens."""
        return np.stack(
            [view_at(scene, each).pixels(points[:, n]) for n, each in enumerate(self.time.tolist())], axis=1
        )

    def backward(self, scene: Scene, points: Array, gradient: Array) -> Array:
        """Convert the gradient by central differences of the projection; see `PointObservation.backward`."""
        steps = 1e-6 * max(scene.sheet.size) * np.eye(3)
        changes = (
            (self.observe(scene, points + step) - self.observe(scene, points - step)) / (2 * step.sum())
            for step in steps
        )
        return np.stack([(gradient * change).sum(axis=-1) for change in changes], axis=-1)

    def tolerance(self, scene: Scene) -> float:
        """Return a number of pixels."""
        return MAX_OFFSET_PX

    def mirror_remedies(self, scene: Scene) -> tuple[str, str]:
        """Return the remedies of a mirrored x and y."""
        width, height = scene.render.size
        return f"{width} - x, counted from the left", f"{height} - y, counted from above"

    def place_remedy(self, scene: Scene) -> tuple[str, str]:
        """Return where the points are expected at rest, and the remedy where they are not."""
        width, height = scene.render.size
        return (
            f"the scene's camera sees them at rest in its {width} x {height} px",
            "give the scene that camera and size, and count from the picture's upper left corner, right and down",
        )

    def faults(self, scene: Scene) -> Iterator[str]:
        """Yield sentinel values of lost points, or fractions of the frame instead of pixels."""
        found = list(super().faults(scene))
        yield from found
        largest, rest = np.nanmax(np.abs(self.values)), self.at_rest(scene)
        if not found and largest <= 1.5 < MAX_OFFSET_PX < np.nan_to_num(np.abs(rest)).max():
            width, height = scene.render.size
            fault = "are they fractions of the frame? multiply them by its width and height"
            yield f"{self.subject}: up to {largest:.3g}; {fault}, {width} and {height} in the scene"

    def _common_offset(self, scene: Scene, predicted: Array) -> Iterator[str]:
        """Yield a common offset by half a pixel."""
        yield from conventions.half_pixel(
            self.subject, self.values, self.at_rest(scene), predicted, self.is_observed, self.sigma
        )


def _residual_correlations(residuals: Array, coordinates: Array) -> tuple[float, float]:
    """Return the correlations of residuals, shape (N, T, numbers), of nearest neighbours and of successive times."""
    from scipy.spatial import KDTree

    def correlation(first: Array, second: Array) -> float:
        product, square = first * second, first**2 + second**2
        is_known = np.isfinite(product)
        return 2 * float(product[is_known].sum()) / max(float(square[is_known].sum()), 1e-300)

    # The nearest point is the point itself, the second its neighbour.
    in_space = (
        correlation(residuals, residuals[KDTree(coordinates).query(coordinates, 2)[1][:, 1]])
        if len(residuals) > 1
        else 0.0
    )
    return in_space, correlation(residuals[:, 1:], residuals[:, :-1])
