"""Delay-augmented models: commands act some ticks late, and the pending ones are part of the state.

    xi = (x, a_1, ..., a_n),   xi+ = (step(x, a_1), a_2, ..., a_n, a)

a_1 acts in the coming tick; what is decided now acts n ticks later. So the action changes no barrier of x within one
step, and the filter's constraint on the next step would have no influence. The barrier is therefore evaluated at the
state in which the new action takes effect, which nothing can change any more:

    h(xi) = h(x_n),   x_0 = x,   x_k = step(x_{k-1}, a_k)

There h(xi+) >= (1 - eta) h(xi) + epsilon is the ordinary constraint of the model without delay. The model need not be
affine in the action: xi+ is.
"""

from __future__ import annotations

from typing import Final, final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.safety.barriers.backup_rollout import Model, fixed, prediction_of
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.function import central_differences
from safedpa.safety.checks.compatibility import check_reads
from safedpa.safety.prediction.predictor import Prediction
from safedpa.safety.validation import Plausible, checked_output

__all__ = ["PendingActions"]


_STEP_SHARE: Final = 1e-3
"""Share of a direction over which the path is differenced; directions are the motion by a whole action range."""


@final
class PendingActions:
    """A model with ``count`` >= 1 actions in flight; ``resting`` (actions,) is pending at the beginning.

    ``model``: a model of this project, a ``Prediction``, ``affine(x) -> f, g`` or ``step(x, a)``, without the delay.
    The filter takes the augmented state xi (states + count actions,)::

        late = PendingActions(model, 3, resting=(0.0,))
        late_barriers = [late.barrier(part) for part in barriers]
        safe = SafetyFilter(late.prediction, late_barriers, settings, state_range=late.state_range)
        xi = late.state(x)
        verdict = safe.decide(xi, nominal action)
        xi = late.next_state(xi, verdict.action, measured)

    Raises InputError for a count below 1, and for a model with other actuator memory.
    """

    def __init__(self, model: Model, count: int, resting: ArrayLike) -> None:
        if isinstance(count, bool) or not isinstance(count, (int, np.integer)) or count < 1:
            raise InputError(f"count: got {count!r}, wanted a whole number of pending actions, 1 or more")
        self.resting = fixed(np.asarray(resting, dtype=np.float64))
        if self.resting.ndim != 1 or not len(self.resting) or not np.isfinite(self.resting).all():
            raise InputError(f"resting: got {resting!r}, wanted (actions,) finite numbers")
        self.count = int(count)
        self._inner = prediction_of(model)
        self.prediction = Prediction(self.affine, self.step)
        """Passed to the filter in place of a model."""
        # Named, so that settings of another system are still refused.
        self.prediction.system = self._inner.system
        self.state_range = self._state_range()
        """Plausible range of xi with the names of its entries, for a model of this project; else None."""

    def state(self, state: ArrayLike, pending: ArrayLike | None = None) -> FloatArray:
        """xi from x (states,) and the pending actions (count, actions), the next one first; default: resting."""
        x = checked_output("state", state)
        if pending is None:
            pending = np.tile(self.resting, (self.count, 1))
        queue = checked_output("pending", pending)
        if x.ndim != 1 or queue.shape != (self.count, len(self.resting)):
            wanted = (self.count, len(self.resting))
            raise InputError(f"pending: got state {x.shape} and {queue.shape}, wanted (states,) and {wanted}")
        return np.concatenate((x, queue.ravel()))

    def next_state(self, augmented: FloatArray, action: ArrayLike, measured: ArrayLike) -> FloatArray:
        """xi one tick later, after ``action`` (actions,) was sent and x ``measured`` (states,)."""
        queue = self.split(augmented)[1]
        # The oldest pending action has been applied; the new one joins at the end.
        last = np.reshape(checked_output("action", action), (1, len(self.resting)))
        return self.state(measured, np.concatenate((queue[1:], last)))

    def split(self, augmented: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Splits xi into x (states,) and the pending actions (count, actions). Raises InputError if it is too short."""
        size_of_queue = self.count * len(self.resting)
        if np.ndim(augmented) != 1 or len(augmented) <= size_of_queue:
            raise InputError(
                f"state: got shape {np.shape(augmented)}, wanted x and {self.count} pending actions of "
                f"{len(self.resting)} after it; make it with state()"
            )
        return augmented[:-size_of_queue], np.reshape(augmented[-size_of_queue:], (self.count, len(self.resting)))

    def path(self, augmented: FloatArray, latent: FloatArray | None = None) -> list[FloatArray]:
        """x_0 to x_count (states,): now, and after each pending action."""
        state, queue = self.split(augmented)
        path = [fixed(state)]
        for action in queue:
            path.append(self._after(path[-1], action, latent))
        return path

    def state_at_effect(self, augmented: FloatArray, latent: FloatArray | None = None) -> FloatArray:
        """x (states,) where the action that is decided now takes effect."""
        return self.path(augmented, latent)[-1]

    def step(self, augmented: FloatArray, action: FloatArray, latent: FloatArray | None = None) -> FloatArray:
        """xi one tick later, as predicted by the model."""
        state, queue = self.split(augmented)
        return self.next_state(augmented, action, self._after(state, queue[0], latent))

    def affine(self, augmented: FloatArray, latent: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """(f, g) with xi+ = f + g a, exact: the action becomes the last pending one."""
        actions = len(self.resting)
        f = self.step(augmented, np.zeros(actions), latent)
        g = np.zeros((len(f), actions))
        # The only entries that a new action changes are its own place in the queue: exact, and never singular.
        g[-actions:] = np.eye(actions)
        return f, g

    def barrier(self, barrier: AbstractBarrier, latent: ArrayLike | None = None) -> AbstractBarrier:
        """Turns a barrier of x into one of xi, evaluated where the action takes effect under ``latent``.

        Raises InputError if it reads other states than the model's.
        """
        # The barrier reads x, so it is compared with the inner model's states, not with those of xi.
        check_reads([barrier], () if self._inner.system is None else self._inner.system.state_names)
        return _DelayedBarrier(self, barrier, None if latent is None else fixed(np.asarray(latent, dtype=np.float64)))

    def _state_range(self) -> Plausible | None:
        system = self._inner.system
        if system is None:
            return None
        pending = [f"{name} pending {place}" for place in range(1, self.count + 1) for name in system.action_names]
        return Plausible(
            np.concatenate((system.state_low, np.tile(system.action_low, self.count))),
            np.concatenate((system.state_high, np.tile(system.action_high, self.count))),
            (*system.state_names, *pending),
        )

    def _after(self, state: FloatArray, action: FloatArray, latent: FloatArray | None) -> FloatArray:
        if self._inner.is_project_model:
            free = None if latent is None else tuple(latent.tolist())
            return fixed(np.array(self._inner.next_state_floats(tuple(state.tolist()), action.tolist(), free, None)))
        found = self._inner.next_state(state, fixed(action), latent, None)
        if found.shape != state.shape:
            raise InputError(f"predicted state: got shape {found.shape}, wanted {state.shape}")
        return fixed(found)


@final
class _DelayedBarrier(AbstractBarrier):
    """Another barrier at the state after the pending actions."""

    def __init__(self, late: PendingActions, barrier: AbstractBarrier, latent: FloatArray | None) -> None:
        self.names, self.kind = barrier.names, barrier.kind
        self.reads = () if late.prediction.system is None else barrier.reads
        self._late, self._barrier, self._latent = late, barrier, latent

    def h(self, state: FloatArray) -> FloatArray:
        return self._barrier.h(self._late.state_at_effect(state, self._latent))

    def h_and_grad(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """By the chain rule: the barrier's gradient times central differences of the path."""
        path = np.array(self._late.path(state, self._latent))
        queue = self._late.split(state)[1]
        motion = np.concatenate((np.ptp(path, axis=0), np.tile(np.ptp(queue, axis=0), self._late.count)))
        path_extent, size = np.ptp(path, axis=0), np.abs(path).max(axis=0)
        # The size of each entry sets the difference step; an entry that is always 0 gets a size of 1, which is never
        # divided by 0.
        size = np.where(path_extent > 0.0, path_extent, np.where(size > 0.0, size, 1.0))
        h, gradient = self._barrier.h_and_grad(path[-1])
        return h, gradient @ central_differences(
            lambda near: self._late.state_at_effect(near, self._latent), state, motion, size
        )

    def lie_derivative(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        moved_state = np.zeros((len(self._late.split(state)[0]), directions.shape[1]))
        for index, direction in enumerate(directions.T):
            ahead = self._late.state_at_effect(state + _STEP_SHARE * direction, self._latent)
            behind = self._late.state_at_effect(state - _STEP_SHARE * direction, self._latent)
            moved_state[:, index] = (ahead - behind) / (2.0 * _STEP_SHARE)
        # Both chain-rule factors are differenced over the same directions, so no full gradient of the path is needed.
        return self._barrier.lie_derivative(self._late.state_at_effect(state, self._latent), moved_state)

    def starting_at(self, state: FloatArray) -> AbstractBarrier:
        # The inner barrier may look at the path between ticks, which starts where the action takes effect.
        inner = self._barrier.starting_at(self._late.state_at_effect(state, self._latent))
        return self if inner is self._barrier else _DelayedBarrier(self._late, inner, self._latent)
