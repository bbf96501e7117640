"""Who may speak and ask, what is passed over, which link is whose, and how an inbox and a log keep their bounds."""

from __future__ import annotations

import os
import signal
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus import Answer, Bus, HealthMessage, MemoryBroker, MemoryTransport
from safedpa.bus.log import EventLog
from safedpa.bus.loop import apart
from safedpa.bus.security.certificates import AUTHORITY, Card, Certificates
from safedpa.bus.transport import inbox as inbox_module
from safedpa.bus.transport import zenoh_transport as zenoh_module
from safedpa.bus.transport.inbox import Inbox, _check_speaker
from safedpa.bus.transport.zenoh_transport import ZenohTransport
from safedpa.bus.wire.codec import decode, encode
from safedpa.bus.wire.requests import Request, request_key
from safedpa.bus.wire.topics import HEALTH
from safedpa.errors import BusError, MessageError


@pytest.mark.parametrize("gone", [AUTHORITY, "r", "r.key"])
def test_who_shows_a_certificate_has_all_three_files_and_a_name(gone: str, tmp_path: Path) -> None:
    for name in (AUTHORITY, "r", "r.key"):
        (tmp_path / f"{name}.pem").write_bytes(b"-----BEGIN ")
        (tmp_path / f"{name}.pem").chmod(0o600)
    assert Card.of(tmp_path, "r").role == "r"
    with pytest.raises(BusError, match=r"got no --role, wanted whose certificate to show, such as robot.r1"):
        Certificates(tmp_path, "")
    (tmp_path / f"{gone}.pem").unlink()
    with pytest.raises(BusError, match=rf"{gone}.pem: is not there; make it with 'safedpa certificates"):
        Certificates(tmp_path, "r")


PEM = b"-----BEGIN "


@pytest.mark.parametrize(
    ("parts", "taken"),
    [((PEM,) * 3, True), ((PEM,) * 2, False), ((PEM,) * 4, False), ((PEM, PEM, b"x"), False), ((b"", PEM, PEM), False)],
)
def test_a_card_has_three_parts_all_of_them_in_pem(parts: tuple[bytes, ...], taken: bool) -> None:
    end, other = os.pipe()
    os.write(other, b"\0".join(parts))
    os.close(other)
    if taken:
        assert Card.from_descriptor(end, "r").key == PEM
    else:
        with pytest.raises(BusError, match=f"--card {end}"):
            Card.from_descriptor(end, "r")


def session_of(*links: tuple[str, str, str | None]) -> Any:
    """A transport whose session has these links: (Zenoh id, far end, name in the certificate)."""
    told = [SimpleNamespace(zid=zid, dst=far, auth_identifier=name) for zid, far, name in links]
    found = object.__new__(ZenohTransport)
    found._session = SimpleNamespace(info=SimpleNamespace(links=lambda: told))  # type: ignore[assignment]
    return found


def test_a_link_is_known_by_its_session_its_address_and_the_name_in_its_certificate() -> None:
    transport = session_of(
        ("a", "tls/10.0.0.1:7447?x=1#y", "robot.r1"), ("b", "tls/[::1]:7448", None), ("c", "unixsock/path:no", "c")
    )
    assert transport.members() == [("a", "robot.r1"), ("b", ""), ("c", "c")]
    assert [transport.name_of(zid) for zid in ("a", "b", "d")] == ["robot.r1", "", ""]
    assert transport._far_ends() == {("10.0.0.1", 7447), ("::1", 7448)}
    assert transport._far_ends({"b"}) == {("::1", 7448)}
    assert transport._far_ends({"c", "d"}) == set()
    assert transport._far_ends(set()) == set()


def test_only_links_of_the_named_sessions_are_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    cut: list[Any] = []
    monkeypatch.setattr(zenoh_module, "cut_off", lambda ends: cut.append(set(ends)) or len(ends))
    transport = session_of(("a", "tls/10.0.0.1:1", "a"), ("b", "tls/10.0.0.2:2", "b"))
    assert transport.cut_off(["b"]) == 1
    assert transport.cut_off(["c"]) == 0
    assert cut == [{("10.0.0.2", 2)}]


def beat(service: str) -> HealthMessage:
    stamp: dict[str, Any] = {"epoch": 1, "tick": 1, "robot_time": 0.0, "publish_time": 0.0}
    return HealthMessage(**stamp, service=service, pid=1, state="running")


def test_nobody_speaks_as_another_service_in_the_message() -> None:
    _check_speaker("safedpa/f/r/health/policy", beat("policy"))
    for said in ("adaptation", "", "policy2"):
        with pytest.raises(MessageError, match=f"got a message of service '{said}', wanted one of 'policy'"):
            _check_speaker("safedpa/f/r/health/policy", beat(said))
    broker = MemoryBroker()
    ear = Bus(MemoryTransport(broker), "f").inbox((HEALTH,), keep_all=True)
    Bus(MemoryTransport(broker), "f").publish(HEALTH, "r", beat("adaptation"), "policy")
    (refused,) = ear.take(0.0)
    assert isinstance(refused, inbox_module.Refused)


