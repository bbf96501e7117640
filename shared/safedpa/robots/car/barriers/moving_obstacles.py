"""Barriers against moving obstacles and hidden areas: passive safety, with one h per disc."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.equations import Given
from safedpa.errors import InputError
from safedpa.operations import FLOATS, Operations, Scalar
from safedpa.robots.car.barriers.body import SweptBody, TrailerEnvelope, body_of, hitch_of
from safedpa.robots.car.barriers.body import grad_bound as steepest_of_body
from safedpa.robots.car.barriers.obstacles import Footprint
from safedpa.robots.car.dynamics.limits import IS_STATIONARY, ReversalBraking
from safedpa.safety.barriers.equation import AbstractEquationBarrier
from safedpa.safety.barriers.stopping import Braking

_BODY = 4
"""Number of shared parameters of the body, as in ``body_of``."""
_OWN = 11
"""Number of shared parameters without those of the load."""
_FASTEST, _THICK = 7, 9
"""Indices of the largest disc speed (followed by the creeping time) and of the car's own radius."""
_RATE, _MOST = _OWN + 1, _OWN + 2
"""Indices of the load's growth per distance driven backwards, and of its largest growth."""
_LOAD_AHEAD = 0.05
"""m; no part of a load that was not pushed back was ever farther ahead of the hitch (tests/sensing)."""
_AWAY = 0.5
"""m; more than any margin can increase to, as margins are about 0.1 m."""
_STILL = 0.01
"""m/s; a stationary car may report a backward speed up to this."""


@final
class MovingObstacleBarrier(AbstractEquationBarrier):
    """h_i = distance(c_i, S(x)) - (R_i + r + clearance + w_i a) - w_i T(v), for discs (c_i, R_i) with speeds w_i.

    S(x) is the segment of ``ObstacleBarrier``, extended by the stopping distance D(v) of ``ReversalBraking``, T(v) its
    stopping time, and a one period, for which the surroundings are not observed again. While h_i >= 0 the car can stop
    before anything not faster than w_i can reach it: passive safety. Under this braking S shrinks into itself and T
    does not increase, so h_i does not decrease.

    For a hidden disc (``hidden``) behind the end that the car drives away from, w_i T counts as 0: someone who
    approaches from behind sees the car.

    With a load (``towed``) r is ``own_radius``, that of the car's own body, if it is known: a load has to pass
    stationary obstacles later, but movers only have to be clear of car and load until these have stopped. So h_i is
    also at most the distance to where the load may be: its whole reach around the hitch, and without reversing only the
    part of it behind the hitch,

        { c : |c - hitch| <= reach } and { c : ahead of the hitch by at most 0.05 m + reach growth / most },

    growth as in ``hitch_of``. The load hides what is behind it, so a hidden position there has an h of at least
    ``_AWAY`` while the car drives away from it.

    A car slower than ``IS_STATIONARY`` counts as stationary. So with ``creeps`` > 0 [s], h_i of a hidden disc is at
    least creeps (IS_STATIONARY - |v|): towards a corner, or backwards with a load that hides the area behind it, the
    car may creep on and observe. As soon as someone is seen there, it is no hidden disc any more, and h_i applies in
    full. Under braking neither of the two terms decreases. Source: Macek, Vasquez, Fraichard, Siegwart, Towards safe
    vehicle navigation in dynamic urban scenarios, 2009.

    ``discs`` (m, 4): x, y, R [m], w [m/s]. Raises InputError for a wrong shape, NaN, or a length or speed below 0.
    """

    kind = "mover"
    at_once = True
    reads = ("x", "y", "yaw", "speed")
    numbers = 5

    def __init__(
        self,
        discs: ArrayLike,
        hidden: Sequence[bool],
        body: Footprint,
        braking: Braking,
        counter: ReversalBraking,
        clearance: float = 0.0,
        period: float = 0.0,
        names: Sequence[str] | None = None,
        towed: TrailerEnvelope | None = None,
        creeps: float = 0.0,
        own_radius: float = 0.0,
    ) -> None:
        table = np.asarray(discs, dtype=np.float64).reshape(-1, 4)
        if not np.isfinite(table).all() or (table[:, 2:] < 0.0).any():
            raise InputError("discs: got NaN, infinity, or a radius or speed below 0, wanted finite ones of 0 or more")
        self.names = tuple(names) if names is not None else tuple(f"disc {index}" for index in range(len(table)))
        if not len(self.names) == len(hidden) == len(table):
            raise InputError(f"discs: got {len(table)}, and {len(self.names)} names; wanted one for each")
        rear, front, radius = body
        fastest = float(table[:, 3].max()) if len(table) else 0.0
        thick = radius if towed is None else min(own_radius or radius, radius)
        beyond = 0.0 if towed is None else radius + towed.most - thick
        brakes = (braking.deceleration, braking.gain, *counter.numbers[1:], counter.deceleration)
        own = (rear, front, *brakes, fastest, creeps, thick, beyond)
        self.shared = own if towed is None else (*own, *towed.numbers)
        kept = thick + clearance
        self.each = tuple(
            (x, y, size + kept + speed * period, speed, 0.0 if unseen else speed)
            for (x, y, size, speed), unseen in zip(table.tolist(), hidden, strict=True)
        )

    @property
    def thick(self) -> float:
        """Radius around the car itself [m]."""
        return self.shared[_THICK]

    @property
    def tows(self) -> bool:
        """Whether the car has a load."""
        return len(self.shared) > _OWN

    def seconds(self, speed: float) -> float:
        """Returns the stopping time T(speed) [s]."""
        soft, corner, hard = self.shared[_BODY:_FASTEST]
        return float(ReversalBraking.seconds(speed, (hard, soft, corner), FLOATS))

    def with_speed(self, fastest: float, creeps: float | None = None) -> MovingObstacleBarrier:
        """Returns a copy for discs with the largest speed ``fastest`` [m/s], and optionally another ``creeps`` [s]."""
        slow = self.shared[_FASTEST + 1] if creeps is None else creeps
        return self.with_shared((*self.shared[:_FASTEST], fastest, slow, *self.shared[_FASTEST + 2 :]))

    @staticmethod
    def equation(given: Given, operations: Operations) -> Sequence[Scalar]:
        """Returns h of a disc: x, y, required distance [m], its speed, and the one that counts behind the car [m/s]."""
        x, y, reach, fastest, fastest_behind = given.each
        rear, front, _, _, soft, corner, hard, _, creeps, _, _ = given.shared[:_OWN]
        body = body_of(_of_body(given), operations)
        speed, numbers = given.state[3], (hard, soft, corner)
        low, high = _ends(given, operations)
        apart_x, apart_y = x - given.state[0], y - given.state[1]
        along = body.cosine * apart_x + body.sine * apart_y
        across = body.cosine * apart_y - body.sine * apart_x
        room = operations.hypot(along - operations.clip(along, low, high), across) - reach
        behind = operations.where(speed >= 0.0, -rear - along, along - front)
        coming = operations.where(behind > 0.0, fastest_behind, fastest)
        unseen = fastest - fastest_behind
        if len(given.shared) == _OWN:
            kept = room - coming * ReversalBraking.seconds(speed, numbers, operations)
            return (_creeping(kept, unseen, speed, creeps, operations),)
        around = _to_load(given, body, (along, across), (low, high), operations) - reach
        kept = operations.minimum(room, around) - coming * ReversalBraking.seconds(speed, numbers, operations)
        away = operations.where(speed >= -_STILL, (-rear - along) * unseen, 0.0)
        kept = operations.where(away > 0.0, operations.maximum(kept, _AWAY), kept)
        return (_creeping(kept, unseen, speed, creeps, operations),)

    @staticmethod
    def grad_bound(given: Given, operations: Operations) -> Sequence[Scalar]:
        """Returns the bounds of the body, or of the reversal braking if larger, plus the stopping time's change."""
        _, _, _, _, soft, corner, hard, fastest, creeps, thick, beyond = given.shared[:_OWN]
        place, _, arm, change, *rest = steepest_of_body(_of_body(given), operations)
        low, high = _ends(given, operations)
        arm = operations.maximum(arm, operations.maximum(operations.absolute(low), operations.absolute(high)))
        way, time = ReversalBraking.grad_bound(given.state[3], (hard, soft, corner), operations)
        if len(given.shared) > _OWN:
            place = 1.0 + given.shared[_RATE] * (thick + beyond) / given.shared[_MOST]
            arm = operations.maximum(arm, operations.maximum(high, 0.0) + 2.0 * (thick + beyond))
            change = change * place  # which it is by at least as much already
        change = operations.maximum(operations.maximum(change, way) + fastest * time, creeps)
        return [place, place, arm, change, *rest]


