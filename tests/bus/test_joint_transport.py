"""Several services of one process over one session."""

from collections.abc import Callable, Sequence
from typing import Any

import pytest
from tests.bus.fleet import Heard

from safedpa.bus import (
    LATENT,
    STATE,
    Bus,
    MemoryBroker,
    MemoryTransport,
    Message,
    ReceivedMessage,
    RejectedMessage,
    decode,
    encode,
)
from safedpa.bus.messages.codec import pack_bundle
from safedpa.bus.messages.topics import BUNDLE
from safedpa.bus.transport.memory import JointTransport
from safedpa.errors import BusError

INSIDE = frozenset(["latent"])


def test_messages_between_services_are_heard_inside_once_and_outside() -> None:
    broker = MemoryBroker()
    joint, outside = JointTransport(MemoryTransport(broker), INSIDE), Heard()
    MemoryTransport(broker).subscribe("safedpa/f/*/latent", outside)
    one, every, other = Heard(), Heard(), Heard()
    joint.subscribe("safedpa/f/r/latent", one)
    joint.subscribe("safedpa/f/*/latent", every)
    joint.subscribe("safedpa/f/q/latent", other)
    joint.put("safedpa/f/r/latent", b"x", never_drop=False)
    sample = ("safedpa/f/r/latent", b"x")
    assert [one.samples, every.samples, other.samples, outside.samples] == [[sample], [sample], [], [sample]]


def test_a_stranger_that_speaks_as_a_service_of_this_process_is_not_heard() -> None:
    broker = MemoryBroker()
    joint, heard = JointTransport(MemoryTransport(broker), INSIDE), Heard()
    joint.subscribe("safedpa/f/*/latent", heard)
    joint.subscribe("safedpa/f/*/state", heard)
    stranger = MemoryTransport(broker)
    stranger.put("safedpa/f/r/latent", b"forged", never_drop=False)
    stranger.put("safedpa/f/r/state", b"state", never_drop=False)
    assert heard.samples == [("safedpa/f/r/state", b"state")]


def test_messages_under_odd_keys_do_no_harm() -> None:
    heard, broker = Heard(), MemoryBroker()
    JointTransport(MemoryTransport(broker), INSIDE).subscribe("safedpa/f/*/state", heard)
    ((_, _, hand_on),) = broker.subscribers
    for key in ("safedpa/**", "**", ""):  # Zenoh lets a sender use wildcards, and a subscriber sees them as they came
        hand_on(key, b"x")
    assert [key for key, _ in heard.samples] == ["safedpa/**", "**", ""]


def test_all_of_them_have_a_message_before_the_first_one_acts_on_it() -> None:
    broker = MemoryBroker()
    joint, order = JointTransport(MemoryTransport(broker), INSIDE), list[str]()
    for name in ("adaptation", "policy", "safety_filter"):
        joint.subscribe("safedpa/f/*/state", lambda _key, _payload, name=name: order.append(name))  # type: ignore[misc]
    MemoryTransport(broker).put("safedpa/f/r/state", b"x", never_drop=False)
    assert order == ["safety_filter", "policy", "adaptation"]


def test_everything_else_is_the_sessions() -> None:
    outer = MemoryTransport(MemoryBroker())
    joint = JointTransport(outer, INSIDE)
    joint.declare_alive("safedpa/f/-/alive/policy/1")
    joint.answer("safedpa/f/*/status", lambda _key, payload: payload + b"!")
    assert joint.alive("safedpa/f/-/alive/*/*") == ["safedpa/f/-/alive/policy/1"]
    assert joint.ask("safedpa/f/r/status", b"how", 1.0) == b"how!"
    answers: list[bytes | None] = []
    joint.ask_soon("safedpa/f/r/status", b"how", 1.0, answers.append)
    assert answers == [b"how!"]
    joint.close()
    with pytest.raises(BusError):
        joint.put("safedpa/f/r/latent", b"x", never_drop=False)


class Reading:
    """Decodes, and counts what."""

    def __init__(self) -> None:
        self.read: list[bytes] = []

    def __call__(self, kind: type[Any], payload: bytes) -> Any:
        self.read.append(payload)
        return decode(kind, payload)


def sent_to_several(services: int, entries: Sequence[tuple[str, bytes]], **options: Any):
    """What so many services of one process take of a bundle of states."""
    broker, reading = MemoryBroker(), Reading()
    joint = JointTransport(MemoryTransport(broker), INSIDE)
    inboxes = [Bus(joint, "f", reading, **options).inbox((STATE,)) for _ in range(services)]
    MemoryTransport(broker).put(f"safedpa/f/{BUNDLE}/state", pack_bundle(entries), never_drop=False)
    return reading, [inbox.take(0.0) for inbox in inboxes]


