"""Which fields a recording has, from its messages byte by byte, and whose outputs a tape keeps."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import msgspec
import pytest

from safedpa.bus import STATE
from safedpa.replay.tape import RobotTape, _note_fields

EVERY = {
    "version", "epoch", "tick", "robot_time", "publish_time", "values", "applied", "applied_by", "period", "lockstep",
    "goal", "obstacles", "field", "footprint",
}  # fmt: skip


@pytest.mark.parametrize(
    ("payload", "known"),
    [
        (msgspec.msgpack.encode({"tick": 1, "epoch": 2}), {"tick", "epoch"}),
        (msgspec.msgpack.encode({"tick": "x", "later": None}), {"tick", "later"}),
        (msgspec.msgpack.encode({}), set()),
    ],
    ids=["two", "with another's", "none"],
)
def test_fields_are_those_of_the_message_whatever_is_in_them(payload: bytes, known: set[str]) -> None:
    fields: dict[Any, frozenset[str]] = {}
    _note_fields(fields, STATE, payload)
    assert fields == {STATE.message: known}


@pytest.mark.parametrize("payload", [b"\x81\xa1\xff\x01", b"\x82\x01\x02\xa4tick\x05"], ids=["no text", "a number"])
def test_where_a_name_is_no_text_all_of_ours_are_taken_to_be_there(payload: bytes) -> None:
    """The message was read, so each field is there or has its default."""
    fields: dict[Any, frozenset[str]] = {}
    _note_fields(fields, STATE, payload)
    assert fields[STATE.message] >= EVERY


def test_the_first_message_tells_for_all() -> None:
    fields: dict[Any, frozenset[str]] = {}
    for names in ({"tick": 1}, {"epoch": 1}):
        _note_fields(fields, STATE, msgspec.msgpack.encode(names))
    assert fields == {STATE.message: {"tick"}}


def test_a_tape_keeps_the_outputs_of_each_service_from_the_beginning() -> None:
    tape = RobotTape("r1", (Path("a.mcap"),))
    assert {name: tape.computed[name] for name in ("adaptation", "perception", "policy", "safety_filter")} == {
        "adaptation": [], "perception": [], "policy": [], "safety_filter": [],
    }  # fmt: skip
