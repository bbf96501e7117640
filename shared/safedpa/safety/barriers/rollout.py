"""A barrier from a backup: the minimum of h along the path on which the backup would lead from here.

    H_i(x) = min over 0 <= t <= horizon of h_i(y(t)),   y(0) = x,   y(t + 1) = step(y(t), backup(y(t))),

between the ticks along straight chords, so that an obstacle thinner than a tick's travel counts as well. If the backup
brings the robot to rest within the horizon, taking the backup loses nothing: H_i(x+) >= H_i(x) for all i at once. Hence
wherever all H_i >= epsilon_i / eta the filter's constraints

    H_i(x+) >= (1 - eta) H_i(x) + epsilon_i

can be satisfied together, whatever the relative degree of h, namely by the backup: give it to the filter as well.
Beyond the horizon nothing is guaranteed; ``check_filter`` drives on from there and reports whether h still falls.
Source: Gurriet, Mote, Singletary, Nilsson, Feron, Ames, A Scalable Safety Critical Control Framework for Nonlinear
Systems, IEEE Access 8, 2020.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.native.rollout import FoundMinimum
from safedpa.safety.barriers.backup_rollout import BackupRollout, Model, fixed
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.function import FunctionBarrier, central_differences
from safedpa.safety.barriers.path_minimum import PathMinimum, PathPoint, chord_point, minimum_along
from safedpa.safety.barriers.rollout_kernel import CompiledRollout
from safedpa.safety.checks.compatibility import check_reads
from safedpa.safety.prediction.predictor import Prediction
from safedpa.safety.validation import checked_output

__all__ = ["PathWithMinimum", "Rollout", "RolloutBarrier"]


_STEP_SHARE: Final = 1e-3
"""Share of a direction over which H is differenced; the filter's directions are the motion by a whole action range."""


