"""Export of trained networks to what the services load: a weights file and its model file."""

from __future__ import annotations

from collections.abc import Mapping
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import torch

from safedpa.dynamics import PhysicsModel, Setting, save_model
from safedpa.dynamics.learned_base import LearnedBase
from safedpa.dynamics.settings import LATENT_PREFIX
from safedpa.networks import Description, Weights
from safedpa_sim.training.configuration import Configuration
from safedpa_sim.training.environments.batched_simulator import BatchedSimulator
from safedpa_sim.training.networks.modules import AffineNetworks, tensors_of

_SAMPLES = 100_000
_BEYOND = 0.1
"""Margin of the latent's range beyond what training saw, as a share of that range."""
_LEAST_SPREAD = 1e-3
"""Lower bound of the spread; keeps the scale of an unused entry of z finite."""


def normalise_latent(networks: AffineNetworks, cars: BatchedSimulator, seed: int) -> None:
    """Normalises z to 0 in the neutral environment and a standard deviation of 1; sets latent_low, _high and _nominal.

    mu's last layer is changed to (z - nominal) / spread, the first layers of f and g undo it, so that predictions stay
    the same. The sign of each entry is chosen so that its range extends further up than down. The range is that of
    mu(e) plus a tenth.
    """
    if not networks.sizes.latents:
        return
    with torch.no_grad():
        environments = cars.draw_environments(_SAMPLES, cars.generator(seed))
        seen, nominal = networks.encode(environments), networks.encode(cars.nominal)
        upwards = seen.amax(0) - nominal >= nominal - seen.amin(0)
        spread = seen.std(0).clamp_min(_LEAST_SPREAD)
        networks.change_latent(nominal, torch.where(upwards, spread, -spread))
        seen = networks.encode(environments)
        low, high = seen.amin(0).clamp_max(0.0), seen.amax(0).clamp_min(0.0)
        beyond = (_BEYOND * (high - low)).clamp_min(_LEAST_SPREAD)
        networks.latent_low.copy_(low - beyond)
        networks.latent_high.copy_(high + beyond)
        networks.latent_nominal.zero_()


def export_weights(
    networks: AffineNetworks,
    cars: BatchedSimulator,
    configuration: Configuration,
    trained_on: Mapping[str, Any],
    states: tuple[str, ...] = (),
) -> Weights:
    """Returns the weights of mu, f and g; their description holds configuration, date and ``trained_on``.

    ``states`` names the entries that the networks see and predict, by default those of the robot's state.
    """
    system, latents = cars.model.system, networks.sizes.latents
    described = Description(
        robot=system.name,
        period=cars.model.period,
        states=states or system.state_names,
        actions=system.action_names,
        latents=latents,
        history=configuration.history if latents else 0,
        environment=cars.entries if latents else (),
        trained_on={
            "configuration": configuration.as_table(),
            "date": datetime.now(UTC).strftime("%Y-%m-%d"),
            **trained_on,
        },
    )
    return Weights(tensors_of(networks), described)


def export_model(weights: Weights, simulator: PhysicsModel, path: Path) -> None:
    """Writes the model file ``path`` and the weights file of the same name with .safetensors.

    The physics base keeps the simulator's parameter values, so that effects can be added on top. z is a free parameter
    with its nominal value.
    """
    base = LearnedBase(simulator.base, weights)
    settings = {name: value for name, value in simulator.settings.items() if name.startswith("base.")}
    for index, value in enumerate(weights["latent_nominal"].tolist() if weights.description.latents else ()):
        settings[f"base.{LATENT_PREFIX}{index}"] = Setting(value, free=True)
    path.parent.mkdir(parents=True, exist_ok=True)
    save_model(PhysicsModel(base, (), settings, simulator.period), path)
