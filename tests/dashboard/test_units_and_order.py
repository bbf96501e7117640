"""What the dashboard draws has the unit of its axis, and the time of the newest that it stands for."""

from __future__ import annotations

import dataclasses
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus import HEALTH, STATE, VERDICT, Bus, HealthMessage, MemoryBroker, MemoryTransport, Received, encode
from safedpa.records import McapRecorder
from safedpa_services.dashboard import dashboard
from safedpa_services.dashboard.books import HealthBook
from safedpa_services.dashboard.dashboard import Dashboard
from safedpa_services.dashboard.fleet_view import FleetView
from safedpa_services.dashboard.shapes import Curves, Note, Page


@pytest.mark.parametrize(
    ("microseconds", "shown"), [(0.0, [0.0]), (150.0, [0.15]), (2500.0, [2.5]), (-1.0, []), (1e9, [])]
)
def test_steps_are_drawn_in_milliseconds(microseconds: float, shown: list[float]) -> None:
    message = HealthMessage(
        epoch=1, tick=0, robot_time=0.0, publish_time=0.0, service="policy", pid=7, state="running",
        step_microseconds=microseconds,
    )  # fmt: skip
    curves = [entry.shape for entry in HealthBook().add(message, 100.0) if entry.path[0] == "steps"]
    drawn = [value for shape in curves if isinstance(shape, Curves) for value in shape.values]
    assert drawn == pytest.approx(shown)


def test_what_a_turn_took_is_told_in_microseconds() -> None:
    broker = MemoryBroker()
    heard = Bus(MemoryTransport(broker), "f").inbox((HEALTH,))
    painter: Any = SimpleNamespace(arrange=lambda _fields: None, draw=lambda _frames: None)
    view: Any = SimpleNamespace(fields={}, left_out=3, refused=2)
    Dashboard(Bus(MemoryTransport(broker), "f"), view, painter, "*", "")._tell_health(0.0025)
    (item,) = heard.take(0.0)
    assert isinstance(item, Received)
    assert isinstance(item.message, HealthMessage)
    assert (item.message.step_microseconds, item.message.stale, item.message.refused) == (2500.0, 3, 2)


def test_messages_of_a_recording_come_when_they_were_recorded_in_parts_of_a_quarter_of_a_second(
    tmp_path: Any, tick_of: Any
) -> None:
    path, moments = tmp_path / "a.mcap", [0, 100, 250, 300, 500, 2000]
    with McapRecorder(path) as recorder:
        for number, milliseconds in enumerate(moments):
            state = tick_of(number)[0][1]
            recorder.write("safedpa/f/r1/state", encode(state), milliseconds * 1_000_000, 0)
        recorder.write("safedpa/f/r1/state", b"garbage", 2_100_000_000, 0)
    batches = [[item.at for item in batch] for batch in dashboard._batches([path])]
    assert [[round(at, 6) for at in batch] for batch in batches] == [[0.0, 0.1, 0.25], [0.3, 0.5], [2.0]]


@pytest.fixture
def heard(look: Any, tick_of: Any) -> FleetView:
    """A robot whose state is of 3 s and whose verdict of 2 s."""
    view = FleetView(look)
    for topic, message, at in ((STATE, tick_of(60)[0][1], 3.0), (VERDICT, tick_of(40)[2][1], 3.0)):
        assert message.robot_time in (2.0, 3.0)
        view.take([Received(topic, "r1", message, b"", f"safedpa/fleet/r1/{topic.name}", at)], at)
    return view


def test_the_end_stands_at_the_newest_that_was_heard(heard: FleetView) -> None:
    frames = heard.end("The drive has ended.", 3.5)
    notes = [frame.at for frame in frames for entry in frame.entries if isinstance(entry.shape, Note)]
    pages = [frame.at for frame in frames for entry in frame.entries if isinstance(entry.shape, Page)]
    assert notes == pages == [3.0]


def test_an_older_message_leaves_the_newest_moment_as_it_is(heard: FleetView, tick_of: Any) -> None:
    late = dataclasses.replace(tick_of(30)[0][1])
    heard.take([Received(STATE, "r1", late, b"", "safedpa/fleet/r1/state", 3.1)], 3.1)
    frames = heard.end("The drive has ended.", 3.5)
    assert [frame.at for frame in frames for entry in frame.entries if isinstance(entry.shape, Note)] == [3.0]
