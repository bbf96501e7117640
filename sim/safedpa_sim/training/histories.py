"""What robots lived through in the simulator, and the rows that the history encoder sees of it."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, NamedTuple, final

import torch

from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.networks import AffineNetworks
from safedpa_sim.training.simulator import BatchedCars

__all__ = ["Drives", "Lived", "RandomDriver", "drive_cars", "history_rows", "windows"]

Tensor = torch.Tensor

Driver = Callable[[Tensor, Tensor], Tensor]
"""Actions (cars, actions) for states (cars, states) and rows of the history so far (cars, history, row)."""


class Drives(NamedTuple):
    """States (cars, steps + 1, states), actions (cars, steps, actions), environments (cars, steps, entries)."""

    states: Tensor
    actions: Tensor
    environments: Tensor


class Lived(NamedTuple):
    """Drives with what networks make of them: rows (cars, steps, row) and latents (cars, steps, latents)."""

    drives: Drives
    rows: Tensor
    latents: Tensor

    def draw(
        self, batch: int, history: int, generator: torch.Generator, earliest: int = 0
    ) -> tuple[tuple[Tensor, Tensor], Tensor, Tensor]:
        """Moments (car, time), histories before them (batch, history, row) and latents at them (batch, latents)."""
        cars, steps = self.rows.shape[:2]
        device = self.rows.device
        car = torch.randint(cars, (batch,), generator=generator, device=device)
        time = torch.randint(earliest, steps, (batch,), generator=generator, device=device)
        return (car, time), windows(self.rows, car, time, history), self.latents[car, time]

    def transitions(self, moments: tuple[Tensor, Tensor]) -> tuple[Tensor, Tensor, Tensor]:
        """State, following state and action at moments (car, time)."""
        car, time = moments
        states, actions, _ = self.drives
        return states[car, time], states[car, time + 1], actions[car, time]


def history_rows(networks: AffineNetworks, states: Tensor, actions: Tensor) -> Tensor:
    """One row (..., n, row) per transition: states (..., n + 1, states), actions (..., n, actions).

    row = [scaled features(x_i), own-frame increment x_i -> x_{i+1} / increment_scale, u_i], as ``HistoryEncoder.rows``.
    """
    before, after = states[..., :-1, :], states[..., 1:, :]
    features = (networks.frame.features(before) - networks.feature_middle) / networks.feature_scale
    increments = networks.frame.own_increment(before, after) / networks.increment_scale
    return torch.cat((features, increments, networks.scaled_action(actions)), dim=-1)


def windows(rows: Tensor, car: Tensor, time: Tensor, history: int) -> Tensor:
    """The ``history`` rows before ``time`` (batch,) of the cars ``car`` (batch,), zeros before the first row.

    Rows (cars, steps, row) give (batch, history, row): what phi may see when the action of ``time`` is chosen.
    """
    index = time.unsqueeze(1) + torch.arange(-history, 0, device=rows.device)
    seen: Tensor = rows[car.unsqueeze(1), index.clamp_min(0)]
    return seen * (index >= 0).unsqueeze(2)


@final
class RandomDriver:
    """Actions that glide, each car at a pace of its own, towards wishes that are drawn anew now and then.

    a[t+1] = a[t] + pace (wish - a[t]); the wish changes with probability ``change`` in each period.
    """

    def __init__(self, cars: BatchedCars, count: int, generator: torch.Generator, change: float = 0.05) -> None:
        self._cars, self._count, self._generator, self._change = cars, count, generator, change
        self._wish = cars.draw_actions(count, generator)
        self._action = self._wish.clone()
        self._pace = 0.05 + 0.95 * torch.rand(count, 1, generator=generator, device=cars.device).square()

    def __call__(self, state: Tensor, rows: Tensor) -> Tensor:
        """The next actions; they depend on nothing that is seen."""
        del state, rows
        draws = torch.rand(self._count, 1, generator=self._generator, device=self._cars.device)
        fresh = self._cars.draw_actions(self._count, self._generator)
        self._wish = torch.where(draws < self._change, fresh, self._wish)
        self._action = self._action + self._pace * (self._wish - self._action)
        return self._action


def drive_cars(
    cars: BatchedCars,
    networks: AffineNetworks,
    driver: Driver,
    count: int,
    steps: int,
    generator: torch.Generator,
    configuration: Configuration,
) -> Drives:
    """Drives ``count`` cars from drawn states; now and then the environment of one changes while it drives."""
    environment = cars.draw_environments(count, generator)
    state, memory = cars.draw_states(count, generator), None
    rows = _no_rows(networks, count, configuration.history, state)
    states, actions, environments = [state], [], []
    for _ in range(steps):
        action = driver(state, rows)
        memory = cars.settled(action, environment) if memory is None else memory
        following, memory = cars.advance(state, action, environment, memory)
        row = history_rows(networks, torch.stack((state, following), 1), action.unsqueeze(1))
        rows = torch.cat((rows[:, 1:], row), dim=1)
        states.append(following)
        actions.append(action)
        environments.append(environment)
        state = following
        environment = _changed(cars, environment, configuration.phase_2.change, generator)
    return Drives(torch.stack(states, 1), torch.stack(actions, 1), torch.stack(environments, 1))


def _no_rows(networks: AffineNetworks, count: int, history: int, like: Tensor) -> Tensor:
    sizes = networks.sizes
    return like.new_zeros(count, history, sizes.features + sizes.states + sizes.actions)


def _changed(cars: BatchedCars, environment: Tensor, share: float, generator: torch.Generator) -> Any:
    """A load is hitched or let go, the wind turns: every entry is drawn anew."""
    count = len(environment)
    changes = torch.rand(count, 1, generator=generator, device=cars.device) < share
    return torch.where(changes, cars.draw_environments(count, generator), environment)
