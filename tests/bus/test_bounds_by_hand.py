"""How much may wait in an inbox: each topic's longest message whole, and no more bytes of all than are allowed."""

from __future__ import annotations

import pytest

from safedpa.bus.transport import inbox as module
from safedpa.bus.transport.inbox import Inbox
from safedpa.bus.wire.topics import TOPICS, Topic


@pytest.mark.parametrize("topic", TOPICS.values(), ids=list(TOPICS))
def test_the_longest_message_of_a_topic_waits_whole_and_a_longer_one_is_seen_to_be_longer(topic: Topic) -> None:
    """What is cut is refused when it is read: a model's document would never arrive."""
    inbox = Inbox()
    for more in (0, 1):
        payload = bytes(topic.largest_bytes + more)
        if topic.delivery == "latest":
            inbox.keep_latest("k", payload)
            kept = inbox._latest["k"][1]
        else:
            inbox.keep_all("k", payload)
            kept = inbox._queues["k"].messages[-1][0]
        assert len(kept) == topic.largest_bytes + more


@pytest.mark.parametrize(("bytes_each", "left", "dropped"), [(2, 5, 0), (3, 3, 2), (11, 0, 5)])
def test_no_more_bytes_wait_than_are_allowed_however_few_messages_they_are(
    bytes_each: int, left: int, dropped: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Five messages, of which ten bytes may wait: the oldest go."""
    monkeypatch.setattr(module, "_LARGEST_QUEUE_BYTES", 10)
    inbox = Inbox(longest_queue=100)
    for number in range(5):
        inbox.keep_all("k", bytes([number] * bytes_each))
    waiting = [payload[0] for queue in inbox._queues.values() for payload, _ in queue.messages]
    assert waiting == list(range(5 - left, 5))
    assert (inbox.dropped, inbox._queued_bytes) == (dropped, left * bytes_each)
