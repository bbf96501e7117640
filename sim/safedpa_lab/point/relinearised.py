"""Filters of the point robots on models that are not affine in the action, and drives behind them.

The filters are given z = mu(e) of the true wind.

Models that tell where any action leads, and what is affine about one: for filters that relinearise.

Actions here lie in [-1, 1] over a range of commands: the clean thrust's, which the body never exceeds, or the
benchmark's stock thrust, twenty times as wide, of which the body does what it can.

The point robots' filter on a model that is not affine in the action: taken as affine about one action, or again.

About the nominal action what passes is judged without an error of the linearisation; what is corrected is not. About
the filter's own action: decide, take the model again about what was decided, decide again; then the error goes where
the action settles.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from time import process_time
from typing import Final, Protocol, final

import numpy as np
from numpy.typing import NDArray

from safedpa.arrays import FloatArray, IndexArray
from safedpa.errors import InputError, did_you_mean
from safedpa.networks import LearnedNetworks, Weights, load_weights
from safedpa_lab.point.beliefs import PROBES, from_task_action, motion_of, weights_named
from safedpa_lab.point.drivers import learned_policy
from safedpa_lab.point.free_model import FreeModel, load_free
from safedpa_sim.point.body import POINT_BODY
from safedpa_sim.point.filtering import (
    ACTION_SCALE,
    ETA,
    FilteredActions,
    PointFilter,
    PointPrediction,
    SimulatedPointModel,
    around_hazards,
    minimum_barrier,
    to_task_action,
)
from safedpa_sim.point.simulation import LARGEST_TURN, PointSimulation, after_one_period, centre_state
from safedpa_sim.point.task import PointTask

_STOCK: Final = 1.0 / POINT_BODY.force_limit
COMMANDS: Final = {"clean": ACTION_SCALE, "stock": ACTION_SCALE * np.array([_STOCK, 1.0])}
"""N and rad/s that the action 1 asks for, by kind of thrust."""
_NUDGE: Final = 1e-4
"""Of an action, for the simulated body's slopes."""


class ActionModel(Protocol):
    """A model of the robots as they are, of all of them or of some."""

    def see(self, state: FloatArray) -> None:
        """The robots' states (robots, 5) in this period."""

    def about(self, action: FloatArray, which: NDArray[np.intp]) -> PointPrediction:
        """x[t+1] = drift + gain a for robots ``which`` (n,), exact in value and slope at actions (n, 2) in [-1, 1]."""

    def following(self, action: FloatArray, which: NDArray[np.intp]) -> FloatArray:
        """(n, 5): where actions (n, 2) lead."""


@final
class AffineModel:
    """f + g a of learned networks, the same about every action; latents (robots, latents) stay as they are."""

    def __init__(self, weights: Weights, latent: FloatArray, scale: FloatArray) -> None:
        self._networks, self._latent, self._scale = LearnedNetworks(weights), latent, scale

    def see(self, state: FloatArray) -> None:  # noqa: D102
        f, g = self._networks.increment(state, self._latent)
        probes = np.broadcast_to(PROBES, (len(state), *PROBES.shape))
        motion = motion_of(*self._scaled(self._networks.increment(probes, self._latent[:, np.newaxis])))
        range_of_one = np.array([float(np.mean(motion.strongest)), LARGEST_TURN])
        self._believed = PointPrediction(state + f, g * self._scale, motion, range_of_one)

    def about(self, action: FloatArray, which: NDArray[np.intp]) -> PointPrediction:  # noqa: D102
        del action
        return PointPrediction(
            self._believed.drift[which],
            self._believed.gain[which],
            self._believed.motion.of(which),
            self._believed.scale,
        )

    def following(self, action: FloatArray, which: NDArray[np.intp]) -> FloatArray:  # noqa: D102
        return self.about(action, which).next_state(action)

    def _scaled(self, increment: tuple[FloatArray, FloatArray]) -> tuple[FloatArray, FloatArray]:
        return increment[0], increment[1] * self._scale


