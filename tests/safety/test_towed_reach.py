"""What is towed claims more room around the hitch the farther the robot was driven backwards."""

from __future__ import annotations

import math
from typing import Any

import numpy as np
import pytest

from safedpa.bus import StateMessage
from safedpa.equations import Given
from safedpa.errors import InputError
from safedpa.operations import FLOATS
from safedpa.robots.car.barriers import braking_of, car_barriers
from safedpa.robots.car.car_scene import CarScene
from safedpa.robots.car.reversed_way import ReversedWay
from safedpa.robots.car.swept import body_of, hitch_of
from safedpa.robots.car.towed_reach import TowedReach
from safedpa.safety import Barriers, FilterSettings
from safedpa.safety.shipped import settings_named
from safedpa.safety.stacks import EquationStack, stacked

SETTINGS = settings_named("car")
BRAKING = braking_of(SETTINGS)
FOOTPRINT, FIELD = (0.08, 0.40, 0.25), (-4.0, 4.0, -4.0, 4.0)
TOWED = (0.1, 0.5, 0.42)


def towed(way: float, pose: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> TowedReach:
    return TowedReach(TOWED[0], TOWED[1], TOWED[2] - FOOTPRINT[2], way, pose)


def growth(load: TowedReach, x: float, y: float, speed: float) -> float:
    """m by which the radius at the hitch is larger."""
    shared = (*FOOTPRINT[:2], BRAKING.deceleration, BRAKING.gain, *load.numbers)
    given = Given((x, y, 0.0, speed), shared, ())
    hitch = hitch_of(body_of(given, FLOATS), given, FLOATS)
    assert hitch is not None
    return float(hitch[1])


def test_the_growth_follows_the_way_and_the_stop_to_come() -> None:
    most = TOWED[2] - FOOTPRINT[2]
    assert growth(towed(0.05), 0.0, 0.0, 1.0) == 0.0
    assert growth(towed(0.3), 0.0, 0.0, 1.0) == pytest.approx(most / 2)
    assert growth(towed(0.3), -0.1, 0.0, 0.0) == pytest.approx(0.75 * most), "10 cm farther back"
    assert growth(towed(0.3), 0.1, 0.0, 0.0) == pytest.approx(0.25 * most), "10 cm forwards again"
    assert growth(towed(0.2), 0.0, 0.0, -0.32) == pytest.approx(most / 2), "the stop takes 10 cm"
    assert growth(towed(0.9), 0.0, 0.0, -0.6) == most


def test_the_way_is_measured_along_the_heading_of_then_from_where_it_was() -> None:
    most = TOWED[2] - FOOTPRINT[2]
    assert growth(towed(0.3, (1.0, 2.0, math.pi / 2)), 5.0, 2.1, 0.0) == pytest.approx(0.25 * most)
    assert growth(towed(0.3, (1.0, 2.0, 0.0)), 0.9, 5.0, 0.0) == pytest.approx(0.75 * most)


def scene(draw: np.random.Generator) -> tuple[np.ndarray[Any, Any], TowedReach, list[Any]]:
    state = np.array([*draw.uniform(-3, 3, 2), draw.uniform(-4, 4), draw.uniform(-0.6, 2.0)])
    pose = (state[0] + draw.normal(0, 0.02), state[1] + draw.normal(0, 0.02), state[2] + draw.normal(0, 0.05))
    load = towed(draw.uniform(0.0, 0.6), pose)
    obstacles = np.column_stack([draw.uniform(-3.5, 3.5, (5, 2)), draw.uniform(0.2, 0.35, 5)])
    return state, load, car_barriers(SETTINGS, FOOTPRINT, obstacles, FIELD, load)


def test_both_roads_to_h_agree_and_slopes_are_those_of_finite_differences() -> None:
    draw, grown = np.random.default_rng(3), 0
    for _ in range(400):
        state, load, parts = scene(draw)
        quick, reference = stacked(parts), Barriers(parts)
        assert isinstance(quick, EquationStack)
        assert np.array(quick.heights(state.tolist())) == pytest.approx(reference.values(state), abs=1e-12)
        assert np.concatenate([part.evaluate(state)[0] for part in parts]) == pytest.approx(reference.values(state))
        slopes = np.array(quick.slopes(state.tolist(), range(len(quick.names))))
        assert slopes == pytest.approx(reference.gradient(state), abs=1e-12)
        steepest = quick.steepest(state.tolist())
        assert steepest is not None
        assert (np.abs(slopes) <= np.array(steepest) + 1e-12).all()
        nudges = 1e-6 * np.eye(4)
        measured = np.array([(reference.values(state + n) - reference.values(state - n)) / 2e-6 for n in nudges]).T
        kinks = np.abs(measured - slopes).max(1) > 1e-4
        assert kinks.sum() <= 2, "a nudge may cross from one nearest point to another"
        grown += growth(load, state[0], state[1], state[3]) > 0.0
    assert grown > 200


def test_braking_straight_lowers_no_h_of_an_obstacle_while_it_reverses() -> None:
    draw, period = np.random.default_rng(4), 0.05
    for _ in range(100):
        state, _, parts = scene(draw)
        state[3] = -abs(state[3]) / 3.0
        before = Barriers(parts).values(state)[:5]
        for _ in range(20):  # the weakest brake that is promised, in small steps
            for _ in range(50):
                size = abs(state[3])
                state[:2] += state[3] * np.array([math.cos(state[2]), math.sin(state[2])]) * period / 50
                state[3] += min(BRAKING.gain * size, BRAKING.deceleration) * period / 50
            after = Barriers(parts).values(state)[:5]
            assert (before - after).max() < 1e-5, "but for the size of the steps"
            before = after


def message(tick: int, x: float, y: float = 0.0, yaw: float = 0.0, **other: Any) -> StateMessage:
    given: dict[str, Any] = {"obstacles": ((2.0, 0.0, 0.3),), "footprint": FOOTPRINT, "towed": TOWED, **other}
    return StateMessage(
        **{
            "epoch": 1,
            "tick": tick,
            "robot_time": 0.05 * tick,
            "publish_time": 0.0,
            "values": (x, y, yaw, 0.0),
            "applied": (0.0, 0.0),
            "applied_by": "filter",
            "period": 0.05,
            "lockstep": True,
            "goal": (1.0, 0.0),
            "field": FIELD,
            **given,
        }
    )


def test_the_way_is_unknown_first_then_forgotten_forwards_and_counted_backwards() -> None:
    way = ReversedWay()
    way.follow(message(0, 0.0))
    assert way.way >= TOWED[1], "nobody knows how the load hangs"
    way.follow(message(1, 0.2))
    assert way.way == pytest.approx(TOWED[1] - 0.2) or way.way == pytest.approx(TOWED[1])
    for tick, x in ((2, 0.6), (3, 1.0), (4, 1.4)):
        way.follow(message(tick, x))
    assert way.way == 0.0
    way.follow(message(5, 1.3))
    way.follow(message(5, 1.3))
    assert way.way == pytest.approx(0.1), "the same state twice counts once"
    way.follow(message(6, 1.3, 0.3))
    assert way.way == pytest.approx(0.1), "sideways is neither"
    way.follow(message(7, math.nan))
    way.follow(message(8, 0.1, 0.3))
    assert way.way == TOWED[1], "more than this is not remembered"


@pytest.mark.parametrize("later", [message(30, 3.0), message(9, 3.0, epoch=2), message(9, 3.0, towed=(0.1, 0.6, 0.5))])
def test_a_robot_that_was_not_watched_may_have_been_reversed(later: StateMessage) -> None:
    way = ReversedWay()
    for tick in range(9):
        way.follow(message(tick, 0.2 * tick))
    assert way.way == 0.0
    way.follow(later)
    assert way.way >= later.towed[1]


def test_the_barriers_of_a_robot_that_tows_follow_its_way() -> None:
    room = []
    tells = CarScene(SETTINGS)
    places = [*np.arange(0.0, 1.0, 0.1), *np.arange(0.9, 0.2, -0.1)]
    for tick, x in enumerate(places):
        found = tells.of(message(tick, float(x), obstacles=((x - 0.08, 1.0, 0.2),)))
        assert not isinstance(found, str)
        room.append(found.heights((float(x), 0.0, 0.0, 0.0))[0])
    assert room[9] == pytest.approx(1.0 - 0.2 - FOOTPRINT[2] - SETTINGS.barrier("clearance"))
    assert room[-1] == pytest.approx(1.0 - 0.2 - TOWED[2] - SETTINGS.barrier("clearance")), (
        "0.7 m back: its whole reach"
    )


def test_a_way_counts_from_the_first_state_on_and_over_half_a_second_without_one() -> None:
    way = ReversedWay()
    way.follow(message(0, 0.2, towed=()))
    assert way.way == 1.0, "before it nothing was seen"
    way.follow(message(10, 0.5, towed=()))
    assert way.way == pytest.approx(0.7), "half a second later"
    way.follow(message(21, 0.9, towed=()))
    assert way.way == 1.0
    way.follow(message(22, 0.0, values=(1.1, 0.0, 0.0), towed=()))
    assert way.way == pytest.approx(0.8), "place and heading are enough"
    way.follow(message(23, 1.1, towed=(), reversed_way=0.0))
    assert way.way == 0.0, "told by the robot"


def test_lengths_at_their_limits() -> None:
    for lengths in ((0.0, 0.5, 0.42), (0.1, 1.0, 0.42)):
        assert ReversedWay().reach(message(0, 0.0, towed=lengths)) is not None
    assert ReversedWay().reach(message(0, 0.0, towed=(0.1, 0.5, FOOTPRINT[2]))) is None, "no more than the footprint"


@pytest.mark.parametrize("wrong", [(0.1, 0.5), (0.5, 0.5, 0.4), (0.5, 0.1, 0.4), (-0.1, 0.5, 0.4), (0.1, 1.5, 0.4)])
def test_lengths_that_are_none_are_no_scene(wrong: tuple[float, ...]) -> None:
    found = CarScene(FilterSettings()).of(message(0, 0.0, towed=wrong))
    assert isinstance(found, str)
    assert "towed" in found
    with pytest.raises(InputError, match="towed"):
        ReversedWay().reach(message(0, 0.0, towed=wrong))


def test_a_filter_that_is_started_again_believes_the_robot_that_counts_itself() -> None:
    old, new, unknowing = ReversedWay(), ReversedWay(), ReversedWay()
    for tick in range(9):
        old.follow(message(tick, 0.2 * tick))
    old.follow(message(9, 1.5))
    assert old.way == pytest.approx(0.1)
    new.follow(message(60, 1.5, reversed_way=old.way))
    unknowing.follow(message(60, 1.5))
    assert new.way == old.way
    assert unknowing.way == TOWED[1], "who is told nothing has to take it for folded up"
    new.follow(message(61, 1.5, reversed_way=7.0))
    assert new.way == TOWED[1], "more than this is not remembered"
    new.follow(message(62, 1.6, reversed_way=math.nan))
    assert new.way == pytest.approx(TOWED[1] - 0.1), "no number: it counts itself"
