"""Actions that are on their way: a model whose commands arrive some ticks late, with what is pending in its state.

    xi = (x, a_1, ..., a_n),   xi+ = (step(x, a_1), a_2, ..., a_n, a)

a_1 acts in the tick to come, and what is decided now acts n ticks later. So the action moves no barrier of x within
one step, and the filter's condition on the next step would be blind. The barrier is therefore judged at the state in
which the new action begins to act, which nothing can change any more:

    h(xi) = h(x_n),   x_0 = x,   x_k = step(x_{k-1}, a_k)

There the condition h(xi+) >= (1 - eta) h(xi) + epsilon is the ordinary one of the model without delay. The model need
not be affine in the action: xi+ is.
"""

from __future__ import annotations

from typing import Final, final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.safety.barriers.backup_rollout import Model, fixed, prediction_of
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.function import central_slopes
from safedpa.safety.checks.compatibility import check_reads
from safedpa.safety.prediction.predictor import Prediction
from safedpa.safety.validation import Plausible, checked_output

__all__ = ["PendingActions"]


_SHARE: Final = 1e-3
"""Of a direction, over which the way is differenced: the filter's directions are what an action's range moves."""


@final
class PendingActions:
    """Any model with ``count`` actions on their way, 1 or more; ``resting`` (actions,) is pending at the beginning.

    ``model``: a model of this project, a ``Prediction``, ``affine(x) -> f, g`` or ``step(x, a)``, without the delay.
    A filter of it takes the augmented state xi (states + count actions,)::

        late = PendingActions(model, 3, resting=(0.0,))
        late_barriers = [late.barrier(part) for part in barriers]
        safe = SafetyFilter(late.prediction, late_barriers, settings, state_range=late.state_range)
        xi = late.state(x)
        verdict = safe.decide(xi, nominal action)
        xi = late.next_state(xi, verdict.action, measured)

    Raises InputError for a count below 1, and for a model whose actuators remember something else.
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
        """What the filter takes in place of a model."""
        self.prediction.system = self._inner.system
        self.state_range = self._range()
        """What is believed of xi, with the names of its entries, for a model of this project; else None."""

    def state(self, state: ArrayLike, pending: ArrayLike | None = None) -> FloatArray:
        """xi from x (states,) and the pending actions (count, actions), the next to act first; default: resting."""
        x = checked_output("state", state)
        if pending is None:
            pending = np.tile(self.resting, (self.count, 1))
        queue = checked_output("pending", pending)
        if x.ndim != 1 or queue.shape != (self.count, len(self.resting)):
            wanted = (self.count, len(self.resting))
            raise InputError(f"pending: got state {x.shape} and {queue.shape}, wanted (states,) and {wanted}")
        return np.concatenate((x, queue.ravel()))

    def next_state(self, augmented: FloatArray, action: ArrayLike, measured: ArrayLike) -> FloatArray:
        """xi one tick later, when ``action`` (actions,) was sent and x ``measured`` (states,)."""
        queue = self.split(augmented)[1]
        last = np.reshape(checked_output("action", action), (1, len(self.resting)))
        return self.state(measured, np.concatenate((queue[1:], last)))

    def split(self, augmented: FloatArray) -> tuple[FloatArray, FloatArray]:
        """x (states,) and the pending actions (count, actions) of xi. Raises InputError when it is too short."""
        held = self.count * len(self.resting)
        if np.ndim(augmented) != 1 or len(augmented) <= held:
            raise InputError(
                f"state: got shape {np.shape(augmented)}, wanted x and {self.count} pending actions of "
                f"{len(self.resting)} after it; make it with state()"
            )
        return augmented[:-held], np.reshape(augmented[-held:], (self.count, len(self.resting)))

    def way(self, augmented: FloatArray, latent: FloatArray | None = None) -> list[FloatArray]:
        """x_0 to x_count (states,): now, and after each of the pending actions."""
        state, queue = self.split(augmented)
        way = [fixed(state)]
        for action in queue:
            way.append(self._after(way[-1], action, latent))
        return way

    def reached(self, augmented: FloatArray, latent: FloatArray | None = None) -> FloatArray:
        """x (states,) when the action that is decided now begins to act."""
        return self.way(augmented, latent)[-1]

    def step(self, augmented: FloatArray, action: FloatArray, latent: FloatArray | None = None) -> FloatArray:
        """xi one tick later as the model has it."""
        state, queue = self.split(augmented)
        return self.next_state(augmented, action, self._after(state, queue[0], latent))

    def affine(self, augmented: FloatArray, latent: FloatArray | None = None) -> tuple[FloatArray, FloatArray]:
        """(f, g) with xi+ = f + g a, exact: the action takes the last place of those that wait."""
        actions = len(self.resting)
        f = self.step(augmented, np.zeros(actions), latent)
        g = np.zeros((len(f), actions))
        g[-actions:] = np.eye(actions)
        return f, g

    def barrier(self, barrier: AbstractBarrier, latent: ArrayLike | None = None) -> AbstractBarrier:
        """A barrier of x as one of xi, judged where the action begins to act; ``latent``: with which it gets there.

        Raises InputError where it reads other states than the model's.
        """
        check_reads([barrier], () if self._inner.system is None else self._inner.system.state_names)
        return _DelayedBarrier(self, barrier, None if latent is None else fixed(np.asarray(latent, dtype=np.float64)))

    def _range(self) -> Plausible | None:
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
        if self._inner.of_this_project:
            free = None if latent is None else tuple(latent.tolist())
            return fixed(np.array(self._inner.following(tuple(state.tolist()), action.tolist(), free, None)))
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

    def values(self, state: FloatArray) -> FloatArray:
        return self._barrier.values(self._late.reached(state, self._latent))

    def evaluate(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """By the chain rule: the barrier's own gradient, times central differences of the way there."""
        way = np.array(self._late.way(state, self._latent))
        queue = self._late.split(state)[1]
        moved = np.concatenate((np.ptp(way, axis=0), np.tile(np.ptp(queue, axis=0), self._late.count)))
        far, size = np.ptp(way, axis=0), np.abs(way).max(axis=0)
        size = np.where(far > 0.0, far, np.where(size > 0.0, size, 1.0))
        h, gradient = self._barrier.evaluate(way[-1])
        return h, gradient @ central_slopes(lambda near: self._late.reached(near, self._latent), state, moved, size)

    def along(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        reached = np.zeros((len(self._late.split(state)[0]), directions.shape[1]))
        for index, direction in enumerate(directions.T):
            ahead = self._late.reached(state + _SHARE * direction, self._latent)
            behind = self._late.reached(state - _SHARE * direction, self._latent)
            reached[:, index] = (ahead - behind) / (2.0 * _SHARE)
        return self._barrier.along(self._late.reached(state, self._latent), reached)

    def since(self, state: FloatArray) -> AbstractBarrier:
        inner = self._barrier.since(self._late.reached(state, self._latent))
        return self if inner is self._barrier else _DelayedBarrier(self._late, inner, self._latent)
