"""Hard cases for numerical stability, the scenes of tests/hard: error estimates, invariances and energy.

Errors are of displacements, as fractions of the largest one of the run, as in `taichi_msm.accuracy.time_step`.
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

# Their 10^6 steps leave no known phase; only their energy is tested.
LONG = {"limit", "undamped"}
SHORT = sorted(path.stem for path in FOLDER.glob("*.yaml") if path.stem not in LONG)


def hard(name: str) -> Scene:
    return load_scene(FOLDER / f"{name}.yaml", ["time.precision=f32"])


def changed(scene: Scene, **sections: dict[str, Any]) -> Scene:
    """The scene with some keys of its sections replaced."""
    parts = {name: getattr(scene, name).model_copy(update=keys) for name, keys in sections.items()}
    return scene.model_copy(update=parts)


def longest(vectors: Array) -> float:
    return float(np.linalg.norm(vectors, axis=-1).max())


def reference_run(scene: Scene, device: Device) -> tuple[Array, float]:
    """Displacements extrapolated from f64 runs with 8 and 16 times the steps, and the difference of these runs.

    A third of the difference is the error of the finer run. The error of the extrapolation, of order 4, is far smaller.
    """
    steps, in_f64 = plan_of(scene).grid.steps_per_frame, changed(scene, time={"precision": "f64"})
    coarse, fine = (frames(in_f64, device, n * steps) for n in (8, 16))
    exact = fine + (fine - coarse) / 3
    return exact, longest(fine - coarse) / longest(exact)


@pytest.mark.parametrize("name", SHORT)
def test_error_and_progress(name: str, device: Device) -> None:
    """The estimated error bounds the true one; of all cases only the pinch compresses springs to less than half."""
    scene = hard(name)
    exact, difference = reference_run(scene, device)
    run_frames, estimate = frames(scene, device), estimate_error(plan_of(scene), device)
    assert estimate.order == 2
    # At order 2 the runs with 8 and 16 times the steps differ by (1/64 - 1/256) = 1/85 of the error.
    assert difference < estimate.error / 16, "the reference has converged"
    # The estimate omits the next power of h, at most half of the error for converging companion runs.
    assert longest(run_frames - exact) / longest(exact) <= 1.5 * estimate.error + difference
    # Half a pixel in a sheet 100 pixels wide that moves by a fifth of that.
    assert estimate.error < 0.025
    # Each step in f32 rounds the displacement once.
    assert estimate.rounding < F32 * plan_of(scene).grid.steps
    largest = longest(run_frames)
    with Simulation(scene, device.arch, device.threads) as run:
        run.advance(scene.time.frames)
        assert (run.progress.shortest_spring < 0.5) == (name == "pinch")
        # Three squares, their sum and its root in f32.
        assert run.progress.max_displacement == pytest.approx(largest, rel=4 * F32)


@pytest.mark.parametrize(
    ("name", "metres", "seconds"),
    [("micrometre", 2.0**20, 1.0), ("kilometre", 2.0**-10, 1.0), ("light", 1.0, 2.0**15), ("heavy", 1.0, 2.0**-5)],
)
def test_units_preserve_bits(name: str, metres: float, seconds: float, device: Device) -> None:
    """Units of length and time scaled by powers of 2 do not change the rounding.

    With the same stiffness [N/m], mass scales with the time squared, damping with the time, force with the length.
    Nothing may under- or overflow, or be compared with a constant that has a unit.
    """
    scene = hard(name)
    (probe,) = scene.probes
    force, falloff = metres * probe_force(probe, scene.sheet).force[2], probe.falloff / metres
    load = tuple((t * seconds, percent) for t, percent in probe.load)
    height, width = scene.sheet.size
    converted = changed(
        scene,
        sheet={"size": (height * metres, width * metres), "mass": plan_of(scene).material.mass * seconds**2},
        time={
            "duration": scene.time.duration * seconds,
            "frames_per_second": scene.time.frames_per_second / seconds,
        },
    ).model_copy(
        update={
            "damping": scene.damping * seconds,
            "probes": (probe.model_copy(update={"force": (0.0, 0.0, force), "falloff": falloff, "load": load}),),
        }
    )
    plain, scaled = frames(scene, device), frames(converted, device)
    assert plain.any()
    assert (scaled / metres).tobytes() == plain.tobytes()


@pytest.mark.parametrize("name", ["on_point", "between_points"])
def test_symmetry_under_a_central_load(name: str, device: Device) -> None:
    scene = hard(name)
    u = frames(scene, device)
    # Forces are summed in another order on the opposite side, with one rounding per step.
    tolerance = F32 * plan_of(scene).grid.steps * longest(u)
    assert longest(u - u[:, :, ::-1] * [-1, 1, 1]) <= tolerance, "left and right"
    assert longest(u - u[:, ::-1] * [1, -1, 1]) <= tolerance, "top and bottom"
    assert longest(u + u.swapaxes(1, 2)[..., [1, 0, 2]] * [1, 1, -1]) <= tolerance, "rows and columns"
    first, middle = u[0], np.array(scene.sheet.points) // 2
    assert np.linalg.norm(first[tuple(middle)]) >= longest(first) - tolerance, "largest under the load"


def shadow_energy(scene: Scene, before: Array, after: Array) -> float:
    """The energy that steps conserve to h^4 [J], for the middle x of a step and its difference quotient v.

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
def test_energy_over_a_million_steps(name: str, device: Device) -> None:
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
    # The shadow energy of a mode of frequency w oscillates by theta^4 / 24 / (1 - theta^2 / 4) with theta = w h, 5 %
    # if all energy is in the highest mode.
    if name == "undamped":
        theta = 2 * grid.step / limit
        assert max(energy) / min(energy) < 1 + theta**4 / 24 / (1 - theta**2 / 4)
    # At the limit this is not a bound, but an instability grows in every step, here by less than ln 2 / (5 10^5).
    half = len(energy) // 2
    for values in (energy, reach):
        assert max(values[half:]) < 2 * max(values[:half])
    # Positions of single mass points are unknown after a tenth of these steps, as the estimate shows.
    tenth = changed(scene, time={"duration": scene.time.duration / 10})
    assert estimate_error(plan_of(tenth), device).error > 0.5
