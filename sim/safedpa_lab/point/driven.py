"""One episode of many point robots under one method, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass
from time import process_time
from typing import Any, Protocol, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, FloatArray
from safedpa_lab.point.inputs import Inputs
from safedpa_sim.point.task import EPISODE_STEPS, PointTask

__all__ = ["Driven", "Driver", "PolicyDriver", "driven", "windy_task"]


class Driver(Protocol):
    """A method at the wheel of all robots of a task."""

    corrected: BoolArray
    """(robots,): where the last action is not the nominal action."""
    relaxed: BoolArray
    """(robots,): where not every condition could be kept."""

    def act(self) -> NDArray[np.floating[Any]]:
        """Actions (robots, 2) in [-1, 1] for the task as it is."""


class _Acts(Protocol):
    """A policy: what it is given, actions out."""

    def act(self, seen: NDArray[np.float32]) -> NDArray[np.float32]:
        """Actions (robots, 2) for what is seen (robots, entries)."""


@final
class PolicyDriver:
    """A policy that acts by itself; nothing is corrected."""

    def __init__(self, task: PointTask, policy: _Acts, inputs: Inputs) -> None:
        self._policy, self._inputs = policy, inputs
        self.corrected = self.relaxed = np.zeros(task.count, bool)

    def act(self) -> NDArray[np.float32]:  # noqa: D102
        return self._policy.act(self._inputs.see())


@final
@dataclass(frozen=True)
class Driven:
    """One entry a robot, each an episode."""

    goals: FloatArray
    reward: FloatArray
    cost: FloatArray
    """Steps within a hazard."""
    least_room: FloatArray
    """m to the nearest hazard's edge, at the closest."""
    first_goal: FloatArray
    """s until the first goal; infinite where there was none."""
    corrected: float
    """Share of all steps."""
    relaxed: float
    """Share of all steps in which not every condition could be kept."""
    processor_seconds: float
    """In the method's own decisions, all robots together."""
    shown: list[dict[str, Any]]
    """Paths of the robots that were asked for: places, whether within a hazard, goals in their order, hazards."""


def windy_task(directions: int, episodes: int, force: float, seed: int) -> PointTask:
    """``directions`` x ``episodes`` robots: robot i in the wind of ``force`` N towards 360 degrees (i // episodes) /
    directions, layouts, headings and goals drawn from the seed alone."""
    task = PointTask(directions * episodes, seed, paired=True)
    towards = np.repeat(2.0 * np.pi * np.arange(directions) / directions, episodes)
    task.simulation.force[:] = force * np.stack((np.cos(towards), np.sin(towards)))
    return task


def driven(
    driver: Driver, task: PointTask, steps: int = EPISODE_STEPS, shown: NDArray[np.intp] | None = None
) -> Driven:
    """Drives all robots of the task, just begun, for so many steps."""
    watch = _Watch(task, np.zeros(0, int) if shown is None else shown)
    corrected = relaxed = worked = 0.0
    for step in range(steps):
        began = process_time()
        action = driver.act()
        worked += process_time() - began
        watch.see(step, task.advance(action))
        corrected += float(driver.corrected.mean())
        relaxed += float(driver.relaxed.mean())
    return Driven(
        watch.goals,
        watch.reward,
        watch.cost,
        watch.least_room,
        watch.first_goal,
        corrected / steps,
        relaxed / steps,
        worked,
        watch.reported(),
    )


class _Watch:
    """What happens to each robot."""

    def __init__(self, task: PointTask, shown: NDArray[np.intp]) -> None:
        self.goals, self.reward, self.cost = np.zeros(task.count), np.zeros(task.count), np.zeros(task.count)
        self.least_room = task.hazard_distance()
        self.first_goal = np.full(task.count, np.inf)
        self._task, self._shown = task, shown
        self._places: list[FloatArray] = []
        self._within: list[FloatArray] = []
        self._met: list[list[list[float]]] = [[_pair(goal)] for goal in task.layout.goal[shown]]
        self._met_at: list[list[int]] = [[] for _ in shown]

    def see(self, step: int, stepped: Any) -> None:
        task, shown = self._task, self._shown
        self.goals += stepped.reached
        self.reward += stepped.reward
        self.cost += stepped.cost
        self.least_room = np.minimum(self.least_room, task.hazard_distance())
        self.first_goal[stepped.reached & np.isinf(self.first_goal)] = 0.02 * (step + 1)
        self._places.append(task.simulation.pose[:2, shown].T.copy())
        self._within.append(stepped.cost[shown] > 0.0)
        for place in np.flatnonzero(stepped.reached[shown]):
            self._met_at[place].append(step)
            self._met[place].append(_pair(task.layout.goal[shown[place]]))

    def reported(self) -> list[dict[str, Any]]:
        places, within = np.round(np.array(self._places), 3), np.array(self._within)
        return [
            {
                "robot": int(robot),
                "places": places[:, index].tolist(),
                "within": within[:, index].tolist(),
                "goals": self._met[index],
                "reached_at": self._met_at[index],
                "hazards": np.round(self._task.layout.hazards[robot], 3).tolist(),
            }
            for index, robot in enumerate(self._shown)
        ]


def _pair(place: FloatArray) -> list[float]:
    return [round(float(part), 3) for part in place]
