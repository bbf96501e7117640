"""A sampling model predictive controller over any dynamics: draws drives, rolls them out, averages the best.

In each period n sequences of actions are drawn about the last plan, u_i = u + noise, and rolled out with the model at
the latent that is known. The new plan is the average of all, weighted by what they cost (S_i, least S_min):

    u <- sum w_i u_i / sum w_i,    w_i = exp(-(S_i - S_min) / temperature)

A drive costs the way that is left, the room that it lacks and how it steers (``DriveCosts``).

Source: Williams et al., Information theoretic MPC, ICRA 2017. Ours: actions as knots, some fixed drives among the drawn
ones, and only drives that resemble the best one enter the average, since the mean of left and right is straight on.
What the speed does beyond the prediction is taken to go on (offset-free MPC, Pannocchia and Rawlings, AIChE J. 2003):
a load that the model misjudges does not keep it trying what fails. Nothing that it requests is trusted: the safety filter
stands behind it as behind every controller.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.bus import StateMessage
from safedpa.dynamics import AbstractDynamics, LearnedBase, PhysicsModel
from safedpa.errors import InputError, MessageError
from safedpa.robots.car.controllers.time_to_goal import TimeToGo, clearance

__all__ = ["DriveCosts", "Planner", "PlannerSettings"]


_FIXED = (
    (1.0, 0.0),
    (1.0, 1.0),
    (1.0, -1.0),
    (0.5, 1.0),
    (0.5, -1.0),
    (-1.0, 0.0),
    (-1.0, 1.0),
    (-1.0, -1.0),
    (0.0, 0.0),
)
"""Drives held over the whole horizon: share of the greatest speed (that way), share of the greatest steer."""
_FORWARDS, _BACKWARDS = 0, 5
"""Which of them are straight on, at full speed."""
_KEPT = 0.75
"""Share of full speed that a robot keeps on average, with corners and stops."""
_SLOWEST = 0.02
"""m/s; slower than this is as bad as this."""
_SPEED_STEP = 1.25
_SPEED = 3
_SMOOTHING = 0.1
"""Weight of the last period's surprise: half a second is remembered."""
_MOST_PUSH = 3.0
"""m/s2; what is more was a bump."""
_ALIKE = 2.5
"""Spreads, at every knot, within which a drive resembles the best one."""


