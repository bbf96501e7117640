"""The networks mu, f, g and phi as torch modules; their parameter names are those of a weights file."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import pairwise
from typing import Any, Literal, final

import numpy as np
import torch
from torch import nn

from safedpa.errors import InputError
from safedpa.networks import Frame, Weights, frame_of
from safedpa.networks.weights import STRIDE

Tensor = torch.Tensor
_CHANNELS = 32
_KERNEL = 8
VECTORS = ("feature_middle", "feature_scale", "action_middle", "action_scale", "increment_scale")
ENVIRONMENT = ("environment_middle", "environment_scale")
LATENT = ("latent_low", "latent_high", "latent_nominal")


@final
class Dense(nn.ModuleList):
    """y = W_n s(... s(W_1 x + b_1) ...) + b_n for x (..., sizes[0]), shape (..., sizes[-1]); s is the activation."""

    def __init__(self, sizes: Sequence[int], activation: Literal["relu", "tanh"] = "relu") -> None:
        super().__init__(nn.Linear(inputs, outputs) for inputs, outputs in pairwise(sizes))
        self._activation = torch.relu if activation == "relu" else torch.tanh

    def forward(self, x: Tensor) -> Tensor:  # noqa: D102
        last = len(self) - 1
        for index, layer in enumerate(self):
            x = layer(x)
            if index < last:
                x = self._activation(x)
        return x


@dataclass(frozen=True)
class AffineSizes:
    """Input and output sizes of mu, f and g; with ``environment`` and ``latents`` 0, f and g have no latent."""

    features: int
    states: int
    actions: int
    environment: int
    latents: int
    hidden: int
    encoder_hidden: int = 64


@final
class AffineNetworks(nn.Module):
    """The control-affine dynamics networks f and g with the environment encoder mu. Their scales are buffers:

        n = [(features(x) - feature_middle) / feature_scale, z],  u = (a - action_middle) / action_scale
        own-frame increment = increment_scale (F(n) + G(n) u),    z = mu((e - environment_middle) / environment_scale)

    ``vectors`` holds the scales by these names; ``frame`` defaults to the frame of the robot.
    Source: Xiao et al., Safe Deep Policy Adaptation, ICRA 2024.
    """

    feature_middle: Tensor
    feature_scale: Tensor
    action_middle: Tensor
    action_scale: Tensor
    increment_scale: Tensor
    environment_middle: Tensor
    environment_scale: Tensor
    latent_low: Tensor
    latent_high: Tensor
    latent_nominal: Tensor

    def __init__(
        self, robot: str, sizes: AffineSizes, vectors: Mapping[str, Tensor], frame: Frame | None = None
    ) -> None:
        super().__init__()
        self.sizes = sizes
        self.frame = frame or frame_of(robot)
        seen, hidden = sizes.features + sizes.latents, sizes.hidden
        self.f = Dense((seen, hidden, hidden, sizes.states))
        self.g = Dense((seen, hidden, hidden, sizes.states * sizes.actions))
        if sizes.latents:
            self.mu = Dense((sizes.environment, sizes.encoder_hidden, sizes.latents))
        for name in (*VECTORS, *((*ENVIRONMENT, *LATENT) if sizes.latents else ())):
            self.register_buffer(name, torch.as_tensor(vectors[name], dtype=torch.float32).clone())

    def encode(self, environment: Tensor) -> Tensor:
        """Returns z (..., latents) = mu(e) for environments (..., entries) in SI units; (..., 0) without a latent."""
        if not self.sizes.latents:
            return environment[..., :0]
        latent: Tensor = self.mu((environment - self.environment_middle) / self.environment_scale)
        return latent

    def change_latent(self, origin: Tensor, unit: Tensor) -> None:
        """Replaces z by (z - origin) / unit, both (latents,), without changing the predictions of f and g."""
        with torch.no_grad():
            last: Any = self.mu[-1]
            last.weight.div_(unit.unsqueeze(-1))
            last.bias.sub_(origin).div_(unit)
            for network in (self.f, self.g):
                first: Any = network[0]
                of_latent = first.weight[:, self.sizes.features :]
                first.bias.add_(of_latent @ origin)
                of_latent.mul_(unit)

    def scaled_affine(self, state: Tensor, latent: Tensor) -> tuple[Tensor, Tensor]:
        """Returns F (..., states) and G (..., states, actions) at states (..., states) and latents (..., latents)."""
        features = (self.frame.features(state) - self.feature_middle) / self.feature_scale
        seen = torch.cat((features, latent), dim=-1)
        f, g = self.f(seen), self.g(seen)
        return f, g.unflatten(-1, (self.sizes.states, self.sizes.actions))

    def scaled_action(self, action: Tensor) -> Tensor:
        """Returns u (..., actions) for actions in SI units."""
        return (action - self.action_middle) / self.action_scale

    def forward(self, state: Tensor, action: Tensor, latent: Tensor) -> Tensor:
        """Returns the scaled own-frame increment F + G u, shape (..., states)."""
        f, g = self.scaled_affine(state, latent)
        increment: Tensor = f + (g * self.scaled_action(action).unsqueeze(-2)).sum(-1)
        return increment

    def step(self, state: Tensor, action: Tensor, latent: Tensor) -> Tensor:
        """Returns x[t+1] (..., states) for states and actions in SI units; differentiable."""
        own = self.increment_scale * self(state, action, latent)
        following: Tensor = state + self.frame.world_increment(state, own)
        return following


@final
class HistoryNetwork(nn.Module):
    """The history encoder z = phi(rows) for rows (batch, history, row): two dense layers per row, two convolutions.

    The result is not clipped to the latent's range, so that gradients do not vanish. Raises InputError when the history
    is too short for the convolutions.
    Source: the 1-D CNN of Kumar et al., RMA: Rapid Motor Adaptation, RSS 2021, in the sizes of SafeDPA's related code.
    """

    def __init__(self, row: int, history: int, latents: int) -> None:
        super().__init__()
        steps = history
        for _ in range(2):
            steps = (steps - _KERNEL) // STRIDE + 1 if steps >= _KERNEL else 0
        if steps < 1:
            raise InputError(f"history: got {history}, too short for two convolutions; wanted 36 or more")
        channels = _CHANNELS
        phi = nn.Module()
        phi.dense = nn.ModuleList((nn.Linear(row, channels), nn.Linear(channels, channels)))
        phi.conv = nn.ModuleList(nn.Conv1d(channels, channels, _KERNEL, STRIDE) for _ in range(2))
        phi.out = nn.Linear(channels * steps, latents)
        self.phi = phi

    def forward(self, rows: Tensor) -> Tensor:  # noqa: D102
        phi: Any = self.phi
        for layer in phi.dense:
            rows = torch.relu(layer(rows))
        channels = rows.transpose(-1, -2)
        for layer in phi.conv:
            channels = torch.relu(layer(channels))
        latent: Tensor = phi.out(channels.flatten(-2))
        return latent


def unit_latent(latents: int) -> dict[str, Tensor]:
    """Returns the latent's range before training: -1 to 1, nominal 0."""
    zeros = torch.zeros(latents)
    return {"latent_low": zeros - 1.0, "latent_high": zeros + 1.0, "latent_nominal": zeros}


