"""Which keys, endpoints, certificates, names and rates are refused: each condition alone, without a network."""

from __future__ import annotations

import argparse
import base64
import ctypes
import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus import Answer, Bus, MemoryBroker, MemoryTransport, Request, ZenohSettings, decode, encode
from safedpa.bus.loop.process import identity_from
from safedpa.bus.security.access import ROUTER, access_control, rate_limits
from safedpa.bus.security.authority import Authority
from safedpa.bus.security.certificates import Card, Certificates, close_memory
from safedpa.bus.wire.requests import AGREED, ORDER, REQUEST, SENSE, STATUS, request_key, robot_of_request
from safedpa.bus.wire.topics import BUNDLE, TOPICS
from safedpa.errors import BusError, InputError
from safedpa_services.router.__main__ import _parser, _settings

PEM = b"-----BEGIN "


@pytest.mark.parametrize("kind", [REQUEST, STATUS, ORDER, SENSE, AGREED])
def test_a_request_names_one_robot(kind: str) -> None:
    assert robot_of_request(request_key("f", "r1", kind)) == "r1"
    for key in (request_key("f", "*", kind), f"safedpa/f/r1/{kind}/x", f"safedpa/r1/{kind}", f"safedpa/**/{kind}"):
        with pytest.raises(InputError, match="wanted safedpa/FLEET/ROBOT/request"):
            robot_of_request(key)


@pytest.mark.parametrize("key", ["safedpa/f/r1/state", "safedpa/f/r1/", "safedpa/f/r*/request", ""])
def test_what_is_no_request_is_about_no_robot(key: str) -> None:
    with pytest.raises(InputError):
        robot_of_request(key)


@pytest.mark.parametrize(
    ("kind", "do", "reaches"),
    [(REQUEST, "accept", True), (REQUEST, "status", True), (STATUS, "status", True), (STATUS, "accept", False)],
)
def test_where_only_the_state_of_things_may_be_asked_nothing_is_ordered(kind: str, do: str, reaches: bool) -> None:
    transport = MemoryTransport(MemoryBroker())
    reached: list[str] = []
    told: list[Any] = []

    def answer(robot: str, request: Request) -> Answer:
        reached.append(f"{robot} {request.do}")
        return Answer(ok=True, sentence="so be it")

    bus = Bus(transport, "f")
    bus.answer_requests(answer, tell=lambda about, request, given: told.append((about, given.ok)))
    payload = transport.ask(request_key("f", "r1", kind), encode(Request(do=do)), 1.0)
    assert payload is not None
    assert decode(Answer, payload).ok is reaches
    assert reached == ([f"r1 {do}"] if reaches else [])
    assert told == [("r1", reaches)]


@pytest.mark.parametrize(
    ("mode", "listen", "connect", "refused"),
    [
        ("client", (), ("tls/router:7447",), False),
        ("router", ("tls/0.0.0.0:7447",), ("tls/other:7447",), False),
        ("client", (), ("tcp/router:7447",), True),
        ("router", ("tcp/0.0.0.0:7447",), (), True),
        ("router", ("tls/0.0.0.0:7447", "tcp/0.0.0.0:7448"), (), True),
        ("peer", (), ("tls/router:7447",), True),
    ],
)
def test_who_has_a_certificate_speaks_by_tls_through_a_router(
    mode: Any, listen: tuple[str, ...], connect: tuple[str, ...], refused: bool
) -> None:
    card = Card("policy", PEM, PEM, PEM)
    ZenohSettings(mode, listen, connect)
    if refused:
        with pytest.raises(BusError, match="wanted"):
            ZenohSettings(mode, listen, connect, card)
    else:
        ZenohSettings(mode, listen, connect, card)


@pytest.mark.parametrize(
    ("said", "accepted"),
    [
        ((PEM + b"A", PEM + b"B", PEM + b"C"), True),
        ((PEM + b"A", PEM + b"B"), False),
        ((PEM + b"A", PEM + b"B", PEM + b"C", PEM + b"D"), False),
        ((PEM + b"A", b"B", PEM + b"C"), False),
        ((b"",), False),
    ],
)
def test_a_card_has_three_parts_in_pem(said: tuple[bytes, ...], accepted: bool) -> None:
    reading, writing = os.pipe()
    os.write(writing, b"\0".join(said))
    os.close(writing)
    if accepted:
        card = Card.from_descriptor(reading, "policy")
        assert (card.role, card.authority, card.certificate, card.key) == ("policy", *said)
    else:
        with pytest.raises(BusError, match="no authority, certificate and key"):
            Card.from_descriptor(reading, "policy")


@pytest.mark.parametrize(
    ("name", "robots", "refused"),
    [("router.west", (), False), ("router.west", ("r1",), False), ("router", (), True), ("policy", (), True),
     ("west", (), True), ("router.west", ("",), True)],
)  # fmt: skip
def test_a_link_is_that_of_a_named_router(name: str, robots: tuple[str, ...], refused: bool) -> None:
    if refused:
        with pytest.raises(InputError):
            access_control("f", ["r1"], {name: robots})
        return
    subjects = [subject["id"] for subject in access_control("f", ["r1"], {name: robots})["subjects"]]
    assert {name, ROUTER} <= set(subjects)


