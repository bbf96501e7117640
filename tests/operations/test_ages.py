"""What is sent to people and to Prometheus: no value of a robot without its age, and no old one as the present."""

import io
import re
import time
from types import SimpleNamespace
from typing import Any

import pytest
from rich.console import Console
from tests.messages import finding_of, health_of, latent_of, stamp, state_of, verdict_of

from safedpa.bus import (
    FINDING,
    HEALTH,
    LATENT,
    STATE,
    VERDICT,
    Bus,
    MemoryBroker,
    MemoryTransport,
    ReceivedMessage,
    SurroundingsMessage,
)
from safedpa.dynamics import load_model
from safedpa.safety.defaults import settings_named
from safedpa_services.command_line.status import document_of
from safedpa_services.command_line.status_table import render_status_table
from safedpa_services.dashboard.display_settings import display_settings
from safedpa_services.dashboard.fleet_view import FleetView
from safedpa_services.dashboard.now_page import NowPage
from safedpa_services.dashboard.shapes import Bands, Curves, MarkdownPage, TimelineFrame
from safedpa_services.metrics.exporter import FAMILIES, FleetCollector
from safedpa_services.supervisor.run_monitor import RunMonitor
from safedpa_services.supervisor.view import render_view
from safedpa_services.terminal import terminal
from safedpa_services.workbench.live.panels import (
    drive_table,
    error_bars,
    filter_sentence,
    finding_sentence,
    where_text,
)
from safedpa_services.workbench.live.store import RobotHistory

H = 0.6
"""h of the fleet's verdicts."""
OF_A_MESSAGE = {
    "safedpa_barrier_value", "safedpa_margin", "safedpa_margin_coverage", "safedpa_margin_coverage_promised",
    "safedpa_model_error", "safedpa_model_error_band", "safedpa_diagnosis_stage", "safedpa_recorder_free_bytes",
}  # fmt: skip
"""Gauges with the value of one message; the others count, or say what is true at the time of the scrape."""
PRESENT = {
    "safedpa_missing", "safedpa_silent_seconds", "safedpa_robot_up", "safedpa_robot_healthy",
    "safedpa_message_age_seconds", "safedpa_service_processes", "safedpa_service_info", "safedpa_service_robots",
    "safedpa_heartbeat_age_seconds",
}  # fmt: skip


@pytest.mark.parametrize("age", [0.0, 7.0, 300.0])
def test_metrics_have_the_age_of_each_message_and_no_value_of_an_old_one(fleet: Any, age: float) -> None:
    gauges = {name for name, family in FAMILIES.items() if family.kind == "gauge"}
    assert gauges == OF_A_MESSAGE | PRESENT, "a further gauge is one or the other"
    fleet.drive(1)
    fleet.finding("r1", "watching", "")
    fleet.overview.listen(0.0)
    fleet.now += age
    samples = [sample for family in FleetCollector(fleet.overview).collect() for sample in family.samples]
    aged = {sample.labels["topic"] for sample in samples if sample.name == "safedpa_message_age_seconds"}
    assert aged == {"state", "verdict", "finding"}
    assert bool({sample.name for sample in samples} & OF_A_MESSAGE) is (age == 0.0)


@pytest.mark.parametrize("age", [0.0, 7.0, 300.0])
def test_the_status_shows_no_h_and_no_verdict_of_the_past_and_its_document_has_their_ages(
    fleet: Any, age: float
) -> None:
    fleet.drive(1)
    fleet.now += age
    document = document_of(fleet.overview)
    (row,) = document["robots"]
    assert row["state_age"] == pytest.approx(age, abs=0.3)
    assert row["verdict_age"] == pytest.approx(age, abs=0.3)
    console = Console(width=220, force_terminal=False)
    with console.capture() as captured:
        console.print(render_status_table(document, 220))
    (shown,) = [line for line in captured.get().splitlines() if (line.startswith("r1 ") and "trouble" in line) or
                (line.startswith("r1 ") and "well" in line)]  # fmt: skip
    assert (f"{H:+.2f}" in shown) is (age == 0.0)
    assert ("passed" in shown) is (age == 0.0)
    assert age == 0.0 or f"{age:.0f} s ago" in shown


@pytest.mark.parametrize("age", [0.0, 0.9, 7.0, 300.0])
def test_every_value_of_the_pages_is_followed_by_its_age(age: float) -> None:
    page, history = NowPage(display_settings(load_model("car"), settings_named("car"))), RobotHistory("r1")
    for message in (state_of(), verdict_of("passed", h_now=H), finding_of("watching")):
        page.take(message, 1000.0)
        history.update(message, 1000.0)
    text = page.page(1000.0 + age).text.replace("\\", "")
    old = f"{age:.1f} s old" if age < 10.0 else f"{age:.0f} s old"
    for value in (r"clock [\d.]+ s, goals \d+, collisions \d+", r"h [\d.]+ m, margin [\d.]+ m", r"diagnosis \w+"):
        assert re.search(rf"{value} \({old}\)", text), (value, text)
    assert text.startswith("**passed**") is (age < 0.75)
    rows = re.findall(r"<tr><td>.*?</td><td>.*?</td><td>(.*?)</td></tr>", drive_table(history, 1000.0 + age))
    assert len(rows) == drive_table(history, 1000.0 + age).count("<tr>") == 6
    assert all(old in row for row in rows)


AGE = re.compile(r"[\d.]+ s old")
SEEN = SurroundingsMessage(
    **stamp(0),
    points=(),
    movers=(),
    hidden=(),
    ages=(0.2, -1.0),
    zones=("closed 31",),
    ordered="31 off",
    problems=("31 returns are too near",),
)


