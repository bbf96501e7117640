"""A recording explains itself to tools that know MCAP alone; who asked the diagnosis for what is in it."""

import dataclasses
import json
import re
from pathlib import Path
from typing import Any

import msgpack
import pytest

from safedpa.bus import (
    ASKED,
    NO_ROBOT,
    TOPICS,
    Answer,
    AskedMessage,
    Bus,
    MemoryBroker,
    MemoryTransport,
    ReceivedMessage,
    Request,
    request_key,
)
from safedpa.bus.messages.requests import asked_message
from safedpa.bus.messages.service_info import setup_message
from safedpa.errors import InputError
from safedpa.records.writers.mcap import schema_of
from safedpa_services.recorder.recorder import Recorder

PAGE = Path(__file__).parents[2] / "docs" / "guides" / "replay.md"


@pytest.mark.parametrize("name", TOPICS)
def test_every_message_has_a_schema_with_all_its_fields(name: str) -> None:
    kind = TOPICS[name].message
    schema = json.loads(schema_of(kind))
    assert list(schema["properties"]) == [item.name for item in dataclasses.fields(kind)]
    needed = {item.name for item in dataclasses.fields(kind) if item.default is dataclasses.MISSING}
    assert set(schema["required"]) == needed
    assert schema["properties"]["robot_time"]["description"].startswith("Time since")


def test_the_mcap_library_reads_it_and_the_schemas_explain_it(fleet_of: Any, tmp_path: Path) -> None:
    from mcap.reader import make_reader

    fleet = fleet_of()
    for _ in range(5):
        fleet.tick()
    broker = MemoryBroker()
    bus, speaker = Bus(MemoryTransport(broker), "test"), Bus(MemoryTransport(broker), "test")
    recorder = Recorder(bus, tmp_path / "drive.mcap", setup_message("recorder", {}))
    for item in fleet.heard:
        speaker.publish(item.topic, item.robot, item.message, getattr(item.message, "service", ""))
    recorder.run(lambda: True)
    with (tmp_path / "drive.mcap").open("rb") as file:
        reader = make_reader(file)
        (metadata,) = reader.iter_metadata()
        assert metadata.metadata["fleet"] == "test"
        kinds = set()
        for schema, channel, message in reader.iter_messages():
            assert schema is not None
            assert (schema.encoding, channel.message_encoding) == ("jsonschema", "msgpack")
            table, known = msgpack.unpackb(message.data), json.loads(schema.data)
            assert set(known["required"]) <= set(table) <= set(known["properties"])
            kinds.add(schema.name)
    assert {"safedpa.StateMessage", "safedpa.SetupMessage", "safedpa.VerdictMessage"} <= kinds


def test_a_refused_request_is_recorded_with_its_reason() -> None:
    broker = MemoryBroker()
    diagnosis, person, recorder = (Bus(MemoryTransport(broker), "test") for _ in range(3))
    inbox = recorder.inbox((ASKED,), keep_all=True)

    def answer(robot: str, request: Request) -> Answer:
        if request.effect == "gravity":
            raise InputError("effect 'gravity': is not proposed")
        return Answer(ok=True, sentence=f"change 1 is offered to {robot}", change=1)

    def report_progress(robot: str, request: Request | None, given: Answer) -> None:
        diagnosis.publish(ASKED, robot or NO_ROBOT, asked_message(request, given))

    diagnosis.answer_requests(answer, report_progress=report_progress)
    for effect in ("gravity", "payload"):
        person.request("r1", Request(do="accept", effect=effect, who="a person", finding=2))
    MemoryTransport(broker).ask(request_key("test", "r1"), b"\xc1", 1.0)
    refused, done, nonsense = (item.message for item in inbox.take(0.0) if isinstance(item, ReceivedMessage))
    assert isinstance(refused, AskedMessage)
    assert isinstance(done, AskedMessage)
    assert isinstance(nonsense, AskedMessage)
    assert (refused.ok, refused.effect, refused.who, refused.finding) == (False, "gravity", "a person", 2)
    assert "is not proposed" in refused.sentence
    assert (done.ok, done.change) == (True, 1)
    assert (nonsense.ok, nonsense.do) == (False, "")


def test_the_page_s_example_runs(monkeypatch: pytest.MonkeyPatch) -> None:
    (code,) = re.findall(r"```python\n(.*?)```", PAGE.read_text(encoding="utf-8"), re.DOTALL)
    monkeypatch.chdir(PAGE.parents[2])
    exec(compile(code, str(PAGE), "exec"), {})
