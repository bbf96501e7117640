"""Messages about many robots that travel as one arrive as if each came alone, and nothing else gets in with them."""

from typing import Any

import msgpack
import pytest
from hypothesis import example, given
from hypothesis import strategies as some

from safedpa.bus import (
    ACTION,
    LATENT,
    STATE,
    TOPICS,
    VERDICT,
    Bus,
    MemoryBroker,
    MemoryTransport,
    Message,
    ReceivedMessage,
    RejectedMessage,
    Topic,
    encode,
    topic_of,
)
from safedpa.bus.messages.codec import pack_bundle, split_into_bundles, unpack_bundle
from safedpa.bus.messages.topics import BUNDLE, NO_ROBOT
from safedpa.bus.security.access_control import ROBOT, ROLES, access_control, check_names, may_write
from safedpa.errors import InputError, MessageError

entries = some.lists(some.tuples(some.text(max_size=8), some.binary(max_size=40)), max_size=300)


class Wire:
    """What goes over the bus ``f``, as bytes."""

    def __init__(self) -> None:
        self.broker = MemoryBroker()
        self.seen: list[tuple[str, bytes]] = []
        for last in ("*", "*/*"):
            MemoryTransport(self.broker).subscribe(f"safedpa/f/{last}/*", lambda *sample: self.seen.append(sample))

    def bus(self, **options: Any) -> Bus:
        return Bus(MemoryTransport(self.broker), "f", **options)

    def put(self, key: str, payload: bytes) -> None:
        MemoryTransport(self.broker).put(key, payload, never_drop=False)


def sent_together(wire: Wire, topic: Topic, message: Message, robots: tuple[str, ...], service: str = "") -> None:
    bus = wire.bus()
    bus.hold()
    for robot in robots:
        bus.publish(topic, robot, message, service)
    bus.flush()


@given(entries)
def test_parts_hold_everything_in_order_and_each_fits(given_entries: list[tuple[str, bytes]]) -> None:
    found = [unpack_bundle(pack_bundle(part)) for part in split_into_bundles(given_entries)]
    assert [entry for part in found for entry in part] == given_entries
    assert all(part for part in found)
    assert all(len(pack_bundle(part)) <= STATE.largest_bytes for part in split_into_bundles([("r", bytes(2000))] * 300))


KIB = 1024


@pytest.mark.parametrize(
    ("sizes", "counts"),
    [
        ([], []),
        ([10] * 600, [256, 256, 88]),
        ([24 * KIB - 1] * 4, [2, 2]),  # and a letter of the name each: 48 KiB together
        ([24 * KIB] * 4, [1, 1, 1, 1]),
        ([10, 50 * KIB, 10, 10], [1, 1, 2]),  # a message that is too large travels alone
    ],
    ids=["none", "600", "48 KiB", "more", "large"],
)
def test_a_bundle_holds_at_most_256_messages_and_48_kib(sizes: list[int], counts: list[int]) -> None:
    assert [len(part) for part in split_into_bundles([("r", bytes(size)) for size in sizes])] == counts


@given(some.binary(max_size=200))
@example(pack_bundle([("r", b"x"), ("s", b"")]))
def test_a_payload_that_is_no_bundle_is_refused(payload: bytes) -> None:
    try:
        found = unpack_bundle(payload)
    except MessageError:
        return
    assert unpack_bundle(pack_bundle(found)) == found


def test_more_than_one_message_travel_as_one_and_arrive_one_by_one(samples: dict[str, Message]) -> None:
    wire = Wire()
    inbox, named = wire.bus().inbox((STATE,)), wire.bus().inbox((STATE,), "b")
    sent_together(wire, STATE, samples["state"], ("a", "b", "c"))
    assert [key for key, _ in wire.seen] == [f"safedpa/f/{BUNDLE}/state"]
    received = inbox.take(0.0)
    assert [
        (item.robot, item.key, item.message, item.bundled) for item in received if isinstance(item, ReceivedMessage)
    ] == [(robot, f"safedpa/f/{robot}/state", samples["state"], True) for robot in ("a", "b", "c")]
    assert [item.robot for item in named.take(0.0)] == ["b"]


def test_one_message_travels_as_ever(samples: dict[str, Message]) -> None:
    wire = Wire()
    inbox = wire.bus().inbox((STATE,))
    sent_together(wire, STATE, samples["state"], ("a",))
    assert wire.seen == [("safedpa/f/a/state", encode(samples["state"]))]
    assert [item.bundled for item in inbox.take(0.0) if isinstance(item, ReceivedMessage)] == [False]


