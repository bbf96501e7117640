"""A robot of a short period looks for the least unsafe action twenty times a second, and holds it in between."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from tests.safety.node_steps import CAR, SETTINGS, latent_at, stamp, state_at

from safedpa.bus import LATENT, VERDICT, WISH, VerdictMessage, WishMessage
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter, Status, Verdict
from safedpa.safety.conditions import Outcome
from safedpa.safety.node import SafetyFilterNode
from safedpa.safety.searched import _ROUNDING, _WORSE, LASTS, Searched

ONE = FilterSettings(action_low=(-1.0,), action_high=(1.0,), eta=0.5, epsilon={"function": 0.1})
"""From h = 0.19 a next h of 0.195 is asked for."""
SLOW = 0.002
"""What the largest action adds to h in a tick: too little."""


class Robot:
    """One entry x = h; what an action leads to is counted."""

    def __init__(self, step: float = SLOW) -> None:
        self.step, self.asked = step, 0
        self.filter = SafetyFilter(
            lambda x: (x, np.full((1, 1), self.step)), [FunctionBarrier(lambda x: x[0])], ONE, self._following
        )
        self.searched = Searched()

    def _following(self, x: Any, action: Any) -> Any:
        self.asked += 1
        return x + self.step * np.sin(action)

    def at(self, seconds: float | None, h: float = 0.19, wish: float = -1.0, **known: Any) -> Verdict:
        known = {"searched": self.searched, **known}
        return self.filter.decide(np.array([h]), np.array([wish]), time=seconds, **known)


def same(one: Verdict, other: Verdict) -> bool:
    told = (one.status, one.reason, one.slack, one.h_next, one.action.tolist())
    return told == (other.status, other.reason, other.slack, other.h_next, other.action.tolist())


def test_within_a_twentieth_of_a_second_the_action_is_held_without_another_search() -> None:
    robot = Robot()
    first = robot.at(1.0)
    whole, robot.asked = robot.asked, 0
    held = robot.at(1.005)
    assert first.status is held.status is Status.relaxed
    assert same(first, held), "nothing has changed in between"
    assert robot.asked < whole / 2


@pytest.mark.parametrize("later", [0.0, LASTS, 2.0 * LASTS, -0.005, float("nan")])
def test_a_robot_of_twenty_hertz_looks_in_every_tick(later: float) -> None:
    """So does one whose clock was set back, and whose tick is decided once more."""
    robot, other = Robot(), Robot()
    robot.at(1.0)
    robot.asked = 0
    found = robot.at(1.0 + later, h=0.19001)
    assert same(found, other.at(1.0, h=0.19001))
    assert robot.asked >= other.asked


def test_of_what_was_held_the_age_is_counted_from_the_search() -> None:
    robot, spent = Robot(), []
    for tick in range(12):
        robot.asked = 0
        robot.at(0.005 * tick)
        spent.append(robot.asked)
    assert [count == spent[0] for count in spent] == [tick in (0, 10) for tick in range(12)]


@pytest.mark.parametrize(
    ("h", "held"), [(0.19, True), (0.18999, True), (0.1899, False), (0.185, False), (0.1905, True)]
)
def test_what_is_worse_now_by_a_hundredth_is_searched_for_anew(h: float, held: bool) -> None:
    """Nearer to the boundary another action may be the least unsafe one; a rise is welcome."""
    robot, other = Robot(step=-SLOW), Robot(step=-SLOW)
    robot.at(0.0)
    robot.asked = 0
    found, anew = robot.at(0.005, h=h), other.at(0.005, h=h)
    assert (robot.asked < other.asked) is held
    assert found.status is anew.status is Status.relaxed
    assert found.h_next == pytest.approx(anew.h_next, abs=1e-5)


def test_what_misses_more_now_is_searched_for_anew() -> None:
    """h leads as high as before, and another margin asks for more."""
    robot, other = Robot(), Robot()
    robot.at(0.0)
    robot.asked = 0
    found = robot.at(0.005, epsilon={"function": 0.101})
    assert same(found, other.at(0.005, epsilon={"function": 0.101}))
    assert robot.asked >= other.asked


def test_an_action_that_leads_below_zero_is_not_held() -> None:
    """There every tick counts: whether another keeps h above 0 is looked for."""
    robot, other = Robot(step=-0.01), Robot(step=-0.01)
    drift = {"epsilon": {"function": 0.5}}
    assert robot.at(0.0, h=0.0, **drift).status is Status.relaxed
    low = robot.searched
    low._least = -1e-9  # what a search found that could do no better
    robot.asked = 0
    assert same(robot.at(0.005, h=0.0, **drift), other.at(0.005, h=0.0, **drift))
    assert robot.asked >= other.asked


def test_a_wish_that_keeps_all_passes_at_once() -> None:
    robot = Robot(step=0.1)
    assert robot.at(0.0, h=0.01).status is Status.relaxed
    assert robot.at(0.005, h=0.19, wish=0.5).status is Status.passed
    assert robot.at(0.010, h=0.19, wish=-1.0).status is Status.corrected


def test_an_action_that_keeps_all_by_now_is_not_called_relaxed() -> None:
    """The way from the wish leads nowhere there, and what was held keeps everything: it is looked for wholly."""
    robot = Robot()
    assert robot.at(0.0).status is Status.relaxed
    found = robot.at(0.005, epsilon={"function": 0.0966})
    assert found.status is Status.corrected
    assert same(found, Robot().at(0.005, epsilon={"function": 0.0966}))


def test_without_a_time_or_a_memory_every_tick_is_searched_wholly() -> None:
    robot = Robot()
    robot.at(0.0, searched=None)
    whole = robot.asked
    for seconds, known in ((0.005, {"searched": None}), (None, {}), (None, {})):
        robot.asked = 0
        robot.at(seconds, **known)
        assert robot.asked == whole


def test_two_robots_of_one_service_hold_their_own() -> None:
    """At rest between two obstacles, within their margin's layer; the second comes four ticks later."""
    searches: list[tuple[str, float]] = []
    node = SafetyFilterNode(CAR, SETTINGS)
    around: dict[str, Any] = {"values": (0.0,) * 4, "obstacles": ((0.675, 0.0, 0.1), (-0.4, 0.0, 0.1))}
    for tick in range(20):
        state = state_at(tick, period=0.005, robot_time=0.005 * tick, **around)
        inputs = {LATENT: latent_at(state), WISH: WishMessage(**stamp(state), values=(1.0, 0.0), controller="test")}
        for robot in ("r", "s")[: 1 if tick < 4 else 2]:
            node.step(robot, state, inputs)
            verdict = node.afterwards(robot)[VERDICT]
            assert isinstance(verdict, VerdictMessage)
            assert verdict.status == "relaxed"
            searched = (robot, round(node._robots[robot].searched._seconds, 3))
            if searched not in searches:
                searches.append(searched)
    assert searches == [("r", 0.0), ("s", 0.02), ("r", 0.05), ("s", 0.07)]


