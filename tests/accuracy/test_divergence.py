"""Simulations that go wrong, by faults that are put into them, and what is said of them."""

from __future__ import annotations

import math
import re
from collections.abc import Callable

import numpy as np
import pytest

from taichi_msm import DivergedError, Simulation
from taichi_msm.accuracy.diagnosis import Diagnosis
from taichi_msm.accuracy.divergence import displacement_bound
from taichi_msm.scene.scene import Scene
from taichi_msm.solver.dynamics import ForceRecorder
from taichi_msm.solver.state import RunProgress, Snapshot, State
from taichi_msm.system.runtime import Device
from tests.golden import Messages
from tests.motion import notes_of
from tests.scenes import SHEET, plan_of, scene, with_steps
from tests.terms.test_contact import moved

# Pressed for three frames.
PRESS = {"force": [0, 300, -1000], "load": [[0, 100], [0.12, 100], [0.12, 0]], "falloff": 20}

# What is added to one number of the state, and at which frames. A fault that is no larger than what a press does is one
# that the load explains, and can be found when nothing presses.
FAULTS = {
    "displacement is no number": ("displacement", np.nan, (1, 2, 4, 6, 9)),
    "displacement is infinite": ("displacement", -np.inf, (1, 2, 4, 6, 9)),
    "difference is no number": ("difference", np.nan, (1, 2, 4, 6, 9)),
    "difference is infinite": ("difference", np.inf, (1, 2, 4, 6, 9)),
    "thrown far away": ("displacement", 1e3, (1, 2, 4, 6, 9)),
    "thrown fast": ("difference", 1e2, (1, 2, 4, 6, 9)),
    "moved by a third of the sheet": ("displacement", 0.1, (4, 5, 6, 8, 9)),
    "pushed": ("difference", -0.02, (4, 5, 6, 8, 9)),
}


def pressed(precision: str = "f32", **sections: object) -> Scene:
    return scene(**{"probes": [PRESS], "time": {"precision": precision}, **sections})


def rest(made: Scene) -> Snapshot:
    nothing = np.zeros((*made.sheet.points, 3), made.time.precision.replace("f", "float"))
    return Snapshot(State(0, nothing, nothing), RunProgress(), ForceRecorder(plan_of(made)).at_rest())


def with_fault(saved: Snapshot, part: str, change: float, random: np.random.Generator) -> Snapshot:
    """Add to one number of a point that moves."""
    wrong = getattr(saved.state, part).copy()
    rows, cols, _ = wrong.shape
    wrong[random.integers(1, rows - 1), random.integers(1, cols - 1), random.integers(3)] += np.float32(change)
    return saved._replace(state=saved.state._replace(**{part: wrong}))


@pytest.mark.parametrize("name", FAULTS)
def test_faults_are_found_within_a_frame(name: str, device: Device, message: Messages) -> None:
    """Put in at 40 places, found at 40."""
    made = pressed()
    part, change, frames = FAULTS[name]
    with Simulation(made, threads=device.threads) as simulation:
        for frame in frames:
            simulation.restore(rest(made))
            simulation.advance(frame)
            good = simulation.positions()
            simulation.restore(with_fault(simulation.save(), part, change, np.random.default_rng(frame)))
            with message.raises(DivergedError, "diverged before ", hide=r"\d[\d.e+]*"):
                simulation.advance()
            assert simulation.frame == frame, "the frame that went wrong does not count"
            assert np.isfinite(good).all()


@pytest.mark.parametrize("active", ["loaded", "always"])
@pytest.mark.parametrize("precision", ["f32", "f64"])
def test_no_fault_is_found_where_there_is_none(precision: str, active: str, device: Device) -> None:
    """Also near the limit of the step, where the energy swings, and where virtual springs begin to pull from afar."""
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


PLAIN = {"falloff": 0, "offset": 0}

