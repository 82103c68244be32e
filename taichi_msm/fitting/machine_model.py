"""Forward model of machine tests, with a run per test and common parameters; reader of their tables and options."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, ClassVar

import numpy as np

from taichi_msm.arithmetic import Array
from taichi_msm.errors import Pause, SceneError
from taichi_msm.fitting.forces import Forces
from taichi_msm.fitting.observation import ObservationModel
from taichi_msm.fitting.panels import Panel
from taichi_msm.fitting.parameters import Parameter, Request, as_data, make_parameters, with_values
from taichi_msm.fitting.predict import FitProblem, ForwardModel, Prediction, without_outputs
from taichi_msm.load.check import check_scene
from taichi_msm.machines.loading import (
    Approach,
    Loading,
    build_loading,
    find_approach,
    late_contact_note,
    require_plausible_travel,
)
from taichi_msm.machines.reader import TABLE_SUFFIXES, cut_window, read_machine_test
from taichi_msm.model.plan import Plan
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene

# Options of `fit` for tables only, and for observed points only.
TABLE_OPTIONS = ("columns", "sheet", "block", "window", "rate", "contact", "force_offset")
POINT_OPTIONS = ("sigma", "correlation", "drift", "resolution")


@dataclass(frozen=True, eq=False)
class MachineForces(Forces, ObservationModel):
    """Forces along the tool's direction [N] of all tests; values of shape (frames of all tests, 1).

    The observation is its own model: the map from the run of a test to these forces. The force of every test has an
    unknown offset, unless it is given.
    """

    is_independent: ClassVar[bool] = False  # Their chi-square is the total.

    approach: Approach
    tests: tuple[Loading, ...]

    @property
    def freedom(self) -> int:
        return round(sum(float(loading.information.sum()) for loading in self.tests)) - sum(
            not loading.has_exact_offset for loading in self.tests
        )

    @property
    def sigma_freedom(self) -> float:
        return sum(loading.sigma_freedom for loading in self.tests)

    def without_offset(self, rows: Array, robust_factor: Callable[[Array], Array] | None = None) -> Array:
        # Offsets are weighted means; frames without information do not count.
        ends, parts = np.cumsum([len(loading.force) for loading in self.tests])[:-1], []
        for part, loading in zip(np.split(rows, ends), self.tests, strict=True):
            unit = (loading.information > 0) / loading.sigma
            part = (part.T * (unit > 0)).T
            if loading.has_exact_offset:
                parts.append(part)
                continue
            centred = part - np.multiply.outer(unit, unit @ part / (unit @ unit))
            if robust_factor is not None:
                for _ in range(20):  # reweighted means
                    weights = unit / np.sqrt(robust_factor(centred))
                    centred = part - unit * (weights @ part / (weights @ unit))
            parts.append(centred)
        return np.concatenate(parts)

    def build_model(self, scene: Scene, frames: int) -> MachineForces:
        return self

    def panels(self, scene: Scene, fitted: Array) -> list[Panel]:
        return []  # Each test has its own.

    def record(self, simulation: Simulation) -> Array:
        """Return the force of the tool in the current frame [N], shape (3,)."""
        return np.array(simulation.forces()[self.approach.probe].force)

    def predict(self, recorded: Array) -> Array:
        """Return the forces of a test along the tool's direction [N], shape (frames, 1)."""
        return np.asarray(recorded @ self.approach.direction[:, None])


@dataclass(frozen=True, eq=False)
class MachineProblem(FitProblem):
    """Scene, parameters and machine tests of a fit."""

    # Forward differences are sufficient for smooth forces at many frames.
    signs: ClassVar[tuple[int, ...]] = (1,)

    approach: Approach = field(kw_only=True)

    @property
    def contact_keys(self) -> list[str]:
        """Keys of the depths of contact of all tests."""
        return contact_keys(len(self.tests))

    def build_model(self, threads: int | None, pause: Pause = lambda: None) -> ForwardModel:
        return MachineModel(self, threads, pause)

    def fitted_data(self, data: dict[str, Any], values: Mapping[str, float], n: int = 0) -> dict[str, Any]:
        test, contact = self.tests[n], values.get(self.contact_keys[n])
        return self.approach.place(with_values(data, values), test.travel(contact), test.rate)

    def reach(self, values: Mapping[str, float]) -> float:
        """Return the greatest travel of all tests [m]; `values`: parameter values by key."""
        pairs = zip(self.tests, self.contact_keys, strict=True)
        return max(float(test.travel(values.get(key)).max()) for test, key in pairs)


class MachineModel(ForwardModel):
    """Forward model that runs every machine test and predicts `MachineForces`, shape (frames of all tests, 1)."""

    problem: MachineProblem

    def predict(self, x: Array, steps: int | None = None, *, halvings: int = 0, to_end: bool = False) -> Prediction:
        # Every run ends with its test.
        forces, most_steps = [], 0
        for n in range(len(self.problem.tests)):
            data = self.problem.fitted_data(self.data, self.values(x), n)
            simulation, plan = self.start(check_scene(Scene(**data), self.maps), steps, halvings)
            forces.append(self.forces(simulation, plan))
            most_steps = max(most_steps, plan.grid.steps_per_frame)
        return Prediction((np.concatenate(forces),), most_steps, np.zeros(1))

    def forces(self, simulation: Simulation, plan: Plan) -> Array:
        """Return the forces of a run along the tool's direction [N], shape (frames, 1), from its first frame."""
        (observed,) = self.problem.observations
        frames = plan.grid.frames + 1
        model = observed.build_model(plan.scene, frames)
        (recorded,) = self.record([model], simulation, frames)
        return model.predict(recorded)


