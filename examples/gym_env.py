"""A gymnasium environment: lower a finger onto tissue, at a random position, until the force is half a newton."""

from pathlib import Path

import gymnasium
import numpy as np

SCENE = Path(__file__).parents[1] / "scenes/press.yaml"
FINGER = {"radius": 0.005, "shaft": [0.3, -0.4, 1], "length": 0.15}
TARGET = 0.5  # N


class Palpation(gymnasium.Env):
    """Observation: a picture. Action: lower the finger by up to 0.5 mm per frame. Reward: minus the force error [N]."""

    observation_space = gymnasium.spaces.Box(0, 255, (128, 128, 3), np.uint8)
    action_space = gymnasium.spaces.Box(-1, 1, (1,), np.float32)
    simulation = None

    def reset(self, *, seed=None, options=None):
        from taichi_msm import (
            Simulation,
            load_scene,
        )  # Not at the top: the parent of spawned environments never needs it.

        super().reset(seed=seed)
        self.place, self.height = self.np_random.uniform(0.3, 0.7, 2).tolist(), 0.0
        finger = {"path": [[0, *self.place, self.height]], "instrument": FINGER}
        scene = load_scene(SCENE, {"probes": [finger], "render.size": [128, 128]})
        if self.simulation is None:
            self.simulation = Simulation(scene, threads=1)
        else:
            self.simulation.restart(scene)
        return self.simulation.draw(), {}

    def step(self, action):
        self.height -= 0.0005 * float(action[0])
        self.simulation.steer([{"path": [[self.simulation.time + 0.02, *self.place, self.height]]}])
        self.simulation.advance()
        force = -self.simulation.forces()[0].force[2]
        terminated, truncated = bool(force >= TARGET), self.simulation.frame >= 50
        return self.simulation.draw(), -abs(force - TARGET), terminated, truncated, {"force": force}


if __name__ == "__main__":
    environments = gymnasium.vector.AsyncVectorEnv([Palpation] * 4, context="spawn")
    environments.reset(seed=0)
    info = {"force": np.zeros(4)}
    while info["force"].max() < TARGET:
        *_, info = environments.step(np.ones((4, 1), np.float32))
    print("four fingers feel", *info["force"].round(2), "N")
    environments.close()
