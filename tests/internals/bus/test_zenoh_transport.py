"""A transport over Zenoh without a network: which ports it guards, and how it reads Zenoh's list of links."""

from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.security.certificates import PemCredentials
from safedpa.bus.transport import zenoh as module

CARD = PemCredentials("router", b"", b"", b"")


@pytest.mark.parametrize(
    ("settings", "opened", "guarded"),
    [
        (ZenohSettings("router", ("tcp/0.0.0.0:7447",)), {7447}, True),
        (ZenohSettings("router", ("tls/0.0.0.0:7447",), certificates=CARD), {7447}, False),
        (ZenohSettings("peer"), {40_001}, False),
        (ZenohSettings("router", ("unixsock-stream//run/bus",)), set(), False),
        (ZenohSettings("client", (), ("tcp/robot:7447",)), set(), False),
    ],
    ids=["plain", "secured", "a peer's own", "in the file system", "a client's"],
)
def test_a_plain_text_port_that_was_asked_for_is_guarded(settings, opened, guarded, monkeypatch):
    """At all its ports the kernel holds back silent connections; ports of other sessions of the process are left."""
    others, deferred, retained = {7000}, list[set[int]](), list[set[int]]()
    ports = iter([others, others | opened])
    monkeypatch.setattr(module, "zenoh_session_configuration", lambda _: None)
    monkeypatch.setattr(module, "open_session", lambda _: SimpleNamespace())
    monkeypatch.setattr(module, "listening_ports", lambda: next(ports))
    monkeypatch.setattr(module, "defer_accept", deferred.append)
    monkeypatch.setattr(module, "ConnectionReaper", lambda found, _: retained.append(found))
    ZenohTransport(settings)
    assert deferred == [opened]
    assert retained == ([opened] if guarded else [])


LINKS = {
    "one": ("tcp/10.0.0.1:7447", "robot.r1", ("10.0.0.1", 7447)),
    "two": ("tls/10.0.0.2:51000?rel=1#iface=eth0", "robot.r2", ("10.0.0.2", 51000)),
    "three": ("tcp/[fe80::1]:7448", None, ("fe80::1", 7448)),
    "four": ("unixsock-stream//run/bus", "", None),
}


@pytest.fixture
def transport() -> Any:
    """A transport over a session with these links; ``waited`` is how long it was asked to wait for signs of life."""
    token = SimpleNamespace(key_expr="safedpa/fleet/r1/alive")
    found: Any = ZenohTransport.__new__(ZenohTransport)
    found.waited = list[float]()

    def get(_: str, timeout: float) -> list[Any]:
        found.waited.append(timeout)
        return [SimpleNamespace(ok=token), SimpleNamespace(ok=None), SimpleNamespace(ok=token)]

    links = [SimpleNamespace(zid=zid, dst=dst, auth_identifier=name) for zid, (dst, name, _) in LINKS.items()]
    found._session = SimpleNamespace(
        info=SimpleNamespace(links=lambda: links), liveliness=lambda: SimpleNamespace(get=get)
    )
    return found


def test_members_have_the_names_of_their_certificates_and_none_in_plain_text(transport: Any) -> None:
    assert transport.members() == [("one", "robot.r1"), ("two", "robot.r2"), ("three", ""), ("four", "")]
    assert [transport.name_of(zid) for zid in ("two", "three", "unknown")] == ["robot.r2", "", ""]


@pytest.mark.parametrize("sessions", [{"two"}, {"one", "three"}, {"four"}, {"unknown"}, set()])
def test_the_links_of_the_named_sessions_are_cut_off_where_they_have_a_port(sessions, transport, monkeypatch):
    asked: list[Any] = []
    monkeypatch.setattr(module, "cut_off", lambda ends: asked.append(ends) or len(ends))
    ends = {LINKS[name][2] for name in sessions & set(LINKS)} - {None}
    assert transport.cut_off(sessions) == len(ends)
    assert asked == ([ends] if ends else [])
    assert transport._peer_addresses() == {end for _, _, end in LINKS.values()} - {None}


def test_signs_of_life_are_waited_for_a_second_and_each_is_named_once(transport: Any) -> None:
    assert transport.alive("safedpa/fleet/*/alive") == ["safedpa/fleet/r1/alive"]
    assert 0.5 <= transport.waited[0] <= 2.0
