"""Health of services: silence after a second, step times in milliseconds, and the dashboard's own heartbeat."""

import threading
import time
from types import SimpleNamespace
from typing import Any

import pytest
from tests.messages import health_of

from safedpa.bus import HEALTH, Bus, Inbox, MemoryBroker, MemoryTransport
from safedpa_services.dashboard.dashboard import Dashboard
from safedpa_services.dashboard.histories import HealthHistory
from safedpa_services.dashboard.shapes import Curves


@pytest.mark.parametrize(("silent_for", "shown"), [(0.25, "running"), (0.99, "running"), (1.01, "silent")])
def test_four_heartbeats_missed_are_silence(silent_for: float, shown: str) -> None:
    book = HealthHistory()
    book.add(health_of("policy"), 100.0)
    reported = book.silences(100.0 + silent_for)
    assert book.states == {"policy": shown}
    assert [entry.path for entry in reported] == ([("services", "policy")] if shown == "silent" else [])
    assert book.silences(100.0 + silent_for) == [], "once each time"


def test_silence_is_per_service_and_ends_with_its_next_heartbeat() -> None:
    book = HealthHistory()
    for service in ("policy", "adaptation"):
        book.add(health_of(service), 100.0)
    book.add(health_of("adaptation"), 101.0)
    book.silences(101.5)
    assert book.states == {"policy": "silent", "adaptation": "running"}
    book.add(health_of("policy"), 101.6)
    assert book.states == {"policy": "running", "adaptation": "running"}


@pytest.mark.parametrize(
    ("microseconds", "shown"), [(0.0, [0.0]), (150.0, [0.15]), (2500.0, [2.5]), (-1.0, []), (1e9, [])]
)
def test_steps_are_drawn_in_milliseconds(microseconds: float, shown: list[float]) -> None:
    message = health_of("policy", step_microseconds=microseconds)
    curves = [entry.shape for entry in HealthHistory().add(message, 100.0) if entry.path[0] == "steps"]
    drawn = [value for shape in curves if isinstance(shape, Curves) for value in shape.values]
    assert drawn == pytest.approx(shown)


def dashboard(seconds_of_a_turn: float = 0.0) -> tuple[Dashboard, Inbox]:
    """A dashboard that draws nothing, and an inbox for its heartbeats."""
    broker = MemoryBroker()
    heard = Bus(MemoryTransport(broker), "f").inbox((HEALTH,), keep_all=True)
    recording: Any = SimpleNamespace(arrange=lambda _fields: None, draw=lambda _frames: time.sleep(seconds_of_a_turn))
    view: Any = SimpleNamespace(fields={}, left_out=3, refused=2, take=lambda _items, _now, **_: [])
    return Dashboard(Bus(MemoryTransport(broker), "f"), view, recording, "*", ""), heard


def test_its_health_reports_counts_and_the_time_of_a_turn_in_microseconds() -> None:
    shown, heard = dashboard(0.02)
    shown.turn(0.0)
    (item,) = heard.take(0.0)
    message: Any = item.message  # type: ignore[union-attr]
    assert (message.service, message.state, message.stale, message.refused) == ("dashboard", "ready", 3, 2)
    assert 20e3 <= message.step_microseconds < 2e6


def test_it_has_a_heartbeat_four_times_a_second(monkeypatch: pytest.MonkeyPatch) -> None:
    clock = [100.0]
    monkeypatch.setattr(time, "monotonic", lambda: clock[0])
    shown, heard = dashboard()
    for _ in range(200):
        clock[0] += 0.02
        shown.turn(0.0)
    assert 12 <= len(heard.take(0.0)) <= 17


def test_a_stopped_dashboard_ends_within_a_second() -> None:
    shown, _ = dashboard()
    stopped = threading.Event()
    running = threading.Thread(target=shown.run, args=(stopped.is_set,), daemon=True)
    running.start()
    time.sleep(0.05)
    stopped.set()
    running.join(1.5)
    assert not running.is_alive()
