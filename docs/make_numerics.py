"""Write docs/numerics.md and its picture: results of the program against independent solutions.

    PYTHONPATH=. python docs/make_numerics.py

Takes some minutes; nothing is timed.
"""

from __future__ import annotations

import math
from pathlib import Path
from typing import Any

import numpy as np
from matplotlib import style
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from numpy.typing import NDArray
from scipy.optimize import brentq
from scipy.sparse import csc_array
from scipy.sparse.linalg import eigsh, spsolve
from scipy.special import k0, k1

from taichi_msm import Scene, load_scene
from taichi_msm.accuracy.time_step import TimeStepTrials, max_norm
from taichi_msm.model.loads import evaluate_loads
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import fixed_points, rest_positions, spacing
from taichi_msm.model.time_grid import Precision
from taichi_msm.plot_style import BLUE, DPI, GREY, PALE, STYLE, TWO_COLUMN_WIDTH, VERMILION
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import make_plan
from taichi_msm.solver.rest import QuasiStatics
from taichi_msm.solver.state import State
from taichi_msm.study.format import markdown_table
from taichi_msm.system import runtime
from tests import reference

ROOT = Path(__file__).parent.parent
PAGE, TEMPLATE = ROOT / "docs" / "numerics.md", ROOT / "docs" / "numerics.template"
IMAGES = ROOT / "docs" / "images"

Array = NDArray[np.float64]

STIFFER = (1, 2, 5, 10)
BUCKLING = 5
ENERGY_STEPS = 100_000
MODES = 6

# Distance of a stepped sheet from equilibrium, relative to the largest displacement.
CLOSE = 1e-6

# Points per side of the indented sheets.
INDENTED = (61, 121, 241)


def press(*overrides: str) -> Scene:
    """Load the press of springs."""
    return load_scene(ROOT / "docs" / "springs.yaml", ["output=[]", *overrides])


def stiffer(times: int) -> Scene:
    """Return the press with stiffer springs and the same virtual ones."""
    sheet = make_plan(press()).material
    return press(f"springs.structural={times * sheet.across}", f"springs.shear={times * sheet.shear}")


def motion(plan: Plan) -> Array:
    """Return the displacements of every frame but the first, with the rounding of the trajectory."""
    dynamics = Dynamics(plan, runtime.current_device())
    rest, frames = rest_positions(plan.scene.sheet), []
    for _ in range(plan.grid.frames):
        dynamics.advance(plan.grid.steps_per_frame)
        u = dynamics.displacement()
        # The trajectory of f32 has positions.
        frames.append((rest + u).astype(u.dtype) - rest)
    dynamics.close()
    return np.array(frames)


def truth(plan: Plan) -> Array:
    """Extrapolate displacements in float64 to a step of 0."""
    counts = (n * plan.grid.steps_per_frame for n in (8, 16))
    coarse, fine = (motion(plan.with_grid(steps_per_frame=count, precision="f64")) for count in counts)
    return fine + (fine - coarse) / 3


def silent_table() -> str:
    """Table of the errors in f32 and with `auto`, and of the estimated error."""
    faint = load_scene(ROOT / "tests" / "hard" / "faint.yaml")
    cases = {f"springs {times} × as stiff": stiffer(times) for times in STIFFER}
    cases |= {"`faint`, displacements of 10 nm": faint}
    rows = []
    for name, scene in cases.items():
        plan = make_plan(scene)
        exact = truth(plan)
        largest = max_norm(exact)
        errors = [max_norm(motion(each) - exact) / largest for each in (plan.with_grid(precision="f32"), plan)]
        estimate = TimeStepTrials(plan, runtime.current_device()).estimate(plan.grid.steps_per_frame).error
        rows.append([name, *(f"{error:.2g}" for error in errors), f"{estimate:.2g}", plan.grid.precision])
    return markdown_table(
        ["run", "error in f32", "error with auto", "estimated error", "auto takes"], rows, left_columns=(0, 4)
    )


def stiffness(scene: Scene, displacement: Array, active: float) -> csc_array:
    """Return the second derivatives of the energy by the coordinates of all points that move [N/m]."""
    moves = np.repeat(~fixed_points(scene.sheet).ravel(), 3)
    return reference.stiffness(scene, displacement, active)[moves][:, moves]