def contact_keys(count: int) -> list[str]:
    """Return the keys of the depths of contact of `count` tests."""
    return ["contact"] if count == 1 else [f"contact.{n}" for n in range(count)]


def is_table(path: object) -> bool:
    """Return whether the suffix of a path is that of a machine table."""
    return isinstance(path, (str, Path)) and str(path).lower().endswith(TABLE_SUFFIXES)


def table_paths(observed: Any) -> list[str]:
    """Return the paths of tables, or an empty list for other observations; raise a SceneError for a mixture."""
    paths = [observed] if isinstance(observed, (str, Path)) or not isinstance(observed, Sequence) else list(observed)
    others = [path for path in paths if not is_table(path)]
    if len(others) == len(paths) == 1:
        return []
    if others or not paths:
        fault = f"not a table of a testing machine, {', '.join(TABLE_SUFFIXES)}; give tables only, or one other file"
        raise SceneError([f"{others[0] if others else 'observed'}: {fault}"])
    return [str(path) for path in paths]


def read_machine_problem(paths: Sequence[str], request: Request) -> MachineProblem:
    """Return the fit problem of machine tables, which exclude --forces."""
    scene, free, _, forces, method = request
    if forces is not None:
        raise SceneError([f"--forces: {paths[0]} contains forces already; leave the option out"])
    if unused := [name for name in POINT_OPTIONS if method.get(name) is not None]:
        raise SceneError([f"--{unused[0]}: only for observed points, and {paths[0]} has none; leave the option out"])
    rate = method.get("rate")
    if rate is not None and not 0 < rate < np.inf:
        raise SceneError([f"--rate {rate:g}: take a number of frames per second, above 0"])
    contacts = _per_table("--contact", "depths", method.get("contact"), len(paths))
    offsets = _per_table("--force-offset", "forces", method.get("force_offset"), len(paths))
    approach, tests = find_approach(scene), []
    for n, (path, key) in enumerate(zip(paths, contact_keys(len(paths)), strict=True)):
        test = read_machine_test(path, method.get("columns") or (), method.get("sheet"), method.get("block"))
        if (window := method.get("window")) is not None:
            test = cut_window(test, *window)
        contact, is_clamp = contacts[n], approach.is_clamp
        loading = build_loading(
            test, scene, rate, contact, is_clamp=is_clamp, force_offset=offsets[n], fits_contact=key in free
        )
        require_plausible_travel(loading, scene)
        is_estimated = contact is None and not is_clamp and key not in free
        if is_estimated and (note := late_contact_note(loading, key)):
            loading = replace(loading, test=replace(loading.test, notes=(*loading.test.notes, note)))
        tests.append(loading)
    parameters = _make_parameters(request, tests, approach.probe)
    first = tests[0]
    placed = approach.place(as_data(without_outputs(scene)), first.travel(), first.rate)
    observations = MachineForces(
        ", ".join(loading.test.name for loading in tests),
        np.concatenate([np.arange(len(loading.force)) / loading.rate for loading in tests]),
        np.concatenate([loading.force for loading in tests])[:, None],
        np.concatenate([loading.sigma for loading in tests]),
        approach,
        tuple(tests),
    )
    if observations.freedom <= len(parameters):
        count = sum(int(np.count_nonzero(loading.information)) for loading in tests)
        fault = f"frames with rows: {count}, too few for {len(parameters)} parameters and the offset of the force"
        raise SceneError([f"{observations.name}: {fault}; raise --rate"])
    return MachineProblem(Scene(**placed), parameters, (observations,), tuple(tests), approach=approach)


def _per_table(option: str, noun: str, given: Sequence[float] | None, count: int) -> list[float | None]:
    """Return the number of every table, from one for all, one each, or none."""
    numbers: list[float | None] = [*given] if given else [None]
    if len(numbers) not in (1, count):
        raise SceneError([f"{option}: {len(numbers)} {noun} for {count} tables; give one, or one per table"])
    return numbers * count if len(numbers) == 1 else numbers


def _make_parameters(request: Request, tests: Sequence[Loading], probe: int) -> tuple[Parameter, ...]:
    """Build the parameters of the free keys, including depths of contact; `probe`: index of the tool."""
    (scene, free, bounds, _, _), contacts = request, contact_keys(len(tests))
    for key in free:
        if key.partition(".")[0] == "contact" and key not in contacts:
            raise SceneError([f"--free {key}: no such table; take {' or '.join(contacts)}"])
        if f"{key}.".startswith(f"probes.{probe}.path."):
            raise SceneError([f"--free {key}: the table sets the path; free contact, the depth of contact"])
    of_scene = [key for key in free if key not in contacts]
    parameters = {}
    if of_scene or not free:
        # Bounds of keys that are not free are an error of `make_parameters`.
        limits = {key: ends for key, ends in bounds.items() if key not in {*free} & {*contacts}}
        parameters = {parameter.key: parameter for parameter in make_parameters(scene, of_scene, limits)}
    for key, test in zip(contacts, tests, strict=True):
        if key in free:
            # Depths of contact are in metres, as in the table; x is in units of their range.
            # The depth of the row of contact may be below that of the first row, by noise.
            first, last = min(float(test.depth[0]), test.contact), float(test.depth.max())
            low, high = bounds.get(key, (first, last))
            low, high = max(first, low), min(last, high)
            if not (low <= test.contact <= high and low < high):
                fault = f"the initial depth is {test.contact:.4g} m, and the greatest one of the table {last:.4g} m"
                remedy = "take bounds around the initial depth, or another one by --contact"
                raise SceneError([f"--bounds {key}: {fault}; {remedy}"])
            parameters[key] = Parameter(key, test.contact, low, high, high - low)
    return tuple(parameters[key] for key in free)
