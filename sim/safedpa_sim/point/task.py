"""The task of the point robot: reach one goal after another for 1000 steps; each step inside a hazard costs 1."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, FloatArray
from safedpa_sim.point.body import POINT_BODY
from safedpa_sim.point.layout import GOAL_RADIUS, HAZARD_RADIUS, draw_goals, draw_layouts
from safedpa_sim.point.observation import hazard_lidar, sensed
from safedpa_sim.point.simulation import PointSimulation

EPISODE_STEPS: Final = 1000
GOAL_REWARD: Final = 1.0
"""Reward of each goal."""


@dataclass(frozen=True)
class StepResult:
    """The result of one step, one entry per robot."""

    reward: FloatArray
    """Progress towards the goal [m], plus 1 when it is reached."""
    cost: FloatArray
    """1 if the hinge, the robot's geometric centre, is inside a hazard."""
    reached: BoolArray
    timed_out: BoolArray
    """Whether this was the last step of the episode."""


def control_of(action: NDArray[np.floating[Any]], stock: bool = False) -> FloatArray:
    """Converts actions (count, 2) in [-1, 1] to motor controls (2, count).

    The thrust control is a twentieth of the action, so that it never saturates and the body is affine in the action.
    With ``stock`` it is the action itself, as in the benchmark, where the thrust saturates at a twentieth of the range.
    """
    scale = np.array([1.0 if stock else POINT_BODY.force_limit, 1.0])
    control: FloatArray = (np.clip(action, -1.0, 1.0) * scale).T
    return control


class PointTask:
    """A batch of ``count`` robots, each with its own layout and wind; the same seed gives the same episodes.

    With ``paired``, each robot has its own random stream for goals, so that different methods face the same goals
    regardless of when other robots reach theirs.
    """

    def __init__(
        self, count: int, seed: int, *, largest_force: float = 0.0, stock: bool = False, paired: bool = False
    ) -> None:
        self.count = count
        self.simulation = PointSimulation(count)
        self.largest_force = largest_force
        """N; at each restart, winds are drawn from the disc of this radius."""
        self._stock = stock
        self._random = np.random.default_rng(seed)
        self._own = np.random.default_rng([seed, 1]).spawn(count) if paired else []
        self.layout = draw_layouts(count, self._random)
        self.steps = np.zeros(count, int)
        self.control = np.zeros((2, count))
        self._distance = np.zeros(count)
        self.restart(np.arange(count))

    def restart(self, which: NDArray[np.intp]) -> None:
        """Starts new episodes at rest, with new layouts, headings and winds, for the robots with the given indices."""
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
        """Simulates one step under actions (count, 2) in [-1, 1]; a goal that is reached is replaced by a new one."""
        return self.advance_under(control_of(action, self._stock))

    def advance_under(self, control: FloatArray) -> StepResult:
        """Simulates one step under motor controls (2, count)."""
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
            position = self.simulation.pose[:2, some].T
            self.layout.goal[some] = draw_goals(position, self.layout.hazards[some], random)

    def hazard_distance(self) -> FloatArray:
        """Returns the distance (count,) [m] from the robot's centre to the nearest hazard's edge, negative inside."""
        apart = self.layout.hazards - self.simulation.pose[:2].T[:, None]
        nearest: FloatArray = np.linalg.norm(apart, axis=2).min(axis=1) - HAZARD_RADIUS
        return nearest

    def observation(self) -> FloatArray:
        """Returns observations (count, 31): 12 sensor, 3 goal and 16 lidar entries, without wind or latent."""
        seen = sensed(self.simulation, self.control, self.layout.goal)
        return np.concatenate((seen, hazard_lidar(self.simulation.pose, self.layout.hazards)), axis=1)

    def _goal_distance(self) -> FloatArray:
        apart: FloatArray = np.linalg.norm(self.layout.goal - self.simulation.pose[:2].T, axis=1)
        return apart
