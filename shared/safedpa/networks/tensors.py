"""The learned dynamics on torch tensors, with gradients, for fits over many states. Needs torch."""

from __future__ import annotations

from typing import Any, final

import numpy as np
import torch

from safedpa.networks.frame import frame_of
from safedpa.networks.layers import layers_of
from safedpa.networks.weights import Weights

__all__ = ["TensorNetworks"]


@final
class TensorNetworks:
    """f + g a as in ``LearnedNetworks``, for tensors of any precision."""

    def __init__(self, weights: Weights) -> None:
        self._frame = frame_of(weights.description.robot)
        self._layers = {name: layers_of(weights.tensors, name) for name in ("f", "g")}
        self._weights = weights

    def change(self, entries: list[Any], latent: list[Any], action: list[Any]) -> list[Any]:
        """Returns the change of each entry of the state over one period; arguments are tensors or numbers."""
        like = next(value for value in (*entries, *latent, *action) if isinstance(value, torch.Tensor))
        tensors = torch.broadcast_tensors(  # type: ignore[no-untyped-call]
            *(torch.as_tensor(value, dtype=like.dtype, device=like.device) for value in (*entries, *latent, *action))
        )
        states, latents = len(entries), len(latent)
        x = torch.stack(tensors[:states], dim=-1)
        z = torch.stack(tensors[states : states + latents], dim=-1) if latents else x[..., :0]
        a = torch.stack(tensors[states + latents :], dim=-1)
        features = (self._frame.features(x) - self._vector("feature_middle", x)) / self._vector("feature_scale", x)
        seen = torch.cat([features, z], dim=-1)
        f, g = self._stack(seen, "f"), self._stack(seen, "g")
        u = (a - self._vector("action_middle", x)) / self._vector("action_scale", x)
        own = f + (g.reshape(*f.shape, u.shape[-1]) @ u[..., None])[..., 0]
        change = self._frame.world_increment(x, own * self._vector("increment_scale", x))
        return [change[..., index] for index in range(states)]

    def _stack(self, seen: Any, name: str) -> Any:
        layers = self._layers[name]
        for index, (weight, bias) in enumerate(layers):
            seen = seen @ _tensor(weight, seen).T + _tensor(bias, seen)
            if index < len(layers) - 1:
                seen = torch.relu(seen)
        return seen

    def _vector(self, name: str, like: Any) -> Any:
        return _tensor(self._weights[name], like)


def _tensor(values: np.ndarray[Any, Any], like: Any) -> Any:
    return torch.from_numpy(values).to(dtype=like.dtype, device=like.device)