@final
class FreeAction:
    """H(x, z, a) of free networks, and what its own slope makes of it.

    The manoeuvre's motion at the probe states: wind and drag without an action, the strongest thrust as half of what
    lies between full thrust ahead and astern; an action's worth, by which the manoeuvre becomes one, by the slope at
    rest, so that what the manoeuvre asks for is what saturates.
    """

    def __init__(self, model: FreeModel, latent: FloatArray, scale: FloatArray) -> None:
        self._model, self._latent, self._scale = model, latent, scale

    def see(self, state: FloatArray) -> None:  # noqa: D102
        self._state = state
        probes, latents = np.tile(PROBES, (len(state), 1)), self._latent.repeat(len(PROBES), axis=0)
        shape = (len(state), *PROBES.shape)
        f, slope = self._model.linearised(probes, latents, np.zeros((len(probes), 2)))
        full = np.broadcast_to(self._scale * np.array([1.0, 0.0]), (len(probes), 2))
        ahead, astern = (self._model.increment(probes, latents, sign * full) for sign in (1.0, -1.0))
        reach = np.stack((0.5 * (ahead - astern), np.zeros_like(ahead)), axis=-1)
        self._motion = motion_of(f.reshape(shape), reach.reshape(*shape, 2))
        first = motion_of(f.reshape(shape), (slope * self._scale).reshape(*shape, 2)).strongest
        self._range = np.array([float(max(np.mean(first), np.mean(self._motion.strongest))), LARGEST_TURN])

    def about(self, action: FloatArray, which: NDArray[np.intp]) -> PointPrediction:  # noqa: D102
        state = self._state[which]
        value, slope = self._model.linearised(state, self._latent[which], action * self._scale)
        gain = slope * self._scale
        drift = state + value - np.einsum("rsa,ra->rs", gain, action)
        return PointPrediction(drift, gain, self._motion.of(which), self._range)

    def following(self, action: FloatArray, which: NDArray[np.intp]) -> FloatArray:  # noqa: D102
        state = self._state[which]
        return state + self._model.increment(state, self._latent[which], action * self._scale)


@final
class SimulatedBody:
    """The simulated robots themselves, yaw rates included: slopes by central differences."""

    def __init__(self, simulation: PointSimulation, scale: FloatArray) -> None:
        self._simulation, self._scale = simulation, scale
        self._wind = simulation.force.T / simulation.body.mass

    def see(self, state: FloatArray) -> None:  # noqa: D102
        self._state, self._rate = state, self._simulation.velocity[2].copy()
        reported = SimulatedPointModel(self._simulation).predict(state, np.zeros((len(state), 0)))
        self._motion = reported.motion
        self._range = reported.scale * self._scale / ACTION_SCALE

    def about(self, action: FloatArray, which: NDArray[np.intp]) -> PointPrediction:  # noqa: D102
        nudges = _NUDGE * np.array([[0.0, 0.0], [1.0, 0.0], [-1.0, 0.0], [0.0, 1.0], [0.0, -1.0]])
        around = (action + nudges[:, np.newaxis]).reshape(-1, 2)
        value, *sides = self.following(around, np.tile(which, len(nudges))).reshape(len(nudges), len(which), 5)
        gain = np.stack([(sides[at] - sides[at + 1]) / (2.0 * _NUDGE) for at in (0, 2)], axis=-1)
        drift = value - np.einsum("rsa,ra->rs", gain, action)
        return PointPrediction(drift, gain, self._motion.of(which), self._range)

    def following(self, action: FloatArray, which: NDArray[np.intp]) -> FloatArray:  # noqa: D102
        sent = action * self._scale
        return after_one_period(self._state[which], sent, self._rate[which], self._wind[which])[0]


ABOUT: Final = ("middle", "nominal", "own")
"""What the model is linearised about: no action, the nominal action, what was decided."""
_AGAIN: Final = 2
"""Decisions after the first, of those whose nominal action does not pass."""
_TOLERANCE: Final = 1e-6
"""m; of what is kept by the model itself."""
_SETTLED: Final = 1e-3
"""Of an action: one that moves less from where the model was taken as affine is not decided again."""


@final
@dataclass(frozen=True)
class Decided:
    """Actions (robots, 2) in [-1, 1], and the least room (robots,) [m] that is predicted with them."""

    action: FloatArray
    corrected: NDArray[np.bool_]
    relaxed: NDArray[np.bool_]
    predicted: FloatArray
    room: FloatArray
    """(robots,) [m]: the least one as they are."""


