"""Observed points: their positions, or their pixels in the scene's main camera, over time.

A prediction interpolates the drawn surface between four mass points, then linearly between frames; pixels are projected
by the camera. The adjoint of an interpolation is its transpose, that of the projection consists of central differences.
"""

from __future__ import annotations

import math
from abc import abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.arithmetic import Array
from taichi_msm.errors import SceneError
from taichi_msm.fitting import observation, rejection
from taichi_msm.fitting.observation import ErrorCorrelation, Observation, ObservationModel
from taichi_msm.fitting.panels import Panel, plot_match, plot_motion, plot_on_sheet
from taichi_msm.model.rest import rest_of
from taichi_msm.model.surface import surface_weights
from taichi_msm.render.camera import view_at
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene

# Largest factor between the observed extent and that at rest, in either direction, for metres.
MAX_EXTENT_RATIO = 30.0

# Smallest significant root mean square of the motion of a point [sigma].
MIN_MOTION_SIGMAS = 1.5

# Largest rounding error, as a share of the coordinates.
ROUNDING_SHARE = 1e-9

# Largest offset of the first observations from rest: of pixels [px]; of positions [share of the sheet].
MAX_OFFSET_PX, MAX_OFFSET_SHARE = 3.0, 0.02

# Smallest correlation of residuals that is reported.
MIN_ERROR_CORRELATION = 0.3


class PointModel(ObservationModel):
    """Map from the mass points of a scene to observed points, and its adjoint."""

    def __init__(self, scene: Scene, observed: PointObservation, frames: int) -> None:
        from scipy.sparse import csr_matrix

        self.scene, self._observed = scene, observed
        corners, weights = surface_weights(observed.coordinates, scene.sheet, scene.render.refine)
        number, (rows, cols) = np.arange(len(corners)), scene.sheet.points
        self._surface = csr_matrix((weights.ravel(), (number.repeat(4), corners.ravel())), (len(corners), rows * cols))
        self._time_weights = observation.time_weights(scene, observed.time, frames)

    def record(self, simulation: Simulation) -> Array:
        """Return the observed points in the current frame [m], shape (N, 3)."""
        return self.on_sheet(simulation.positions()[None])[0]

    def predict(self, recorded: Array) -> Array:
        """Return the values, shape (N, T, 3 or 2); `recorded`: points at all frames [m], shape (frames, N, 3)."""
        return self._observed.observe(self.scene, self.interpolate(recorded))

    def motion(self, recorded: Array) -> Array:
        """Return the largest displacement at every frame [m], shape (frames,); `recorded`: as for `predict`."""
        moved = recorded - self._observed.rest_positions(self.scene)
        return np.asarray(np.linalg.norm(moved, axis=2).max(axis=1))

    def on_sheet(self, position: Array) -> Array:
        """Return the points on the sheet [m], shape (frames, N, 3); `position`: shape (frames, rows, cols, 3)."""
        return np.array([self._surface @ frame.reshape(-1, 3) for frame in position])

    def interpolate(self, at_frames: Array) -> Array:
        """Return the points at the observed times [m], shape (N, T, 3), from `on_sheet`."""
        at_times = self._time_weights @ at_frames.reshape(len(at_frames), -1)
        return np.asarray(at_times.reshape(-1, *at_frames.shape[1:]).swapaxes(0, 1))

    def points(self, position: Array) -> Array:
        """Return the observed points [m], shape (N, T, 3); `position`: shape (frames, rows, cols, 3)."""
        return self.interpolate(self.on_sheet(position))

    def backward(self, points: Array, gradient: Array) -> Array:
        """Return the gradient of a loss by the positions of all frames, shape (frames, rows, cols, 3).

        Predicted points [m] have shape (N, T, 3), the gradient by the values (N, T, 3 or 2).
        """
        gradient = self._observed.backward(self.scene, points, gradient)
        at_frames = self._time_weights.T @ gradient.swapaxes(0, 1).reshape(gradient.shape[1], -1)
        shape = *self.scene.sheet.points, 3
        return np.array([(self._surface.T @ frame.reshape(-1, 3)).reshape(shape) for frame in at_frames])


class Conventions(NamedTuple):
    """Expected place of points at rest, and remedies for another camera or origin."""

    tolerance: float  # largest offset of correct points at rest [m] or [px]
    place: str  # clause on the expected place of points at rest
    remedy: str  # for a wrong camera or origin
    mirror_remedies: tuple[str, str]  # for mirrored x, and for mirrored y


