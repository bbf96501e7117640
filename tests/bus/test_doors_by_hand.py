"""Which doors of a Zenoh session have a keeper, and which questions over it are answered; no network."""

from __future__ import annotations

from types import SimpleNamespace, TracebackType
from typing import Any

import pytest

from safedpa.bus.security.certificates import Card
from safedpa.bus.transport import zenoh_transport as module
from safedpa.bus.transport.zenoh_transport import ZenohSettings, ZenohTransport, _ZenohSubscription
from safedpa.bus.wire.stamp import stamp_of
from safedpa.errors import BusError

CARD = Card("router", b"", b"", b"")
KEY = "safedpa/f/r1/request"


class Session:
    """What Zenoh gives, with nothing behind it; keeps by which function questions are answered."""

    asked: Any = None

    def declare_queryable(self, _: str, asked: Any) -> None:
        self.asked = asked


class Kept:
    """In place of a doorkeeper: whose doors it was given."""

    doors: list[set[int]]

    def __init__(self, ports: set[int], _: Any) -> None:
        self.doors.append(ports)


@pytest.fixture
def session(monkeypatch: pytest.MonkeyPatch) -> Session:
    found = Session()
    monkeypatch.setattr(module, "open_session", lambda _: found)
    monkeypatch.setattr(module, "configuration_of", lambda _: None)
    monkeypatch.setattr(module, "_warn_of_plain_text", lambda _: None)
    monkeypatch.setattr(Kept, "doors", [], raising=False)
    monkeypatch.setattr(module, "Doorkeeper", Kept)
    return found


@pytest.mark.parametrize(
    ("settings", "opened", "kept"),
    [
        (ZenohSettings("router", ("tcp/0.0.0.0:7447",)), {7447}, True),
        (ZenohSettings("router", ("tls/0.0.0.0:7447",), certificates=CARD), {7447}, False),
        (ZenohSettings("peer"), {40_001}, False),
        (ZenohSettings("router", ("unixsock-stream//run/bus",)), set(), False),
        (ZenohSettings("client", (), ("tcp/robot:7447",)), set(), False),
    ],
    ids=["plain", "secured", "a peer's own", "in the file system", "a client's"],
)
def test_a_door_to_which_strangers_come_in_plain_text_has_a_keeper(
    settings: ZenohSettings, opened: set[int], kept: bool, session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Ports of this process on which another session listens are nothing to it."""
    others, held = {7000}, list[set[int]]()
    ports = iter([others, others | opened])
    monkeypatch.setattr(module, "listening_ports", lambda: next(ports))
    monkeypatch.setattr(module, "defer_accept", held.append)
    assert ZenohTransport(settings)._session is session
    assert Kept.doors == ([opened] if kept else [])
    assert held == [opened]


class Query:
    """A question that came; what is replied to it goes into ``replies``."""

    def __init__(self, key: str, payload: bytes | None, stamp: bytes | None) -> None:
        self.key_expr = key
        self.payload = None if payload is None else SimpleNamespace(to_bytes=lambda: payload)
        self.attachment = None if stamp is None else SimpleNamespace(to_bytes=lambda: stamp)
        self.replies: list[tuple[str, bytes, bytes]] = []
        self.ended = 0

    def reply(self, key: str, answer: bytes, attachment: bytes) -> None:
        self.replies.append((key, answer, attachment))

    def __enter__(self) -> Query:
        return self

    def __exit__(
        self, kind: type[BaseException] | None, error: BaseException | None, trace: TracebackType | None
    ) -> None:
        self.ended += 1


@pytest.mark.parametrize(
    ("stamp", "answer", "heard"),
    [
        (stamp_of(KEY), b"so", True),
        (None, b"so", True),
        (stamp_of("safedpa/f/r2/request"), b"so", False),
        (stamp_of(KEY), None, True),
    ],
    ids=["its own", "none", "another's", "nothing to say"],
)
@pytest.mark.parametrize("payload", [b"what", None])
def test_a_question_is_answered_under_its_own_key_and_one_that_went_astray_is_not(
    stamp: bytes | None,
    answer: bytes | None,
    heard: bool,
    payload: bytes | None,
    session: Session,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    import zenoh

    questions: list[tuple[str, bytes]] = []

    def on_question(key: str, asked: bytes) -> bytes | None:
        questions.append((key, asked))
        return answer

    monkeypatch.setattr(zenoh.handlers, "Callback", lambda asked: asked)
    monkeypatch.setattr(module, "listening_ports", set)
    ZenohTransport(ZenohSettings("client", (), ("tcp/robot:7447",))).answer("safedpa/f/*/request", on_question)
    query = Query(KEY, payload, stamp)
    session.asked(query)
    assert questions == ([(KEY, payload or b"")] if heard else [])
    assert query.replies == ([(KEY, answer, stamp_of(KEY))] if heard and answer is not None else [])
    assert query.ended == 1


def test_an_error_in_an_answer_is_told_where_errors_of_threads_are(
    session: Session, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Zenoh would print it, and the process would go on, mute."""
    import zenoh

    told: list[str] = []
    monkeypatch.setattr("sys.excepthook", lambda _, error, __: told.append(str(error)))
    monkeypatch.setattr(zenoh.handlers, "Callback", lambda asked: asked)
    monkeypatch.setattr(module, "listening_ports", set)

    def on_question(_: str, __: bytes) -> bytes:
        raise RuntimeError("planted")

    ZenohTransport(ZenohSettings("client", (), ("tcp/robot:7447",))).answer("safedpa/f/*/request", on_question)
    query = Query(KEY, b"what", None)
    session.asked(query)
    assert (told, query.replies, query.ended) == (["planted"], [], 1)


@pytest.mark.parametrize(("listens", "connects"), [((), ("tcp/h:1",)), (("tcp/h:1",), ()), (("tls/h:1", "ws/h:2"), ())])
def test_with_a_certificate_nothing_goes_by_another_way_than_tls(
    listens: tuple[str, ...], connects: tuple[str, ...]
) -> None:
    card = Card("r", b"", b"", b"")
    with pytest.raises(BusError, match=r"^bus: got endpoint '(tcp|ws)/h:.' with certificates, wanted tls/HOST:PORT"):
        ZenohSettings("router", listens, connects, card)
    with pytest.raises(BusError, match=r"^bus: got certificates for a peer, wanted --mode client"):
        ZenohSettings("peer", certificates=card)
    assert ZenohSettings("router", listens, connects).certificates is None
    assert ZenohSettings("client", (), ("tls/h:1",), card).certificates is card


@pytest.mark.parametrize(("astray", "put", "taken"), [(False, True, True), (True, True, False), (False, False, False)])
def test_what_was_sent_under_another_key_or_takes_something_away_is_passed_over(
    astray: bool, put: bool, taken: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    import zenoh

    told: list[str] = []
    monkeypatch.setattr(module, "astray", lambda *_: astray)
    monkeypatch.setattr(module, "log_event", lambda kind, *_, **__: told.append(kind))
    heard: list[tuple[str, bytes]] = []
    subscription: Any = _ZenohSubscription.__new__(_ZenohSubscription)
    subscription._on_sample = lambda key, payload: heard.append((key, payload))
    sample = SimpleNamespace(
        kind=zenoh.SampleKind.PUT if put else zenoh.SampleKind.DELETE,
        key_expr="safedpa/f/r/state",
        attachment=None,
        payload=SimpleNamespace(to_bytes=lambda: b"data"),
    )
    subscription._received(sample)
    assert heard == ([("safedpa/f/r/state", b"data")] if taken else [])
    assert told == (["bus.astray"] if astray and put else [])