def test_what_is_told_at_every_tick_is_limited_in_rate_and_nothing_that_must_not_be_lost() -> None:
    """Each rule is of one topic of one robot, or of bundles; none for a topic whose messages all count."""
    assert rate_limits("f", []) == []
    (limits,) = rate_limits("f", ["r1", "r2"])
    keys = [rule["key_expr"].split("/") for rule in limits["rules"]]
    assert all(rule["freq"] > 0 for rule in limits["rules"])
    ticking = {name for name, topic in TOPICS.items() if topic.delivery == "latest" and not topic.per_service}
    bundled = {name for name in ticking if TOPICS[name].bundles}
    for robot, topics in (("r1", ticking), ("r2", ticking), (BUNDLE, bundled)):
        assert sorted(key[3] for key in keys if key[2] == robot and key[3] != "health") == sorted(topics)
    assert {len(key) for key in keys if key[3] == "health"} == {5}, "a heartbeat is of its service alone"


def options_of(*words: str) -> argparse.Namespace:
    return _parser().parse_args(["--fleet", "f", "--robot", "r1", *words])


@pytest.mark.parametrize(
    ("words", "said"),
    [
        ((), "--listen: got none"),
        (("--listen", "tls/0.0.0.0:7447"), "--certificates: got none"),
        (("--listen", "tcp/0.0.0.0:7447", "--plain", "--certificates", "."), "--plain: got it together"),
        (("--listen", "tcp/0.0.0.0:7447", "--plain", "--card", "9"), "--plain: got it together"),
        (("--listen", "tcp/0.0.0.0:7447", "--plain"), ""),
    ],
)
def test_a_router_is_told_who_it_is_or_that_nobody_is_denied_anything(words: tuple[str, ...], said: str) -> None:
    if said:
        with pytest.raises(InputError, match=said):
            _settings(options_of(*words))
        return
    settings = _settings(options_of(*words))
    assert (settings.certificates, settings.access) == (None, None)
    assert settings.rates == tuple(rate_limits("f", ["r1"]))


@pytest.mark.parametrize("by", ["folder", "card"])
def test_a_router_with_a_certificate_denies_and_forgets_those_that_were_revoked(
    by: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("safedpa.bus.loop.process.close_memory", lambda: None)  # of this test's process
    authority = Authority(tmp_path, "f")
    for role in (ROUTER, "policy"):
        authority.issue(role, 1.0)
    (tmp_path / "revoked.txt").write_text("policy\n")
    words = ["--certificates", str(tmp_path)]
    if by == "card":
        words = ["--card", str(Card.of(tmp_path, ROUTER).pipe())]
    settings = _settings(options_of("--listen", "tls/0.0.0.0:7447", *words))
    assert settings.certificates is not None
    assert settings.access is not None
    told = {subject for policy in settings.access["policies"] for subject in policy["subjects"]}
    assert ("policy" in told) is (by == "card")
    assert "safety_filter" in told


def test_a_role_without_a_certificate_is_refused() -> None:
    for role in ("", "policy"):
        options = argparse.Namespace(card=None, certificates=None, role=role)
        if role:
            with pytest.raises(BusError, match="--role policy: got no --certificates"):
                identity_from(options)
        else:
            assert identity_from(options) is None


@pytest.mark.parametrize(("result", "closed"), [(0, True), (-1, False), (1, False)])
def test_memory_is_closed_where_the_kernel_says_so(monkeypatch: pytest.MonkeyPatch, result: int, closed: bool) -> None:
    """prctl(2): PR_SET_DUMPABLE is 4, SUID_DUMP_DISABLE 0; with anything behind them it may answer EINVAL."""
    asked: list[tuple[int, ...]] = []

    def prctl(*words: int) -> int:
        asked.append(words)
        return result

    monkeypatch.setattr(ctypes, "CDLL", lambda name: SimpleNamespace(prctl=prctl))
    assert close_memory() is closed
    assert asked == [(4, 0, 0, 0, 0)]


@pytest.mark.parametrize("library", [SimpleNamespace(), None])
def test_where_the_system_knows_no_such_thing_memory_stays_open(monkeypatch: pytest.MonkeyPatch, library: Any) -> None:
    def opened(name: None) -> Any:
        if library is None:
            raise OSError("no library")
        return library

    monkeypatch.setattr(ctypes, "CDLL", opened)
    assert close_memory() is False


@pytest.mark.parametrize(
    ("mode", "told"), [(0o600, False), (0o640, False), (0o604, True), (0o602, True), (0o601, True)]
)
def test_a_key_is_exposed_where_others_than_its_group_may_do_anything(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], mode: int, told: bool
) -> None:
    Authority(tmp_path, "f").issue("policy", 1.0)
    (tmp_path / "policy.key.pem").chmod(mode)
    Certificates(tmp_path, "policy")
    assert ("bus.key_exposed" in capsys.readouterr().err) is told


def test_a_card_of_64_kib_is_read_whole(tmp_path: Path) -> None:
    """A pipe holds as much; what is longer is cut, and refused."""
    long = PEM + b"x" * 20_000
    descriptor = Card("policy", long, long, long).pipe()
    assert Card.from_descriptor(descriptor, "policy").key == long


def test_a_card_says_to_zenoh_what_its_files_say(tmp_path: Path) -> None:
    Authority(tmp_path, "f").issue("policy", 1.0)
    files, card = Certificates(tmp_path, "policy").tls(), Card.of(tmp_path, "policy").tls()
    assert {name: base64.b64decode(value) for name, value in card.items()} == {
        f"{name}_base64": Path(value).read_bytes() for name, value in files.items()
    }
    assert "PRIVATE" not in repr(Card.of(tmp_path, "policy"))
