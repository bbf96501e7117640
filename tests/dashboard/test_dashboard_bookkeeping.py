"""Residuals over ticks with gaps, the time line of many robots, and the drawing rate."""

import math
from dataclasses import replace

import pytest

from safedpa.bus import LATENT, STATE, VERDICT, ReceivedMessage
from safedpa.robots.car.system import CAR
from safedpa_services.dashboard.fleet_view import DrawingRate, DrawingThrottle, FleetView, TimeLine
from safedpa_services.dashboard.histories import FindingHistory, ResidualHistory
from safedpa_services.dashboard.palette import UNKNOWN_STATUS, VERDICT_COLOURS
from safedpa_services.dashboard.robot_view import RobotView
from safedpa_services.dashboard.shapes import Curves, MarkdownPage, Note, States, StateSet


@pytest.fixture
def state_of(tick_of):
    """state_of(tick, **changes)"""
    return lambda k, **changes: replace(tick_of(k)[0][1], **changes)


@pytest.fixture
def verdict_of(tick_of):
    """verdict_of(tick, **changes)"""
    return lambda k, **changes: replace(tick_of(k)[2][1], **changes)


FOUR = (1.0, 2.0, 0.1, 1.5)


@pytest.mark.parametrize(
    ("measured", "applied_by", "predicted", "residual"),
    [
        (FOUR, "filter", (0.9, 2.0, 0.0, 1.5), (0.1, 0.0, 0.1, 0.0)),
        ((1.0, 2.0, 3.1, 1.5), "filter", (1.0, 2.0, -3.1, 1.5), (0.0, 0.0, 6.2 - 2.0 * math.pi, 0.0)),
        ((1.0, 2.0, -3.1, 1.5), "filter", (1.0, 2.0, 3.1, 1.5), (0.0, 0.0, 2.0 * math.pi - 6.2, 0.0)),
        (FOUR, "watchdog", (0.9, 2.0, 0.0, 1.5), None),  # the prediction is about another action
        (FOUR[:3], "filter", (0.9, 2.0, 0.0, 1.5), None),  # of another robot's model
        ((*FOUR, 0.0), "filter", (0.9, 2.0, 0.0, 1.5), None),
        (FOUR, "filter", (0.9, 2.0), None),
    ],
)
@pytest.mark.parametrize("late", [False, True])
def test_a_residual_is_measured_minus_predicted_under_the_filters_own_action(
    state_of, verdict_of, measured, applied_by, predicted, residual, late
):
    """In either order of arrival; angle differences are wrapped; a pair counts once."""
    book = ResidualHistory(CAR)
    state, verdict = state_of(7, values=measured, applied_by=applied_by), verdict_of(6, predicted=(predicted,))
    if late:
        first, found = book.add_state(state), book.add_verdict(verdict)
        assert found is None or found[0] == 7
        second = None if found is None else found[1]
    else:
        first, second = book.add_verdict(verdict), book.add_state(state)
    assert first is None
    assert second == (None if residual is None else pytest.approx(residual))
    assert book.add_state(state) is None


@pytest.mark.parametrize(
    ("verdicts", "tick", "paired"),
    [((4,), 6, False), ((4, 6), 7, True), ((4, 6, 8), 5, True), ((4, 30), 5, False), ((), 5, False)],
)
def test_a_prediction_waits_a_few_ticks_for_its_state_and_no_longer(state_of, verdict_of, verdicts, tick, paired):
    book = ResidualHistory(CAR)
    for k in verdicts:
        book.add_verdict(verdict_of(k))
    assert (book.add_state(state_of(tick)) is not None) is paired


def test_the_first_robots_time_is_its_own_and_a_later_one_begins_now():
    line = TimeLine()
    assert line.at("r1", 1, 3.0, clock=100.0) == 3.0
    assert line.at("r1", 1, 8.0, clock=105.0) == 8.0
    assert line.at("r2", 9, 0.0, clock=106.0) == pytest.approx(9.0)
    assert line.at("r2", 9, 2.0, clock=108.0) == pytest.approx(11.0)
    assert line.at("r1", 2, 0.0, clock=120.0) == pytest.approx(23.0), "a second life does not cover the first"
    assert (line.offset("r1", 1), line.offset("r1", 2)) == (0.0, pytest.approx(23.0))


def test_the_time_line_goes_on_from_the_newest_moment_of_any_robot():
    line = TimeLine()
    assert line.now(50.0) == 0.0
    assert line.at("r1", 1, 10.0, 100.0) == 10.0
    assert line.now(101.0) == 11.0
    assert line.at("r1", 1, 9.0, 101.0) == 9.0
    assert line.now(101.0) == 11.0, "an older message does not turn it back"
    assert line.at("r1", 1, 12.0, 102.5) == 12.0
    assert line.now(103.0) == 12.5


@pytest.mark.parametrize("absurd", [1e30, -1e30])
def test_an_absurd_robot_time_keeps_the_line_finite(absurd):
    assert abs(TimeLine().at("r1", 1, absurd, 0.0)) == 1e9


@pytest.mark.parametrize(
    ("rate", "factor", "drawn", "left_out"),
    [(20, 1, 20, 0), (20, 2, 10, 10), (20, 4, 5, 15), (100, 1, 19, 0), (10, 1, 10, 0)],
)
def test_at_most_twenty_messages_a_second_are_drawn_and_one_in_factor_of_them(rate, factor, drawn, left_out):
    """Messages above the drawing rate do not count as left out."""
    thinner = DrawingThrottle()
    assert sum(thinner.draws("state", k / rate, factor) for k in range(rate)) == pytest.approx(drawn, abs=rate == 100)
    assert thinner.left_out == left_out
    assert thinner.draws("verdict", 0.0, factor), "each kind is counted on its own"
    assert thinner.draws("state", 0.0, factor), "a restarted robot is drawn at once"


