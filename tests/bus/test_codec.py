"""Messages survive the wire unchanged, and nothing else gets through."""

import dataclasses
import math
from pathlib import Path
from typing import Any

import msgpack
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as some

from safedpa.bus import TOPICS, Answer, Message, Request, RosterEntry, decode, encode
from safedpa.bus.messages.codec import LARGEST_BYTES
from safedpa.bus.messages.messages import LARGEST_NUMBER
from safedpa.errors import MessageError

SAMPLES = Path(__file__).parent / "samples"

numbers = some.floats(-LARGEST_NUMBER, LARGEST_NUMBER)
vectors = some.lists(numbers, max_size=8).map(tuple)
BY_TYPE: dict[str, some.SearchStrategy[Any]] = {
    "Count": some.integers(0, 2**63),
    "Number": numbers,
    "Positive": some.floats(1e-6, LARGEST_NUMBER),
    "bool": some.booleans(),
    "str": some.text(max_size=40),
    "Vector": vectors,
    "Rows": some.lists(vectors, max_size=4).map(tuple),
    "tuple[str, ...]": some.lists(some.text(max_size=10), max_size=4).map(tuple),
}
BY_TYPE["tuple[RosterEntry, ...]"] = some.lists(
    some.builds(RosterEntry, **{f.name: BY_TYPE[str(f.type)] for f in dataclasses.fields(RosterEntry)}), max_size=3
).map(tuple)
BEYOND = math.nextafter(LARGEST_NUMBER, math.inf)
WRONG: dict[str, list[Any]] = {
    "Count": [None, "1", 1.0, True, -1, [1]],
    "Number": [None, "1.0", b"1", True, math.nan, math.inf, -math.inf, 1e300, BEYOND, -BEYOND, [1.0]],
    "Positive": [None, 0.0, -0.0, -1e-9, 0, math.nan, math.inf, BEYOND, True],
    "bool": [None, 0, 1, "true"],
    "str": [None, 1, b"bytes", ["text"]],
    "Vector": [None, 1.0, "12", {"0": 1.0}, [math.nan], [0.0, math.inf], [0.5, "1"], [0.5, True, 0.5],
               [True, 0.5], [0.5, [1.0]], [0.5, None], [BEYOND]],
    "Rows": [None, 1.0, [1.0], [[math.nan]], [[0.0], 1.0], [["1"]], [[0.5], [-BEYOND]], [[0.5], [True]]],
    "tuple[str, ...]": [None, "text", [1], [None], [b"x"]],
    "tuple[RosterEntry, ...]": [None, "r1", ["r1"], [{"kind": 1, "name": "r1"}]],
}  # fmt: skip
KINDS = [topic.message for topic in TOPICS.values()]
FIELDS = [(kind, field) for kind in KINDS for field in dataclasses.fields(kind)]


def messages(kind: type[Message]) -> some.SearchStrategy[Message]:
    return some.builds(kind, **{field.name: BY_TYPE[str(field.type)] for field in dataclasses.fields(kind)})


def table_of(message: Message) -> dict[str, Any]:
    return dataclasses.asdict(message)


@given(some.one_of([messages(kind) for kind in KINDS]))
def test_every_message_comes_back_as_it_was_sent(message: Message) -> None:
    assert decode(type(message), encode(message)) == message


@given(some.binary(max_size=300), some.sampled_from(KINDS))
def test_random_bytes_are_refused(payload: bytes, kind: type[Message]) -> None:
    with pytest.raises(MessageError, match=kind.__name__):
        decode(kind, payload)


@given(some.data(), some.sampled_from(KINDS))
def test_a_flipped_byte_is_refused_or_yields_a_message(data: some.DataObject, kind: type[Message]) -> None:
    payload = bytearray(encode(data.draw(messages(kind))))
    payload[data.draw(some.integers(0, len(payload) - 1))] ^= data.draw(some.integers(1, 255))
    try:
        message = decode(kind, bytes(payload))
    except MessageError:
        return
    assert decode(kind, encode(message)) == message


def test_numbers_of_numpy_are_sent_as_numbers(samples: dict[str, Message]) -> None:
    message = samples["action"]
    values = tuple(np.array([0.25, -0.5]))
    assert encode(dataclasses.replace(message, values=values)) == encode(
        dataclasses.replace(message, values=(0.25, -0.5))
    )


@pytest.mark.parametrize(("kind", "field"), FIELDS, ids=lambda item: getattr(item, "name", None) or item.__name__)
def test_wrong_values_are_refused_by_the_name_of_the_field(kind, field, samples):
    good = table_of(next(message for message in samples.values() if type(message) is kind))
    for wrong in WRONG[str(field.type)]:
        with pytest.raises(MessageError, match=rf"^{kind.__name__}\.{field.name}(\[[.\d]+\](\.kind)?)*: Expected "):
            decode(kind, msgpack.packb({**good, field.name: wrong}))


