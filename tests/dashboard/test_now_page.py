"""The page of words: what is awaited and from whom, a stand with its reason, the keyframes that repeat the present."""

from __future__ import annotations

from dataclasses import replace

import pytest

from safedpa.bus import HEALTH, NO_ROBOT, STATE, VERDICT, Received, Refused
from safedpa_services.dashboard.fleet_view import KEYFRAME_SECONDS, FleetView
from safedpa_services.dashboard.shapes import Page, States


def _received(topic, message, robot="r1", at=0.0):
    return Received(topic, robot, message, b"", f"safedpa/fleet/{robot}/{topic.name}", at)


def _pages(frames, name="now"):
    return [e.shape.text for f in frames for e in f.entries if isinstance(e.shape, Page) and e.path[-1] == name]


def _drive(view, tick_of, ticks, **changes):
    frames = []
    for k in ticks:
        items = [_received(topic, replace(message, **changes.get(topic.name, {})), at=0.05 * k)
                 for topic, message in tick_of(k) if topic.name in changes]  # fmt: skip
        frames += view.take(items, 0.05 * k)
    return frames


def test_while_there_is_no_robot_the_page_says_who_is_there_and_what_was_refused(look, tick_of):
    view = FleetView(look, "depot")
    heartbeat = replace(tick_of(0)[3][1], service="policy")
    view.take([_received(HEALTH, heartbeat, NO_ROBOT), Refused("safedpa/depot/r1/state", "r1", "version 9")], 0.0)
    [told] = _pages(view.take([], 0.1), "waiting")
    assert "fleet **depot**" in told
    assert "policy (running)" in told
    assert "version 9" in told
    assert _pages(view.take([], 0.2), "waiting") == [], "said once, as long as nothing changes"


def test_what_is_missing_is_named_with_what_it_is_for(look, tick_of):
    view = FleetView(look)
    told = _pages(_drive(view, tick_of, range(100), state={}))
    assert "Waiting for" not in told[0]
    assert "a verdict of the safety filter" in told[-1]
    assert "the diagnosis" in told[-1]
    told = _pages(view.take([_received(HEALTH, tick_of(0)[3][1], at=9.0)], 9.0))
    assert "silent for 4 s" in told[-1]


def test_a_robot_that_stands_is_said_to_stand_with_the_reason_and_the_cure(look, tick_of):
    stood = {"stands": 7.0, "standstill": "boxed in: obstacle_0 allow no action that would move it"}
    told = _pages(_drive(FleetView(look), tick_of, range(30), state={}, verdict=stood))[-1]
    assert "**Stands for 7 s**, boxed in: obstacle\\_0" in told
    assert "another goal or more room" in told


def test_the_end_is_said_until_a_robot_speaks_again(look, tick_of):
    view = FleetView(look)
    _drive(view, tick_of, range(30), state={}, verdict={})
    assert "**The drive has ended.**" in _pages(view.end("The drive has ended.", 2.0))[-1]
    assert "The drive has ended.**" not in _pages(_drive(view, tick_of, range(60, 90), state={}, verdict={}))[-1]


def test_a_keyframe_never_stands_later_than_a_change_that_is_still_to_come(look, tick_of):
    view = FleetView(look)
    changed = {"verdict": {}, "state": {}}
    frames = _drive(view, tick_of, range(75), **changed)
    state, verdict = tick_of(82)[0][1], tick_of(80)[2][1]
    frames += view.take([_received(STATE, state, at=4.2), _received(VERDICT, verdict, at=4.2)], 4.2)
    frames += view.take([], 4.2 + KEYFRAME_SECONDS)
    lane = [(f.at, e.shape.state) for f in frames for e in f.entries if e.path[-1] == "filter" and not e.static]
    assert lane[-1] == (pytest.approx(4.0), "corrected")
    assert sorted(lane) == lane


def test_a_quiet_fleet_is_not_drawn_for_ever(look, tick_of):
    view = FleetView(look)
    _drive(view, tick_of, range(10), state={})
    assert any(isinstance(e.shape, Page) for f in view.take([], 5.0) for e in f.entries)
    assert view.take([], 60.0) == []


def test_every_second_all_that_is_drawn_on_change_is_drawn_again(look, tick_of):
    view = FleetView(look)
    everything = {name: {} for name in ("state", "verdict", "latent", "health")}
    _drive(view, tick_of, range(60), **everything)
    entries = [e for f in _drive(view, tick_of, range(60, 60 + 20), **everything) for e in f.entries]
    paths = {"/".join(e.path[2:]) for e in entries}
    assert paths >= {"world/obstacles", "world/goal", "world/field", "world/clearance", "now", "services/robot"}
    assert {e.path[-1]: e.shape for e in entries if isinstance(e.shape, States)}["filter"] == States("passed")