def test_of_topics_that_drop_nothing_every_message_of_a_bundle_is_kept(samples: dict[str, Message]) -> None:
    wire = Wire()
    inbox = wire.bus().inbox((VERDICT,))
    for _ in range(3):
        sent_together(wire, VERDICT, samples["verdict"], ("a", "b"))
    assert [item.robot for item in inbox.take(0.0)] == ["a", "b"] * 3


def test_a_robot_that_reads_its_own_messages_only_hears_no_bundle(samples: dict[str, Message]) -> None:
    wire = Wire()
    robot = wire.bus().inbox((ACTION,), "a", alone=True)
    sent_together(wire, ACTION, samples["action"], ("a", "b"))
    assert robot.take(0.0) == []


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"garbage",
        msgpack.packb({"a": b"x"}),
        msgpack.packb([["a"]]),
        msgpack.packb([["a", "text"]]),
        msgpack.packb([[1, b"x"]]),
        msgpack.packb([["a", b"x"]] * 257),
        msgpack.packb([["a/b", b"x"]]),
        msgpack.packb([["", b"x"]]),
        pack_bundle([("a", bytes(70_000))]),
    ],
)
def test_a_malformed_bundle_is_refused_once_and_delivers_no_message(payload: bytes) -> None:
    wire = Wire()
    inbox = wire.bus().inbox((STATE,))
    wire.put(f"safedpa/f/{BUNDLE}/state", payload)
    (refused,) = inbox.take(0.0)
    assert isinstance(refused, RejectedMessage)
    assert refused.robot == ""


@pytest.mark.parametrize("name", ["*", BUNDLE])
def test_no_robot_has_the_name_of_a_bundle_or_a_wildcard(name: str, samples: dict[str, Message]) -> None:
    wire = Wire()
    inbox = wire.bus().inbox((STATE,))
    wire.put(
        f"safedpa/f/{BUNDLE}/state", pack_bundle([(name, encode(samples["state"])), ("a", encode(samples["state"]))])
    )
    found = inbox.take(0.0)
    assert sorted(type(item).__name__ for item in found) == ["ReceivedMessage", "RejectedMessage"]
    with pytest.raises(InputError):
        topic_of(f"safedpa/f/{name}/state")
    with pytest.raises(InputError):
        check_names("f", (name,))


def test_garbage_of_one_robot_leaves_the_others_in_its_bundle_alone(samples: dict[str, Message]) -> None:
    wire = Wire()
    inbox = wire.bus().inbox((STATE,))
    good = encode(samples["state"])
    wire.put(f"safedpa/f/{BUNDLE}/state", pack_bundle([("a", good), ("b", b"garbage"), ("c", good)]))
    assert [(item.robot, type(item)) for item in inbox.take(0.0)] == [
        ("a", ReceivedMessage),
        ("b", RejectedMessage),
        ("c", ReceivedMessage),
    ]


def test_only_roles_that_serve_the_whole_fleet_may_send_bundles_and_no_robot_may_read_one() -> None:
    for role in ROLES.values():
        for topic in TOPICS.values():
            allowed = may_write(role, topic, BUNDLE)
            assert not allowed or (topic.bundles and may_write(role, topic, NO_ROBOT if topic.per_service else "r"))
    table = access_control("f", ("r1", "r2"))
    keys = {rule["id"]: rule["key_exprs"] for rule in table["rules"]}
    assert f"safedpa/f/{BUNDLE}/latent" in keys["adaptation puts"]
    assert f"safedpa/f/{BUNDLE}/action" in keys["safety_filter puts"]
    assert f"safedpa/f/{BUNDLE}/setup/adaptation" not in keys["adaptation puts"]
    of_robots = [key for name, found in keys.items() if name.startswith(f"{ROBOT}.") for key in found]
    assert of_robots
    assert not [key for key in of_robots if f"/{BUNDLE}/" in key]
    assert not [key for key in keys["robot.r1 reads"] if "*" in key.split("/")[2]]


def test_a_router_that_is_linked_for_some_robots_may_bring_no_bundle() -> None:
    table = access_control("f", ("r1",), {"router.hall": ("r1",)})
    keys = {rule["id"]: rule["key_exprs"] for rule in table["rules"]}
    brought = keys["router.hall brings"]
    assert brought
    assert not [key for key in brought if BUNDLE in key]
    assert {key.split("/")[2] for key in brought} == {"r1", NO_ROBOT}
    assert LATENT.bundles
