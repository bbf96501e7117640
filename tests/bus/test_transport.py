"""One contract, two transports: in memory and over Zenoh."""

import gc
import os
import subprocess
import sys
import threading
import time
import weakref
from abc import ABC, abstractmethod
from collections.abc import Iterator
from typing import Any

import pytest
from tests.bus.fleet import Heard
from tests.waiting import until

from safedpa.bus import (
    STATE,
    AbstractTransport,
    Answer,
    Bus,
    MemoryBroker,
    MemoryTransport,
    Message,
    Request,
    ZenohSettings,
    request_key,
)
from safedpa.bus import ZenohTransport as Zenoh
from safedpa.bus.transport.zenoh import close_session
from safedpa.errors import BusError, InputError, MessageError

PATIENCE = 30.0


class TransportContract(ABC):
    """What every transport must do."""

    @pytest.fixture
    @abstractmethod
    def pair(self) -> Any:
        """Two participants that hear each other."""

    def settled(self, sender: AbstractTransport, heard: Heard, key: str) -> None:
        """Sends until something arrives, then forgets it: subscriptions spread over a network with some delay."""

        def arrives() -> bool:
            sender.put(key, b"are you there", never_drop=True)
            return bool(heard.samples)

        assert until(arrives)
        sender.put(key, b"last", never_drop=True)
        assert until(lambda: heard.payloads[-1] == b"last")
        heard.samples.clear()

    def test_delivers_bytes_under_their_key_in_order(self, pair: tuple[AbstractTransport, AbstractTransport]) -> None:
        sender, receiver = pair
        heard = Heard()
        receiver.subscribe("safedpa/f/r/verdict", heard)
        self.settled(sender, heard, "safedpa/f/r/verdict")
        sent = [bytes([number]) * 300 for number in range(50)]
        for payload in sent:
            sender.put("safedpa/f/r/verdict", payload, never_drop=True)
        assert until(lambda: len(heard.samples) == len(sent))
        assert heard.samples == [("safedpa/f/r/verdict", payload) for payload in sent]

    def test_a_star_matches_one_part_and_nothing_else(self, pair: tuple[AbstractTransport, AbstractTransport]) -> None:
        sender, receiver = pair
        heard = Heard()
        receiver.subscribe("safedpa/f/*/state", heard)
        self.settled(sender, heard, "safedpa/f/r/state")
        for key in ("safedpa/g/a/state", "safedpa/f/a/b/state", "safedpa/f/a/nominal", "safedpa/f/a/state"):
            sender.put(key, b"x", never_drop=True)
        assert until(lambda: bool(heard.samples))
        assert heard.samples == [("safedpa/f/a/state", b"x")]

    def test_a_sender_hears_itself(self, pair: tuple[AbstractTransport, AbstractTransport]) -> None:
        heard = Heard()
        pair[0].subscribe("safedpa/f/r/state", heard)
        pair[0].put("safedpa/f/r/state", b"x", never_drop=False)
        assert until(lambda: heard.payloads == [b"x"])

    def test_shows_its_signs_of_life_until_it_closes(self, pair: tuple[AbstractTransport, AbstractTransport]) -> None:
        one, other = pair
        other.declare_alive("safedpa/f/r/alive/policy/2")
        other.declare_alive("safedpa/f/r/alive/policy/1")
        both = ["safedpa/f/r/alive/policy/1", "safedpa/f/r/alive/policy/2"]
        assert until(lambda: one.alive("safedpa/f/*/alive/policy/*") == both)
        assert one.alive("safedpa/f/*/alive/robot/*") == []
        other.close()
        assert until(lambda: one.alive("safedpa/f/*/alive/policy/*") == [])

    def test_after_close_nothing_is_heard_and_nothing_can_be_sent(self, pair):
        sender, receiver = pair
        heard, witness = Heard(), Heard()
        receiver.subscribe("safedpa/f/r/state", heard)
        self.settled(sender, heard, "safedpa/f/r/state")
        receiver.close()
        receiver.close()
        sender.subscribe("safedpa/f/r/state", witness)
        sender.put("safedpa/f/r/state", b"x", never_drop=True)
        assert until(lambda: witness.payloads == [b"x"])
        assert heard.samples == []
        with pytest.raises(BusError, match="closed"):
            receiver.put("safedpa/f/r/state", b"x", never_drop=False)

    def test_a_name_that_is_taken_cannot_be_claimed(self, pair: tuple[AbstractTransport, AbstractTransport]) -> None:
        one, other = Bus(pair[0], "f"), Bus(pair[1], "f")
        one.claim("r", "robot", "m")
        assert until(lambda: other.instances("r", "robot") == ["m"])
        for instance in ("a", "z"):
            with pytest.raises(BusError, match=r"robot 'r' of fleet 'f' is already running \(instance m\)"):
                other.claim("r", "robot", instance)
        other.claim("r2", "robot", "a")
        one.close()
        assert until(lambda: other.instances("r", "robot") == [])
        other.claim("r", "robot", "a")
        assert other.instances("r", "robot") == ["a"]

    def test_a_name_cannot_be_held_by_one_that_was_there_second(self, pair):
        """The first one announced itself between the second one's two looks: the lower instance must not win then."""
        first, second = Bus(pair[0], "f"), Bus(pair[1], "f")

        class Late(Bus):
            def announce(self, robot: str, service: str, instance: str) -> None:
                first.claim(robot, service, "z")
                assert until(lambda: second.instances(robot, service) == ["z"])
                super().announce(robot, service, instance)

        with pytest.raises(BusError, match="instance z"):
            Late(pair[1], "f").claim("r", "robot", "a", settle_seconds=0.1)

    def test_of_two_that_claim_at_once_the_lower_stays(self, pair: tuple[AbstractTransport, AbstractTransport]) -> None:
        lower, higher = Bus(pair[0], "f"), Bus(pair[1], "f")

        class Both(Bus):
            def announce(self, robot: str, service: str, instance: str) -> None:
                higher.announce(robot, service, "b")
                super().announce(robot, service, instance)
                assert until(lambda: lower.instances(robot, service) == ["a", "b"])
                threading.Timer(0.2, higher.close).start()

        Both(pair[0], "f").claim("r", "robot", "a", settle_seconds=PATIENCE)
        assert until(lambda: lower.instances("r", "robot") == ["a"])

    def test_of_two_that_claim_at_once_the_higher_leaves_at_once(self, pair):
        """If both waited for each other, both would leave in the end, and no one would be there."""
        lower, higher = Bus(pair[0], "f"), Bus(pair[1], "f")

        class Both(Bus):
            def announce(self, robot: str, service: str, instance: str) -> None:
                lower.announce(robot, service, "a")
                super().announce(robot, service, instance)
                assert until(lambda: higher.instances(robot, service) == ["a", "b"])

        began = time.monotonic()
        with pytest.raises(BusError, match=r"is already running \(instance a\)"):
            Both(pair[1], "f").claim("r", "robot", "b", settle_seconds=PATIENCE)
        assert time.monotonic() - began < 0.5 * PATIENCE

    def test_a_question_is_answered(self, pair: tuple[AbstractTransport, AbstractTransport]) -> None:
        one, other = pair
        assert one.ask("safedpa/f/r/request", b"anybody", PATIENCE) is None, "no one answers, and that is known at once"
        other.answer("safedpa/f/*/request", lambda key, payload: key.encode() + payload)
        assert until(lambda: one.ask("safedpa/f/r/request", b"?", PATIENCE) == b"safedpa/f/r/request?")
        assert one.ask("safedpa/f/r/state", b"?", 0.2) is None
        other.answer("safedpa/f/*/agreed", lambda key, payload: None)
        other.answer("safedpa/f/r/agreed", lambda key, payload: b"I know")
        assert until(lambda: one.ask("safedpa/f/r/agreed", b"?", PATIENCE) == b"I know"), "one leaves it to the other"
        other.close()
        assert until(lambda: one.ask("safedpa/f/r/request", b"?", 0.2) is None)
        one.close()
        with pytest.raises(BusError, match="closed"):
            one.ask("safedpa/f/r/request", b"?", 0.2)

    def test_requests_are_answered_or_refused(self, pair: tuple[AbstractTransport, AbstractTransport]) -> None:
        asker, answerer = Bus(pair[0], "f"), Bus(pair[1], "f")

        def answered(robot: str, request: Request) -> Answer:
            if request.effect == "none":
                raise InputError("effect 'none': no candidate of that name")
            return Answer(ok=True, sentence=f"{request.do} {robot}", change=request.finding)

        answerer.answer_requests(answered)
        assert until(lambda: asker.request("r", Request(do="status"), 0.2) is not None)
        accepted = asker.request("r", Request(do="accept", finding=7), PATIENCE)
        assert accepted == Answer(ok=True, sentence="accept r", change=7)
        refused = asker.request("r", Request(do="accept", effect="none"), PATIENCE)
        assert refused == Answer(ok=False, sentence="refused: effect 'none': no candidate of that name")
        malformed = pair[0].ask(request_key("f", "r"), b"\xc1", PATIENCE)
        assert malformed is not None
        assert b"Request: MessagePack data is malformed" in malformed

    def test_messages_travel(self, pair: tuple[AbstractTransport, AbstractTransport], samples: dict[str, Message]):
        one, other = Bus(pair[0], "f"), Bus(pair[1], "f")
        inbox = other.inbox((STATE,))

        def arrives() -> bool:
            one.publish(STATE, "r", samples["state"])
            return any(getattr(item, "message", None) == samples["state"] for item in inbox.take(0.05))

        assert until(arrives)


