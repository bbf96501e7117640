"""An inbox holds so much and no more, and a sender that floods it loses its own messages."""

import sys
import tracemalloc
from collections import defaultdict
from itertools import count
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.bus import Inbox, RejectedMessage
from safedpa.bus.messages.topics import TOPICS
from safedpa.bus.transport.inbox import SharedPayload
from safedpa.errors import MessageError

MEBIBYTE = 1024 * 1024


class Reader:
    """Reads payloads as no message, and records them."""

    def __init__(self) -> None:
        self.read: list[bytes] = []

    def __call__(self, _kind: type[Any], payload: bytes) -> Any:
        self.read.append(payload)
        raise MessageError("no message")


def test_keys_beyond_sixteen_thousand_are_dropped_and_known_ones_get_their_newest_message() -> None:
    reader = Reader()
    inbox = Inbox(decode=reader)
    for index in range(20_000):
        inbox.keep_latest(f"safedpa/f/r{index}/state", b"1")
    inbox.keep_latest("safedpa/f/r0/state", b"2")
    assert 10_000 <= len(inbox.take(0.0)) == 20_000 - inbox.dropped <= 17_000
    assert reader.read.count(b"2") == 1


def test_a_payload_that_is_too_large_is_refused_and_not_kept_until_then() -> None:
    tracemalloc.start()
    try:
        inbox = Inbox()
        inbox.keep_latest("safedpa/f/a/state", bytes(10_000_000))
        inbox.keep_all("safedpa/f/a/model", bytes(10_000_000))
        assert tracemalloc.get_traced_memory()[0] < 5_000_000
    finally:
        tracemalloc.stop()
    taken = inbox.take(0.0)
    assert [type(item) for item in taken] == [RejectedMessage, RejectedMessage]
    assert all("wanted at most" in item.reason for item in taken if isinstance(item, RejectedMessage))


@settings(max_examples=60, deadline=None)
@given(sent=st.lists(st.tuples(st.sampled_from("abc"), st.integers(1, 50)), max_size=60), longest=st.integers(1, 10))
def test_the_key_that_has_most_waiting_loses_its_oldest(sent: list[tuple[str, int]], longest: int) -> None:
    reader, clock = Reader(), count()
    inbox = Inbox(longest_queue=longest, decode=reader, clock=lambda: float(next(clock)))
    waiting: dict[str, list[int]] = {}
    dropped = 0
    for robot, size in sent:
        inbox.keep_all(f"safedpa/f/{robot}/verdict", robot.encode() * size)
        waiting.setdefault(robot, []).append(size)
        if sum(map(len, waiting.values())) > longest:
            most = max(waiting, key=lambda name: sum(waiting[name]))
            waiting[most].pop(0)
            waiting = {name: sizes for name, sizes in waiting.items() if sizes}
            dropped += 1
    assert inbox.dropped == dropped
    inbox.take(0.0)
    retained = defaultdict[str, list[int]](list)
    for payload in reader.read:
        retained[chr(payload[0])].append(len(payload))
    assert retained == waiting


@pytest.mark.parametrize(("sent", "retained"), [(60, 60), (64, 64), (65, 64), (80, 64)])
def test_no_more_than_256_mebibytes_wait_and_the_oldest_go(sent: int, retained: int) -> None:
    """Messages of 4 MiB, the largest; two of them are sent in turn, so that they need no memory here."""
    reader = Reader()
    inbox, large = Inbox(decode=reader), (bytes(4 * MEBIBYTE), bytes([1]) * (4 * MEBIBYTE))
    for index in range(sent):
        inbox.keep_all("safedpa/f/r/model", large[index < sent - retained])
    assert inbox.dropped == sent - retained
    assert len(inbox.take(0.0)) == retained
    assert all(payload is large[0] for payload in reader.read)


def test_of_each_key_at_most_so_many_are_taken_in_one_turn() -> None:
    inbox = Inbox()
    for index in range(30):
        inbox.keep_all("safedpa/f/flood/verdict", bytes(index + 1))
    inbox.keep_all("safedpa/f/good/verdict", b"1")
    first = inbox.take(0.0, 4)
    assert [item.key.split("/")[2] for item in first] == ["flood"] * 4 + ["good"]
    assert len(inbox.take(0.0)) == 26
    assert not inbox.waiting


@pytest.mark.parametrize(("over", "reads"), [(-1, 1), (0, 1), (1, 2), (100, 2)])
def test_a_message_that_several_inboxes_hold_is_read_once_and_the_whole_of_one_too_large_is_kept_by_none(over, reads):
    largest = max(topic.largest_bytes for topic in TOPICS.values() if topic.delivery == "latest")
    reader, payload = Reader(), bytes(largest + over)
    inboxes, unheld = (Inbox(decode=reader), Inbox(decode=reader)), sys.getrefcount(payload)
    payloads = [SharedPayload("safedpa/f/a/state", payload)]
    for inbox in inboxes:
        inbox.add_payloads(payloads, all_of_them=False)
    payloads.clear()
    assert (sys.getrefcount(payload) > unheld) is (over <= 1), "one byte more is kept to see that it is too large"
    for inbox in inboxes:
        assert [type(item) for item in inbox.take(0.0)] == [RejectedMessage]
    assert [len(read) for read in reader.read] == [min(largest + over, largest + 1)] * reads
