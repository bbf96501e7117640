"""Reads and writes weights: tensors as safetensors, with a description of the robot and the training."""

from __future__ import annotations

import json
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from hashlib import sha256
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError, did_you_mean
from safedpa.limits import check_tensor_file, parse_json, refuse_unknown

__all__ = ["FORMAT", "STRIDE", "Description", "EnvironmentEntry", "Weights", "load_weights", "save_weights"]

FORMAT = 1
STRIDE = 4
"""Stride of phi's convolutions over time."""
_KEY = "safedpa"
_VECTORS = ("feature_middle", "feature_scale", "action_middle", "action_scale", "increment_scale")
_LATENT_VECTORS = ("latent_low", "latent_high", "latent_nominal")


@final
@dataclass(frozen=True)
class EnvironmentEntry:
    """One entry of the environment e: a parameter of a named effect, and its range in the training."""

    path: str
    low: float
    high: float


@final
@dataclass(frozen=True)
class Description:
    """The robot and the sizes of the networks. ``trained_on`` documents configuration, seeds and date."""

    robot: str
    period: float
    states: tuple[str, ...]
    actions: tuple[str, ...]
    latents: int = 0
    history: int = 0
    """Transitions in the input of the history encoder; 0 without one."""
    environment: tuple[EnvironmentEntry, ...] = ()
    trained_on: Mapping[str, Any] = field(default_factory=dict)

    def to_json(self) -> str:
        """Returns the JSON text that ``from_json`` reads."""
        return json.dumps({"format": FORMAT, **asdict(self)}, sort_keys=True)

    @staticmethod
    def from_json(text: str) -> Description:
        """Returns the description that ``to_json`` wrote. Raises InputError naming the key."""
        table = parse_json(text)
        if not isinstance(table, dict) or table.pop("format", None) != FORMAT:
            raise InputError(f"description: wanted format {FORMAT}; this program reads no other")
        known = Description.__dataclass_fields__
        refuse_unknown(table, known, "description.")
        try:
            entries = tuple(EnvironmentEntry(**entry) for entry in table.pop("environment", ()))
            states, actions = (tuple(table.pop(name)) for name in ("states", "actions"))
            found = Description(**table, states=states, actions=actions, environment=entries)
        except (KeyError, TypeError) as error:
            raise InputError(f"description: {error}; wanted the keys {', '.join(known)}") from error
        _check_numbers(found)
        return found