class TestMemory(TransportContract):
    @pytest.fixture
    def pair(self) -> tuple[AbstractTransport, AbstractTransport]:
        broker = MemoryBroker()
        return MemoryTransport(broker), MemoryTransport(broker)


@pytest.mark.processes
class TestZenohPeers(TransportContract):
    @pytest.fixture
    def pair(self, free_port: int) -> Iterator[tuple[AbstractTransport, AbstractTransport]]:
        one = Zenoh(ZenohSettings(listen=(f"tcp/127.0.0.1:{free_port}",)))
        other = Zenoh(ZenohSettings(connect=(f"tcp/127.0.0.1:{free_port}",)))
        yield one, other
        one.close()
        other.close()


@pytest.mark.processes
class TestZenohClientsOfARouter(TransportContract):
    @pytest.fixture
    def pair(self, free_port: int) -> Iterator[tuple[AbstractTransport, AbstractTransport]]:
        endpoint = f"tcp/127.0.0.1:{free_port}"
        router = Zenoh(ZenohSettings("router", listen=(endpoint,)))
        one, other = (Zenoh(ZenohSettings("client", connect=(endpoint,))) for _ in range(2))
        yield one, other
        for transport in (one, other, router):
            transport.close()


@pytest.mark.processes
@pytest.mark.parametrize("endpoint", ["tcp/127.0.0.1:99999", "tcp/no.such.host.invalid:7447", "pigeon/1"])
def test_an_endpoint_that_cannot_be_is_refused_with_its_name(endpoint: str) -> None:
    with pytest.raises(BusError, match="check the endpoints") as caught:
        Zenoh(ZenohSettings(listen=(endpoint,)))
    assert endpoint in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("side", ["listen", "connect"])
