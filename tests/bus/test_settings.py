"""How a process joins the network: what its settings become in Zenoh's configuration, and which are refused."""

import pytest

from safedpa.bus import ZenohSettings
from safedpa.bus.security.certificates import PemCredentials
from safedpa.errors import BusError

CARD = PemCredentials("policy", *[b"-----BEGIN "] * 3)
LEASE, ACCEPT, CONNECT = "transport/link/tx/lease", "transport/unicast/accept_timeout", "connect/timeout_ms"
ROUTER = ZenohSettings("router", ("tcp/0.0.0.0:7447",))
CLIENT = ZenohSettings("client", connect=("tcp/robot:7447",))
HERE = ZenohSettings("peer", ("tcp/127.0.0.1:7447",))
ELSEWHERE = ZenohSettings("peer", ("tcp/0.0.0.0:7447",))


@pytest.mark.parametrize(
    ("settings", "lease"),
    [(ROUTER, 500), (CLIENT, 500), (ELSEWHERE, 500), (HERE, 2000), (ZenohSettings(), 2000)],
    ids=["router", "client", "peer", "peer on one machine", "peer that looks for others"],
)
def test_a_lost_link_is_noticed_within_half_a_second_and_on_one_machine_a_busy_one_is_kept(
    settings: ZenohSettings, lease: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A robot that hears nothing brakes by itself; a longer lease would deliver old commands after a partition."""
    monkeypatch.undo()  # the tests of this folder let links live longer
    configuration = settings.configuration()
    assert configuration[LEASE] == lease
    assert 500 <= configuration[ACCEPT] <= 2000, "ms for a handshake"
    assert 5_000 <= configuration[CONNECT] <= 20_000, "ms until a process reports that it cannot connect"


def test_a_handshake_of_tls_ends_within_two_seconds() -> None:
    (endpoint,) = ZenohSettings("router", ("tls/0.0.0.0:7447",), certificates=CARD).configuration()["listen/endpoints"]
    endpoint, _, milliseconds = endpoint.partition("#tls_handshake_timeout_ms=")
    assert endpoint == "tls/0.0.0.0:7447"
    assert 500 <= int(milliseconds) <= 2000


@pytest.mark.parametrize(
    ("mode", "listen", "connect", "refused"),
    [
        ("client", (), ("tls/router:7447",), ""),
        ("router", ("tls/0.0.0.0:7447",), ("tls/other:7447",), ""),
        ("client", (), ("tcp/router:7447",), "got endpoint 'tcp/router:7447' with certificates, wanted tls/HOST:PORT"),
        ("router", ("tcp/0.0.0.0:7447",), (), "got endpoint 'tcp/0.0.0.0:7447' with certificates"),
        ("router", ("tls/h:1", "ws/h:2"), (), "got endpoint 'ws/h:2' with certificates"),
        ("peer", (), ("tls/router:7447",), "got certificates for a peer, wanted --mode client"),
        ("peer", (), (), "got certificates for a peer, wanted --mode client"),
    ],
)
def test_a_process_with_a_certificate_speaks_tls_through_a_router_only(mode, listen, connect, refused):
    assert ZenohSettings(mode, listen, connect).certificates is None
    if refused:
        with pytest.raises(BusError, match=f"^bus: {refused}"):
            ZenohSettings(mode, listen, connect, CARD)
        return
    configuration = ZenohSettings(mode, listen, connect, CARD).configuration()
    assert configuration["transport/link/protocols"] == ["tls"]
    tls = configuration["transport/link/tls"]
    assert tls["enable_mtls"] is tls["verify_name_on_connect"] is tls["close_link_on_expiration"] is True


@pytest.mark.parametrize(
    ("settings", "one_of_two"),
    [
        (ZenohSettings(), True),
        (ZenohSettings(connect=("tcp/127.0.0.1:7447",)), True),
        (ZenohSettings(connect=("tcp/elsewhere:7447",)), False),
        (ZenohSettings("client", connect=("tcp/127.0.0.1:7447",)), False),
    ],
)
def test_of_two_peers_of_one_machine_one_connects(settings: ZenohSettings, one_of_two: bool) -> None:
    """Over several machines one of them may be the only one that reaches the other."""
    assert ("scouting/gossip/autoconnect_strategy" in settings.configuration()) == one_of_two


@pytest.mark.parametrize(
    ("endpoint", "plain"),
    [
        ("tcp/127.0.0.1:7447", False),
        ("tcp/127.5.0.1:7447", False),
        ("tcp/[::1]:7447", False),
        ("tcp/localhost:7447", False),
        ("unixsock-stream//run/bus", False),
        ("tls/robot:7447", False),
        ("tcp/robot:7447", True),
        ("tcp/0.0.0.0:7447", True),
        ("tcp/[::]:7447", True),
        ("tcp/192.168.0.1:7447?rel=1#iface=eth0", True),
        ("udp/10.0.0.1:7447", True),
        ("garbage", True),
    ],
)
def test_an_endpoint_that_other_machines_reach_without_tls_is_plain_text(endpoint: str, plain: bool) -> None:
    for settings in (ZenohSettings("router", (endpoint,)), ZenohSettings("client", connect=(endpoint,))):
        assert settings.plain_endpoints == ((endpoint,) if plain else ())


@pytest.mark.parametrize(
    ("settings", "finds"), [(ZenohSettings(), True), (HERE, False), (CLIENT, False), (ROUTER, False)]
)
def test_only_a_peer_without_endpoints_looks_for_others_and_only_on_this_machine(settings: ZenohSettings, finds: bool):
    configuration = settings.configuration()
    assert configuration["scouting/multicast/enabled"] is finds
    assert configuration["scouting/multicast/interface"] == "lo"
    if finds:
        assert configuration["listen/endpoints"] == ["tcp/127.0.0.1:0"]
