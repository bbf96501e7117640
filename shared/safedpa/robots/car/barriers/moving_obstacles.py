"""Discs around a car that may move by themselves: passive safety, told as one h for each."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

import numpy as np
from numpy.typing import ArrayLike

from safedpa.equations import Given
from safedpa.errors import InputError
from safedpa.operations import FLOATS, Operations, Scalar
from safedpa.robots.car.barriers.body import SweptBody, body_of, hitch_of
from safedpa.robots.car.barriers.body import steepest as steepest_of_body
from safedpa.robots.car.barriers.obstacles import Footprint
from safedpa.robots.car.barriers.trailer import TrailerEnvelope
from safedpa.robots.car.dynamics.limits import IS_STATIONARY, ReversalBraking
from safedpa.safety.barriers.equation import AbstractEquationBarrier
from safedpa.safety.barriers.stopping import Braking

__all__ = ["MovingObstacleBarrier"]

_BODY = 4
"""Shared numbers of the body, as ``body_of`` takes them."""
_OWN = 11
"""Shared numbers without those of what is towed."""
_FASTEST, _THICK = 7, 9
"""Which say how fast the fastest disc is, behind it for how long it creeps, and how thick the car itself is."""
_RATE, _MOST = _OWN + 1, _OWN + 2
"""Which of those of what is towed say how it grows with the way backwards, and by how much at most."""
_LOAD_AHEAD = 0.05
"""m; so far ahead of the hitch no part of a load was that was not pushed back, by 0.05 m: tests/sensing."""
_AWAY = 0.5
"""m; more than a margin of 0.1 m may widen to."""
_STILL = 0.01
"""m/s backwards that a speed may be told of a car that stands."""


@final
class MovingObstacleBarrier(AbstractEquationBarrier):
    """h_i = distance(c_i, S(x)) - (R_i + r + clearance + w_i a) - w_i T(v), for discs (c_i, R_i) with speeds w_i.

    S(x) is the segment of ``ObstacleBarrier``, stretched by the way D(v) in which the car stands that drives against
    its own motion, T(v) the time that it takes (``ReversalBraking``), a one period: so long no one looks again. While
    h_i >= 0 the car can brake and stands before anything that is no faster than w_i can have reached it: passive
    safety. Under that braking S shrinks into itself and T does not grow, so h_i does not fall.

    Of a disc that no one sees (``hidden``) and that lies behind the end that the car drives away from, w_i T counts 0:
    who comes from behind has to see the car.

    With something ``towed`` r is ``own_radius``, that of the car's own body, where it is known: the load has to get
    past what is at rest, and who moves need not have room for it later, but for car and load where they are until they
    stand. So h_i is also no more than the room to where the load may be: all that it reaches to around the hitch, and
    as long as it was not driven backwards only what of that lies behind the hitch,

        { c : |c - hitch| <= reach } and { c : ahead of the hitch by 0.05 m + reach growth / most at most },

    growth as in ``hitch_of``. As the load hides what is behind it, a place behind it that no one sees counts ``_AWAY``
    at least: it is driven away from.

    A car slower than ``IS_STATIONARY`` counts as standing, and who walks into it then has met a standing car. So with
    ``creeps`` > 0 [s] h_i of a disc that no one sees is no less than creeps (STANDS - |v|): towards a corner, or
    backwards with a load that hides what is behind it, the car creeps on, and looks. As soon as someone is seen
    there, he is no hidden disc any more, and the whole of h_i counts. Under braking neither of the two falls.
    Source: Macek, Vasquez, Fraichard, Siegwart, Towards safe vehicle navigation in dynamic urban scenarios, 2009.

    ``discs`` (m, 4): x, y, R [m], w [m/s]. Raises InputError for a wrong shape, NaN, or a length or speed below 0.
    """

    kind = "mover"
    at_once = True
    reads = ("x", "y", "yaw", "speed")
    numbers = 5
    written = "safedpa.robots.car.written_barriers"

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
        """m; the radius that counts around the car itself."""
        return self.shared[_THICK]

    @property
    def tows(self) -> bool:
        """Whether something is towed."""
        return len(self.shared) > _OWN

    def seconds(self, speed: float) -> float:
        """T(speed) [s] until the car stands."""
        soft, corner, hard = self.shared[_BODY:_FASTEST]
        return float(ReversalBraking.seconds(speed, (hard, soft, corner), FLOATS))

    def with_speed(self, fastest: float, creeps: float | None = None) -> MovingObstacleBarrier:
        """The same for discs of which the ``fastest`` [m/s] is given, and with other ``creeps`` [s]."""
        slow = self.shared[_FASTEST + 1] if creeps is None else creeps
        return self.sharing((*self.shared[:_FASTEST], fastest, slow, *self.shared[_FASTEST + 2 :]))

    @staticmethod
    def h(given: Given, operations: Operations) -> Sequence[Scalar]:
        """Of a disc x, y, what its distance has to exceed [m], its speed, and the one that counts behind [m/s]."""
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
    def steepest(given: Given, operations: Operations) -> Sequence[Scalar]:
        """As of the body, or of its own way where that is longer; and what the time until it stands changes."""
        _, _, _, _, soft, corner, hard, fastest, creeps, thick, beyond = given.shared[:_OWN]
        place, _, arm, change, *rest = steepest_of_body(_of_body(given), operations)
        low, high = _ends(given, operations)
        arm = operations.maximum(arm, operations.maximum(operations.absolute(low), operations.absolute(high)))
        way, time = ReversalBraking.steepest(given.state[3], (hard, soft, corner), operations)
        if len(given.shared) > _OWN:
            place = 1.0 + given.shared[_RATE] * (thick + beyond) / given.shared[_MOST]
            arm = operations.maximum(arm, operations.maximum(high, 0.0) + 2.0 * (thick + beyond))
            change = change * place  # which it is by at least as much already
        change = operations.maximum(operations.maximum(change, way) + fastest * time, creeps)
        return [place, place, arm, change, *rest]


def _to_load(
    given: Given, body: SweptBody, place: tuple[Scalar, Scalar], ends: tuple[Scalar, Scalar], operations: Operations
) -> Scalar:
    """m from a place (along, across) the heading to where what is towed may be until it stands, less what it is
    that the body's own radius leaves of that.

    The larger of two distances that neither exceed the true one: from all that it reaches to around the hitch, and from
    the strip as wide as that which ends where it ends ahead. The second is never the larger one behind that end.
    """
    rear, front, *_, thick, beyond = given.shared[:_OWN]
    (along, across), (low, high) = place, ends
    last = high - front - rear  # the hitch goes on as far as both ends do
    around = operations.hypot(along - operations.clip(along, low, last), across) - beyond
    _, growth = hitch_of(body, _of_body(given), operations) or (0.0, 0.0)
    reach = thick + beyond
    ahead = along - last - _LOAD_AHEAD - growth * reach / given.shared[_MOST]
    aside = operations.absolute(across) - reach
    strip = operations.hypot(operations.maximum(ahead, 0.0), operations.maximum(aside, 0.0)) + thick
    return operations.maximum(around, strip)


def _creeping(kept: Scalar, unseen: Scalar, speed: Scalar, creeps: Scalar, operations: Operations) -> Scalar:
    """``retained`` [m], or of what no one sees (``unseen`` > 0) the room that there is to ``IS_STATIONARY``."""
    slow = creeps * (IS_STATIONARY - operations.absolute(speed))
    return operations.where(creeps * unseen > 0.0, operations.maximum(kept, slow), kept)


def _ends(given: Given, operations: Operations) -> tuple[Scalar, Scalar]:
    """Rear and front end along the heading [m] of the segment that the way until the car stands stretches."""
    rear, front, _, _, soft, corner, hard, *_ = given.shared[:_OWN]
    way = ReversalBraking.distance(given.state[3], (hard, soft, corner), operations)
    return -rear + operations.minimum(way, 0.0), front + operations.maximum(way, 0.0)


def _of_body(given: Given) -> Given:
    """What ``body_of`` and ``steepest`` of the body are given: without the numbers of this barrier's own."""
    return Given(given.state, (*given.shared[:_BODY], *given.shared[_OWN:]), given.each, given.form)
