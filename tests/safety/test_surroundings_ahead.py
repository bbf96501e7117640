"""What may move is wherever it can have gone by the time an action acts: every way it can go ends within its disc."""

from __future__ import annotations

from math import cos, hypot, sin, tau

import numpy as np
import pytest

from safedpa.bus import SurroundingsMessage
from safedpa.safety.surroundings_ahead import moved_on

STAMP = {"epoch": 1, "tick": 3, "robot_time": 0.15, "publish_time": 0.2}
POINTS = ((1.0, 2.0, 0.05), (3.0, -1.0, 0.4))


def seen(movers: tuple[tuple[float, ...], ...], hidden: tuple[tuple[float, ...], ...]) -> SurroundingsMessage:
    return SurroundingsMessage(
        **STAMP,  # type: ignore[arg-type]
        points=POINTS,
        movers=movers,
        hidden=hidden,
        ages=(0.05, 0.1),
        amiss=("one source is late",),
    )


@pytest.mark.parametrize("seed", range(5))
def test_every_way_a_mover_can_go_ends_within_its_disc_and_the_fastest_at_its_edge(seed: int) -> None:
    """Ways of ten legs in any directions at any speeds allowed; the straight one at full speed leads to the edge."""
    random = np.random.default_rng(seed)
    x, y, radius, speed = random.uniform((-5.0, -5.0, 0.0, 0.1), (5.0, 5.0, 1.0, 3.0)).tolist()
    seconds = float(random.uniform(0.02, 1.4))
    found = moved_on(seen(((x, y, radius, 0.3, -0.2, speed),), ((x, y, radius, speed),)), seconds)
    for row in (*found.movers, *found.hidden):
        middle_x, middle_y, wide = row[:3]
        for _ in range(50):
            legs, at_x, at_y = random.dirichlet(np.ones(10)) * seconds, x, y
            for leg, angle, pace in zip(
                legs, random.uniform(0.0, tau, 10), random.uniform(0.0, speed, 10), strict=True
            ):
                at_x, at_y = at_x + leg * pace * cos(angle), at_y + leg * pace * sin(angle)
            assert hypot(at_x - middle_x, at_y - middle_y) + radius <= wide + 1e-12
        angle = float(random.uniform(0.0, tau))
        far_x, far_y = x + seconds * speed * cos(angle), y + seconds * speed * sin(angle)
        assert hypot(far_x - middle_x, far_y - middle_y) + radius == pytest.approx(wide)


def test_speeds_and_stationary_points_are_passed_on_unchanged() -> None:
    before = seen(((1.0, 2.0, 0.3, 0.4, -0.5, 0.8), (0.0, 1.0, 0.2, 0.0, 0.0, 0.0)), ((4.0, 5.0, 0.6, 1.5),))
    found = moved_on(before, 0.2)
    assert [row[3:] for row in found.movers] == [(0.4, -0.5, 0.8), (0.0, 0.0, 0.0)]
    assert [row[3:] for row in found.hidden] == [(1.5,)]
    assert [len(row) for row in (*found.movers, *found.hidden)] == [6, 6, 4]
    assert found.movers[1] == before.movers[1], "who may not move is where it was"
    assert (found.points, found.ages, found.amiss) == (before.points, before.ages, before.amiss)


@pytest.mark.parametrize("seconds", [0.0, -0.1])
def test_what_acts_at_once_sees_what_is_seen(seconds: float) -> None:
    before = seen(((1.0, 2.0, 0.3, 0.4, -0.5, 0.8),), ((4.0, 5.0, 0.6, 1.5),))
    assert moved_on(before, seconds) is before


@pytest.mark.parametrize("width", [0, 1, 2, 3, 5, 7])
def test_rows_of_another_width_are_left_for_the_scene_to_refuse(width: int) -> None:
    odd = tuple(float(number) for number in range(width))
    found = moved_on(seen((odd, (1.0, 2.0, 0.3, 0.4, -0.5, 0.8)), (odd,)), 0.5)
    assert found.movers[0] == odd
    assert found.movers[1][2] == pytest.approx(0.7)
    assert found.hidden == (odd,)
