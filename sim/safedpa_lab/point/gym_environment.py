"""One point robot in MuJoCo as a gymnasium environment:

    gymnasium.make("safedpa_lab.point.gym_environment:safedpa/PointGoal-v0", force=(0.004, -0.004))

The same task as ``PointTask``: goals in turn among eight hazards, 1000 steps, cost in ``info``.
"""

from __future__ import annotations

from typing import Any, Final, final

import gymnasium
import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa_lab.point.world import MujocoPoint
from safedpa_sim.point.layout import GOAL_RADIUS, HAZARD_RADIUS, Layout, draw_goals, draw_layouts
from safedpa_sim.point.observation import GOAL_ENTRIES, LIDAR_BINS, SENSOR_ENTRIES, goal_seen, hazard_lidar
from safedpa_sim.point.task import EPISODE_STEPS, GOAL_REWARD, control_of

ENVIRONMENT_ID: Final = "safedpa/PointGoal-v0"


@final
class PointGoalEnvironment(gymnasium.Env):  # type: ignore[misc] # gymnasium is not type-checked here
    """Action: thrust and turn in [-1, 1]. Observation (31,): 12 sensors, 3 of the goal, 16 of the hazards' lidar.

    ``force``: of the wind [N] in the world, the same in every episode; without it one is drawn at each reset within a
    disc of ``largest_force``. ``stock``: the benchmark's own thrust, full beyond a twentieth of the action. ``info``
    reports ``cost`` (1 in a hazard), ``reached``, ``goals`` of the episode, ``force``, ``hazard_distance`` [m]. An
    episode ends by time alone (truncated). Raises InputError for a force that is none.
    """

    metadata: dict[str, Any] = {"render_modes": []}  # noqa: RUF012

    def __init__(
        self,
        force: tuple[float, float] | None = None,
        largest_force: float = 0.0,
        stock: bool = False,
        render_mode: str | None = None,
    ) -> None:
        given = np.zeros(2) if force is None else np.asarray(force, dtype=np.float64)
        if given.shape != (2,) or not np.all(np.isfinite(given)):
            raise InputError(f"force: got {force}; wanted two finite numbers [N], x and y in the world")
        if not 0.0 <= largest_force < np.inf:
            raise InputError(f"largest_force: got {largest_force}; wanted a finite number [N] of 0 or more")
        self.render_mode = render_mode
        self._given, self._largest, self._stock = None if force is None else given, largest_force, stock
        entries = SENSOR_ENTRIES + GOAL_ENTRIES + LIDAR_BINS
        self.observation_space = gymnasium.spaces.Box(-np.inf, np.inf, (entries,), np.float32)
        self.action_space = gymnasium.spaces.Box(-1.0, 1.0, (2,), np.float32)
        self._layout: Layout | None = None

    def reset(
        self, *, seed: int | None = None, options: dict[str, Any] | None = None
    ) -> tuple[NDArray[np.float32], dict[str, Any]]:
        """A new layout, heading and wind, at rest."""
        super().reset(seed=seed, options=options)
        random = self.np_random
        self._layout = draw_layouts(1, random)
        self._world = MujocoPoint([(float(x), float(y)) for x, y in self._layout.hazards[0]])
        yaw, direction = random.uniform(0.0, 2.0 * np.pi, 2)
        strength = self._largest * np.sqrt(random.uniform())
        drawn = strength * np.array([np.cos(direction), np.sin(direction)])
        self._force = drawn if self._given is None else self._given
        start = np.array([*self._layout.robot[0], yaw])
        self._world.put(start, np.zeros(3), (float(self._force[0]), float(self._force[1])))
        self._show_goal()
        self._steps = self._goals = 0
        self._distance = self._goal_distance()
        return self._observation(), self._info(False)

    def step(self, action: NDArray[np.floating[Any]]) -> tuple[NDArray[np.float32], float, bool, bool, dict[str, Any]]:
        """One step of 20 ms. Raises InputError before the first reset, or for an action of other size."""
        if self._layout is None:
            raise InputError("step: got no reset before it; call reset first")
        self._world.advance(control_of(np.asarray(action, dtype=np.float64)[np.newaxis], self._stock)[:, 0])
        self._steps += 1
        distance = self._goal_distance()
        reached = distance <= GOAL_RADIUS
        reward = self._distance - distance + GOAL_REWARD * reached
        if reached:
            self._goals += 1
            place = self._world.pose[np.newaxis, :2]
            self._layout.goal[:] = draw_goals(place, self._layout.hazards, self.np_random)
            self._show_goal()
            distance = self._goal_distance()
        self._distance = distance
        return self._observation(), float(reward), False, self._steps >= EPISODE_STEPS, self._info(reached)

    def _show_goal(self) -> None:
        """Puts the goal's disc of the MuJoCo world where it is."""
        assert self._layout is not None
        self._world.data.mocap_pos[0, :2] = self._layout.goal[0]

    def _goal_distance(self) -> float:
        assert self._layout is not None
        return float(np.linalg.norm(self._layout.goal[0] - self._world.pose[:2]))

    def _observation(self) -> NDArray[np.float32]:
        assert self._layout is not None
        pose = self._world.pose[:, np.newaxis]
        parts = (
            self._world.sensors(),
            goal_seen(pose, self._layout.goal)[0],
            hazard_lidar(pose, self._layout.hazards)[0],
        )
        return np.concatenate(parts).astype(np.float32)

    def _info(self, reached: bool) -> dict[str, Any]:
        assert self._layout is not None
        apart = np.linalg.norm(self._layout.hazards[0] - self._world.pose[:2], axis=1).min() - HAZARD_RADIUS
        return {
            "cost": float(apart <= 0.0),
            "reached": reached,
            "goals": self._goals,
            "force": self._force.copy(),
            "hazard_distance": float(apart),
        }


if ENVIRONMENT_ID not in gymnasium.registry:
    gymnasium.register(
        id=ENVIRONMENT_ID, entry_point="safedpa_lab.point.gym_environment:PointGoalEnvironment", order_enforce=False
    )