@pytest.mark.parametrize(("lag", "after"), [(0.0, 1), (0.1, 1), (0.11, 2), (0.5, 2), (0.51, 64)])
def test_the_drawing_rate_halves_half_a_second_behind_and_recovers_after_two_calm_seconds(lag, after):
    """Calm means a lag below 0.1 s; between 0.1 s and 0.5 s nothing changes."""
    pace = DrawingRate()
    assert pace.observe(0.6, 0.0)
    for tenth in range(1, 25):
        pace.observe(lag, 0.1 * tenth)
    assert pace.factor == after


def test_each_step_of_the_recovery_takes_two_calm_seconds():
    pace = DrawingRate()
    for _ in range(9):
        pace.observe(9.0, 0.0)
    assert pace.factor == 64
    changed = [tenth / 10 for tenth in range(140) if pace.observe(0.0, tenth / 10)]
    assert changed == pytest.approx([2.0, 4.0, 6.0, 8.0, 10.0, 12.0], abs=0.11)
    assert pace.factor == 1


def received(topic, message, at=0.0):
    return ReceivedMessage(topic, "r1", message, b"", f"safedpa/fleet/r1/{topic.name}", at)


def test_falling_behind_is_visible_and_changes_of_status_are_kept(look, tick_of):
    view = FleetView(look)
    drawn, notes = 0, []
    for k in range(200):
        items = [received(topic, message, 0.05 * k) for topic, message in tick_of(k)[:3]]
        for frame in view.take(items, 0.05 * k + 0.6):
            drawn += any(entry.path[-1] == "car" for entry in frame.entries)
            notes += [entry.shape.text for entry in frame.entries if isinstance(entry.shape, Note)]
    assert drawn < 60
    assert view.left_out > 100
    assert any("behind, draws one frame in" in note for note in notes)
    assert [note.split(":")[0] for note in notes if note.startswith(("passed", "corr"))] == ["passed", "corrected"] * 2


def test_a_repeated_tick_changes_nothing(look, tick_of):
    view = FleetView(look)
    items = [received(topic, message) for topic, message in tick_of(3) if topic in (STATE, VERDICT)]
    assert view.take(items, 0.0)
    assert view.take(items, 0.0) == []


@pytest.mark.parametrize(("silent", "known"), [(0, True), (3, True), (4, True), (5, False), (12, False)])
def test_the_path_has_the_colour_of_a_verdict_for_four_ticks_after_it(look, tick_of, silent, known):
    """0.2 s of the car: an old verdict's colour would be wrong for a robot that is no longer filtered."""
    view, colours = FleetView(look), []
    for k in range(10 + silent):
        kinds = (STATE, VERDICT) if k < 10 else (STATE,)
        items = [received(topic, message, 0.05 * k) for topic, message in tick_of(k) if topic in kinds]
        for frame in view.take(items, 0.05 * k):
            colours += [entry.shape.colours for entry in frame.entries if entry.path[-1] == "trail"]
    newest = VERDICT_COLOURS["passed"] if known else UNKNOWN_STATUS
    assert colours[5] == (VERDICT_COLOURS["passed"],)
    assert colours[-1] == (newest,)
    assert len(colours) == 9 + silent


def test_the_end_is_drawn_at_the_newest_moment_that_was_heard(look, tick_of):
    """A state of 3 s, and after it a verdict of 2 s and a state of 1.5 s."""
    view = FleetView(look)
    for topic, message in (tick_of(60)[0], tick_of(40)[2], tick_of(30)[0]):
        view.take([received(topic, message, 3.0)], 3.0)
    frames = view.end("The drive has ended.", 3.5)
    notes = [frame.at for frame in frames for entry in frame.entries if isinstance(entry.shape, Note)]
    pages = [frame.at for frame in frames for entry in frame.entries if isinstance(entry.shape, MarkdownPage)]
    assert notes == pages == [3.0]


def test_a_late_message_does_not_move_the_keyframes_back(look, tick_of):
    view = FleetView(look)
    for tick in (8, 4):
        view.take([received(*item, 0.5) for item in tick_of(tick) if item[0] in (STATE, LATENT, VERDICT)], 0.5)
    frames = view.take([], 2.0)
    assert frames
    of_now = {"filter", "log", "now"}
    kept = [frame.at for frame in frames if of_now.isdisjoint(entry.path[-1] for entry in frame.entries)]
    assert kept == pytest.approx([0.05 * 8] * len(kept))


def test_the_action_in_force_is_drawn_when_it_changes_and_a_braking_watchdog_is_logged(look, tick_of):
    view, lanes, notes = RobotView(look), [], []
    for k, name in enumerate(["filter", "filter", "watchdog", "watchdog", "filter"]):
        entries = view.take(replace(tick_of(k)[0][1], applied_by=name), 0.05 * k)
        lanes += [entry.shape for entry in entries if entry.path == ("verdict", "in_force")]
        notes += [entry.shape.level for entry in entries if isinstance(entry.shape, Note)]
    assert lanes == [States("filter"), States("watchdog"), States("filter")]
    assert notes == ["WARN"]


def test_names_and_colours_are_logged_without_a_time(look) -> None:
    """A viewer that joins late, or looks at another time, has them too."""
    entries = [*FindingHistory.start(), *RobotView(look).start()]
    kinds = Curves | StateSet
    assert [entry.path for entry in entries if isinstance(entry.shape, kinds) and not entry.static] == []
