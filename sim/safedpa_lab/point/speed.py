"""Steps a second of the point robot on one core, by processor time: many at once, and one in MuJoCo."""

from __future__ import annotations

from collections.abc import Callable
from time import process_time

import numpy as np

from safedpa_sim.point.simulation import PointSimulation
from safedpa_sim.point.task import PointTask


def steps_per_second(robots: int = 128, steps: int = 200, repeats: int = 5) -> dict[str, float]:
    """The best of ``repeats``: ``simulation`` (10 physics steps each) and ``task`` (reward, cost, observation too) of
    so many robots at once; ``mujoco``, ``environment``: the same of one robot."""
    from safedpa_lab.point.gym_environment import PointGoalEnvironment
    from safedpa_lab.point.world import MujocoPoint

    random = np.random.default_rng(0)
    actions = random.uniform(-1.0, 1.0, (steps, robots, 2))
    simulation, task = PointSimulation(robots), PointTask(robots, 0)
    world, environment = MujocoPoint(), PointGoalEnvironment()
    environment.reset(seed=0)

    def of_task(index: int) -> None:
        task.advance(actions[index])
        task.observation()

    runs: dict[str, tuple[Callable[[int], object], int]] = {
        "simulation": (lambda index: simulation.advance(0.05 * actions[index].T), robots),
        "task": (of_task, robots),
        "mujoco": (lambda index: world.advance(0.05 * actions[index, 0]), 1),
        "environment": (lambda index: environment.step(actions[index, 0]), 1),
    }
    return {name: count * _rate(run, steps, repeats) for name, (run, count) in runs.items()}


def _rate(run: Callable[[int], object], steps: int, repeats: int) -> float:
    best = float("inf")
    for _ in range(repeats):
        began = process_time()
        for index in range(steps):
            run(index)
        best = min(best, process_time() - began)
    return steps / best