class Posed:
    """Conditions under which every action leads to one outcome, given by hand."""

    def __init__(self, least: float, tightest: float) -> None:
        self._found, self._tightest = Outcome([0.5], [0.0], [least], [tightest], [0]), tightest

    def outcome(self, action: Any) -> Outcome:
        del action
        return self._found

    def tightest(self, found: Outcome) -> float:
        del found
        return self._tightest


@pytest.mark.parametrize(
    ("later", "least", "tightest", "held"),
    [
        (0.005, 1.0, -1.0, True),
        (0.005, 1.0 - _WORSE, -1.0, True),
        (0.005, 1.0, -(1.0 + _WORSE), True),
        (0.005, 0.9899, -1.0, False),
        (0.005, 1.0, -1.0101, False),
        ((1.0 - _ROUNDING) * LASTS, 1.0, -1.0, False),
    ],
)
def test_the_edges_of_what_is_no_worse(later: float, least: float, tightest: float, held: bool) -> None:
    searched, then = Searched(), Posed(1.0, -1.0)
    searched.note(then, then.outcome(()), 0.0, "")
    assert (searched.still(Posed(least, tightest), later) is not None) is held


def test_an_h_of_zero_is_held() -> None:
    searched, then = Searched(), Posed(0.0, -1.0)
    searched.note(then, then.outcome(()), 0.0, "")
    assert searched.still(then, 0.005) is not None
