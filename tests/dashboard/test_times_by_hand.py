"""When the dashboard draws less, when it says that somebody is silent, and at which time each thing is drawn."""

from __future__ import annotations

from typing import Any

import pytest

from safedpa.bus import (
    FindingMessage,
    LatentMessage,
    Received,
    StateMessage,
    SurroundingsMessage,
    VerdictMessage,
)
from safedpa_services.dashboard.fleet_view import FleetView, Pace, Thinner, TimeLine
from safedpa_services.dashboard.now_page import NowPage
from safedpa_services.dashboard.robot_view import RobotView
from safedpa_services.dashboard.shapes import Note

STAMP = {"epoch": 1, "tick": 1, "robot_time": 0.0, "publish_time": 0.0}


@pytest.mark.parametrize(("lag", "after"), [(0.0, 1), (0.1, 1), (0.11, 2), (0.5, 2), (0.51, 64)])
def test_it_draws_half_as_much_behind_half_a_second_and_more_again_after_two_calm_ones(lag: float, after: int) -> None:
    """Calm is a tenth of a second; between that and half of one nothing changes."""
    pace = Pace()
    assert pace.observe(0.6, 0.0)
    for tenth in range(1, 25):
        pace.observe(lag, 0.1 * tenth)
    assert pace.factor == after


def test_calm_counts_from_its_first_moment_and_anew_after_each_step() -> None:
    pace = Pace()
    for _ in range(9):
        pace.observe(9.0, 0.0)
    assert pace.factor == 64
    changed = [tenth / 10 for tenth in range(0, 140) if pace.observe(0.0, tenth / 10)]
    assert changed == pytest.approx([2.0, 4.0, 6.0, 8.0, 10.0, 12.0], abs=0.11)
    assert pace.factor == 1


@pytest.mark.parametrize(("factor", "drawn"), [(1, 20), (2, 10), (4, 5)])
def test_of_twenty_messages_a_second_every_one_is_drawn_or_every_so_many(factor: int, drawn: int) -> None:
    thinner = Thinner()
    assert sum(thinner.draws("state", 0.05 * tick, factor) for tick in range(20)) == drawn
    assert thinner.left_out == 20 - drawn
    assert thinner.draws("verdict", 0.0, factor), "each kind for itself"
    assert thinner.draws("state", 0.0, factor), "a robot that started anew"


def test_the_time_line_goes_on_with_the_newest_moment_of_any_robot() -> None:
    """An older message neither turns it back nor delays it."""
    line = TimeLine()
    assert line.now(50.0) == 0.0
    assert line.at("r1", 1, 10.0, 100.0) == 10.0
    assert line.now(101.0) == 11.0
    assert line.at("r1", 1, 9.0, 101.0) == 9.0
    assert line.now(101.0) == 11.0
    assert line.at("r1", 1, 12.0, 102.5) == 12.0
    assert line.now(103.0) == 12.5
    assert line.at("r2", 7, 500.0, 103.0) == 12.5
    assert line.at("r2", 7, 501.0, 104.0) == 13.5
    assert line.at("r1", 2, 0.0, 105.0) == pytest.approx(14.5)
    assert (line.offset("r1", 1), line.offset("r1", 2)) == (0.0, pytest.approx(14.5))


@pytest.mark.parametrize("told", [1e30, -1e30])
def test_a_robot_that_tells_an_absurd_time_keeps_the_line_finite(told: float) -> None:
    assert abs(TimeLine().at("r1", 1, told, 0.0)) == 1e9


def received(topic: Any, message: Any, at: float = 0.0) -> Received:
    return Received(topic, "r1", message, b"", "key", at)


def test_at_the_end_each_page_says_why_at_its_robots_newest_moment(look: Any, tick_of: Any) -> None:
    view = FleetView(look)
    for tick in (4, 8):
        known = tick_of(tick)[: 3 if tick == 4 else 1]  # of tick 8 the state alone
        view.take([received(topic, message) for topic, message in known], 0.1 * tick)
    (frame,) = [
        frame
        for frame in view.end("the drive is over", 1.0)
        for entry in frame.entries
        if isinstance(entry.shape, Note) and entry.shape.text == "the drive is over"
    ]
    assert frame.at == pytest.approx(0.05 * 8)