@final
class RolloutBarrier(AbstractBarrier):
    """H_i(x) >= 0 from a model, a backup and h; see the module's equation. One value for each value of h.

    ``model``: a model of this project, a ``Prediction``, ``affine(x) -> f, g`` as the filter takes it, or
    ``step(x, a)``; it should be the filter's own. ``backup(x (states,)) -> action (actions,)``, or one constant action.
    ``h(x) -> float or (m,)`` with ``names`` and the states that it ``reads``, or another barrier, whose names, kind and
    states are used. ``horizon``: ticks of the model, 1 or more; ticks after the robot has come to rest take no time.
    ``latent``: the model's, for all ticks; a filter whose latent is estimated online gets a new barrier with each
    decision.

    A ``backup(x, operations)``, an ``h(x, operations)`` and a ``step(x, a, operations)`` compute with the elementwise
    functions that they are given. If all three do so (or are a model with rates over ``operations``, a constant backup,
    a barrier that is an equation), the rollout is compiled to C; ``not_compiled`` says why not.

    The minimum is exact, not smoothed; its gradient is that of h at the minimising point. It is computed by the
    recorded equations if the model has them, the backup is constant and h has a gradient; otherwise by unit-free
    central differences of the whole path up to that point. Of two equal minima the earlier one counts. The filter
    evaluates H itself at every action that it returns, so a kink may make an action less close to the nominal one, but
    not unsafe.

    Raises InputError for a horizon below 1, a model with actuator memory, an h of other states than the model's, and at
    evaluation for a wrong shape.

    Example: a mass that brakes before a wall at 1 m.

        >>> def step(x, a):
        ...     return np.array([x[0] + 0.05 * x[1], x[1] + 0.05 * a[0]])
        >>> def brake(x):
        ...     return np.clip(-x[1:] / 0.05, -1.0, 1.0)
        >>> safedpa.RolloutBarrier(step, brake, lambda x: 1.0 - x[0], horizon=40).h(np.array([0.0, 1.0])).round(3)
        array([0.475])
    """

    def __init__(
        self,
        model: Model,
        backup: Callable[..., ArrayLike] | ArrayLike,
        h: Callable[..., ArrayLike] | AbstractBarrier,
        horizon: int,
        names: Sequence[str] = ("h",),
        kind: str = "rollout",
        *,
        latent: ArrayLike | None = None,
        reads: Sequence[str] = (),
    ) -> None:
        # True would be a horizon of one tick.
        if isinstance(horizon, bool) or not isinstance(horizon, (int, np.integer)) or horizon < 1:
            raise InputError(
                f"horizon: got {horizon!r}, wanted a whole number of ticks, 1 or more (seconds to rest / period)"
            )
        own = h if isinstance(h, AbstractBarrier) else FunctionBarrier(h, names=names, kind=kind, reads=reads)
        self.names, self.kind, self.reads, self.horizon = own.names, own.kind, own.reads, int(horizon)
        self.loop = BackupRollout(model, backup, latent)
        self._h = own
        system = self.loop.prediction.system
        if system is not None:
            check_reads([own], system.state_names)
        self.reads = own.reads if system is None else system.state_names
        self._compiled = CompiledRollout(model, backup, own, self.loop, self.horizon)
        # A FunctionBarrier may have to difference its own h: differencing the whole path once is then more accurate.
        self._knows_gradient = not isinstance(own, FunctionBarrier)

    @property
    def prediction(self) -> Prediction:
        """The model for ``SafetyFilter(barrier.prediction, [barrier], ...)``.

        A ``step(x, a, operations)`` is compiled to C with its slopes in the action. A ``step(x, a)`` without
        ``operations`` has no slopes: give the filter ``Prediction(affine, step)``.
        """
        return self._compiled.prediction or self.loop.prediction

    def compiled_rows(self, states: int, actions: int, seconds: float) -> Any:
        """The compiled rollout for the compiled search at ``seconds`` of the run; None: the search must be Python's.

        To be asked after ``starting_at``, which compares it with the functions.
        """
        kernel = self._compiled.kernel(states)
        exact = self._knows_gradient and kernel is not None and kernel.has_gradient
        by_numpy = self._knows_gradient and self.loop.constant and not exact
        if kernel is None or kernel.actions < actions or by_numpy or self._compiled.time != seconds:
            return None
        return kernel.rows_for_search(exact)

    @property
    def not_compiled(self) -> str:
        """Why rollouts run in NumPy instead of compiled C, in one line; empty if they are compiled."""
        return self._compiled.reason

    def h(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return self._checked_minimum(state).values

    def h_and_grad(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:  # noqa: D102
        rollout = self._checked_minimum(state)
        return rollout.values, self.gradient_at(rollout)

    def lie_derivative(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        """As in every barrier; without recorded equations, differences along the directions."""
        return self.lie_derivative_at(self._checked_minimum(state), directions)

    def starting_at(self, state: FloatArray) -> AbstractBarrier:
        """Returns the barrier for states one tick after ``state``: the chord to them counts as well."""
        self._compiled.refresh(state)
        return _RolloutFrom(self, fixed(state))

    def backup(self, state: FloatArray | None) -> FloatArray:
        """The backup's action (actions,), for ``SafetyFilter(..., backup=barrier.backup)``.

        Raises InputError without a state, unless the backup is constant; the filter then uses its resting action.
        """
        if state is None and not self.loop.constant:
            raise InputError("backup: got no state, wanted one")
        # A constant backup ignores the state, so an empty one is as good as any.
        return self.loop.action(np.empty(0) if state is None else state)

    def path(self, state: FloatArray) -> list[FloatArray]:
        """The states from ``state`` (states,) on under the backup, until the horizon or rest."""
        return self.loop.path(state, self.horizon)

    def fall_beyond(self, state: FloatArray) -> FloatArray:
        """(m,) >= 0 by how much h falls below H within another horizon: 0 if the backup ends at rest."""
        path = self.path(state)
        known = minimum_along(self._h_of, path).values
        # A path shorter than the horizon has come to rest: nothing changes beyond it.
        if len(path) <= self.horizon:
            return np.zeros(len(known))
        further = np.array([self._h_of(each) for each in self.loop.path(path[-1], self.horizon)])
        return np.asarray(np.maximum(known - further.min(axis=0), 0.0))

    def minimum_at(self, origin: FloatArray | None, state: FloatArray) -> Rollout:
        """H at ``state`` (states,) and its minimising points; the path begins with ``origin`` if given."""
        kernel = self._compiled.kernel(len(state))
        # None: a state is not finite, which the implementation in NumPy reports
        found = None if kernel is None else kernel.minimum(origin, state, self._compiled.time)
        return Rollout(origin, fixed(state), found or self._found_by_numpy(origin, state))

    def _found_by_numpy(self, origin: FloatArray | None, state: FloatArray) -> PathWithMinimum:
        path = self._path_from(origin, state, self.horizon)
        return PathWithMinimum(path, minimum_along(self._h_of, path, always=int(origin is not None)))

    def _checked_minimum(self, state: FloatArray) -> Rollout:
        """H at a state that is asked for alone: as at every decision, the kernel is compared with the functions."""
        self._compiled.refresh(state)
        return self.minimum_at(None, state)

    def gradient_at(self, rollout: Rollout) -> FloatArray:
        """d(H)/d(x) (m, states)."""
        exact = self._gradient_by_chain_rule(rollout)
        if exact is not None:
            return exact
        path = self._path_from(rollout.origin, rollout.state, self.horizon)
        motion = np.ptp(np.array(path), axis=0)
        size = rollout.found.size if isinstance(rollout.found, FoundMinimum) else rollout.found.minimum.size
        return central_differences(lambda near: self._h_near(rollout, near), rollout.state, motion, size)

    def lie_derivative_at(self, rollout: Rollout, directions: FloatArray) -> FloatArray:
        """d(H)/d(u) (m, n) at the state + ``directions`` (states, n) u, u = 0."""
        exact = self._gradient_by_chain_rule(rollout)
        if exact is not None:
            return np.asarray(exact @ directions)
        kernel, found = self._compiled.kernel(len(rollout.state)), rollout.found
        if kernel is not None and isinstance(found, FoundMinimum):
            quick = kernel.lie_differences(found, rollout.origin, rollout.state, directions, self._compiled.time)
            if quick is not None:
                return quick
        derivatives = np.zeros((len(self.names), directions.shape[1]))
        for index, direction in enumerate(directions.T):
            if direction.any():
                step = _STEP_SHARE * direction
                ahead = self._h_near(rollout, rollout.state + step)
                derivatives[:, index] = (ahead - self._h_near(rollout, rollout.state - step)) / (2.0 * _STEP_SHARE)
        return derivatives

    def _gradient_by_chain_rule(self, rollout: Rollout) -> FloatArray | None:
        """The gradient by the chain rule, if both h and the model have derivatives."""
        if not self._knows_gradient:
            return None
        kernel, found = self._compiled.kernel(len(rollout.state)), rollout.found
        if isinstance(found, FoundMinimum):
            exact = (
                None if kernel is None else kernel.gradient(found, rollout.origin, rollout.state, self._compiled.time)
            )
            if exact is not None or not self.loop.constant:
                return exact
            found = self._found_by_numpy(rollout.origin, rollout.state)
        first = int(rollout.origin is not None)
        derivatives = self.loop.sensitivities(found.path[first:])
        if derivatives is None:
            return None
        # ``origin`` is measured and does not move with the state: its sensitivity is 0.
        sensitivities = [*([np.zeros_like(derivatives[0])] * first), *derivatives]
        rows = []
        for row, (k, share) in enumerate(found.minimum.points):
            ahead = sensitivities[k]
            change = ahead if share == 0.0 else (1.0 - share) * ahead + share * sensitivities[k + 1]
            rows.append(self._h.h_and_grad(chord_point(found.path, (k, share)))[1][row] @ change)
        return np.array(rows)

    def _h_of(self, state: FloatArray) -> FloatArray:
        """h (m,) at one state, as a copy: a barrier may return an array that it writes again."""
        return checked_output("h", self._h.h(state))

    def _path_from(self, origin: FloatArray | None, state: FloatArray, ticks: int) -> list[FloatArray]:
        path = self.loop.path(state, ticks)
        return path if origin is None else [origin, *path]

    def _h_near(self, rollout: Rollout, state: FloatArray) -> FloatArray:
        """h_i (m,) at the same points of the path from another state."""
        kernel, found = self._compiled.kernel(len(state)), rollout.found
        if isinstance(found, FoundMinimum):
            near = None if kernel is None else kernel.h_near(found, rollout.origin, state, self._compiled.time)
            if near is not None:
                return near
            points = tuple(zip(found.chords.tolist(), found.shares.tolist(), strict=True))
        else:
            points = found.minimum.points
        # Only as many ticks as the furthest point needs; the rest of the path has no influence on the difference.
        last = max(k + (share > 0.0) for k, share in points) - (rollout.origin is not None)
        path = self._path_from(rollout.origin, state, max(last, 0))
        known: dict[PathPoint, FloatArray] = {}
        for point in points:
            # By the envelope theorem the minimising point may stay fixed: to first order only h at that point changes.
            if point not in known:
                known[point] = self._h_of(path[-1] if point[0] + 1 >= len(path) else chord_point(path, point))
        return np.array([known[point][row] for row, point in enumerate(points)])


@final
@dataclass(frozen=True, eq=False)
class PathWithMinimum:
    """A path and the minimum on it, from the implementation in NumPy."""

    path: list[FloatArray]
    minimum: PathMinimum


@final
@dataclass(frozen=True, eq=False)
class Rollout:
    """H at a state, from the compiled kernel or from NumPy."""

    origin: FloatArray | None
    state: FloatArray
    found: FoundMinimum | PathWithMinimum

    @property
    def values(self) -> FloatArray:
        """H (m,)."""
        return self.found.values if isinstance(self.found, FoundMinimum) else self.found.minimum.values


@final
class _RolloutFrom(AbstractBarrier):
    """A rollout barrier for states one tick after ``origin``; caches their rollouts for one decision."""

    def __init__(self, barrier: RolloutBarrier, origin: FloatArray) -> None:
        self.names, self.kind, self.reads = barrier.names, barrier.kind, barrier.reads
        self._barrier, self._origin = barrier, origin
        self._known: dict[bytes, Rollout] = {}

    def h(self, state: FloatArray) -> FloatArray:
        # A copy: the caller may write into it, and the rollout is cached.
        return self._rollout_at(state).values.copy()

    def h_and_grad(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.h(state), self._barrier.gradient_at(self._rollout_at(state))

    def lie_derivative(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        return self._barrier.lie_derivative_at(self._rollout_at(state), directions)

    def _rollout_at(self, state: FloatArray) -> Rollout:
        # The same candidate states are evaluated for h and again for the gradient; a rollout takes many model steps.
        key = state.tobytes()
        if key not in self._known:
            self._known[key] = self._barrier.minimum_at(self._origin, state)
        return self._known[key]