@pytest.mark.parametrize("age", [0.0, 7.0, 300.0])
def test_every_part_of_a_page_that_has_a_number_has_an_age_too(age: float) -> None:
    """Also numbers within sentences of the filter, the diagnosis and perception."""
    page, history = NowPage(display_settings(load_model("car"), settings_named("car"))), RobotHistory("r1")
    verdict = verdict_of("corrected", h_now=H, sentence="turned by 31 degrees")
    finding = finding_of("candidates", sentence="31 steps miss", where="near 31 m", error=0.31, band=0.2)
    for message in (state_of(sources=("front", "rear")), verdict, finding, SEEN):
        page.take(message, 1000.0)
        history.update(message, 1000.0)
    now = 1000.0 + age
    blocks = [filter_sentence(history, now), finding_sentence(history, now), where_text(history, now)]
    blocks.append(error_bars(history, now))
    blocks += [part for block in page.page(now).text.replace("\\", "").split("\n\n") for part in block.split("; ")]
    with_numbers = [block for block in blocks if re.search(r"\d", block) and not block.startswith("**No ")]
    assert len(with_numbers) >= 10, blocks
    assert [block for block in with_numbers if not AGE.search(block)] == []


@pytest.mark.parametrize("width", [80, 95, 125, 220])
@pytest.mark.parametrize("age", [0.0, 7.0, 300.0])
def test_each_row_of_the_status_has_an_age_at_every_width(fleet: Any, age: float, width: int) -> None:
    fleet.drive(1)
    fleet.now += age
    document = document_of(fleet.overview)
    console = Console(width=width, force_terminal=False)
    with console.capture() as captured:
        console.print(render_status_table(document, width))
    heads = [line for line in captured.get().splitlines() if line.startswith(("robot ", "process "))]
    assert len(heads) == 2
    assert all("age s" in head for head in heads)
    (row,) = document["robots"]
    assert (row["sense_to_act_p99"] is None) is (age > 0.0), "latencies of the past are not those of the present"


@pytest.mark.parametrize("age", [0.0, 7.0, 300.0])
def test_every_line_of_the_terminal_view_has_an_age(monkeypatch: pytest.MonkeyPatch, age: float) -> None:
    watch = RunMonitor(Bus(MemoryTransport(MemoryBroker()), "fleet"))
    verdict = verdict_of("corrected", h_now=H, stationary_for=9.0, stationary_reason="a wall")
    watch.state, watch.verdict, watch.finding = state_of(), verdict, finding_of("raised")
    watch.state_at = watch.verdict_at = watch.finding_at = 1000.0
    watch.health["policy"] = health_of("policy", step_microseconds=42.0), 1000.0
    monkeypatch.setattr(time, "monotonic", lambda: 1000.0 + age)
    console = terminal(file=io.StringIO(), width=200)
    child = SimpleNamespace(name="policy", pid=4711, heartbeat=True, exit_code=None, restarts=0)
    console.print(render_view(watch, [child], []))
    first, *lines = [line for line in console.file.getvalue().splitlines() if re.search(r"\d", line)]
    assert len(AGE.findall(first)) == 2, "of the state and of the verdict"
    assert first.startswith("No state for") is (age > 0.0)
    *texts, row = lines
    assert len(texts) == (2 if age == 0.0 else 1), "the reason of a stop is of the present"
    assert all(AGE.search(line) for line in texts)
    assert re.search(rf" {age:.1f} s +0", row)


def curves_of(frames: list[TimelineFrame]) -> list[float]:
    """Returns the time of each point of a curve."""
    drawn = [(frame.at, entry) for frame in frames for entry in frame.entries if not entry.static]
    return [at for at, entry in drawn if isinstance(entry.shape, Curves | Bands)]


@pytest.mark.parametrize("delay", [0.0, 0.6])
def test_each_point_of_a_curve_is_at_the_time_of_its_measurement_and_none_is_drawn_again(delay: float) -> None:
    """A curve has no other age: the time line goes on without it."""
    view = FleetView(display_settings(load_model("car"), settings_named("car")))
    for tick in range(40):
        messages = {
            STATE: state_of(**stamp(tick)),
            LATENT: latent_of(0.4, 2.5, **stamp(tick)),
            VERDICT: verdict_of("passed", **stamp(tick), h_now=H, action=(1.0, 0.0), nominal=(1.0, 0.0)),
            FINDING: finding_of("watching", **stamp(tick)),
        }
        at = 1000.0 + 0.05 * tick
        items = [ReceivedMessage(topic, "r1", message, b"", "", at) for topic, message in messages.items()]
        points = curves_of(view.take(items, at + delay))
        assert set(points) <= {0.05 * tick}
    assert points
    ages = [view.take([], at + delay + silence) for silence in (1.0, 2.0, 7.0, 8.0, 60.0)]
    assert [curves_of(frames) for frames in ages] == [[]] * 5
    pages = [[f.at for f in frames if isinstance(f.entries[-1].shape, MarkdownPage)][-1] for frames in ages]
    assert pages[-1] > 0.05 * tick + 59.0, "the time line goes on while nothing arrives"
    assert pages == sorted(pages)


def test_step_times_are_at_the_time_of_their_heartbeat() -> None:
    view = FleetView(display_settings(load_model("car"), settings_named("car")))
    view.take([ReceivedMessage(STATE, "r1", state_of(**stamp(0)), b"", "", 1000.0)], 1000.0)
    message = health_of("policy", step_microseconds=42.0, **stamp(0))
    assert curves_of(view.take([ReceivedMessage(HEALTH, "r1", message, b"", "", 1003.0)], 1009.0)) == [3.0]
