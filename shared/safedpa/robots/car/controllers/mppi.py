"""A model predictive path integral (MPPI) controller: samples trajectories, rolls them out, averages the best.

In each period n action sequences are sampled around the last plan, u_i = u + noise, and rolled out with the model at
the current latent. The new plan is their average, weighted by the costs S_i with minimum S_min:

    u <- sum w_i u_i / sum w_i,    w_i = exp(-(S_i - S_min) / temperature)

The cost of a trajectory consists of time to go, lack of clearance and steering effort (``DriveCosts``).

Source: Williams et al., Information theoretic MPC, ICRA 2017. Additions: actions are spline knots; some fixed
trajectories are among the samples; only trajectories similar to the best one are averaged, because the mean of left and
right is straight on. The prediction error of the speed is assumed to persist (offset-free MPC, Pannocchia and Rawlings,
AIChE J. 2003), so that a load that the model misjudges does not make the controller repeat a failing plan. Its actions
are not trusted: the safety filter corrects them, as for every controller.
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
"""Constant trajectories: share of the largest speed in that direction, share of the largest steer."""
_FORWARDS, _BACKWARDS = 0, 5
"""Indices of the straight trajectories at full speed."""
_KEPT = 0.75
"""Average speed over full speed, accounting for corners and stops."""
_SLOWEST = 0.02
"""m/s; lower bound of the average speed."""
_SPEED_STEP = 1.25
_SPEED = 3
_SMOOTHING = 0.1
"""Weight of the newest prediction error in the moving average, whose memory is half a second."""
_MOST_PUSH = 3.0
"""m/s2; larger prediction errors are clipped as bumps."""
_ALIKE = 2.5
"""Standard deviations at every knot within which a trajectory counts as similar to the best one."""


@final
@dataclass(frozen=True)
class PlannerSettings:
    """Sampling and cost settings of the planner, in SI units. Raises InputError naming a value that is not positive."""

    samples: int = 128
    """Trajectories per period."""
    steps: int = 15
    """Steps of the horizon."""
    step_seconds: float = 0.1
    knots: int = 5
    """Sampled actions, evenly spaced over the horizon, with linear interpolation between them."""
    speed_spread: float = 0.8
    """m/s; standard deviation of the sampled target speeds."""
    steer_spread: float = 0.2
    """rad; standard deviation of the sampled steers."""
    temperature: float = 0.05
    """Trajectories with a cost further above the best one hardly count in the average."""
    slowest_target: float = -0.6
    fastest_target: float = 2.0
    steer_limit: float = 0.34
    braking_deceleration: float = 2.8
    """m/s2; clearance is measured from the stopping position."""
    braking_gain: float = 3.2
    """1/s; gain of the speed servo, which limits braking below braking_deceleration / braking_gain."""
    room: float = 0.15
    """m; clearance above which there is no cost."""
    room_weight: float = 8.0
    contact_weight: float = 60.0
    way_weight: float = 0.3
    """Cost per second of mean time to go along the trajectory; a second of time to go at the horizon costs 1."""
    sweeps: int = 5
    """Bellman sweeps of the time to go per period until it has converged; about 2 ms each."""
    effort_weight: float = 0.02
    """Cost of the squared change of an action from knot to knot, relative to its range."""

    def __post_init__(self) -> None:
        for item in fields(self):
            value = getattr(self, item.name)
            if not value > 0.0 and item.name != "slowest_target":
                raise InputError(f"planner, {item.name}: got {value}, wanted a positive number")
        if self.knots < 2 or self.slowest_target >= self.fastest_target:
            raise InputError(f"planner: got {self}, wanted at least 2 knots and slowest_target < fastest_target")


@final
class DriveCosts:
    """The cost of trajectories in a scene: obstacles (m, 3) [m], field (4,), footprint (rear, front, radius)."""

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
        """Returns the costs (n,) of states (n, steps, 4) under actions (n, knots, 2), after ``last_action`` (2,)."""
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
        """Returns the clearance (n, steps) [m] of the capsule extended by the stopping distance."""
        gain, size = self._settings.braking_gain, np.abs(speed)
        corner = self._settings.braking_deceleration / gain
        beyond = np.maximum(size - corner, 0.0) * (size + corner) / (2.0 * self._settings.braking_deceleration)
        stretch = np.sign(speed) * (np.minimum(size, corner) / gain + beyond)
        rear, front, radius = self._footprint
        ends = (-rear + np.minimum(stretch, 0.0), front + np.maximum(stretch, 0.0))
        return clearance((x, y, yaw), ends, self._obstacles, self._field) - radius


@final
class Planner:
    """The MPPI controller of one car; call ``nominal_action`` once per period. Deterministic in seed and states."""

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
        """Returns target speed [m/s] and steer [rad] of the plan's first knot. Raises MessageError for a bad state."""
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
        """Returns the weighted average (knots, 2) of the trajectories similar to the best one."""
        best = int(cost.argmin())
        alike = (np.abs(knots - knots[best]) <= _ALIKE * self._spread).all(axis=(1, 2))
        weight = np.exp(-(cost - cost[best]) / self.settings.temperature) * alike
        average = np.tensordot(weight / weight.sum(), knots, axes=1)
        return np.asarray(np.clip(average, self._low, self._high))  # the weights sum to 1 only up to rounding

    def _note_surprise(self, state: StateMessage, latent: FloatArray | None) -> None:
        """Updates the moving average of the model's acceleration error [m/s2] with the last period."""
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
        """Updates the attainable speeds forwards and backwards of the time to go, quantised in steps of a quarter."""
        ends = (states[1 + _FORWARDS, -1, 3], -states[1 + _BACKWARDS, -1, 3])
        speeds = tuple(_SPEED_STEP ** round(math.log(max(_KEPT * end, _SLOWEST), _SPEED_STEP)) for end in ends)
        if speeds != self._speeds:
            self._speeds = speeds
            costs.to_go.drive_at(*speeds)

    def _drawn(self) -> FloatArray:
        """Returns knots (n, knots, 2): the last plan, fixed trajectories, and samples around the last plan."""
        chosen = self.settings
        count = max(chosen.samples - len(self._fixed) - 1, 1)
        noise = self._draw.normal(size=(count, chosen.knots, 2)) * self._spread
        drawn = np.clip(self._plan + noise, self._low, self._high)
        return np.concatenate([self._plan[None], self._fixed, drawn])

    def _rolled_out(
        self, state: FloatArray, before: FloatArray, knots: FloatArray, latent: FloatArray | None
    ) -> FloatArray:
        """Returns states (n, steps, 4) after each step under the knots (n, knots, 2)."""
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
            raise MessageError(f"state: the model diverges from {state.tolist()}; wanted a plausible state")
        return states.transpose(1, 0, 2)

    def _scene_costs(self, state: StateMessage) -> DriveCosts:
        """Returns the costs for the scene and goal, cached until these change."""
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
        """Returns knots (knots, 2) of a constant action: shares of the largest speed in that direction, and steer."""
        chosen = self.settings
        target = speed * chosen.fastest_target if speed >= 0.0 else -speed * chosen.slowest_target
        return np.tile((target, steer * chosen.steer_limit), (chosen.knots, 1))

    def _blended(self, times: FloatArray) -> FloatArray:
        """Returns the interpolation matrix (times, knots): linear between knots, constant after the last one."""
        return np.stack([np.interp(times, self._knot_times, row) for row in np.eye(len(self._knot_times))], axis=1)


def _settings_for(model: AbstractDynamics) -> PlannerSettings:
    """Returns the settings for a model; networks are five times slower than physics, so they get fewer samples."""
    learned = isinstance(model, PhysicsModel) and isinstance(model.base, LearnedBase)
    return PlannerSettings(samples=48, steps=12) if learned else PlannerSettings()
