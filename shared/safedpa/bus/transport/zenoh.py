"""The bus over eclipse-zenoh.

By default every process is a peer on this machine: nothing to install or start. Over several machines the topology is
static and explicit: ``client`` sessions that connect to a router, over mutual TLS where there are certificates. Peers
would speak past the router that enforces who may say what. What the settings below defend against was measured:
a lease of 0.5 s instead of 10 s, so that a partition is noticed and no burst of old commands arrives after it; direct
callbacks that only append to a queue; no shared memory; sends that drop rather than wait.

Zenoh sessions, opened and closed so that one that is stationary takes no other with it.
"""

from __future__ import annotations

import ipaddress
import json
import os
import sys
import threading
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, final

from safedpa.bus.logging import log_event
from safedpa.bus.messages.key_stamp import is_misrouted, key_stamp
from safedpa.bus.security.certificates import Certificates, PemCredentials
from safedpa.bus.security.connection_reaper import ConnectionReaper, cut_off, defer_accept, listening_ports
from safedpa.bus.transport.base import AbstractTransport, OnAnswer, OnQuestion, OnSample, Subscription
from safedpa.errors import BusError, InputError, JoinError
from safedpa.limits import readable

if TYPE_CHECKING:
    import zenoh

__all__ = [
    "Mode",
    "ZenohSettings",
    "ZenohTransport",
    "close_session",
    "open_session",
    "short_error_text",
    "zenoh_session_configuration",
]

_NET_THREADS = 4
"""Threads with which Zenoh opens and closes links, for all sessions of a process. By default it is one; where peers
come and go it waited for a lock whose holder waited for it, and every session of the process was stationary for good.
https://github.com/eclipse-zenoh/zenoh/issues/2581; ``deploy/zenoh_churn.py`` brings it about."""
_UNCLOSED: list[Any] = []
"""Sessions that did not close: letting go of one would close it again, for as long, and abort the thread."""


def zenoh_session_configuration(settings: Mapping[str, Any]) -> zenoh.Config:
    """Zenoh's configuration of paths and values. Raises zenoh.ZError for a value that cannot be."""
    import zenoh

    configuration = zenoh.Config()
    for path, value in settings.items():
        configuration.insert_json5(path, json.dumps(value))
    return configuration


def open_session(configuration: zenoh.Config) -> zenoh.Session:
    """A session. Raises zenoh.ZError where it cannot be opened."""
    import zenoh

    os.environ.setdefault("ZENOH_RUNTIME", f"(net: (worker_threads: {_NET_THREADS}))")  # read with the first session
    return zenoh.open(configuration)


def close_session(session: zenoh.Session) -> None:
    """Closes a session; one that does not close in Zenoh's 10 s is told, and kept: it ends with the process."""
    import zenoh

    if session.is_closed():
        return
    try:
        session.close()  # type: ignore[no-untyped-call]
    except zenoh.ZError as error:  # https://github.com/eclipse-zenoh/zenoh/issues/2675, on a busy machine
        _UNCLOSED.append(session)
        log_event("bus.unclosed", f"the bus could not be closed in peace ({short_error_text(error)})", level="warning")


def short_error_text(error: Exception) -> str:
    """What Zenoh says, on one line, without the places in its own sources."""
    return " ".join(str(error).split(" at /")[0].split())


Mode = Literal["peer", "client", "router"]

_LEASE_MILLISECONDS = 500
_LEASE_ON_ONE_MACHINE_MILLISECONDS = 2000
"""No network parts peers on one machine, but a machine that has too much to do keeps signs of life waiting for 0.5 s
and more, and a link between peers that found each other is not made again. A process that dies is seen at once anyway.
"""
_LOCAL_SOCKET = "unixsock-stream/"
"""Beginning of the endpoint of a socket in the file system: who may open the folder may connect, no one else."""
_ACCEPT_MILLISECONDS = 1000
"""For a handshake, once its first bytes are there: it takes 3 ms; by default a stranger has five times as long."""
_MOST_ON_THEIR_WAY = 2000
"""Connections whose handshake goes on; by default 100, and then no one else gets in."""
_ONE_OF_TWO = {"peer": {"to_router": "always", "to_peer": "greater-zid"}}
"""Of two peers that hear of each other one connects; if both do, one link must go again, and where peers come and go
a session takes 2 s to close instead of 0.4 s (``deploy/zenoh_churn.py``)."""
_ALIVE_TIMEOUT_SECONDS = 1.0
_MOST_GATHERED = 4096
"""Messages of one subscription that wait to be collected; beyond, the oldest give way. A thousand robots send so many
in four of their periods, and the loop collects every few milliseconds."""


