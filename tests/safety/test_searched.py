"""A robot of a short period looks for the least-violation action twenty times a second, and holds it in between."""

from math import inf
from typing import Any

import numpy as np
import pytest
from tests.safety.node_steps import CAR, SETTINGS, latent_at, stamp, state_at

from safedpa.bus import LATENT, NOMINAL, VERDICT, NominalMessage, VerdictMessage
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter, Status, Verdict
from safedpa.safety.solver.candidates import MAX_AGE, HeldSolution
from safedpa.safety.solver.constraints import ActionCandidate

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
        self.held_solution = HeldSolution()

    def _following(self, x: Any, action: Any) -> Any:
        self.asked += 1
        return x + self.step * np.sin(action)

    def at(self, seconds: float | None, h: float = 0.19, nominal: float = -1.0, **known: Any) -> Verdict:
        known = {"held_solution": self.held_solution, **known}
        return self.filter.decide(np.array([h]), np.array([nominal]), time=seconds, **known)


HELD = " Found a moment ago, and no worse now."


def same(one: Verdict, other: Verdict) -> bool:
    reported = (one.status, one.reason.removesuffix(HELD), one.slack, one.h_next, one.action.tolist())
    return reported == (other.status, other.reason, other.slack, other.h_next, other.action.tolist())


def test_within_a_twentieth_of_a_second_the_action_is_held_without_another_search() -> None:
    robot = Robot()
    first = robot.at(1.0)
    whole, robot.asked = robot.asked, 0
    held = robot.at(1.005)
    assert first.status is held.status is Status.relaxed
    assert same(held, first), "nothing has changed in between"
    assert held.reason.endswith(HELD)
    assert not first.reason.endswith(HELD)
    assert robot.asked < whole / 2


@pytest.mark.parametrize("later", [0.0, MAX_AGE, 2.0 * MAX_AGE, -0.005, float("nan")])
def test_a_robot_of_twenty_hertz_looks_in_every_tick(later: float) -> None:
    """So does one whose clock was set back, and whose tick is decided again."""
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
def test_an_action_that_is_worse_by_a_hundredth_is_searched_for_again(h: float, held: bool) -> None:
    """Nearer to the boundary another action may be the least-violation one; a rise is welcome."""
    robot, other = Robot(step=-SLOW), Robot(step=-SLOW)
    robot.at(0.0)
    robot.asked = 0
    found, again = robot.at(0.005, h=h), other.at(0.005, h=h)
    assert (robot.asked < other.asked) is held
    assert found.status is again.status is Status.relaxed
    assert found.h_next == pytest.approx(again.h_next, abs=1e-5)


def test_an_action_that_misses_more_is_searched_for_again() -> None:
    """h leads as high as before, and another margin asks for more."""
    robot, other = Robot(), Robot()
    robot.at(0.0)
    robot.asked = 0
    found = robot.at(0.005, epsilon={"function": 0.101})
    assert same(found, other.at(0.005, epsilon={"function": 0.101}))
    assert robot.asked >= other.asked


def test_a_nominal_action_that_keeps_all_passes_and_an_action_that_does_by_now_is_not_called_relaxed() -> None:
    robot = Robot(step=0.1)
    assert robot.at(0.0, h=0.01).status is Status.relaxed
    assert robot.at(0.005, h=0.19, nominal=0.5).status is Status.passed
    assert robot.at(0.010, h=0.19, nominal=-1.0).status is Status.corrected
    # The way from the nominal action leads nowhere there, and what was held keeps everything: it is looked for wholly.
    robot = Robot()
    assert robot.at(0.0).status is Status.relaxed
    found = robot.at(0.005, epsilon={"function": 0.0966})
    assert found.status is Status.corrected
    assert same(found, Robot().at(0.005, epsilon={"function": 0.0966}))


def test_without_a_time_or_a_memory_every_tick_is_searched_wholly() -> None:
    robot = Robot()
    robot.at(0.0, held_solution=None)
    whole = robot.asked
    for seconds, known in ((0.005, {"held_solution": None}), (None, {}), (None, {})):
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
        inputs = {
            LATENT: latent_at(state),
            NOMINAL: NominalMessage(**stamp(state), values=(1.0, 0.0), controller="test"),
        }
        for robot in ("r", "s")[: 1 if tick < 4 else 2]:
            node.step(robot, state, inputs)
            verdict = node.afterwards(robot)[VERDICT]
            assert isinstance(verdict, VerdictMessage)
            assert verdict.status == "relaxed"
            if HELD not in verdict.sentence:
                searches.append((robot, round(0.005 * tick, 3)))
    assert searches == [("r", 0.0), ("s", 0.02), ("r", 0.05), ("s", 0.07)]


class Posed:
    """Conditions under which every action leads to one outcome, given by hand."""

    def __init__(self, h: list[float], residual: list[float]) -> None:
        broken = [row for row, rest in enumerate(residual) if rest < 0.0]
        self.found = ActionCandidate((0.5,), (0.0,), h, residual, broken)

    def evaluate(self, action: Any) -> ActionCandidate:
        del action
        return self.found


SIDES = ((-1.0, 1.0, 2.0),)


def held_then(then: Posed, now: Posed, later: float = 0.005, sides: Any = SIDES, asked: float | None = None):
    """What is held ``later`` of what was found ``then``."""
    searched = HeldSolution()
    searched.store(then.found, 0.0, "")
    if asked is not None:
        searched.reuse_if_no_worse(then, sides, asked)
    return searched.reuse_if_no_worse(now, sides, later)


