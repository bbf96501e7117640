"""The policy task of the car: thousands of cars drive to goals among obstacles, with unknown loads and wind.

Solid objects stop a car and push it out. The safety filter corrects each action, so that the policy learns to drive
with the filter in the loop.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
import torch
from numpy.typing import NDArray

from safedpa.arrays import BoolArray, Float32Array
from safedpa.dynamics import PhysicsModel
from safedpa.networks import LearnedNetworks, Weights
from safedpa.policy.learned import LearnedPolicy
from safedpa.robots.car.barriers.batch import barriers_of_cars
from safedpa.robots.car.observation import clearances, observe
from safedpa.safety.batch.filter import BatchFilter
from safedpa.safety.defaults import settings_named
from safedpa_sim.robots.car.scene import GOAL_RADIUS
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.data import drives
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.environments.car_scenes import FOOTPRINTS, ScenePool, draw_scenes
from safedpa_sim.training.environments.policy_task import EVALUATION_SEED, PeriodResult


def evaluate(
    configuration: Configuration, weights: Weights, *, cars: int = 512, seed: int = 0, with_filter: bool = True
) -> dict[str, Any]:
    """Evaluates one noise-free drive of each car: the share that reach the goal within 15 s, contacts and more.

    ``clean`` is the share that reach the goal without a contact. ``success_by_radius`` is the share that reach it by
    the radius [m] of the footprint: of the car alone and of each load.
    """
    driving = DrivingTask(configuration, weights, cars, seed + EVALUATION_SEED, with_filter=with_filter, calm=True)
    policy = LearnedPolicy(weights)
    middle, scale = weights["action_middle"], weights["action_scale"]
    reached, contacts = np.zeros(cars, dtype=bool), np.zeros(cars, dtype=np.int64)
    ticks, gained = np.full(cars, EPISODE_TICKS), np.zeros(cars)
    nearest = driving.distance.copy()
    for tick in range(EPISODE_TICKS):
        chosen = (policy.act(driving.observation()) - middle) / scale
        moved = driving.advance(chosen.astype(np.float32))
        ticks[moved.reached & ~reached] = tick + 1
        contacts += moved.began & ~reached
        gained += np.where(reached, 0.0, moved.reward)
        nearest = np.minimum(nearest, driving.distance)
        reached |= moved.reached
    radii = np.array([item[2] for item in FOOTPRINTS])
    group = np.abs(driving.scene.footprint[:, 2, np.newaxis] - radii).argmin(axis=1)
    return {
        "success": float(reached.mean()),
        "clean": float((reached & (contacts == 0)).mean()),
        "contacts": float(contacts.mean()),
        "nearest": float(nearest.mean()),
        "reward": float(gained.mean()),
        "mean_seconds": float(ticks.mean() * driving.period),
        "success_by_radius": {
            f"{radius:.2f}": float(reached[group == index].mean())
            for index, radius in enumerate(radii)
            if (group == index).any()
        },
    }


_BEHIND: Final = 0.15
"""m by which a load extends further back than the footprint, which matters when reversing."""
_OWN_RADIUS: Final = 0.13
"""m; a footprint with a larger radius includes a load."""


@final
class TrainingFilter:
    """The batched safety filter with the simulator's own model; ``model`` takes the environment as its latent."""

    def __init__(self, model: PhysicsModel) -> None:
        self._filter = BatchFilter(model, settings_named("car").with_barriers(clearance=0.0))

    def decide(
        self,
        state: Float32Array,
        nominal: Float32Array,
        environment: Float32Array,
        scene: ScenePool,
        retained: Float32Array,
    ) -> Float32Array:
        """Returns safe actions (cars, 2) for states (cars, 4), nominal actions (cars, 2), environments (cars, entries).

        ``retained`` (cars,) [m] is the distance that each car keeps at standstill, clearance plus margin: epsilon /
        eta.
        """
        settings, footprint = self._filter.settings, scene.footprint.astype(np.float64)
        footprint[:, 0] += _BEHIND * (footprint[:, 2] > _OWN_RADIUS)
        barriers = barriers_of_cars(settings, scene.obstacles, footprint, scene.field)
        room = settings.eta * retained
        margins = {"obstacle": room, "field": room, "speed": 0.0}
        found = self._filter.decide(state, nominal, environment, barriers=barriers, epsilon=margins)
        return found.action.astype(np.float32)


EPISODE_TICKS = 300
"""15 s; time limit of an episode."""
_POOL = 8192
"""Largest number of scenes; 16 per car when there are fewer than 512 cars."""
_HITCHED = 0.003
"""Probability per tick that the environment changes: a load is hitched or dropped, the wind turns."""
_SPEED_NOISE, _STEER_NOISE = 0.03, 0.01
"""m/s and rad; standard deviation of the actuators around their commands."""
_STEER_HOLD = 0.5
"""Largest share of the last steering angle that persists for one tick (actuator lag); drawn for each car."""
_RETAINED = (0.05, 0.19)
"""m of clearance plus margin in the filter; drawn for each car, because the policy does not observe it."""
_WIDE = 0.2
"""m of clearance below which proximity costs reward."""