# Sound, each with something that a bound could leave out.
SOUND = {
    "flies free, as nothing joins it to the border": scene(
        springs={"virtual": 0.5},
        damping=0,
        probes=[{**PLAIN, "force": [0, 0, 0.5], "load": [[0, 0], [0.2, 100], [0.2, 0]]}],
        time={"duration": 2.0},
    ),
    "virtual springs begin twice in a frame, each time farther away": scene(
        sheet={"points": [5, 5], "size": [1, 1], "mass": 1},
        springs={"virtual": 1600},
        damping=0,
        probes=[
            {**PLAIN, "force": [0, 0, 1e-3], "load": [[9.98, 0], [9.98, 100], [9.99, 100], [9.99, 0]]},
            {
                **PLAIN,
                "force": [0, 0, 1e-30],
                "load": [
                    [t + start, on] for start in (13.5, 18) for t, on in ((0, 0), (0, 9), (0.0395, 9), (0.0395, 0))
                ],
            },
        ],
        time={"duration": 20, "frames_per_second": 0.1, "step": 0.0005},
    ),
    "is let go at a frame, but for rounding": scene(
        springs={"structural": 1},
        damping=0,
        probes=[{**PLAIN, "force": [0.01, 0, 0], "load": [[0, 0], [1 / 30 - 1e-16, 100], [1 / 30 - 1e-16, 0]]}],
        time={"duration": 1, "frames_per_second": 30},
    ),
    "a tool takes it along, and lets it fly sixty times as far as it is long": scene(
        sheet={**SHEET, "fixed": "none"},
        springs={"structural": 20, "shear": 10},
        damping=0,
        probes=[moved([0, 0.5, 0.5, 0.0], [8, 0.5, 0.5, -13.0], [9, 0.5, 0.5, -12.0], friction=1.0, grip=[[0, 7.5]])],
        time={"duration": 16},
    ),
    "a tool stretches it sixteen times as far as it is long, and lets go": scene(
        sheet={**SHEET, "fixed": ["left"]},
        damping=0,
        probes=[moved([0, 0.9, 0.5, 0.0], [0.8, 0.9, 0.5, 6.5], grip=[[0, 0.8]])],
        time={"duration": 1.2, "precision": "f32"},
    ),
    "tools bat it about, each by half its radius in a step": scene(
        sheet={**SHEET, "fixed": "none"},
        springs={"structural": 20, "shear": 10},
        damping=0,
        probes=[
            moved([0, x, 0.5, 0.0], *([0.2 * n, x, 0.5, (-0.6, 0.6)[n % 2]] for n in range(1, 5))) for x in (0.2, 0.8)
        ],
        time={"duration": 2, "step": 0.004},
    ),
    "a force presses it into a tool that stands": scene(
        damping=0, probes=[moved([0, 0.5, 0.5, 0.0]), {"force": [0, 0, 0.3], "falloff": 3, "offset": 0}]
    ),
    "moves by less than f32 can square": scene(
        sheet={"points": [9, 9], "size": [1e10, 1e10], "mass": 1},
        springs={"structural": 1},
        damping=0,
        probes=[{**PLAIN, "force": [1e-13, 0, 0], "load": [[0, 100], [3, 100], [3, 0]]}],
        time={"duration": 100, "frames_per_second": 1, "precision": "f32"},
    ),
}


@pytest.mark.default_cases(
    "flies free, as nothing joins it to the border",
    "virtual springs begin twice in a frame, each time farther away",
    "is let go at a frame, but for rounding",
    "a tool takes it along, and lets it fly sixty times as far as it is long",
    "moves by less than f32 can square",
)
@pytest.mark.parametrize("name", SOUND)
def test_what_is_sound_is_let_pass(name: str, device: Device) -> None:
    with Simulation(SOUND[name], threads=device.threads) as simulation:
        simulation.advance(SOUND[name].time.frames)
        assert simulation.progress.peak > 0


@pytest.mark.parametrize("fault", ["displacement is no number", "thrown fast"])
def test_faults_are_found_beside_a_tool(fault: str, device: Device) -> None:
    part, change, _ = FAULTS[fault]
    with Simulation(
        pressed(probes=[moved([0, 0.5, 0.5, 0.0], [0.2, 0.5, 0.5, -0.03])]), threads=device.threads
    ) as simulation:
        simulation.advance(4)
        simulation.restore(with_fault(simulation.save(), part, change, np.random.default_rng(4)))
        with pytest.raises(DivergedError):
            simulation.advance()


def test_springs_that_begin_to_pull_from_afar_give_energy(device: Device) -> None:
    """Twice within a frame, each for a quarter of their period, and between them the sheet flies to the other side."""
    on, off = [(0.01, 0), (0.01, 1)], [(0.017, 1), (0.017, 0)]
    load = [*on, *off, *((t + 0.027, percent) for t, percent in [*on, *off])]
    made = scene(
        sheet={**SHEET, "points": [2, 2], "fixed": "none"},
        springs={"structural": 1, "virtual": 50},
        damping=0,
        probes=[{"force": [0, 0, 1e-9], "load": load}],
        time={"duration": 0.2, "frames_per_second": 5},
    )
    away = np.full((2, 2, 3), [0, 0, 0.02])
    held = 50 / 2 * 0.02**2 * 4
    with Simulation(made, threads=device.threads) as simulation:
        simulation.restore(rest(made)._replace(state=State(0, away, 0 * away), progress=RunProgress(reach=0.04)))
        simulation.advance()
        assert simulation.progress.energy > 10 * held


def diagnosed(made: Scene, device: Device, fault: Callable[[Simulation], None] = lambda _: None) -> Diagnosis:
    """What is found about a run that diverges."""
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance()
        start = simulation.save()
        fault(simulation)
        with pytest.raises(DivergedError):
            simulation.advance(made.time.frames)
        return simulation.diagnose(start)


INCONSISTENT = {"force": [0, 0, -1], "load": [[0, 0], [0.1, 100], [0.1, 1e9]], "falloff": 20}


