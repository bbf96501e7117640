"""A message that arrives under another key than it was sent under is not delivered; one without a stamp is."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.waiting import until

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.logging import EVENT_LOG
from safedpa.bus.messages.topics import STAMP_BYTES, is_misrouted, key_stamp
from safedpa.bus.transport.zenoh import open_session, zenoh_session_configuration

MINE, OTHERS = "safedpa/f/mine/state", "safedpa/f/others/state"
PATIENCE = 30.0

keys = st.text(min_size=1, max_size=80)


@given(keys, keys)
def test_a_stamp_is_of_one_key(one: str, other: str) -> None:
    assert not is_misrouted(one, key_stamp(one))
    assert not is_misrouted(one, None)
    assert is_misrouted(other, key_stamp(one)) is (one != other)
    assert is_misrouted(one, b"")
    assert len(key_stamp(one)) == STAMP_BYTES


def test_a_stamp_is_what_the_tool_of_others_says() -> None:
    """``printf safedpa/f/mine/state | b2sum -l 64``: a program in another language makes the same."""
    assert key_stamp(MINE).hex() == "fc5b9a0df84c1874"


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
    other, raw = ZenohTransport(settings), open_session(zenoh_session_configuration(settings.configuration()))
    yield Network(one, other, raw)
    raw.close()
    one.close()
    other.close()


@pytest.mark.processes
@pytest.mark.parametrize("gathers", [False, True])
def test_a_misrouted_message_is_not_delivered_and_is_logged(network: Network, gathers: bool) -> None:
    one, other, raw = network.one, network.other, network.raw
    heard: list[tuple[str, bytes]] = []
    subscription = other.subscribe(MINE, lambda key, payload: heard.append((key, payload)))
    if gathers:
        subscription.gather()
    reported = EVENT_LOG.counts().get("bus.misrouted", 0)

    def notice() -> bool:
        raw.put(MINE, b"of another robot", attachment=key_stamp(OTHERS))
        raw.delete(MINE)
        raw.put(MINE, b"of a program that knows of no stamps")
        one.put(MINE, b"its own", never_drop=True)
        subscription.collect()
        return {b"of a program that knows of no stamps", b"its own"} <= {payload for _, payload in heard}

    assert until(notice)
    assert until(lambda: subscription.collect() or EVENT_LOG.counts().get("bus.misrouted", 0) > reported)
    assert set(heard) == {(MINE, b"of a program that knows of no stamps"), (MINE, b"its own")}


@pytest.mark.processes
def test_misrouted_questions_and_answers_are_ignored(network: Network) -> None:
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
    assert question(b"is_misrouted", attachment=key_stamp("safedpa/f/others/request")) == []
    assert b"is_misrouted" not in asked

    def mistaken(query: Any) -> None:
        with query:
            query.reply(query.key_expr, b"about another robot", attachment=key_stamp("safedpa/f/others/agreed"))

    retained = raw.declare_queryable("safedpa/f/mine/agreed", mistaken)
    reported = EVENT_LOG.counts().get("bus.misrouted", 0)

    def refused() -> bool:
        assert one.ask("safedpa/f/mine/agreed", b"?", 1.0) is None
        return EVENT_LOG.counts().get("bus.misrouted", 0) > reported

    assert until(refused)
    retained.undeclare()
