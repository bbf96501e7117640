"""Who is linked, by what Zenoh tells of each link: names, addresses, and which of them are cut off."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from safedpa.bus import ZenohTransport
from safedpa.bus.transport import zenoh_transport as module

LINKS = {
    "one": ("tcp/10.0.0.1:7447", "robot.r1"),
    "two": ("tls/10.0.0.2:51000?rel=1#iface=eth0", "robot.r2"),
    "three": ("tcp/[fe80::1]:7448", None),
    "four": ("unixsock-stream//run/bus", ""),
}
FAR = {"one": ("10.0.0.1", 7447), "two": ("10.0.0.2", 51000), "three": ("fe80::1", 7448)}


def transport_of() -> tuple[ZenohTransport, list[float]]:
    """A transport over a session that links as above; how long it was asked to wait for tokens."""
    waited: list[float] = []

    def get(_: str, timeout: float) -> list[Any]:
        waited.append(timeout)
        token = SimpleNamespace(key_expr="safedpa/fleet/r1/alive")
        return [SimpleNamespace(ok=token), SimpleNamespace(ok=None), SimpleNamespace(ok=token)]

    links = [SimpleNamespace(zid=zid, dst=dst, auth_identifier=name) for zid, (dst, name) in LINKS.items()]
    session = SimpleNamespace(info=SimpleNamespace(links=lambda: links), liveliness=lambda: SimpleNamespace(get=get))
    transport = ZenohTransport.__new__(ZenohTransport)
    transport._session = session  # type: ignore[assignment]
    return transport, waited


def test_members_have_the_names_of_their_certificates_and_none_in_plain_text() -> None:
    transport, _ = transport_of()
    assert transport.members() == [("one", "robot.r1"), ("two", "robot.r2"), ("three", ""), ("four", "")]
    assert [transport.name_of(zid) for zid in ("two", "three", "nobody")] == ["robot.r2", "", ""]


@pytest.mark.parametrize(
    ("sessions", "ends"),
    [
        (None, {"one", "two", "three"}),
        ({"two"}, {"two"}),
        ({"one", "three"}, {"one", "three"}),
        ({"four"}, set()),
        ({"nobody"}, set()),
        (set(), set()),
    ],
)
def test_only_the_links_of_these_sessions_are_ended_and_only_where_they_have_a_port(
    sessions: set[str] | None, ends: set[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    transport, _ = transport_of()
    assert transport._far_ends(sessions) == {FAR[name] for name in ends}
    asked: list[Any] = []

    def cut_off(far_ends: Any) -> int:
        asked.append(far_ends)
        return len(far_ends)

    monkeypatch.setattr(module, "cut_off", cut_off)
    if sessions is not None:
        assert transport.cut_off(sessions) == len(ends)
        assert asked == ([{FAR[name] for name in ends}] if ends else [])


def test_who_is_there_is_asked_for_a_second_at_most_and_each_named_once() -> None:
    transport, waited = transport_of()
    assert transport.alive("safedpa/fleet/*/alive") == ["safedpa/fleet/r1/alive"]
    assert 0.5 <= waited[0] <= 2.0