def test_a_message_is_read_once_for_all_services_of_a_process(samples: dict[str, Message]) -> None:
    state = encode(samples["state"])
    garbage, large = b"garbage", bytes(70_000)
    reading, taken = sent_to_several(3, [("a", state), ("b", garbage), ("c", state)])
    assert reading.read == [state, garbage, state]
    assert taken[0] == taken[1] == taken[2]
    assert [type(item) for item in taken[0]] == [ReceivedMessage, RejectedMessage, ReceivedMessage]
    assert taken[0][0] is taken[1][0]
    _, alone = sent_to_several(1, [("a", state), ("b", garbage), ("c", state)])
    without_time = [item._replace(at=0.0) if isinstance(item, ReceivedMessage) else item for item in taken[0]]
    assert without_time == [item._replace(at=0.0) if isinstance(item, ReceivedMessage) else item for item in alone[0]]
    _, refused = sent_to_several(2, [("a", large)])
    assert [[type(item) for item in items] for items in refused] == [[RejectedMessage], [RejectedMessage]]


def test_a_message_that_is_replaced_before_it_is_taken_is_never_read(samples: dict[str, Message]) -> None:
    broker, reading = MemoryBroker(), Reading()
    joint = JointTransport(MemoryTransport(broker), INSIDE)
    inboxes = [Bus(joint, "f", reading).inbox((STATE,)) for _ in range(2)]
    newest = encode(samples["state"])
    for payload in (b"1", b"2", b"3", newest):
        MemoryTransport(broker).put("safedpa/f/a/state", payload, never_drop=False)
    assert [len(inbox.take(0.0)) for inbox in inboxes] == [1, 1]
    assert reading.read == [newest]


def test_a_service_that_asks_for_other_robots_gets_its_own(samples: dict[str, Message]) -> None:
    broker = MemoryBroker()
    joint = JointTransport(MemoryTransport(broker), INSIDE)
    asked: tuple[Callable[[str], bool] | None, ...] = (None, lambda robot: robot == "a", lambda robot: robot == "b")
    inboxes = [Bus(joint, "f", serves=serves).inbox((STATE,)) for serves in asked]
    state = encode(samples["state"])
    outside = MemoryTransport(broker)
    outside.put(f"safedpa/f/{BUNDLE}/state", pack_bundle([("a", state), ("b", state)]), never_drop=False)
    assert [[item.robot for item in inbox.take(0.0)] for inbox in inboxes] == [["a", "b"], ["a"], ["b"]]
    outside.put("safedpa/f/b/state", state, never_drop=False)
    assert [[item.robot for item in inbox.take(0.0)] for inbox in inboxes] == [["b"], [], ["b"]]


def test_inside_a_bundle_is_opened_once_too_and_what_comes_alone_stays_alone(samples: dict[str, Message]) -> None:
    reading = Reading()
    joint = JointTransport(MemoryTransport(MemoryBroker()), INSIDE)
    inboxes = [Bus(joint, "f", reading).inbox((LATENT,)) for _ in range(2)]
    sender = Bus(joint, "f")
    sender.hold()
    for robot in ("a", "b"):
        sender.publish(LATENT, robot, samples["latent"])
    sender.flush()
    taken = [inbox.take(0.0) for inbox in inboxes]
    assert [[(item.robot, item.bundled) for item in items if isinstance(item, ReceivedMessage)] for items in taken] == [
        [("a", True), ("b", True)]
    ] * 2
    assert len(reading.read) == 2
    sender.publish(LATENT, "a", samples["latent"])
    assert [item.bundled for inbox in inboxes for item in inbox.take(0.0) if isinstance(item, ReceivedMessage)] == [
        False
    ] * 2


def test_no_service_acts_before_every_service_has_the_message(samples: dict[str, Message]) -> None:
    broker = MemoryBroker()
    joint = JointTransport(MemoryTransport(broker), INSIDE)
    inboxes = [Bus(joint, "f").inbox((STATE,)) for _ in range(3)]
    seen: list[list[bool]] = []
    for inbox in inboxes:
        inbox.set_listener(lambda: seen.append([other.waiting for other in inboxes]))
    state = encode(samples["state"])
    outside = MemoryTransport(broker)
    outside.put("safedpa/f/a/state", state, never_drop=False)
    outside.put(f"safedpa/f/{BUNDLE}/state", pack_bundle([("a", state), ("b", state)]), never_drop=False)
    assert seen == [[True] * 3] * 6
