"""The safety filter for many robots at once, for simulation, training and evaluation.

Every robot gets what ``SafetyFilter.decide`` would give it alone, to 1e-6: networks, barriers and the quadratic program
run over arrays with the robots first. Whatever is out of the ordinary (an input that is not plausible, a program that
needs slack, conditions that cannot all be kept, an h below 0) is left to the filter of one robot itself, so that the
ladder of fallbacks exists once. The services keep one step per robot: there its numbers must not depend on its
neighbours.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safedpa.arrays import BoolArray, FloatArray
from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError
from safedpa.safety.batch.barriers import AbstractBatchBarriers
from safedpa.safety.batch.constraints import BatchCandidates, BatchConstraints, search_batch
from safedpa.safety.batch.predictor import AbstractBatchPredictor, AffineBatchPredictor, BatchPredictor
from safedpa.safety.checks.compatibility import check_settings, known_kinds
from safedpa.safety.filter import SafetyFilter
from safedpa.safety.settings import FilterSettings
from safedpa.safety.validation import Plausible
from safedpa.safety.verdict import Status
from safedpa.systems import System

__all__ = ["STATUSES", "BatchFilter", "BatchVerdicts"]


STATUSES = tuple(Status)
"""By their number in ``BatchVerdicts.status``."""
_ACTIONS = 2
"""The nearest point that keeps conditions is known in closed form in the plane."""


@final
@dataclass(frozen=True, eq=False)
class BatchVerdicts:
    """What ``Verdict`` says of one decision, for many; all (robots,) but for ``action`` (robots, actions)."""

    action: FloatArray
    status: NDArray[np.int8]
    """Index into ``STATUSES``."""
    slack: FloatArray
    h_now: FloatArray
    h_next: FloatArray
    alone: BoolArray
    """Whom the filter of one robot answered."""

    def count(self, status: Status) -> int:
        """How many robots have that status."""
        return int(np.count_nonzero(self.status == STATUSES.index(status)))


@final
@dataclass(frozen=True, eq=False)
class _BatchInput:
    """One moment of the robots; every array has them first."""

    state: FloatArray
    nominal: FloatArray
    latent: FloatArray | None
    barriers: AbstractBatchBarriers
    margins: Mapping[str, FloatArray]
    affine: tuple[FloatArray, FloatArray] | None
    backup: Callable[[int], Any] | None

    def predictions(self, model: PhysicsModel | None, which: NDArray[np.intp]) -> AbstractBatchPredictor:
        """Of the robots of these indices."""
        if model is None:
            assert self.affine is not None
            return AffineBatchPredictor(self.state[which], *(part[which] for part in self.affine))
        return BatchPredictor(model, self.state[which], None if self.latent is None else self.latent[which])


@final
class BatchFilter:
    """``decide`` for robots that share a model and settings, with barriers of any kind.

    In place of a model its system alone: then every ``decide`` brings what is predicted, as f + g a of each robot.
    Raises InputError for a model of another robot, of more than two actions, or one that depends on the time.
    """

    def __init__(self, model: PhysicsModel | System, settings: FilterSettings | None = None) -> None:
        self.settings = settings or FilterSettings()
        self.model = model if isinstance(model, PhysicsModel) else None
        self._system = model.system if isinstance(model, PhysicsModel) else model
        check_settings(self.settings, self._system)
        if not 1 <= len(self.settings.action_low) <= _ACTIONS:
            raise InputError(f"model: got {len(self.settings.action_low)} actions, wanted 1 or 2; filter it one by one")
        if self.model is not None and self.model.timed:
            raise InputError(
                "model: depends on the time since the start, which a batch does not have; filter one by one"
            )
        self._kinds = {*known_kinds(), "default", *self.settings.epsilon}
        self._turn: tuple[_BatchInput, int] | None = None
        self._one = self._filter_of_one()

    def _filter_of_one(self) -> SafetyFilter:
        if self.model is not None:
            return SafetyFilter.for_model(self.model, self.settings, backup=self._backup_of_one)
        system = self._system
        believed = Plausible(system.state_low, system.state_high, system.state_names)
        return SafetyFilter(self._affine_of_one, None, self.settings, backup=self._backup_of_one, state_range=believed)

    def _affine_of_one(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """What is known of the robot whose turn it is: of its present state, and of no other."""
        del state
        assert self._turn is not None
        asked, robot = self._turn
        assert asked.affine is not None
        return asked.affine[0][robot], asked.affine[1][robot]

    def _backup_of_one(self, state: FloatArray | None) -> FloatArray:
        """The backup of the robot whose turn it is; the resting action where none was given or its state is unknown."""
        own = None if self._turn is None or state is None else self._turn[0].backup
        return self.settings.resting_action if own is None or self._turn is None else np.asarray(own(self._turn[1]))

    def decide(
        self,
        state: ArrayLike,
        nominal: ArrayLike,
        latent: ArrayLike | None = None,
        *,
        barriers: AbstractBatchBarriers,
        epsilon: Mapping[str, Any] | None = None,
        affine: tuple[FloatArray, FloatArray] | None = None,
        backup: Callable[[int], Any] | None = None,
    ) -> BatchVerdicts:
        """Verdicts for states (robots, states), nominal actions (robots, actions), latents (robots, latents).

        ``barriers`` around as many robots; ``epsilon`` by kind of barrier: a number, or (robots,); ``affine`` f
        (robots, states) and g (robots, states, actions) where there is no model; ``backup`` gives the action (actions,)
        of a robot, by its index, without a decision. Numbers that cannot be believed end in the fallback of their own
        robot; raises InputError for wrong shapes, and for barriers that read other states.
        """
        asked = self._asked(
            np.asarray(state, dtype=np.float64), _array(nominal), _array(latent), barriers, epsilon, affine, backup
        )
        verdicts = self._blank(len(asked.state))
        ordinary = np.flatnonzero(self._ordinary(asked))
        if len(ordinary) and barriers.kinds:
            with np.errstate(all="ignore"):  # numbers beyond all bounds are left to the filter of one robot
                self._together(verdicts, ordinary, asked)
        for robot in np.flatnonzero(verdicts.alone).tolist():
            self._alone(verdicts, robot, asked)
        return verdicts

    def _asked(
        self,
        state: FloatArray,
        nominal: Any,
        latent: FloatArray | None,
        barriers: AbstractBatchBarriers,
        epsilon: Mapping[str, Any] | None,
        affine: tuple[FloatArray, FloatArray] | None,
        backup: Callable[[int], Any] | None,
    ) -> _BatchInput:
        """What came in, of the right shapes. Raises InputError for others."""
        robots, names = len(state), self._system.state_names
        actions = len(self.settings.action_low)
        _check("state", state, (robots, len(names)))
        _check("nominal", nominal, (robots, actions))
        if latent is not None and self.model is not None:
            _check("latent", latent, (robots, len(self.model.latent_names)))
        if len(barriers) != robots:
            raise InputError(f"barriers: got those of {len(barriers)} robots, wanted {robots}")
        if barriers.reads != names[: len(barriers.reads)]:
            raise InputError(
                f"barriers: got those of {', '.join(barriers.reads)}, the model's states are {', '.join(names)}"
            )
        if (self.model is None) == (affine is None):
            raise InputError(
                "affine: wanted f and g of each robot where the filter has no model, and nothing where it has"
            )
        margins = {kind: np.broadcast_to(value, robots) for kind, value in (epsilon or {}).items()}
        if affine is not None:
            _check("f", affine[0], state.shape)
            _check("g", affine[1], (*state.shape, actions))
        return _BatchInput(state, nominal, latent, barriers, margins, affine, backup)

    def _blank(self, robots: int) -> BatchVerdicts:
        slack, h_now, h_next = np.zeros((3, robots))
        status, alone = np.zeros(robots, dtype=np.int8), np.ones(robots, dtype=bool)
        return BatchVerdicts(np.zeros((robots, len(self.settings.action_low))), status, slack, h_now, h_next, alone)

    def _ordinary(self, asked: _BatchInput) -> BoolArray:
        """Robots (robots,) whose inputs the filter of one robot would believe."""
        tools = self._one.tools
        believed = np.full(len(asked.state), self.settings.enabled)
        pairs = (
            (asked.state, tools.state_range),
            (asked.nominal, tools.nominal_range),
            (asked.latent, tools.latent_range),
        )
        for numbers, plausible in pairs:
            if numbers is not None:
                believed &= _within(numbers, plausible)
            elif plausible is not None and len(plausible.names) > 0:
                believed[:] = False
        for kind, value in asked.margins.items():  # a margin for what no barrier is would be no margin
            usual = kind in self._kinds or kind in asked.barriers.kinds
            believed &= usual and value.dtype.kind in "iuf" and np.isfinite(value) & (value >= 0.0)
        return believed

    def _together(self, verdicts: BatchVerdicts, which: NDArray[np.intp], asked: _BatchInput) -> None:
        """The verdicts of robots whose conditions can be kept; the others stay alone."""
        settings, nominal = self.settings, asked.nominal[which]
        barriers = asked.barriers if len(which) == len(asked.nominal) else asked.barriers.only(which)
        predictions = asked.predictions(self.model, which)
        margins = {kind: value[which] for kind, value in asked.margins.items()}
        state = predictions.state
        h_now = barriers.values(state)
        epsilon = self._epsilon(barriers, len(state), margins)
        share = np.where(barriers.at_once or (False,), 0.0, 1.0 - settings.eta)  # of each row, or of all
        required, scale = share * h_now + epsilon, np.maximum(np.abs(h_now), epsilon)
        straight = np.zeros(len(state), dtype=bool)
        conditions = BatchConstraints(settings, barriers, predictions, required, scale, straight)
        within = np.minimum(np.maximum(nominal, settings.low), settings.high)
        outcome = conditions.outcome(np.where(within == nominal, nominal, within))
        safe = (h_now >= 0.0).all(axis=1)
        kept = safe & conditions.kept(outcome)
        status = np.where(
            (within == nominal).all(axis=1), STATUSES.index(Status.passed), STATUSES.index(Status.corrected)
        )
        numbers = h_now, outcome.h_next, outcome.next_state
        known = np.logical_and.reduce([np.isfinite(table).all(axis=1) for table in numbers])
        wrong = np.flatnonzero(known & safe & ~kept)
        if len(wrong):
            own = conditions.only(wrong)
            found, certain = search_batch(own, nominal[wrong], outcome.only(wrong))
            good = certain & own.kept(found)
            outcome.put(wrong[good], found.only(good))
            kept[wrong[good]] = True
            status[wrong] = STATUSES.index(Status.corrected)
        self._write(verdicts, which, known & kept, status, h_now, outcome)

    def _write(
        self,
        verdicts: BatchVerdicts,
        which: NDArray[np.intp],
        answered: BoolArray,
        status: NDArray[np.intp],
        h_now: FloatArray,
        outcome: BatchCandidates,
    ) -> None:
        robots = which[answered]
        verdicts.action[robots] = outcome.action[answered]
        verdicts.status[robots] = status[answered]
        verdicts.h_now[robots] = h_now.min(axis=1)[answered]
        verdicts.h_next[robots] = outcome.h_next.min(axis=1)[answered]
        verdicts.alone[robots] = False

    def _epsilon(self, barriers: AbstractBatchBarriers, robots: int, margins: Mapping[str, FloatArray]) -> FloatArray:
        """(robots, rows)."""
        table: dict[str, Any] = {**self.settings.epsilon, **margins}
        otherwise = table.get("default", 0.0)
        return np.stack([np.broadcast_to(table.get(kind, otherwise), robots) for kind in barriers.kinds], axis=1)

    def _alone(self, verdicts: BatchVerdicts, robot: int, asked: _BatchInput) -> None:
        own = None if asked.latent is None else asked.latent[robot]
        epsilon = {kind: np.asarray(value[robot]).item() for kind, value in asked.margins.items()}
        around = asked.barriers.one(robot)
        self._turn = asked, robot
        try:
            found = self._one.decide(asked.state[robot], asked.nominal[robot], own, barriers=around, epsilon=epsilon)
        finally:
            self._turn = None
        verdicts.action[robot], verdicts.status[robot] = found.action, STATUSES.index(found.status)
        verdicts.slack[robot], verdicts.h_now[robot], verdicts.h_next[robot] = found.slack, found.h_now, found.h_next


def _within(numbers: FloatArray, plausible: Plausible | None) -> BoolArray:
    """Rows (robots,) that are finite and within the range."""
    believed = np.isfinite(numbers)
    if plausible is not None and len(plausible.names) > 0:
        believed &= (numbers >= plausible.low) & (numbers <= plausible.high)
    return np.asarray(believed.all(axis=1))


def _array(numbers: ArrayLike | None) -> Any:
    return None if numbers is None else np.asarray(numbers, dtype=np.float64)


def _check(what: str, numbers: FloatArray, shape: tuple[int, ...]) -> None:
    if numbers.shape != shape:
        raise InputError(f"{what}: got shape {numbers.shape}, wanted {shape}, the robots first")