def forces(scene: Scene, displacement: Array, t: float) -> Array:
    """Return the forces on the points that move at a time [s] without damping [N], flat."""
    loads = evaluate_loads(make_plan(scene), np.array([t]))
    return reference.force(scene, displacement, loads, 0)[~fixed_points(scene.sheet)].ravel()


def lowest(matrix: csc_array, below: float, count: int = 1) -> tuple[Array, Array]:
    """Return the smallest eigenvalues and their vectors; `below` is a lower bound."""
    values, vectors = eigsh(matrix, k=count, sigma=below, which="LM", tol=1e-9)
    assert values.min() > below
    order = np.argsort(values)
    return values[order], vectors[:, order]


def buckling() -> dict[str, Any]:
    """Compute and draw the smallest eigenvalue during a stiffer press, and its mode."""
    scene = stiffer(BUCKLING)
    plan = make_plan(scene).with_grid(precision="f64")
    grid, dynamics = plan.grid, Dynamics(plan, runtime.current_device())
    moves = ~fixed_points(scene.sheet)
    times, values, modes = [], [], []
    for frame in range(grid.frames + 1):
        if frame:
            dynamics.advance(grid.steps_per_frame)
        t = frame / scene.time.frames_per_second
        active = float(evaluate_loads(make_plan(scene), np.array([t])).active[0])
        value, vector = lowest(stiffness(scene, dynamics.displacement(), active), below=-6.0)
        mode = np.zeros((*scene.sheet.points, 3))
        mode[moves] = vector[:, 0].reshape(-1, 3)
        times.append(t)
        values.append(float(value[0]))
        modes.append(mode)
    dynamics.close()
    worst = int(np.argmin(values))
    mode = modes[worst]
    component = int(np.abs(mode).max(axis=(0, 1)).argmax())
    row, column = np.unravel_index(np.abs(mode[..., component]).argmax(), mode.shape[:2])
    window = np.s_[max(0, row - 10) : row + 11, max(0, column - 10) : column + 11]
    largest = np.abs(mode[..., component]).max()
    load = np.array(scene.probes[0].load)

    with style.context(STYLE, after_reset=True):
        figure = Figure(figsize=(TWO_COLUMN_WIDTH, 3.4), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        left, right = figure.subplots(1, 2, width_ratios=(1.7, 1))
        left.axhline(0, color=GREY, linewidth=0.8)
        left.axvspan(load[0, 0], load[-1, 0], color=PALE, zorder=0)
        left.annotate("loaded", (load[-1, 0] / 2, 0.97), xycoords=("data", "axes fraction"), ha="center", va="top")
        left.plot(times, values, "o-", color=BLUE, markersize=4)
        left.plot(times[worst], values[worst], "o", color=VERMILION, markersize=8)
        left.annotate("the mode on the right", (times[worst] + 0.03, values[worst]), va="center", color=VERMILION)
        left.set(title="Smallest eigenvalue of the stiffness", xlabel="time [s]", ylabel="N/m; unstable below 0")
        left.set_ylim(top=1.3)
        right.imshow(mode[..., component][window], cmap="PuOr", vmin=-largest, vmax=largest)
        right.set(title=f"Its mode, close up ({'xyz'[component]})", xticks=[], yticks=[])
        figure.savefig(IMAGES / "numerics-buckling.png", format="png")
    return {"buckled": f"{values[worst]:.2g}", "unloaded": f"{values[0]:.2g}"}


def energy() -> dict[str, Any]:
    """Measure the energy of an undamped sheet over many steps."""
    press_time, every, rows = 0.2, 20, []
    scene = load_scene(ROOT / "tests" / "hard" / "undamped.yaml", [f"time.duration={ENERGY_STEPS}"])
    assert scene.springs is not None
    base = scene.model_copy(update={"springs": scene.springs.model_copy(update={"virtual": 0.0})})
    h = 0.1 * make_plan(base).stable_step
    probe = scene.probes[0].model_copy(update={"load": [[0, 0], [press_time, 100], [press_time, 0]]})
    rate = 1 / (every * h)
    made = base.model_copy(update={"probes": (probe,)})
    time = {"duration": ENERGY_STEPS // every / rate, "frames_per_second": rate, "step": h, "tolerance": None}
    made = made.model_copy(update={"time": made.time.model_copy(update=time)})
    kinds: tuple[Precision, ...] = "f32", "f64"
    for kind in kinds:
        dynamics = Dynamics(make_plan(made).with_grid(precision=kind), runtime.current_device())
        energies = []
        for _ in range(ENERGY_STEPS // every):
            dynamics.advance(every)
            energies.append(dynamics.read().energy)
        dynamics.close()
        steps = every * np.arange(1, len(energies) + 1)
        released = np.array(energies)[steps * h > press_time + every * h]
        mean = released.mean()
        tenth = len(released) // 10
        drift = released[-tenth:].mean() / released[:tenth].mean() - 1
        swing = np.abs(released / mean - 1).max()
        rows.append([kind, f"{mean:.4g} J", f"{100 * swing:.2g} %", f"{100 * drift:+.1g} %"])
    return {
        "energy_points": " × ".join(map(str, made.sheet.points)),
        "energy_press": press_time,
        "energy_steps": f"{ENERGY_STEPS:,}",
        "energy_share": f"{h / make_plan(made).stable_step:g}",
        "energy_table": markdown_table(
            ["precision", "mean energy", "largest swing", "last tenth of the time, against the first"],
            rows,
            left_columns=(0,),
        ),
    }


def static() -> dict[str, Any]:
    """Compare the settled shape under a load with Newton's method."""
    seconds = 6
    scene = press(
        "probes.0.load=[[0, 0], [0.36, 100]]", f"time.duration={seconds}", "damping=0.04", "time.precision=f64"
    )
    plan = make_plan(scene)
    dynamics = Dynamics(plan, runtime.current_device())
    dynamics.advance(plan.grid.steps)
    stepped = dynamics.displacement()
    dynamics.close()
    moves = ~fixed_points(scene.sheet)
    # Newton's method needs a start nearby, but not the answer.
    u = 0.97 * stepped
    for _ in range(60):
        residual = forces(scene, u, float(seconds))
        u[moves] += spsolve(stiffness(scene, u, 1.0), residual).reshape(-1, 3)
    return {
        "static_seconds": seconds,
        "static_error": f"{max_norm(stepped - u) / max_norm(u):.1g}",
        "static_depth": f"{1000 * max_norm(u):.1f}",
        "static_residual": f"{np.abs(forces(scene, u, float(seconds))).max():.1g}",
    }


def at_rest() -> dict[str, Any]:
    """Count force evaluations of `motion: quasistatic`, and steps to the same shape."""
    press, sides = "scenes/press.yaml", (31, 61, 121)
    held = ["probes.0.load=[[0, 100]]", "output=[]", "time.duration=1", "time.frames_per_second=100"]
    changes = {
        "the press, held": [],
        "a plate instead of tension": ["tissue.pretension=0", "tissue.bending=plate"],
        "pulled along, without tension": ["tissue.pretension=0", "probes.0.total=[2, 0, 0]"],
    }
    rows = []
    for name, change in changes.items():
        counts = [name]
        for side in sides:
            points = f"sheet.points=[{side}, {side}]"
            scene = load_scene(ROOT / press, [*held, *change, points, "time.motion=quasistatic"])
            still = QuasiStatics(make_plan(scene), runtime.current_device())
            still.advance(0)
            counts.append(f"{still.evaluations}")
            if not change:
                moving = Dynamics(
                    make_plan(load_scene(ROOT / press, [*held, points, "time.precision=f64"])), runtime.current_device()
                )
                settled = still.displacement()
                while max_norm(moving.displacement() - settled) > CLOSE * max_norm(settled):
                    moving.advance(16)
                counts[-1] += f" ({moving.steps_done} steps)"
                moving.close()
            if side == sides[0] and name.startswith("pulled"):
                lifted = 1000 * float(np.abs(still.displacement()[..., 2]).max())
            still.close()
        rows.append(counts)
    head = ["force evaluations for a frame", *(f"{side} × {side}" for side in sides)]
    return {"rest_table": markdown_table(head, rows), "rest_close": f"{CLOSE:.0e}", "rest_lifted": f"{lifted:.1f}"}


def indentation() -> dict[str, Any]:
    """Compare the force of a round tip in a membrane on a foundation, in equilibrium, with the closed form."""
    tension, foundation, radius, depths = 25.0, 4e5, 0.04, (1e-4, 2e-4, 4e-4)
    fades, count = math.sqrt(tension / foundation), len(depths)
    rod = {"radius": radius, "shaft": [0, 0, 1], "length": 0.1}
    path = [[0, 0.5, 0.5, 0.0], *([n + 1, 0.5, 0.5, -depth] for n, depth in enumerate(depths))]
    held = {"young": 3e4, "thickness": 3e-3, "pretension": tension, "foundation": foundation}
    rows = [[f"{1000 * depth:g} mm", f"{resistance(depth, radius, tension, foundation):.4g} N"] for depth in depths]
    for side in INDENTED:
        scene = Scene(
            sheet={"points": [side, side], "size": [0.1, 0.1]},
            tissue={**held, "foundation_active": "always"},
            probes=[{"path": path, "instrument": rod}],
            time={"motion": "quasistatic", "duration": count, "frames_per_second": 1},
            output=[],
        )
        rest = QuasiStatics(make_plan(scene), runtime.current_device())
        for row, depth in zip(rows, depths, strict=True):
            rest.advance(1)
            error = -rest.tool_forces()[0, 2] / resistance(depth, radius, tension, foundation) - 1
            row.append(f"{100 * error:+.2g} %")
        rest.close()
    head = ["depth", "force", *(f"{side} × {side}" for side in INDENTED)]
    facts = {"tension": f"{tension:g}", "foundation": f"{foundation / 1e3:g}", "radius": f"{1000 * radius:g}"}
    facts["fades"] = f"{1000 * fades:.1f}"
    return {f"tip_{name}": fact for name, fact in facts.items()} | {"tip_table": markdown_table(head, rows)}


def resistance(depth: float, radius: float, tension: float, foundation: float) -> float:
    """Return the force of a round tip on an infinite membrane on a foundation [N].

    S w'' = K w, so that w is K0(r / l), l^2 = S / K, outside the contact circle, and a paraboloid inside.

    Args:
        depth: depth of the tip [m].
        radius: radius of the tip [m].
        tension: S [N/m].
        foundation: K [N/m3].
    """
    fades = math.sqrt(tension / foundation)

    def depth_of(c: float) -> float:
        return float(c / radius * fades / k1(c / fades) * k0(c / fades) + c**2 / (2 * radius))

    c = brentq(lambda c: depth_of(c) - depth, 1e-9, radius / 2)
    below = foundation * (math.pi * c**2 * depth - math.pi * c**4 / (4 * radius))
    return float(below + tension * 2 * math.pi * c * c / radius)


def frequencies() -> dict[str, Any]:
    """Compare small motions with the phases of their modes."""
    scene = press("springs.virtual_active=always", "damping=0", "time.precision=f64", "probes=[]", "time.duration=0.8")
    plan = make_plan(scene)
    moves, grid = ~plan.fixed, plan.grid
    values, vectors = lowest(stiffness(scene, np.zeros((*scene.sheet.points, 3)), 1.0), 0.0, MODES)
    rows = []
    dynamics = Dynamics(plan, runtime.current_device())
    for value, vector in zip(values, vectors.T, strict=True):
        w = math.sqrt(value / plan.material.mass)
        theta = 2 * math.asin(w * grid.step / 2)
        shape = np.zeros((*scene.sheet.points, 3))
        shape[moves] = 1e-6 * spacing(scene.sheet)[0] * vector.reshape(-1, 3) / np.abs(vector).max()
        # u_0 of u_n = cos(n theta), and the difference from u_{-1}; a first step from rest would differ.
        dynamics.restart(plan, State(1, shape, shape * (1 - math.cos(theta))))
        dynamics.advance(grid.steps)
        amplitude = float((dynamics.displacement() * shape).sum() / (shape * shape).sum())
        expected = math.cos(grid.steps * theta)
        error = f"{abs(amplitude - expected):.0e}"
        rows.append([f"{w / (2 * math.pi):.4f}", f"{expected:+.9f}", f"{amplitude:+.9f}", error])
    dynamics.close()
    head = ["frequency [Hz]", "cos(n theta)", "amplitude after n steps", "difference"]
    return {"modes": MODES, "modes_table": markdown_table(head, rows)}


def main() -> None:
    """Compute, draw, and write the page."""
    runtime.start("cpu")
    facts: dict[str, Any] = {}
    for part in (frequencies, static, at_rest, indentation, energy, buckling, lambda: {"silent_table": silent_table()}):
        facts |= part()
        print(facts, flush=True)
    PAGE.write_text(TEMPLATE.read_text(encoding="utf-8").format(**facts), encoding="utf-8")


if __name__ == "__main__":
    main()
