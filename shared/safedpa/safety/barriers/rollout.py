"""A barrier from a backup: the least h along the path on which the backup would lead from here.

    H_i(x) = min over 0 <= t <= horizon of h_i(y(t)),   y(0) = x,   y(t + 1) = step(y(t), backup(y(t))),

between the ticks along straight chords, so that what is thinner than a tick's travel counts as well. If the backup
brings the robot to where it stays (at rest) within the horizon, taking the backup loses nothing: H_i(x+) >= H_i(x) for
all i at once. Hence wherever all H_i >= epsilon_i / eta the filter's conditions

    H_i(x+) >= (1 - eta) H_i(x) + epsilon_i

can be kept together, whatever the relative degree of h, and by the backup: give it to the filter as well. The end of
the horizon is no one's promise but the backup's; ``check_filter`` drives on from there and tells when h still falls.
Source: Gurriet, Mote, Singletary, Nilsson, Feron, Ames, A Scalable Safety Critical Control Framework for Nonlinear
Systems, IEEE Access 8, 2020.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Final, final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.safety.barriers.backup_rollout import BackupRollout, Model, fixed
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.function import FunctionBarrier, central_slopes
from safedpa.safety.barriers.path_minimum import PathMinimum, Place, chord_point, minimum_along
from safedpa.safety.checks.compatibility import check_reads
from safedpa.safety.validation import checked_output

__all__ = ["Rollout", "RolloutBarrier"]


_SHARE: Final = 1e-3
"""Of a direction, over which H is differenced: the filter's directions are what an action's whole range moves."""


@final
class RolloutBarrier(AbstractBarrier):
    """H_i(x) >= 0 from a model, a backup and h; see the module's equation. One value for each value of h.

    ``model``: a model of this project, a ``Prediction``, ``affine(x) -> f, g`` as the filter takes it, or
    ``step(x, a)``; it should be the filter's own. ``backup(x (states,)) -> action (actions,)``, or one constant action.
    ``h(x) -> float or (m,)`` with ``names`` and the states that it ``reads``, or another barrier, whose names, kind and
    states are taken. ``horizon``: ticks of the model, 1 or more; those that lie beyond the backup's rest cost nothing.
    ``latent``: the model's, for all ticks; a filter whose latent is estimated while it drives gets a new barrier with
    each decision.

    The minimum is exact, not softened; the gradient is that of the place where it is taken: by the recorded equations
    where the model has them, the backup is constant and h knows its own gradient; else by central differences of the
    whole way to there, whose steps have no unit. Where two places are equally low it belongs to the earlier one:
    the filter evaluates H itself at every action that it hands out, so a kink costs it nearness to the nominal action, no safety.

    Raises InputError for a horizon below 1, a model whose actuators remember, an h that reads other states than the
    model's, and at evaluation for a wrong shape.
    """

    def __init__(
        self,
        model: Model,
        backup: Callable[[FloatArray], ArrayLike] | ArrayLike,
        h: Callable[[FloatArray], ArrayLike] | AbstractBarrier,
        horizon: int,
        names: Sequence[str] = ("h",),
        kind: str = "rollout",
        *,
        latent: ArrayLike | None = None,
        reads: Sequence[str] = (),
    ) -> None:
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
        self._knows_gradient = not isinstance(own, FunctionBarrier)

    def values(self, state: FloatArray) -> FloatArray:  # noqa: D102
        return self.taken(None, state).least.values

    def evaluate(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:  # noqa: D102
        taken = self.taken(None, state)
        return taken.least.values, self.gradient_of(taken)

    def along(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        """As in every barrier; without recorded equations, differences along the directions."""
        return self.along_of(self.taken(None, state), directions)

    def since(self, state: FloatArray) -> AbstractBarrier:
        """The barrier for states that are reached within one tick from ``state``: the chord to them counts as well."""
        return _RolloutFrom(self, fixed(state))

    def backup(self, state: FloatArray | None) -> FloatArray:
        """The backup's action (actions,), for ``SafetyFilter(..., backup=barrier.backup)``.

        Raises InputError without a state, unless the backup is constant; the filter then takes its resting action.
        """
        if state is None and not self.loop.constant:
            raise InputError("backup: got no state, wanted one")
        return self.loop.action(np.empty(0) if state is None else state)

    def path(self, state: FloatArray) -> list[FloatArray]:
        """The states from ``state`` (states,) on under the backup, up to the horizon or to rest."""
        return self.loop.path(state, self.horizon)

    def fall_beyond(self, state: FloatArray) -> FloatArray:
        """(m,) >= 0 by how much h falls below H in another horizon's ticks: 0 where the backup ends at rest."""
        path = self.path(state)
        known = minimum_along(self._heights, path).values
        if len(path) <= self.horizon:
            return np.zeros(len(known))
        further = np.array([self._heights(each) for each in self.loop.path(path[-1], self.horizon)])
        return np.asarray(np.maximum(known - further.min(axis=0), 0.0))

    def taken(self, origin: FloatArray | None, state: FloatArray) -> Rollout:
        """H at ``state`` (states,) and where on its path it is taken, which begins with ``origin`` if one is given."""
        path = self._whole(origin, state, self.horizon)
        return Rollout(origin, fixed(state), path, minimum_along(self._heights, path, always=int(origin is not None)))

    def gradient_of(self, taken: Rollout) -> FloatArray:
        """dH/dx (m, states)."""
        exact = self._chained(taken)
        if exact is not None:
            return exact
        moved = np.ptp(np.array(taken.path), axis=0)
        return central_slopes(lambda near: self._h_near(taken, near), taken.state, moved, taken.least.size)

    def along_of(self, taken: Rollout, directions: FloatArray) -> FloatArray:
        """dH/du (m, n) at the state + ``directions`` (states, n) u, u = 0."""
        exact = self._chained(taken)
        if exact is not None:
            return np.asarray(exact @ directions)
        slopes = np.zeros((len(self.names), directions.shape[1]))
        for index, direction in enumerate(directions.T):
            if direction.any():
                ahead = self._h_near(taken, taken.state + _SHARE * direction)
                slopes[:, index] = (ahead - self._h_near(taken, taken.state - _SHARE * direction)) / (2.0 * _SHARE)
        return slopes

    def _chained(self, taken: Rollout) -> FloatArray | None:
        """The gradient by the chain rule, of h that knows its own and a model that knows its slopes."""
        first = int(taken.origin is not None)
        slopes = self.loop.sensitivities(taken.path[first:]) if self._knows_gradient else None
        if slopes is None:
            return None
        moved = [*([np.zeros_like(slopes[0])] * first), *slopes]
        rows = []
        for row, (k, share) in enumerate(taken.least.places):
            change = moved[k] if share == 0.0 else (1.0 - share) * moved[k] + share * moved[k + 1]
            rows.append(self._h.evaluate(chord_point(taken.path, (k, share)))[1][row] @ change)
        return np.array(rows)

    def _heights(self, state: FloatArray) -> FloatArray:
        """h (m,) at one state, as an array of its own: a barrier may return one that it writes again."""
        return checked_output("h", self._h.values(state))

    def _whole(self, origin: FloatArray | None, state: FloatArray, ticks: int) -> list[FloatArray]:
        path = self.loop.path(state, ticks)
        return path if origin is None else [origin, *path]

    def _h_near(self, taken: Rollout, state: FloatArray) -> FloatArray:
        """h_i (m,) at the same place of the path from another state."""
        places = taken.least.places
        last = max(k + (share > 0.0) for k, share in places) - (taken.origin is not None)
        path = self._whole(taken.origin, state, max(last, 0))
        known: dict[Place, FloatArray] = {}
        for place in places:
            if place not in known:
                known[place] = self._heights(path[-1] if place[0] + 1 >= len(path) else chord_point(path, place))
        return np.array([known[place][row] for row, place in enumerate(places)])


@final
@dataclass(frozen=True, eq=False)
class Rollout:
    """H at a state: the path that it was looked for on, and where it is taken."""

    origin: FloatArray | None
    state: FloatArray
    path: list[FloatArray]
    least: PathMinimum


@final
class _RolloutFrom(AbstractBarrier):
    """A rollout barrier for states that one tick from ``origin`` leads to; remembers them, for one decision."""

    def __init__(self, whole: RolloutBarrier, origin: FloatArray) -> None:
        self.names, self.kind, self.reads = whole.names, whole.kind, whole.reads
        self._whole, self._origin = whole, origin
        self._known: dict[bytes, Rollout] = {}

    def values(self, state: FloatArray) -> FloatArray:
        return self._taken(state).least.values.copy()

    def evaluate(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        return self.values(state), self._whole.gradient_of(self._taken(state))

    def along(self, state: FloatArray, directions: FloatArray) -> FloatArray:
        return self._whole.along_of(self._taken(state), directions)

    def _taken(self, state: FloatArray) -> Rollout:
        key = state.tobytes()
        if key not in self._known:
            self._known[key] = self._whole.taken(self._origin, state)
        return self._known[key]
