"""What an intake opens: bundles of its own topic, fleet and service that are no larger than a message may be."""

from collections.abc import Callable

import pytest

from safedpa.bus import HEALTH, STATE, Inbox, Topic
from safedpa.bus.messages.codec import pack_bundle
from safedpa.bus.messages.topics import BUNDLE
from safedpa.bus.transport.inbox import InboxReceiver, RejectedMessage


def intake(topic: Topic = STATE, wanted: str = "*", serves: Callable[[str], bool] | None = None) -> InboxReceiver:
    return InboxReceiver(Inbox(), topic, "f", wanted, serves, all_of_them=False)


def opened(by: InboxReceiver, key: str, payload: bytes) -> list[tuple[str, bytes]]:
    return [(shared.key, shared.payload) for shared in by.opened(key, payload)]


def bundle_of(size: int) -> bytes:
    """As many bytes, in two messages."""
    rest = size - len(pack_bundle([("a", bytes(300)), ("b", bytes(300))]))
    return pack_bundle([("a", bytes(300)), ("b", bytes(300 + rest))])


@pytest.mark.parametrize(("more", "count"), [(0, 2), (1, 1)])
def test_a_bundle_has_as_many_bytes_as_a_message_may_have_and_no_more(more: int, count: int) -> None:
    payload = bundle_of(STATE.largest_bytes + more)
    assert len(payload) == STATE.largest_bytes + more
    key = f"safedpa/f/{BUNDLE}/state"
    found = opened(intake(), key, payload)
    assert len(found) == count
    assert [name for name, _ in found] == ([key] if more else ["safedpa/f/a/state", "safedpa/f/b/state"])


@pytest.mark.parametrize("key", ["+/state/x", "+/states", "+/state/", "+/*", "+/**", "*/state"])
def test_a_bundle_under_another_key_is_handed_on_as_it_came_and_refused_there(key: str) -> None:
    key, payload, inbox = f"safedpa/f/{key}", pack_bundle([("a", b"1"), ("b", b"2")]), Inbox()
    by = InboxReceiver(inbox, STATE, "f", "*", None, all_of_them=False)
    assert opened(by, key, payload) == [(key, payload)]
    by(key, payload)
    assert [type(item) for item in inbox.take(0.0)] == [RejectedMessage]


def test_a_bundle_of_a_service_is_opened_under_its_name() -> None:
    found = opened(intake(HEALTH), f"safedpa/f/{BUNDLE}/health/policy", pack_bundle([("a", b"1"), ("b", b"2")]))
    assert found == [("safedpa/f/a/health/policy", b"1"), ("safedpa/f/b/health/policy", b"2")]


@pytest.mark.parametrize(
    ("wanted", "serves", "names"),
    [("*", None, "abc"), ("b", None, "b"), ("*", "ac", "ac"), ("b", "ac", ""), ("d", None, "")],
)
def test_out_of_a_bundle_come_those_that_are_wanted_and_served(wanted: str, serves: str | None, names: str) -> None:
    own = intake(wanted=wanted, serves=None if serves is None else serves.__contains__)
    payload = pack_bundle([(name, name.encode()) for name in "abc"])
    assert opened(own, f"safedpa/f/{BUNDLE}/state", payload) == [
        (f"safedpa/f/{name}/state", name.encode()) for name in names
    ]


@pytest.mark.parametrize(("serves", "comes"), [(None, True), ("a", True), ("b", False)])
def test_what_comes_alone_comes_where_its_robot_is_served(serves: str | None, comes: bool) -> None:
    own = intake(serves=None if serves is None else serves.__contains__)
    assert opened(own, "safedpa/f/a/state", b"1") == ([("safedpa/f/a/state", b"1")] if comes else [])


def test_two_ask_for_the_same_where_topic_fleet_robot_and_the_robots_that_they_serve_agree() -> None:
    def serves(name: str) -> bool:
        return name == "a"

    usual = intake(serves=serves)
    assert usual.asks_as(intake(serves=serves))
    others = [
        intake(), intake(HEALTH, serves=serves), intake(wanted="a", serves=serves), intake(serves=lambda _: True),
        InboxReceiver(Inbox(), STATE, "g", "*", serves, all_of_them=False),
    ]  # fmt: skip
    assert not [other for other in others if usual.asks_as(other)]


def test_a_message_of_every_service_is_refused_once_and_under_no_robots_name() -> None:
    """As Zenoh delivers what was put under a wildcard; each robot would count a refusal that it did not bring about."""
    key, payload = f"safedpa/f/{BUNDLE}/health/*", pack_bundle([("a", b"1"), ("b", b"2")])
    inbox = Inbox()
    by = InboxReceiver(inbox, HEALTH, "f", "*", None, all_of_them=False)
    assert opened(by, key, payload) == [(key, payload)]
    by(key, payload)
    (refused,) = inbox.take(0.0)
    assert isinstance(refused, RejectedMessage)
    assert refused.robot == ""
