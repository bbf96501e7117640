"""The text page: missing messages, the reason of a stop, and the keyframes."""

from dataclasses import replace

import pytest
from tests.messages import finding_of, latent_of, stamp, verdict_of

from safedpa.bus import HEALTH, NO_ROBOT, STATE, VERDICT, ReceivedMessage, RejectedMessage, SurroundingsMessage
from safedpa_services.dashboard.fleet_view import FleetView
from safedpa_services.dashboard.now_page import NowPage
from safedpa_services.dashboard.shapes import MarkdownPage, States


def _received(topic, message, robot="r1", at=0.0):
    return ReceivedMessage(topic, robot, message, b"", f"safedpa/fleet/{robot}/{topic.name}", at)


def _pages(frames, name="now"):
    return [e.shape.text for f in frames for e in f.entries if isinstance(e.shape, MarkdownPage) and e.path[-1] == name]


def _drive(view, tick_of, ticks, **changes):
    frames = []
    for k in ticks:
        items = [_received(topic, replace(message, **changes.get(topic.name, {})), at=0.05 * k)
                 for topic, message in tick_of(k) if topic.name in changes]  # fmt: skip
        frames += view.take(items, 0.05 * k)
    return frames


def test_without_a_robot_the_page_lists_services_and_refused_messages(look, tick_of):
    view = FleetView(look, "depot")
    heartbeat = replace(tick_of(0)[3][1], service="policy")
    view.take(
        [_received(HEALTH, heartbeat, NO_ROBOT), RejectedMessage("safedpa/depot/r1/state", "r1", "version 9")], 0.0
    )
    [report] = _pages(view.take([], 0.1), "waiting")
    assert "fleet **depot**" in report
    assert "policy (running)" in report
    assert "version 9" in report
    assert _pages(view.take([], 0.2), "waiting") == [], "published once, as long as nothing changes"


def test_missing_messages_are_named_with_their_consequence(look, tick_of):
    view = FleetView(look)
    report = _pages(_drive(view, tick_of, range(100), state={}))
    assert "Waiting for" not in report[0]
    assert report[-1].startswith("**No verdict yet; the robot brakes.**")
    assert "the diagnosis" in report[-1]
    report = _pages(view.take([_received(HEALTH, tick_of(0)[3][1], at=9.0)], 9.0))
    assert "No state for 4 s" in report[-1]


def test_a_stationary_robot_is_shown_with_the_reason_and_what_to_do(look, tick_of):
    stood = {"stationary_for": 7.0, "stationary_reason": "boxed in: obstacle_0 allow no action that would move it"}
    report = _pages(_drive(FleetView(look), tick_of, range(30), state={}, verdict=stood))[-1]
    assert "**Stationary for 7 s**, boxed in: obstacle\\_0" in report
    assert "another goal or more room" in report


def test_the_end_is_shown_until_a_state_arrives_again(look, tick_of):
    view = FleetView(look)
    _drive(view, tick_of, range(30), state={}, verdict={})
    assert "**The drive has ended.**" in _pages(view.end("The drive has ended.", 2.0))[-1]
    assert "The drive has ended.**" not in _pages(_drive(view, tick_of, range(60, 90), state={}, verdict={}))[-1]


def test_a_keyframe_is_never_later_than_a_change_that_is_still_to_come(look, tick_of):
    view = FleetView(look)
    changed = {"verdict": {}, "state": {}}
    frames = _drive(view, tick_of, range(75), **changed)
    state, verdict = tick_of(82)[0][1], tick_of(80)[2][1]
    frames += view.take([_received(STATE, state, at=4.2), _received(VERDICT, verdict, at=4.2)], 4.2)
    frames += view.take([], 5.2)
    lane = [(f.at, e.shape.state) for f in frames for e in f.entries if e.path[-1] == "filter" and not e.static]
    assert [each for each in lane if each[1] != "none"][-1] == (pytest.approx(4.0), "corrected")
    assert lane[-1] == (pytest.approx(5.1), "none")
    assert [at for at, _ in lane] == sorted(at for at, _ in lane)


def test_a_quiet_fleet_is_not_drawn_for_ever(look, tick_of):
    view = FleetView(look)
    _drive(view, tick_of, range(10), state={})
    assert any(isinstance(e.shape, MarkdownPage) for f in view.take([], 5.0) for e in f.entries)
    entries = [entry for frame in view.take([], 60.0) for entry in frame.entries]
    assert [entry.path[-1] for entry in entries] == ["now"], "the page with its ages alone"
    assert "No state for 60 s" in entries[0].shape.text


