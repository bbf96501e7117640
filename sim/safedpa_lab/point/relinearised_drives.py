"""Point robots with the clean thrust or the benchmark's, behind filters that are given z = mu(e) of the true wind."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.networks import LearnedNetworks, Weights, load_weights
from safedpa_lab.point.action_models import COMMANDS, ActionModel, AffineModel, FreeAction, SimulatedBody
from safedpa_lab.point.beliefs import from_task_action
from safedpa_lab.point.free_model import FreeModel, load_free
from safedpa_lab.point.relinearised_filter import RelinearisedFilter
from safedpa_lab.point.weights import weights_named
from safedpa_sim.point.body_steps import centre_state
from safedpa_sim.point.observation import policy_seen
from safedpa_sim.point.point_model import ACTION_SCALE, to_task_action
from safedpa_sim.point.route_planner import RoutePlanner
from safedpa_sim.point.task import PointTask

__all__ = [
    "NETWORKS",
    "NOMINAL_KINDS",
    "FilteredDriver",
    "affine_weights",
    "free_model",
    "model_of",
    "nominal_policy_of",
    "windy",
]

NominalPolicy = Callable[[], FloatArray]

NETWORKS: Final = ("affine_stock", "free_clean", "free_stock")
"""Files of networks that are trained for this alone; the affine ones of the clean thrust ship as ``point_learned``."""
NOMINAL_KINDS: Final = ("policy", "disturbed")
"""SafeDPA's policy; every other half second an action drawn at random over the whole range in its place."""
_SHIPPED: Final = Path(__file__).parent / "free_networks"
_HELD: Final = 25
"""Periods for which a disturbance is held."""
_NEAR: Final = 0.1
"""m of h below which an error counts, as in ``safedpa_lab.point.margin``."""


def affine_weights(thrust: str, folder: Path) -> Weights:
    """f and g for that thrust, of the folder, or else those that ship. Raises InputError for none."""
    if thrust == "clean":
        return weights_named("learned", folder)
    return load_weights(_file(f"affine_{thrust}", folder))


def free_model(thrust: str, folder: Path) -> FreeModel:
    """H for that thrust, likewise."""
    return load_free(_file(f"free_{thrust}", folder))


def _file(name: str, folder: Path) -> Path:
    own = folder / f"{name}.safetensors"
    return own if own.exists() else _SHIPPED / own.name


def model_of(kind: str, thrust: str, task: PointTask, folder: Path) -> ActionModel:
    """``affine``, ``free`` or ``truth`` for the robots of a task in their winds, given z = mu(e) of these.

    Raises InputError for another kind.
    """
    wind, scale = task.simulation.force.T / task.simulation.body.mass, COMMANDS[thrust]
    if kind == "affine":
        weights = affine_weights(thrust, folder)
        return AffineModel(weights, LearnedNetworks(weights).encode(wind), scale)
    if kind == "free":
        model = free_model(thrust, folder)
        return FreeAction(model, model.encode(wind), scale)
    if kind == "truth":
        return SimulatedBody(task.simulation, scale)
    raise InputError(f"model '{kind}': wanted affine, free or truth")


def windy(thrust: str, towards: FloatArray, force: float, seed: int) -> PointTask:
    """One robot for each direction [rad] of a force [N]; goals of each robot from a sequence of its own."""
    task = PointTask(len(towards), seed, paired=True, stock=thrust == "stock")
    task.simulation.force[:] = force * np.stack((np.cos(towards), np.sin(towards)))
    return task


def nominal_policy_of(name: str, thrust: str, task: PointTask, folder: Path, seed: int) -> NominalPolicy:
    """Nominal actions (robots, 2) in [-1, 1] over the range of commands, one of ``NOMINAL_KINDS``.

    The policy was trained with the clean thrust. Of the stock one it requests the command that pushes alike, a
    twentieth of the clean one's: the map is one to one up to the full push, and every command beyond it pushes no
    harder. A disturbance knows nothing of that: 95 of 100 stock ones saturate.
    """
    from safedpa_sim.point.latent_policy import LatentPolicy

    weights = weights_named("learned", folder)
    latent = LearnedNetworks(weights).encode(task.simulation.force.T / task.simulation.body.mass)
    learned, ways = LatentPolicy(weights), RoutePlanner(task.count)
    alike = ACTION_SCALE / COMMANDS[thrust]
    random, drawn, period = np.random.default_rng([seed, 71]), np.zeros((task.count, 2)), 0

    def nominal_action() -> FloatArray:
        nonlocal drawn, period
        place, layout = task.simulation.pose[:2].T, task.layout
        turn, _ = ways.first_turns(place, layout.hazards, layout.goal)
        own = from_task_action(np.asarray(learned.act(policy_seen(task, latent, turn)), dtype=np.float64)) * alike
        if period % _HELD == 0:
            drawn = random.uniform(-1.0, 1.0, (task.count, 2))
        disturbed = name == "disturbed" and period // _HELD % 2 == 1
        period += 1
        return drawn.copy() if disturbed else own

    return nominal_action


@final
@dataclass
class FilteredDriver:
    """A nominal action through a filter, with the errors of what it predicts: a driver as ``safedpa_lab.point.driven``
    has it."""

    task: PointTask
    model: ActionModel
    filter: RelinearisedFilter
    nominal: NominalPolicy

    def __post_init__(self) -> None:
        self.corrected = self.relaxed = np.zeros(self.task.count, bool)
        self.seconds = 0.0
        """Of processor, in decisions alone."""
        self._errors: list[FloatArray] = []
        self._predicted = self._room = np.full(self.task.count, np.nan)

    def act(self) -> FloatArray:
        """Actions (robots, 2) of the task."""
        nominal, state, hazards = self.nominal(), centre_state(self.task.simulation), self.task.layout.hazards
        began = process_time()
        found = self.filter.decide(state, nominal, hazards, self.model)
        self.seconds += process_time() - began
        near = (self._room > 0.0) & (self._room < _NEAR)
        self._errors.append(np.where(near, self._predicted - found.room, np.nan))
        self._predicted, self._room = found.predicted, found.room
        self.corrected, self.relaxed = found.corrected, found.relaxed
        return to_task_action(found.action)

    def seen(self) -> list[FloatArray]:
        """Of each robot, (steps near hazards,) [m]: the least h that was predicted less the one that was found."""
        return [column[np.isfinite(column)] for column in np.array(self._errors).T]

    def errors(self) -> list[FloatArray]:
        """The same; of a robot that came near none one error that no margin misses."""
        return [column if len(column) else np.full(1, -_NEAR) for column in self.seen()]
