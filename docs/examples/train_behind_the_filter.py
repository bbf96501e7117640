"""Trains PPO of stable-baselines3 with and without the filter, and counts collisions while it learns.

python docs/examples/train_behind_the_filter.py [PICTURE.png]
"""

import sys

import gymnasium
import numpy as np
from stable_baselines3 import PPO

from safedpa.safety import FilterSettings, FunctionBarrier, GymnasiumSafetyFilter, SafetyFilter

A, B = np.array([[1.0, 0.1], [0.0, 1.0]]), np.array([[0.005], [0.1]])  # a mass on a line, 10 Hz
STEPS, LENGTH = 3000, 50  # steps of training, steps of an episode
SETTINGS = FilterSettings(action_low=(-1.0,), action_high=(1.0,), backup_action=(-1.0,), eta=0.2, epsilon=0.002)


class Wall(gymnasium.Env):
    """Position and speed; the reward is higher closer to the wall at 1 m, and a collision ends the episode."""

    action_space = gymnasium.spaces.Box(-1.0, 1.0, (1,))
    observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (2,), np.float64)

    def __init__(self):
        self.largest = []  # position of each episode [m]

    def reset(self, seed=None, options=None):
        """Starts at rest, 1 m before the wall."""
        super().reset(seed=seed)
        self.x, self.left = np.zeros(2), LENGTH
        self.largest.append(0.0)
        return self.x.copy(), {}

    def step(self, action):
        """One tick."""
        self.x, self.left = A @ self.x + B @ action, self.left - 1
        hit = bool(self.x[0] >= 1.0)
        self.largest[-1] = max(self.largest[-1], float(self.x[0]))
        return self.x.copy(), float(-abs(0.9 - self.x[0])), hit, self.left == 0, {}


def room(x: np.ndarray) -> float:
    """Room to the wall less the distance to stop [m]."""
    return float(1.0 - x[0] - max(x[1], 0.0) ** 2 / 1.6 - 0.2 * max(x[1], 0.0))


def trained(*, filtered: bool, steps: int = STEPS) -> list[float]:
    """Largest position of each episode of the training [m]."""
    inner = Wall()
    safe = SafetyFilter(lambda x: (A @ x, B), [FunctionBarrier(room)], SETTINGS)
    env = GymnasiumSafetyFilter(inner, safe, penalty=0.1) if filtered else inner
    learner = PPO(
        "MlpPolicy", env, n_steps=250, batch_size=125, n_epochs=5, learning_rate=3e-3, gamma=0.95, seed=0, device="cpu",
        policy_kwargs={"net_arch": [16, 16]},
    )  # fmt: skip
    learner.learn(steps)
    return inner.largest[:-1]  # the last one has just begun


def main(arguments: list[str], steps: int = STEPS) -> str:
    """Trains twice."""
    found = {name: trained(filtered=name == "filter", steps=steps) for name in ("no filter", "filter")}
    if arguments:
        from matplotlib.figure import Figure

        axes = (figure := Figure(figsize=(6.4, 3.0), layout="constrained")).subplots()
        for name, largest in found.items():
            axes.plot(largest, ".-", label=name)
        axes.axhline(1.0, color="k", linestyle="--", label="wall")
        axes.set(xlabel="episode", ylabel="largest position [m]")
        axes.legend()
        figure.savefig(arguments[0], dpi=100)
    return "".join(
        f"{name}: {sum(x >= 1.0 for x in largest)} collisions in {len(largest)} episodes of training\n"
        for name, largest in found.items()
    )


if __name__ == "__main__":
    sys.stdout.write(main(sys.argv[1:]))
