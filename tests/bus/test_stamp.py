"""A message that arrives under another key than it was sent under is not delivered; one without a stamp is."""

import time
from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.log import counted_events
from safedpa.bus.transport.session import configuration_of, open_session
from safedpa.bus.wire.stamp import STAMP_BYTES, astray, stamp_of

MINE, OTHERS = "safedpa/f/mine/state", "safedpa/f/others/state"
PATIENCE = 30.0

keys = st.text(min_size=1, max_size=80)


@given(keys, keys)
def test_a_stamp_is_of_one_key(one: str, other: str) -> None:
    assert not astray(one, stamp_of(one))
    assert not astray(one, None)
    assert astray(other, stamp_of(one)) is (one != other)
    assert astray(one, b"")
    assert len(stamp_of(one)) == STAMP_BYTES


def test_a_stamp_is_what_the_tool_of_others_says() -> None:
    """``printf safedpa/f/mine/state | b2sum -l 64``: a program in another language makes the same."""
    assert stamp_of(MINE).hex() == "fc5b9a0df84c1874"


@dataclass
class Network:
    """Two peers, and a session of Zenoh that also sends what no transport would."""

    one: ZenohTransport
    other: ZenohTransport
    raw: Any


@pytest.fixture
def network(free_port: int) -> Iterator[Network]:
    settings = ZenohSettings(connect=(f"tcp/127.0.0.1:{free_port}",))
    one = ZenohTransport(ZenohSettings(listen=(f"tcp/127.0.0.1:{free_port}",)))
    other, raw = ZenohTransport(settings), open_session(configuration_of(settings.configuration()))
    yield Network(one, other, raw)
    raw.close()
    one.close()
    other.close()


def until(condition: Any) -> bool:
    end = time.monotonic() + PATIENCE
    while not condition():
        if time.monotonic() > end:
            return False
        time.sleep(0.01)
    return True


@pytest.mark.processes
@pytest.mark.parametrize("gathers", [False, True])
def test_a_message_gone_astray_is_not_delivered_and_that_is_reported(network: Network, gathers: bool) -> None:
    one, other, raw = network.one, network.other, network.raw
    heard: list[tuple[str, bytes]] = []
    subscription = other.subscribe(MINE, lambda key, payload: heard.append((key, payload)))
    if gathers:
        subscription.gather()
    told = counted_events().get("bus.astray", 0)

    def said() -> bool:
        raw.put(MINE, b"of another robot", attachment=stamp_of(OTHERS))
        raw.delete(MINE)
        raw.put(MINE, b"of a program that knows of no stamps")
        one.put(MINE, b"its own", never_drop=True)
        subscription.collect()
        return {b"of a program that knows of no stamps", b"its own"} <= {payload for _, payload in heard}

    assert until(said)
    assert until(lambda: subscription.collect() or counted_events().get("bus.astray", 0) > told)
    assert set(heard) == {(MINE, b"of a program that knows of no stamps"), (MINE, b"its own")}


@pytest.mark.processes
def test_a_question_gone_astray_is_not_answered_and_an_answer_gone_astray_is_not_taken(network: Network) -> None:
    one, other, raw = network.one, network.other, network.raw
    asked: list[bytes] = []

    def on_question(key: str, payload: bytes) -> bytes:
        asked.append(payload)
        return payload

    other.answer("safedpa/f/*/request", on_question)

    def question(payload: bytes, **more: Any) -> list[bytes]:
        replies = raw.get("safedpa/f/mine/request", payload=payload, timeout=PATIENCE, **more)
        return [reply.ok.payload.to_bytes() for reply in replies if reply.ok is not None]

    assert until(lambda: one.ask("safedpa/f/mine/request", b"stamped", 1.0) == b"stamped")
    assert until(lambda: question(b"without a stamp") == [b"without a stamp"])
    assert question(b"astray", attachment=stamp_of("safedpa/f/others/request")) == []
    assert b"astray" not in asked

    def mistaken(query: Any) -> None:
        with query:
            query.reply(query.key_expr, b"about another robot", attachment=stamp_of("safedpa/f/others/agreed"))

    kept = raw.declare_queryable("safedpa/f/mine/agreed", mistaken)
    told = counted_events().get("bus.astray", 0)

    def refused() -> bool:
        assert one.ask("safedpa/f/mine/agreed", b"?", 1.0) is None
        return counted_events().get("bus.astray", 0) > told

    assert until(refused)
    kept.undeclare()
