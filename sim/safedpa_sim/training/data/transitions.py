"""Random single steps of the simulator, and the scales that normalise them."""

from __future__ import annotations

from typing import NamedTuple

import torch

from safedpa.networks import frame_of
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator

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
    for name, ranges in (("action", cars.action_ranges), ("environment", cars.environment_ranges)):
        vectors[f"{name}_middle"] = ranges.mean(1)
        vectors[f"{name}_scale"] = 0.5 * (ranges[:, 1] - ranges[:, 0])
    return vectors