@dataclass(frozen=True, eq=False)
class PointObservation(Observation):
    """Tracks of N points at T times; values of shape (N, T, 3 or 2), times of shape (T,)."""

    noun: ClassVar[str] = "coordinates"
    kind: ClassVar[str]  # name of the array of values in a file
    correlation_remedy: ClassVar[str]  # remedy for correlated errors of neighbouring points, or an empty string

    sigma: float | None
    coordinates: Array  # across and down as fractions of the sheet, shape (N, 2)
    off_sheet: int = 0  # number of points that `on_sheet` left out
    is_mesh: bool = False  # whether `coordinates` are (u, v) of a mesh, which `on_sheet` converts

    @property
    def is_observed(self) -> NDArray[np.bool_]:
        """Mask of the observed points and times, shape (N, T)."""
        return self.known[..., 0]

    @property
    def subject(self) -> str:
        """Subject of messages: file and array."""
        return f"{self.name}: {self.kind}"

    def on_sheet(self, scene: Scene) -> Self:
        """Return the observation without points that fall on no sheet; raise a SceneError if none remains."""
        rest = rest_of(scene.sheet)
        if self.is_mesh:
            return replace(self, coordinates=rest.sheet_places(self.coordinates), is_mesh=False).on_sheet(scene)
        if (covered := rest.covers(self.coordinates)).all():
            return self
        if not self.is_observed[covered].any():
            fault = "all observed points fall on no sheet"
            raise SceneError([f"{self.name}: coordinates: {fault}; compare them with the white pixels of sheet.mask"])
        values, coordinates = self.values[covered], self.coordinates[covered]
        return replace(self, values=values, coordinates=coordinates, off_sheet=int((~covered).sum()))

    def build_model(self, scene: Scene, frames: int) -> PointModel:
        return PointModel(scene, self, frames)

    @abstractmethod
    def observe(self, scene: Scene, points: Array) -> Array:
        """Return the values of points [m], shape (N, T, 3), as (N, T, 3 or 2), NaN where a point has no pixel."""

    @abstractmethod
    def backward(self, scene: Scene, points: Array, gradient: Array) -> Array:
        """Return the gradient of a loss by points [m], both (N, T, 3), from that by values, shape (N, T, 3 or 2)."""

    @abstractmethod
    def conventions(self, scene: Scene) -> Conventions:
        """Return the conventions of camera or origin."""

    def rest_positions(self, scene: Scene) -> Array:
        """Return the rest positions of the points [m], shape (N, 3)."""
        rest = rest_of(scene.sheet)
        return rest.place(rest.coordinates(self.coordinates))

    def at_rest(self, scene: Scene) -> Array:
        """Return the values of the sheet at rest, shape (N, T, 3 or 2)."""
        return self.observe(scene, np.repeat(self.rest_positions(scene)[:, None], len(self.time), axis=1))

    def signal(self, scene: Scene) -> float:
        """Return the largest root mean square of the motion of a point."""
        motion = self._motion(scene)
        return float(np.sqrt(np.nanmean(motion**2, axis=(1, 2)).max())) if len(motion) else math.inf

    def panels(self, scene: Scene, fitted: Array) -> list[Panel]:
        panels: list[Panel] = []
        # A single time shows no motion, a single point no map of residuals.
        if np.sum(self.is_observed.any(axis=0)) > 1:
            centre = np.nanmean(fitted, axis=1, keepdims=True)
            x, y = ((values - centre)[self.known] for values in (fitted, self.values))
            panels.append(partial(plot_motion, time=self.time, fitted=fitted, observed=self.values, unit=self.unit))
            panels.append(partial(plot_match, fitted=x, observed=y, unit=self.unit, origin="the mean"))
        if np.sum(self.is_observed.any(axis=1)) > 1:
            residuals = np.sqrt(np.nanmean((fitted - self.values) ** 2, axis=(1, 2)))
            on_sheet = partial(plot_on_sheet, coordinates=self.coordinates, size=rest_of(scene.sheet).sides)
            panels.append(partial(on_sheet, residuals=residuals, unit=self.unit))
        return panels

    def format_residual(self, residual: float) -> str:
        points, times = self.is_observed.shape
        return f"{residual:.3g} {self.unit} of {points} points at {times} times"

    def faults(self, scene: Scene) -> Iterator[str]:
        """Yield a message about a sentinel value of lost points."""
        rest = self.at_rest(scene)
        is_sentinel = (self.values == self.values[..., :1]).all(axis=2)
        is_sentinel &= ~(np.linalg.norm(rest - self.values[..., :1], axis=-1) < self.conventions(scene).tolerance)
        for sentinel, count in zip(*np.unique(self.values[is_sentinel][:, 0], return_counts=True), strict=True):
            if sentinel in (0, -1) or count > 1:
                fault = f"{sentinel:g} in all numbers of {count} points and times"
                yield f"{self.subject}: {fault}; are they lost points? take NaN for them"
                return

    def is_still(self, scene: Scene) -> bool:
        """Return whether the observed motion is within the errors."""
        if self.sigma is None:
            return self.signal(scene) <= ROUNDING_SHARE * float(np.nanmax(np.abs(self.values)))
        chi_square = float(np.nansum((self._motion(scene) / self.sigma) ** 2))
        freedom = self.known.sum() - self.known.any(axis=1).sum()
        # Five standard deviations of chi-square above its mean.
        is_significant = chi_square > freedom + 5.0 * math.sqrt(2 * freedom) > 0
        return not (is_significant or self.signal(scene) > MIN_MOTION_SIGMAS * self.sigma)

    def faults_at_start(self, scene: Scene, predicted: Array, *, same_camera: bool) -> Iterator[str]:
        if invisible := int((self.known & ~np.isfinite(predicted)).any(axis=(1, 2)).sum()):
            fault = "are behind the scene's camera, or beyond its lens, at the initial values"
            remedy = "give the scene the camera of the recording, or NaN in their place"
            yield f"{self.subject}: {invisible} of the observed points {fault}; {remedy}"
        elif same_camera and (axes := self._mirrored_axes(scene)):
            names = " and ".join("xy"[axis] for axis in axes)
            remedy = " and ".join(self.conventions(scene).mirror_remedies[axis] for axis in axes)
            yield f"{self.subject}: {names} of the points at rest has the opposite sign in the scene; take {remedy}"
        elif same_camera:
            yield from self._offset_faults(scene, predicted)

    def opposed(self, scene: Scene, *predictions: Array) -> Iterator[str]:
        rest = self.at_rest(scene)
        moved = [prediction - rest for prediction in predictions]
        for axis in observation.opposed_axes(self.values - rest, moved, self.sigma):
            fault = f"the motion in {'xyz'[axis]} is opposite to the scene's; is its sign wrong, or that of the tool?"
            yield f"{self.subject}: {fault} change the sign of {'xyz'[axis]}, or of the force or path"

    def pattern(self, scene: Scene, predicted: Array, signal: float, correlation: ErrorCorrelation) -> str | None:
        remedy = self.correlation_remedy or "give --sigma"
        residuals, displacement = predicted - self.values, predicted - self.at_rest(scene)
        return rejection.by_pattern(residuals, displacement, self.time, self.coordinates, signal, correlation, remedy)

    def correlated(self, rows: Array, correlation: ErrorCorrelation) -> tuple[Array, float]:
        from scipy.spatial.distance import cdist

        # Distances are between mean pixels; tracks without observations are left out.
        is_tracked: NDArray[np.bool_] = np.any(self.is_observed, axis=1)
        space, time = np.eye(int(is_tracked.sum())), np.eye(len(self.time))
        if correlation.length is not None:
            pixels = np.nanmean(self.values[is_tracked], axis=1)
            space = np.exp(-cdist(pixels, pixels) / correlation.length)
        if correlation.drift is not None:
            time = np.exp(-np.abs(self.time[:, None] - self.time) / correlation.drift)
        by_track = np.zeros((*self.values.shape, rows.shape[1]))
        by_track[self.known] = rows
        by_track = by_track[is_tracked]
        correlated = np.einsum("st,ntcp->nscp", time, np.tensordot(space, by_track, 1))
        is_observed = self.is_observed[is_tracked].astype(float)
        square = self.values.shape[2] * float(np.sum(space**2 * (is_observed @ time**2 @ is_observed.T)))
        return np.tensordot(by_track, correlated, ((0, 1, 2), (0, 1, 2))), square

    def residual_notes(self, predicted: Array, signal: float, correlation: ErrorCorrelation) -> Iterator[str]:
        if self.off_sheet:
            count = self.off_sheet + len(self.coordinates)
            yield f"{self.off_sheet} of {count} points fall on no sheet, see sheet.mask, and are left out"
        residuals = predicted - self.values
        if np.sqrt(np.nanmean(residuals**2)) < max(1e-6 * signal, 0.1 * (self.sigma or 0.0)):
            if self.sigma is None:
                yield "the residual is almost 0, and so are the intervals; give the standard deviation by --sigma"
            return
        space_correlation, time_correlation = _residual_correlations(residuals, self.coordinates)
        if space_correlation > MIN_ERROR_CORRELATION and correlation.length is None:
            remedy = self.correlation_remedy or "take fewer of them, farther apart"
            fault = f"the residuals of neighbouring points are correlated (by {space_correlation:.2f})"
            yield f"{fault}, so that the intervals are too narrow; {remedy}"
        elif time_correlation > MIN_ERROR_CORRELATION and correlation.drift is None:
            fault = f"the residuals of a point are correlated in time (by {time_correlation:.2f})"
            yield f"{fault}, so that the intervals are too narrow; give --drift SECONDS"

    def _motion(self, scene: Scene) -> Array:
        """Return the values minus their mean over time, or minus rest if every point was observed only once."""
        known = self.is_observed.any(axis=1)
        values, is_repeated = self.values[known], self.is_observed.sum(axis=1).max() > 1
        motion = values - (np.nanmean(values, axis=1, keepdims=True) if is_repeated else self.at_rest(scene)[known])
        # Points behind the camera at rest have no values to subtract.
        return motion[np.isfinite(motion).any(axis=(1, 2))]

    def _mirrored_axes(self, scene: Scene) -> list[int]:
        """Return the axes along which the observed points mirror the points at rest."""
        count = self.is_observed.sum(axis=1)
        expected, observed = (
            np.where(self.known, each, 0.0).sum(axis=1)[count > 0, :2] / count[count > 0, None]
            for each in (self.at_rest(scene), self.values)
        )
        if not (np.isfinite(expected).all() and len(expected) >= observation.MIN_COUNT):
            return []
        return observation.opposed_axes(observed - observed.mean(axis=0), [expected - expected.mean(axis=0)], None)

    def _offset_faults(self, scene: Scene, predicted: Array) -> Iterator[str]:
        """Yield a message if the first observations are displaced from rest, as with another camera or origin."""
        tolerance, place, remedy, _ = self.conventions(scene)
        rest, start = self.at_rest(scene), int(np.argmax(self.is_observed.any(axis=0)))
        offsets = np.linalg.norm((self.values - rest)[:, start], axis=1)[self.is_observed[:, start]]
        offset = float(np.median(np.where(np.isfinite(offsets), offsets, math.inf)))
        motion = float(np.nanmax(np.linalg.norm(predicted - rest, axis=2)))
        if offset > max(tolerance, 5 * (self.sigma or 0.0), 3.0 * max(motion, self.signal(scene))):
            fault = f"half of the points are at least {offset:.3g} {self.unit} from where {place}"
            yield f"{self.subject}: {fault}; {remedy}"