@final
class RelinearisedFilter:
    """``epsilon`` [m] is the margin; ``about`` one of ``ABOUT``, else InputError.

    Of the filter's own action the model itself says what it predicts; else what was affine says it.
    """

    def __init__(self, epsilon: float, about: str) -> None:
        if about not in ABOUT:
            raise InputError(f"linearised about '{about}': {did_you_mean(about, ABOUT)}")
        self._filter, self._epsilon, self._about = PointFilter(epsilon), epsilon, about

    def decide(self, state: FloatArray, nominal: FloatArray, hazards: FloatArray, model: ActionModel) -> Decided:
        """Safe actions for states (robots, 5), which the model sees, and nominal actions (robots, 2) among hazards."""
        model.see(state)
        everybody = np.arange(len(state))
        believed = model.about(np.zeros_like(nominal) if self._about == "middle" else nominal, everybody)
        if self._about == "own":
            found = self._settled(state, nominal, hazards, model, believed)
            following = model.following(found.action, everybody)
        else:
            found = self._filter.decide(state, nominal, hazards, believed)
            following = believed.next_state(found.action)
        around = around_hazards(hazards, believed.motion)
        predicted, room = (around.h(one).min(axis=1) for one in (following, state))
        return Decided(found.action, found.corrected, found.relaxed, predicted, room)

    def _settled(
        self, state: FloatArray, nominal: FloatArray, hazards: FloatArray, model: ActionModel, believed: PointPrediction
    ) -> FilteredActions:
        """A nominal action that passes by the model itself passes; others are decided about no action, then about what
        was decided.

        About no action first: about a saturated nominal action the thrust has no slope, so that no correction is found.
        What could not be solved, or falls short by the model itself, replaces only what is worse.
        """
        action, relaxed = nominal.copy(), np.zeros(len(nominal), bool)
        everybody = np.arange(len(nominal))
        short = self._retained(nominal, everybody, state, hazards, model, believed) < -_TOLERANCE
        outside = minimum_barrier(state, hazards, believed.motion) < 0.0
        which = np.flatnonzero(short | outside)
        retained, about = np.full(len(which), -np.inf), np.zeros((len(which), 2))
        relaxed[which] = True
        for _ in range(1 + _AGAIN):
            if not len(which):
                break
            near = model.about(about, which)
            new = self._filter.decide(state[which], nominal[which], hazards[which], near)
            now = self._retained(new.action, which, state, hazards, model, near)
            good = ~new.relaxed & (now >= -_TOLERANCE)
            better = good | ((now > retained) & (relaxed[which] | ~new.relaxed))
            action[which[better]], relaxed[which[better]] = new.action[better], new.relaxed[better]
            moves = np.abs(action[which] - about).max(axis=1) > _SETTLED
            which, retained, about = which[moves], np.where(better, now, retained)[moves], action[which[moves]]
        return FilteredActions(action, np.any(action != nominal, axis=1), relaxed)

    def _retained(
        self,
        action: FloatArray,
        which: IndexArray,
        state: FloatArray,
        hazards: FloatArray,
        model: ActionModel,
        believed: PointPrediction,
    ) -> FloatArray:
        """min over hazards of h(next) - (1 - eta) h - epsilon (n,) [m], by the model itself: below 0 it falls short."""
        around = around_hazards(hazards[which], believed.motion)
        following = model.following(action, which)
        retained: FloatArray = (around.h(following) - (1.0 - ETA) * around.h(state[which])).min(axis=1)
        return retained - self._epsilon


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


def nominal_policy_of(name: str, thrust: str, task: PointTask, folder: Path, seed: int) -> NominalPolicy:
    """Nominal actions (robots, 2) in [-1, 1] over the range of commands, one of ``NOMINAL_KINDS``.

    The policy was trained with the clean thrust. Of the stock one it requests the command that pushes alike, a
    twentieth of the clean one's: the map is one to one up to the full push, and every command beyond it pushes no
    harder. A disturbance knows nothing of that: 95 of 100 stock ones saturate.
    """
    weights = weights_named("learned", folder)
    latent = LearnedNetworks(weights).encode(task.simulation.force.T / task.simulation.body.mass)
    learned = learned_policy(task, weights)
    alike = ACTION_SCALE / COMMANDS[thrust]
    random, drawn, period = np.random.default_rng([seed, 71]), np.zeros((task.count, 2)), 0

    def nominal_action() -> FloatArray:
        nonlocal drawn, period
        own = from_task_action(np.asarray(learned(latent), dtype=np.float64)) * alike
        if period % _HELD == 0:
            drawn = random.uniform(-1.0, 1.0, (task.count, 2))
        disturbed = name == "disturbed" and period // _HELD % 2 == 1
        period += 1
        return drawn.copy() if disturbed else own

    return nominal_action


@final
@dataclass
class FilteredDriver:
    """A nominal action through a filter, with the errors of what it predicts: a driver as ``safedpa_lab.point.drivers``
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