def test_every_second_all_that_is_drawn_on_change_is_drawn_again(look, tick_of):
    view = FleetView(look)
    everything = {name: {} for name in ("state", "verdict", "latent", "health")}
    _drive(view, tick_of, range(60), **everything)
    entries = [e for f in _drive(view, tick_of, range(60, 60 + 20), **everything) for e in f.entries]
    paths = {"/".join(e.path[2:]) for e in entries}
    assert paths >= {"world/obstacles", "world/goal", "world/field", "world/clearance", "now", "services/robot"}
    assert {e.path[-1]: e.shape for e in entries if isinstance(e.shape, States)}["filter"] == States("passed")


NOW = stamp(1, epoch=7)
HEARD = {
    "verdict": verdict_of("passed", **NOW),
    "estimate": latent_of(0.1, **NOW),
    "diagnosis": finding_of("learning", **NOW),
    "perception": SurroundingsMessage(**NOW, points=(), movers=(), hidden=(), ages=()),
}


def _awaited(look, state, name="", last=None):
    """Returns what the page waits for at 20 s, if ``name`` arrived at ``last`` and all others 0.5 s ago."""
    page = NowPage(look)
    page.take(state, 10.0)
    for tick, (own, message) in enumerate(HEARD.items(), 2):
        heard = last if own == name else 19.5
        if heard is not None:
            page.take(replace(state, tick=tick), heard)
            page.take(replace(message, tick=tick), heard)
    page.take(replace(state, tick=9), 20.0)
    return [line for line in page.page(20.0).text.splitlines() if line.startswith(("**Waiting for**", "**No "))]


@pytest.mark.parametrize("sees", [True, False])
@pytest.mark.parametrize("name", HEARD)
@pytest.mark.parametrize("last", [None, 18.9, 19.5])
def test_a_service_is_missed_after_a_second_of_silence(look, tick_of, name, last, sees):
    """The diagnosis is missing only until its first message; perception only for robots with sensors."""
    state = replace(tick_of(1)[0][1], sources=("laser",) if sees else ())
    missed = last is None if name == "diagnosis" else last != 19.5 and (sees or name != "perception")
    lines = _awaited(look, state, name, last)
    assert len(lines) == missed
    assert all(name in line for line in lines)


@pytest.mark.parametrize(("age", "silent"), [(0.7, False), (0.8, True), (30.0, True)])
def test_a_robot_is_silent_after_a_second(look, tick_of, age, silent):
    page = NowPage(look)
    page.take(tick_of(1)[0][1], 20.0 - age)
    text = page.page(20.0).text
    assert text.startswith(f"**No state for {age:.0f} s; the robot has ended, hangs or is cut off") is silent


@pytest.mark.parametrize("silent", [0.8, 7.0, 300.0])
def test_the_headline_is_the_present_and_an_old_verdict_comes_after_it_with_its_age(look, tick_of, silent):
    page = NowPage(look)
    for topic, message in tick_of(1)[:3]:
        del topic
        page.take(message, 5.0)
    assert page.page(5.1).text.startswith("**passed**: The nominal action was passed. (0.1 s old)")
    page.take(tick_of(2)[0][1], 5.0 + silent)
    text = page.page(5.0 + silent).text
    age = "0.8" if silent < 1.0 else f"{silent:.1f}" if silent < 10.0 else f"{silent:.0f}"
    assert text.startswith(f"**No verdict for {silent:.0f} s; the robot brakes.**")
    assert f"Last verdict: passed: The nominal action was passed. ({age} s old)" in text
    assert f"margin 0.020 m ({age} s old)" in text


@pytest.mark.parametrize(("since", "reported"), [(1.9, False), (2.1, True)])
def test_nothing_is_missed_in_the_first_two_seconds_of_a_robot_or_of_a_restarted_one(look, tick_of, since, reported):
    page, state = NowPage(look), tick_of(1)[0][1]
    page.take(state, 5.0)
    page.take(replace(state, epoch=8), 20.0 - since)
    page.take(replace(state, epoch=8, tick=2), 19.9)
    assert ("Waiting for" in page.page(20.0).text) is reported


def test_before_the_first_state_the_page_waits_for_it(look):
    assert "the robot's first state" in NowPage(look).page(0.0).text
