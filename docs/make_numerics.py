"""Write docs/numerics.md and its pictures: what the program computes beside independent solutions.

    PYTHONPATH=. python docs/make_numerics.py

It takes some minutes; nothing in it is timed.
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
from scipy.sparse import coo_matrix, csc_matrix, identity
from scipy.sparse.linalg import eigsh, spsolve
from scipy.special import k0, k1

from taichi_msm import Scene, load_scene
from taichi_msm.accuracy.time_step import TimeStepTrials, max_norm
from taichi_msm.model.loads import decay, evaluate_loads
from taichi_msm.model.plan import Plan
from taichi_msm.model.sheet import fixed_points, rest_positions, spacing
from taichi_msm.model.time_grid import Precision
from taichi_msm.plot_style import BLUE, DPI, GREY, STYLE, TWO_COLUMN_WIDTH, VERMILION
from taichi_msm.solver.dynamics import Dynamics
from taichi_msm.solver.planning import make_plan
from taichi_msm.solver.rest import QuasiStatics
from taichi_msm.solver.state import State
from taichi_msm.study.format import markdown_table
from taichi_msm.system import runtime

ROOT = Path(__file__).parent.parent
PAGE, TEMPLATE = ROOT / "docs" / "numerics.md", ROOT / "docs" / "numerics.template"
IMAGES = ROOT / "docs" / "images"

Array = NDArray[np.float64]

STIFFER = (1, 2, 5, 10)
BUCKLING = 5
ENERGY_STEPS = 100_000
MODES = 6

# How close to the sheet at rest a stepped one must come, of the largest displacement; it is compared every few steps.
CLOSE, STRIDE = 1e-6, 16

# The points a side of the sheets that a round tip is pressed into.
INDENTED = (61, 121, 241)

# Springs of which every one is counted once: down, right.
HALF = ((0, 1), (1, 0), (1, 1), (1, -1))


def press(*overrides: str) -> Scene:
    """Load the press in springs."""
    return load_scene(ROOT / "docs" / "springs.yaml", ["output=[]", *overrides])


def stiffer(times: int) -> Scene:
    """Make the springs of the press stiffer, but not the virtual ones."""
    sheet = make_plan(press()).material
    return press(f"springs.structural={times * sheet.across}", f"springs.shear={times * sheet.shear}")


def motion(plan: Plan) -> Array:
    """Displacements of every frame but the first, as they are written."""
    dynamics = Dynamics(plan, runtime.current_device())
    rest, frames = rest_positions(plan.scene.sheet), []
    for _ in range(plan.grid.frames):
        dynamics.advance(plan.grid.steps_per_frame)
        u = dynamics.displacement()
        # In f32 the trajectory has positions.
        frames.append((rest + u).astype(u.dtype) - rest)
    dynamics.close()
    return np.array(frames)


def truth(plan: Plan) -> Array:
    """Extrapolate in float64, from displacements."""
    counts = (n * plan.grid.steps_per_frame for n in (8, 16))
    coarse, fine = (motion(plan.with_grid(steps_per_frame=count, precision="f64")) for count in counts)
    return fine + (fine - coarse) / 3


def silent_table() -> str:
    """Compare f32, the precision of `auto`, and the error that is told."""
    faint = load_scene(ROOT / "tests" / "hard" / "faint.yaml")
    cases = {f"springs {times} × as stiff": stiffer(times) for times in STIFFER}
    cases |= {"`faint`, displacements of 10 nm": faint}
    rows = []
    for name, scene in cases.items():
        plan = make_plan(scene)
        exact = truth(plan)
        largest = max_norm(exact)
        errors = [max_norm(motion(one) - exact) / largest for one in (plan.with_grid(precision="f32"), plan)]
        told = TimeStepTrials(plan, runtime.current_device()).estimate(plan.grid.steps_per_frame).error
        rows.append([name, *(f"{error:.2g}" for error in errors), f"{told:.2g}", plan.grid.precision])
    return markdown_table(
        ["run", "error in f32", "error with auto", "error told", "auto takes"], rows, left_columns=(0, 4)
    )


def stiffness(scene: Scene, displacement: Array, active: float) -> csc_matrix:
    """Assemble the second derivative of the energy over the coordinates of all points that move [N/m].

    The scene is in springs, so that K is the same at all points. A spring of direction n and lengths L and L0 adds
    k ((1 - L0 / L) (I - n n^T) + n n^T) between its ends.
    """
    rows, cols = scene.sheet.points
    dx, dy = spacing(scene.sheet)
    x = rest_positions(scene.sheet) + displacement
    number = np.arange(rows * cols).reshape(rows, cols)
    parts = []
    for down, right in HALF:
        k = make_plan(scene).material.shear if down and right else make_plan(scene).material.across
        here = np.s_[0 : rows - down, max(0, -right) : cols - max(0, right)]
        there = np.s_[down:rows, max(0, right) : cols + min(0, right)]
        along = x[there] - x[here]
        length = np.linalg.norm(along, axis=-1)[..., None, None]
        n = (along / length[..., 0])[..., :, None]
        project = n * np.swapaxes(n, -1, -2)
        block = k * ((1 - math.hypot(right * dx, down * dy) / length) * (np.eye(3) - project) + project)
        a, b = number[here].ravel(), number[there].ravel()
        blocks = block.reshape(-1, 3, 3)
        parts += [(a, a, blocks), (b, b, blocks), (a, b, -blocks), (b, a, -blocks)]
    size = 3 * rows * cols
    first = np.concatenate([np.repeat(3 * i[:, None] + np.arange(3), 3, axis=1).ravel() for i, _, _ in parts])
    second = np.concatenate([np.tile(3 * j[:, None] + np.arange(3), (1, 3)).ravel() for _, j, _ in parts])
    values = np.concatenate([blocks.ravel() for _, _, blocks in parts])
    whole = coo_matrix((values, (first, second)), shape=(size, size)).tocsc()
    whole = whole + active * make_plan(scene).material.virtual * identity(size, format="csc")
    moves = np.repeat(~fixed_points(scene.sheet).ravel(), 3)
    return whole[moves][:, moves]


def forces(scene: Scene, displacement: Array, t: float) -> Array:
    """Sum up springs, virtual springs and probes on the points that move [N], by the same list of springs."""
    rows, cols = scene.sheet.points
    dx, dy = spacing(scene.sheet)
    x, total = rest_positions(scene.sheet) + displacement, np.zeros((rows, cols, 3))
    for down, right in HALF:
        k = make_plan(scene).material.shear if down and right else make_plan(scene).material.across
        here = np.s_[0 : rows - down, max(0, -right) : cols - max(0, right)]
        there = np.s_[down:rows, max(0, right) : cols + min(0, right)]
        along = x[there] - x[here]
        length = np.linalg.norm(along, axis=-1, keepdims=True)
        pull = k * (1 - math.hypot(right * dx, down * dy) / length) * along
        total[here] += pull
        total[there] -= pull
    loads = evaluate_loads(make_plan(scene), np.array([t]))
    total -= loads.active[0] * make_plan(scene).material.virtual * displacement
    for n, probe in enumerate(scene.probes):
        total += decay(probe, scene.sheet)[..., None] * loads.strength[0, n]
    return total[~fixed_points(scene.sheet)].ravel()


def lowest(matrix: csc_matrix, below: float, count: int = 1) -> tuple[Array, Array]:
    """Find the smallest eigenvalues and their vectors, near a number that is below all of them."""
    values, vectors = eigsh(matrix, k=count, sigma=below, which="LM", tol=1e-9)
    assert values.min() > below
    order = np.argsort(values)
    return values[order], vectors[:, order]


def buckling() -> dict[str, Any]:
    """Follow the smallest eigenvalue through a stiffer press, and draw it and its mode."""
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
    size = np.linalg.norm(modes[worst], axis=-1)
    row = int(np.unravel_index(size.argmax(), size.shape)[0])
    component = int(np.abs(modes[worst]).max(axis=(0, 1)).argmax())
    along = modes[worst][row, :, component]

    with style.context(STYLE, after_reset=True):
        figure = Figure(figsize=(TWO_COLUMN_WIDTH, 3.2), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        left, middle, right = figure.subplots(1, 3, width_ratios=(1.4, 1, 1))
        left.axhline(0, color=GREY, linewidth=0.8)
        left.plot(times, values, "o-", color=BLUE, markersize=3)
        left.set(title=f"Smallest eigenvalue, springs {BUCKLING} × as stiff", xlabel="time [s]", ylabel="N/m")
        load = np.array(scene.probes[0].load)
        twin = left.twinx()
        twin.plot(*load.T, color=VERMILION, linewidth=1)
        twin.set_ylim(0, 400)
        twin.grid(visible=False)
        twin.set_yticks([0, 100])
        twin.set_ylabel("load [%]", color=VERMILION, loc="bottom")
        mode = modes[worst]
        middle.imshow(np.linalg.norm(mode, axis=-1), cmap="magma")
        middle.set(title=f"Its mode at {times[worst]:g} s: size", xticks=[], yticks=[])
        near = np.s_[max(0, row - 10) : row + 11]
        column = int(np.abs(along).argmax())
        beside = np.s_[max(0, column - 10) : column + 11]
        largest = np.abs(mode[..., component]).max()
        right.imshow(mode[near, beside, component], cmap="RdBu", vmin=-largest, vmax=largest)
        right.set(title=f"and {'xyz'[component]}, around its largest point", xticks=[], yticks=[])
        figure.savefig(IMAGES / "numerics-buckling.png", format="png")
    return {"buckled": f"{values[worst]:.2g}", "unloaded": f"{values[0]:.2g}"}


def energy() -> dict[str, Any]:
    """Read the energy of an undamped sheet over many steps, and draw it."""
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
    with style.context(STYLE, after_reset=True):
        figure = Figure(figsize=(TWO_COLUMN_WIDTH, 2.8), dpi=DPI, layout="constrained")
        FigureCanvasAgg(figure)
        axes = figure.subplots()
        colours: dict[Precision, str] = {"f32": VERMILION, "f64": BLUE}
        for kind, colour in colours.items():
            dynamics = Dynamics(make_plan(made).with_grid(precision=kind), runtime.current_device())
            found = []
            for _ in range(ENERGY_STEPS // every):
                dynamics.advance(every)
                found.append(dynamics.read().energy)
            dynamics.close()
            steps = every * np.arange(1, len(found) + 1)
            free = steps * h > press_time + every * h
            known = np.array(found)[free]
            mean = known.mean()
            tenth = len(known) // 10
            drift = known[-tenth:].mean() / known[:tenth].mean() - 1
            swing = np.abs(known / mean - 1).max()
            rows.append([kind, f"{mean:.4g} J", f"{100 * swing:.2g} %", f"{100 * drift:+.1g} %"])
            axes.plot(steps[free], known / mean, color=colour, linewidth=0.8, label=kind)
        axes.set(
            xlabel="steps", ylabel="energy / its mean", title=f"Energy of an undamped sheet, read every {every} steps"
        )
        axes.legend()
        figure.savefig(IMAGES / "numerics-energy.png", format="png")
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
    """Compare the shape at rest under load with Newton's."""
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
    # From nearby, as Newton's method needs, but not from the answer.
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
    """Count the evaluations of the forces that `motion: quasistatic` takes, and the steps to the same shape."""
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
            found = load_scene(ROOT / press, [*held, *change, points, "time.motion=quasistatic"])
            still = QuasiStatics(make_plan(found), runtime.current_device())
            still.advance(0)
            counts.append(f"{still.evaluations}")
            if not change:
                moving = Dynamics(
                    make_plan(load_scene(ROOT / press, [*held, points, "time.precision=f64"])), runtime.current_device()
                )
                wanted = still.displacement()
                while max_norm(moving.displacement() - wanted) > CLOSE * max_norm(wanted):
                    moving.advance(STRIDE)
                counts[-1] += f" ({moving.steps_done} steps)"
                moving.close()
            if side == sides[0] and name.startswith("pulled"):
                lifted = 1000 * float(np.abs(still.displacement()[..., 2]).max())
            still.close()
        rows.append(counts)
    head = ["force evaluations for a frame", *(f"{side} × {side}" for side in sides)]
    return {"rest_table": markdown_table(head, rows), "rest_close": f"{CLOSE:.0e}", "rest_lifted": f"{lifted:.1f}"}


