"""How well f, g and phi predict: one step, and many steps with phi looking at the predictions themselves."""

from __future__ import annotations

from typing import Any

import torch

from safedpa.networks.weights import STRIDE
from safedpa_sim.training.histories import TransitionSequence, history_rows
from safedpa_sim.training.networks import AffineNetworks, HistoryNetwork

__all__ = ["ALONG", "along", "errors", "latents_along", "one_step_loss", "rollout_errors", "rollout_loss"]

Tensor = torch.Tensor
ALONG = 8
"""Histories that training encodes together, ``STRIDE`` transitions apart: see ``latents_along``."""


def one_step_loss(networks: AffineNetworks, latent: Tensor, lived: TransitionSequence, index: Tensor) -> Tensor:
    """mean(((increment - f - g a) / increment_scale)^2) of transitions (batch,) with latents (batch, latents)."""
    states, following = lived.states[index], lived.following[index]
    increment = networks.frame.own_increment(states, following) / networks.increment_scale
    predicted: Tensor = networks(states, lived.actions[index], latent)
    loss: Tensor = (predicted - increment).square().mean()
    return loss


def along(start: Tensor) -> Tensor:
    """The ``ALONG`` transitions that follow each other ``STRIDE`` apart from each start (batch,) on, in one row."""
    return (start.unsqueeze(1) + STRIDE * torch.arange(ALONG, device=start.device)).flatten()


def latents_along(encoder: HistoryNetwork, rows: Tensor, count: int) -> Tensor:
    """z (batch, count, latents) of ``count`` histories that follow each other ``STRIDE`` rows apart.

    Rows (batch, history + STRIDE (count - 1), row). The convolutions are computed once for all of them, so that it
    costs a fraction of so many calls of the encoder, and gives the same numbers.
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
    lived: TransitionSequence,
    index: Tensor,
    steps: int,
    history: int,
) -> Tensor:
    """Scaled errors (steps, batch, states) of predictions from transitions (batch,) on, 1 to ``steps`` periods ahead.

    Only the state at the start and what was before it is measured; the actions are those of the drive, and from step to
    step phi looks at what was predicted. An error is the way from the measured to the predicted state, in the frame of
    the measured one, over increment_scale.
    """
    rows, state = lived.histories(index, history), lived.states[index]
    found = []
    for step in range(steps):
        action = lived.actions[index + step]
        following = networks.step(state, action, encoder(rows))
        row = history_rows(networks, state, action, following)
        rows = torch.cat((rows[:, 1:], row.unsqueeze(1)), dim=1)
        state = following
        measured = lived.following[index + step]
        found.append(networks.frame.own_increment(measured, state) / networks.increment_scale)
    return torch.stack(found)


def rollout_loss(
    networks: AffineNetworks,
    encoder: HistoryNetwork,
    lived: TransitionSequence,
    index: Tensor,
    steps: int,
    history: int,
) -> Tensor:
    """mean over s of mean((error after s steps / s)^2): late errors are larger, and count alike."""
    found = rollout_errors(networks, encoder, lived, index, steps, history)
    counts = torch.arange(1, steps + 1, device=found.device).reshape(-1, 1, 1)
    return (found / counts).square().mean()


def errors(
    networks: AffineNetworks,
    encoder: HistoryNetwork,
    lived: TransitionSequence,
    steps: int,
    history: int,
    most: int = 4000,
) -> tuple[Tensor, Tensor]:
    """Root mean square of the scaled errors after one step and after ``steps``, (states,) each, without gradients.

    Over at most ``most`` starts, evenly spread over all transitions from which ``steps`` are measured.
    """
    index = torch.arange(len(lived.rows), device=lived.rows.device)
    starts = index[lived.last - index >= steps - 1]
    starts = starts[:: max(1, -(-len(starts) // most))]
    with torch.no_grad():
        found = rollout_errors(networks, encoder, lived, starts, steps, history)
    rms = found.square().mean(1).sqrt()
    return rms[0], rms[-1]