def test_what_comes_late_does_not_take_the_place_of_the_newest_in_the_keyframe(look: Any, tick_of: Any) -> None:
    """A keyframe of a lane belongs at the moment of its newest change, where no other comes behind it."""
    view = FleetView(look)
    for tick in (8, 4):
        view.take([received(topic, message) for topic, message in tick_of(tick)[:3]], 0.5)
    newest = view._robots["r1"].newest
    assert newest == pytest.approx(dict.fromkeys(newest, 0.05 * 8))
    assert newest


def test_who_is_in_force_is_drawn_when_it_changes(look: Any) -> None:
    view = RobotView(look)
    told = [view._in_force_change(who) for who in ("filter", "filter", "watchdog", "watchdog", "filter")]
    assert [len(entries) for entries in told] == [1, 0, 2, 0, 1]


def state_of(**changes: Any) -> StateMessage:
    what = {"values": (0.0, 0.0, 0.0, 1.0), "applied": (1.0, 0.0), "applied_by": "filter", "period": 0.05}
    what |= {"lockstep": True, "goal": (), "obstacles": (), "field": (-4.0, 4.0, -4.0, 4.0), "footprint": ()}
    return StateMessage(**{**STAMP, **what, **changes})


VERDICT = VerdictMessage(
    **STAMP, status="passed", sentence="", action=(), wish=(), slack=0.0, active=(), h_now=0.0, h_next=0.0, margin=0.0,
    solver="", microseconds=0.0,
)  # fmt: skip
FINDING = FindingMessage(
    **STAMP, model="m", stage="learning", sentence="", number=1, error=0.0, band=0.0, evidence=0.0, threshold=0.0,
    coverage=1.0, where="",
)  # fmt: skip
HEARD: dict[str, Any] = {
    "verdict": VERDICT,
    "adaptation": LatentMessage(**STAMP, model="m", values=(0.1,), deviations=(0.1,)),
    "diagnosis": FINDING,
    "perception": SurroundingsMessage(**STAMP, points=(), movers=(), hidden=(), ages=()),
}


@pytest.mark.parametrize(
    ("which", "missed"), [("verdict", "verdict"), ("adaptation", "estimate"), ("perception", "perception")]
)
@pytest.mark.parametrize("how", ["without", "old"])
def test_who_was_not_heard_for_a_second_is_missed(look: Any, which: str, missed: str, how: str) -> None:
    state = state_of(sources=("laser",))
    assert words_of(look, state, "old", "nobody") == []
    (told,) = words_of(look, state, how, which)
    assert missed in told


def words_of(look: Any, state: StateMessage, how: str, which: str) -> list[str]:
    """Who is missed at 20 s, where one was never heard or 1.1 s ago, and all others 0.9 s ago."""
    page = NowPage(look)
    page.take(state, 10.0)
    for name, message in HEARD.items():
        if not (how == "without" and name == which):
            page.take(message, 18.9 if name == which else 19.1)
    page.take(state, 20.0)
    return page._missing(20.0)


def test_of_the_diagnosis_one_word_is_enough_and_perception_is_missed_by_robots_that_see_for_themselves(
    look: Any,
) -> None:
    sees, blind = state_of(sources=("laser",)), state_of()
    assert words_of(look, sees, "old", "diagnosis") == []
    assert "the diagnosis" in words_of(look, sees, "without", "diagnosis")[0]
    assert words_of(look, blind, "without", "perception") == []


@pytest.mark.parametrize(("age", "silent"), [(0.9, False), (1.1, True), (30.0, True)])
def test_a_robot_is_silent_after_a_second(look: Any, age: float, silent: bool) -> None:
    page = NowPage(look)
    page.take(state_of(), 20.0 - age)
    assert any("the robot's states: silent" in line for line in page._missing(20.0)) is silent


@pytest.mark.parametrize(("since", "told"), [(1.9, False), (2.1, True)])
def test_in_its_first_two_seconds_nobody_is_missed_and_a_robot_that_starts_anew_has_them_again(
    look: Any, since: float, told: bool
) -> None:
    page = NowPage(look)
    page.take(state_of(), 5.0)
    page.take(state_of(epoch=2), 20.0 - since)
    page.take(state_of(epoch=2), 19.9)
    assert bool(page._missing(20.0)) is told


def test_before_the_first_state_that_one_is_awaited(look: Any) -> None:
    assert "first state" in NowPage(look)._missing(0.0)[0]
