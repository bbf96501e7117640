"""Simulated drives for training: under random actions, or to goals with the policy and phi's latent.

``Drawbars`` adds what the effect ``towed_load`` lacks. In the library a towed load pulls in line with the car. A real
load swings on a drawbar and pulls the rear of the car to the side. With the hitch h behind the tracked point, and the
load's centre l behind the hitch and moving without side slip, the angle theta between load and car obeys

    d(theta)/dt = -(speed sin(theta) + h yaw_rate cos(theta)) / l - yaw_rate,   |theta| <= stop

The load pulls along the drawbar with mass_ratio (deceleration sign(speed) + d(speed)/dt) per mass of the car. The tyres
balance the lateral part s = -pull sin(theta) by slipping, so the car drifts and turns by

    sideways speed = slip s (|speed| + 0.3 m/s),   yaw rate -= lever slip s (|speed| + 0.3 m/s)

h, l, stop, slip and lever of a future load are unknown. They are drawn from wide ranges for each car, so that the
history encoder learns to estimate them. Source: the kinematic trailer, Rajamani, Vehicle Dynamics and Control, 2nd ed.,
and tyres of constant cornering stiffness; all ranges are assumed.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, final

import numpy as np
import torch

from safedpa.networks import Weights
from safedpa_sim.training.data.transitions import TransitionSequence, history_rows, transition_sequence
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.networks.modules import AffineNetworks, HistoryNetwork

_RANGES = {"hitch": (0.03, 0.15), "length": (0.2, 0.6), "stop": (0.6, 1.2), "slip": (0.006, 0.04), "lever": (2.5, 5.5)}
"""h, l [m], stop [rad], slip [s2/m], lever [1/m]."""
_SLOWEST = 0.3
"""m/s added to the speed in the slip, as in the equation above."""
_REST = 0.03
"""m/s; below this speed the pull of friction fades to 0 instead of jumping."""
_LOAD = ("towed_load.mass_ratio", "towed_load.deceleration")


@final
class Drawbars:
    """The swinging loads of ``count`` cars, initially straight behind them; inactive if e has no towed load."""

    def __init__(self, cars: BatchedSimulator, count: int, generator: torch.Generator) -> None:
        paths = [entry.path for entry in cars.entries]
        self._columns = tuple(paths.index(path) for path in _LOAD) if set(_LOAD) <= set(paths) else ()
        self._cars, self._generator = cars, generator
        self._drawn = self._draw(count)
        self._angle = torch.zeros(count, device=cars.device)
        self._last = torch.zeros(count, device=cars.device)
        """Change of speed in the last period."""

    def environment(self, environment: Tensor) -> Tensor:
        """Returns e with the load's deceleration reduced to its part in line with the car, times cos(theta)."""
        if not self._columns:
            return environment
        seen = environment.clone()
        seen[:, self._columns[1]] *= torch.cos(self._angle)
        return seen

    def pulled(self, state: Tensor, following: Tensor, environment: Tensor) -> Tensor:
        """Adds the lateral pull to the next states (count, 4) and advances the swing angles by one period."""
        if not self._columns:
            return following
        period, drawn = self._cars.model.period, self._drawn
        ratio, deceleration = (environment[:, column] for column in self._columns)
        speed = 0.5 * (state[:, 3] + following[:, 3])
        rate = (following[:, 2] - state[:, 2]) / period
        pull = ratio * (deceleration * torch.tanh(speed / _REST) + self._last / period)
        aside = -pull * torch.sin(self._angle) * drawn["slip"] * (speed.abs() + _SLOWEST) * period
        turn = -drawn["lever"] * aside
        yaw = state[:, 2] + 0.5 * (rate * period + turn)
        swing = (speed * torch.sin(self._angle) + drawn["hitch"] * rate * torch.cos(self._angle)) / drawn["length"]
        angle = self._angle - period * (swing + rate)
        self._angle = torch.maximum(torch.minimum(angle, drawn["stop"]), -drawn["stop"])
        self._last = following[:, 3] - state[:, 3]
        change = torch.stack((-torch.sin(yaw) * aside, torch.cos(yaw) * aside, turn, torch.zeros_like(turn)), 1)
        along = 0.5 * turn * speed * period
        change[:, 0] -= torch.sin(yaw) * along
        change[:, 1] += torch.cos(yaw) * along
        return following + change

    def renew(self, which: Tensor) -> None:
        """Replaces the loads of the cars marked in ``which`` (count,) by new ones straight behind them."""
        new = self._draw(len(which))
        self._drawn = {name: torch.where(which, new[name], values) for name, values in self._drawn.items()}
        self._angle = torch.where(which, torch.zeros_like(self._angle), self._angle)

    def _draw(self, count: int) -> dict[str, Tensor]:
        def uniform(low: float, high: float) -> Tensor:
            return low + (high - low) * torch.rand(count, generator=self._generator, device=self._cars.device)

        return {name: uniform(*pair) for name, pair in _RANGES.items()}


Tensor = torch.Tensor
_SPEED = 3
"""Index of the speed in the car's state."""