@dataclass(frozen=True)
class ZenohSettings:
    """How this process joins the network.

    Without endpoints a peer listens on the loopback interface and finds others there by multicast. With ``connect`` it
    finds the others through those endpoints (and what they know), without multicast. With ``certificates`` every
    endpoint is ``tls/HOST:PORT``, both sides prove who they are, and no one is found who was not named. ``access``,
    ``limits`` and ``rates`` are a router's: Zenoh's ``access_control``, ``low_pass_filter`` and ``downsampling``.

    Raises BusError for certificates with a peer, or with an endpoint that is not TLS.
    """

    mode: Mode = "peer"
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    certificates: Certificates | PemCredentials | None = None
    access: Mapping[str, Any] | None = None
    limits: tuple[Mapping[str, Any], ...] = ()
    rates: tuple[Mapping[str, Any], ...] = ()
    patience: float = 10.0
    """s to go on trying to connect at the start; later, while it runs, it tries for ever."""

    def __post_init__(self) -> None:
        if self.certificates is None:
            return
        if self.mode == "peer":
            raise BusError(
                "bus: got certificates for a peer, wanted --mode client: peers speak past the router, which alone "
                "enforces who may say what"
            )
        for endpoint in (*self.listen, *self.connect):
            if not endpoint.startswith("tls/"):
                raise BusError(f"bus: got endpoint '{endpoint}' with certificates, wanted tls/HOST:PORT")

    @property
    def plain_endpoints(self) -> tuple[str, ...]:
        """Endpoints that other machines can reach and where anybody can listen and speak."""
        return tuple(
            endpoint
            for endpoint in (*self.listen, *self.connect)
            if not endpoint.startswith("tls/") and not _is_loopback(endpoint)
        )

    @property
    def _among_peers_of_one_machine(self) -> bool:
        return self.mode == "peer" and all(map(_is_loopback, (*self.listen, *self.connect)))

    def configuration(self) -> dict[str, Any]:
        """The Zenoh configuration as paths and values."""
        alone, among_peers = not self.listen and not self.connect, self._among_peers_of_one_machine
        listen = self.listen or ((_own_door(self.connect),) if self.mode == "peer" else ())
        return {
            "mode": self.mode,
            "listen/endpoints": [*map(_in_haste, listen)],
            "connect/endpoints": list(self.connect),
            "connect/timeout_ms": round(1000.0 * self.patience),
            "connect/exit_on_failure": True,
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 400, "period_increase_factor": 1.5},
            "scouting/multicast/enabled": alone,
            "scouting/multicast/interface": "lo",
            "scouting/gossip/enabled": self.mode == "peer",
            # over several machines one of the two may be the only one that reaches the other
            **({"scouting/gossip/autoconnect_strategy": _ONE_OF_TWO} if among_peers else {}),
            "scouting/delay": 200 if alone else 0,
            "timestamping/enabled": True,
            "transport/unicast/accept_timeout": _ACCEPT_MILLISECONDS,
            "transport/unicast/accept_pending": _MOST_ON_THEIR_WAY,
            "transport/link/tx/lease": _LEASE_ON_ONE_MACHINE_MILLISECONDS if among_peers else _LEASE_MILLISECONDS,
            "transport/shared_memory/enabled": False,
            **({} if self.certificates is None else _tls(self.certificates)),
            **({} if self.access is None else {"access_control": dict(self.access)}),
            **({"downsampling": [dict(rate) for rate in self.rates]} if self.rates else {}),
            **({"low_pass_filter": [dict(limit) for limit in self.limits]} if self.limits else {}),
        }


def _tls(certificates: Certificates | PemCredentials) -> dict[str, Any]:
    """Mutual TLS and nothing else; a connection ends when one of its certificates does."""
    return {
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            **certificates.tls(),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        },
    }


def _own_door(connect: tuple[str, ...]) -> str:
    """Where a peer listens that was not told: next to the socket of those it joins, or on the loopback interface."""
    alongside = next((endpoint for endpoint in connect if endpoint.startswith(_LOCAL_SOCKET)), "")
    if not alongside:
        return "tcp/127.0.0.1:0"
    return f"{alongside.rpartition('/')[0]}/{os.getpid()}-{os.urandom(4).hex()}"


def _in_haste(endpoint: str) -> str:
    """An endpoint to listen on where no one has longer for the handshake of TLS."""
    plain = not endpoint.startswith("tls/") or "#" in endpoint
    return endpoint if plain else f"{endpoint}#tls_handshake_timeout_ms={_ACCEPT_MILLISECONDS}"


def _is_loopback(endpoint: str) -> bool:
    """Whether an endpoint like ``tcp/127.0.0.1:7447`` can be reached from this machine alone."""
    if endpoint.startswith(_LOCAL_SOCKET):
        return True
    host = endpoint.partition("/")[2].partition("#")[0].partition("?")[0].rpartition(":")[0].strip("[]")
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False