def test_what_is_no_endpoint_is_bad_input_and_not_tried_again(side: str) -> None:
    with pytest.raises(InputError, match=r"garbage.*wanted endpoints") as caught:
        Zenoh(ZenohSettings(**{side: ("garbage",)}))
    assert "\n" not in str(caught.value)


def test_a_session_that_does_not_close_is_reported_and_kept(capsys: pytest.CaptureFixture[str]) -> None:
    """Zenoh gives up after 10 s where the machine has too much to do; a process that ends must not fail by it."""
    import zenoh

    class Stuck:
        def is_closed(self) -> bool:
            return False

        def close(self) -> None:
            raise zenoh.ZError("close operation timed out! at /somewhere/close.rs:135.")

    stuck: Any = Stuck()
    close_session(stuck)
    error = capsys.readouterr().err
    assert '"kind": "bus.unclosed"' in error
    assert "close operation timed out!" in error
    assert "close.rs" not in error
    known = weakref.ref(stuck)
    del stuck
    gc.collect()
    assert known() is not None, "letting go of a session would close it again, for as long"


def test_wrong_message_for_a_topic_is_refused_before_it_is_sent(samples: dict[str, Message]) -> None:
    with Bus(MemoryTransport(MemoryBroker()), "f") as bus:
        ear = bus.inbox((STATE,), keep_all=True)
        with pytest.raises(MessageError, match="state: got ActionMessage, wanted StateMessage"):
            bus.publish(STATE, "r", samples["action"])
        assert ear.take(0.0) == []


@pytest.mark.processes
def test_links_are_opened_and_closed_by_more_than_one_thread(free_port: int) -> None:
    """With one, Zenoh's default, a session that is stationary keeps all others of its process from closing."""
    program = (
        "import os, time\n"
        "from safedpa.bus import ZenohSettings, ZenohTransport\n"
        f"transport = ZenohTransport(ZenohSettings(listen=('tcp/127.0.0.1:{free_port}',)))\n"
        "def named():\n"
        "    names = [open(f'/proc/self/task/{task}/comm').read() for task in os.listdir('/proc/self/task')]\n"
        "    return sum(name.startswith('net-') for name in names)\n"
        "end = time.monotonic() + 10.0\n"  # a thread gets its name a moment after it was started
        "while named() < 4 and time.monotonic() < end:\n"
        "    time.sleep(0.05)\n"
        "print(named())\n"
        "transport.close()\n"
    )
    environment = {name: value for name, value in os.environ.items() if name != "ZENOH_RUNTIME"}
    command = [sys.executable, "-c", program]
    found = subprocess.run(command, capture_output=True, text=True, env=environment, timeout=60, check=False)
    assert found.stdout.strip() == "4", found.stderr