@dataclass(frozen=True)
class Rewards:
    """Reward terms of a tick, in the unit of the progress term: m."""

    reached: float = 5.0
    tick: float = 0.02
    steering: float = 0.02
    """Cost of the squared change of steer, in units of half its range."""
    near: float = 0.05
    """Cost at contact, decreasing to 0 at a clearance of 0.2 m, below which the filter would intervene."""
    reversing: float = 0.01
    contact: float = 0.05
    """Cost of each tick of contact."""
    penalty: float = 0.0
    """Cost of the first tick of a contact: the penalty of RMA-P."""


@final
class DrivingTask:
    """A batch of ``count`` driving cars; the same seed gives the same drives.

    Each contact costs ``penalty``. ``with_filter``, the safety filter corrects each action, unless ``practice.shelter``
    of the configuration is off.
    The ``latent`` of each car is mu(e). With ``calm``, each drive starts at rest and its environment does not change.
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
        practice = configuration.practice
        self.count, self.calm = count, calm
        self.rewards = Rewards(near=practice.near, contact=practice.contact, penalty=penalty)
        self.with_filter = with_filter and practice.shelter
        self._cars = BatchedSimulator(configuration)
        self._filter = TrainingFilter(self._cars.model)
        self.period = self._cars.model.period
        self._networks = LearnedNetworks(weights)
        self._generator = self._cars.generator(seed)
        self._random = np.random.default_rng([seed, 11])
        self._middle, self._scale = weights["action_middle"], weights["action_scale"]
        self._pool = draw_scenes(self._random, min(16 * count, _POOL), loads=practice.loads)
        self.body: Float32Array | None = None if practice.footprint else np.array(FOOTPRINTS[0], np.float32)
        """(3,) rear, front, radius [m] that the policy observes instead of the actual footprint; None: that one."""
        self.scene: ScenePool = self._pool.taken(np.zeros(count, dtype=np.int64))
        self.state: Float32Array = np.zeros((count, 4), dtype=np.float32)
        self.applied: Float32Array = np.zeros((count, 2), dtype=np.float32)
        self.environment: Float32Array = np.zeros((count, len(self._cars.entries)), dtype=np.float32)
        self.latent: Float32Array = np.zeros((count, weights.description.latents), dtype=np.float32)
        self.tick = np.zeros(count, dtype=np.int64)
        self._touching = np.zeros(count, dtype=bool)
        self.distance: Float32Array = np.zeros(count, dtype=np.float32)
        """m to the goal."""
        self._hold: Float32Array = np.zeros(count, dtype=np.float32)
        self._retained: Float32Array = np.zeros(count, dtype=np.float32)
        self._angle = np.zeros(count, dtype=np.float32)
        self.restart(np.arange(count))

    def restart(self, which: NDArray[np.intp]) -> None:
        """Starts new episodes with new scenes and environments; unless ``calm``, half of the cars start at speed."""
        count = len(which)
        drawn = self._pool.taken(self._random.integers(0, len(self._pool), count))
        for name in ("start", "goal", "obstacles", "field", "footprint"):
            getattr(self.scene, name)[which] = getattr(drawn, name)
        self.state[which, :3] = drawn.start
        self.state[which, 3] = 0.0 if self.calm else np.maximum(self._random.uniform(-1.0, 1.0, count), 0.0)
        self.applied[which] = 0.0
        self.applied[which, 0] = self.state[which, 3]
        self._angle[which] = 0.0
        self._hold[which] = self._random.uniform(0.0, _STEER_HOLD, count)
        self._retained[which] = self._random.uniform(*_RETAINED, count)
        self.tick[which] = 0
        self._touching[which] = False
        self.distance[which] = np.hypot(*(drawn.goal - drawn.start[:, :2]).T)
        self._change_environment(which)

    def observation(self, which: NDArray[np.intp] | slice = slice(None)) -> Float32Array:
        """Returns the observations (count, observations) of the cars with the given indices, by default of all."""
        scene = self.scene.taken(which)
        own = self.state[which], self.applied[which]
        body = scene.footprint if self.body is None else np.broadcast_to(self.body, scene.footprint.shape)
        seen = observe(*own, scene.goal, scene.obstacles, scene.field, body, self.latent[which])
        return seen.astype(np.float32, copy=False)

    def exploring(self, random: np.random.Generator) -> Float32Array:
        """Returns random forward actions, from which the scales of the observations are computed."""
        chosen = random.uniform(-1.0, 1.0, (self.count, 2)).astype(np.float32)
        chosen[:, 0] = np.abs(chosen[:, 0])
        return chosen

    def advance(self, chosen: Float32Array) -> PeriodResult:
        """Simulates one period under ``chosen`` (count, 2), each entry in [-1, 1] over the range of commands."""
        before = self.applied.copy()
        nominal = self._middle + self._scale * np.clip(chosen, -1.0, 1.0)
        if self.with_filter:
            nominal = self._filter.decide(self.state, nominal, self.environment, self.scene, self._retained)
        self.applied = nominal.astype(np.float32)
        self._move()
        room = self._meet_solids()
        contact = room <= 0.0
        began = contact & ~self._touching
        self._touching = contact
        distance = self._to_goal()
        reached = distance < GOAL_RADIUS
        self.tick += 1
        moved = PeriodResult(
            self._reward(before, distance, room, reached, began),
            reached,
            (self.tick >= EPISODE_TICKS) & ~reached,
            contact,
            began,
        )
        self.distance = distance
        if not self.calm:
            self._change_environment(np.flatnonzero(self._random.random(self.count) < _HITCHED))
        return moved

    def _reward(
        self, before: Float32Array, distance: Float32Array, room: Float32Array, reached: BoolArray, began: BoolArray
    ) -> Float32Array:
        worth = self.rewards
        turned = (self.applied[:, 1] - before[:, 1]) / self._scale[1]
        near = np.clip(1.0 - room / _WIDE, 0.0, 1.0)
        reward = self.distance - distance - worth.tick + worth.reached * reached
        reward -= worth.steering * turned * turned + worth.near * near + worth.reversing * (self.state[:, 3] < -0.05)
        reward -= worth.contact * self._touching + worth.penalty * began
        return np.asarray(reward, dtype=np.float32)

    def _move(self) -> None:
        """Simulates one period with actuator noise and steering lag."""
        noise = self._random.standard_normal((self.count, 2), dtype=np.float32)
        felt = self.applied + noise * np.array([_SPEED_NOISE, _STEER_NOISE], dtype=np.float32)
        felt[:, 1] += self._hold * (self._angle - felt[:, 1])
        self._angle = felt[:, 1]
        tensors = (torch.from_numpy(array) for array in (self.state, felt, self.environment))
        with torch.no_grad():
            following, _ = self._cars.advance(*tensors)
        self.state = following.numpy()

    def _meet_solids(self) -> Float32Array:
        """Pushes cars out of solid objects, stops them, and returns the clearance of each car before that [m]."""
        state, scene = self.state, self.scene
        cosine, sine = np.cos(state[:, 2]), np.sin(state[:, 2])
        room, offset = clearances(self._own_obstacles(), scene.obstacles[..., 2], scene.footprint)
        nearest = np.argmin(room, axis=1)
        rows = np.arange(self.count)
        least, towards = room[rows, nearest], offset[rows, nearest]
        towards = towards / np.maximum(np.hypot(towards[:, 0], towards[:, 1]), 1e-6)[:, np.newaxis]
        depth = np.maximum(-least, 0.0)
        along = depth * towards[:, 0]
        state[:, 0] -= along * cosine - depth * towards[:, 1] * sine
        state[:, 1] -= along * sine + depth * towards[:, 1] * cosine
        blocked = (depth > 0.0) & (towards[:, 0] * state[:, 3] > 0.0)
        for axis, heading in ((0, cosine), (1, sine)):
            push, wall = self._wall_push(axis, heading)
            state[:, axis] += push
            least = np.minimum(least, wall)
            blocked |= push * heading * state[:, 3] < 0.0
        state[blocked, 3] = 0.0
        return np.asarray(least, dtype=np.float32)

    def _wall_push(self, axis: int, heading: Float32Array) -> tuple[Float32Array, Float32Array]:
        """Returns the push of the walls along an axis [m] and the clearance to the nearer wall before the push."""
        scene, at = self.scene, self.state[:, axis]
        rear, front, radius = scene.footprint.T
        highest = at + np.maximum(front * heading, -rear * heading) + radius
        lowest = at + np.minimum(front * heading, -rear * heading) - radius
        up, down = scene.field[:, 2 * axis + 1] - highest, lowest - scene.field[:, 2 * axis]
        push: Float32Array = np.minimum(up, 0.0) - np.minimum(down, 0.0)
        return push, np.minimum(up, down)

    def _own_obstacles(self) -> Float32Array:
        """Returns the obstacle centres (count, m, 2) in each car's own frame."""
        state = self.state
        x, y = (self.scene.obstacles[..., axis] - state[:, axis, np.newaxis] for axis in (0, 1))
        cosine, sine = np.cos(state[:, 2])[:, np.newaxis], np.sin(state[:, 2])[:, np.newaxis]
        return np.stack((cosine * x + sine * y, cosine * y - sine * x), axis=-1)

    def _to_goal(self) -> Float32Array:
        offset = self.scene.goal - self.state[:, :2]
        distance: Float32Array = np.hypot(offset[:, 0], offset[:, 1])
        return distance

    def _change_environment(self, which: NDArray[np.intp]) -> None:
        if not len(which):
            return
        drawn: Any = self._cars.draw_environments(len(which), self._generator).numpy()
        self.environment[which] = drawn
        if self.latent.shape[1]:
            self.latent[which] = self._networks.encode(drawn)


make_environment = DrivingTask
random_drives = drives.random_drives
