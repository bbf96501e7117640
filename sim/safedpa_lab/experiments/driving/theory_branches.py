"""Drives in the training simulator at whose ends the truth is known: what the theory's constants are measured on.

Robots drive in constant environments e, under actions held for a while; the history encoder watches. At the end, each
state branches into several actions.
"""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.networks import HistoryEncoder, LearnedNetworks
from safedpa_lab.theory.measure import Branches
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator

_LONGER = 30
"""Transitions beyond a full history, at most: drives end at different times of their held actions."""
_CHANGE = 1.0 / 30.0
"""Probability with which an action changes in a period: every 1.5 s at 20 Hz."""


def simulated_branches(
    networks: LearnedNetworks, configuration: Configuration, count: int, actions: int, seed: int
) -> Branches:
    """``count`` states at the end of drives, each left with ``actions`` drawn ones.

    Weights without a history encoder are given z itself: eps_z is then 0. Raises InputError when the networks know
    another environment than the configuration draws, or have no mu.
    """
    cars = BatchedSimulator(configuration)
    paths = tuple(entry.path for entry in cars.entries)
    known = tuple(entry.path for entry in networks.description.environment)
    if paths != known or not networks.weights.has("mu"):
        raise InputError(f"weights: trained on {known}, the configuration draws {paths}; give the one of the training")
    draw = np.random.default_rng(seed)
    generator = cars.generator(seed)
    environment = cars.draw_environments(count, generator).double().numpy()
    start = cars.draw_states(count, generator).double().numpy()
    ranges = cars.action_ranges.double().numpy()
    history = networks.description.history or configuration.history
    states, acted = _driven(cars.model, start, environment, ranges, history + _LONGER, draw)
    ends = draw.integers(history, states.shape[1], count)
    state, latent = states[np.arange(count), ends], networks.encode(environment)
    action = draw.uniform(ranges[:, 0], ranges[:, 1], (count, actions, len(ranges)))
    following = cars.model.step(
        np.repeat(state, actions, axis=0), action.reshape(-1, len(ranges)), np.repeat(environment, actions, axis=0)
    )
    return Branches(
        state=state,
        latent=latent,
        deployed=_watched(networks, states, acted, ends) if networks.weights.has("phi") else latent,
        action=action,
        following=following.reshape(count, actions, -1),
    )


def _watched(networks: LearnedNetworks, states: FloatArray, actions: FloatArray, ends: NDArray[np.int64]) -> FloatArray:
    """z^ (n, latents) from the full history before each drive's end."""
    encoder = HistoryEncoder(networks.weights)
    rows = encoder.rows(states, actions)
    return encoder.encode(np.stack([row[end - encoder.length : end] for row, end in zip(rows, ends, strict=True)]))


def _driven(
    model: Any, state: FloatArray, environment: FloatArray, ranges: FloatArray, steps: int, draw: np.random.Generator
) -> tuple[FloatArray, FloatArray]:
    """States (n, steps + 1, states) and actions (n, steps, actions) under actions that are held and then redrawn."""
    low, high = ranges[:, 0], ranges[:, 1]
    action = draw.uniform(low, high, (len(state), len(low)))
    states, actions = [state], []
    memory = model.initial_memory(action, environment)
    for _ in range(steps):
        again = draw.random((len(state), 1)) < _CHANGE
        action = np.where(again, draw.uniform(low, high, action.shape), action)
        state, memory = model.advance(state, action, memory, environment)
        states.append(state)
        actions.append(action)
    return np.stack(states, axis=1), np.stack(actions, axis=1)
