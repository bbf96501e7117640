"""Phase 1a for networks that are not affine in the action: H(x, z, a) and mu, trained jointly on the same pairs.

The pairs, the scales, the optimiser and its rates are those of ``train_affine`` with the same configuration; only the
form differs. What is trained is written and read by ``FreeModel``, which no filter of the services takes.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from datetime import UTC, datetime
from typing import Any, final

import torch
from torch import nn

from safedpa.networks import Description, frame_of
from safedpa_lab.point.free_model import FreeModel
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.data.transitions import Transitions, draw_transitions, scales
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.networks.modules import ENVIRONMENT, VECTORS, Dense, tensors_of
from safedpa_sim.training.networks.prediction_errors import explained
from safedpa_sim.training.progress import ReportProgress, silent

Tensor = torch.Tensor
_SCALES, _TRAINING, _HELD_OUT = 1, 2, 3
"""Streams of ``train_affine``: configuration.seed * 10 + this; so are the pairs the same."""
_HELD = 20_000
_REPORT_PROGRESS_STEPS = 200


@final
class FreeNetworks(nn.Module):
    """mu and H with their scales, which are buffers:

    n = [(features(x) - feature_middle) / feature_scale, z],  u = (a - action_middle) / action_scale
    own-frame increment = increment_scale H([n, u]),          z = mu((e - environment_middle) / environment_scale)
    """

    feature_middle: Tensor
    feature_scale: Tensor
    action_middle: Tensor
    action_scale: Tensor
    increment_scale: Tensor
    environment_middle: Tensor
    environment_scale: Tensor

    def __init__(self, cars: BatchedSimulator, configuration: Configuration, vectors: Mapping[str, Tensor]) -> None:
        super().__init__()
        system, latents = cars.model.system, configuration.latents
        self.frame = frame_of(system.name)
        hidden = free_hidden(configuration.phase_1a.hidden)
        seen = len(self.frame.feature_names) + latents + len(system.action)
        self.h = Dense((seen, hidden, hidden, len(system.state)))
        self.mu = Dense((len(cars.entries), configuration.phase_1a.encoder_hidden, latents))
        for name in (*VECTORS, *ENVIRONMENT):
            self.register_buffer(name, torch.as_tensor(vectors[name], dtype=torch.float32).clone())

    def encode(self, environment: Tensor) -> Tensor:
        """z (..., latents) = mu(e) for environments (..., entries) in SI units."""
        latent: Tensor = self.mu((environment - self.environment_middle) / self.environment_scale)
        return latent

    def forward(self, state: Tensor, action: Tensor, latent: Tensor) -> Tensor:
        """The scaled own-frame increment H, shape (..., states)."""
        features = (self.frame.features(state) - self.feature_middle) / self.feature_scale
        scaled = (action - self.action_middle) / self.action_scale
        increment: Tensor = self.h(torch.cat((features, latent, scaled), dim=-1))
        return increment


def free_hidden(affine: int) -> int:
    """Neurons a layer of H with as many weights in the middle as f and g of ``affine`` neurons have together."""
    return round(math.sqrt(2.0) * affine)


def train_free(
    configuration: Configuration, report_progress: ReportProgress = silent
) -> tuple[FreeModel, dict[str, Any]]:
    """Minimises mean(((increment - predicted) / increment_scale)^2) by Adam, as ``train_affine`` does, in one pass.

    Returns the model and loss, share of variance explained and error for each state on held-out transitions.
    """
    cars, phase = BatchedSimulator(configuration), configuration.phase_1a
    vectors = scales(cars, configuration.seed * 10 + _SCALES)
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(configuration.seed)
        networks = FreeNetworks(cars, configuration, vectors)
    optimiser = torch.optim.Adam(networks.parameters(), phase.learning_rate, fused=True)
    generator = cars.generator(configuration.seed * 10 + _TRAINING)
    steps = math.ceil(phase.pairs / phase.batch)
    for done in range(steps):
        share = 0.5 * (1.0 + math.cos(math.pi * done / steps))
        for group in optimiser.param_groups:
            group["lr"] = phase.last_learning_rate + (phase.learning_rate - phase.last_learning_rate) * share
        environment, state, action, increment = draw_transitions(cars, phase.batch, generator)
        predicted = networks(state, action, networks.encode(environment))
        loss = (predicted - increment / networks.increment_scale).square().mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
        if (done + 1) % _REPORT_PROGRESS_STEPS == 0 or done + 1 == steps:
            report_progress("free", (done + 1) * phase.batch, steps * phase.batch, f"loss {float(loss.detach()):.2e}")
    held_out = draw_transitions(cars, _HELD, cars.generator(configuration.seed * 10 + _HELD_OUT))
    summary = {"pairs": steps * phase.batch, **held_out_errors(networks, held_out)}
    return FreeModel(tensors_of(networks), _described(cars, configuration, summary)), summary


def held_out_errors(networks: FreeNetworks, held_out: Transitions) -> dict[str, Any]:
    """Loss, share of variance explained and root mean square error (own frame, SI units), by state: as ``evaluate``."""
    environment, state, action, increment = held_out
    with torch.inference_mode():
        predicted = networks.increment_scale * networks(state, action, networks.encode(environment))
        error = predicted - increment
        return {
            "loss": float((error / networks.increment_scale).square().mean()),
            "explained": explained(predicted, increment).tolist(),
            "rms_error": error.square().mean(0).sqrt().tolist(),
        }


def _described(cars: BatchedSimulator, configuration: Configuration, summary: Mapping[str, Any]) -> Description:
    system = cars.model.system
    return Description(
        robot=system.name,
        period=cars.model.period,
        states=system.state_names,
        actions=system.action_names,
        latents=configuration.latents,
        environment=cars.entries,
        trained_on={
            "configuration": configuration.as_table(),
            "date": datetime.now(UTC).strftime("%Y-%m-%d"),
            "phase": "1a, free",
            "pairs": summary["pairs"],
            "seed": configuration.seed,
            "loss": summary["loss"],
        },
    )
