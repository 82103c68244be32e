"""Write ball.csv: a synthetic test of the tissue of ball.yaml with other values, as a testing machine writes it.

    python examples/make_ball.py

A ball descends by 1 mm/s, touches the tissue after 2 s, and is held 4 mm below its surface.
"""

from pathlib import Path

import numpy as np

from taichi_msm import Simulation, load_scene

FOLDER = Path(__file__).parent

TRUTH = {
    "tissue.foundation.young": 3e4,
    "tissue.foundation.lock": 0.008,
    "tissue.relaxation.0.share": 0.4,
    "tissue.relaxation.0.time": 0.5,
}

# Times [s], depth of the machine [m], its force in the air [N], and the standard deviation of its noise [N].
TIME = np.arange(281) / 20
CONTACT, OFFSET, NOISE = 0.002, 0.05, 0.002
DEPTH = np.minimum(1e-3 * TIME, CONTACT + 0.004)


def forces() -> np.ndarray:
    """Return the force of the tissue on the ball at all times [N], shape (rows,)."""
    path = [[t, 0.5, 0.5, -max(depth - CONTACT, 0.0)] for t, depth in zip(TIME.tolist(), DEPTH.tolist(), strict=True)]
    run = {"probes.0.path": path, "time.duration": float(TIME[-1]), "time.frames_per_second": 20}
    values = []
    with Simulation(load_scene(FOLDER / "ball.yaml", {**TRUTH, **run})) as simulation:
        for frame in range(len(TIME)):
            simulation.advance(min(frame, 1))
            values.append(-simulation.forces()[0].force[2])
    return np.array(values)


if __name__ == "__main__":
    measured = forces() + OFFSET + np.random.default_rng(1).normal(0, NOISE, len(TIME))
    rows = [f"{t:.2f},{1000 * d:.4f},{f:.4f}" for t, d, f in zip(TIME, DEPTH, measured, strict=True)]
    (FOLDER / "ball.csv").write_text("\n".join(["Time [s],Depth [mm],Force [N]", *rows]) + "\n", encoding="utf-8")
