"""The baselines' tasks, and their policies on disk, as plain numpy."""

from __future__ import annotations

import json
from collections.abc import Mapping
from importlib.resources import files
from pathlib import Path
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.errors import InputError
from safedpa.limits import check_tensor_file, parse_json
from safedpa.networks import dense_stack
from safedpa.networks.layers import layers_of
from safedpa.records.writers.tables import atomic_path
from safedpa_lab.point.inputs import entries_of
from safedpa_lab.point.plan import Plan

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


LARGEST_FORCE: Final = 0.008
"""N, of 0.015 N that the robot can push with."""

TASKS: Final = {"still": Plan(stock=True), "wind": Plan(largest_force=LARGEST_FORCE)}
"""The benchmark's own task, in still air with its thrust; winds of any direction, thrust that does not saturate."""

PUBLISHED: Final = {
    "ppo": (25.4, 55.7),
    "trpo": (27.2, 45.9),
    "ppo_lagrangian": (13.0, 25.8),
    "trpo_lagrangian": (18.5, 23.0),
    "cpo": (20.5, 28.8),
}
"""Reward and cost of an episode after ten million steps. Source: OmniSafe, JMLR 25 (2024), point, goal, level 1."""


SHIPPED: Final = Path(str(files("safedpa_sim.point"))) / "weights"


def folder_of(seed: int) -> str:
    """Where the policies of one training seed lie."""
    return f"seed_{seed}"


def baselines_in(folder: Path, seed: int = 0) -> dict[str, dict[str, Any]]:
    """The accounts of one seed's policies in a folder, or else those that ship, by NAME_TASK and what follows it."""
    found = {}
    for place in (SHIPPED, folder):
        for path in sorted((place / folder_of(seed)).glob("*.safetensors")):
            found[path.stem] = load_policy(path).reported
    return found


def baseline_named(key: str, folder: Path, seed: int = 0) -> BaselinePolicy:
    """KEY of a training seed from the folder, or else the one that ships. Raises InputError when there is none."""
    own, shipped = (place / folder_of(seed) / f"{key}.safetensors" for place in (folder, SHIPPED))
    for path in (own, shipped):
        if path.exists():
            return load_policy(path)
    raise InputError(f"{own}: no such file, and none ships; train it with 'safedpa train-baselines'")


def seeds_of(key: str, folder: Path) -> tuple[int, ...]:
    """The training seeds of which there is a policy of that KEY, in the folder or shipped."""
    paths = [path for place in (folder, SHIPPED) for path in place.glob(f"seed_*/{key}.safetensors")]
    return tuple(sorted({int(path.parent.name.removeprefix("seed_")) for path in paths}))