@final
class RandomDriver:
    """Random actions that approach randomly redrawn targets, each car at its own pace.

    a[t+1] = a[t] + pace (target - a[t]). Each entry of the target changes with probability ``change`` per period. The
    pace is 1 (steps) for a third of the cars, and between 0.05 and 1, mostly slow, for the others.
    """

    def __init__(self, cars: BatchedSimulator, count: int, generator: torch.Generator, change: float = 0.04) -> None:
        self._cars, self._count, self._generator, self._change = cars, count, generator, change
        self._nominal = cars.draw_actions(count, generator)
        self._action = self._nominal.clone()
        drawn = self._drawn(2)
        pace = 0.05 + 0.95 * drawn[:, :1].square()
        self._pace = torch.where(drawn[:, 1:] < 1.0 / 3.0, torch.ones_like(pace), pace)

    def action(self) -> Tensor:
        """Returns the next actions (count, actions)."""
        new = self._cars.draw_actions(self._count, self._generator)
        self._nominal = torch.where(self._drawn(new.shape[1]) < self._change, new, self._nominal)
        self._action = self._action + self._pace * (self._nominal - self._action)
        return self._action

    def _drawn(self, columns: int) -> Tensor:
        return torch.rand(self._count, columns, generator=self._generator, device=self._cars.device)


def random_drives(
    cars: BatchedSimulator,
    networks: AffineNetworks,
    count: int,
    steps: int,
    change: float,
    generator: torch.Generator,
    *,
    swinging: bool = False,
) -> TransitionSequence:
    """Simulates ``count`` drives under ``RandomDriver``; environments change with probability ``change`` per period.

    With ``swinging``, loads also pull to the side (see ``Drawbars``) and cars start at rest; otherwise at any speed.
    """
    environment = cars.draw_environments(count, generator)
    state = cars.draw_states(count, generator)
    bars = Drawbars(cars, count, generator) if swinging else None
    if swinging:
        state = state * (torch.arange(state.shape[1], device=cars.device) != _SPEED)
    driver = RandomDriver(cars, count, generator)
    memory, states, actions, environments = None, [state], [], []
    with torch.no_grad():
        for _ in range(steps):
            action = driver.action()
            felt = environment if bars is None else bars.environment(environment)
            memory = cars.settled(action, felt) if memory is None else memory
            following, memory = cars.advance(state, action, felt, memory)
            state = following if bars is None else bars.pulled(state, following, environment)
            states.append(state)
            actions.append(action)
            environments.append(environment)
            changes = torch.rand(count, generator=generator, device=cars.device) < change
            environment = torch.where(changes[:, None], cars.draw_environments(count, generator), environment)
            if bars is not None:
                bars.renew(changes)
        return transition_sequence(
            networks, torch.stack(states, 1), torch.stack(actions, 1), torch.stack(environments, 1)
        )


def policy_drives(
    driving: Any, weights: Weights, networks: AffineNetworks, encoder: HistoryNetwork, steps: int, history: int
) -> TransitionSequence:
    """Simulates drives of a policy whose latent is phi(history), so that phi is trained on the histories it causes.

    The end of an episode and a contact end a drive, because the free motion in the simulator explains neither.
    """
    choose = _chooser(weights)
    low, high = weights["latent_low"], weights["latent_high"]
    count = driving.count
    seen = torch.zeros(count, history, networks.sizes.features + networks.sizes.states + networks.sizes.actions)
    first = np.zeros(count, dtype=np.int64)
    columns: list[tuple[Any, ...]] = []
    firsts = []
    for step in range(steps):
        with torch.no_grad():
            latent = encoder(seen).numpy().clip(low, high)
        truth, driving.latent = driving.latent, latent
        chosen = choose(driving.observation())
        driving.latent = truth
        before, known = driving.state.copy(), truth.copy()
        moved = driving.advance(chosen.astype(np.float32))
        tensors = [torch.from_numpy(np.array(part)) for part in (before, driving.state, driving.applied, known)]
        row = history_rows(networks, tensors[0], tensors[2], tensors[1])
        seen = torch.cat((seen[:, 1:], row.unsqueeze(1)), dim=1)
        columns.append((tensors[0], tensors[1], tensors[2], row, tensors[3]))
        firsts.append(first.copy())
        over = moved.reached | moved.timed_out | moved.contact
        driving.restart(np.flatnonzero(moved.reached | moved.timed_out))
        seen[torch.from_numpy(over)] = 0.0
        first[over] = step + 1
    return _split_into_drives(columns, np.stack(firsts, 1))


def _chooser(weights: Weights) -> Callable[[Any], Any]:
    """Returns the policy of the weights: observations to actions (count, actions), each in [-1, 1] over its range."""
    if weights.description.robot == "point":
        from safedpa_sim.point.latent_policy import LatentPolicy

        return LatentPolicy(weights).chosen
    from safedpa.policy.learned import LearnedPolicy

    policy = LearnedPolicy(weights)
    return lambda observation: (policy.act(observation) - weights["action_middle"]) / weights["action_scale"]


def _split_into_drives(columns: list[tuple[Any, ...]], firsts: np.ndarray[Any, Any]) -> TransitionSequence:
    """Joins the steps car by car; ``firsts`` (count, steps) holds the step at which the drive of each step began."""
    count, steps = firsts.shape
    parts = [torch.stack(column, 1).flatten(0, 1) for column in zip(*columns, strict=True)]
    first = torch.from_numpy(firsts + steps * np.arange(count)[:, np.newaxis]).flatten()
    index = torch.arange(count * steps)
    ends = torch.cat((first[1:] == index[1:], torch.tensor([True])))
    after = torch.where(ends, index, count * steps)
    last = after.flip(0).cummin(0).values.flip(0)
    return TransitionSequence(parts[0], parts[1], parts[2], parts[3], first, last, parts[4])
