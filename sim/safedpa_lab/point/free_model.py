"""Networks that are not affine in the action, at work in plain numpy: H(x, z, a), its slope in a, and its file."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from hashlib import sha256
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.limits import check_tensor_file
from safedpa.networks import Description, Layer, dense_stack, frame_of
from safedpa.networks.layers import layers_of
from safedpa.records.writers.tables import atomic_path

_KEY = "safedpa_free"
_VECTORS = ("feature_middle", "feature_scale", "action_middle", "action_scale", "increment_scale")
_ENVIRONMENT = ("environment_middle", "environment_scale")


@final
@dataclass(frozen=True)
class FreeModel:
    """With n = [(features(x) - middle) / scale, z] and u = (a - action_middle) / action_scale:

        increment in the robot's own frame = increment_scale H([n, u]),  H a ReLU network

    Raises InputError where a tensor is missing, not finite, or of a shape that does not fit.
    """

    tensors: Mapping[str, NDArray[np.float32]]
    description: Description

    def __post_init__(self) -> None:
        described = self.description
        wanted = (*_VECTORS, *_ENVIRONMENT, "mu.0.weight", "h.0.weight", "h.1.weight")
        missing = [name for name in wanted if name not in self.tensors]
        if missing:
            raise InputError(f"free networks: no tensor '{missing[0]}'; train them again")
        for name, tensor in self.tensors.items():
            if not np.isfinite(tensor).all():
                raise InputError(f"free networks: '{name}' holds numbers that are not finite; train them again")
        layers = layers_of(self.tensors, "h")
        inputs = len(self.tensors["feature_middle"]) + described.latents + len(described.actions)
        got = layers[0].weight.shape[1], len(layers[-1].bias)
        if got != (inputs, len(described.states)):
            raise InputError(f"free networks: H takes {got[0]} and gives {got[1]}, wanted {inputs} and the states")

    @property
    def digest(self) -> str:
        """SHA-256 over names and numbers of all tensors, its first 16 digits."""
        running = sha256()
        for name in sorted(self.tensors):
            running.update(f"{name} {self.tensors[name].shape} ".encode())
            running.update(np.ascontiguousarray(self.tensors[name], dtype="<f4").tobytes())
        return running.hexdigest()[:16]

    def encode(self, environment: FloatArray) -> FloatArray:
        """z = mu((e - middle) / scale), shape (..., latents), for environments e (..., entries) in SI units."""
        scaled = (environment - self._vector("environment_middle")) / self._vector("environment_scale")
        return dense_stack(scaled, _doubled(layers_of(self.tensors, "mu")), "relu").astype(np.float64)

    def increment(self, state: FloatArray, latent: FloatArray, action: FloatArray) -> FloatArray:
        """The change (n, states) of the state's own entries; (n, states), (n, latents), (n, actions) in SI units."""
        own = self._vector("increment_scale") * dense_stack(self._seen(state, latent, action), self._layers, "relu")
        turned: FloatArray = frame_of(self.description.robot).world_increment(state, own)
        return turned

    def linearised(self, state: FloatArray, latent: FloatArray, action: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The increment (n, states) at ``action`` (n, actions) and its slope there (n, states, actions), both exact.

        The slope is carried forward with the values: D_1 = W_1's columns of u, D_k = W_k (D_{k-1} where its unit is
        positive, else 0). At a kink, where a unit is 0, it is the slope on the side where the unit is silent.
        """
        x, slope = self._seen(state, latent, action), np.zeros((0, 0, 0))
        actions = action.shape[-1]
        for index, (weight, bias) in enumerate(self._layers):
            if index == 0:
                slope = np.broadcast_to(weight[:, -actions:].T, (len(x), actions, len(bias)))
            else:
                active = x > 0.0
                x = np.where(active, x, 0.0)
                slope = (slope * active[:, np.newaxis]) @ weight.T
            x = x @ weight.T + bias
        scale = self._vector("increment_scale")
        frame = frame_of(self.description.robot)
        slope = slope * scale / self._vector("action_scale")[:, np.newaxis]
        turned = [frame.world_increment(state, slope[:, index]) for index in range(actions)]
        return frame.world_increment(state, scale * x), np.stack(turned, axis=-1)

    @property
    def _layers(self) -> tuple[Layer, ...]:
        return _doubled(layers_of(self.tensors, "h"))

    def _seen(self, state: FloatArray, latent: FloatArray, action: FloatArray) -> FloatArray:
        features = frame_of(self.description.robot).features(state)
        features = (features - self._vector("feature_middle")) / self._vector("feature_scale")
        scaled = (action - self._vector("action_middle")) / self._vector("action_scale")
        return np.concatenate((features, latent, scaled), axis=-1)

    def _vector(self, name: str) -> FloatArray:
        return self.tensors[name].astype(np.float64)


def _doubled(layers: tuple[Layer, ...]) -> tuple[Layer, ...]:
    return tuple(Layer(layer.weight.astype(np.float64), layer.bias.astype(np.float64)) for layer in layers)


def save_free(model: FreeModel, path: Path) -> None:
    """Writes a safetensors file; whole or not at all."""
    from safetensors.numpy import save

    tensors: dict[str, Any] = {
        name: np.ascontiguousarray(tensor, dtype=np.float32) for name, tensor in model.tensors.items()
    }
    path.parent.mkdir(parents=True, exist_ok=True)
    with atomic_path(path) as unfinished:
        unfinished.write_bytes(save(tensors, metadata={_KEY: model.description.to_json()}))


def load_free(path: Path) -> FreeModel:
    """Reads what ``save_free`` wrote. Raises InputError naming the file and what is wrong with it."""
    from safetensors import SafetensorError, safe_open

    try:
        check_tensor_file(path)
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors = {name: np.asarray(file.get_tensor(name), dtype=np.float32) for name in file.keys()}  # noqa: SIM118
        if _KEY not in metadata:
            raise InputError("got no free networks, wanted a file of 'safedpa experiment point-relinearised --train'")
        return FreeModel(tensors, Description.from_json(metadata[_KEY]))
    except (OSError, SafetensorError, ValueError, InputError) as error:
        raise InputError(f"{path}: {error}") from error
