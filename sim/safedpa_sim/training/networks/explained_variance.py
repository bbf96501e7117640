"""The share of the variance of the motion that a model explains, and the part that no control-affine model can."""

from __future__ import annotations

from typing import Any

import torch

from safedpa_sim.training.data.transitions import Transitions, draw_transitions
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.networks.modules import AffineNetworks

Tensor = torch.Tensor


def explained(predicted: Tensor, measured: Tensor) -> Tensor:
    """Returns 1 - mean((measured - predicted)^2) / variance(measured) for each column of (n, columns)."""
    return 1.0 - (measured - predicted).square().mean(0) / measured.var(0, correction=0)


def evaluate(networks: AffineNetworks, held_out: Transitions) -> dict[str, Any]:
    """Returns loss, and for each state explained variance and RMS error (own frame, SI units), on transitions."""
    environment, state, action, increment = held_out
    with torch.inference_mode():
        predicted = networks.increment_scale * networks(state, action, networks.encode(environment))
        error = predicted - increment
        return {
            "loss": float((error / networks.increment_scale).square().mean()),
            "explained": explained(predicted, increment).tolist(),
            "rms_error": error.square().mean(0).sqrt().tolist(),
        }


def affine_floor(cars: BatchedSimulator, generator: torch.Generator, points: int = 500, actions: int = 200) -> Tensor:
    """Returns for each state the share of the increments' variance that no f + g a can explain, (states,).

    At each of ``points`` states and environments, the increments under ``actions`` random actions are fitted by least
    squares in (1, a). The residual is the part that is not affine in a: tan(steer), the servo's limit, curved paths.
    """
    environments = cars.draw_environments(points, generator).repeat_interleave(actions, 0)
    states = cars.draw_states(points, generator).repeat_interleave(actions, 0)
    drawn = draw_transitions(cars, points * actions, generator, environment=environments, state=states)
    increment = drawn.increment.double().reshape(points, actions, -1)
    regressors = torch.cat((torch.ones_like(drawn.action[:, :1]), drawn.action), dim=1).double()
    regressors = regressors.reshape(points, actions, -1)
    fitted: Tensor = regressors @ torch.linalg.lstsq(regressors, increment).solution
    freedom = actions / (actions - regressors.shape[-1])  # makes the variance of the residual unbiased
    left = (increment - fitted).square().mean((0, 1)) * freedom
    return left / draw_transitions(cars, 100_000, generator).increment.double().var(0)