def affine_networks(weights: Weights) -> AffineNetworks:
    """Builds f and g, and mu if present, from a weights file."""
    described = weights.description
    latents = described.latents
    names = (*VECTORS, *((*ENVIRONMENT, *LATENT) if latents else ()))
    sizes = AffineSizes(
        features=len(weights["feature_middle"]),
        states=len(described.states),
        actions=len(described.actions),
        environment=len(described.environment),
        latents=latents,
        hidden=len(weights["f.0.bias"]),
        encoder_hidden=len(weights["mu.0.bias"]) if latents else 0,
    )
    networks = AffineNetworks(described.robot, sizes, {name: _tensor(weights[name]) for name in names})
    _fill(networks, weights)
    return networks


def history_network(weights: Weights) -> HistoryNetwork:
    """Builds phi from a weights file; raises InputError when the file has no phi."""
    described = weights.description
    network = HistoryNetwork(weights["phi.dense.0.weight"].shape[1], described.history, described.latents)
    _fill(network, weights)
    return network


def tensors_of(module: nn.Module) -> dict[str, np.ndarray[Any, Any]]:
    """Returns parameters and buffers as NumPy arrays by the names of a weights file."""
    return {name: tensor.detach().cpu().numpy().copy() for name, tensor in module.state_dict().items()}


def _fill(module: nn.Module, weights: Weights) -> None:
    try:
        module.load_state_dict({name: _tensor(weights[name]) for name in module.state_dict()})
    except RuntimeError as error:
        raise InputError(f"weights: they do not fit the networks ({error})") from error


def _tensor(values: np.ndarray[Any, Any]) -> Tensor:
    return torch.from_numpy(np.array(values, dtype=np.float32))
