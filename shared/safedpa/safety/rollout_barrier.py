"""A barrier from a backup: the least h along the path on which the backup would lead from here.

    H_i(x) = min over 0 <= t <= horizon of h_i(y(t)),   y(0) = x,   y(t + 1) = step(y(t), backup(y(t))),

between the ticks along straight chords, so that what is thinner than a tick's travel counts as well. If the backup
brings the robot to where it stays (at rest) within the horizon, taking the backup loses nothing: H_i(x+) >= H_i(x) for
all i at once. Hence wherever all H_i >= epsilon_i / eta the filter's conditions

    H_i(x+) >= (1 - eta) H_i(x) + epsilon_i

can be kept together, whatever the relative degree of h, and by the backup: give it to the filter as well. The end of
the horizon is nobody's promise but the backup's; ``check_filter`` drives on from there and tells when h still falls.
Source: Gurriet, Mote, Singletary, Nilsson, Feron, Ames, A Scalable Safety Critical Control Framework for Nonlinear
Systems, IEEE Access 8, 2020.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import TypeAlias, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.closed_loop import ClosedLoop, Model, fixed
from safedpa.safety.differences import central_slopes
from safedpa.safety.function_barrier import FunctionBarrier
from safedpa.safety.swept import Least, Place, chord_point, least_along

__all__ = ["RolloutBarrier"]

Values: TypeAlias = NDArray[np.float64]


@final
class RolloutBarrier(AbstractBarrier):
    """H_i(x) >= 0 from a model, a backup and h; see the module's equation. One value for each value of h.

    ``model``: a model of this project, a ``Prediction``, ``affine(x) -> f, g`` as the filter takes it, or
    ``step(x, a)``; it should be the filter's own. ``backup(x (states,)) -> action (actions,)``, or one constant action.
    ``h(x) -> float or (m,)`` with ``names``, or another barrier, whose names and kind are taken. ``horizon``: ticks of
    the model, 1 or more; those that lie beyond the backup's rest cost nothing. ``latent``: the model's, for all ticks.

    The minimum is exact, not softened; the gradient is that of the place where it is taken: by the recorded equations
    where the model has them, the backup is constant and h knows its own gradient; else by central differences of the
    whole way to there, whose steps have no unit. Where two places are equally low it belongs to the earlier one:
    the filter evaluates H itself at every action that it hands out, so a kink costs it nearness to the wish, no safety.

    Raises InputError for a horizon below 1, a model whose actuators remember, and at evaluation for a wrong shape.
    """

    def __init__(
        self,
        model: Model,
        backup: Callable[[Values], ArrayLike] | ArrayLike,
        h: Callable[[Values], ArrayLike] | AbstractBarrier,
        horizon: int,
        names: Sequence[str] = ("h",),
        kind: str = "rollout",
        *,
        latent: ArrayLike | None = None,
    ) -> None:
        if isinstance(horizon, bool) or not isinstance(horizon, (int, np.integer)) or horizon < 1:
            raise InputError(
                f"horizon: got {horizon!r}, wanted a whole number of ticks, 1 or more (seconds to rest / period)"
            )
        own = h if isinstance(h, AbstractBarrier) else FunctionBarrier(h, names=names, kind=kind)
        self.names, self.kind, self.horizon = own.names, own.kind, int(horizon)
        self.loop = ClosedLoop(model, backup, latent)
        self._h = own
        self._knows_gradient = not isinstance(own, FunctionBarrier)

    def values(self, state: Values) -> Values:  # noqa: D102
        return self.least(state, None).values

    def evaluate(self, state: Values) -> tuple[Values, Values]:  # noqa: D102
        return self.evaluate_from(None, state)

    def since(self, state: Values) -> AbstractBarrier:
        """The barrier for states that are reached within one tick from ``state``: the chord to them counts as well."""
        return _Since(self, fixed(state))

    def backup(self, state: Values | None) -> Values:
        """The backup's action (actions,), for ``SafetyFilter(..., backup=barrier.backup)``.

        Raises InputError without a state, unless the backup is constant; the filter then takes its resting action.
        """
        if state is None and not self.loop.constant:
            raise InputError("backup: got no state, wanted one")
        return self.loop.action(np.empty(0) if state is None else state)

    def path(self, state: Values) -> list[Values]:
        """The states from ``state`` (states,) on under the backup, up to the horizon or to rest."""
        return self.loop.path(state, self.horizon)

    def least(self, state: Values, origin: Values | None) -> Least:
        """H (m,) and where it is taken on the path, which begins with ``origin`` where one is given."""
        return least_along(self._h.values, self._whole(state, origin, self.horizon), always=int(origin is not None))

    def fall_beyond(self, state: Values) -> Values:
        """(m,) >= 0 by how much h falls below H in another horizon's ticks: 0 where the backup ends at rest."""
        path = self.path(state)
        known = least_along(self._h.values, path).values
        if len(path) <= self.horizon:
            return np.zeros(len(known))
        further = np.array([self._h.values(each) for each in self.loop.path(path[-1], self.horizon)])
        return np.asarray(np.maximum(known - further.min(axis=0), 0.0))

    def evaluate_from(self, origin: Values | None, state: Values) -> tuple[Values, Values]:
        """H (m,) and its gradient (m, states), with the chord from ``origin`` where one is given."""
        path = self._whole(state, origin, self.horizon)
        found = least_along(self._h.values, path, always=int(origin is not None))
        exact = self._chained(path[int(origin is not None) :], found.places, path, origin is not None)
        if exact is not None:
            return found.values, exact
        moved = np.ptp(np.array(path), axis=0)
        at = fixed(state)
        return found.values, central_slopes(lambda near: self._h_at(found.places, near, origin), at, moved, found.size)

    def _chained(self, path: list[Values], places: Sequence[Place], whole: list[Values], swept: bool) -> Values | None:
        """The gradient (m, states) by the chain rule, of h that knows its own and a model that knows its slopes."""
        slopes = self.loop.sensitivities(path) if self._knows_gradient else None
        if slopes is None:
            return None
        before = [np.zeros_like(slopes[0]), *slopes] if swept else slopes
        rows = []
        for row, (k, share) in enumerate(places):
            moved = before[k] if share == 0.0 else (1.0 - share) * before[k] + share * before[k + 1]
            rows.append(self._h.evaluate(chord_point(whole, (k, share)))[1][row] @ moved)
        return np.array(rows)

    def _whole(self, state: Values, origin: Values | None, ticks: int) -> list[Values]:
        path = self.loop.path(state, ticks)
        return path if origin is None else [origin, *path]

    def _h_at(self, places: Sequence[Place], state: Values, origin: Values | None) -> Values:
        """h_i (m,) at its own place of the path from ``state``."""
        last = max(k + (share > 0.0) for k, share in places) - (origin is not None)
        path = self._whole(state, origin, max(last, 0))
        known: dict[Place, Values] = {}
        for place in places:
            if place not in known:
                k, share = place
                known[place] = self._h.values(path[-1] if k + 1 >= len(path) else chord_point(path, (k, share)))
        return np.array([known[place][row] for row, place in enumerate(places)])


@final
class _Since(AbstractBarrier):
    """A rollout barrier for states that one tick from ``origin`` leads to."""

    def __init__(self, whole: RolloutBarrier, origin: Values) -> None:
        self.names, self.kind = whole.names, whole.kind
        self._whole, self._origin = whole, origin

    def values(self, state: Values) -> Values:
        return self._whole.least(state, self._origin).values

    def evaluate(self, state: Values) -> tuple[Values, Values]:
        return self._whole.evaluate_from(self._origin, state)