@pytest.mark.parametrize(
    ("h", "residual", "held"),
    [
        ([1.0, 2.0], [-1.0, 0.5], True),
        ([0.99, 2.0], [-1.0, 0.5], True),
        ([1.0, 2.0], [-1.01, 0.5], True),
        ([0.9899, 2.0], [-1.0, 0.5], False),
        ([1.0, 2.0], [-1.0101, 0.5], False),
        ([1.0, 1.0], [-1.0, 0.0], True),  # h of a condition that is kept may fall as far as the condition lets it
        ([1.0, 2.0], [-1.0, -0.001], False),  # the other was kept, and what the first one lacks hid it
        ([1.0, -0.001], [-1.0, 0.0], False),
        ([2.0, 2.0], [0.1, 0.5], True),
        ([1.0, 2.0, 3.0], [-1.0, 0.5, 0.5], False),
        ([-inf, -inf], [-inf, -inf], False),
    ],
)
def test_each_condition_is_compared_with_itself(h: list[float], residual: list[float], held: bool) -> None:
    then = Posed([1.0, 2.0], [-1.0, 0.5])
    assert (held_then(then, Posed(h, residual)) is not None) is held


def test_an_h_of_zero_is_held_and_none_below_it() -> None:
    assert held_then(Posed([0.0], [-1.0]), Posed([0.0], [-1.0])) is not None
    assert held_then(Posed([-0.5], [-1.0]), Posed([-0.5], [-1.0])) is None


@pytest.mark.parametrize(
    ("period", "searches"), [(0.005, 20), (0.01, 20), (0.02, 25), (0.025, 20), (0.03, 33), (0.04, 25), (0.045, 22)]
)
def test_no_period_searches_less_often_than_twenty_times_a_second(period: float, searches: int) -> None:
    """An action that would be in force for longer is not held: at 25 Hz one was for 80 ms."""
    searched, then, counted = HeldSolution(), Posed([1.0], [-1.0]), 0
    for tick in range(round(10.0 / period)):
        if searched.reuse_if_no_worse(then, SIDES, tick * period) is None:
            searched.store(then.found, tick * period, "")
            counted += 1
    assert counted / 10.0 == pytest.approx(searches, abs=0.5)


def test_after_a_pause_another_search_is_due() -> None:
    then = Posed([1.0], [-1.0])
    assert held_then(then, then, 0.04, asked=0.035) is not None
    assert held_then(then, then, 0.04) is None, "the next tick may be as far away"


@pytest.mark.parametrize("sides", [((-0.4, 0.4, 0.8),), ((-1.0, 1.0, 2.0), (-1.0, 1.0, 2.0))])
def test_an_action_of_another_filter_is_not_handed_on(sides: Any) -> None:
    then = Posed([1.0], [-1.0])
    assert held_then(then, then, sides=sides) is None


def eroded(hold: bool, ticks: int = 24, error: float = 0.0005) -> tuple[float, int]:
    """Least h of a barrier next to one that hardly any action moves, and how often it was below 0.

    h_A = x is short of its condition whatever is done; h_B is the room beyond the braking way, which the nominal
    action uses up.
    """
    dt, acceleration = 0.005, 3.0
    moved = np.array([[1.0, 0.0, 0.0], [0.0, 1.0, dt], [0.0, 0.0, 1.0]])
    acts = np.array([[1e-6, 0.0], [0.0, 0.5 * dt * dt], [0.0, dt]])

    def room(state: Any) -> float:
        return float(state[1] - min(state[2], 0.0) ** 2 / (2.0 * acceleration))

    settings = FilterSettings(
        action_low=(-1.0, -acceleration), action_high=(1.0, acceleration), eta=0.2, epsilon={"function": 0.002}
    )
    filtering = SafetyFilter(
        lambda s: (moved @ s, acts),
        [FunctionBarrier(lambda s: s[0]), FunctionBarrier(room)],
        settings,
        lambda s, a: moved @ s + acts @ np.asarray(a),
    )
    searched, state, least, violated = HeldSolution(), np.array([0.0005, 0.02 + 0.25 / 6.0, -0.5]), inf, 0
    for tick in range(ticks):
        known = {"held_solution": searched} if hold else {}
        verdict = filtering.decide(state, np.array([1.0, -acceleration]), time=tick * dt, **known)
        least, violated = min(least, room(state)), violated + (verdict.status is Status.violated)
        state = moved @ state + acts @ verdict.action
        state[1] -= error
    return least, violated


def test_what_one_barrier_is_short_of_does_not_hide_another_and_no_memory_is_none() -> None:
    """With the least of all h compared alone, the other one was used up between two searches, and fell below 0."""
    whole, held = eroded(hold=False), eroded(hold=True)
    assert whole[1] == held[1] == 0
    assert held[0] >= whole[0] - 1e-4
    robot = Robot()
    assert same(robot.at(0.0, held_solution=object()), robot.at(0.005, held_solution=object()))


@pytest.mark.parametrize("kind", [float, np.float64, np.float32])
def test_a_time_of_numpys_is_a_time(kind: Any) -> None:
    """Compiled, a comparison of one of numpy's with a number was no truth value, and each decision the fallback."""
    assert Robot().at(kind(0.5)).status is Status.relaxed
