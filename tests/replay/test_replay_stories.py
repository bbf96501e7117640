"""Whatever befalls the services while they drive, the recording replays bit for bit."""

import dataclasses
import tempfile
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from tests.replay.conftest import driven

from safedpa.bus import LATENT, NOMINAL, STATE, VERDICT, VerdictMessage
from safedpa.errors import RunError
from safedpa.records import McapRecorder
from safedpa.replay.replay import Replay, replay
from safedpa.replay.tape import RobotTape, gaps_of, read_tape

SERVICES = ("adaptation", "policy", "safety_filter")
EVENTS = st.lists(
    st.tuples(
        st.integers(2, 40),
        st.sampled_from(["kill", "restart", "stall", "robot"]),
        st.sampled_from(SERVICES),
        st.integers(1, 6),
    ),
    max_size=5,
)


def replayed(path: Path) -> tuple[RobotTape, Replay]:
    tape = read_tape([path])
    return tape, replay(tape)


def counted(found: Replay) -> dict[str, int]:
    return {topic: count for part in found.services for topic, count in part.compared.items()}


@pytest.mark.long
@settings(max_examples=6, deadline=None)
@given(events=EVENTS)
def test_every_story_replays_bit_for_bit(fleet_of: Any, events: list[tuple[int, str, str, int]]) -> None:
    with tempfile.TemporaryDirectory() as folder:
        fleet = driven(fleet_of(), 45, events)
        tape, found = replayed(fleet.record(Path(folder) / "drive.mcap"))
    assert found.exact, (events, [part.differing[:2] or part.spans for part in found.services])
    notice = {topic.name: sum(item.topic is topic for item in fleet.heard) for topic in (LATENT, NOMINAL, VERDICT)}
    assert {name: counted(found).get(name, 0) for name in notice} == notice
    assert gaps_of(tape) == []


@pytest.mark.parametrize("stops", [True, False])
@pytest.mark.parametrize("ends", ["go", "confirm"])
def test_a_drive_replays_after_a_stop_order_and_an_implausible_state_ended(
    fleet_of: Any, tmp_path: Path, ends: str, *, stops: bool
) -> None:
    fleet = driven(fleet_of(), 20)
    fleet.metres = 0.8
    driven(fleet, 15)
    fleet.stop_order(ends)
    driven(fleet, 15)
    if stops:
        fleet.stop_order("stop")
        driven(fleet, 5)
        fleet.stop_order("go")
        driven(fleet, 10)
    verdicts = [item.message for item in fleet.heard if item.topic is VERDICT]
    assert any("jumped" in verdict.sentence for verdict in verdicts[20:35])
    assert not verdicts[-1].ordered
    _, found = replayed(fleet.record(tmp_path / "drive.mcap"))
    assert found.exact


@pytest.mark.parametrize("controller", ["goal_seeker", "random", "planner"])
def test_every_controller_replays(fleet_of: Any, tmp_path: Path, controller: str) -> None:
    ticks = 8 if controller == "planner" else 30
    fleet = driven(fleet_of(controller=controller), ticks, [(4, "stall", "adaptation", 2)])
    _, found = replayed(fleet.record(tmp_path / "drive.mcap"))
    assert found.exact
    assert counted(found)["nominal"] == ticks


@pytest.mark.parametrize("restarted", [(), ("adaptation",), ("policy",), ("safety_filter",)])
def test_a_change_of_the_model_replays_with_all_that_follows_it(fleet_of, offer_of, tmp_path, restarted):
    fleet, offer = fleet_of(), offer_of("car", 1)
    driven(fleet, 20)
    fleet.send(offer)
    driven(fleet, 5)
    assert {answer.state for answer in fleet.takeovers} == {"ready"}
    fleet.send(dataclasses.replace(offer, step="take", from_tick=fleet.robot.tick + 3, document="", margin=""))
    driven(fleet, 15, [(7, "restart", service, 0) for service in restarted])
    tape, found = replayed(fleet.record(tmp_path / "drive.mcap"))
    models = {
        entry.message.model for entry in tape.computed["safety_filter"] if isinstance(entry.message, VerdictMessage)
    }
    assert len(models) == 2
    assert found.exact, [part.differing[:3] or part.spans for part in found.services]


def test_lost_outputs_are_made_up_where_their_states_are_there(fleet_of: Any, tmp_path: Path) -> None:
    fleet = driven(fleet_of(), 40)
    path = fleet.record(
        tmp_path / "drive.mcap", lambda item: not (item.topic in (LATENT, VERDICT) and 10 <= item.message.tick < 15)
    )
    tape, found = replayed(path)
    assert found.exact
    assert {part.service: part.lost for part in found.services} == {"adaptation": 5, "policy": 0, "safety_filter": 5}
    assert counted(found) == {"latent": 35, "nominal": 40, "verdict": 35, "action": 35}
    assert {(gap.what, gap.missing) for gap in gaps_of(tape)} == {("adaptation", 5), ("safety_filter", 5)}


def test_outputs_lost_to_the_end_are_seen_by_what_others_used(fleet_of: Any, tmp_path: Path) -> None:
    fleet = driven(fleet_of(), 40)
    path = fleet.record(tmp_path / "drive.mcap", lambda item: not (item.topic is LATENT and item.message.tick >= 25))
    tape, found = replayed(path)
    assert found.exact
    assert counted(found)["verdict"] == 40
    assert [(gap.what, gap.after_tick, gap.missing) for gap in gaps_of(tape)] == [("adaptation", 24, 15)]


def test_a_gap_makes_the_memory_unknown_until_it_agrees_again(fleet_of: Any, tmp_path: Path) -> None:
    fleet = driven(fleet_of(model="car_measured"), 90)
    path = fleet.record(
        tmp_path / "drive.mcap",
        lambda item: not (item.topic in (STATE, LATENT, NOMINAL, VERDICT) and 20 <= item.message.tick < 24),
    )
    tape, found = replayed(path)
    assert ("state", 4) in {(gap.what, gap.missing) for gap in gaps_of(tape)}
    spans = [span for part in found.services for span in part.spans]
    assert spans
    assert {span.tick for span in spans} == {24}
    assert all(span.agrees_from is not None and "not recorded" in span.reason for span in spans)
    assert found.agrees


def test_a_recording_that_begins_mid_drive_is_reported_as_such(fleet_of: Any, tmp_path: Path) -> None:
    fleet = driven(fleet_of(), 40)
    _, found = replayed(
        fleet.record(tmp_path / "drive.mcap", lambda item: item.topic.name == "setup" or item.message.tick >= 10)
    )
    adaptation = found.services[0]
    assert adaptation.spans[0].tick == 10
    assert "not recorded" in adaptation.spans[0].reason
    assert not adaptation.differing, "what cannot be known is no difference"


def test_of_several_robots_the_one_that_is_named_is_replayed(fleet_of: Any, tmp_path: Path) -> None:
    fleet = driven(fleet_of(), 20)
    path = tmp_path / "two.mcap"
    with McapRecorder(path) as recorder:
        for item in fleet.heard:
            at = round(1e9 * item.at)
            for name in ("r1", "r2") if item.robot == "r1" else (item.robot,):
                recorder.write(item.key.replace("/r1/", f"/{name}/"), item.payload, at, at)
    with pytest.raises(RunError, match="holds 2 robots: r1, r2; name one with --robot"):
        read_tape([path])
    with pytest.raises(RunError, match="robot 'r3'"):
        read_tape([path], "r3")
    tape = read_tape([path], "r2")
    assert tape.robot == "r2"
    assert replay(tape).exact
