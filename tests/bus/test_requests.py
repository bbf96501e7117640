"""Requests and answers: their defaults, their keys, which are answered, and what is published of them."""

import time
from importlib.metadata import PackageNotFoundError, version
from typing import Any

import msgpack
import pytest

from safedpa.bus import Answer, Bus, MemoryBroker, MemoryTransport, Request, decode, encode
from safedpa.bus.messages import service_info as of_the_software
from safedpa.bus.messages.requests import asked_message, request_key, robot_of_request
from safedpa.bus.messages.service_info import software_version
from safedpa.errors import InputError


def test_a_short_request_has_empty_defaults() -> None:
    asked = decode(Request, msgpack.packb({"do": "status"}))
    assert asked == Request(do="status", effect="", model="", finding=0, who="", switches=())


def test_a_short_answer_has_empty_defaults() -> None:
    given = decode(Answer, msgpack.packb({"ok": True, "sentence": "so be it"}))
    numbers = (given.change, given.epoch, given.from_tick, given.finding, given.earlier)
    assert numbers == (0, 0, 0, 0, 0)
    texts = (given.fingerprint, given.document, given.margin, given.pending, given.pending_fingerprint)
    assert texts == ("", "", "", "", "")
    assert (given.candidates, given.foreseen) == ((), ())


def test_a_request_and_its_answer_are_published_in_one_message() -> None:
    request = Request(do="accept", effect="towed_load", model="0123456789ab", finding=2, who="engineer")
    before = time.time()
    report = asked_message(request, Answer(ok=False, sentence="not now", change=3))
    assert before <= report.publish_time <= time.time()
    assert (report.do, report.effect, report.model, report.finding, report.who) == (
        "accept", "towed_load", "0123456789ab", 2, "engineer",
    )  # fmt: skip
    assert (report.ok, report.sentence, report.change) == (False, "not now", 3)
    assert (report.epoch, report.tick, report.robot_time) == (0, 0, 0.0), "it belongs to no tick"


def test_of_a_payload_that_is_no_request_only_the_answer_is_published() -> None:
    report = asked_message(None, Answer(ok=True, sentence="no msgpack", change=4))
    assert (report.do, report.effect, report.model, report.finding, report.who) == ("", "", "", 0, "")
    assert (report.ok, report.sentence, report.change) == (True, "no msgpack", 4)
    assert (report.epoch, report.tick, report.robot_time) == (0, 0, 0.0)


KINDS = ("request", "status", "order", "sense", "agreed")


@pytest.mark.parametrize("kind", KINDS)
def test_the_key_of_a_request_names_one_robot(kind: str) -> None:
    assert request_key("f", "r1") == "safedpa/f/r1/request"
    assert request_key("f", "*", kind) == f"safedpa/f/*/{kind}"
    assert robot_of_request(request_key("f", "r1", kind)) == "r1"
    for key in (request_key("f", "*", kind), f"safedpa/f/r1/{kind}/x", f"safedpa/r1/{kind}", f"safedpa/**/{kind}",
                f"safedpa/f/r*/{kind}", "safedpa/f/r1/state", "safedpa/f/r1/", ""):  # fmt: skip
        with pytest.raises(InputError, match="wanted safedpa/FLEET/ROBOT/request"):
            robot_of_request(key)


@pytest.mark.parametrize(
    ("kind", "do", "ok"),
    [
        ("request", "accept", True),
        ("request", "status", True),
        ("status", "status", True),
        ("status", "accept", False),
        ("status", "stop", False),
    ],
)
def test_under_the_key_for_status_nothing_else_is_answered(kind: str, do: str, ok: bool) -> None:
    transport, reported, asked = MemoryTransport(MemoryBroker()), list[Any](), list[str]()

    def answer(robot: str, request: Request) -> Answer:
        asked.append(f"{robot} {request.do}")
        return Answer(ok=True, sentence="yes")

    Bus(transport, "f").answer_requests(
        answer, report_progress=lambda *one: reported.append((one[0], one[1], one[2].ok))
    )
    given = transport.ask(request_key("f", "r", kind), encode(Request(do=do)), 1.0)
    assert given is not None
    assert decode(Answer, given).ok is ok
    assert asked == ([f"r {do}"] if ok else [])
    assert reported == [("r", Request(do=do), ok)]


def test_a_heartbeat_names_the_installed_version_or_none(monkeypatch: pytest.MonkeyPatch) -> None:
    software_version.cache_clear()
    assert software_version() == version("safedpa")

    def absent(name: str) -> str:
        raise PackageNotFoundError(name)

    monkeypatch.setattr(of_the_software, "version", absent)
    software_version.cache_clear()
    assert software_version() == ""
    monkeypatch.undo()
    software_version.cache_clear()
    assert software_version() == version("safedpa")
