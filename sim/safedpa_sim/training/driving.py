"""Thousands of cars that drive to goals among obstacles, each with a load or wind of its own: where a policy learns.

Solid things stop a car as they would: it is pushed out, and does not go on into them. Before each action stands a
simple stand-in for the safety filter, so that the policy learns to drive with one: the target speed is limited by what
the free way ahead (behind, when reversing) allows. See ``allowed_speed``.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, final

import numpy as np
import torch
from numpy.typing import NDArray

from safedpa.networks import LearnedNetworks, Weights
from safedpa.robots.car.observation import clearances, observe
from safedpa_sim.robots.scene import GOAL_RADIUS
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.moved import Moved
from safedpa_sim.training.scenes import ScenePool, draw_scenes
from safedpa_sim.training.simulator import BatchedCars

__all__ = ["Driving", "Rewards", "allowed_speed"]

Floats = NDArray[np.float32]
Flags = NDArray[np.bool_]

EPISODE_TICKS = 300
"""15 s; until then the goal is to be reached."""
_POOL = 8192
"""Most scenes; as many times fewer as there are fewer than 512 cars."""
_HITCHED = 0.003
"""Probability per tick that the environment becomes another: a load is hitched or let go, the wind turns."""
_SPEED_NOISE, _STEER_NOISE = 0.03, 0.01
"""m/s and rad; standard deviation of what the actuators do beyond what they are told."""
_STEER_HOLD = 0.5
"""Largest share of its last angle that a car's steering keeps in one tick; drawn for each car. Real steering lags."""
_BRAKING, _GAIN, _USED = 2.0, 2.5, 0.25
"""m/s2, 1/s and s: the filter's guaranteed braking, and period over the share of room that it uses up in a tick."""
_KEPT = (0.05, 0.19)
"""m that the filter keeps, clearance and margin; drawn for each car: the policy does not see it."""
_WIDE = 0.2
"""m of clearance below which being near costs something."""
_BEHIND = 0.15
"""m by which a load reaches further back than the footprint: it counts when reversing."""
_OWN_RADIUS = 0.13
"""m; a footprint of a larger radius has a load."""


@dataclass(frozen=True)
class Rewards:
    """What a tick is worth: progress in m, everything else in the same unit."""

    reached: float = 5.0
    tick: float = 0.02
    steering: float = 0.02
    """Per square of the change of steer, in full steers."""
    near: float = 0.05
    """At contact, falling to 0 at a clearance of 0.2 m: nearer, the filter would hold the car back."""
    reversing: float = 0.01
    contact: float = 0.05
    """At every tick of contact."""
    penalty: float = 0.0
    """At the first tick of a contact: the strong penalty of RMA-P."""


