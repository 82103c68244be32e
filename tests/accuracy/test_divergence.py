"""Detection of injected faults, no false alarms, and the diagnosis of divergence."""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from taichi_msm import DivergedError, Simulation
from taichi_msm.accuracy import diagnosis
from taichi_msm.accuracy.diagnosis import Diagnosis
from taichi_msm.accuracy.divergence import displacement_bound
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.dynamics import ForceRecorder
from taichi_msm.solver.state import RunProgress, Snapshot, State
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.motion import notes_of
from tests.scenes import SHEET, plan_of, scene, with_steps
from tests.terms.test_contact import PRESSED, moved, touching

# Pressed for three frames.
PRESS = {"force": [0, 300, -1000], "load": [[0, 100], [0.12, 100], [0.12, 0]], "falloff": 20}

# Changes of one number of the state, and frames of the change. Changes no larger than by a press can be detected only
# in frames without a load.
FAULTS = {
    "NaN displacement": ("displacement", np.nan, (1, 2, 4, 6, 9)),
    "infinite displacement": ("displacement", -np.inf, (1, 2, 4, 6, 9)),
    "NaN difference": ("difference", np.nan, (1, 2, 4, 6, 9)),
    "infinite difference": ("difference", np.inf, (1, 2, 4, 6, 9)),
    "large displacement": ("displacement", 1e3, (1, 2, 4, 6, 9)),
    "large difference": ("difference", 1e2, (1, 2, 4, 6, 9)),
    "displacement by a third of the sheet": ("displacement", 0.1, (4, 5, 6, 8, 9)),
    "push": ("difference", -0.02, (4, 5, 6, 8, 9)),
}


def pressed(precision: str = "f32", **sections: object) -> Scene:
    return scene(**{"probes": [PRESS], "time": {"precision": precision}, **sections})


def start_of(made: Scene) -> Snapshot:
    zero = np.zeros((*made.sheet.points, 3), made.time.precision.replace("f", "float"))
    return Snapshot(State(0, zero, zero), RunProgress(), ForceRecorder(plan_of(made)).at_start())


def with_fault(snapshot: Snapshot, array: str, change: float, seed: int) -> Snapshot:
    """Change one number of a point that moves."""
    values, random = getattr(snapshot.state, array).copy(), np.random.default_rng(seed)
    rows, cols, _ = values.shape
    values[random.integers(1, rows - 1), random.integers(1, cols - 1), random.integers(3)] += np.float32(change)
    return snapshot._replace(state=snapshot.state._replace(**{array: values}))


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_detected_within_a_frame(name: str, device: Device, message: Messages) -> None:
    """40 faults, each at another time and point."""
    made = pressed()
    array, change, frames = FAULTS[name]
    with Simulation(made, threads=device.threads) as simulation:
        for frame in frames:
            simulation.restore(start_of(made))
            simulation.advance(frame)
            simulation.restore(with_fault(simulation.save(), array, change, frame))
            with pytest.raises(DivergedError) as error:
                simulation.advance()
            assert simulation.frame == frame, "the frame with the fault does not count"
    message(str(error.value), "diverged before ", hide=r"\d[\d.e+]*")


@pytest.mark.parametrize("name", ["NaN displacement", "large difference"])
def test_faults_with_contact_are_detected(name: str, device: Device) -> None:
    array, change, _ = FAULTS[name]
    made = pressed(probes=[moved([0, 0.5, 0.5, 0.0], [0.2, 0.5, 0.5, -0.03])])
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance(4)
        simulation.restore(with_fault(simulation.save(), array, change, 4))
        with pytest.raises(DivergedError):
            simulation.advance()


@pytest.mark.parametrize("active", ["loaded", "always"])
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_no_false_alarm_near_the_stability_limit(precision: str, active: str, device: Device) -> None:
    """There the energy oscillates; virtual springs become active at large displacements."""
    loads = [100, 100, 0, 0, -100, -100, 0, 0, 1, 0]
    jumps = list(zip([0, 0.1, 0.1, 0.14, 0.14, 0.2, 0.2, 0.3, 0.3, 0.7], loads, strict=True))
    made = pressed(
        springs={"structural": 20, "shear": 10, "virtual": 5, "virtual_active": active},
        damping=0,
        probes=[{**PRESS, "load": jumps}, {**PRESS, "at": [[0, -0.5, 0.5], [0.8, 1.5, 0.5]]}],
        time={"duration": 0.8, "precision": precision},
    )
    for steps in (plan_of(made).grid.steps_per_frame, math.ceil(1 / 25 / plan_of(made).stable_step / 0.995)):
        with Simulation(with_steps(made, steps), threads=device.threads) as simulation:
            simulation.advance(20)
            assert simulation.progress.peak > 1e-3