@dataclass(frozen=True, eq=False)
class Positions(PointObservation):
    """Positions of points [m], from the middle of the sheet at rest; values of shape (N, T, 3)."""

    kind: ClassVar[str] = "position"
    unit: ClassVar[str] = "m"
    correlation_remedy: ClassVar[str] = ""

    def observe(self, scene: Scene, points: Array) -> Array:
        return points

    def backward(self, scene: Scene, points: Array, gradient: Array) -> Array:
        return gradient

    def conventions(self, scene: Scene) -> Conventions:
        """Return the conventions of positions."""
        return Conventions(
            MAX_OFFSET_SHARE * rest_of(scene.sheet).extent,
            "they are at rest in the scene",
            "count from the sheet's middle, x right, y up, z toward the viewer",
            ("-x, positive right of the middle", "-y, positive above the middle"),
        )

    def faults(self, scene: Scene) -> Iterator[str]:
        """Yield messages about an extent in other units, and about sentinel values of lost points."""
        is_observed = self.is_observed.any(axis=1)
        rest = self.rest_positions(scene)[is_observed]
        if len(rest) > 1:
            centres = np.nanmedian(self.values[is_observed], axis=1)[:, :2]
            extent, rest_extent = (
                float(np.linalg.norm(points - points.mean(axis=0), axis=1).max()) for points in (centres, rest[:, :2])
            )
            if rest_extent > 0 and extent > 0 and not 1 / MAX_EXTENT_RATIO < extent / rest_extent < MAX_EXTENT_RATIO:
                extents = f"{extent:.3g} m from their middle, but {rest_extent:.3g} m at rest"
                units = {3: ": are they in mm? divide them by 1000", 2: ": are they in cm? divide them by 100"}
                unit = units.get(round(math.log10(extent / rest_extent)), "")
                yield f"{self.subject}: the points extend {extents}; give metres{unit}"
        yield from super().faults(scene)


