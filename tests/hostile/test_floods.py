"""Who floods with a valid key gets no more through than the fastest robot would send, and others are not held up."""

from __future__ import annotations

import time

import pytest

from safedpa.bus import ACTION, HEALTH, NO_ROBOT, WISH, ZenohSettings, ZenohTransport, key_of
from safedpa.bus.access import ROLES, rate_limits

pytestmark = [pytest.mark.processes, pytest.mark.slow]
_MOST = 4000.0


def test_a_flood_ends_at_the_router(free_port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    router = ZenohTransport(ZenohSettings("router", (endpoint,), rates=tuple(rate_limits("fleet", ("r1",)))))
    flooder, other, reader = (ZenohTransport(ZenohSettings("client", (), (endpoint,))) for _ in range(3))
    came: dict[str, list[float]] = {"wish": [], "action": []}
    try:
        for topic in (WISH, ACTION):
            key = key_of("fleet", "r1", topic)
            reader.subscribe(key, lambda _, payload, name=topic.name: came[name].append(time.monotonic()))
        time.sleep(0.5)
        sent, regular = 0, 0
        end, due = time.monotonic() + 2.0, time.monotonic()
        while time.monotonic() < end:
            for _ in range(50):
                flooder.put(key_of("fleet", "r1", WISH), b"x" * 100, never_drop=False)
            sent += 50
            if time.monotonic() >= due:
                other.put(
                    key_of("fleet", "r1", ACTION), b"y", never_drop=True
                )  # a busy machine drops what may be dropped
                regular, due = regular + 1, due + 0.05
        time.sleep(0.5)
    finally:
        for transport in (flooder, other, reader, router):
            transport.close()
    assert sent > 3 * _MOST, "no flood"
    assert 0 < len(came["wish"]) <= 1.3 * 2.0 * _MOST
    assert len(came["action"]) == regular, "what others say is not held up"


def test_heartbeats_are_counted_too() -> None:
    """They are of no tick, and whoever has a key that nobody else uses may send them."""
    rules = {rule["key_expr"]: rule["freq"] for limit in rate_limits("f", ("r1",)) for rule in limit["rules"]}
    for role in (role for role in ROLES.values() if role.lives):
        for robot in ("r1", NO_ROBOT):
            assert rules[key_of("f", robot, HEALTH, role.name)] <= 100.0