def undamped(*probes: dict[str, Any], **sections: Any) -> Scene:
    """A scene without damping; probes act alike on all points."""
    return scene(damping=0, probes=[{"falloff": 0, "offset": 0} | probe for probe in probes], **sections)


def undamped_contact(*probes: dict[str, Any], **sections: Any) -> Scene:
    return scene(damping=0, probes=list(probes), **sections)


UNHELD = {"sheet": {**SHEET, "fixed": "none"}, "springs": {"structural": 20, "shear": 10}}

# Sound scenes, each with a contribution that a bound could omit.
SOUND = {
    "flight without structural springs": undamped(
        {"force": [0, 0, 0.5], "load": [[0, 0], [0.2, 100], [0.2, 0]]},
        springs={"virtual": 0.5},
        time={"duration": 2.0},
    ),
    "virtual springs activated twice in a frame, at growing distances": undamped(
        {"force": [0, 0, 1e-3], "load": [[9.98, 0], [9.98, 100], [9.99, 100], [9.99, 0]]},
        {
            "force": [0, 0, 1e-30],
            "load": [[t + start, on] for start in (13.5, 18) for t, on in ((0, 0), (0, 9), (0.0395, 9), (0.0395, 0))],
        },
        sheet={"points": [5, 5], "size": [1, 1], "mass": 1},
        springs={"virtual": 1600},
        time={"duration": 20, "frames_per_second": 0.1, "step": 0.0005},
    ),
    "release at a frame but for rounding": undamped(
        {"force": [0.01, 0, 0], "load": [[0, 0], [1 / 30 - 1e-16, 100], [1 / 30 - 1e-16, 0]]},
        springs={"structural": 1},
        time={"duration": 1, "frames_per_second": 30},
    ),
    "displacements whose squares underflow in f32": undamped(
        {"force": [1e-13, 0, 0], "load": [[0, 100], [3, 100], [3, 0]]},
        sheet={"points": [9, 9], "size": [1e10, 1e10], "mass": 1},
        springs={"structural": 1},
        time={"duration": 100, "frames_per_second": 1, "precision": "f32"},
    ),
    "flight over sixty sizes after a grip": undamped_contact(
        moved([0, 0.5, 0.5, 0.0], [8, 0.5, 0.5, -13.0], [9, 0.5, 0.5, -12.0], friction=1.0, grip=[[0, 7.5]]),
        **UNHELD,
        time={"duration": 16},
    ),
    "stretching over sixteen sizes by a grip": undamped_contact(
        moved([0, 0.9, 0.5, 0.0], [0.8, 0.9, 0.5, 6.5], grip=[[0, 0.8]]),
        sheet={**SHEET, "fixed": ["left"]},
        time={"duration": 1.2, "precision": "f32"},
    ),
    "strokes of two tools, by half their radius in a step": undamped_contact(
        *(moved([0, x, 0.5, 0.0], *([0.2 * n, x, 0.5, (-0.6, 0.6)[n % 2]] for n in range(1, 5))) for x in (0.2, 0.8)),
        **UNHELD,
        time={"duration": 2, "step": 0.004},
    ),
    "a force against a tool without motion": undamped_contact(
        moved([0, 0.5, 0.5, 0.0]), {"force": [0, 0, 0.3], "falloff": 3, "offset": 0}
    ),
}


@pytest.mark.default_cases(*list(SOUND)[:5])
@pytest.mark.parametrize("name", SOUND)
def test_no_false_alarm_of_sound_scenes(name: str, device: Device) -> None:
    with Simulation(SOUND[name], threads=device.threads) as simulation:
        simulation.advance(SOUND[name].time.frames)
        assert simulation.progress.peak > 0


def diagnosis_of(made: Scene, device: Device, fault: Callable[[Simulation], None] = lambda _: None) -> Diagnosis:
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance()
        start = simulation.save()
        fault(simulation)
        with pytest.raises(DivergedError):
            simulation.advance(made.time.frames)
        return simulation.diagnose(start)


EXCESSIVE = {"force": [0, 0, -1], "load": [[0, 0], [0.1, 100], [0.1, 1e9]], "falloff": 20}


def test_diagnosis_of_an_excessive_force(device: Device, message: Messages) -> None:
    """A harmless probe or tool is not blamed."""
    harmless = {"force": [0, 0, 1], "at": [0.2, 0.2]}, moved([0, 0.2, 0.2, 0.0], [0.2, 0.2, 0.2, -0.02])
    for probe in harmless:
        made = pressed(probes=[probe, EXCESSIVE])
        found = diagnosis_of(made, device)
        hide = r"0\.1\d+|(?<=step )\d+|[-.\de]+(?= [ms]\b)"
        message(found.message, "probes.1.force, which reaches 454 N", hide=hide)
    # The step is the first with a fault: the state before it is sound, and the next frame diverges.
    bad_step, sound = int(re.findall(r"step (\d+)", found.message)[0]), found.last_sound_state
    assert sound
    assert sound.state.steps == bad_step - 1
    assert np.isfinite(sound.state.displacement).all()
    with Simulation(made, threads=device.threads) as simulation:
        simulation.restore(sound)
        with pytest.raises(DivergedError):
            simulation.advance()


