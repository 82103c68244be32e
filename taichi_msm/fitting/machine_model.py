"""Forward model of machine tests: a run per test with the same parameters, and the forces at its frames."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np
from numpy.typing import NDArray

from taichi_msm.errors import Pause, SceneError
from taichi_msm.fitting.forces import Forces
from taichi_msm.fitting.machine_test import Approach, Loading
from taichi_msm.fitting.observation import ObservationModel
from taichi_msm.fitting.parameters import Bounds, Parameter, make_parameters, with_values
from taichi_msm.fitting.predict import FitProblem, ForwardModel, Prediction
from taichi_msm.load.check import check_scene
from taichi_msm.model.plan import Plan
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene

Array = NDArray[np.float64]


def contact_keys(count: int) -> list[str]:
    """Return the keys of the depths of contact of a number of tests."""
    return ["contact"] if count == 1 else [f"contact.{n}" for n in range(count)]


@dataclass(frozen=True, eq=False)
class MachineProblem(FitProblem):
    """Scene, parameters and machine tests of a fit."""

    # Tests have many frames, and smooth forces.
    signs: ClassVar[tuple[int, ...]] = (1,)

    tests: tuple[Loading, ...]
    approach: Approach

    def build_model(self, threads: int | None) -> ForwardModel:
        """Build the forward model of the tests."""
        return MachineModel(self, threads)

    def fitted_data(self, data: dict[str, Any], values: Mapping[str, float]) -> dict[str, Any]:
        """Return a scene's data with parameter values by key, and with the path and the times of the first test."""
        return self.place(data, values, 0)

    def place(self, data: dict[str, Any], values: Mapping[str, float], n: int) -> dict[str, Any]:
        """Return a scene's data with parameter values, by key, and with the path and the times of test n."""
        contact = values.get(contact_keys(len(self.tests))[n])
        return self.tests[n].place(self.with_scene_values(data, values), self.approach, contact)

    def with_scene_values(self, data: dict[str, Any], values: Mapping[str, float]) -> dict[str, Any]:
        """Return a scene's data with parameter values by key, except depths of contact."""
        of_scene = [parameter for parameter in self.parameters if parameter.key not in contact_keys(len(self.tests))]
        return with_values(data, of_scene, [values[parameter.key] for parameter in of_scene])

    def reach(self, values: Mapping[str, float]) -> float:
        """Return the greatest travel of all tests [m] with parameter values by key."""
        keys = contact_keys(len(self.tests))
        return max(float(test.travel(values.get(key)).max()) for test, key in zip(self.tests, keys, strict=True))


class MachineModel(ForwardModel):
    """Forward model of machine tests; predicts `MachineForces`, of shape (frames of all tests, 1)."""

    job: MachineProblem

    def predict(
        self,
        x: Array,
        steps: int | None = None,
        *,
        coarse: int = 0,
        to_end: bool = False,  # The runs end with their tests.
        pause: Pause = lambda: None,
    ) -> Prediction:
        """Simulate all tests with the parameters at x; arguments and errors as of `ForwardModel.predict`."""
        forces, most_steps = [], 0
        for n in range(len(self.job.tests)):
            simulation, plan = self.start(self.plan(x, n), steps, coarse)
            forces.append(self.forces(simulation, plan.grid.frames, pause))
            most_steps = max(most_steps, plan.grid.steps_per_frame)
        return Prediction((np.concatenate(forces),), most_steps, np.zeros(1))

    def forces(self, simulation: Simulation, frames: int, pause: Pause) -> Array:
        """Return the forces along the tool's direction in a run of a number of frames [N], shape (frames + 1, 1)."""
        (observed,) = self.job.observations
        model = observed.build_model(self.job.scene, frames + 1)
        (recorded,) = self.record([model], simulation, frames + 1, pause)
        return model.predict(recorded)

    def plan(self, x: Array, n: int = 0) -> Plan:
        """Plan the scene of test n with the parameters at x; SceneError: it is not valid."""
        return check_scene(Scene(**self.job.place(self.data, self.values(x), n)), self.maps)

    def values(self, x: Array) -> dict[str, float]:
        """Return the parameter values by key at x; SceneError: they are out of range."""
        values = {
            parameter.key: parameter.value(coordinate)
            for parameter, coordinate in zip(self.job.parameters, x.tolist(), strict=True)
        }
        if not np.isfinite(list(values.values())).all():
            raise SceneError(["the values are out of range"])
        return values


