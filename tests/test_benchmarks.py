"""The benchmarks compare like with like: a peer is timed only if its answer is correct."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from benchmarks import child, coverage, dop853, page, process, race
from benchmarks.stepping import PEERS, measure, numpy_
from benchmarks.stepping.problem import Array
from taichi_msm import load_scene
from taichi_msm.accuracy.time_step import max_norm
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.motion import frames_on
from tests.scenes import plan_of


@pytest.fixture(autouse=True)
def answer_cache(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measure, "CACHE", tmp_path)


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Measurements are calls in this process."""

    def call(task: str, **arguments: Any) -> Any:
        answer = child.answer(task, arguments)
        if "unavailable" in answer:
            raise process.UnavailableError(answer["unavailable"])
        return answer["returned"]

    monkeypatch.setattr(race, "call", call)
    monkeypatch.setattr(measure, "seconds", lambda work: 1.0)


class Late(numpy_.Stepper):
    """Returns the displacement of the step before."""

    def displacement(self) -> Array:
        return np.moveaxis(self._before, 0, -1)


class Lost(numpy_.Stepper):
    """Returns NaN."""

    def displacement(self) -> Array:
        return super().displacement() * np.nan


@pytest.mark.parametrize("name", ["taichi_msm", "NumPy"])
def test_correct_answers(name: str, device: Device) -> None:
    result = measure.check(PEERS[name], 13, device.threads)
    assert result["correct"], result["wanted"]
    assert result["answer"] < measure.TOLERANCE / 10


@pytest.mark.usefixtures("in_this_process")
def test_wrong_and_missing_peers_are_not_timed(monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    peers = {"NumPy": PEERS["NumPy"], "missing": "benchmarks.stepping.nobody"}
    for stepper in (Late, Lost):
        module = ModuleType(stepper.__name__)
        module.prepare = lambda problem, threads, stepper=stepper: stepper(problem)  # type: ignore[attr-defined]
        monkeypatch.setitem(sys.modules, module.__name__, module)
        peers[module.__name__] = module.__name__
    correct, *others = race.race("benchmarks.stepping.measure", peers, 2, lambda text: None, points=13)
    assert (correct.failure, correct.samples) == ("", [1.0, 1.0])
    assert not any(entry.samples for entry in others)
    message("\n".join(entry.failure for entry in others), "benchmarks.stepping.nobody", "nan", hide=r"\d\S*")


@pytest.mark.slow
def test_failures_of_a_measuring_process(monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    with pytest.raises(process.FailedError, match="TypeError"):
        process.call("json:dumps", nothing=1)
    monkeypatch.setenv("PATH", "")
    with message.raises(process.UnavailableError):
        process.call("benchmarks.stepping.measure:check", peer=PEERS["C++, OpenMP"], points=5)


def test_tables_of_the_page(message: Messages) -> None:
    entries = [
        asdict(race.Entry("taichi_msm", answer=1e-7, compile=1.0, samples=[2e-6, 4e-6, 3e-6])),
        asdict(race.Entry("Numba", failure="skipped: numba is not installed")),
    ]
    text = page.page({"machine": page.machine(), "rounds": 3, "stepping": {"31": entries}})
    rows = [" ".join(line.split()) for line in text.splitlines() if line.startswith("| ") and "--" not in line]
    message(rows, "taichi_msm", "Numba", hide="[^|]*(?=: time)")
    assert page.NOT_MEASURED in " ".join(text.split())


@pytest.mark.slow
def test_dop853_solves_the_scene(root: Path, device: Device) -> None:
    plan = plan_of(load_scene(root / "scenes/figure-3.yaml", ["output=[]"])).with_grid(precision="f64")
    exact = frames_on(plan.with_grid(steps_per_frame=8 * plan.grid.steps_per_frame), device)
    assert max_norm(dop853.integrate(1e-5) - exact) < 1e-4 * max_norm(exact)


def test_coverage_of_a_clamp(device: Device) -> None:
    result = coverage.try_test(coverage.Kind("clamp", 120, waits=False), 1)
    assert result.keys() == {"young", "lock", "rejected", "noted"}
    for _, error in (result["young"], result["lock"]):
        assert abs(error) < 4
