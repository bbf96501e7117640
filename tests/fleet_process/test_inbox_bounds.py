"""An inbox holds so much and no more, and who floods it loses its own."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from safedpa.bus import Inbox, Refused
from safedpa.bus.transport import inbox as module
from safedpa.bus.transport.inbox import Parcel
from safedpa.bus.wire.topics import TOPICS
from safedpa.errors import MessageError


def test_different_keys_beyond_the_most_are_dropped_and_known_ones_kept() -> None:
    inbox = Inbox()
    for index in range(module._MOST_KEYS + 50):
        inbox.keep_latest(f"safedpa/f/r{index}/state", b"1")
    inbox.keep_latest("safedpa/f/r0/state", b"2")
    assert inbox.dropped == 50
    assert len(inbox._latest) == module._MOST_KEYS
    assert inbox._latest["safedpa/f/r0/state"][1] == b"2"


def test_of_a_payload_that_is_too_large_only_so_much_is_kept_that_it_is_refused() -> None:
    inbox = Inbox()
    inbox.keep_latest("safedpa/f/a/state", bytes(10_000_000))
    inbox.keep_all("safedpa/f/a/model", bytes(10_000_000))
    assert len(inbox._latest["safedpa/f/a/state"][1]) == 65_537
    assert inbox._queued_bytes == 4 * 1024 * 1024 + 1
    taken = inbox.take(0.0)
    assert [type(item) for item in taken] == [Refused, Refused]
    assert all("wanted at most" in item.reason for item in taken if isinstance(item, Refused))


@settings(max_examples=60, deadline=None)
@given(sent=st.lists(st.tuples(st.sampled_from("abc"), st.integers(1, 50)), max_size=60), longest=st.integers(1, 10))
def test_the_key_that_has_most_waiting_loses_its_oldest(sent: list[tuple[str, int]], longest: int) -> None:
    inbox = Inbox(longest_queue=longest)
    waiting: dict[str, list[int]] = {}
    dropped = 0
    for robot, size in sent:
        inbox.keep_all(f"safedpa/f/{robot}/verdict", bytes(size))
        waiting.setdefault(robot, []).append(size)
        if sum(map(len, waiting.values())) > longest:
            most = max(waiting, key=lambda name: sum(waiting[name]))
            waiting[most].pop(0)
            waiting = {name: sizes for name, sizes in waiting.items() if sizes} if not waiting[most] else waiting
            dropped += 1
    assert inbox.dropped == dropped
    kept = {key.split("/")[2]: [len(payload) for payload, _ in queue.messages] for key, queue in inbox._queues.items()}
    assert kept == {name: sizes for name, sizes in waiting.items() if sizes}
    assert inbox._queued == sum(map(len, kept.values()))
    assert inbox._queued_bytes == sum(map(sum, kept.values()))


@pytest.mark.parametrize(("most", "kept"), [(100, 10), (99, 9), (35, 3), (10, 1), (9, 0)])
def test_what_waits_has_no_more_bytes_than_fit(most: int, kept: int, monkeypatch: pytest.MonkeyPatch) -> None:
    """Ten messages of ten bytes: the oldest go, until the rest has room."""
    monkeypatch.setattr(module, "_LARGEST_QUEUE_BYTES", most)
    inbox = Inbox()
    for index in range(10):
        inbox.keep_all("safedpa/f/r/verdict", bytes([index] * 10))
    assert inbox.dropped == 10 - kept
    queues = [payload for queue in inbox._queues.values() for payload, _ in queue.messages]
    assert queues == [bytes([index] * 10) for index in range(10 - kept, 10)]
    assert inbox._queued_bytes == 10 * kept


def test_of_each_key_at_most_so_many_are_taken_in_one_turn() -> None:
    inbox = Inbox()
    for index in range(30):
        inbox.keep_all("safedpa/f/flood/verdict", bytes(index + 1))
    inbox.keep_all("safedpa/f/good/verdict", b"1")
    first = inbox.take(0.0, 4)
    assert [item.key.split("/")[2] for item in first] == ["flood"] * 4 + ["good"]
    assert len(inbox.take(0.0)) == 26
    assert not inbox.waiting


@pytest.mark.parametrize(("over", "read"), [(-1, 1), (0, 1), (1, 2)])
def test_a_message_that_several_inboxes_hold_is_read_once_and_one_too_large_is_kept_by_none(
    over: int, read: int
) -> None:
    """What is too large is cut for each inbox: the whole of it must not stay for the sake of what they share."""
    decoded: list[int] = []

    def decode(_: type[Any], payload: bytes) -> Any:
        decoded.append(len(payload))
        raise MessageError("no message")

    largest = max(topic.largest_bytes for topic in TOPICS.values() if topic.delivery == "latest")
    parcel, inboxes = Parcel("safedpa/f/a/state", bytes(largest + over)), (Inbox(decode=decode), Inbox(decode=decode))
    for inbox in inboxes:
        inbox.keep_parcels([parcel], all_of_them=False)
    held = [
        part for inbox in inboxes for _, payload, _, kept in inbox._latest.values() for part in (payload, kept.payload)
    ]
    assert {len(part) for part in held} == ({largest + over} if over <= 0 else {largest + 1, 0})
    for inbox in inboxes:
        assert [type(item) for item in inbox.take(0.0)] == [Refused]
    assert decoded == [largest + over] * read
