"""Batches under load: when they are made, what waits for them, and that nothing is lost on the way there and back."""

from collections.abc import Iterator

import pytest
from hypothesis import given
from hypothesis import strategies as st
from tests.waiting import until

from safedpa.bus import (
    ACTION,
    MODEL,
    VERDICT,
    AbstractTransport,
    Bus,
    Inbox,
    MemoryBroker,
    MemoryTransport,
    Message,
    ReceivedMessage,
    ZenohSettings,
    ZenohTransport,
    encode,
)
from safedpa.bus.service.service_loop import batch_interval
from safedpa.bus.transport.base import Subscription


@given(robots=st.integers(0, 300), period=st.floats(0.001, 1.0), coalescing=st.booleans())
def test_a_quantum_is_a_small_part_of_the_period_or_nothing(robots: int, period: float, coalescing: bool) -> None:
    quantum = batch_interval([period] * robots, coalescing=coalescing)
    assert quantum == 0.0 or 0.001 <= quantum <= 0.1 * period
    if robots < 4 or batch_interval([period] * 300, coalescing=True) == 0.0:
        assert quantum == 0.0


def test_batches_begin_with_eight_robots_and_end_below_four() -> None:
    sizes = range(1, 12)
    assert [size for size in sizes if batch_interval([0.05] * size, coalescing=False)] == list(range(8, 12))
    assert [size for size in sizes if batch_interval([0.05] * size, coalescing=True)] == list(range(4, 12))


@pytest.mark.parametrize(
    ("period", "quantum"),
    [(0.1, 0.003), (0.05, 0.0015), (0.03, 0.0), (0.0, 0.0)],
    ids=["slow", "usual", "fast", "waits"],
)
def test_a_batch_takes_a_thirtieth_of_the_shortest_period_or_is_not_worth_it(period: float, quantum: float) -> None:
    """Sleeping for less than a millisecond costs more than it saves; a robot in lockstep (0) stands while it waits."""
    assert batch_interval([0.1] * 20 + [period], coalescing=True) == pytest.approx(quantum)


class Retained(Subscription):
    """A subscription that can gather, filled by the test."""

    def __init__(self, inbox: Inbox) -> None:
        self.inbox, self.gathered, self.gathers = inbox, list[tuple[str, bytes]](), False

    def send(self, key: str, payload: bytes) -> None:
        if self.gathers:
            self.gathered.append((key, payload))
        else:
            self.inbox.keep_latest(key, payload)

    def gather(self) -> None:
        self.gathers = True

    def collect(self) -> None:
        gathered, self.gathered = self.gathered, []
        for key, payload in gathered:
            self.inbox.keep_latest(key, payload)

    def pass_on(self) -> None:
        self.collect()
        self.gathers = False


def test_an_inbox_that_makes_batches_takes_all_that_was_gathered(samples: dict[str, Message]) -> None:
    inbox = Inbox()
    retained = Retained(inbox)
    inbox.fill_from(retained)
    inbox.coalesce(0.002)
    for robot in "abc":
        retained.send(f"safedpa/f/{robot}/action", encode(samples["action"]))
    assert retained.gathered, "nothing was kept outside"
    assert inbox.waiting
    assert [item.robot for item in inbox.take(0.0) if isinstance(item, ReceivedMessage)] == ["a", "b", "c"]
    retained.send("safedpa/f/d/action", encode(samples["action"]))
    inbox.coalesce(0.0)
    retained.send("safedpa/f/e/action", encode(samples["action"]))
    assert [item.robot for item in inbox.take(0.0) if isinstance(item, ReceivedMessage)] == ["d", "e"]


def test_a_batch_is_not_taken_before_its_quantum_is_over(samples: dict[str, Message], monkeypatch: pytest.MonkeyPatch):
    inbox = Inbox()
    retained = Retained(inbox)
    inbox.fill_from(retained)
    slept: list[float] = []
    monkeypatch.setattr("time.sleep", slept.append)
    inbox.coalesce(0.05)
    inbox.take(0.0)
    assert slept == [], "it waited although it should not"
    retained.send("safedpa/f/a/action", encode(samples["action"]))
    assert len(inbox.take(1.0)) == 1
    assert len(slept) == 1
    assert 0.0 < slept[0] <= 0.05


def test_held_messages_go_out_in_order_at_the_flush(samples: dict[str, Message]) -> None:
    broker = MemoryBroker()
    bus, inbox = Bus(MemoryTransport(broker), "f"), Bus(MemoryTransport(broker), "f").inbox((ACTION, VERDICT))
    models = bus.inbox((MODEL,))
    bus.hold()
    bus.publish(VERDICT, "b", samples["verdict"])
    bus.publish(ACTION, "a", samples["action"])
    bus.publish(MODEL, "m", samples["model"])
    assert [item.robot for item in models.take(0.0)] == ["m"], "it never travels in a bundle, so it does not wait"
    bus.publish(ACTION, "alone", samples["action"], alone=True)
    assert [item.robot for item in inbox.take(0.0)] == ["alone"]
    bus.hold()  # what is held already stays
    assert inbox.take(0.0) == []
    bus.flush()
    assert [item.robot for item in inbox.take(0.0) if isinstance(item, ReceivedMessage)] == ["b", "a"]
    bus.publish(ACTION, "c", samples["action"])
    assert len(inbox.take(0.0)) == 1, "it held on after the flush"
    bus.flush()
    assert inbox.take(0.0) == []


@pytest.mark.processes
class TestZenohGathers:
    """The ring on Zenoh's side."""

    KEY = "safedpa/f/r/state"

    @pytest.fixture
    def pair(self, free_port: int) -> Iterator[tuple[AbstractTransport, AbstractTransport]]:
        one = ZenohTransport(ZenohSettings(listen=(f"tcp/127.0.0.1:{free_port}",)))
        other = ZenohTransport(ZenohSettings(connect=(f"tcp/127.0.0.1:{free_port}",)))
        yield one, other
        one.close()
        other.close()

    def test_nothing_is_lost_nor_twice_on_the_way_to_batches_and_back(self, pair):
        sender, receiver = pair
        heard: list[bytes] = []
        subscription = receiver.subscribe(self.KEY, lambda _key, payload: heard.append(payload))

        def notice(word: bytes) -> None:
            sender.put(self.KEY, word, never_drop=True)

        def arrives() -> bool:
            notice(b"are you there")
            return bool(heard)

        assert until(arrives)
        notice(b"before")
        assert until(lambda: heard[-1] == b"before")
        heard.clear()
        subscription.gather()
        subscription.gather()  # asked twice, it is one
        for number in range(50):
            notice(b"%d" % number)

        def collected() -> bool:
            subscription.collect()
            return b"49" in heard

        assert heard == [], "it called although it gathers"
        assert until(collected)
        notice(b"on the way back")
        assert until(lambda: (subscription.collect(), b"on the way back" in heard)[1])
        subscription.pass_on()
        notice(b"after")
        assert until(lambda: heard[-1] == b"after")
        assert heard == [*(b"%d" % number for number in range(50)), b"on the way back", b"after"]
