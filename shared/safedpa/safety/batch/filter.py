"""The safety filter for many robots at once, for simulation, training and evaluation.

Each robot gets what ``SafetyFilter.decide`` would return for it, to 1e-6: networks, barriers and the quadratic program
run over arrays with the robots first. All unusual cases (an implausible input, a program that needs slack, infeasible
constraints, an h below 0) are left to the filter of one robot, so that the fallback hierarchy exists once. The services
use one filter per robot instead: their results must not depend on which other robots share a batch.
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
from safedpa.safety.batch.constraints import BatchCandidates, BatchConstraints, solve_sqp_batch
from safedpa.safety.batch.predictor import AbstractBatchPredictor, AffineBatchPredictor, BatchPredictor
from safedpa.safety.checks.compatibility import check_settings, known_kinds
from safedpa.safety.filter import SafetyFilter
from safedpa.safety.settings import FilterSettings
from safedpa.safety.validation import Plausible
from safedpa.safety.verdict import Status
from safedpa.systems import System

__all__ = ["STATUSES", "BatchFilter", "BatchVerdicts"]


STATUSES = tuple(Status)
"""By their index in ``BatchVerdicts.status``."""
_ACTIONS = 2
"""The quadratic program has a closed-form solution for two actions."""


@final
@dataclass(frozen=True, eq=False)
class BatchVerdicts:
    """The fields of ``Verdict`` for many robots; all (robots,) except ``action`` (robots, actions)."""

    action: FloatArray
    status: NDArray[np.int8]
    """Index into ``STATUSES``."""
    slack: FloatArray
    h_now: FloatArray
    h_next: FloatArray
    single: BoolArray
    """Which robots the filter of one robot decided."""

    def count(self, status: Status) -> int:
        """The number of robots with that status."""
        return int(np.count_nonzero(self.status == STATUSES.index(status)))


@final
@dataclass(frozen=True, eq=False)
class _BatchInput:
    """The inputs of one tick; every array has the robots first."""

    state: FloatArray
    nominal: FloatArray
    latent: FloatArray | None
    barriers: AbstractBatchBarriers
    margins: Mapping[str, FloatArray]
    affine: tuple[FloatArray, FloatArray] | None
    backup: Callable[[int], Any] | None

    def predictions(self, model: PhysicsModel | None, which: NDArray[np.intp]) -> AbstractBatchPredictor:
        """The predictor of the robots of these indices."""
        if model is None:
            assert self.affine is not None
            return AffineBatchPredictor(self.state[which], *(part[which] for part in self.affine))
        return BatchPredictor(model, self.state[which], None if self.latent is None else self.latent[which])


@final
class BatchFilter:
    """``decide`` for robots that share a model and settings, with barriers of any kind.

    With a system in place of a model, every ``decide`` gets the prediction as f + g a of each robot. Raises InputError
    for a model of another robot, of more than two actions, or one that depends on time.
    """

    def __init__(self, model: PhysicsModel | System, settings: FilterSettings | None = None) -> None:
        self.model = model if isinstance(model, PhysicsModel) else None
        self._system = model.system if isinstance(model, PhysicsModel) else model
        self.settings = settings or FilterSettings.for_robot(self._system)
        check_settings(self.settings, self._system)
        if not 1 <= len(self.settings.action_low) <= _ACTIONS:
            raise InputError(f"model: got {len(self.settings.action_low)} actions, wanted 1 or 2; filter it one by one")
        # One clock for all robots would be wrong as soon as they start at different times.
        if self.model is not None and self.model.timed:
            raise InputError(
                "model: depends on the time since the start, which a batch does not have; filter one by one"
            )
        self._kinds = {*known_kinds(), "default", *self.settings.epsilon}
        self._current: tuple[_BatchInput, int] | None = None
        self._single_filter = self._make_single_filter()

    def _make_single_filter(self) -> SafetyFilter:
        if self.model is not None:
            return SafetyFilter.for_model(self.model, self.settings, backup=self._backup_of_current)
        system = self._system
        valid = Plausible(system.state_low, system.state_high, system.state_names)
        return SafetyFilter(
            self._affine_of_current, None, self.settings, backup=self._backup_of_current, state_range=valid
        )

    def _affine_of_current(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """The prediction of the robot that is being decided, at its present state only."""
        # SafetyFilter calls a function of the state; the batch was given f and g per robot instead.
        del state
        assert self._current is not None
        request, robot = self._current
        assert request.affine is not None
        return request.affine[0][robot], request.affine[1][robot]

    def _backup_of_current(self, state: FloatArray | None) -> FloatArray:
        """The backup of the robot that is being decided; the resting action without one, or with an unknown state."""
        own = None if self._current is None or state is None else self._current[0].backup
        if own is None or self._current is None:
            return self.settings.resting_action
        return np.asarray(own(self._current[1]))

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

        ``barriers`` are those of as many robots; ``epsilon`` by kind of barrier is a number or (robots,). ``affine`` is
        f (robots, states) and g (robots, states, actions), if there is no model. ``backup`` returns the backup action
        (actions,) of a robot by its index. Implausible values lead to the fallback of their robot only; raises
        InputError for wrong shapes and for barriers of other states.
        """
        request = self._validated_input(
            np.asarray(state, dtype=np.float64), _array(nominal), _array(latent), barriers, epsilon, affine, backup
        )
        verdicts = self._blank(len(request.state))
        ordinary = np.flatnonzero(self._has_valid_inputs(request))
        if len(ordinary) and barriers.kinds:
            with np.errstate(all="ignore"):  # a robot whose values overflow is decided by the filter of one robot
                self._decide_batch(verdicts, ordinary, request)
        for robot in np.flatnonzero(verdicts.single).tolist():
            self._decide_single(verdicts, robot, request)
        return verdicts

    def _validated_input(
        self,
        state: FloatArray,
        nominal: Any,
        latent: FloatArray | None,
        barriers: AbstractBatchBarriers,
        epsilon: Mapping[str, Any] | None,
        affine: tuple[FloatArray, FloatArray] | None,
        backup: Callable[[int], Any] | None,
    ) -> _BatchInput:
        """Checks the shapes of all inputs. Raises InputError for others."""
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
        # Every robot counts as undecided first: one that is forgotten below is decided singly, not left without.
        status, single = np.zeros(robots, dtype=np.int8), np.ones(robots, dtype=bool)
        return BatchVerdicts(np.zeros((robots, len(self.settings.action_low))), status, slack, h_now, h_next, single)

    def _has_valid_inputs(self, request: _BatchInput) -> BoolArray:
        """(robots,) whether the filter of one robot would accept the inputs."""
        context = self._single_filter.tools
        valid = np.full(len(request.state), self.settings.enabled)
        pairs = (
            (request.state, context.state_range),
            (request.nominal, context.nominal_range),
            (request.latent, context.latent_range),
        )
        for numbers, plausible in pairs:
            if numbers is not None:
                valid &= _within(numbers, plausible)
            elif plausible is not None and len(plausible.names) > 0:
                valid[:] = False
        for kind, value in request.margins.items():  # a margin of an unknown kind would protect nothing
            # An unknown kind is left to the single filter, which names it in its fallback.
            usual = kind in self._kinds or kind in request.barriers.kinds
            valid &= usual and value.dtype.kind in "iuf" and np.isfinite(value) & (value >= 0.0)
        return valid

    def _decide_batch(self, verdicts: BatchVerdicts, which: NDArray[np.intp], request: _BatchInput) -> None:
        """Decides robots with feasible constraints; the others stay undecided."""
        settings, nominal = self.settings, request.nominal[which]
        # Indexing copies all barriers: it is skipped in the usual case that every robot has valid inputs.
        barriers = request.barriers if len(which) == len(request.nominal) else request.barriers.only(which)
        predictions = request.predictions(self.model, which)
        margins = {kind: value[which] for kind, value in request.margins.items()}
        state = predictions.state
        h_now = barriers.h(state)
        epsilon = self._epsilon(barriers, len(state), margins)
        share = np.where(barriers.at_once or (False,), 0.0, 1.0 - settings.eta)  # of each row, or of all
        rhs, scale = share * h_now + epsilon, np.maximum(np.abs(h_now), epsilon)
        straight = np.zeros(len(state), dtype=bool)
        constraints = BatchConstraints(settings, barriers, predictions, rhs, scale, straight)
        clipped = np.minimum(np.maximum(nominal, settings.low), settings.high)
        # The nominal action itself where clipping changes nothing, so that -0.0 stays -0.0.
        candidate = constraints.evaluate(np.where(clipped == nominal, nominal, clipped))
        safe = (h_now >= 0.0).all(axis=1)
        feasible = safe & constraints.is_feasible(candidate)
        status = np.where(
            (clipped == nominal).all(axis=1), STATUSES.index(Status.passed), STATUSES.index(Status.corrected)
        )
        numbers = h_now, candidate.h_next, candidate.next_state
        # Robots with NaN or infinity are neither written nor corrected here: they are left to the single filter.
        known = np.logical_and.reduce([np.isfinite(table).all(axis=1) for table in numbers])
        infeasible = np.flatnonzero(known & safe & ~feasible)
        if len(infeasible):
            own = constraints.only(infeasible)
            found, certain = solve_sqp_batch(own, nominal[infeasible], candidate.only(infeasible))
            # Not proven or not feasible: the single filter searches further, so nothing is written here.
            good = certain & own.is_feasible(found)
            candidate.put(infeasible[good], found.only(good))
            feasible[infeasible[good]] = True
            status[infeasible] = STATUSES.index(Status.corrected)
        self._write(verdicts, which, known & feasible, status, h_now, candidate)

    def _write(
        self,
        verdicts: BatchVerdicts,
        which: NDArray[np.intp],
        answered: BoolArray,
        status: NDArray[np.intp],
        h_now: FloatArray,
        candidate: BatchCandidates,
    ) -> None:
        robots = which[answered]
        verdicts.action[robots] = candidate.action[answered]
        verdicts.status[robots] = status[answered]
        verdicts.h_now[robots] = h_now.min(axis=1)[answered]
        verdicts.h_next[robots] = candidate.h_next.min(axis=1)[answered]
        verdicts.single[robots] = False

    def _epsilon(self, barriers: AbstractBatchBarriers, robots: int, margins: Mapping[str, FloatArray]) -> FloatArray:
        """The margin of each row (robots, rows)."""
        table: dict[str, Any] = {**self.settings.epsilon, **margins}
        otherwise = table.get("default", 0.0)
        return np.stack([np.broadcast_to(table.get(kind, otherwise), robots) for kind in barriers.kinds], axis=1)

    def _decide_single(self, verdicts: BatchVerdicts, robot: int, request: _BatchInput) -> None:
        own = None if request.latent is None else request.latent[robot]
        epsilon = {kind: np.asarray(value[robot]).item() for kind, value in request.margins.items()}
        around = request.barriers.one(robot)
        # The functions of the single filter read the robot from here; it is reset even after an exception.
        self._current = request, robot
        try:
            found = self._single_filter.decide(
                request.state[robot], request.nominal[robot], own, barriers=around, epsilon=epsilon
            )
        finally:
            self._current = None
        verdicts.action[robot], verdicts.status[robot] = found.action, STATUSES.index(found.status)
        verdicts.slack[robot], verdicts.h_now[robot], verdicts.h_next[robot] = found.slack, found.h_now, found.h_next


def _within(numbers: FloatArray, plausible: Plausible | None) -> BoolArray:
    """(robots,) whether all entries are finite and within the range."""
    valid = np.isfinite(numbers)
    if plausible is not None and len(plausible.names) > 0:
        valid &= (numbers >= plausible.low) & (numbers <= plausible.high)
    return np.asarray(valid.all(axis=1))


def _array(numbers: ArrayLike | None) -> Any:
    return None if numbers is None else np.asarray(numbers, dtype=np.float64)


def _check(what: str, numbers: FloatArray, shape: tuple[int, ...]) -> None:
    if numbers.shape != shape:
        raise InputError(f"{what}: got shape {numbers.shape}, wanted {shape}, the robots first")
