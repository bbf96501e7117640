"""Transitions: random single steps with the scales that normalise them, and drives as sequences for the encoder."""

from __future__ import annotations

from typing import NamedTuple

import torch

from safedpa.networks import frame_of
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.networks.modules import AffineNetworks

Tensor = torch.Tensor
_SAMPLES = 100_000
"""Transitions for the scales; they give the standard deviation of an increment to 0.3 %."""


class Transitions(NamedTuple):
    """Environments (n, entries), states (n, states), actions (n, actions), own-frame increments (n, states)."""

    environment: Tensor
    state: Tensor
    action: Tensor
    increment: Tensor


def draw_transitions(
    cars: BatchedSimulator,
    count: int,
    generator: torch.Generator,
    *,
    environment: Tensor | None = None,
    state: Tensor | None = None,
) -> Transitions:
    """Draws ``count`` independent single steps, each with its own environment, state and action.

    ``environment`` (entries,) or (count, entries) and ``state`` likewise fix what is otherwise random. Actuators with
    memory start settled at another random action; networks without memory see their transient as noise.
    """
    environments = (cars.draw_environments(count, generator) if environment is None else environment).expand(count, -1)
    states = (cars.draw_states(count, generator) if state is None else state).expand(count, -1)
    actions = cars.draw_actions(count, generator)
    memory = cars.settled(cars.draw_actions(count, generator), environments) if cars.remembers else ()
    following, _ = cars.advance(states, actions, environments, memory)
    increments = frame_of(cars.model.system.name).own_increment(states, following)
    return Transitions(environments, states, actions, increments)


def scales(cars: BatchedSimulator, seed: int) -> dict[str, Tensor]:
    """Returns the vectors that normalise features, actions, environments and increments.

    Ranges are mapped to [-1, 1]. An increment is divided by its standard deviation, so that predicting the mean has a
    mean square error of 1.
    """
    drawn = draw_transitions(cars, _SAMPLES, cars.generator(seed))
    features = frame_of(cars.model.system.name).features(drawn.state)
    low, high = (bound.round(decimals=2) for bound in (features.amin(0), features.amax(0)))  # -1 and 1, not -0.9999
    vectors = {
        "feature_middle": 0.5 * (low + high),
        "feature_scale": 0.5 * (high - low),
        "increment_scale": drawn.increment.std(0),
    }
    return vectors | range_scales(cars)


def range_scales(cars: BatchedSimulator) -> dict[str, Tensor]:
    """Returns the vectors that map the ranges of actions and environments to [-1, 1]."""
    vectors = {}
    for name, ranges in (("action", cars.action_ranges), ("environment", cars.environment_ranges)):
        vectors[f"{name}_middle"], vectors[f"{name}_scale"] = ranges.mean(1), 0.5 * (ranges[:, 1] - ranges[:, 0])
    return vectors


_TRIES = 3
"""Indices drawn per wanted one, as some are rejected; nearly all drives are much longer than ``before`` + ``ahead``."""


class TransitionSequence(NamedTuple):
    """The transitions of several drives, one drive after the other, with the bounds of each transition's drive."""

    states: Tensor
    """(n, states) before each transition."""
    following: Tensor
    """(n, states) after it."""
    actions: Tensor
    """(n, actions)."""
    rows: Tensor
    """(n, row): input row of the history encoder."""
    first: Tensor
    """(n,): index of the first transition of the same drive."""
    last: Tensor
    """(n,): index of its last transition."""
    latents: Tensor
    """(n, latents): mu(e) of each transition; (n, 0) if the environment is unknown."""

    def draw(self, batch: int, generator: torch.Generator, *, before: int = 0, ahead: int = 1) -> Tensor:
        """Draws indices (batch,) of transitions with at least ``before`` transitions of their drive before them and
        ``ahead`` from them on, themselves included. If no transition qualifies, draws from all."""
        index = torch.randint(len(self.rows), (_TRIES * batch,), generator=generator, device=self.rows.device)
        fits = index[self._fits(index, before, ahead)]
        if len(fits) < batch:
            every = torch.arange(len(self.rows), device=self.rows.device)
            fitting = every[self._fits(every, before, ahead)]
            fitting = fitting if len(fitting) else every
            drawn = torch.randint(len(fitting), (batch,), generator=generator, device=self.rows.device)
            return fitting[drawn]
        return fits[:batch]

    def _fits(self, index: Tensor, before: int, ahead: int) -> Tensor:
        return (index - self.first[index] >= before) & (self.last[index] - index >= ahead - 1)

    def histories(self, index: Tensor, length: int, ahead: int = 0) -> Tensor:
        """Returns ``length`` rows before transitions (batch,) and ``ahead`` from them on: (batch, length + ahead, row).

        Rows before the beginning of the drive are zero.
        """
        wanted = index.unsqueeze(1) + torch.arange(-length, ahead, device=index.device)
        there = wanted >= self.first[index].unsqueeze(1)
        return self.rows[wanted.clamp_min(0)] * there.unsqueeze(2)


def history_rows(networks: AffineNetworks, states: Tensor, actions: Tensor, following: Tensor) -> Tensor:
    """Returns the encoder row (..., row) of each transition from states (..., states) by actions (..., actions):

    [scaled features(x_i), own-frame increment x_i -> x_{i+1} / increment_scale, u_i], as ``HistoryEncoder.rows``.
    """
    features = (networks.frame.features(states) - networks.feature_middle) / networks.feature_scale
    increments = networks.frame.own_increment(states, following) / networks.increment_scale
    return torch.cat((features, increments, networks.scaled_action(actions)), dim=-1)


def transition_sequence(
    networks: AffineNetworks, states: Tensor, actions: Tensor, environments: Tensor | None = None
) -> TransitionSequence:
    """Builds a sequence from drives of equal length: states (drives, steps + 1, states), actions (drives, steps,
    actions) and, if known, environments (drives, steps, entries)."""
    drives, steps = actions.shape[:2]
    before, after = states[:, :-1], states[:, 1:]
    index = torch.arange(drives * steps, device=states.device)
    first = index - index % steps
    latents = states.new_zeros(drives, steps, 0) if environments is None else networks.encode(environments)
    rows = history_rows(networks, before, actions, after)
    flat = [part.reshape(drives * steps, part.shape[-1]) for part in (before, after, actions, rows, latents)]
    return TransitionSequence(flat[0], flat[1], flat[2], flat[3], first, first + steps - 1, flat[4])


def concatenate(parts: list[TransitionSequence]) -> TransitionSequence:
    """Concatenates sequences; the bounds of the drives are preserved."""
    starts = torch.tensor([0, *(len(part.rows) for part in parts)]).cumsum(0)[:-1].tolist()
    moved = [
        part._replace(first=part.first + start, last=part.last + start)
        for part, start in zip(parts, starts, strict=True)
    ]
    return TransitionSequence(*(torch.cat(columns) for columns in zip(*moved, strict=True)))