def test_a_force_that_is_too_strong_is_named(device: Device, message: Messages) -> None:
    """And not a tool that does no harm."""
    weak, made = {"force": [0, 0, 1], "at": [0.2, 0.2]}, []
    for other in (weak, moved([0, 0.2, 0.2, 0.0], [0.2, 0.2, 0.2, -0.02])):
        made.append(pressed(probes=[other, INCONSISTENT]))
        found = diagnosed(made[-1], device)
        message(found.message, "probes.1.force, which reaches 454 N", hide=r"0\.1\d+|(?<=step )\d+|[-.\de]+(?= [ms]\b)")
    # The step named is the first: one less is fine, and it is not.
    bad = int(re.findall(r"step (\d+)", found.message)[0])
    assert found.last_sound_state
    assert found.last_sound_state.state.steps == bad - 1
    assert np.isfinite(found.last_sound_state.state.displacement).all()
    with Simulation(made[-1], threads=device.threads) as simulation:
        simulation.restore(found.last_sound_state)
        with pytest.raises(DivergedError):
            simulation.advance()


def test_a_step_that_is_too_long_is_named(device: Device, message: Messages) -> None:
    """Near the limit of stability, an undamped sheet that is hit hard flies apart."""
    blow = {"force": [0, 0, -4e6], "load": [[0.1, 0], [0.1, 100]], "falloff": 60}
    made = with_steps(pressed("f64", probes=[blow], damping=0), 9)
    found = diagnosed(made, device).message
    message(
        found, "time.step, 0.00444444 s", hide=r"(?<=step )\d+|(?<=with )[.\d]+|(?<= at )[.\d]+|(?<= is )[.\d]+|\(.*?\)"
    )
    finer = float(re.findall(r"with ([.\d]+) s it does not diverge here", found)[0])
    with Simulation(with_steps(made, round(1 / 25 / finer)), threads=device.threads) as simulation:
        simulation.advance(3)


def test_a_machine_that_makes_errors_is_told_of(device: Device, message: Messages) -> None:
    def flip(simulation: Simulation) -> None:
        simulation.advance(3)
        simulation.restore(with_fault(simulation.save(), "displacement", np.nan, np.random.default_rng(1)))

    made = pressed()
    found = diagnosed(made, device, flip)
    message(found.message, "machine", "--resume", hide=r"(?<=step )\d+|(?<=point )\(.*?\)")
    assert found.last_sound_state
    assert found.last_sound_state.progress.frame == 1, "where it was saved"
    with Simulation(made, threads=device.threads) as simulation:
        simulation.restore(found.last_sound_state)
        simulation.advance(made.time.frames - simulation.frame)
        resumed = simulation.positions()
    with Simulation(made, threads=device.threads) as simulation:
        simulation.advance(made.time.frames)
        np.testing.assert_array_equal(simulation.positions(), resumed)


def test_how_far_a_point_may_be() -> None:
    # 0.05 N on 1 g is 50 m/s^2; the sheet is 0.4 m long.
    probes = [{"force": [0, 0, 0.05], "falloff": 0, "offset": 0}]
    assert displacement_bound(plan_of(scene(probes=probes)), 3.0) == pytest.approx(10 * 0.4)
    loose = {"sheet": {**SHEET, "fixed": "none"}, "springs": {"structural": 20}}, {"springs": {"shear": 20}}
    for sections in loose:
        flying = displacement_bound(plan_of(scene(probes=probes, **sections)), 3.0)
        assert flying == pytest.approx(10 * 0.4 + 50 * 3.0**2 / 2)
    assert displacement_bound(plan_of(scene(probes=probes, springs={"virtual": 1})), 3.0) == math.inf


def released(across: float, down: float, active: str) -> Scene:
    """A rod that crushes tissue without damping at this place, and is away from 0.3 s on."""
    way = [[0, 0, 0, 0.0005], [0.12, 0, 0, -0.0053], [0.2, 0.04, 0.1, -0.0053], [0.3, 0, 0, 0.05]]
    path = [[t, across + x, down + y, height] for t, x, y, height in way]
    rod = moved(*path, instrument={"radius": 0.006, "shaft": [0, 0, 1], "length": 0.15})
    tissue = {"young": 3e5, "thickness": 3.2e-3, "density": 1050, "foundation": 1e6, "pretension": 200}
    sheet, time = {"points": [15, 9], "size": [0.045, 0.026]}, {"duration": 0.8}
    tissue |= {"foundation_active": active}  # type: ignore[dict-item]
    return scene(sheet=sheet, springs=None, damping=0, tissue=tissue, probes=[rod], time=time)


@pytest.mark.parametrize("active", ["always", "loaded"])
def test_energy_that_grows_without_a_load_is_noted(active: str, device: Device, message: Messages) -> None:
    # Near the border, springs that are pressed together are stiffer than the step limit assumes.
    for across, down, grows in ((0.76, 0.78, True), (0.5, 0.45, False)):
        made = released(across, down, active)
        with Simulation(made, device.arch) as simulation:
            simulation.advance(20)
            progress = simulation.progress
        assert progress.energy_growth > (3 if grows else 0)
        notes = [note for note in notes_of(made, progress, None) if note.startswith("the energy grew")]
        message(notes, *(["after 0.3 s"] if grows else []), hide=r"[\d.]+(?= times)")