def indentation() -> dict[str, Any]:
    """Press a round tip into a membrane on a foundation, at rest, and compare its force with the closed form."""
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
    """Give the force of a round tip on an endless membrane on a foundation [N].

    S w'' = K w, so that w is K0(r / l), l^2 = S / K, outside of the circle that touches, and a paraboloid within.
    """
    fades = math.sqrt(tension / foundation)

    def depth_of(c: float) -> float:
        return float(c / radius * fades / k1(c / fades) * k0(c / fades) + c**2 / (2 * radius))

    c = brentq(lambda c: depth_of(c) - depth, 1e-9, radius / 2)
    below = foundation * (math.pi * c**2 * depth - math.pi * c**4 / (4 * radius))
    return float(below + tension * 2 * math.pi * c * c / radius)


def frequencies() -> dict[str, Any]:
    """Compare the phase of small motions with that of the modes."""
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
        # Of u_n = cos(n theta) that is u_0, and the difference from u_{-1}. A first step from rest would be another.
        dynamics.restart(plan, State(1, shape, shape * (1 - math.cos(theta))))
        dynamics.advance(grid.steps)
        found = float((dynamics.displacement() * shape).sum() / (shape * shape).sum())
        expected = math.cos(grid.steps * theta)
        rows.append([f"{w / (2 * math.pi):.4f}", f"{expected:+.9f}", f"{found:+.9f}", f"{abs(found - expected):.0e}"])
    dynamics.close()
    head = ["frequency [Hz]", "cos(n theta)", "amplitude after n steps", "apart"]
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
