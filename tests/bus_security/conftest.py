"""A fleet's certificates, made once; a router of its own for every test, and who connects to it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from tests.waiting import until

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.security.access_control import ROUTER, access_control, roles_of, size_limits
from safedpa.bus.security.certificate_authority import HOSTS, Authority
from safedpa.bus.security.certificates import Certificates
from safedpa.bus.transport.zenoh import open_session, zenoh_session_configuration

FLEET = "f"
ROBOTS = ("r1", "r2")
STRANGERS = ("intruder", "robot.r3", "robot", "safety_filter.f")
"""To whom the authority gave certificates, but who are none of the router's roles."""
PATIENCE = 90.0


@pytest.fixture(scope="session")
def certificates(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a fleet with two robots, and of strangers."""
    folder = tmp_path_factory.mktemp("certificates")
    authority = Authority(folder, FLEET)
    for role in (*roles_of(ROBOTS), *STRANGERS, "router.west"):
        authority.issue(role, 1.0, HOSTS if role.startswith(ROUTER) else ())
    return folder


class Ear:
    """What one session of Zenoh hears under a key expression; deletions too."""

    def __init__(self, session: Any, *keys: str) -> None:
        import zenoh

        self.heard: list[tuple[str, bytes, str]] = []
        handler: Any = zenoh.handlers.Callback(self._received, indirect=False)
        self._retained = [session.declare_subscriber(key, handler) for key in keys]

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
        self.open: list[Any] = []
        self.roles: dict[int, str] = {}

    def start(self, *, guarded: bool, **more: Any) -> ZenohTransport:
        """The router; ``guarded`` with access control and size limits, else with mutual TLS alone."""
        rules: dict[str, Any] = {}
        if guarded:
            rules = {"access": access_control(FLEET, ROBOTS), "limits": tuple(size_limits(FLEET))}
        self.router = self.opened(ZenohSettings("router", (self.endpoint,), (), self.card(ROUTER), **rules, **more))
        return self.router

    def card(self, role: str) -> Certificates:
        return Certificates(self.folder, role)

    def settings(self, role: str, endpoint: str = "", mode: Any = "client") -> ZenohSettings:
        return ZenohSettings(mode, (), (endpoint or self.endpoint,), self.card(role), connect_timeout=PATIENCE)

    def join(self, role: str, endpoint: str = "") -> ZenohTransport:
        """A member of the fleet, as a process of the product joins."""
        return self.opened(self.settings(role, endpoint))

    def raw(self, role: str, endpoint: str = "", mode: Any = "client") -> Any:
        """A session of Zenoh with the certificate of a role, which sends whatever it likes."""
        session = open_session(zenoh_session_configuration(self.settings(role, endpoint, mode).configuration()))
        self.open.append(session)
        self.roles[id(session)] = role
        return session

    def opened(self, settings: ZenohSettings) -> ZenohTransport:
        transport = ZenohTransport(settings)
        self.open.append(transport)
        self.roles[id(transport)] = settings.certificates.role if settings.certificates else ""
        return transport

    def leave(self, session: Any) -> None:
        """Closes a session and waits until the router has taken everything that it sent."""
        role = self.roles[id(session)]

        def linked() -> int:
            return len({zid for zid, name in self.router.members() if name == role})

        before = linked()
        session.close()
        assert until(lambda: linked() < max(before, 1))

    def ear(self, session: Any, *keys: str) -> Ear:
        return Ear(session, *keys)

    def fence(self, ear: Ear) -> None:
        """Returns when the ear has heard whatever was sent by sessions that have left."""
        sender = self.raw("adaptation")
        key, payload = f"safedpa/{FLEET}/-/health/adaptation", str(len(ear.heard)).encode() + b" fence"

        def heard() -> bool:
            sender.put(key, payload)
            return bool(ear.of(payload))

        assert until(heard)
        sender.close()

    def close(self) -> None:
        for session in reversed(self.open):
            session.close()


@pytest.fixture
def network(certificates: Path, free_port: int, monkeypatch: pytest.MonkeyPatch) -> Iterator[Network]:
    """A router that is not started yet.

    Signs of life may take longer than between the robots: these tests send each message once, and on a busy machine a
    lost link would take the messages on it along.
    """
    usual = ZenohSettings.configuration
    longer = {"transport/link/tx/lease": 30_000}
    monkeypatch.setattr(ZenohSettings, "configuration", lambda settings: usual(settings) | longer)
    made = Network(certificates, free_port)
    yield made
    made.close()