@final
class Driving:
    """``count`` cars; the same seed gives the same drives. ``sheltered`` puts the stand-in for the filter before each.

    ``latent`` of each car is mu(e) of the weights. ``calm``: every drive begins at rest, and its environment stays.
    """

    def __init__(
        self,
        configuration: Configuration,
        weights: Weights,
        count: int,
        seed: int,
        *,
        rewards: Rewards | None = None,
        sheltered: bool = True,
        calm: bool = False,
    ) -> None:
        self.count = count
        self.calm = calm
        self.rewards = rewards or Rewards()
        self.sheltered = sheltered
        self._cars = BatchedCars(configuration)
        self.period = self._cars.model.period
        self._networks = LearnedNetworks(weights)
        self._generator = self._cars.generator(seed)
        self._random = np.random.default_rng([seed, 11])
        self._middle, self._scale = weights["action_middle"], weights["action_scale"]
        self._pool = draw_scenes(self._random, min(16 * count, _POOL))
        self.scene: ScenePool = self._pool.taken(np.zeros(count, dtype=np.int64))
        self.state: Floats = np.zeros((count, 4), dtype=np.float32)
        self.applied: Floats = np.zeros((count, 2), dtype=np.float32)
        self.environment: Floats = np.zeros((count, len(self._cars.entries)), dtype=np.float32)
        self.latent: Floats = np.zeros((count, weights.description.latents), dtype=np.float32)
        self.tick = np.zeros(count, dtype=np.int64)
        self._touching = np.zeros(count, dtype=bool)
        self.distance: Floats = np.zeros(count, dtype=np.float32)
        """m to the goal."""
        self._hold: Floats = np.zeros(count, dtype=np.float32)
        self._kept: Floats = np.zeros(count, dtype=np.float32)
        self._angle = np.zeros(count, dtype=np.float32)
        self.restart(np.arange(count))

    def restart(self, which: NDArray[np.intp]) -> None:
        """New scenes and environments for the cars of those indices; some of them already drive."""
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
        self._kept[which] = self._random.uniform(*_KEPT, count)
        self.tick[which] = 0
        self._touching[which] = False
        self.distance[which] = np.hypot(*(drawn.goal - drawn.start[:, :2]).T)
        self._change_environment(which)

    def observation(self, which: NDArray[np.intp] | slice = slice(None)) -> Floats:
        """What the policy sees of the cars of those indices, all of them without (count, observations)."""
        scene = self.scene.taken(which)
        own = self.state[which], self.applied[which]
        seen = observe(*own, scene.goal, scene.obstacles, scene.field, scene.footprint, self.latent[which])
        return seen.astype(np.float32, copy=False)

    def exploring(self, random: np.random.Generator) -> Floats:
        """Actions at random, forwards, for the scales of what is observed."""
        chosen = random.uniform(-1.0, 1.0, (self.count, 2)).astype(np.float32)
        chosen[:, 0] = np.abs(chosen[:, 0])
        return chosen

    def advance(self, chosen: Floats) -> Moved:
        """One period under ``chosen`` (count, 2), each entry in [-1, 1] over the range of commands."""
        before = self.applied.copy()
        wish = self._middle + self._scale * np.clip(chosen, -1.0, 1.0)
        self.applied = (self._limited(wish) if self.sheltered else wish).astype(np.float32)
        self._move()
        room = self._meet_solids()
        contact = room <= 0.0
        began = contact & ~self._touching
        self._touching = contact
        distance = self._to_goal()
        reached = distance < GOAL_RADIUS
        self.tick += 1
        moved = Moved(
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

    def _reward(self, before: Floats, distance: Floats, room: Floats, reached: Flags, began: Flags) -> Floats:
        worth = self.rewards
        turned = (self.applied[:, 1] - before[:, 1]) / self._scale[1]
        near = np.clip(1.0 - room / _WIDE, 0.0, 1.0)
        reward = self.distance - distance - worth.tick + worth.reached * reached
        reward -= worth.steering * turned * turned + worth.near * near + worth.reversing * (self.state[:, 3] < -0.05)
        reward -= worth.contact * self._touching + worth.penalty * began
        return np.asarray(reward, dtype=np.float32)

    def _limited(self, wish: Floats) -> Floats:
        """The wish with a target speed that the room ahead and behind allows."""
        ahead, behind = self._free_way()
        behind = behind - _BEHIND * (self.scene.footprint[:, 2] > _OWN_RADIUS)
        limited = wish.copy()
        limited[:, 0] = np.clip(wish[:, 0], -allowed_speed(behind), allowed_speed(ahead))
        return limited

    def _free_way(self) -> tuple[Floats, Floats]:
        """How far [m] the footprint gets straight ahead and straight back, less what the filter keeps."""
        scene = self.scene
        rear, front, radius = scene.footprint.T
        own = self._own_obstacles()
        reach = scene.obstacles[..., 2] + (radius + self._kept)[:, np.newaxis]
        inside = reach * reach - own[..., 1] ** 2
        half = np.sqrt(np.maximum(inside, 0.0))
        middle = 0.5 * (front - rear)[:, np.newaxis]
        met, ahead_of = inside > 0.0, own[..., 0] > middle
        ahead = np.where(met & ahead_of, own[..., 0] - half, 1e3).min(axis=1) - front
        behind = np.where(met & ~ahead_of, -own[..., 0] - half, 1e3).min(axis=1) - rear
        walls = self._to_walls(front, 1.0), self._to_walls(rear, -1.0)
        return np.minimum(ahead, walls[0] - self._kept), np.minimum(behind, walls[1] - self._kept)

    def _to_walls(self, reach: Floats, sign: float) -> Floats:
        """Along the heading (sign 1) or against it (-1), from the footprint's end to the first wall [m]."""
        scene, state = self.scene, self.state
        way: Floats = np.full(self.count, 1e3, dtype=np.float32)
        for axis, slope in ((0, sign * np.cos(state[:, 2])), (1, sign * np.sin(state[:, 2]))):
            end = state[:, axis] + reach * slope
            up = scene.field[:, 2 * axis + 1] - scene.footprint[:, 2] - end
            down = end - scene.field[:, 2 * axis] - scene.footprint[:, 2]
            way = np.minimum(way, np.where(slope > 0.0, up, down) / np.maximum(np.abs(slope), 1e-3))
        return way

    def _move(self) -> None:
        """One period of the simulator, with noise and lag in what the actuators do."""
        noise = self._random.standard_normal((self.count, 2), dtype=np.float32)
        felt = self.applied + noise * np.array([_SPEED_NOISE, _STEER_NOISE], dtype=np.float32)
        felt[:, 1] += self._hold * (self._angle - felt[:, 1])
        self._angle = felt[:, 1]
        tensors = (torch.from_numpy(array) for array in (self.state, felt, self.environment))
        with torch.no_grad():
            following, _ = self._cars.advance(*tensors)
        self.state = following.numpy()

    def _meet_solids(self) -> Floats:
        """Pushes cars out of what they have run into, stops them there, and returns the room around each [m]."""
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

    def _wall_push(self, axis: int, heading: Floats) -> tuple[Floats, Floats]:
        """By how much walls push a car along an axis [m], and its room to the nearer one before that."""
        scene, at = self.scene, self.state[:, axis]
        rear, front, radius = scene.footprint.T
        highest = at + np.maximum(front * heading, -rear * heading) + radius
        lowest = at + np.minimum(front * heading, -rear * heading) - radius
        up, down = scene.field[:, 2 * axis + 1] - highest, lowest - scene.field[:, 2 * axis]
        push: Floats = np.minimum(up, 0.0) - np.minimum(down, 0.0)
        return push, np.minimum(up, down)

    def _own_obstacles(self) -> Floats:
        """Obstacles' centres (count, m, 2) in each car's own frame."""
        state = self.state
        x, y = (self.scene.obstacles[..., axis] - state[:, axis, np.newaxis] for axis in (0, 1))
        cosine, sine = np.cos(state[:, 2])[:, np.newaxis], np.sin(state[:, 2])[:, np.newaxis]
        return np.stack((cosine * x + sine * y, cosine * y - sine * x), axis=-1)

    def _to_goal(self) -> Floats:
        offset = self.scene.goal - self.state[:, :2]
        distance: Floats = np.hypot(offset[:, 0], offset[:, 1])
        return distance

    def _change_environment(self, which: NDArray[np.intp]) -> None:
        if not len(which):
            return
        drawn: Any = self._cars.draw_environments(len(which), self._generator).numpy()
        self.environment[which] = drawn
        if self.latent.shape[1]:
            self.latent[which] = self._networks.encode(drawn)


def allowed_speed(way: Floats) -> Floats:
    """The largest speed v [m/s] with D(v) + 0.25 s v <= way [m]; 0 without any way.

    D is the stopping distance of ``safedpa.safety.braking``: v / k up to b / k, then b / k^2 + (v^2 - b^2 / k^2) / 2b.
    The second part is what the filter's condition h(next) >= (1 - eta) h(now) asks at constant speed, 0.05 s v / eta.
    """
    corner = _BRAKING / _GAIN
    way = np.maximum(way, 0.0)
    slow = way / (1.0 / _GAIN + _USED)
    rest = way - corner / _GAIN + corner * corner / (2.0 * _BRAKING)
    fast = _BRAKING * (np.sqrt(np.maximum(_USED * _USED + 2.0 * rest / _BRAKING, 0.0)) - _USED)
    return np.where(slow <= corner, slow, fast)
