"""An action that keeps all is brought back towards the wish where tangents led it further than it need go."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import pytest
from tests.safety.scripted import outcome

from safedpa.dynamics import load_model
from safedpa.robots.car.barriers import car_barriers
from safedpa.safety import SafetyFilter, Status
from safedpa.safety.conditions import Outcome
from safedpa.safety.retreat import STEP, retreated
from safedpa.safety.shipped import settings_named
from safedpa_lab.experiments.adversary.car_grid import CarGrid, car_question
from safedpa_lab.experiments.adversary.car_judge import FIELD, FOOTPRINT, CarJudge

SIDES = ((0.0, 10.0, 10.0), (-1.0, 1.0, 2.0))


class Plane:
    """Kept where ``room`` of the action is not below 0."""

    def __init__(self, room: Callable[[Any], float]) -> None:
        self.room = room
        self.tried: list[tuple[float, ...]] = []

    def outcome(self, action: Any) -> Outcome:
        self.tried.append(tuple(action))
        found = outcome(action[0], self.room(action))
        found.action = tuple(action)
        return found


def start(plane: Plane, *action: float) -> Outcome:
    found = plane.outcome(action)
    plane.tried.clear()
    return found


def test_an_entry_on_a_plateau_comes_back_to_its_edge() -> None:
    """Kept from 3 on, however far beyond: from 9 back towards 0, to a thirty-second of the way."""
    plane = Plane(lambda a: min(a[0] - 3.0, 1.0))
    found = retreated(plane, SIDES, (0.0, 0.0), start(plane, 9.0, 0.0))
    assert found.kept
    assert 3.0 <= found.action[0] <= 3.0 + 8.0 / 32.0
    assert found.action[1] == 0.0
    assert len(plane.tried) == 6


def test_what_no_step_brings_nearer_costs_one_look_an_entry_and_stays_itself() -> None:
    plane = Plane(lambda a: a[0] + a[1] - 9.0)
    kept = start(plane, 8.5, 0.5)
    assert retreated(plane, SIDES, (0.0, -1.0), kept) is kept
    assert plane.tried == [pytest.approx((7.5, 0.5)), pytest.approx((8.5, 0.3))], "the furthest entry first"


def test_entries_within_a_step_of_the_wish_are_left_alone() -> None:
    plane = Plane(lambda a: 1.0)
    kept = start(plane, 10.0 * STEP, 2.0 * STEP - 1.0)
    assert retreated(plane, SIDES, (0.0, -1.0), kept) is kept
    below = start(plane, 10.0 - 10.0 * STEP, -1.0)
    assert retreated(plane, SIDES, (10.0, -1.0), below) is below
    assert plane.tried == []


def test_a_wish_beyond_the_bounds_is_approached_no_further_than_they_allow() -> None:
    plane = Plane(lambda a: 1.0)
    found = retreated(plane, SIDES, (-50.0, 7.0), start(plane, 9.0, -1.0))
    assert all(low <= value <= high for value, (low, high, _) in zip(found.action, SIDES, strict=True))
    assert found.action == pytest.approx((0.0, 1.0), abs=0.3)
    assert min(action[0] for action in plane.tried) >= 0.0


def test_every_entry_has_its_turn_from_where_the_others_came_to() -> None:
    plane = Plane(lambda a: min(a[0] - 2.0, a[1] + 0.5, 1.0))
    found = retreated(plane, SIDES, (0.0, -1.0), start(plane, 9.0, 1.0))
    assert found.kept
    assert found.action[0] == pytest.approx(2.0, abs=0.3)
    assert found.action[1] == pytest.approx(-0.5, abs=0.08)


@pytest.mark.parametrize("number", [9827, 7743, 5964, 4898, 2205, 4108])
def test_a_car_is_not_sent_along_the_plateau_of_its_drive(number: int) -> None:
    """Found by the grid: the speed asked for lay beyond what the drive can reach in a tick, far past what is needed."""
    model, settings, question = load_model("car"), settings_named("car"), car_question(2010, number)
    verdict = SafetyFilter.for_model(model, settings).decide(
        question.state,
        question.wish,
        model.latent,
        barriers=car_barriers(settings, FOOTPRINT, question.obstacles, FIELD),
    )
    judge = CarJudge(model, settings, question)
    kept = ((judge.h - judge.required) / judge.scale >= 1e-9).all(axis=1)
    assert verdict.status is Status.corrected
    assert judge.distance(verdict.action[None])[0] <= judge.distance(judge.grid[kept]).min() + 0.06


@pytest.mark.parametrize("number", [1424, 3861, 8186, 10808])
def test_the_least_unsafe_action_is_looked_for_across_the_plateau(number: int) -> None:
    """Found by the grid: more than 1 % of a scale below what it reaches."""
    _, (found,) = CarGrid().work(("car", 2010, number, number + 1))
    assert found.status in ("relaxed", "violated")
    assert found.shortfall is not None
    assert found.shortfall < 0.008


def test_a_standing_car_finds_the_action_that_keeps_all_though_h_bends_there() -> None:
    """Found by the grid: eight actions of it keep all, in a narrow strip of reversing with the wheels turned."""
    _, (found,) = CarGrid().work(("odd scenes", 2050, 724, 725))
    assert found.status == "corrected"
    assert not found.missed


@pytest.mark.parametrize("number", [9514])
def test_the_least_unsafe_action_is_looked_for_on_both_sides_of_a_standstill(number: int) -> None:
    _, (found,) = CarGrid().work(("car", 2050, number, number + 1))
    assert found.status == "relaxed"
    assert found.shortfall is not None
    assert found.shortfall < 0.01
