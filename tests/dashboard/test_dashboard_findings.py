"""Findings and changes of the model in the live view: curves, lanes, marks."""

import math

from tests.messages import finding_of, stamp

from safedpa.bus import FINDING, MODEL, ModelMessage, ReceivedMessage
from safedpa_services.dashboard.fleet_view import FleetView
from safedpa_services.dashboard.shapes import Curves, Note, States


def _finding(tick, stage, **fields):
    usual = {"number": 0, "model": "aaa", "error": 0.03, "where": "yaw: 0.1 rad more than predicted"}
    return FINDING, finding_of(stage, **stamp(tick, epoch=7), **{**usual, **fields})


def _entries(view, *items):
    received = [
        ReceivedMessage(topic, "r1", message, b"", f"safedpa/fleet/r1/{topic.name}", 0.0) for topic, message in items
    ]
    return {"/".join(e.path[2:]): e.shape for f in view.take(received, 0.0) for e in f.entries if not e.static}


def test_error_and_band_are_curves_and_the_band_has_a_gap_while_it_is_learned(look, tick_of):
    view = FleetView(look)
    _entries(view, *tick_of(0))
    first = _entries(view, _finding(1, "learning", band=0.0))["diagnosis/error"]
    later = _entries(view, _finding(21, "watching"))["diagnosis/error"]
    assert isinstance(first, Curves)
    assert first.values[0] == 0.03
    assert math.isnan(first.values[1])
    assert later.values == (0.03, 0.06)


def test_a_finding_leaves_one_mark_and_one_line(look, tick_of):
    view = FleetView(look)
    _entries(view, *tick_of(0), _finding(1, "watching"))
    raised = _entries(view, _finding(41, "raised", number=1, error=0.4))
    again = _entries(view, _finding(61, "raised", number=1, error=0.4))
    assert raised["verdict/diagnosis"] == States("raised")
    assert isinstance(raised["log"], Note)
    assert "yaw: 0.1 rad more" in raised["log"].text
    assert "verdict/diagnosis" not in again
    assert "log" not in again


def test_the_lane_of_models_changes_with_the_model_and_goes_back_with_it(look, tick_of):
    view = FleetView(look)
    lanes = [
        _entries(view, *(tick_of(0) if k == 0 else []), _finding(20 * k + 1, "watching", model=model)).get(
            "verdict/model"
        )
        for k, model in enumerate(["aaa", "aaa", "bbb", "aaa"])
    ]
    assert lanes == [States("model 1"), None, States("model 2"), States("model 1")]


def test_every_step_of_a_change_is_logged_with_its_author_and_reason(look, tick_of):
    view = FleetView(look)
    _entries(view, *tick_of(0))
    for step, phrase in (("offer", "offered"), ("take", "from tick 50 on"), ("drop", "dropped")):
        message = ModelMessage(
            **stamp(40, epoch=7), step=step, change=1, fingerprint="bbb", replaces="aaa", from_tick=50, who="Ada",
            why="accept wind",
        )  # fmt: skip
        text = _entries(view, (MODEL, message))["log"].text
        assert phrase in text
        assert "Ada" in text
        assert "accept wind" in text
