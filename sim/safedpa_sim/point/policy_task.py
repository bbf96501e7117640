"""The policy task of the point robot: driving from goal to goal among hazards, with the wind's latent as an input.

Reward: progress in m along the shortest route around the hazards, and 1 for each goal. The safety filter, with the
simulated physics as its model, corrects the actions, so that hazards need not be in the reward.
"""

from __future__ import annotations

from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import Float32Array
from safedpa.networks import LearnedNetworks, Weights
from safedpa_sim.point.filtering import ACTION_SCALE, PointFilter, SimulatedPointModel, to_task_action
from safedpa_sim.point.latent_policy import LatentPolicy
from safedpa_sim.point.layout import GOAL_RADIUS
from safedpa_sim.point.observation import policy_seen
from safedpa_sim.point.route_planner import RoutePlanner, teacher_actions
from safedpa_sim.point.simulation import centre_state
from safedpa_sim.point.task import EPISODE_STEPS, GOAL_REWARD, PointTask
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.data import drives
from safedpa_sim.training.environments.policy_task import EVALUATION_SEED, PeriodResult

LARGEST_FORCE: Final = 0.008
"""N; strongest wind."""
EPSILON: Final = 0.003
"""m; the filter's margin in training."""
_EVALUATION_TICKS = 500
_TURNS = 0.001
"""Probability per tick that the wind changes."""
_JUMP = 0.3
"""m; limit of the progress per step: the route length jumps when the route switches to the other side of a hazard."""


