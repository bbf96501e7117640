"""Residuals over ticks with gaps, one time line for many robots, drawing less when behind."""

from __future__ import annotations

from dataclasses import replace

import pytest

from safedpa.bus import STATE, VERDICT, Received
from safedpa.robots.car.system import CAR
from safedpa_services.dashboard.books import ResidualBook
from safedpa_services.dashboard.fleet_view import FleetView, Pace, Thinner, TimeLine
from safedpa_services.dashboard.palette import UNKNOWN_STATUS, VERDICT_COLOURS
from safedpa_services.dashboard.shapes import Note


def _state(tick_of, k, shift=0.25, **changes):
    state = tick_of(k)[0][1]
    return replace(state, values=(state.values[0] + shift, *state.values[1:]), **changes)


def _verdict(tick_of, k):
    return tick_of(k)[2][1]


@pytest.mark.parametrize("late", [False, True])
def test_a_residual_compares_a_prediction_with_the_next_tick_in_either_order(tick_of, late):
    book = ResidualBook(CAR)
    if late:
        assert book.add_state(_state(tick_of, 5)) is None
        tick, residual = book.add_verdict(_verdict(tick_of, 4))
        assert tick == 5
    else:
        assert book.add_verdict(_verdict(tick_of, 4)) is None
        residual = book.add_state(_state(tick_of, 5))
    assert residual == pytest.approx((0.25, 0.0, 0.0, 0.0), abs=1e-12)
    assert book.add_state(_state(tick_of, 5)) is None, "a pair counts once"


def test_after_a_gap_the_next_pair_counts_and_no_false_one(tick_of):
    book = ResidualBook(CAR)
    book.add_verdict(_verdict(tick_of, 4))
    assert book.add_state(_state(tick_of, 6)) is None
    book.add_verdict(_verdict(tick_of, 6))
    assert book.add_state(_state(tick_of, 7)) == pytest.approx((0.25, 0.0, 0.0, 0.0), abs=1e-12)


def test_a_period_in_which_the_watchdog_braked_says_nothing_about_the_model(tick_of):
    book = ResidualBook(CAR)
    book.add_verdict(_verdict(tick_of, 4))
    assert book.add_state(_state(tick_of, 5, applied_by="watchdog")) is None


def test_angles_are_compared_the_short_way_round(tick_of):
    book = ResidualBook(CAR)
    book.add_verdict(replace(_verdict(tick_of, 0), predicted=((0.0, 0.0, 3.1, 0.0),)))
    residual = book.add_state(replace(_state(tick_of, 1), values=(0.0, 0.0, -3.1, 0.0)))
    assert residual == pytest.approx((0.0, 0.0, 2 * 3.14159265 - 6.2, 0.0), abs=1e-6)


def test_what_never_finds_its_pair_is_forgotten(tick_of):
    book = ResidualBook(CAR)
    for k in range(0, 1000, 2):
        book.add_verdict(_verdict(tick_of, k))
    assert len(book._predicted) < 10


def test_the_first_robots_time_is_its_own_and_a_later_one_begins_now():
    line = TimeLine()
    assert line.at("r1", 1, 3.0, clock=100.0) == 3.0
    assert line.at("r1", 1, 8.0, clock=105.0) == 8.0
    assert line.at("r2", 9, 0.0, clock=106.0) == pytest.approx(9.0)
    assert line.at("r2", 9, 2.0, clock=108.0) == pytest.approx(11.0)
    assert line.at("r1", 2, 0.0, clock=120.0) == pytest.approx(23.0), "a second life does not cover the first"
    assert line.offset("r1", 2) == pytest.approx(23.0)


def test_twenty_messages_a_second_are_all_drawn_and_of_a_hundred_a_fifth():
    slow, fast = Thinner(), Thinner()
    assert all(slow.draws("state", 0.05 * k, 1) for k in range(200))
    assert 18 <= sum(fast.draws("state", 0.01 * k, 1) for k in range(100)) <= 20
    assert slow.left_out == fast.left_out == 0


def test_the_pace_slows_while_behind_and_recovers_in_calm():
    pace = Pace()
    assert [pace.observe(1.0, 0.1 * k) for k in range(3)] == [True, True, True]
    assert pace.factor == 8
    for k in range(100):
        pace.observe(0.01, 1.0 + 0.1 * k)
    assert pace.factor == 1


def test_falling_behind_is_visible_and_changes_of_status_are_kept(look, tick_of):
    view = FleetView(look)
    drawn, notes = 0, []
    for k in range(200):
        items = [Received(topic, "r1", message, b"", "key", 0.05 * k) for topic, message in tick_of(k)[:3]]
        for frame in view.take(items, 0.05 * k + 3.0):
            drawn += any(entry.path[-1] == "car" for entry in frame.entries)
            notes += [entry.shape.text for entry in frame.entries if isinstance(entry.shape, Note)]
    assert drawn < 60
    assert view.left_out > 100
    assert any("behind, draws one in" in note for note in notes)
    assert [note.split(":")[0] for note in notes if note.startswith(("passed", "corr"))] == ["passed", "corrected"] * 2


def test_a_repeated_tick_changes_nothing(look, tick_of):
    view = FleetView(look)
    items = [
        Received(topic, "r1", message, b"", "key", 0.0) for topic, message in tick_of(3) if topic in (STATE, VERDICT)
    ]
    assert view.take(items, 0.0)
    assert view.take(items, 0.0) == []


@pytest.mark.parametrize(("silent", "known"), [(0, True), (3, True), (4, True), (5, False), (12, False)])
def test_a_stretch_of_the_trail_has_a_verdicts_colour_for_four_ticks_and_no_longer(look, tick_of, silent, known):
    """0.2 s of the car: who draws an old verdict beside a robot that nobody filters says what is not so."""
    view, colours = FleetView(look), []
    for k in range(10 + silent):
        kinds = (STATE, VERDICT) if k < 10 else (STATE,)
        items = [
            Received(topic, "r1", message, b"", "key", 0.05 * k) for topic, message in tick_of(k) if topic in kinds
        ]
        for frame in view.take(items, 0.05 * k):
            colours += [entry.shape.colours for entry in frame.entries if entry.path[-1] == "trail"]
    newest = VERDICT_COLOURS["passed"] if known else UNKNOWN_STATUS
    assert colours[5] == (VERDICT_COLOURS["passed"],)
    assert colours[-1] == (newest,)
    assert len(colours) == 9 + silent
