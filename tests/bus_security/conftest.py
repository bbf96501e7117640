"""A fleet's certificates, made once; a router of its own for every test, and who connects to it."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.security.access import ROUTER, access_control, roles_of, size_limits
from safedpa.bus.security.authority import HOSTS, Authority
from safedpa.bus.security.certificates import Certificates
from safedpa.bus.transport import zenoh_transport

FLEET = "f"
ROBOTS = ("r1", "r2")
STRANGERS = ("intruder", "robot.r3", "robot", "safety_filter.f")
"""To whom the authority gave certificates, but who are none of the router's roles."""
PATIENCE = 90.0


def until(condition: Callable[[], bool], every: float = 0.005) -> bool:
    """Whether the condition comes true in time; it is asked every so many s."""
    end = time.monotonic() + PATIENCE
    pause = threading.Event()
    while not condition():
        if time.monotonic() > end:
            return False
        pause.wait(every)
    return True


@pytest.fixture(scope="session")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a fleet with two robots, and of strangers."""
    folder = tmp_path_factory.mktemp("certificates")
    authority = Authority(folder, FLEET)
    for role in (*roles_of(ROBOTS), *STRANGERS, "router.west"):
        authority.issue(role, 1.0, HOSTS if role.startswith(ROUTER) else ())
    return folder


class Ear:
    """What one session hears under a key expression; deletions too."""

    def __init__(self, transport: ZenohTransport, *keys: str) -> None:
        import zenoh

        self.heard: list[tuple[str, bytes, str]] = []
        handler: Any = zenoh.handlers.Callback(self._received, indirect=False)
        self._kept = [transport._session.declare_subscriber(key, handler) for key in keys]

    def _received(self, sample: Any) -> None:
        kind = str(sample.kind).rsplit(".", maxsplit=1)[-1]
        self.heard.append((str(sample.key_expr), sample.payload.to_bytes(), kind))

    @property
    def keys(self) -> set[str]:
        return {key for key, _, _ in self.heard}

    def of(self, payload: bytes) -> set[str]:
        """Keys under which that payload came."""
        return {key for key, heard, _ in self.heard if heard == payload}


class Network:
    """One router, and sessions of roles that connect to it."""

    fleet = FLEET
    robots = ROBOTS
    strangers = STRANGERS
    patience = PATIENCE
    until = staticmethod(until)

    def __init__(self, folder: Path, port: int) -> None:
        self.folder, self.endpoint = folder, f"tls/127.0.0.1:{port}"
        self._open: list[ZenohTransport] = []

    def start(self, *, guarded: bool, **more: Any) -> ZenohTransport:
        """The router; ``guarded`` with access control and size limits, else with mutual TLS alone."""
        rules: dict[str, Any] = {}
        if guarded:
            rules = {"access": access_control(FLEET, ROBOTS), "limits": tuple(size_limits(FLEET))}
        self.router = self.opened(ZenohSettings("router", (self.endpoint,), (), self.card(ROUTER), **rules, **more))
        return self.router

    def card(self, role: str) -> Certificates:
        return Certificates(self.folder, role)

    def join(self, role: str) -> ZenohTransport:
        return self.opened(ZenohSettings("client", (), (self.endpoint,), self.card(role), patience=PATIENCE))

    def join_as(self, role: str, mode: Any) -> ZenohTransport:
        return self.opened(ZenohSettings(mode, (), (self.endpoint,), self.card(role), patience=PATIENCE))

    def opened(self, settings: ZenohSettings) -> ZenohTransport:
        transport = ZenohTransport(settings)
        self._open.append(transport)
        return transport

    def leave(self, transport: ZenohTransport) -> None:
        """Closes a session and waits until the router has taken everything that it sent."""
        session = str(transport._session.info.zid())
        transport.close()
        assert until(lambda: not any(str(link.zid) == session for link in self.router._session.info.links()))

    def ear(self, transport: ZenohTransport, *keys: str) -> Ear:
        return Ear(transport, *keys)

    def fence(self, ear: Ear) -> None:
        """Returns when the ear has heard whatever was sent by sessions that have left."""
        sender = self.join("adaptation")
        key, payload = f"safedpa/{FLEET}/-/health/adaptation", str(len(ear.heard)).encode() + b" fence"

        def heard() -> bool:
            sender._session.put(key, payload)
            return bool(ear.of(payload))

        assert until(heard)
        sender.close()

    def close(self) -> None:
        for transport in reversed(self._open):
            transport.close()


@pytest.fixture
def network(certificates: Path, free_port: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Network]:
    """A router that is not started yet.

    Signs of life may wait for longer than between the robots: these tests ask who may say what, once, and on a machine
    with too much to do a link that is lost takes with it what was said.
    """
    monkeypatch.setattr(zenoh_transport, "_LEASE_MILLISECONDS", 30_000)
    made = Network(certificates, free_port)
    yield made
    made.close()
