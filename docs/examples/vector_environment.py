"""Four masses in one vector environment, pushed at a wall by random actions, each behind the filter.

python docs/examples/vector_environment.py [PICTURE.png]
"""

import sys

import gymnasium
import numpy as np

from safedpa.safety import FilterSettings, FunctionBarrier, GymnasiumSafetyFilter, SafetyFilter

A, B = np.array([[1.0, 0.05], [0.0, 1.0]]), np.array([[0.00125], [0.05]])  # a mass on a line, 20 Hz
SETTINGS = FilterSettings(action_low=(-1.0,), action_high=(1.0,), backup_action=(-1.0,), eta=0.1, epsilon=0.002)


class Mass(gymnasium.Env):
    """Position and speed; the wall is at 1 m."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def reset(self, seed=None, options=None):
        """Starts at a random position, at rest."""
        super().reset(seed=seed)
        self.x = np.array([self.np_random.uniform(-0.5, 0.5), 0.0])
        return self.x.copy(), {}

    def step(self, action):
        """One tick."""
        self.x = A @ self.x + B @ action
        return self.x.copy(), 0.0, False, False, {}


def room(x: np.ndarray) -> float:
    """Room to the wall less the distance to stop [m]."""
    return float(1.0 - x[0] - max(x[1], 0.0) ** 2 / 1.6 - 0.1 * max(x[1], 0.0))


def main(arguments: list[str]) -> str:
    """Drives for 10 s."""
    safe = SafetyFilter(lambda x: (A @ x, B), [FunctionBarrier(room)], SETTINGS)
    envs = GymnasiumSafetyFilter(gymnasium.vector.SyncVectorEnv([Mass] * 4), safe)
    random, (seen, _) = np.random.default_rng(0), envs.reset(seed=0)
    positions, statuses = [seen[:, 0]], []
    for _ in range(200):
        seen, _, _, _, infos = envs.step(random.uniform(-0.3, 1.0, (4, 1)).astype(np.float32))
        positions.append(seen[:, 0])
        statuses += [verdict.status.value for verdict in infos["verdict"]]
    if arguments:
        from matplotlib.figure import Figure

        axes = (figure := Figure(figsize=(6.4, 3.0), layout="constrained")).subplots()
        axes.plot(0.05 * np.arange(len(positions)), positions)
        axes.axhline(1.0, color="k", linestyle="--", label="wall")
        axes.set(xlabel="t [s]", ylabel="position [m]")
        axes.legend()
        figure.savefig(arguments[0], dpi=100)
    counted = {status: statuses.count(status) for status in sorted(set(statuses))}
    return f"largest position {np.max(positions):.3f} m of 1 m; verdicts {counted}\n"


if __name__ == "__main__":
    sys.stdout.write(main(sys.argv[1:]))