@pytest.mark.parametrize(
    ("kind", "do", "ok"), [("request", "accept", True), ("request", "status", True), ("status", "status", True),
                           ("status", "accept", False), ("status", "stop", False)]
)  # fmt: skip
def test_where_only_the_state_of_things_may_be_asked_all_else_is_refused(kind: str, do: str, ok: bool) -> None:
    transport, told = MemoryTransport(MemoryBroker()), list[tuple[str, Any, bool]]()
    asked: list[str] = []

    def answer(robot: str, request: Request) -> Answer:
        asked.append(f"{robot} {request.do}")
        return Answer(ok=True, sentence="yes")

    Bus(transport, "f").answer_requests(
        answer, tell=lambda robot, request, given: told.append((robot, request, given.ok))
    )
    given = transport.ask(request_key("f", "r", kind), encode(Request(do=do)), 1.0)
    assert given is not None
    assert decode(Answer, given).ok is ok
    assert asked == ([f"r {do}"] if ok else [])
    assert told == [("r", Request(do=do), ok)]


def test_a_bus_that_was_closed_sends_and_asks_no_more() -> None:
    transport = MemoryTransport(MemoryBroker())
    transport.put("k", b"", never_drop=False)
    assert transport.ask("k", b"", 1.0) is None
    transport.close()
    with pytest.raises(BusError, match=r"^k: the bus was closed; open another one to send"):
        transport.put("k", b"", never_drop=False)
    with pytest.raises(BusError, match=r"^k: the bus was closed; open another one to ask"):
        transport.ask("k", b"", 1.0)


@pytest.fixture
def inbox() -> Inbox:
    return Bus(MemoryTransport(MemoryBroker()), "f").inbox((HEALTH,), keep_all=True)


def keys_of(inbox: Any) -> list[str]:
    return list(inbox._latest)


def test_of_the_newest_messages_so_many_keys_are_kept_and_known_ones_are_renewed(
    inbox: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inbox_module, "_MOST_KEYS", 2)
    for key, payload in (("a", b"1"), ("b", b"2"), ("c", b"3"), ("a", b"4")):
        inbox.keep_latest(key, payload)
    assert keys_of(inbox) == ["a", "b"]
    assert [entry[1] for entry in inbox._latest.values()] == [b"4", b"2"]
    assert inbox.dropped == 1


@pytest.mark.parametrize(("size", "kept"), [(4, 4), (5, 5), (6, 5), (900, 5)])
def test_of_what_is_too_large_so_much_is_kept_that_it_is_seen(
    size: int, kept: int, inbox: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(inbox_module, "_LARGEST_LATEST", 4)
    inbox.keep_latest("a", b"x" * size)
    assert len(inbox._latest["a"][1]) == kept


def test_where_too_much_waits_the_oldest_of_whoever_has_most_bytes_goes(
    inbox: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """So who floods loses its own messages, and who sends little none."""
    inbox._longest_queue = 4
    for number in range(6):
        inbox.keep_all("loud", b"xx" + bytes([number]))
    inbox.keep_all("quiet", b"q")
    assert {key: [payload for payload, _ in queue.messages] for key, queue in inbox._queues.items()} == {
        "loud": [b"xx\x03", b"xx\x04", b"xx\x05"],
        "quiet": [b"q"],
    }
    assert (inbox.dropped, inbox._queued, inbox._queued_bytes) == (3, 4, 10)
    monkeypatch.setattr(inbox_module, "_LARGEST_QUEUE_BYTES", 10)
    inbox.keep_all("quiet", b"r")
    assert (inbox.dropped, inbox._queued_bytes) == (4, 8)


@pytest.mark.parametrize(
    ("status", "said"),
    [
        (signal.SIGKILL, "trying it took more than 5 s of processor time"),
        (signal.SIGXCPU, "trying it took more than 5 s of processor time"),
        (signal.SIGSEGV, r"trying it took more than \d+ MiB of memory, or ended its process \(code -11\)"),
        (1 << 8, r"trying it took more than \d+ MiB of memory, or ended its process \(code 1\)"),
    ],
)
def test_how_a_trial_ended_is_told(status: int, said: str) -> None:
    import re

    assert re.fullmatch(said, apart._ending(int(status)))


class Said:
    """A log whose clock stands still; ``later``: what is to be done when the second is over."""

    def __init__(self) -> None:
        self.now, self.lines, self.later = 0.0, list[str](), list[tuple[float, Callable[[], None]]]()
        self.log = EventLog(
            self.lines.append, lambda: self.now, lambda seconds, work: self.later.append((seconds, work))
        )

    def event(self, robot: str = "r", kind: str = "k") -> None:
        self.log.log({"time": 0.0, "level": "info", "kind": kind, "sentence": "s", "robot": robot})


@pytest.mark.parametrize(("after", "lines"), [(0.0, 1), (0.99, 1), (1.0, 2), (1.5, 2)])
def test_the_like_of_an_event_is_written_once_a_second(after: float, lines: int) -> None:
    said = Said()
    said.event()
    said.event("another robot")
    said.event(kind="another kind")
    assert len(said.lines) == 3
    said.now = after
    said.event()
    assert len(said.lines) == 2 + lines
    assert said.log.counts() == {"k": 3, "another kind": 1}
    assert [seconds for seconds, _ in said.later] == ([pytest.approx(1.0 - after)] if lines == 1 else [])


def test_what_was_left_out_of_a_second_is_written_when_it_is_over() -> None:
    said = Said()
    for at in (0.0, 0.25, 0.5):
        said.now = at
        said.event()
    ((seconds, work),) = said.later
    assert (seconds, len(said.lines)) == (0.75, 1)
    said.now = 1.0
    work()
    assert len(said.lines) == 2
    assert "repeated" in said.lines[1]
    assert "2" in said.lines[1]
    work()  # was done already
    assert len(said.lines) == 2
