"""Surroundings are reproduced from recorded scans and orders; missing scans are reported."""

import dataclasses
from pathlib import Path
from typing import Any

import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from tests.replay.conftest import driven

from safedpa.bus import SCAN, SURROUNDINGS, ReceivedMessage, ScanMessage, SurroundingsMessage, decode, encode
from safedpa.bus.logging import EVENT_LOG
from safedpa.replay.driver import ReplayedStep
from safedpa.replay.replay import Replay, ServiceReplay, replay
from safedpa.replay.report import write_outputs
from safedpa.replay.setups import complete_setups
from safedpa.replay.tape import RobotTape, read_tape
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors

ZONES = """
[[zones]]
name = "wet"
kind = "closed"
frame = "map"
polygon = [[1.0, -0.5], [2.0, -0.5], [2.0, 0.5], [1.0, 0.5]]
use = false

[[zones]]
name = "arm"
kind = "ignored"
frame = "robot"
polygon = [[0.2, -0.2], [0.6, -0.2], [0.6, 0.2]]

[[zones]]
name = "slow"
kind = "ignored"
frame = "robot"
polygon = [[-0.9, -0.2], [-0.6, -0.2], [-0.6, 0.2]]
speed = [0.0, 0.4]
"""
EVENTS = st.lists(
    st.tuples(
        st.integers(2, 40),
        st.sampled_from(["kill", "restart", "stall", "robot"]),
        st.sampled_from(["perception", "safety_filter", "policy"]),
        st.integers(1, 6),
    ),
    max_size=4,
)


def two_lasers() -> SimulatedSensors:
    """One that turns quickly, and one that looks ahead and is late."""
    return SimulatedSensors(
        (Laser(LaserSettings(), 3), Laser(LaserSettings(name="front", rays=90, rate=15.0, latency=0.12), 4))
    )


@pytest.fixture
def fleet(fleet_of: Any) -> Any:
    return fleet_of(load="none", sensor_inputs=two_lasers, zones=ZONES)


def of_perception(found: Replay) -> ServiceReplay:
    return next(part for part in found.services if part.service == "perception")


def replayed(fleet: Any, path: Path, keep: Any = lambda _: True) -> tuple[RobotTape, Replay]:
    tape = read_tape([fleet.record(path, keep)])
    return tape, replay(tape)


def reported(tape: RobotTape) -> list[SurroundingsMessage]:
    found = [entry.message for entry in tape.computed["perception"]]
    assert all(isinstance(message, SurroundingsMessage) for message in found)
    return found  # type: ignore[return-value]


@pytest.mark.long
@pytest.mark.parametrize("events", [[], [(20, "stall", "perception", 3), (40, "kill", "perception", 12)]])
def test_what_is_seen_comes_out_again(fleet: Any, tmp_path: Path, events: list[tuple[int, str, str, int]]) -> None:
    tape, found = replayed(driven(fleet, 90, events), tmp_path / "seen.mcap")
    assert found.exact, of_perception(found).differing[:3]
    assert of_perception(found).compared["surroundings"] == len(reported(tape)) > 70
    assert {name for message in reported(tape) for name in map(int, (row[0] for row in message.scans))} == {0, 1}
    by_name = {part.service: part for part in found.services}
    assert by_name["safety_filter"].compared["verdict"] >= 85
    seen = next(message for message in reported(tape) if message.tick == 60)
    key = (SURROUNDINGS, seen.epoch, 60, seen.publish_time)
    tape.named[key] = dataclasses.replace(seen, movers=((1e-3, 0.0, 9.0, 0.0, 0.0, 1.5),))
    assert not replay(tape).agrees, "another thing that was seen makes another verdict"


