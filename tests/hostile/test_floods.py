"""Who floods with a valid key gets no more through than the fastest robot would send, and others are not held up."""

import time
from collections.abc import Callable

import pytest

from safedpa.bus import ACTION, HEALTH, NO_ROBOT, NOMINAL, ZenohSettings, ZenohTransport, key_of
from safedpa.bus.security.access_control import ROLES, rate_limits

pytestmark = [pytest.mark.processes, pytest.mark.slow, pytest.mark.usefixtures("links_outlive")]
_MOST = 4000.0
_ACTIONS = 20
_KNOCK = b"anybody there?"
_PATIENCE_SECONDS = 60.0
"""For what takes a second on an idle machine; without limits each action waits for seconds behind the flood."""


def knocked(sender: ZenohTransport, key: str, heard: Callable[[], bool]) -> None:
    """Sends under the key until a message is received, and waits a little, so that the flood meets empty queues."""
    deadline = time.monotonic() + _PATIENCE_SECONDS
    while not heard():
        assert time.monotonic() < deadline, f"no one hears {key}"
        sender.put(key, _KNOCK, never_drop=True)
        time.sleep(0.1)
    time.sleep(0.1)


def test_a_flood_ends_at_the_router(free_port: int) -> None:
    """Each action is sent when the one before has arrived: two that a busy machine holds up together reach the router
    within the same quarter of a millisecond, and the later one is passed over as a flood's would be."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    router = ZenohTransport(ZenohSettings("router", (endpoint,), rates=tuple(rate_limits("fleet", ("r1",)))))
    flooder, other, reader = (ZenohTransport(ZenohSettings("client", (), (endpoint,))) for _ in range(3))
    came: dict[str, list[bytes]] = {"nominal": [], "action": []}
    try:
        for topic, sender in ((NOMINAL, flooder), (ACTION, other)):
            key = key_of("fleet", "r1", topic)
            reader.subscribe(key, lambda _, payload, name=topic.name: came[name].append(payload))
            knocked(sender, key, lambda name=topic.name: bool(came[name]))  # type: ignore[misc]
            came[topic.name].clear()
        sent, regular = 0, 0
        began = due = time.monotonic()
        while len(came["action"]) < _ACTIONS and time.monotonic() < began + _PATIENCE_SECONDS:
            for _ in range(50):
                flooder.put(key_of("fleet", "r1", NOMINAL), b"x" * 100, never_drop=False)
            sent += 50
            if len(came["action"]) == regular < _ACTIONS and time.monotonic() >= due:
                other.put(key_of("fleet", "r1", ACTION), b"y", never_drop=True)  # a busy machine drops what may be
                regular, due = regular + 1, time.monotonic() + 0.05
        flooded = time.monotonic() - began
        time.sleep(0.5)
    finally:
        for transport in (flooder, other, reader, router):
            transport.close()
    assert sent > 3 * len(came["nominal"]), "no flood, or all of it came through"
    assert 0 < len(came["nominal"]) <= 1.1 * (flooded + 0.5) * _MOST
    assert len(came["action"]) == regular == _ACTIONS, "what others say is not held up"


def test_what_arrives_at_once_is_taken_for_a_flood(free_port: int) -> None:
    """The price of the limit, as in the threat model: of two under one key that come together one gets through,
    and one that comes a period later does."""
    endpoint = f"tcp/127.0.0.1:{free_port}"
    router = ZenohTransport(ZenohSettings("router", (endpoint,), rates=tuple(rate_limits("fleet", ("r1",)))))
    sender, reader = (ZenohTransport(ZenohSettings("client", (), (endpoint,))) for _ in range(2))
    key, came = key_of("fleet", "r1", ACTION), []
    try:
        reader.subscribe(key, lambda _, payload: came.append(payload))
        knocked(sender, key, lambda: bool(came))
        came.clear()
        for number in range(200):
            sender.put(key, str(number).encode(), never_drop=True)
        deadline = time.monotonic() + _PATIENCE_SECONDS
        while b"later" not in came and time.monotonic() < deadline:
            time.sleep(0.05)
            sender.put(key, b"later", never_drop=True)
    finally:
        for transport in (sender, reader, router):
            transport.close()
    assert came[0] == b"0"
    assert came[-1] == b"later"
    assert len(came) < 150


def test_heartbeats_are_counted_too() -> None:
    """They are of no tick, and a process whose key no other uses may send them."""
    rules = {rule["key_expr"]: rule["freq"] for limit in rate_limits("f", ("r1",)) for rule in limit["rules"]}
    for role in (role for role in ROLES.values() if role.lives):
        for robot in ("r1", NO_ROBOT):
            assert rules[key_of("f", robot, HEALTH, role.name)] <= 100.0