@final
class PointEnvironment:
    """A batch of point robots in random winds.

    ``with_filter``, the safety filter corrects each action. Each step in a hazard costs ``penalty``. With ``calm`` the
    winds are constant.
    """

    def __init__(
        self,
        configuration: Configuration,
        weights: Weights,
        count: int,
        seed: int,
        *,
        penalty: float = 0.0,
        with_filter: bool = True,
        calm: bool = False,
    ) -> None:
        self.count = count
        self.task = PointTask(count, seed, largest_force=LARGEST_FORCE)
        self.period = configuration.simulator.period
        self._penalty, self._with_filter, self._calm = penalty, with_filter, calm
        self._networks = LearnedNetworks(weights) if weights.description.latents else None
        self._paths = [entry.path for entry in weights.description.environment]
        self._random = np.random.default_rng([seed, 17])
        self._belief = SimulatedPointModel(self.task.simulation)
        self._filter = PointFilter(EPSILON)
        if not calm:
            self.task.steps[:] = self._random.integers(0, EPISODE_STEPS, count)
        self.latent: Float32Array = np.zeros((count, weights.description.latents), np.float32)
        self._update_latent()
        self.applied: Float32Array = np.zeros((count, 2), np.float32)
        self._within = np.zeros(count, bool)
        self._ways = RoutePlanner(count)
        self._turn, self._left = self._way()

    def _way(self) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
        """Returns the first turns of the routes and their lengths [m]."""
        layout = self.task.layout
        return self._ways.first_turns(self.task.simulation.pose[:2].T, layout.hazards, layout.goal)

    @property
    def state(self) -> Float32Array:
        """States (robots, 5) of the centres of mass."""
        return centre_state(self.task.simulation).astype(np.float32)

    def restart(self, which: NDArray[np.intp]) -> None:
        """Starts new episodes with new layouts and winds for the robots with the given indices."""
        if len(which):
            self.task.restart(which)
            self._within[which] = False
            self._update_latent()
            self._turn, self._left = self._way()

    def observation(self, which: NDArray[np.intp] | slice = slice(None)) -> Float32Array:
        """Returns ``policy_seen`` (robots, entries) of the robots with the given indices."""
        return policy_seen(self.task, self.latent, self._turn)[which].astype(np.float32)

    def teacher(self) -> Float32Array:
        """Returns actions (robots, 2) in [-1, 1] of a teacher that knows the wind."""
        state = centre_state(self.task.simulation)
        motion = self._belief.predict(state, np.zeros((self.count, 0))).motion
        return teacher_actions(state, self._turn, motion).astype(np.float32)

    def exploring(self, random: np.random.Generator) -> Float32Array:
        """Returns random actions, from which the scales of the observations are computed."""
        return random.uniform(-1.0, 1.0, (self.count, 2)).astype(np.float32)

    def advance(self, chosen: Float32Array) -> PeriodResult:
        """Simulates one period under ``chosen`` (robots, 2), each entry in [-1, 1] over the range of commands."""
        task = self.task
        action = np.clip(np.asarray(chosen, dtype=np.float64), -1.0, 1.0)
        if self._with_filter:
            state = centre_state(task.simulation)
            believed = self._belief.predict(state, np.zeros((self.count, 0)))
            action = self._filter.decide(state, action, task.layout.hazards, believed).action
        self.applied = (action * ACTION_SCALE).astype(np.float32)
        stepped = task.advance(to_task_action(action))
        within = stepped.cost > 0.0
        began, self._within = within & ~self._within, within
        self.goals = stepped.reached
        reward = self._gained() - self._penalty * stepped.cost
        if not self._calm:
            self._turn_wind()
        never = np.zeros(self.count, bool)
        return PeriodResult(reward.astype(np.float32), never, stepped.timed_out, never, began)

    def _gained(self) -> NDArray[np.float64]:
        """Returns the progress [m] along the route; at a goal, the remaining distance to its edge plus 1."""
        before = self._left
        self._turn, self._left = self._way()
        gained = np.clip(before - self._left, -_JUMP, _JUMP)
        return np.where(self.goals, before - GOAL_RADIUS + GOAL_REWARD, gained)

    def _turn_wind(self) -> None:
        which = np.flatnonzero(self._random.random(self.count) < _TURNS)
        if len(which):
            direction = self._random.uniform(0.0, 2.0 * np.pi, len(which))
            strength = LARGEST_FORCE * np.sqrt(self._random.random(len(which)))
            self.task.simulation.force[:, which] = strength * np.stack((np.cos(direction), np.sin(direction)))
            self._update_latent()

    def _update_latent(self) -> None:
        """Sets z = mu(e) for the current winds."""
        if self._networks is None:
            return
        simulation = self.task.simulation
        wind = dict(
            zip(("constant_force.ax", "constant_force.ay"), simulation.force / simulation.body.mass, strict=True)
        )
        environment = np.stack([wind.get(path, np.zeros(self.count)) for path in self._paths], axis=1)
        self.latent = self._networks.encode(environment).astype(np.float32)


def evaluate(
    configuration: Configuration, weights: Weights, *, cars: int = 128, seed: int = 0, with_filter: bool = True
) -> dict[str, Any]:
    """Evaluates ten noise-free seconds of each robot: the share that reach a goal, and means over the robots.

    ``goals`` reached, ``contacts`` (hazards entered), ``nearest`` (least distance to a hazard [m]) and ``reward``.
    """
    robots = PointEnvironment(configuration, weights, cars, seed + EVALUATION_SEED, with_filter=with_filter, calm=True)
    policy = LatentPolicy(weights)
    goals, contacts, gained = np.zeros(cars), np.zeros(cars), np.zeros(cars)
    nearest = np.full(cars, np.inf)
    for _ in range(_EVALUATION_TICKS):
        moved = robots.advance(policy.chosen(robots.observation()).astype(np.float32))
        goals += robots.goals
        contacts += moved.began
        gained += moved.reward
        nearest = np.minimum(nearest, robots.task.hazard_distance())
    return {
        "success": float((goals > 0).mean()),
        "goals": float(goals.mean()),
        "contacts": float(contacts.mean()),
        "nearest": float(nearest.mean()),
        "reward": float(gained.mean()),
    }


make_environment = PointEnvironment
random_drives = drives.random_drives
