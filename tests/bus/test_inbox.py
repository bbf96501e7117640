"""What waits in an inbox, in which order, and what is lost."""

from __future__ import annotations

import itertools
import threading

from safedpa.bus import Inbox, Message, Received, Refused, encode


def ticks(items: list[Received | Refused]) -> list[int]:
    return [item.message.tick for item in items if isinstance(item, Received)]


def payloads(message: Message, count: int) -> list[bytes]:
    import dataclasses

    return [encode(dataclasses.replace(message, tick=tick)) for tick in range(count)]


def test_of_latest_topics_only_the_newest_per_key_waits(samples: dict[str, Message]) -> None:
    inbox = Inbox()
    for payload in payloads(samples["action"], 5):
        inbox.keep_latest("safedpa/f/a/action", payload)
    inbox.keep_latest("safedpa/f/b/action", encode(samples["action"]))
    taken = inbox.take(0.0)
    assert ticks(taken) == [4, 412]
    assert [item.robot for item in taken if isinstance(item, Received)] == ["a", "b"]
    assert inbox.take(0.0) == []


def test_of_other_topics_everything_waits_in_order(samples: dict[str, Message]) -> None:
    inbox = Inbox()
    for payload in payloads(samples["verdict"], 50):
        inbox.keep_all("safedpa/f/a/verdict", payload)
    assert ticks(inbox.take(0.0)) == list(range(50))


def test_both_kinds_come_out_oldest_first(samples: dict[str, Message]) -> None:
    clock = itertools.count()
    inbox = Inbox(clock=lambda: float(next(clock)))
    inbox.keep_all("safedpa/f/a/verdict", encode(samples["verdict"]))
    inbox.keep_latest("safedpa/f/a/action", encode(samples["action"]))
    inbox.keep_all("safedpa/f/b/verdict", encode(samples["verdict"]))
    inbox.keep_latest("safedpa/f/a/action", encode(samples["action"]))
    taken = inbox.take(0.0)
    assert [item.key for item in taken] == ["safedpa/f/a/verdict", "safedpa/f/b/verdict", "safedpa/f/a/action"]
    assert [item.at for item in taken if isinstance(item, Received)] == [0.0, 2.0, 3.0]


def test_beyond_its_length_the_queue_loses_the_oldest_and_counts_them(samples: dict[str, Message]) -> None:
    inbox = Inbox(longest_queue=3)
    for payload in payloads(samples["verdict"], 5):
        inbox.keep_all("safedpa/f/a/verdict", payload)
    assert ticks(inbox.take(0.0)) == [2, 3, 4]
    assert inbox.dropped == 2
    for payload in payloads(samples["verdict"], 4):
        inbox.keep_all("safedpa/f/a/verdict", payload)
    assert ticks(inbox.take(0.0)) == [1, 2, 3], "the length holds after a take as well"
    assert inbox.dropped == 3


def test_garbage_and_foreign_keys_come_out_as_refused(samples: dict[str, Message]) -> None:
    inbox = Inbox()
    inbox.keep_latest("safedpa/f/a/state", b"garbage")
    inbox.keep_latest("safedpa/f/*/state", encode(samples["state"]))
    inbox.keep_latest("safedpa/**", encode(samples["state"]))
    inbox.keep_latest("safedpa/f/a/wish", encode(samples["action"]))
    taken = inbox.take(0.0)
    assert [type(item) for item in taken] == [Refused] * 4
    reasons = [item.reason for item in taken if isinstance(item, Refused)]
    assert "msgpack" in reasons[0]
    assert "name '*'" in reasons[1]
    assert "WishMessage.controller: missing" in reasons[3]


def test_take_wakes_up_for_a_message_from_another_thread(samples: dict[str, Message]) -> None:
    inbox = Inbox()
    payload = encode(samples["action"])
    sender = threading.Timer(0.05, lambda: inbox.keep_latest("safedpa/f/a/action", payload))
    sender.start()
    assert len(inbox.take(30.0)) == 1
    sender.join()


def test_nothing_is_lost_between_many_threads(samples: dict[str, Message]) -> None:
    inbox, each, senders = Inbox(), 200, 4
    sent = payloads(samples["verdict"], each)

    def send(robot: str) -> None:
        for payload in sent:
            inbox.keep_all(f"safedpa/f/{robot}/verdict", payload)

    threads = [threading.Thread(target=send, args=(f"r{number}",)) for number in range(senders)]
    for thread in threads:
        thread.start()
    taken: list[Received | Refused] = []
    while len(taken) < each * senders:
        fresh = inbox.take(10.0)
        assert fresh, "a message was lost"
        taken += fresh
    for thread in threads:
        thread.join()
    for number in range(senders):
        own = [item for item in taken if isinstance(item, Received) and item.robot == f"r{number}"]
        assert ticks(list(own)) == list(range(each)), "in order per sender"
