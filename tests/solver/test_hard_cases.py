"""The hard cases for numerical stability, scenes in tests/hard: each stays right with a known error, or says otherwise.

Errors are of displacements, and fractions of the largest one of the run, as in `taichi_msm.accuracy.time_step`.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from taichi_msm.load.scene_file import load_scene
from taichi_msm.model import sheet
from taichi_msm.model.tool_force import probe_force
from taichi_msm.runs.simulation import Simulation
from taichi_msm.scene.scene import Scene
from taichi_msm.system.runtime import Device
from tests import reference
from tests.motion import dynamics_of, estimate_error, frames
from tests.scenes import plan_of

Array = NDArray[np.float64]

FOLDER = Path(__file__).parent.parent / "hard"
F32, F64 = 2.0**-24, 2.0**-53

# Without phase after 10^6 steps: what holds of them is tested apart.
LONG = {"limit", "undamped"}
SHORT = sorted(path.stem for path in FOLDER.glob("*.yaml") if path.stem not in LONG)


def hard(name: str) -> Scene:
    return load_scene(FOLDER / f"{name}.yaml", ["time.precision=f32"])


def changed(scene: Scene, **sections: dict[str, Any]) -> Scene:
    """The scene with some keys of its sections replaced."""
    parts = {name: getattr(scene, name).model_copy(update=keys) for name, keys in sections.items()}
    return scene.model_copy(update=parts)


def in_double(scene: Scene) -> Scene:
    return changed(scene, time={"precision": "f64"})


def longest(vectors: Array) -> float:
    return float(np.linalg.norm(vectors, axis=-1).max())


def truth(scene: Scene, cut: int, device: Device) -> tuple[Array, float]:
    """Extrapolate runs in float64 at 8 and 16 times so many steps a frame, and say how far they are apart.

    The extrapolation's own error is of order 4: far below a third of this doubt, which is the error of the finer run.
    """
    coarse, fine = (frames(in_double(scene), device, n * cut) for n in (8, 16))
    exact = fine + (fine - coarse) / 3
    return exact, longest(fine - coarse) / longest(exact)


def test_the_cases_are_as_hard_as_they_say(root: Path) -> None:
    paper, stiff = plan_of(load_scene(root / "scenes/figure-3.yaml")).material, plan_of(hard("stiff")).material
    assert (stiff.across, stiff.shear) == pytest.approx((1e4 * paper.across, 1e4 * paper.shear))
    assert max(percent for _, percent in hard("overload").probes[0].load) == 1000
    damped = hard("overdamped")
    assert plan_of(damped).material.drag * plan_of(damped).grid.step > 2
    assert damped.time.damping_difference == "central"
    for path in FOLDER.glob("*.yaml"):
        scene = load_scene(path)
        assert (scene.output, scene.image, scene.time.precision) == ((), None, "auto")


@pytest.mark.parametrize("name", SHORT)
def test_the_error_is_small_and_known(name: str, device: Device) -> None:
    scene = hard(name)
    exact, doubt = truth(scene, plan_of(scene).grid.steps_per_frame, device)
    error = longest(frames(scene, device) - exact) / longest(exact)
    estimate = estimate_error(plan_of(scene), device)
    assert estimate.order == 2
    # At order 2 the runs at 8 and 16 times the steps differ by (1/64 - 1/256) of the error at once: 1/85.
    assert doubt < estimate.error / 16, "the reference has converged"
    # The estimate leaves out the next power of h: at most half of the error where the pilots have begun to converge.
    assert error <= 1.5 * estimate.error + doubt
    # Half a pixel where the sheet is 100 pixels wide and moves by a fifth of that: not to be seen.
    assert estimate.error < 0.025
    # A step in f32 rounds once the displacement, and the roundings of all steps to one side would be this.
    assert estimate.rounding < F32 * plan_of(scene).grid.steps


@pytest.mark.parametrize("name", SHORT)
def test_only_the_pinch_is_noted(name: str, device: Device) -> None:
    scene = hard(name)
    largest = longest(frames(scene, device))
    with Simulation(scene, device.arch, device.threads) as run:
        run.advance(scene.time.frames)
        assert (run.progress.shortest_spring < 0.5) == (name == "pinch")
        # Three squares, their sum and its root in f32.
        assert run.progress.max_displacement == pytest.approx(largest, rel=4 * F32)


@pytest.mark.parametrize(
    ("name", "metres", "seconds"),
    [("micrometre", 2.0**20, 1.0), ("kilometre", 2.0**-10, 1.0), ("light", 1.0, 2.0**15), ("heavy", 1.0, 2.0**-5)],
)
def test_other_units_give_the_same_bits(name: str, metres: float, seconds: float, device: Device) -> None:
    # Lengths and times in units that are powers of 2, with stiffness in N/m as it is, round in the same way: mass goes
    # with the time squared, damping with the time, force with the length. Nothing may under- or overflow, or be
    # compared with a number that has a unit.
    scene = hard(name)
    (probe,) = scene.probes
    here, there = metres * probe_force(probe, scene.sheet).force[2], probe.falloff / metres
    load = tuple((t * seconds, percent) for t, percent in probe.load)
    height, width = scene.sheet.size
    other = changed(
        scene,
        sheet={"size": (height * metres, width * metres), "mass": plan_of(scene).material.mass * seconds**2},
        time={
            "duration": scene.time.duration * seconds,
            "frames_per_second": scene.time.frames_per_second / seconds,
        },
    ).model_copy(
        update={
            "damping": scene.damping * seconds,
            "probes": (probe.model_copy(update={"force": (0.0, 0.0, here), "falloff": there, "load": load}),),
        }
    )
    plain, scaled = frames(scene, device), frames(other, device)
    assert plain.any()
    assert (scaled / metres).tobytes() == plain.tobytes()


@pytest.mark.parametrize("name", ["on_point", "between_points"])
def test_a_load_on_the_axes_keeps_the_sheet_symmetric(name: str, device: Device) -> None:
    scene = hard(name)
    u = frames(scene, device)
    # Forces are summed in another order on the other side: a rounding a step, at worst all to one side.
    tolerance = F32 * plan_of(scene).grid.steps * longest(u)
    assert longest(u - u[:, :, ::-1] * [-1, 1, 1]) <= tolerance, "left and right"
    assert longest(u - u[:, ::-1] * [1, -1, 1]) <= tolerance, "top and bottom"
    assert longest(u + u.swapaxes(1, 2)[..., [1, 0, 2]] * [1, 1, -1]) <= tolerance, "rows and columns"
    first, middle = u[0], np.array(scene.sheet.points) // 2
    assert np.linalg.norm(first[tuple(middle)]) >= longest(first) - tolerance, "deepest where it is pressed"


def shadow_energy(scene: Scene, before: Array, after: Array) -> float:
    """The energy that a step conserves to h^4 [J], from the middle x of a step and its difference quotient v.

    m v^2 / 2 + V(x) + h^2 (|F(x)|^2 / (12 m) - v V''(x) v / 24)    Hairer, Lubich, Wanner 2003, Acta Numerica 12
    """
    h, m = plan_of(scene).grid.step, plan_of(scene).material.mass
    v, middle = (after - before) / h, (before + after) / 2

    def force(u: Array) -> Array:
        return reference.elastic_force(scene, u) * ~sheet.fixed_points(scene.sheet)[..., None]

    curvature = -float(((after - before) * (force(after) - force(before))).sum())
    kinetic = m / 2 * float((v**2).sum())
    return (
        kinetic + reference.energy(scene, middle) + h**2 / (12 * m) * float((force(middle) ** 2).sum()) - curvature / 24
    )


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(LONG))
def test_a_million_steps_keep_the_energy(name: str, device: Device) -> None:
    scene = hard(name)
    grid, limit = plan_of(scene).grid, plan_of(scene).stable_step
    assert grid.steps == 10**6
    assert grid.step / limit == pytest.approx({"limit": 0.99, "undamped": 0.495}[name], rel=1e-4)
    dynamics = dynamics_of(scene, device)
    energy, reach = [], []
    for _ in range(scene.time.frames):
        dynamics.advance(grid.steps_per_frame - 1)
        before = dynamics.displacement().astype(float)
        dynamics.advance(1)
        after = dynamics.displacement().astype(float)
        energy.append(shadow_energy(scene, before, after))
        reach.append(longest(after))
    # The shadow energy of a mode of frequency w swings by theta^4 / 24 / (1 - theta^2 / 4) with theta = w h: 5 %, far
    # below the limit, if all of the energy were in the highest mode.
    if name == "undamped":
        theta = 2 * grid.step / limit
        assert max(energy) / min(energy) < 1 + theta**4 / 24 / (1 - theta**2 / 4)
    # At the limit it is no bound, but what is unstable grows in every step: here by less than ln 2 / (5 10^5).
    half = len(energy) // 2
    for values in (energy, reach):
        assert max(values[half:]) < 2 * max(values[:half])
    # Where single points are is not known after so long; and the estimate says so, already after a tenth.
    tenth = changed(scene, time={"duration": scene.time.duration / 10})
    assert estimate_error(plan_of(tenth), device).error > 0.5
