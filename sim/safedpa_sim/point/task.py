"""The task: reach the goal, then the next one, for 1000 steps; every step within a hazard costs 1."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, FloatArray
from safedpa_sim.point.body import POINT_BODY
from safedpa_sim.point.layout import GOAL_RADIUS, HAZARD_RADIUS, draw_goals, draw_layouts
from safedpa_sim.point.observation import hazard_lidar
from safedpa_sim.point.sensed import sensed
from safedpa_sim.point.simulation import PointSimulation

__all__ = ["EPISODE_STEPS", "GOAL_REWARD", "PointTask", "StepResult", "control_of"]


EPISODE_STEPS: Final = 1000
GOAL_REWARD: Final = 1.0
"""For each goal."""


@dataclass(frozen=True)
class StepResult:
    """What one step brought, one entry a robot."""

    reward: FloatArray
    """m by which the goal came nearer, and 1 where it was reached."""
    cost: FloatArray
    """1 where the hinge, the robot's middle, lies within a hazard."""
    reached: BoolArray
    timed_out: BoolArray
    """The episode's last step."""


def control_of(action: NDArray[np.floating[Any]], stock: bool = False) -> FloatArray:
    """Controls (2, count) of actions (count, 2) in [-1, 1].

    The thrust's control is a twentieth of the action, so that it never saturates and the body is affine in it; with
    ``stock`` the action itself, as in the benchmark: beyond a twentieth of its range the thrust is full.
    """
    scale = np.array([1.0 if stock else POINT_BODY.force_limit, 1.0])
    control: FloatArray = (np.clip(action, -1.0, 1.0) * scale).T
    return control


class PointTask:
    """``count`` robots, each in a layout and a wind of its own; the same seed gives the same episodes.

    ``paired``: each robot's goals come from a sequence of its own, whatever the others reach and when, so that several
    methods meet the same.
    """

    def __init__(
        self, count: int, seed: int, *, largest_force: float = 0.0, stock: bool = False, paired: bool = False
    ) -> None:
        self.count = count
        self.simulation = PointSimulation(count)
        self.largest_force = largest_force
        """N; winds are drawn within that disc at each restart."""
        self._stock = stock
        self._random = np.random.default_rng(seed)
        self._own = np.random.default_rng([seed, 1]).spawn(count) if paired else []
        self.layout = draw_layouts(count, self._random)
        self.steps = np.zeros(count, int)
        self.control = np.zeros((2, count))
        self._distance = np.zeros(count)
        self.restart(np.arange(count))

    def restart(self, which: NDArray[np.intp]) -> None:
        """New layouts, headings and winds for the robots of those indices, at rest."""
        drawn = draw_layouts(len(which), self._random)
        self.layout.robot[which], self.layout.goal[which] = drawn.robot, drawn.goal
        self.layout.hazards[which] = drawn.hazards
        simulation = self.simulation
        simulation.pose[:2, which] = drawn.robot.T
        simulation.pose[2, which] = self._random.uniform(0.0, 2.0 * np.pi, len(which))
        simulation.velocity[:, which] = 0.0
        direction = self._random.uniform(0.0, 2.0 * np.pi, len(which))
        strength = self.largest_force * np.sqrt(self._random.uniform(0.0, 1.0, len(which)))
        simulation.force[:, which] = strength * np.stack((np.cos(direction), np.sin(direction)))
        self.control[:, which] = 0.0
        self.steps[which] = 0
        self._distance[which] = self._goal_distance()[which]

    def advance(self, action: NDArray[np.floating[Any]]) -> StepResult:
        """One step under actions (count, 2) in [-1, 1]; a goal that is reached is put elsewhere."""
        return self.advance_under(control_of(action, self._stock))

    def advance_under(self, control: FloatArray) -> StepResult:
        """The same under controls (2, count) of the body's motors."""
        self.control = control
        self.simulation.advance(self.control)
        self.steps += 1
        distance = self._goal_distance()
        reward = self._distance - distance
        reached = distance <= GOAL_RADIUS
        reward[reached] += GOAL_REWARD
        which = np.flatnonzero(reached)
        if len(which):
            self._put_goals(which)
            distance[which] = self._goal_distance()[which]
        self._distance = distance
        cost = (self.hazard_distance() <= 0.0).astype(float)
        return StepResult(reward, cost, reached, self.steps >= EPISODE_STEPS)

    def _put_goals(self, which: NDArray[np.intp]) -> None:
        groups = [(np.array([index]), self._own[index]) for index in which] if self._own else [(which, self._random)]
        for some, random in groups:
            place = self.simulation.pose[:2, some].T
            self.layout.goal[some] = draw_goals(place, self.layout.hazards[some], random)

    def hazard_distance(self) -> FloatArray:
        """(count,) m from the robot's middle to the edge of the nearest hazard, negative within."""
        apart = self.layout.hazards - self.simulation.pose[:2].T[:, None]
        nearest: FloatArray = np.linalg.norm(apart, axis=2).min(axis=1) - HAZARD_RADIUS
        return nearest

    def observation(self) -> FloatArray:
        """(count, 31): 12 of the sensors, 3 of the goal, 16 of the lidar; the wind or a latent is not among them."""
        seen = sensed(self.simulation, self.control, self.layout.goal)
        return np.concatenate((seen, hazard_lidar(self.simulation.pose, self.layout.hazards)), axis=1)

    def _goal_distance(self) -> FloatArray:
        apart: FloatArray = np.linalg.norm(self.layout.goal - self.simulation.pose[:2].T, axis=1)
        return apart
