"""A baseline's policy on disk, and as plain numpy: observation in, action out."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any, final

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.limits import check_tensor_file, parse_json
from safedpa.networks import dense_stack
from safedpa.networks.layers import layers_of
from safedpa.records.writers.tables import atomic_path
from safedpa_lab.point.inputs import entries_of

__all__ = ["BaselinePolicy", "load_policy", "save_policy"]

_KEY = "safedpa"


@final
class BaselinePolicy:
    """a = clip(pi(o), -1, 1): the mean of the Gaussian that was trained, tanh between dense layers; o: ``inputs``.

    Raises InputError for tensors that are no such network.
    """

    def __init__(self, tensors: Mapping[str, NDArray[np.float32]], reported: Mapping[str, Any]) -> None:
        self.tensors, self.reported = dict(tensors), dict(reported)
        self._layers = layers_of(self.tensors, "policy")
        self.inputs: str = self.reported.get("plan", {}).get("inputs", "lidar")
        """Of ``INPUTS``: what it is given."""
        wanted = (entries_of(self.inputs), 2)
        got = (self._layers[0].weight.shape[1], self._layers[-1].weight.shape[0]) if self._layers else (0, 0)
        if got != wanted:
            raise InputError(f"policy: got one of {got[0]} numbers in and {got[1]} out, wanted {wanted[0]} and 2")

    def act(self, seen: NDArray[np.float32]) -> NDArray[np.float32]:
        """Actions (robots, 2) in [-1, 1] for what its ``inputs`` tell (robots, entries)."""
        chosen: NDArray[np.float32] = dense_stack(seen, self._layers, "tanh").clip(-1.0, 1.0)
        return chosen


def save_policy(policy: BaselinePolicy, path: Path) -> None:
    """Writes tensors and what is reported of them as safetensors; whole or not at all."""
    from safetensors.numpy import save

    path.parent.mkdir(parents=True, exist_ok=True)
    content = save(policy.tensors, metadata={_KEY: json.dumps(policy.reported, sort_keys=True)})
    with atomic_path(path) as unfinished:
        unfinished.write_bytes(content)


def load_policy(path: Path) -> BaselinePolicy:
    """What ``save_policy`` wrote. Raises InputError naming the file."""
    from safetensors import SafetensorError, safe_open

    try:
        check_tensor_file(path)
        with safe_open(path, framework="numpy") as file:
            reported = parse_json((file.metadata() or {}).get(_KEY, "{}"))
            tensors = {name: np.asarray(file.get_tensor(name), np.float32) for name in file.keys()}  # noqa: SIM118
        return BaselinePolicy(tensors, reported)
    except (OSError, SafetensorError, ValueError, InputError) as error:
        raise InputError(f"{path}: {error}; wanted a policy that 'safedpa train point' wrote") from error