def test_diagnosis_of_a_step_that_is_too_long(device: Device, message: Messages) -> None:
    """Near the stability limit, an undamped sheet diverges after a strong blow."""
    blow = {"force": [0, 0, -4e6], "load": [[0.1, 0], [0.1, 100]], "falloff": 60}
    made = with_steps(pressed("f64", probes=[blow], damping=0), 9)
    text = diagnosis_of(made, device).message
    hide = r"(?<=step )\d+|(?<=with )[.\d]+|(?<= at )[.\d]+|(?<= is )[.\d]+|\(.*?\)"
    message(text, "time.step, 0.00444444 s", hide=hide)
    finer = float(re.findall(r"with ([.\d]+) s it does not diverge here", text)[0])
    with Simulation(with_steps(made, round(1 / 25 / finer)), threads=device.threads) as simulation:
        simulation.advance(3)


def test_likely_causes_without_a_stable_step(monkeypatch: pytest.MonkeyPatch, message: Messages) -> None:
    """A fast tool; and a strong force after so many steps that none is tried."""
    monkeypatch.setattr(diagnosis, "_is_stable", lambda *_: False)
    for made, bad_step in (touching([PRESSED]), 1), (pressed(probes=[EXCESSIVE]), 10**12):
        dynamics: Any = SimpleNamespace(plan=plan_of(made))
        message(diagnosis._likely_cause(dynamics, bad_step, (2, 3), lambda: None))


def test_diagnosis_of_a_hardware_error(device: Device, message: Messages) -> None:
    def flip(simulation: Simulation) -> None:
        simulation.advance(3)
        simulation.restore(with_fault(simulation.save(), "displacement", np.nan, 1))

    found = diagnosis_of(pressed(), device, flip)
    message(found.message, "machine", "--resume", hide=r"(?<=step )\d+|(?<=point )\(.*?\)")
    assert found.last_sound_state
    assert found.last_sound_state.progress.frame == 1, "the frame of the snapshot"


def test_bound_of_displacements() -> None:
    # 0.05 N on 1 g is 50 m/s^2; the sheet is 0.4 m long.
    probes = [{"force": [0, 0, 0.05], "falloff": 0, "offset": 0}]
    free = 10 * 0.4 + 50 * 3.0**2 / 2
    for sections, bound in (
        ({}, 10 * 0.4),
        ({"sheet": {**SHEET, "fixed": "none"}, "springs": {"structural": 20}}, free),
        ({"springs": {"shear": 20}}, free),
        ({"springs": {"virtual": 1}}, math.inf),
    ):
        assert displacement_bound(plan_of(scene(probes=probes, **sections)), 3.0) == pytest.approx(bound)


def released(across: float, down: float, active: str) -> Scene:
    """A rod that compresses undamped tissue at a place, and is out of contact from 0.3 s on."""
    offsets = [[0, 0, 0, 0.0005], [0.12, 0, 0, -0.0053], [0.2, 0.04, 0.1, -0.0053], [0.3, 0, 0, 0.05]]
    path = [[t, across + x, down + y, height] for t, x, y, height in offsets]
    rod = moved(*path, instrument={"radius": 0.006, "shaft": [0, 0, 1], "length": 0.15})
    tissue = {"young": 3e5, "thickness": 3.2e-3, "density": 1050, "foundation": 1e6, "pretension": 200}
    sheet, time = {"points": [15, 9], "size": [0.045, 0.026]}, {"duration": 0.8}
    tissue |= {"foundation_active": active}  # type: ignore[dict-item]
    return scene(sheet=sheet, springs=None, damping=0, tissue=tissue, probes=[rod], time=time)


@pytest.mark.parametrize("active", ["always", "loaded"])
def test_warning_of_energy_growth_without_a_load(active: str, device: Device, message: Messages) -> None:
    # Near the border, compressed springs are stiffer than the stability limit assumes.
    for across, down, grows in ((0.76, 0.78, True), (0.5, 0.45, False)):
        made = released(across, down, active)
        with Simulation(made, device.arch) as simulation:
            simulation.advance(20)
            progress = simulation.progress
        assert progress.energy_growth > (3 if grows else 0)
        notes = [note for note in notes_of(made, progress, None) if note.startswith("the energy grew")]
        if grows:
            message(notes, "after 0.3 s", hide=r"(?<=factor of )[\d.]+")
        else:
            assert not notes