def test_values_just_within_the_limits_are_taken(samples: dict[str, Message]) -> None:
    taken: dict[str, tuple[Any, ...]] = {
        "tick": (0, 1, 2**40), "robot_time": (0.0, -5.0, LARGEST_NUMBER, -LARGEST_NUMBER, 3, 5e-324),
        "period": (5e-324, LARGEST_NUMBER, 1), "lockstep": (True, False), "applied_by": ("", "ä\n"),
        "values": ((), (1.0, -LARGEST_NUMBER), (1, 2.5)), "obstacles": ((), ((),), ((1.0, 2.0, 0.5), (1, 2, 3))),
    }  # fmt: skip
    good = table_of(samples["state"])
    for name, values in taken.items():
        for value in values:
            assert getattr(decode(type(samples["state"]), msgpack.packb({**good, name: value})), name) == value


@pytest.mark.parametrize(("kind", "field"), FIELDS, ids=lambda item: getattr(item, "name", None) or item.__name__)
def test_a_missing_field_is_refused_unless_it_has_a_default(kind, field, samples):
    table = table_of(next(message for message in samples.values() if type(message) is kind))
    del table[field.name]
    if field.default is dataclasses.MISSING:
        with pytest.raises(MessageError, match=rf"{kind.__name__}: .* missing required field `{field.name}`"):
            decode(kind, msgpack.packb(table))
    else:
        assert getattr(decode(kind, msgpack.packb(table)), field.name) == field.default


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (b"", "truncated"),
        (b"\xc1", "malformed"),
        (msgpack.packb([1, 2, 3]), "Expected `object`"),
        (msgpack.packb(None), "Expected `object`"),
        (msgpack.packb({1: 2}), "Expected `str`"),
        (b"\x81\xa1\xff\x01", "missing"),
        (b"\x91" * 5000, "Expected `object`"),
    ],
)
def test_a_payload_that_is_no_map_of_fields_is_refused(kind: type[Message], payload: bytes, reason: str) -> None:
    with pytest.raises(MessageError, match=reason):
        decode(kind, payload)


@pytest.mark.parametrize("kind", LARGEST_BYTES)
def test_a_payload_that_is_too_large_is_refused_unread(kind: type[Message]) -> None:
    with pytest.raises(MessageError, match=rf"{kind.__name__}: got \d+ bytes, wanted at most"):
        decode(kind, b"\xc1" * (LARGEST_BYTES[kind] + 1))
    with pytest.raises(MessageError, match="malformed"):
        decode(kind, b"\xc1")


def test_a_question_is_short_and_an_answer_holds_two_models_with_their_margins() -> None:
    assert (LARGEST_BYTES[Request], LARGEST_BYTES[Answer]) == (4_096, 8_388_608)
    filled = Request(do="accept", who="x" * 4_000)
    left = LARGEST_BYTES[Request] - len(encode(filled))
    assert decode(Request, encode(dataclasses.replace(filled, who="x" * (4_000 + left)))).do == "accept"
    with pytest.raises(MessageError, match="got 4097 bytes, wanted at most 4096"):
        decode(Request, encode(dataclasses.replace(filled, who="x" * (4_001 + left))))


@pytest.mark.parametrize("number", [-LARGEST_NUMBER, LARGEST_NUMBER, int(LARGEST_NUMBER), -int(LARGEST_NUMBER), 1, 0])
def test_the_largest_number_is_carried_as_a_float(number, samples):
    kind, good = TOPICS["action"].message, table_of(samples["action"])
    for values in ([number], [number, 0.5], [0.5, number]):
        message = decode(kind, msgpack.packb({**good, "values": values, "robot_time": number}))
        assert message.values == tuple(map(float, values))
        assert {type(value) for value in (*message.values, message.robot_time)} == {float}


def test_requests_and_answers_come_back_as_they_were_sent() -> None:
    request = Request(do="accept", effect="towed_load", model="0123456789ab", finding=2, who="engineer")
    answer = Answer(ok=True, sentence="change 3 is offered", change=3, fingerprint="0123456789ab", from_tick=7)
    assert decode(Request, encode(request)) == request
    assert decode(Answer, encode(answer)) == answer
    with pytest.raises(MessageError, match=r"Request\.finding: Expected `int` >= 0"):
        decode(Request, msgpack.packb({"do": "accept", "finding": -1}))


def test_fields_that_a_newer_program_added_are_ignored(samples: dict[str, Message]) -> None:
    for message in samples.values():
        payload = msgpack.packb({**table_of(message), "added_later": [1, {"any": "thing"}]})
        assert decode(type(message), payload) == message


@pytest.mark.parametrize("path", sorted(SAMPLES.glob("*.v2.msgpack")), ids=lambda path: path.stem)
def test_messages_of_version_1_are_understood_for_ever(path: Path, samples: dict[str, Message]) -> None:
    name = path.name.split(".")[0]
    assert decode(TOPICS[name].message, path.read_bytes()) == samples[name]


def test_there_is_a_stored_sample_of_every_topic() -> None:
    assert {path.name.split(".")[0] for path in SAMPLES.glob("*.v2.msgpack")} == set(TOPICS)