@pytest.mark.long
@settings(max_examples=8, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(events=EVENTS)
def test_whatever_befalls_the_services(fleet_of: Any, tmp_path: Path, events: list[tuple[int, str, str, int]]) -> None:
    fleet = fleet_of(load="none", sensor_inputs=two_lasers, zones=ZONES)
    _, found = replayed(driven(fleet, 50, events), tmp_path / "seen.mcap")
    assert not of_perception(found).differing
    assert found.agrees or of_perception(found).spans


def test_orders_apply_in_the_replay_from_their_tick_on_and_the_recording_names_their_author(fleet: Any, tmp_path: Path):
    driven(fleet, 20)
    fleet.order("source front=off", "zone wet=on", who="Ada")
    driven(fleet, 20)
    fleet.order("source front=on", "zone arm=off", who="Grace\n")
    driven(fleet, 20)
    tape, found = replayed(fleet, tmp_path / "ordered.mcap")
    assert found.exact, of_perception(found).differing[:3]
    assert {len(message.zones) for message in reported(tape)[:20]} == {1, 2}, "slow and quick"
    first, second, third = (
        dataclasses.replace(message, zones=tuple(name for name in message.zones if name != "ignored slow"))
        for message in (reported(tape)[tick] for tick in (10, 30, 50))
    )
    assert (first.off, first.zones, first.ordered) == ((), ("ignored arm",), "")
    assert second.off == ("front",)
    assert second.zones == ("closed wet", "ignored arm")
    assert second.ordered == "source front off, zone wet on, by Ada"
    assert third.zones == ("closed wet",)
    assert third.ordered.startswith("source front on, zone wet on, zone arm off, by Grace")
    assert third.ordered.isprintable()
    assert [row[1:] for row in second.borders if row[0] == 0.0] == [(1.0, -0.5), (2.0, -0.5), (2.0, 0.5), (1.0, 0.5)]
    tape.computed["perception"] = [
        dataclasses.replace(entry, message=dataclasses.replace(entry.message, zones=("ignored arm",)))
        for entry in tape.computed["perception"]
    ]
    forged = of_perception(replay(tape)).differing
    assert {item.field for item in forged} >= {"points"}, "closed zones are published as discs"


@pytest.mark.long
def test_a_scan_that_was_not_recorded_is_reported_and_is_no_difference_of_perception(fleet: Any, tmp_path: Path):
    def keep(item: ReceivedMessage) -> bool:
        scan = item.topic is SCAN and decode(ScanMessage, item.payload)
        return not (isinstance(scan, ScanMessage) and scan.source == "front" and scan.number == 12)

    _, found = replayed(driven(fleet, 60), tmp_path / "lost.mcap", keep)
    part = of_perception(found)
    assert [span.reason for span in part.spans] == ["scan 12 of front was not recorded"]
    assert not part.differing


def test_the_surroundings_of_older_programs_are_accepted(fleet: Any, tmp_path: Path) -> None:
    path = driven(fleet, 30).record(tmp_path / "older.mcap")
    tape = read_tape([path])
    tape.fields[SurroundingsMessage] = tape.fields[SurroundingsMessage] - {
        "scans",
        "off",
        "zones",
        "borders",
        "ordered",
    }
    found, saved = replayed_again(tape, tmp_path / "older again.mcap")
    assert [part.service for part in found.services] == ["adaptation", "policy", "safety_filter"]
    assert found.exact
    assert [entry.message for entry in saved.computed["perception"]] == reported(tape)


def test_without_a_setup_the_recorded_perception_is_used_and_reported(fleet: Any, tmp_path: Path) -> None:
    tape = read_tape([driven(fleet, 30).record(tmp_path / "seen.mcap")])
    assert complete_setups(tape) == []
    del tape.setups["perception"]
    assert complete_setups(tape) == ["perception: no setup was recorded; its outputs are accepted as recorded"]
    assert "perception" not in [part.service for part in replay(tape).services]


def replayed_again(tape: RobotTape, path: Path) -> tuple[Replay, RobotTape]:
    """A replay, and what it writes as a recording."""
    steps: list[ReplayedStep] = []
    found = replay(tape, report_progress=steps.append)
    write_outputs(tape, steps, path)
    return found, read_tape([path])


def test_what_was_replayed_with_scans_can_be_replayed(fleet: Any, tmp_path: Path) -> None:
    driven(fleet, 15)
    fleet.order("zone wet=on", who="Ada")
    tape = read_tape([driven(fleet, 15).record(tmp_path / "seen.mcap")])
    before = EVENT_LOG.counts()
    _, again = replayed_again(tape, tmp_path / "again.mcap")
    assert len(again.scans) == len(tape.scans) > 20
    found = replay(again)
    assert found.exact
    assert of_perception(found).compared["surroundings"] == 30
    assert reported(again)[20].ordered == "zone wet on, by Ada"
    assert EVENT_LOG.counts() == before, "what was switched then is no news"


def test_as_many_borders_are_sent_as_fit_into_a_message() -> None:
    from safedpa.perception.zones import ActiveZones, Zone

    ring = tuple((0.1 * number, float(number % 2)) for number in range(0, 40))
    wave = (*ring, (4.0, 9.0), (0.0, 9.0))
    zones = tuple(Zone(f"z{number}", "ignored", wave) for number in range(64))
    counting = ActiveZones(zones=zones)
    borders = counting.borders((0.0, 0.0, 0.0))
    assert 400 < len(borders) <= 512
    assert {row[0] for row in borders} == set(map(float, range(len(borders) // len(wave))))
    assert len(counting.names) == 64
    stamp = {"epoch": 1, "tick": 0, "robot_time": 0.0, "publish_time": 0.0}
    disc = tuple((1 / 3, 1 / 3, 1 / 3) for _ in range(256))
    message = SurroundingsMessage(
        **stamp, points=disc, movers=tuple(row * 2 for row in disc), hidden=tuple((*row, 1 / 3) for row in disc),
        ages=(0.1,), zones=tuple(name + "n" * 55 for name in counting.names), borders=borders,
        scans=((0.0, 123456.0),) * 256, ordered="zone " + "n" * 68 * 64, problems=("a" * 400,),
    )  # fmt: skip
    assert len(encode(message)) < SURROUNDINGS.largest_bytes
