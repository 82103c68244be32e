"""What a scene with certain numbers lets one see: where the observed points are at the observed times, and the forces.

Points lie on the surface that is drawn, so each is a weighted mean of the four mass points around it; between frames
they, and the forces, go in straight lines. All runs are in f64 on one compiled kernel.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple, cast

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import DivergedError, SceneError
from taichi_msm.fitting.observations import Observations
from taichi_msm.fitting.parameters import Parameter, as_data, with_values
from taichi_msm.physics.deformed import surface_weights
from taichi_msm.physics.mesh_error import coarser
from taichi_msm.physics.plan import Plan
from taichi_msm.progress import Pause
from taichi_msm.render.camera import view
from taichi_msm.scene import Scene, Sheet
from taichi_msm.scenefile.validation import checked
from taichi_msm.simulation import Simulation

Array = NDArray[np.float64]

# By how much a parameter is changed for a difference.
SMOOTH, ROUGH = 1e-5, 1e-2


class Predicted(NamedTuple):
    """What would be seen."""

    values: Array  # as in the observations, shape (N, T, 3 or 2); NaN: not seen by the camera
    forces: Array  # shape (rows, 3)
    steps: int  # of a frame
    motion: Array  # the farthest that any of the points is from rest, at every frame that was simulated [m]


@dataclass(frozen=True, eq=False)
class Job:
    """What is predicted; each process that is given it keeps its own kernel."""

    token: str  # tells jobs apart
    scene: Scene  # of which only the parameters change
    parameters: tuple[Parameter, ...]
    observations: Observations

    def values(self, x: Array) -> Array:
        """Give the values of the parameters at x."""
        return np.array([one.value(each) for one, each in zip(self.parameters, x.tolist(), strict=True)])


def runnable(scene: Scene) -> Scene:
    """Give the scene that is run for a fit: in f64, and without anything that is drawn or written."""
    time = scene.time.model_copy(update={"precision": "f64"})
    return scene.model_copy(update={"image": None, "region": None, "output": (), "time": time})


class Predictor:
    """A simulation that is restarted for every prediction.

    Attributes:
        job: what it predicts.
    """

    def __init__(self, job: Job, threads: int | None) -> None:
        self.job, self._data = job, as_data(job.scene)
        plan = checked(job.scene)
        self._maps, self._threads = plan.maps, threads
        self._simulation: Simulation | None = None
        # Times in frames, without the rounding of their product.
        rate, seen = plan.grid.frames_per_second, job.observations
        self._place = np.round(seen.time * rate, 6)
        self._force_place = np.round((seen.forces.time if seen.forces else np.empty(0)) * rate, 6)
        self._last = math.ceil(max(1.0, *self._place, *self._force_place))

    def predict(
        self,
        x: Array,
        steps: int | None = None,
        *,
        coarse: bool = False,
        whole: bool = False,
        pause: Pause = lambda: None,
    ) -> Predicted:
        """Run the scene with the parameters at x.

        Args:
            x: of every parameter.
            steps: of a frame, as of a run that this one is compared with, if it needs no more; None: so many that
                runs with neighbouring values can have them too.
            coarse: take half the cells a side; a scene for which `mesh_error.coarser` gives None is run as it is.
            whole: go on to the last frame, even if nothing was seen there.
            pause: called some times a second; what it raises stops it.

        Raises:
            SceneError: when the values make no valid scene.
            DivergedError: when the run diverges.
        """
        plan = self.plan(x)
        if coarse:
            plan = coarser(plan) or plan
        if plan.scene.time.step == "auto" and not plan.scene.time.at_rest:
            plan = plan.with_grid(steps_per_frame=max(steps or _with_margin(plan), plan.grid.steps_per_frame))
        if self._simulation is None:
            self._simulation = Simulation(plan, threads=self._threads)
        else:
            self._simulation.restart(plan)
        return self._run(self._simulation, plan, whole, pause)

    def compile(self, x: Array, pause: Pause = lambda: None) -> None:
        """Compile now what the first run would compile; raises a SceneError as `predict` does."""
        self._simulation = Simulation(self.plan(x), threads=self._threads)
        self._simulation.compile(pause)

    def attempt(
        self, x: Array, steps: int | None = None, *, coarse: bool = False, pause: Pause = lambda: None
    ) -> Predicted | None:
        """Predict; None where the values give no run, or a point that was seen would be behind the eye."""
        try:
            predicted = self.predict(x, steps, coarse=coarse, pause=pause)
        except (SceneError, DivergedError):
            return None
        return predicted if np.isfinite(predicted.values[self.job.observations.known]).all() else None

    def plan(self, x: Array) -> Plan:
        """Plan the scene with the parameters at x; SceneError: it is not valid."""
        values = self.job.values(x)
        if not np.isfinite(values).all():
            raise SceneError(["the values are out of range"])
        data = with_values(self._data, self.job.parameters, values.tolist())
        return checked(Scene(**data), self._maps)

    def _run(self, simulation: Simulation, plan: Plan, whole: bool, pause: Pause) -> Predicted:
        seen, scene = self.job.observations, plan.scene
        # A coarse run has other points than the others.
        corners, weights = surface_weights(seen.coordinates, scene.sheet, scene.render.refine)
        points, forces = [], []
        for frame in range((plan.grid.frames if whole else self._last) + 1):
            simulation.advance(min(frame, 1), pause)
            position = simulation.positions().reshape(-1, 3)
            points.append(np.einsum("nk,nkc->nc", weights, position[corners]))
            if seen.forces is not None:
                forces.append([one.force for one in simulation.forces()])
        rest = places_at_rest(seen.coordinates, scene.sheet)
        motion = np.linalg.norm(np.array(points) - rest, axis=2).max(axis=1)
        values = between(np.array(points), self._place).swapaxes(0, 1)
        if seen.kind == "pixel":
            values = seen_by_camera(scene, values, seen.time)
        felt = np.empty((0, 3))
        if seen.forces is not None:
            felt = between(np.array(forces), self._force_place)[np.arange(len(self._force_place)), seen.forces.probe]
        return Predicted(values, felt, plan.grid.steps_per_frame, motion)

    def close(self) -> None:
        """Free the memory."""
        if self._simulation is not None:
            self._simulation.close()


def difference(scene: Scene) -> float:
    """Give by how much a parameter is changed for a difference, in units of x.

    At rest the shape is known to about 1e-6, and with contact it changes in small jumps.
    """
    return ROUGH if scene.time.at_rest or any(probe.moved for probe in scene.probes) else SMOOTH


def _with_margin(plan: Plan) -> int:
    """Count the steps of a frame for this scene and for those with slightly other values."""
    frame = 1 / plan.grid.frames_per_second
    return math.ceil(2 * frame / plan.stable_step * (1 + difference(plan.scene)))


def between(frames: Array, place: Array) -> Array:
    """Interpolate what is given for each frame, shape (frames, ...), linearly at places between them."""
    from scipy.interpolate import make_interp_spline

    return cast("Array", make_interp_spline(np.arange(len(frames)), frames, k=1)(place))


def places_at_rest(coordinates: Array, sheet: Sheet) -> Array:
    """Give where points are at rest [m], shape (N, 3)."""
    height, width = sheet.size
    across, down = coordinates.T
    return np.stack([(across - 0.5) * width, (0.5 - down) * height, np.zeros_like(across)], axis=1)


def seen_by_camera(scene: Scene, points: Array, time: Array) -> Array:
    """Find where the scene's main camera sees points [m], shape (N, T, 3), at T times [s].

    Returns pixels from the picture's upper left corner, shape (N, T, 2); NaN: behind the eye, or beyond the lens.
    """
    seen = [view(scene, each).pixels(points[:, n]) for n, each in enumerate(time.tolist())]
    return np.stack(seen, axis=1)


def seen_at_rest(scene: Scene, seen: Observations) -> Array:
    """Give what would be seen if the sheet stayed at rest, shape (N, T, 3 or 2)."""
    rest = np.repeat(places_at_rest(seen.coordinates, scene.sheet)[:, None], len(seen.time), axis=1)
    return rest if seen.kind == "position" else seen_by_camera(scene, rest, seen.time)


# The predictor of the job that this process was given last.
_kept: dict[str, Predictor] = {}


def predict(job: Job, x: Array, steps: int | None) -> Predicted | None:
    """Predict in a process of its own, on one thread; None where the values give no run."""
    if job.token not in _kept:
        for other in _kept.values():
            other.close()
        _kept.clear()
        _kept[job.token] = Predictor(job, threads=1)
    return _kept[job.token].attempt(x, steps)
