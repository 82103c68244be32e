"""Interface of an observation: measured values, their prediction, plausibility checks and messages."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any, ClassVar, NamedTuple

import numpy as np
from numpy.typing import NDArray
from typing_extensions import Self

from taichi_msm.arithmetic import Array
from taichi_msm.errors import SceneError
from taichi_msm.fitting.panels import Panel, plot_match
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.scene.section import MAX_MAGNITUDE, MIN_MAGNITUDE

# Largest residual of a good fit, as a share of the signal and in sigma.
MAX_RESIDUAL_SHARE, MAX_RESIDUAL_SIGMAS = 0.1, 2.0

# An opposed component has at most this cosine with its prediction, and at least this norm [sigma] and number of values.
MAX_COSINE, MIN_SIGMAS, MIN_COUNT = -0.9, 5.0, 3


class ErrorCorrelation(NamedTuple):
    """Correlation of tracking errors in space and time; None for independent errors."""

    length: float | None  # correlation length of neighbouring tracks [px]
    drift: float | None  # correlation time of a track [s]


class ObservationModel(ABC):
    """Map from a run to the values of an observation."""

    @abstractmethod
    def record(self, simulation: Simulation) -> Array:
        """Return the record of the current frame, an array of a fixed shape."""

    @abstractmethod
    def predict(self, recorded: Array) -> Array:
        """Return the values of the observation; `recorded`: records of all frames, stacked."""

    def motion(self, recorded: Array) -> Array:
        """Return the largest displacement of the observed points at each frame [m], shape (frames,), NaN if unknown."""
        return np.full(len(recorded), np.nan)


@dataclass(frozen=True, eq=False)
class Observation(ABC):
    """Measured values of any shape, with their components along the last axis.

    Attributes:
        noun: name of the values, for messages.
        unit: unit of the values and of sigma.
        is_independent: whether errors are independent, so that chi-square of these values alone may reject a model.
        name: name of the file, for messages.
        time: times of the values [s].
        values: measured values [unit], NaN where not measured.
        sigma: standard deviation of the errors [unit], a number or of shape (known,); None to estimate it.
    """

    noun: ClassVar[str]
    unit: ClassVar[str]
    is_independent: ClassVar[bool] = False

    name: str
    time: Array
    values: Array
    sigma: float | Array | None

    @property
    def known(self) -> NDArray[np.bool_]:
        """Mask of the measured values, with their shape."""
        return np.isfinite(self.values)

    @property
    def freedom(self) -> int:
        """Number of measured values, less that of fitted offsets."""
        return int(self.known.sum())

    @property
    def sigma_freedom(self) -> float:
        """Degrees of freedom of a sigma that is itself an estimate; infinite for an exact one."""
        return math.inf

    def without_offset(self, rows: Array, robust_factor: Callable[[Array], Array] | None = None) -> Array:
        """Return rows [sigma], shape (known, ...), less the offset of their errors that minimises their squares.

        Args:
            rows: residuals, or their derivatives.
            robust_factor: d(r) of a robust cost, see `Misfit`; with it, the offset minimises this cost.
        """
        return rows

    def with_sigma(self, sigma: Any) -> Self:
        """Return the observation with a new sigma, or unchanged for None; raise a SceneError for an invalid sigma."""
        if sigma is None:
            return self
        array = np.asarray(sigma)
        is_number = array.dtype.kind in "fiu" and array.size == 1
        if not (is_number and MIN_MAGNITUDE <= (value := float(array.ravel()[0])) <= MAX_MAGNITUDE):
            shown = f"{value:g}" if is_number else f"{array.dtype} of shape {array.shape}"
            remedy = f"take one number above 0, the standard deviation of the errors [{self.unit}], or leave it out"
            raise SceneError([f"{self.name}: sigma: {shown}; {remedy}"])
        return replace(self, sigma=value)

    def without(self, samples: NDArray[np.bool_]) -> Self:
        """Return a copy without the samples of a mask, which has the shape of the values without their last axis."""
        return replace(self, values=np.where(samples[..., None], np.nan, self.values))

    def on_sheet(self, scene: Scene) -> Self:
        """Return the observation without values of places on no sheet, which a mask leaves; by default unchanged."""
        return self

    @abstractmethod
    def build_model(self, scene: Scene, frames: int) -> ObservationModel:
        """Return the map from a run to the values.

        Args:
            scene: scene of the run, with its mesh and camera.
            frames: number of recorded frames.
        """

    @abstractmethod
    def signal(self, scene: Scene) -> float:
        """Return the root mean square of the observed motion or forces [unit]."""

    def difference_step(self, scene: Scene) -> float:
        """Return the step of finite differences: a relative change of a parameter, or a share of its range.

        Errors e of the values [unit] require about sqrt(e / signal); by default they are those of a run in f64, some
        1e-10 of the signal. Equilibria, solved to about 1e-6, and contacts, which change in jumps, require larger
        steps.
        """
        return 1e-2 if scene.time.at_rest or any(probe.moved for probe in scene.probes) else 1e-5

    def panels(self, scene: Scene, fitted: Array) -> list[Panel]:
        """Return the panels of fit.png, functions that plot on the given axes of Matplotlib.

        Args:
            scene: fitted scene.
            fitted: values predicted by it, with the shape of `values`.
        """
        return [partial(plot_match, fitted=fitted[self.known], observed=self.values[self.known], unit=self.unit)]

    def format_residual(self, residual: float) -> str:
        """Format the root mean square of the residuals [unit], with the number of values."""
        return f"{residual:.3g} {self.unit} of {self.known.sum()} {self.noun}"

    def fits_well(self, residuals: Array, deviation: float, signal: float) -> bool:
        """Return whether the residuals are small.

        Args:
            residuals: predicted minus observed values [unit], shape (known,).
            deviation: standard deviation estimated from the residuals [unit].
            signal: root mean square from `signal` [unit].
        """
        if self.sigma is None:
            return deviation <= MAX_RESIDUAL_SHARE * signal
        return deviation <= MAX_RESIDUAL_SIGMAS * float(np.mean(self.sigma))

    def summary(self, residuals: Array, sigma: float | Array) -> dict[str, Any]:
        """Return residual and sigma as fields of a `FitResult`, by name.

        Args:
            residuals: predicted minus observed known values [unit], shape (known,).
            sigma: standard deviation of the errors [unit], given or estimated.
        """
        return {"residual": root_mean_square(residuals), "sigma": float(np.mean(sigma)), "unit": self.unit}

    def faults(self, scene: Scene) -> Iterator[str]:
        """Yield the faults found without a run, such as wrong units and sentinel values."""
        yield from ()

    def is_still(self, scene: Scene) -> bool:
        """Return whether no significant motion was observed."""
        return False

    def faults_at_start(self, scene: Scene, predicted: Array, *, same_camera: bool) -> Iterator[str]:
        """Yield the faults found with a run of the initial scene: mirrored axes, another camera or origin.

        Args:
            scene: the initial scene.
            predicted: values predicted by the initial scene, with the shape of `values`.
            same_camera: whether the camera is no parameter, so that displaced points are a fault.
        """
        yield from ()

    def opposed(self, scene: Scene, *predictions: Array) -> Iterator[str]:
        """Yield a message for every component with the opposite sign in all predictions.

        Args:
            scene: the initial scene.
            predictions: predicted values, each with the shape of `values`.
        """
        yield from ()

    def unit_faults(self, *predictions: Array) -> Iterator[str]:
        """Yield a message if another unit explains the ratio of observed values to all predictions."""
        yield from ()

    def pattern(self, scene: Scene, predicted: Array, signal: float, correlation: ErrorCorrelation) -> str | None:
        """Return the reason to reject the model for a pattern in the residuals, or None.

        Args:
            scene: scene with the camera.
            predicted: values predicted by the solution, with the shape of `values`.
            signal: root mean square from `signal` [unit].
            correlation: given correlation of the errors.
        """
        return None

    def factor_note(self, predicted: Array) -> str:
        """Return a clause with the ratio of measured to predicted values, or an empty string."""
        return ""

    def correlated(self, rows: Array, correlation: ErrorCorrelation) -> tuple[Array, float]:
        """Return R^T K R, shape (n, n), and tr(K^2), for the correlation matrix K of the errors, by default 1.

        Args:
            rows: R, shape (known, n).
            correlation: correlation of the errors, which defines K.
        """
        return rows.T @ rows, float(len(rows))

    def residual_notes(self, predicted: Array, signal: float, correlation: ErrorCorrelation) -> Iterator[str]:
        """Yield warnings about the residuals.

        Args:
            predicted: values predicted by the solution, with the shape of `values`.
            signal: root mean square from `signal` [unit].
            correlation: given correlation of the errors.
        """
        yield from ()


def root_mean_square(values: Array) -> float:
    """Return the root mean square of values of any shape."""
    return float(np.sqrt(np.mean(values**2)))


def time_in_frames(scene: Scene, time: Array) -> Array:
    """Return times [s], any shape, in frames, rounded to six decimals, so that times of frames become integers."""
    return np.round(time * scene.time.frames_per_second, 6)


def time_weights(scene: Scene, time: Array, frames: int) -> Any:
    """Return the sparse matrix of linear interpolation between frames, shape (T, frames), at times [s], shape (T,)."""
    from scipy.sparse import csr_matrix

    position, row = time_in_frames(scene, time), np.arange(len(time))
    before = np.clip(np.floor(position), 0, frames - 2).astype(int)
    shares, frame = np.stack([1 - position + before, position - before]), np.stack([before, before + 1])
    return csr_matrix((shares.ravel(), (np.tile(row, 2), frame.ravel())), (len(time), frames))


def opposed_axes(observed: Array, predictions: Sequence[Array], sigma: Any) -> list[int]:
    """Return the indices of the components that are significant, and opposite to all predictions.

    Arrays have the shape (..., components), NaN where unknown; `sigma` is None if unknown.
    """
    size = observed.shape[-1]
    is_opposed = np.ones(size, np.bool_)
    for predicted in predictions:
        known = np.isfinite(observed) & np.isfinite(predicted)
        first, second = (np.where(known, array, 0.0).reshape(-1, size) for array in (observed, predicted))
        lengths = np.linalg.norm(first, axis=0), np.linalg.norm(second, axis=0)
        counts = known.reshape(-1, size).sum(axis=0)
        # Without sigma, significance needs more values.
        is_opposed &= counts >= (12 if sigma is None else MIN_COUNT)
        is_opposed &= lengths[0] > MIN_SIGMAS * (sigma or 0.0) * np.sqrt(counts)
        for length in lengths:
            is_opposed &= length > 0.1 * np.linalg.norm(length)
        is_opposed &= (first * second).sum(axis=0) < MAX_COSINE * lengths[0] * lengths[1]
    return np.flatnonzero(is_opposed).tolist()
