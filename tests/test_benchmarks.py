"""The benchmarks compare like with like: a peer is timed only where its answer is right."""

from __future__ import annotations

import sys
from dataclasses import asdict
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from benchmarks import child, dop853, page, process, race
from benchmarks.stepping import PEERS, measure, numpy_
from benchmarks.stepping.problem import Array, Problem
from taichi_msm import load_scene
from taichi_msm.accuracy.time_step import max_norm
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.motion import frames_on
from tests.scenes import plan_of


@pytest.fixture(autouse=True)
def own_cache(tmp_path: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(measure, "CACHE", tmp_path)


@pytest.fixture
def in_this_process(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every call is made here."""

    def call(task: str, **arguments: Any) -> Any:
        answer = child.answer(task, arguments)
        if "unavailable" in answer:
            raise process.UnavailableError(answer["unavailable"])
        return answer["returned"]

    monkeypatch.setattr(race, "call", call)
    monkeypatch.setattr(measure, "seconds", lambda work: 1.0)


class Late(numpy_.Stepper):
    """Its answer is that of one step before."""

    def displacement(self) -> Array:
        return np.moveaxis(self._before, 0, -1)


class Lost(numpy_.Stepper):
    """Its answer is no number."""

    def displacement(self) -> Array:
        return super().displacement() * np.nan


def peer(monkeypatch: pytest.MonkeyPatch, stepper: Any) -> str:
    """Make the module of a peer; gives its name."""
    module = ModuleType("made_peer")
    module.prepare = lambda problem, threads: stepper(problem)  # type: ignore[attr-defined]
    monkeypatch.setitem(sys.modules, module.__name__, module)
    return module.__name__


@pytest.mark.parametrize("name", ["taichi_msm", "NumPy"])
def test_a_right_answer_is_found_right(name: str, device: Device) -> None:
    found = measure.check(PEERS[name], 13, device.threads)
    assert found["right"], found["wanted"]
    assert found["answer"] < measure.TOLERANCE / 10


@pytest.mark.usefixtures("in_this_process")
@pytest.mark.parametrize("stepper", [Late, Lost])
def test_a_wrong_answer_is_not_timed(stepper: Any, monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    peers = {"right": PEERS["NumPy"], "wrong": peer(monkeypatch, stepper)}
    right, wrong = race.race("benchmarks.stepping.measure", peers, 2, lambda text: None, points=13)
    assert (right.said, right.samples) == ("", [1.0, 1.0])
    message(wrong.said, "wrong", hide=r"\d\S*")
    assert not wrong.samples


@pytest.mark.usefixtures("in_this_process")
def test_a_peer_that_is_not_installed_is_skipped_with_its_word(message: Messages) -> None:
    peers = {"nobody": "benchmarks.stepping.nobody", "NumPy": PEERS["NumPy"]}
    missing, there = race.race("benchmarks.stepping.measure", peers, 1, lambda text: None, points=13)
    message(missing.said, "benchmarks.stepping.nobody")
    assert not missing.samples
    assert there.samples


@pytest.mark.slow
def test_a_measurement_is_a_process_of_its_own(monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    with pytest.raises(process.FailedError, match="TypeError"):
        process.call("json:dumps", nothing=1)
    monkeypatch.setenv("PATH", "")
    with message.raises(process.UnavailableError):
        process.call("benchmarks.stepping.measure:check", peer=PEERS["C++, OpenMP"], points=5)


def test_the_load_reaches_every_point() -> None:
    for share in np.abs(Problem(101).load):
        assert share.min() > 0.01 * share.max()


def test_the_page_shows_times_and_words(message: Messages) -> None:
    entries = [
        asdict(race.Entry("taichi_msm", answer=1e-7, compile=1.0, samples=[2e-6, 4e-6, 3e-6])),
        asdict(race.Entry("Numba", said="skipped: numba is not installed")),
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
