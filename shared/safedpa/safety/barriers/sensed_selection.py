"""Which sensed discs enter a decision: those that an action of this tick may bring below their limit, by least h."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from math import inf
from typing import NamedTuple, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.equations import Given
from safedpa.operations import NUMPY
from safedpa.safety.barriers.disc_selection import MOST_ROWS, Rows, below, discs_near, moving_near
from safedpa.safety.barriers.equation import AbstractEquationBarrier

__all__ = ["Selected", "Vicinity", "remark_about", "select_movers", "select_points"]


@final
@dataclass(frozen=True)
class Vicinity:
    """Where and up to which h discs matter."""

    x: float = 0.0
    y: float = 0.0
    within: float = inf
    """m; discs farther from (x, y), beyond their own reach, do not matter."""
    limit: float = inf
    """m; discs of a larger h do not matter."""
    values: tuple[float, ...] = ()
    """(states,) at which h is computed; empty if the state is unknown, and every disc matters."""
    compared: tuple[tuple[float, ...], ...] = ()
    """(n, states): states at which the discs of least h are chosen, where too many matter."""
    seconds: float = 0.0
    """s until the robot stands."""


class Selected(NamedTuple):
    """Chosen discs, with their names."""

    discs: list[tuple[float, ...]]
    names: tuple[str, ...]
    left_out: int
    """Number of discs that matter, if some of them were left out; else 0."""
    yields_to: str
    """Who may reach the robot before it stands, as text; empty if none."""


def select_points(still: AbstractEquationBarrier, rows: Rows, room: float, near: Vicinity) -> Selected:
    """Selects discs at rest, ``rows`` (m, 3) x, y, radius, to which the body keeps ``room`` [m].

    ``still`` is a barrier with the shared numbers of the body. Raises InputError for invalid rows.
    """
    found, discs = discs_near(rows, near.x, near.y, near.within, room)
    places = list(range(len(found)))
    if near.values:
        places = below(still.with_items(discs, ()).scalar_rows(len(near.values)).h_floats(near.values), near.limit)
    taken = _of_least_h(still, discs, places, near.compared) if near.values and len(places) > MOST_ROWS else places
    names = tuple([f"point {found[place]}" for place in taken])
    return Selected([discs[place] for place in taken], names, len(places) if len(taken) < len(places) else 0, "")


def select_movers(
    swiftest: AbstractEquationBarrier,
    movers: Rows,
    hidden: Rows,
    room: float,
    period: float,
    near: Vicinity,
    stands: bool,
) -> Selected:
    """Selects movers (m, 6) and hidden places (k, 4), whose rows must have been validated by ``fastest_of``.

    Relevance is decided with the speeds that apply everywhere, not with those behind the robot: after a small turn a
    hidden position may be ahead, and its h drops discontinuously. ``swiftest`` has shared numbers without creeping:
    while a robot creeps, h of near discs is raised, but not any more once it drives.
    """
    rows, discs, everywhere = moving_near(movers, hidden, (near.x, near.y, near.seconds), near.within, room, period)
    taken, left_out, who = list(range(len(discs))), 0, ""

    def named(place: int) -> str:
        row = rows[place]
        return f"mover {row}" if row < len(movers) else f"hidden {row - len(movers)}"

    if near.values and discs:
        h_values = swiftest.with_items([*discs, *everywhere], ()).scalar_rows(len(near.values)).h_floats(near.values)
        count = len(discs) - len(everywhere)
        taken = below([*h_values[:count], *h_values[len(discs) :]], near.limit)
        if len(taken) > MOST_ROWS:
            left_out, taken = len(taken), _of_least_h(swiftest, discs, taken, near.compared)
        who = _who_may_touch(h_values[: count if stands else len(discs)], named)
    return Selected([discs[place] for place in taken], tuple(map(named, taken)), left_out, who)


def remark_about(points: int, movers: int) -> str:
    """Returns the sentence of the verdict about discs that were left out; empty if there are none."""
    left_out = " and ".join(filter(None, (f"{points} points" * bool(points), f"{movers} movers" * bool(movers))))
    return f"Of {left_out} near it, those with the least h were looked at." if left_out else ""


def _of_least_h(
    barrier: AbstractEquationBarrier,
    discs: Sequence[tuple[float, ...]],
    near: Sequence[int],
    compared: Sequence[tuple[float, ...]],
) -> list[int]:
    """Returns the ``MOST_ROWS`` indices among ``near`` with the least h at any of the states: a mover that is
    irrelevant while the robot stands may matter when it drives off."""
    states = tuple(column[:, np.newaxis] for column in np.array(compared).T)
    items = tuple(np.array([discs[place] for place in near]).T)
    least: FloatArray = np.asarray(barrier.equation(Given(states, barrier.shared, items, barrier.form), NUMPY)[0]).min(
        axis=0
    )
    return sorted([near[place] for place in np.argpartition(least, MOST_ROWS)[:MOST_ROWS].tolist()])


def _who_may_touch(h: Sequence[float], named: Callable[[int], str]) -> str:
    """Returns which of the movers and hidden positions may reach the robot before it stops; empty if none."""
    least = min(h, default=0.0)
    if least >= 0.0:
        return ""
    who = named(h.index(least))
    return f"{who if who.startswith('mover') else 'an unseen person'} may reach the robot before it stops"