@final
@dataclass(frozen=True)
class Weights:
    """Tensors by name (the docs page on training lists them), float32, and their description.

    Raises InputError naming the tensor when one is missing, not finite or of a shape that does not fit.
    """

    tensors: Mapping[str, NDArray[np.float32]]
    description: Description
    source: Path | None = None
    """The file that they were read from."""

    def __post_init__(self) -> None:
        for name, tensor in self.tensors.items():
            if not np.isfinite(tensor).all():
                raise InputError(f"weights: '{name}' holds numbers that are not finite; train again")
        self._check_vectors()
        described, features = self.description, len(self["feature_middle"])
        states, actions, latents = len(described.states), len(described.actions), described.latents
        self._check_network("f", features + latents, states)
        self._check_network("g", features + latents, states * actions)
        if "mu.0.weight" in self.tensors:
            self._check_network("mu", len(described.environment), latents)
        if self.has("phi"):
            self._check_shape("phi.dense.0.weight", (None, features + states + actions))
            self._check_shape("phi.out.weight", (latents, self._convolved()))

    def __getitem__(self, name: str) -> NDArray[np.float32]:
        """A tensor by name; raises InputError when there is none."""
        if name not in self.tensors:
            raise InputError(f"weights: no tensor '{name}'; {did_you_mean(name, self.tensors)}")
        return self.tensors[name]

    def has(self, network: str) -> bool:
        """Returns whether the weights contain a network (mu, f, g, phi, policy)."""
        return any(name.startswith(f"{network}.") for name in self.tensors)

    @property
    def digest(self) -> str:
        """SHA-256 over names, shapes and values of all tensors."""
        running = sha256()
        for name in sorted(self.tensors):
            running.update(f"{name} {self.tensors[name].shape} ".encode())
            # little-endian on every machine: models name this digest
            running.update(np.ascontiguousarray(self.tensors[name], dtype="<f4").tobytes())
        return running.hexdigest()

    def with_tensors(self, tensors: Mapping[str, Any], description: Description | None = None) -> Weights:
        """Returns the weights with some tensors replaced or added."""
        added = {name: np.asarray(tensor, dtype=np.float32) for name, tensor in tensors.items()}
        return Weights({**self.tensors, **added}, description or self.description)

    def _check_vectors(self) -> None:
        described = self.description
        lengths = {
            "action_middle": len(described.actions),
            "action_scale": len(described.actions),
            "increment_scale": len(described.states),
        }
        for name in _VECTORS + (_LATENT_VECTORS if described.latents else ()):
            wanted = described.latents if name in _LATENT_VECTORS else lengths.get(name)
            self._check_shape(name, (wanted,))
        for name in ("feature_scale", "action_scale", "increment_scale"):
            if not (self[name] > 0.0).all():
                raise InputError(f"weights: '{name}' is {self[name].tolist()}, wanted positive numbers")

    def _check_network(self, name: str, inputs: int, outputs: int) -> None:
        last = 0
        while f"{name}.{last + 1}.weight" in self.tensors:
            last += 1
        self._check_shape(f"{name}.0.weight", (None, inputs))
        self._check_shape(f"{name}.{last}.weight", (outputs, None))

    def _convolved(self) -> int:
        """Returns the number of outputs of the convolutions for one history."""
        steps, channels, index = self.description.history, 0, 0
        while (name := f"phi.conv.{index}.weight") in self.tensors:
            channels, _, kernel = self.tensors[name].shape
            if steps < kernel:
                raise InputError(
                    f"weights: a history of {self.description.history} is too short for '{name}', which wants "
                    f"{kernel} rows and gets {steps}"
                )
            steps, index = (steps - kernel) // STRIDE + 1, index + 1
        return channels * steps

    def _check_shape(self, name: str, wanted: tuple[int | None, ...]) -> None:
        shape = self[name].shape
        if len(shape) != len(wanted) or any(want not in (None, got) for got, want in zip(shape, wanted, strict=True)):
            text = " x ".join("any" if number is None else str(number) for number in wanted)
            raise InputError(
                f"weights: '{name}' has shape {shape}, wanted {text} for robot '{self.description.robot}' with "
                f"{self.description.latents} latents; do the weights belong to this model?"
            )


def _check_numbers(described: Description) -> None:
    """Raises InputError for a value of the wrong type or range: a broken file must not fail later, in a service."""
    for name in ("latents", "history"):
        value = getattr(described, name)
        if type(value) is not int or value < 0:
            raise InputError(f"description.{name}: got {value!r}, wanted a whole number, 0 or more")
    if type(described.period) is not float or not 0.0 < described.period < 1e3:
        raise InputError(f"description.period: got {described.period!r}, wanted a positive number of seconds")


def save_weights(weights: Weights, path: str | Path) -> None:
    """Writes a safetensors file, completely or not at all."""
    from safetensors.numpy import save

    path = Path(path)
    tensors = {name: np.ascontiguousarray(tensor, dtype=np.float32) for name, tensor in weights.tensors.items()}
    content = save(tensors, metadata={_KEY: weights.description.to_json()})
    path.parent.mkdir(parents=True, exist_ok=True)
    # written next to it and renamed: a reader sees the old file or the new one
    unfinished = path.with_suffix(".part")
    unfinished.write_bytes(content)
    unfinished.replace(path)


def load_weights(path: str | Path) -> Weights:
    """Reads a file that ``save_weights`` wrote. Raises InputError naming the file and the problem."""
    from safetensors import SafetensorError, safe_open

    path = Path(path)
    try:
        check_tensor_file(path)
        with safe_open(path, framework="numpy") as file:
            metadata = file.metadata() or {}
            tensors = {name: np.asarray(file.get_tensor(name), dtype=np.float32) for name in file.keys()}  # noqa: SIM118
        if _KEY not in metadata:
            raise InputError(f"no description under the key '{_KEY}'; wanted a file that 'safedpa train' wrote")
        return Weights(tensors, Description.from_json(metadata[_KEY]), path)
    except (OSError, SafetensorError, ValueError, InputError) as error:
        raise InputError(f"{path}: {error}") from error