@final
class ZenohTransport(AbstractTransport):
    """One Zenoh session. Raises BusError when it cannot be opened, InputError for endpoints that are none."""

    def __init__(self, settings: ZenohSettings) -> None:
        import zenoh

        others = listening_ports()  # whom this process lets in there is nothing to this session
        try:
            configuration = zenoh_session_configuration(settings.configuration())
        except zenoh.ZError as error:
            asked = ", ".join((*settings.listen, *settings.connect))
            raise InputError(
                f"bus: {asked}: got what Zenoh does not take ({short_error_text(error)}); wanted endpoints such as "
                "tcp/robot:7447"
            ) from error
        try:
            self._session = open_session(configuration)
        except zenoh.ZError as error:
            kind = JoinError if settings.connect else BusError  # where it listens is the person's choice
            raise kind(
                f"bus: {settings.mode} could not open listen={list(settings.listen)} connect={list(settings.connect)} "
                f"({short_error_text(error)}); check the endpoints and whether a router runs there"
            ) from error
        ports = listening_ports() - others
        defer_accept(ports)
        # of TLS each one cut off costs Zenoh 0.1 s; at a socket in the file system there are no strangers
        guards = settings.listen and settings.certificates is None and ports
        self._connection_reaper = ConnectionReaper(ports, self._far_ends) if guards else None
        _warn_of_plain_text(settings.plain_endpoints)
        self._publishers: dict[tuple[str, bool], zenoh.Publisher] = {}
        self._declared: list[Any] = []

    def put(self, key: str, payload: bytes, *, never_drop: bool) -> None:  # noqa: D102
        import zenoh

        try:
            publisher = self._publishers.get((key, never_drop))
            if publisher is None:
                publisher = self._publishers[key, never_drop] = self._publisher(key, never_drop)
            publisher.put(payload, attachment=key_stamp(key))
        except zenoh.ZError as error:
            raise BusError(f"{key}: could not be sent ({short_error_text(error)}); was the bus closed?") from error

    def _publisher(self, key: str, never_drop: bool) -> zenoh.Publisher:
        import zenoh

        control = zenoh.CongestionControl
        return self._session.declare_publisher(
            key,
            encoding="application/msgpack",
            congestion_control=control.BLOCK if never_drop else control.DROP,
            priority=zenoh.Priority.DATA_HIGH if never_drop else zenoh.Priority.REAL_TIME,
            express=False,  # what waits at one moment goes out as one batch: with many robots a tenth of the processor
            reliability=zenoh.Reliability.RELIABLE,
        )

    def release(self, beginning: str) -> None:  # noqa: D102
        for key, never_drop in [entry for entry in self._publishers if entry[0].startswith(beginning)]:
            self._publishers.pop((key, never_drop)).undeclare()  # type: ignore[no-untyped-call]

    def subscribe(self, key_expression: str, on_sample: OnSample) -> Subscription:  # noqa: D102
        subscription = _ZenohSubscription(self._session, key_expression, on_sample)
        self._declared.append(subscription)
        return subscription

    def declare_alive(self, key: str) -> None:  # noqa: D102
        self._declared.append(self._session.liveliness().declare_token(key))

    def alive(self, key_expression: str) -> list[str]:  # noqa: D102
        replies = self._session.liveliness().get(key_expression, timeout=_ALIVE_TIMEOUT_SECONDS)
        return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})

    def answer(self, key_expression: str, on_question: OnQuestion) -> None:  # noqa: D102
        import zenoh

        def asked(query: zenoh.Query) -> None:
            with query:  # ends the answer, whatever happens
                try:
                    key, payload = str(query.key_expr), b"" if query.payload is None else query.payload.to_bytes()
                    if _misrouted(key, query.attachment):
                        return
                    answer = on_question(key, payload)
                    if answer is not None:
                        query.reply(query.key_expr, answer, attachment=key_stamp(key))
                except zenoh.ZError:
                    return  # the asker is gone, or this session is being closed
                except Exception as error:  # noqa: BLE001  Zenoh would print it, and the process would go on, mute
                    sys.excepthook(type(error), error, error.__traceback__)

        self._declared.append(self._session.declare_queryable(key_expression, zenoh.handlers.Callback(asked)))

    def ask(self, key: str, payload: bytes, timeout: float) -> bytes | None:  # noqa: D102
        import zenoh

        try:
            replies = self._session.get(
                key,
                payload=payload,
                attachment=key_stamp(key),
                timeout=timeout,
                target=zenoh.QueryTarget.ALL,
                consolidation=zenoh.ConsolidationMode.NONE,  # the first answer at once, not when all have answered
            )
            answers = (reply.ok for reply in replies if reply.ok is not None)
            own = (answer for answer in answers if not _misrouted(str(answer.key_expr), answer.attachment))
            return next((answer.payload.to_bytes() for answer in own), None)
        except zenoh.ZError as error:
            raise BusError(f"{key}: could not be asked ({short_error_text(error)}); was the bus closed?") from error

    def ask_soon(self, key: str, payload: bytes, timeout: float, on_answer: OnAnswer) -> None:  # noqa: D102
        def ask() -> None:
            try:
                answer = self.ask(key, payload, timeout)
            except BusError:  # closed meanwhile: as if no one answered
                answer = None
            on_answer(answer)

        threading.Thread(target=ask, daemon=True).start()

    def members(self) -> list[tuple[str, str]]:
        """(Zenoh id, common name of the certificate) of every session linked to this one; no name in plain text."""
        return [(str(link.zid), str(link.auth_identifier or "")) for link in self._session.info.links()]

    def name_of(self, session: str) -> str:
        """Common name of the certificate of a linked session by its Zenoh id; empty when there is none."""
        return dict(self.members()).get(session, "")

    def cut_off(self, sessions: Collection[str]) -> int:
        """Ends the links of these sessions, by their Zenoh ids; how many there were."""
        ends = self._far_ends(sessions)
        return cut_off(ends) if ends else 0

    def _far_ends(self, sessions: Collection[str] | None = None) -> set[tuple[str, int]]:
        """Addresses of those who are linked to this session, or of some of them."""
        found = set()
        for link in self._session.info.links():
            host, _, port = str(link.dst).partition("/")[2].partition("?")[0].partition("#")[0].rpartition(":")
            if port.isdecimal() and (sessions is None or str(link.zid) in sessions):
                found.add((host.strip("[]"), int(port)))
        return found

    def close(self) -> None:  # noqa: D102
        if self._connection_reaper is not None:
            self._connection_reaper.close()
        close_session(self._session)


