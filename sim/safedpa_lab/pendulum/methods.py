"""The methods that are compared on the pendulum, each a policy, an encoder and a filter, or fewer of them."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Final, final

from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa_lab.pendulum.difficulty import Difficulty
from safedpa_lab.pendulum.rollouts import Closed, physics_in_any_wind
from safedpa_sim.pendulum.task import FIXED_DIRECTIONS

_FIX: Final = tuple(f"fix_{direction}" for direction in FIXED_DIRECTIONS)
_GOAL_SEEKER: Final = "goal_seeker"


@final
@dataclass(frozen=True)
class Method:
    """One line of the tables. ``policy`` and ``filter`` are names of models, empty where there is none."""

    name: str
    title: str
    policy: str = "learned"
    """Or ``goal_seeker``: a formula, see ``crossing``."""
    filter: str = "learned"
    reported: bool = False
    """Filter and policy know the true wind: an oracle."""


FILTERED: Final = (
    Method("safedpa", "SafeDPA"),
    *(Method(name, f"Fix-{name.removeprefix('fix_')}", filter=name) for name in _FIX),
    Method("mix", "Mix", filter="mix"),
    Method("oracle", "knows the wind", filter="physics", reported=True),
)
"""Who has a filter, each of another model."""
BALANCING_METHODS: Final = (*FILTERED, Method("unfiltered", "no filter", filter=""))
PENALISED: Final = (
    Method("rma_p_0_1", "RMA-P, beta 0.1", policy="rma_p_0_1", filter=""),
    Method("rma_p_1", "RMA-P, beta 1", policy="rma_p_1", filter=""),
    Method("rma_p_10", "RMA-P, beta 10", policy="rma_p_10", filter=""),
)
"""From the smallest penalty on."""
HAZARD_METHODS: Final = (
    *FILTERED,
    Method(_GOAL_SEEKER, "goal seeker, SafeDPA's filter", policy=_GOAL_SEEKER),
    Method(f"{_GOAL_SEEKER}_unfiltered", "goal seeker, no filter", policy=_GOAL_SEEKER, filter=""),
    Method("unfiltered", "SafeDPA's policy, no filter", filter=""),
    Method("rma", "RMA", policy="rma", filter=""),
    *PENALISED,
    Method("ppo", "PPO", policy="ppo", filter=""),
)


def method_named(question: int, name: str) -> Method:
    """One of the methods of the first or the second question."""
    return next(method for method in (BALANCING_METHODS, HAZARD_METHODS)[question - 1] if method.name == name)


def model_named(name: str, folder: Path) -> PhysicsModel:
    """``pendulum_<name>`` from the folder, or else the one that ships. Raises InputError when there is none."""
    if name == "physics":
        return physics_in_any_wind()
    file = folder / f"pendulum_{name}.toml"
    try:
        return load_model(file if file.exists() else f"pendulum_{name}")
    except InputError as error:
        raise InputError(f"{file}: {error}; train it with 'safedpa train pendulum'") from error


def closed_of(method: Method, folder: Path, epsilon: float, difficulty: Difficulty) -> Closed:
    """The method's filter with the margin ``epsilon`` [rad], and its encoder."""
    learned = model_named("learned", folder)
    adapts = model_named(method.policy, folder) if method.policy.startswith("rma") else learned
    if not method.filter:
        return Closed(adapts=adapts, torque=difficulty.torque)
    filters = model_named(method.filter, folder)
    return Closed(difficulty.settings(epsilon), filters, adapts, method.reported, difficulty.torque)