@final
@dataclass(frozen=True)
class PlannerSettings:
    """How the planner searches, and what it cares for: SI units. Raises InputError naming what is not positive."""

    samples: int = 128
    """Drives that are tried in each period."""
    steps: int = 15
    """Of the horizon."""
    step_seconds: float = 0.1
    knots: int = 5
    """Actions that are drawn, evenly over the horizon; in between the action goes straight from one to the next."""
    speed_spread: float = 0.8
    """m/s; standard deviation of the drawn target speeds."""
    steer_spread: float = 0.2
    """rad; likewise of the wheels."""
    temperature: float = 0.05
    """Of the average: drives that cost more than this above the best hardly count."""
    slowest_target: float = -0.6
    fastest_target: float = 2.0
    steer_limit: float = 0.34
    braking_deceleration: float = 2.8
    """m/s2; the room ahead is measured from where the robot would come to rest."""
    braking_gain: float = 3.2
    """1/s; of the speed servo, below braking_deceleration / braking_gain."""
    room: float = 0.15
    """m of clearance that cost nothing."""
    room_weight: float = 8.0
    contact_weight: float = 60.0
    way_weight: float = 0.3
    """Per second that is left on the mean of the way; one second that is left at the horizon costs 1."""
    sweeps: int = 5
    """Rounds of refining the time to go in each period, until it is settled: about 2 ms each."""
    effort_weight: float = 0.02
    """Per square of the change of an action from knot to knot, over its range."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not value > 0.0 and item.name != "slowest_target":
                raise InputError(f"planner, {item.name}: got {value}, wanted a positive number")
        if self.knots < 2 or self.slowest_target >= self.fastest_target:
            raise InputError(f"planner: got {self}, wanted at least 2 knots and slowest_target < fastest_target")


@final
class DriveCosts:
    """The cost of drives in one scene: obstacles (m, 3) [m], field (4,), capsule footprint (rear, front, radius)."""

    def __init__(
        self,
        settings: PlannerSettings,
        goal: Sequence[float],
        obstacles: FloatArray,
        field: Sequence[float],
        footprint: Sequence[float],
    ) -> None:
        self._settings, self._obstacles, self._field, self._footprint = settings, obstacles, field, footprint
        self.to_go = TimeToGo(goal, obstacles, field, footprint, settings.room)

    def of(self, states: FloatArray, knots: FloatArray, last_action: FloatArray) -> FloatArray:
        """Costs (n,) of states (n, steps, 4) under actions (n, knots, 2), after ``last_action`` (2,)."""
        settings = self._settings
        x, y, yaw, speed = (states[..., index] for index in range(4))
        left = self.to_go(x, y, yaw)
        way = left[:, -1] + settings.way_weight * left.mean(axis=1)
        room = self._room(x, y, yaw, speed)
        lacking = np.maximum(1.0 - room / settings.room, 0.0)
        near = settings.room_weight * (lacking**2).mean(axis=1) + settings.contact_weight * (room < 0.0).mean(axis=1)
        scale = np.array((settings.fastest_target - settings.slowest_target, 2.0 * settings.steer_limit))
        changes = np.diff(np.concatenate([np.broadcast_to(last_action, (len(knots), 1, 2)), knots], axis=1), axis=1)
        effort = settings.effort_weight * ((changes / scale) ** 2).sum(axis=(1, 2))
        return np.asarray(way + near + effort)

    def _room(self, x: FloatArray, y: FloatArray, yaw: FloatArray, speed: FloatArray) -> FloatArray:
        """Clearance (n, steps) [m] of the capsule, stretched by the stopping distance."""
        gain, size = self._settings.braking_gain, np.abs(speed)
        corner = self._settings.braking_deceleration / gain
        beyond = np.maximum(size - corner, 0.0) * (size + corner) / (2.0 * self._settings.braking_deceleration)
        stretch = np.sign(speed) * (np.minimum(size, corner) / gain + beyond)
        rear, front, radius = self._footprint
        ends = (-rear + np.minimum(stretch, 0.0), front + np.maximum(stretch, 0.0))
        return clearance((x, y, yaw), ends, self._obstacles, self._field) - radius


@final
class Planner:
    """The controller of one car; ``nominal`` is called once per period. The same seed and states give the same nominal actions."""

    def __init__(self, model: AbstractDynamics, settings: PlannerSettings | None = None, seed: int = 0) -> None:
        self._model, self.settings = model, settings or _settings_for(model)
        chosen = self.settings
        self._low = np.array((chosen.slowest_target, -chosen.steer_limit))
        self._high = np.array((chosen.fastest_target, chosen.steer_limit))
        self._spread = np.array((chosen.speed_spread, chosen.steer_spread))
        self._draw = np.random.default_rng(seed)
        self._knot_times: FloatArray = np.linspace(0.0, (chosen.steps - 1) * chosen.step_seconds, chosen.knots)
        self._blend = self._blended(np.arange(chosen.steps, dtype=np.float64) * chosen.step_seconds)
        self._plan = np.zeros((chosen.knots, 2))
        self._fixed = np.array([self._held(*shares) for shares in _FIXED])
        self._scene: tuple[object, ...] = ()
        self._costs: DriveCosts | None = None
        self._speeds: tuple[float, ...] = ()
        self._push = 0.0
        self._last: StateMessage | None = None

    def nominal_action(self, state: StateMessage, latent: NDArray[np.float64] | None) -> tuple[tuple[float, ...], str]:
        """Target speed [m/s] and steer [rad] that the plan begins with. Raises MessageError for an odd state."""
        costs = self._scene_costs(state)
        costs.to_go.relax(self.settings.sweeps)
        self._note_surprise(state, latent)
        self._plan = np.tensordot(self._blended(self._knot_times + state.period), self._plan, axes=1)
        before = np.array(state.applied)
        knots = self._drawn()
        states = self._rolled_out(np.array(state.values), before, knots, latent)
        cost = costs.of(states, knots, before)
        self._note_speeds(costs, states)
        self._plan = self._averaged(knots, cost)
        return tuple(self._plan[0].tolist()), "planner"

    def _averaged(self, knots: FloatArray, cost: FloatArray) -> FloatArray:
        """The weighted average (knots, 2) of those drives that go the same way as the best."""
        best = int(cost.argmin())
        alike = (np.abs(knots - knots[best]) <= _ALIKE * self._spread).all(axis=(1, 2))
        weight = np.exp(-(cost - cost[best]) / self.settings.temperature) * alike
        average = np.tensordot(weight / weight.sum(), knots, axes=1)
        return np.asarray(np.clip(average, self._low, self._high))  # shares that sum to 1 but for rounding

    def _note_surprise(self, state: StateMessage, latent: FloatArray | None) -> None:
        """What the speed did beyond the model's prediction over the last period enters the push, smoothed [m/s2]."""
        last, self._last = self._last, state
        if last is None or (last.epoch, last.tick + 1) != (state.epoch, state.tick):
            return
        before, action = np.array(last.values), np.array(state.applied)
        memory = self._model.initial_memory(np.array(last.applied), latent)
        expected, _ = self._model.advance(before, action, memory, latent, period=last.period)
        surprise = (state.values[_SPEED] - float(expected[_SPEED])) / last.period
        if math.isfinite(surprise):
            self._push += _SMOOTHING * (min(max(surprise, -_MOST_PUSH), _MOST_PUSH) - self._push)

    def _note_speeds(self, costs: DriveCosts, states: FloatArray) -> None:
        """What full speed forwards and backwards come to at the horizon, for the time to go: in steps of a quarter."""
        ends = (states[1 + _FORWARDS, -1, 3], -states[1 + _BACKWARDS, -1, 3])
        speeds = tuple(_SPEED_STEP ** round(math.log(max(_KEPT * end, _SLOWEST), _SPEED_STEP)) for end in ends)
        if speeds != self._speeds:
            self._speeds = speeds
            costs.to_go.drive_at(*speeds)

    def _drawn(self) -> FloatArray:
        """Knots (n, knots, 2): the last plan, fixed drives, and plans drawn about the last one."""
        chosen = self.settings
        count = max(chosen.samples - len(self._fixed) - 1, 1)
        noise = self._draw.normal(size=(count, chosen.knots, 2)) * self._spread
        drawn = np.clip(self._plan + noise, self._low, self._high)
        return np.concatenate([self._plan[None], self._fixed, drawn])

    def _rolled_out(
        self, state: FloatArray, before: FloatArray, knots: FloatArray, latent: FloatArray | None
    ) -> FloatArray:
        """States (n, steps, 4) after each step under the knots (n, knots, 2)."""
        actions = np.einsum("tk,nka->tna", self._blend, knots)
        current = np.broadcast_to(state, (len(knots), len(state)))
        memory = self._model.initial_memory(np.broadcast_to(before, (len(knots), 2)), latent)
        states = np.empty((len(actions), *current.shape))
        push = self._push * self.settings.step_seconds
        for index, action in enumerate(actions):
            current, memory = self._model.advance(
                current, action, memory, latent, period=self.settings.step_seconds, time=0.0
            )
            current[:, _SPEED] += push
            states[index] = current
        if not np.isfinite(states).all():
            raise MessageError(
                f"state: the model's drives from {state.tolist()} leave all bounds; wanted a plausible one"
            )
        return states.transpose(1, 0, 2)

    def _scene_costs(self, state: StateMessage) -> DriveCosts:
        """The costs of this scene and goal, kept while they stay the same."""
        if len(state.values) != 4 or len(state.goal) != 2 or len(state.applied) != 2:
            raise MessageError(
                f"state: got {len(state.values)} values, {len(state.applied)} actions and a goal of "
                f"{len(state.goal)}, wanted 4, 2 and 2"
            )
        scene = (state.goal, state.obstacles, state.field, state.footprint)
        if self._costs is None or scene != self._scene:
            if len(state.field) != 4 or len(state.footprint) != 3:
                raise MessageError(
                    f"state: got field {state.field}, footprint {state.footprint}, wanted 4 and 3 numbers"
                )
            obstacles = np.array(state.obstacles, dtype=np.float64).reshape(-1, 3)
            self._costs = DriveCosts(self.settings, state.goal, obstacles, state.field, state.footprint)
            self._scene, self._speeds = scene, ()
        return self._costs

    def _held(self, speed: float, steer: float) -> FloatArray:
        """Knots (knots, 2) of one action held: shares of the greatest speed forwards or backwards, and steer."""
        chosen = self.settings
        target = speed * chosen.fastest_target if speed >= 0.0 else -speed * chosen.slowest_target
        return np.tile((target, steer * chosen.steer_limit), (chosen.knots, 1))

    def _blended(self, times: FloatArray) -> FloatArray:
        """(times, knots): shares of the knots in the action at each time, linear between knots, the last one held."""
        return np.stack([np.interp(times, self._knot_times, row) for row in np.eye(len(self._knot_times))], axis=1)


def _settings_for(model: AbstractDynamics) -> PlannerSettings:
    """Networks cost five times what physics costs: fewer and shorter drives keep the nominal action in time."""
    learned = isinstance(model, PhysicsModel) and isinstance(model.base, LearnedBase)
    return PlannerSettings(samples=48, steps=12) if learned else PlannerSettings()