@final
class _ZenohSubscription(Subscription):
    """Called by Zenoh's own thread, or gathering in a ring on Zenoh's side, which needs nothing of Python.

    Measured with 1000 messages a second in groups of 16, processor time of the receiver for each: 125 us by calls,
    40 us by the ring.
    """

    def __init__(self, session: zenoh.Session, key_expression: str, on_sample: OnSample) -> None:
        self._session, self._key_expression, self._on_sample = session, key_expression, on_sample
        self._calling: Any = self._called()
        self._gathering: Any = None

    def gather(self) -> None:
        import zenoh

        if self._gathering is None:  # both for a moment, so that nothing falls between them
            ring: Any = zenoh.handlers.RingChannel(_MOST_GATHERED)
            self._gathering = self._session.declare_subscriber(self._key_expression, ring)
            self._calling.undeclare()

    def collect(self) -> None:
        if self._gathering is not None:
            receive = self._gathering.handler.try_recv
            for _ in range(_MOST_GATHERED):
                sample = receive()
                if sample is None:
                    return
                self._received(sample)

    def pass_on(self) -> None:
        if self._gathering is not None:
            calling = self._called()
            self.collect()
            self._gathering.undeclare()
            self._calling, self._gathering = calling, None

    def _called(self) -> Any:
        import zenoh

        handler: Any = zenoh.handlers.Callback(self._received, indirect=False)
        return self._session.declare_subscriber(self._key_expression, handler)

    def _received(self, sample: zenoh.Sample) -> None:
        import zenoh

        if sample.kind != zenoh.SampleKind.PUT:
            return
        try:
            key = str(sample.key_expr)
            if not _misrouted(key, sample.attachment):
                self._on_sample(key, sample.payload.to_bytes())
        except Exception as error:  # noqa: BLE001  Zenoh would print it, and the process would go on, deaf
            sys.excepthook(type(error), error, error.__traceback__)


def _misrouted(key: str, alongside: zenoh.ZBytes | None) -> bool:
    """Whether what came was sent under another key; that it was is told."""
    if not is_misrouted(key, None if alongside is None else alongside.to_bytes()):
        return False
    log_event(
        "bus.astray",
        f"passed over what came under {readable(key)} and was sent under another key, as it happens after a lost link",
        level="warning",
    )
    return True


def _warn_of_plain_text(endpoints: tuple[str, ...]) -> None:
    if endpoints:
        log_event(
            "bus.plain_text",
            f"the bus is plain text on {', '.join(endpoints)}: anyone who reaches that network reads and commands every "
            "robot; make certificates with 'safedpa certificates' and name them by --certificates",
            level="warning",
        )
