"""The methods that are compared on the pendulum, each a policy, an encoder and a filter, or fewer of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa_lab.pendulum.rollouts import Closed, physics_in_any_wind
from safedpa_sim.pendulum.task import FIXED_DIRECTIONS, filter_settings

__all__ = ["BALANCING_METHODS", "HAZARD_METHODS", "Method", "closed_of", "model_named"]

_FIX: Final = tuple(f"fix_{direction}" for direction in FIXED_DIRECTIONS)


@final
@dataclass(frozen=True)
class Method:
    """One line of the tables. ``policy`` and ``filter`` are names of models, empty where there is none."""

    name: str
    title: str
    policy: str = "learned"
    filter: str = "learned"
    told: bool = False


BALANCING_METHODS: Final = (
    Method("safedpa", "SafeDPA"),
    *(Method(name, f"Fix-{name.removeprefix('fix_')}", filter=name) for name in _FIX),
    Method("mix", "Mix", filter="mix"),
    Method("oracle", "knows the wind", filter="physics", told=True),
)
HAZARD_METHODS: Final = (
    *BALANCING_METHODS[:-1],
    Method("unfiltered", "SafeDPA without filter", filter=""),
    Method("rma", "RMA", policy="rma", filter=""),
    Method("rma_p_0_1", "RMA-P, beta 0.1", policy="rma_p_0_1", filter=""),
    Method("rma_p_1", "RMA-P, beta 1", policy="rma_p_1", filter=""),
    Method("rma_p_10", "RMA-P, beta 10", policy="rma_p_10", filter=""),
    Method("ppo", "PPO", policy="ppo", filter=""),
)


def model_named(name: str, folder: Path) -> PhysicsModel:
    """``pendulum_<name>`` from the folder, or else the one that ships. Raises InputError when there is none."""
    if name == "physics":
        return physics_in_any_wind()
    file = folder / f"pendulum_{name}.toml"
    try:
        return load_model(file if file.exists() else f"pendulum_{name}")
    except InputError as error:
        raise InputError(f"{file}: {error}; train it with 'safedpa train pendulum'") from error


def closed_of(method: Method, folder: Path, epsilon: float) -> Closed:
    """The method's filter and encoder; every filter has the same margin ``epsilon`` [rad]."""
    learned = model_named("learned", folder)
    adapts = model_named(method.policy, folder) if method.policy.startswith("rma") else learned
    if not method.filter:
        return Closed(adapts=adapts)
    return Closed(filter_settings(epsilon), model_named(method.filter, folder), adapts, method.told)
