"""Prediction errors and losses of f, g and phi: one step, rollouts in which phi sees the predictions, and
the share of the variance of the motion that they explain.
"""

from __future__ import annotations

from typing import Any

import torch

from safedpa.networks.weights import STRIDE
from safedpa_sim.training.data.transitions import Transitions, TransitionSequence, draw_transitions, history_rows
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.networks.modules import AffineNetworks, HistoryNetwork

Tensor = torch.Tensor
ALONG = 8
"""Histories, ``STRIDE`` transitions apart, that training encodes together; see ``latents_along``."""


def one_step_loss(networks: AffineNetworks, latent: Tensor, sequence: TransitionSequence, index: Tensor) -> Tensor:
    """Returns mean(((increment - f - g a) / increment_scale)^2) over transitions (batch,), latents (batch, latents)."""
    states, following = sequence.states[index], sequence.following[index]
    increment = networks.frame.own_increment(states, following) / networks.increment_scale
    predicted: Tensor = networks(states, sequence.actions[index], latent)
    loss: Tensor = (predicted - increment).square().mean()
    return loss


def along(start: Tensor) -> Tensor:
    """Returns for each start (batch,) the indices of ``ALONG`` transitions that are ``STRIDE`` apart, flattened."""
    return (start.unsqueeze(1) + STRIDE * torch.arange(ALONG, device=start.device)).flatten()


def latents_along(encoder: HistoryNetwork, rows: Tensor, count: int) -> Tensor:
    """Encodes ``count`` overlapping histories that are ``STRIDE`` rows apart, to z (batch, count, latents).

    Rows have shape (batch, history + STRIDE (count - 1), row). The convolutions are shared between the histories, which
    takes a fraction of the time of ``count`` calls of the encoder with the same result.
    """
    phi: Any = encoder.phi
    for layer in phi.dense:
        rows = torch.relu(layer(rows))
    first, second = phi.conv
    seen = torch.relu(first(rows.transpose(-1, -2)))
    seen = torch.relu(torch.nn.functional.conv1d(seen, second.weight, second.bias))
    steps = phi.out.in_features // second.out_channels
    shifted = [seen[..., STRIDE * step : STRIDE * step + count] for step in range(steps)]
    flat = torch.stack(shifted, dim=2).permute(0, 3, 1, 2).flatten(2)
    latents: Tensor = phi.out(flat)
    return latents


def rollout_errors(
    networks: AffineNetworks,
    encoder: HistoryNetwork,
    sequence: TransitionSequence,
    index: Tensor,
    steps: int,
    history: int,
) -> Tensor:
    """Returns scaled errors (steps, batch, states) of open-loop predictions from transitions (batch,) on.

    A rollout starts from the measured state and history, applies the recorded actions, and feeds phi its predictions.
    An error is the increment from the measured to the predicted state in the measured state's own frame, divided by
    increment_scale.
    """
    rows, state = sequence.histories(index, history), sequence.states[index]
    found = []
    for step in range(steps):
        action = sequence.actions[index + step]
        following = networks.step(state, action, encoder(rows))
        row = history_rows(networks, state, action, following)
        rows = torch.cat((rows[:, 1:], row.unsqueeze(1)), dim=1)
        state = following
        measured = sequence.following[index + step]
        found.append(networks.frame.own_increment(measured, state) / networks.increment_scale)
    return torch.stack(found)


def rollout_loss(
    networks: AffineNetworks,
    encoder: HistoryNetwork,
    sequence: TransitionSequence,
    index: Tensor,
    steps: int,
    history: int,
) -> Tensor:
    """Returns the mean over s of mean((error after s steps / s)^2); dividing by s gives all steps a similar weight."""
    found = rollout_errors(networks, encoder, sequence, index, steps, history)
    counts = torch.arange(1, steps + 1, device=found.device).reshape(-1, 1, 1)
    return (found / counts).square().mean()


def errors(
    networks: AffineNetworks,
    encoder: HistoryNetwork,
    sequence: TransitionSequence,
    steps: int,
    history: int,
    most: int = 4000,
) -> tuple[Tensor, Tensor]:
    """Returns the RMS of the scaled errors after one step and after ``steps``, (states,) each, without gradients.

    Uses at most ``most`` starts, spread evenly over all transitions that are followed by ``steps`` measured ones.
    """
    index = torch.arange(len(sequence.rows), device=sequence.rows.device)
    starts = index[sequence.last - index >= steps - 1]
    starts = starts[:: max(1, -(-len(starts) // most))]
    with torch.no_grad():
        found = rollout_errors(networks, encoder, sequence, starts, steps, history)
    rms = found.square().mean(1).sqrt()
    return rms[0], rms[-1]


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