def _to_load(
    given: Given, body: SweptBody, place: tuple[Scalar, Scalar], ends: tuple[Scalar, Scalar], operations: Operations
) -> Scalar:
    """Returns the distance [m] from a position (along, across) to where the load may be until the stop, plus the car's
    own radius.

    It is the larger of two lower bounds of the true distance: from the disc of the load's reach around the hitch, and
    from a strip of the same width that ends at the load's foremost point. Behind that point the second is never larger.
    """
    rear, front, *_, thick, beyond = given.shared[:_OWN]
    (along, across), (low, high) = place, ends
    last = high - front - rear  # the hitch moves by the same stopping distance as both ends
    around = operations.hypot(along - operations.clip(along, low, last), across) - beyond
    _, growth = hitch_of(body, _of_body(given), operations) or (0.0, 0.0)
    reach = thick + beyond
    ahead = along - last - _LOAD_AHEAD - growth * reach / given.shared[_MOST]
    aside = operations.absolute(across) - reach
    strip = operations.hypot(operations.maximum(ahead, 0.0), operations.maximum(aside, 0.0)) + thick
    return operations.maximum(around, strip)


def _creeping(kept: Scalar, unseen: Scalar, speed: Scalar, creeps: Scalar, operations: Operations) -> Scalar:
    """Returns ``kept`` [m]; for a hidden disc (``unseen`` > 0) at least the term that permits creeping."""
    slow = creeps * (IS_STATIONARY - operations.absolute(speed))
    return operations.where(creeps * unseen > 0.0, operations.maximum(kept, slow), kept)


def _ends(given: Given, operations: Operations) -> tuple[Scalar, Scalar]:
    """Returns rear and front end along the heading [m] of the segment extended by the stopping distance."""
    rear, front, _, _, soft, corner, hard, *_ = given.shared[:_OWN]
    way = ReversalBraking.distance(given.state[3], (hard, soft, corner), operations)
    return -rear + operations.minimum(way, 0.0), front + operations.maximum(way, 0.0)


def _of_body(given: Given) -> Given:
    """Returns the arguments for ``body_of`` and ``grad_bound`` of the body, without this barrier's own parameters."""
    return Given(given.state, (*given.shared[:_BODY], *given.shared[_OWN:]), given.each, given.form)
