"""Whoever is held back tries another way."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from safedpa.bus import StateMessage
from safedpa.errors import InputError
from safedpa.policy.backing_off import BackingOff, BackingOffSettings


class Stubborn:
    """Asks for the same thing for ever, and counts how often it was asked."""

    asked = 0

    def wish(self, state: StateMessage, latent: np.ndarray | None) -> tuple[tuple[float, ...], str]:
        del state, latent
        self.asked += 1
        return (1.5, 0.1), "stubborn"


def state(tick: int, x: float = 0.0, goal: tuple[float, float] = (3.0, 1.0)) -> StateMessage:
    return StateMessage(
        epoch=1,
        tick=tick,
        robot_time=0.05 * tick,
        publish_time=0.0,
        values=(x, 0.0, 0.0, 0.0),
        applied=(0.0, 0.0),
        applied_by="filter",
        period=0.05,
        lockstep=True,
        goal=goal,
        obstacles=(),
        field=(-4.0, 4.0, -4.0, 4.0),
        footprint=(0.08, 0.4, 0.12),
    )


def wishes(states: list[StateMessage]) -> list[tuple[float, ...]]:
    controller = BackingOff(Stubborn())
    return [controller.wish(item, None)[0] for item in states]


def test_a_car_that_moves_is_left_alone() -> None:
    found = wishes([state(tick, x=0.05 * tick) for tick in range(100)])
    assert set(found) == {(1.5, 0.1)}


def test_a_car_that_is_held_backs_off_to_one_side_and_then_the_other() -> None:
    found = wishes([state(tick) for tick in range(110)])
    reversing = [index for index, wish in enumerate(found) if wish[0] < 0.0]
    assert 17 <= reversing[0] <= 20  # after the patience of one second
    sides = [found[index][1] for index in reversing]
    assert sides[0] < 0.0  # the goal lies to the left: reversing with the wheels to the right turns the nose there
    assert {math.copysign(1.0, side) for side in sides} == {-1.0, 1.0}
    first_stretch = next(k for k in range(reversing[0], 110) if found[k][0] > 0.0) - reversing[0]
    assert abs(first_stretch - 28) <= 1  # 1.4 s


def test_the_controller_is_asked_in_every_tick() -> None:
    inner = Stubborn()
    controller = BackingOff(inner)
    names = {controller.wish(state(tick), None)[1] for tick in range(60)}
    assert inner.asked == 60
    assert names == {"stubborn", "stubborn:back_off"}


def test_a_new_goal_ends_it() -> None:
    held = [state(tick) for tick in range(30)]
    assert wishes([*held, state(30)])[-1][0] < 0.0
    assert wishes([*held, state(30, goal=(-3.0, 0.0))])[-1] == (1.5, 0.1)


def test_settings_that_would_not_back_off_are_refused() -> None:
    with pytest.raises(InputError, match="speed below 0"):
        replace(BackingOffSettings(), reverse_speed=0.3)
