"""What a question and its answer mean where they say little, and what is told of them on the bus."""

from __future__ import annotations

import time
from importlib.metadata import PackageNotFoundError, version

import msgpack
import pytest

from safedpa.bus import Answer, Request, decode
from safedpa.bus.wire import version as of_the_software
from safedpa.bus.wire.requests import asked_message, request_key
from safedpa.bus.wire.version import software_version


def test_what_a_short_question_leaves_out_is_nothing() -> None:
    asked = decode(Request, msgpack.packb({"do": "status"}))
    assert asked == Request(do="status", effect="", model="", finding=0, who="", switches=())


def test_what_a_short_answer_leaves_out_is_nothing() -> None:
    given = decode(Answer, msgpack.packb({"ok": True, "sentence": "so be it"}))
    numbers = (given.change, given.epoch, given.from_tick, given.finding, given.earlier)
    assert numbers == (0, 0, 0, 0, 0)
    texts = (given.fingerprint, given.document, given.margin, given.pending, given.pending_fingerprint)
    assert texts == ("", "", "", "", "")
    assert (given.candidates, given.foreseen) == ((), ())


def test_what_was_asked_and_answered_is_told_in_one_message() -> None:
    request = Request(do="accept", effect="towed_load", model="0123456789ab", finding=2, who="engineer")
    before = time.time()
    told = asked_message(request, Answer(ok=False, sentence="not now", change=3))
    assert before <= told.publish_time <= time.time()
    assert (told.do, told.effect, told.model, told.finding, told.who) == (
        "accept", "towed_load", "0123456789ab", 2, "engineer",
    )  # fmt: skip
    assert (told.ok, told.sentence, told.change) == (False, "not now", 3)
    assert (told.epoch, told.tick, told.robot_time) == (0, 0, 0.0), "it belongs to no tick"


def test_of_what_was_no_question_the_answer_alone_is_told() -> None:
    told = asked_message(None, Answer(ok=True, sentence="no msgpack", change=4))
    assert (told.do, told.effect, told.model, told.finding, told.who) == ("", "", "", 0, "")
    assert (told.ok, told.sentence, told.change) == (True, "no msgpack", 4)
    assert (told.epoch, told.tick, told.robot_time) == (0, 0, 0.0)


def test_a_question_is_asked_beside_the_topics_of_its_robot() -> None:
    assert request_key("f", "r1") == "safedpa/f/r1/request"
    assert request_key("f", "*", "agreed") == "safedpa/f/*/agreed"


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
