"""What is drawn where, measured on the picture: wheels, arcs; and which predictions are compared with what came."""

from __future__ import annotations

import dataclasses
import math
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from safedpa.bus import StateMessage, VerdictMessage
from safedpa_services.dashboard.books import ResidualBook
from safedpa_services.dashboard.geometry import Pose
from safedpa_services.dashboard.pendulum import _arc
from safedpa_services.dashboard.world import _car


def directions(strips: Any) -> list[float]:
    """Of the long sides of the four wheels, rad, rear ones first."""
    found = []
    for wheel in strips[2:]:
        sides = [np.subtract(other, one) for one, other in pairwise(wheel)]
        x, y = max(sides, key=lambda side: float(np.hypot(*side)))
        found.append(math.atan2(y, x) % math.pi)
    return found


@pytest.mark.parametrize(
    ("actions", "applied", "front"),
    [
        (("target_speed", "steer"), (1.0, 0.3), 0.3),
        (("throttle", "steer"), (0.2, 0.3), 0.3),
        (("speed", "yaw_rate"), (1.0, 0.3), 0.0),  # a rate is no angle of a wheel
        (("target_speed", "steer"), (), 0.0),  # a robot that does not tell what it does
        (("target_speed", "steer"), (1.0,), 0.0),
        (("target_speed", "steer"), (1.0, 0.3, 0.3), 0.0),
    ],
)
def test_front_wheels_stand_as_the_steering_does_and_rear_ones_straight(
    look: Any, actions: tuple[str, ...], applied: tuple[float, ...], front: float
) -> None:
    own = SimpleNamespace(wheelbase=0.3, system=SimpleNamespace(action_names=actions))
    state: Any = SimpleNamespace(applied=applied)
    drawn = _car(Pose(2.0, 1.0, 0.5), state, own)  # type: ignore[arg-type]
    assert directions(drawn.strips) == pytest.approx([0.5, 0.5, 0.5 + front, 0.5 + front])


@pytest.mark.parametrize(("start", "end"), [(-0.4, 0.9), (0.9, 2.0 * math.pi - 0.4), (0.0, 9.0)])
def test_an_arc_looks_round_and_is_no_more_than_a_turn(start: float, end: float) -> None:
    """Between two points of a chord the circle is r (1 - cos(angle / 2)) away: a thousandth of the radius at 5 degrees,
    which nobody sees."""
    points = _arc(start, end, 1.15)
    assert points[0] == pytest.approx((-1.15 * math.sin(start), 1.15 * math.cos(start)))
    middles = [math.dist((0.0, 0.0), (0.5 * (a[0] + b[0]), 0.5 * (a[1] + b[1]))) for a, b in pairwise(points)]
    assert min(middles) > 1.148
    assert len(points) < 200
    length = sum(math.dist(one, other) for one, other in pairwise(points))
    assert length == pytest.approx(1.15 * min(end - start, 2.0 * math.pi), rel=2e-3)


@pytest.mark.parametrize(
    ("measured", "applied_by", "predicted", "residual"),
    [
        ((1.0, 2.0, 0.1, 1.5), "filter", (0.9, 2.0, 0.0, 1.5), (0.1, 0.0, 0.1, 0.0)),
        ((1.0, 2.0, 3.1, 1.5), "filter", (1.0, 2.0, -3.1, 1.5), (0.0, 0.0, 6.2 - 2.0 * math.pi, 0.0)),
        ((1.0, 2.0, 0.1, 1.5), "watchdog", (0.9, 2.0, 0.0, 1.5), None),  # another action than the one it is about
        ((1.0, 2.0, 0.1), "filter", (0.9, 2.0, 0.0, 1.5), None),  # of another robot's model
        ((1.0, 2.0, 0.1, 1.5, 0.0), "filter", (0.9, 2.0, 0.0, 1.5), None),
        ((1.0, 2.0, 0.1, 1.5), "filter", (0.9, 2.0), None),
    ],
)
@pytest.mark.parametrize("late", [True, False])
def test_a_residual_is_what_came_less_what_was_predicted_of_the_filters_own_action(
    look: Any, tick_of: Any, measured: Any, applied_by: str, predicted: Any, residual: Any, *, late: bool
) -> None:
    """Whichever of the two arrives first. Angles the short way round: from -3.1 to 3.1 are 0.083 rad back."""
    messages = [message for k in (6, 7) for _, message in tick_of(k)]
    states = [one for one in messages if isinstance(one, StateMessage)]
    verdicts = [one for one in messages if isinstance(one, VerdictMessage)]
    state = dataclasses.replace(states[1], values=measured, applied_by=applied_by)
    verdict = dataclasses.replace(verdicts[0], predicted=(predicted,))
    book = ResidualBook(look.system)
    if late:
        first, found = book.add_state(state), book.add_verdict(verdict)
        told = None if found is None else found[1]
        assert found is None or found[0] == 7
    else:
        first, told = book.add_verdict(verdict), book.add_state(state)
    assert first is None
    assert told == (None if residual is None else pytest.approx(residual))
