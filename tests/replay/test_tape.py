"""Which fields a recording has, and whose outputs a tape keeps."""

from dataclasses import fields
from pathlib import Path

import msgspec
import pytest

from safedpa.bus import STATE, StateMessage, encode, key_of
from safedpa.records import McapRecorder
from safedpa.replay.tape import RobotTape, read_tape
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene

PAYLOAD = encode(CarRobot(Scene.random(1, "none")).state_message())
WHOLE = {item.name for item in fields(StateMessage)}


def without(*names: str) -> bytes:
    document = msgspec.msgpack.decode(PAYLOAD)
    return msgspec.msgpack.encode({name: value for name, value in document.items() if name not in names})


def with_entry(entry: bytes) -> bytes:
    """One entry more, whose name need not be text."""
    assert PAYLOAD[0] == 0xDE, "a map of 16 entries or more"
    return b"\xde" + (int.from_bytes(PAYLOAD[1:3], "big") + 1).to_bytes(2, "big") + PAYLOAD[3:] + entry


@pytest.mark.parametrize(
    ("payloads", "lacking"),
    [
        pytest.param([PAYLOAD], set(), id="all"),
        pytest.param(
            [without("collisions", "goals_reached")], {"collisions", "goals_reached"}, id="of an older program"
        ),
        pytest.param([without("collisions"), PAYLOAD], {"collisions"}, id="the first message decides"),
        pytest.param([with_entry(b"\xa1\xff\x01")], set(), id="a name that is no text"),
    ],
)
def test_the_fields_of_a_recording_are_those_of_its_first_message(payloads, lacking, tmp_path):
    with McapRecorder(tmp_path / "a.mcap") as recorder:
        for tick, payload in enumerate(payloads):
            recorder.write(key_of("fleet", "r1", STATE), payload, tick, tick)
    tape = read_tape([tmp_path / "a.mcap"])
    assert tape.findings == []
    known = tape.fields[StateMessage]
    assert known >= WHOLE - lacking
    assert not known & lacking


def test_a_tape_keeps_the_outputs_of_each_service_from_the_beginning() -> None:
    tape = RobotTape("r1", (Path("a.mcap"),))
    assert {name: tape.computed[name] for name in ("adaptation", "perception", "policy", "safety_filter")} == {
        "adaptation": [], "perception": [], "policy": [], "safety_filter": [],
    }  # fmt: skip
