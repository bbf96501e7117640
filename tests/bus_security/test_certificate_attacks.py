"""Who gets onto a secured bus at all. Every refusal has a twin that gets in."""

import socket
import ssl
import time
from pathlib import Path
from typing import Any

import pytest

from safedpa.bus import ZenohSettings, ZenohTransport
from safedpa.bus.security.certificate_authority import HOSTS, Authority
from safedpa.bus.security.certificates import Certificates
from safedpa.errors import BusError

pytestmark = pytest.mark.processes


def attempt(endpoint: str, card: Certificates | None, patience: float = 0.5) -> None:
    ZenohTransport(ZenohSettings("client", (), (endpoint,), card, connect_timeout=patience)).close()


def gets_in(endpoint: str, card: Certificates | None) -> None:
    """However long a busy machine takes for the handshake."""
    attempt(endpoint, card, 90.0)


def test_the_fleets_own_certificate_gets_in(network: Any) -> None:
    network.start(guarded=True)
    gets_in(network.endpoint, network.card("safety_filter"))


@pytest.fixture
def foreign(tmp_path: Path) -> Path:
    """The folder of another authority that calls itself the same."""
    authority = Authority(tmp_path / "foreign", "f")
    for role in ("safety_filter", "router"):
        authority.issue(role, 1.0, HOSTS if role == "router" else ())
    return authority.folder


def test_a_certificate_of_a_foreign_authority_is_refused(network: Any, foreign: Path) -> None:
    network.start(guarded=True)
    with pytest.raises(BusError, match="could not open"):
        attempt(network.endpoint, Certificates(foreign, "safety_filter"))
    (foreign / "authority.pem").write_bytes((network.folder / "authority.pem").read_bytes())
    with pytest.raises(BusError, match="could not open"):  # even if the attacker trusts the router
        attempt(network.endpoint, Certificates(foreign, "safety_filter"))


def test_a_router_of_a_foreign_authority_is_not_trusted(network: Any, foreign: Path) -> None:
    network.opened(ZenohSettings("router", (network.endpoint,), (), Certificates(foreign, "router")))
    gets_in(network.endpoint, Certificates(foreign, "safety_filter"))  # the twin: its own believe it
    with pytest.raises(BusError, match="could not open"):
        attempt(network.endpoint, network.card("safety_filter"))


def test_an_expired_certificate_is_refused(network: Any) -> None:
    network.start(guarded=True)
    authority = Authority(network.folder, network.fleet)
    authority.issue("expiring", 1.0)
    gets_in(network.endpoint, network.card("expiring"))
    authority.issue("expiring", 0.2 / 86400.0)
    ends = time.time() + 1.2

    def refused() -> bool:
        try:
            attempt(network.endpoint, network.card("expiring"))
        except BusError:
            return True
        return False

    assert network.until(lambda: time.time() > ends and refused())


def tls_client(network: Any, role: str | None) -> bytes:
    """What a program that speaks TLS, but no Zenoh, reads from the router."""
    context = ssl.create_default_context(cafile=str(network.folder / "authority.pem"))
    if role is not None:
        context.load_cert_chain(network.folder / f"{role}.pem", network.folder / f"{role}.key.pem")
    host, port = network.endpoint.removeprefix("tls/").split(":")
    with (
        socket.create_connection((host, int(port)), timeout=30.0) as raw,
        context.wrap_socket(raw, server_hostname=host) as secured,
    ):
        secured.sendall(b"\x00\x00\x00")
        return secured.recv(16)


def test_a_process_without_a_certificate_is_refused(network: Any) -> None:
    network.start(guarded=True)
    assert tls_client(network, "safety_filter")  # the router hangs up in its own protocol: it got that far
    with pytest.raises(ssl.SSLError, match="CERTIFICATE_REQUIRED"):
        tls_client(network, None)


def test_plain_text_is_refused(network: Any, free_port: int) -> None:
    endpoint = f"tcp/127.0.0.1:{free_port}"
    network.start(guarded=True)
    with pytest.raises(BusError, match="could not open"):
        attempt(endpoint, None)
    network.close()
    network.opened(ZenohSettings("router", (endpoint,)))
    gets_in(endpoint, None)


def test_a_service_cannot_pose_as_the_router(network: Any) -> None:
    """Its certificate may open connections, not accept them."""
    network.opened(ZenohSettings("router", (network.endpoint,), (), network.card("policy")))
    with pytest.raises(BusError, match="could not open"):
        attempt(network.endpoint, network.card("safety_filter"))


def test_a_router_is_believed_only_under_its_own_names(network: Any, free_port: int) -> None:
    network.opened(ZenohSettings("router", (f"tls/0.0.0.0:{free_port}",), (), network.card("router")))
    for host in ("127.0.0.1", "localhost"):
        gets_in(f"tls/{host}:{free_port}", network.card("safety_filter"))
    with pytest.raises(BusError, match="could not open"):
        attempt(f"tls/127.0.0.2:{free_port}", network.card("safety_filter"))


def test_plain_text_beyond_this_machine_logs_a_warning(free_port: int, capsys: pytest.CaptureFixture[str]) -> None:
    ZenohTransport(ZenohSettings("router", (f"tcp/127.0.0.1:{free_port}",))).close()
    assert capsys.readouterr().err == ""
    ZenohTransport(ZenohSettings("router", (f"tcp/0.0.0.0:{free_port}",))).close()
    assert '"kind": "bus.plain_text"' in capsys.readouterr().err
