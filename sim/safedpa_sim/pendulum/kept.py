"""Pendulums that torques at random are kept within 45 degrees: what the history encoder meets while balancing."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final

import torch

from safedpa_sim.pendulum.task import AHEAD, BALANCING, TORQUE
from safedpa_sim.training.histories import Lived, lived
from safedpa_sim.training.networks import AffineNetworks
from safedpa_sim.training.simulator import BatchedCars

__all__ = ["kept_drives", "kept_torque"]

Tensor = torch.Tensor
_ETA: Final = 0.5
_EPSILON: Final = 0.018
"""rad; about the filter's margin. Who leans on the filter comes to rest epsilon / eta inside the edge."""
_STRONGEST: Final = 4.4
"""m/s; winds in which the corridor can be kept."""
_FIRST: Final = 0.6
"""rad; largest angle at the start, at rest."""
_DRAWN_ANEW: Final = (1.0, 0.1, 0.03)
"""Probability per period that a torque is drawn anew, for a third of the pendulums each."""


def kept_torque(after: Callable[[Tensor], Tensor], state: Tensor, torque: Tensor, edges: tuple[float, float]) -> Tensor:
    """The torque (n, 1) nearest to ``torque`` that keeps (1 - eta) h + epsilon, within the bounds.

    ``after`` tells the states (n, 2) one period later under torques (n, 1): s = angle + AHEAD rate rises with them, as
    good as linearly.
    """
    lowest, highest = (_ahead(after(torch.full_like(torque, bound))) for bound in (-TORQUE, TORQUE))
    now, slope = _ahead(state), (highest - lowest) / (2.0 * TORQUE)
    least = ((1.0 - _ETA) * now + _ETA * edges[0] + _EPSILON - lowest) / slope - TORQUE
    most = ((1.0 - _ETA) * now + _ETA * edges[1] - _EPSILON - lowest) / slope - TORQUE
    within = torch.minimum(torch.maximum(torque[:, 0], least), most)
    return within.clamp(-TORQUE, TORQUE).unsqueeze(1)


def _ahead(state: Tensor) -> Tensor:
    return state[:, 0] + AHEAD * state[:, 1]


def kept_drives(
    cars: BatchedCars, networks: AffineNetworks, count: int, steps: int, change: float, generator: torch.Generator
) -> Lived:
    """``count`` pendulums for ``steps`` periods; the wind becomes another with probability ``change`` a period."""
    environment, state = _winds(cars, count, generator), torch.zeros(count, 2)
    state[:, 0] = _FIRST * (2.0 * torch.rand(count, generator=generator) - 1.0)
    anew = torch.tensor(_DRAWN_ANEW)[torch.arange(count) % len(_DRAWN_ANEW)].unsqueeze(1)
    wish, states, actions, environments = cars.draw_actions(count, generator), [state], [], []
    with torch.no_grad():
        for _ in range(steps):
            drawn = torch.rand(count, 2, generator=generator)
            wish = torch.where(drawn[:, :1] < anew, cars.draw_actions(count, generator), wish)

            def after(torque: Tensor, state: Tensor = state, wind: Tensor = environment) -> Tensor:
                return cars.advance(state, torque, wind)[0]

            torque = kept_torque(after, state, wish, BALANCING)
            state = after(torque)
            states.append(state)
            actions.append(torque)
            environments.append(environment)
            environment = torch.where(drawn[:, 1:] < change, _winds(cars, count, generator), environment)
        return lived(networks, torch.stack(states, 1), torch.stack(actions, 1), torch.stack(environments, 1))


def _winds(cars: BatchedCars, count: int, generator: torch.Generator) -> Tensor:
    drawn = cars.draw_environments(count, generator)
    limited: Tensor = drawn * (_STRONGEST / drawn.norm(dim=1, keepdim=True)).clamp_max(1.0)
    return limited