@dataclass(frozen=True, eq=False)
class Pixels(PointObservation):
    """Pixels of points [px], from the upper left corner of the picture; values of shape (N, T, 2).

    Points behind the camera, or beyond its lens, have no pixel.
    """

    kind: ClassVar[str] = "pixel"
    unit: ClassVar[str] = "px"
    correlation_remedy: ClassVar[str] = "give --correlation PX"

    def observe(self, scene: Scene, points: Array) -> Array:
        pixels = [view_at(scene, time).pixels(points[:, n]) for n, time in enumerate(self.time.tolist())]
        return np.stack(pixels, axis=1)

    def backward(self, scene: Scene, points: Array, gradient: Array) -> Array:
        by_axis = []
        for step in 1e-6 * rest_of(scene.sheet).extent * np.eye(3):
            change = (self.observe(scene, points + step) - self.observe(scene, points - step)) / (2 * step.sum())
            by_axis.append((gradient * change).sum(axis=-1))
        return np.stack(by_axis, axis=-1)

    def conventions(self, scene: Scene) -> Conventions:
        """Return the conventions of pixels."""
        width, height = scene.render.size
        return Conventions(
            MAX_OFFSET_PX,
            f"the scene's camera shows them at rest in its {width} x {height} px",
            "give the scene that camera and size, and count from the picture's upper left corner, right and down",
            (f"{width} - x, counted from the left", f"{height} - y, counted from above"),
        )

    def faults(self, scene: Scene) -> Iterator[str]:
        """Yield messages about sentinel values of lost points, or about fractions of the frame instead of pixels."""
        sentinels = list(super().faults(scene))
        yield from sentinels
        largest, rest = np.nanmax(np.abs(self.values)), self.at_rest(scene)
        if not sentinels and largest <= 1.5 < MAX_OFFSET_PX < np.nan_to_num(np.abs(rest)).max():
            width, height = scene.render.size
            fault = "are they fractions of the frame? multiply them by its width and height"
            yield f"{self.subject}: up to {largest:.3g}; {fault}, {width} and {height} in the scene"

    def _offset_faults(self, scene: Scene, predicted: Array) -> Iterator[str]:
        """Yield messages about another camera, and about half a pixel of offset at points that are still at rest."""
        yield from super()._offset_faults(scene, predicted)
        rest = self.at_rest(scene)
        is_at_rest = self.is_observed & (np.linalg.norm(predicted - rest, axis=2) < 0.02)
        count = is_at_rest.sum(axis=1)
        offsets = np.where(is_at_rest[..., None], self.values - rest, 0.0).sum(axis=1)[count > 0]
        offsets = offsets / count[count > 0, None]
        if len(offsets) < 5:
            return
        sigma_error = (self.sigma or 0.0) / np.sqrt(count.sum())
        mean, error = offsets.mean(axis=0), np.maximum(offsets.std(axis=0, ddof=1) / np.sqrt(len(offsets)), sigma_error)
        halves = np.where(np.abs(mean) < 0.25, 0.0, 0.5 * np.sign(mean))
        distance = np.abs(np.stack([mean, np.median(offsets, axis=0)]) - halves).max(axis=0)
        # Half a pixel of offset [px]: the means of both axes are precise and within 3 standard errors of 0 or a half,
        # and one of the halves is significant.
        is_half = (distance <= 3.0 * error + 0.02) & (error < 0.1)
        if is_half.all() and ((halves != 0) & (np.abs(mean) > 5.0 * error)).any():
            shown = " and ".join(f"{offset:+.2g} px in {axis}" for offset, axis in zip(mean, "xy", strict=True))
            side, remedy = (0, "add") if halves.min() < 0 else (1, "subtract")
            question = f"is the centre of their first pixel at {side}? {remedy} 0.5, as it is at 0.5 here"
            yield f"{self.subject}: points at rest are off by {shown} on average; {question}"


def _residual_correlations(residuals: Array, coordinates: Array) -> tuple[float, float]:
    """Return the correlations of residuals, shape (N, T, 3 or 2), between neighbours and between successive times."""
    from scipy.spatial import KDTree

    def correlation(first: Array, second: Array) -> float:
        product, square = first * second, first**2 + second**2
        is_known = np.isfinite(product)
        return 2 * float(product[is_known].sum()) / max(float(square[is_known].sum()), 1e-300)

    space_correlation = 0.0
    if len(residuals) > 1:
        # The nearest point is the point itself, the second its neighbour.
        neighbour = KDTree(coordinates).query(coordinates, 2)[1][:, 1]
        space_correlation = correlation(residuals, residuals[neighbour])
    return space_correlation, correlation(residuals[:, 1:], residuals[:, :-1])