def machine_parameters(
    scene: Scene, tests: Sequence[Loading], free: Sequence[str], bounds: Mapping[str, Bounds], probe: int
) -> tuple[Parameter, ...]:
    """Build the parameters of the keys `free`, among them depths of contact.

    Args:
        scene: the scene with its initial values.
        tests: the machine tests.
        free: keys.
        bounds: smallest and largest values by key.
        probe: index of the tool.

    Raises:
        SceneError: lists all faults.
    """
    contacts = contact_keys(len(tests))
    for key in free:
        if key.partition(".")[0] == "contact" and key not in contacts:
            raise SceneError([f"--free {key}: there is no such table; take {' or '.join(contacts)}"])
        if f"{key}.".startswith(f"probes.{probe}.path."):
            raise SceneError([f"--free {key}: the path is that of the table; name contact, its depth of contact"])
    of_scene = [key for key in free if key not in contacts]
    parameters = {}
    if of_scene or not free:
        limits = {key: ends for key, ends in bounds.items() if key not in free or key not in contacts}
        parameters = {parameter.key: parameter for parameter in make_parameters(scene, of_scene, limits)}
    for key, test in zip(contacts, tests, strict=True):
        if key in free:
            parameters[key] = _contact_parameter(key, test, bounds.get(key))
    return tuple(parameters[key] for key in free)


def _contact_parameter(key: str, test: Loading, bounds: Bounds | None) -> Parameter:
    """Build the parameter of a depth of contact [m of the table], in units of the range of depths."""
    low, high = test.contact_range
    if bounds is not None:
        low, high = max(low, bounds[0]), min(high, bounds[1])
    if not (low <= test.contact <= high and low < high):
        end = test.contact_range[1]
        found = f"the search begins at {test.contact:.4g} m, and the table's depths end at {end:.4g} m"
        raise SceneError([f"--bounds {key}: {found}; take bounds around the start, or another start by --contact"])
    return Parameter(key, test.contact, low, high, high - low)


class MachineForceModel(ObservationModel):
    """Map from the run of a machine test to the forces at its frames."""

    def __init__(self, approach: Approach) -> None:
        self._approach = approach

    def record(self, simulation: Simulation) -> Array:
        """Return the force of the tool in the current frame [N], shape (3,)."""
        return np.array(simulation.forces()[self._approach.probe].force)

    def predict(self, recorded: Array) -> Array:
        """Return the forces along the direction of the tool at all frames [N], shape (frames, 1)."""
        return np.asarray(recorded @ self._approach.direction[:, None])


@dataclass(frozen=True, eq=False)
class MachineForces(Forces):
    """Forces at the frames of all tests along the direction of the tool, of shape (frames, 1)."""

    approach: Approach

    def build_model(self, scene: Scene, frames: int) -> MachineForceModel:
        """Build the map from the run of a test."""
        return MachineForceModel(self.approach)


def observe_tests(tests: Sequence[Loading], approach: Approach) -> MachineForces:
    """Return the forces of machine tests."""
    lengths = [len(loading.force) for loading in tests]
    return MachineForces(
        ", ".join(loading.test.name for loading in tests),
        np.concatenate([loading.scene_time for loading in tests]),
        np.concatenate([loading.force for loading in tests])[:, None],
        np.repeat([loading.sigma for loading in tests], lengths),
        approach,
    )
