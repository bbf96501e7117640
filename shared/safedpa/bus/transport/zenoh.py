"""The transport over Eclipse Zenoh, and the settings of a Zenoh session.

By default every process is a peer on this machine, which needs no installation and no router. Over several machines the
topology is static and explicit: ``client`` sessions connect to a router, over mutual TLS if there are certificates.
Peers would exchange messages without the router, which enforces the access control.

The settings follow from measurements: a lease of 0.5 s instead of 10 s, so that a partition is noticed and no burst of
old commands arrives after it; callbacks that only append to a queue; no shared memory; sends that drop messages rather
than wait.
"""

from __future__ import annotations

import ipaddress
import json
import os
import sys
import threading
import time
import weakref
from collections.abc import Callable, Collection, Mapping
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, Literal, final

from safedpa.bus.logging import log_event
from safedpa.bus.messages.topics import is_misrouted, key_stamp
from safedpa.bus.security.certificates import Certificates, PemCredentials
from safedpa.bus.security.connection_reaper import ConnectionReaper, cut_off, defer_accept, listening_ports
from safedpa.bus.transport.base import AbstractTransport, OnAnswer, OnQuestion, OnSample, Subscription
from safedpa.errors import BusError, InputError, JoinError
from safedpa.limits import readable

if TYPE_CHECKING:
    import zenoh

# Threads with which Zenoh opens and closes links, for all sessions of a process. With the default of one thread,
# sessions deadlocked for good when peers joined and left often: the thread waited for a lock whose holder waited for
# the thread. https://github.com/eclipse-zenoh/zenoh/issues/2581; ``deploy/zenoh_churn.py`` reproduces it.
_NET_THREADS = 4
# Sessions that failed to close. If one were garbage collected, Zenoh would try to close it again, for another 10 s, and
# abort the thread.
_UNCLOSED: list[Any] = []


def zenoh_session_configuration(settings: Mapping[str, Any]) -> zenoh.Config:
    """Returns Zenoh's configuration for settings by path. Raises zenoh.ZError for invalid values."""
    import zenoh

    configuration = zenoh.Config()
    for path, value in settings.items():
        configuration.insert_json5(path, json.dumps(value))
    return configuration


def open_session(configuration: zenoh.Config) -> zenoh.Session:
    """Opens a session. Raises zenoh.ZError if that fails."""
    import zenoh

    # Zenoh reads this variable once, when the first session of the process is opened.
    os.environ.setdefault("ZENOH_RUNTIME", f"(net: (worker_threads: {_NET_THREADS}))")
    return zenoh.open(configuration)


def close_session(session: zenoh.Session) -> None:
    """Closes a session. One that does not close within Zenoh's 10 s is logged and kept until the process ends."""
    import zenoh

    if session.is_closed():
        return
    try:
        session.close()  # type: ignore[no-untyped-call]
    except zenoh.ZError as error:
        # Occurs on a busy machine: https://github.com/eclipse-zenoh/zenoh/issues/2675
        _UNCLOSED.append(session)
        log_event("bus.unclosed", f"the bus could not be closed in time ({short_error_text(error)})", level="warning")


def short_error_text(error: Exception) -> str:
    """Returns Zenoh's error message on one line, without the locations in its source code."""
    return " ".join(str(error).split(" at /")[0].split())


Mode = Literal["peer", "client", "router"]

# Zenoh closes a link that was silent for this long. Its default of 10 s would hide a network partition, after which a
# burst of old commands would arrive.
_LEASE_MILLISECONDS = 500
# Peers on one machine have no network between them that could fail, but an overloaded machine delays keep-alive
# messages by 0.5 s and more, and peers that discovered each other do not re-establish a closed link. The end of a
# process is noticed immediately regardless of the lease, because its socket closes.
_LEASE_ON_ONE_MACHINE_MILLISECONDS = 2000
# s; how often a peer checks whether this process was suspended, and the suspension after which its links may be gone:
# keep-alive messages are sent four times per lease.
_SUSPENSION_CHECK, _LONGEST_SUSPENSION = 0.5, 0.75e-3 * _LEASE_ON_ONE_MACHINE_MILLISECONDS
# s of it without processor time. A process that computes keeps its links, since Zenoh's own threads do not wait for the
# interpreter; on a busy machine it computes for a part of the time.
_LONGEST_IDLE = 0.5e-3 * _LEASE_ON_ONE_MACHINE_MILLISECONDS
# s by which a check is late on a machine that is too busy, and for which a link that is lost then counts as closed for
# silence: without it, the other process has ended.
_LATE_CHECK, _BUSY_SECONDS = 0.2, 6.0
# Prefix of the endpoint of a Unix domain socket. Only users with access to its folder can connect.
_LOCAL_SOCKET = "unixsock-stream/"
# Time for a handshake after its first bytes. It takes 3 ms; Zenoh's default gives an unauthenticated client 5 s.
_ACCEPT_MILLISECONDS = 1000
# Concurrent handshakes. With Zenoh's default of 100, a hundred stalled clients would lock out everyone else.
_MOST_PENDING_HANDSHAKES = 2000
# Of two peers that discover each other only the one with the greater id connects. If both did, one of the links would
# be closed again, and with peers joining and leaving often a session would take 2 s to close instead of 0.4 s
# (``deploy/zenoh_churn.py``).
_CONNECT_FROM_ONE_SIDE = {"peer": {"to_router": "always", "to_peer": "greater-zid"}}
_ALIVE_TIMEOUT_SECONDS = 1.0
# Capacity of the ring of one gathering subscription; beyond it the oldest messages are dropped. A thousand robots send
# as many in four periods, and the loop collects every few milliseconds.
_MOST_GATHERED = 4096


@dataclass(frozen=True)
class ZenohSettings:
    """How this process joins the network.

    Without endpoints, a peer listens on the loopback interface and discovers others there by multicast. With
    ``connect``, it discovers others through those endpoints, without multicast. With ``certificates``, every endpoint
    is ``tls/HOST:PORT``, both sides authenticate, and there is no discovery. ``access``, ``limits`` and ``rates`` are
    for routers: Zenoh's ``access_control``, ``low_pass_filter`` and ``downsampling``.

    Raises BusError for a peer with certificates, and for certificates with an endpoint that is not TLS.
    """

    mode: Mode = "peer"
    listen: tuple[str, ...] = ()
    connect: tuple[str, ...] = ()
    certificates: Certificates | PemCredentials | None = None
    access: Mapping[str, Any] | None = None
    limits: tuple[Mapping[str, Any], ...] = ()
    rates: tuple[Mapping[str, Any], ...] = ()
    connect_timeout: float = 10.0
    """Time in s to retry the first connection. Once connected, the session retries forever."""

    def __post_init__(self) -> None:
        if self.certificates is None:
            return
        if self.mode == "peer":
            raise BusError(
                "bus: got certificates for a peer, wanted --mode client: peers exchange messages without the router, "
                "which enforces the access control"
            )
        for endpoint in (*self.listen, *self.connect):
            if not endpoint.startswith("tls/"):
                raise BusError(f"bus: got endpoint '{endpoint}' with certificates, wanted tls/HOST:PORT")

    @property
    def plain_endpoints(self) -> tuple[str, ...]:
        """Endpoints that other machines can reach without authentication or encryption."""
        return tuple(
            endpoint
            for endpoint in (*self.listen, *self.connect)
            if not endpoint.startswith("tls/") and not _is_loopback(endpoint)
        )

    @property
    def _among_peers_of_one_machine(self) -> bool:
        return self.mode == "peer" and all(map(_is_loopback, (*self.listen, *self.connect)))

    def configuration(self) -> dict[str, Any]:
        """Returns the Zenoh configuration by path."""
        alone, among_peers = not self.listen and not self.connect, self._among_peers_of_one_machine
        listen = self.listen or ((_default_listen_endpoint(self.connect),) if self.mode == "peer" else ())
        return {
            "mode": self.mode,
            "listen/endpoints": [*map(_with_handshake_timeout, listen)],
            "connect/endpoints": list(self.connect),
            "connect/timeout_ms": round(1000.0 * self.connect_timeout),
            "connect/exit_on_failure": True,
            # After a lost link the robot brakes until it is back; Zenoh's default waits up to 4 s between attempts.
            "connect/retry": {"period_init_ms": 100, "period_max_ms": 400, "period_increase_factor": 1.5},
            # Multicast on the loopback interface only: a process never joins a fleet on the network by accident.
            "scouting/multicast/enabled": alone,
            "scouting/multicast/interface": "lo",
            "scouting/gossip/enabled": self.mode == "peer",
            # Not over several machines, where possibly only the peer with the smaller id can reach the other one.
            **({"scouting/gossip/autoconnect_strategy": _CONNECT_FROM_ONE_SIDE} if among_peers else {}),
            "scouting/delay": 200 if alone else 0,
            "timestamping/enabled": True,
            "transport/unicast/accept_timeout": _ACCEPT_MILLISECONDS,
            "transport/unicast/accept_pending": _MOST_PENDING_HANDSHAKES,
            "transport/link/tx/lease": _LEASE_ON_ONE_MACHINE_MILLISECONDS if among_peers else _LEASE_MILLISECONDS,
            # Messages of a few hundred bytes gain nothing from it.
            "transport/shared_memory/enabled": False,
            **({} if self.certificates is None else _tls(self.certificates)),
            **({} if self.access is None else {"access_control": dict(self.access)}),
            **({"downsampling": [dict(rate) for rate in self.rates]} if self.rates else {}),
            **({"low_pass_filter": [dict(limit) for limit in self.limits]} if self.limits else {}),
        }


def _tls(certificates: Certificates | PemCredentials) -> dict[str, Any]:
    """Returns the configuration of mutual TLS; a connection closes when one of its certificates expires."""
    return {
        # No other protocol, so that a mistake in an endpoint does not open an unauthenticated one.
        "transport/link/protocols": ["tls"],
        "transport/link/tls": {
            **certificates.tls(),
            "enable_mtls": True,
            "verify_name_on_connect": True,
            "close_link_on_expiration": True,
        },
    }


def _default_listen_endpoint(connect: tuple[str, ...]) -> str:
    """Returns where a peer listens by default: next to the Unix socket it connects to, or on the loopback interface."""
    socket = next((endpoint for endpoint in connect if endpoint.startswith(_LOCAL_SOCKET)), "")
    if not socket:
        return "tcp/127.0.0.1:0"
    # The pid alone is not unique: containers that share the folder have pid namespaces of their own.
    return f"{socket.rpartition('/')[0]}/{os.getpid()}-{os.urandom(4).hex()}"


def _with_handshake_timeout(endpoint: str) -> str:
    """Adds the time limit of the TLS handshake to a TLS endpoint, unless it has options of its own."""
    plain = not endpoint.startswith("tls/") or "#" in endpoint
    return endpoint if plain else f"{endpoint}#tls_handshake_timeout_ms={_ACCEPT_MILLISECONDS}"


def _is_loopback(endpoint: str) -> bool:
    """Whether an endpoint such as ``tcp/127.0.0.1:7447`` can be reached only from this machine."""
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
    """A Zenoh session. Raises BusError if it cannot be opened, InputError for invalid endpoints.

    A peer opens a new session after its process was suspended for longer than its lease: peers that discovered each
    other do not re-establish a closed link, but link to every session that is new.
    """

    def __init__(self, settings: ZenohSettings) -> None:
        import zenoh

        # Ports of other sessions and of web servers in this process, whose connections are not ours to watch.
        others = listening_ports()
        try:
            configuration = zenoh_session_configuration(settings.configuration())
        except zenoh.ZError as error:
            asked = ", ".join((*settings.listen, *settings.connect))
            raise InputError(
                f"bus: {asked}: Zenoh rejects the endpoint ({short_error_text(error)}); wanted endpoints such as "
                "tcp/robot:7447"
            ) from error
        try:
            self._session = open_session(configuration)
        except zenoh.ZError as error:
            # A router that is not up yet may come up: the supervisor retries after JoinError. An address to listen on
            # does not become valid by waiting.
            kind = JoinError if settings.connect else BusError
            raise kind(
                f"bus: {settings.mode} could not open listen={list(settings.listen)} connect={list(settings.connect)} "
                f"({short_error_text(error)}); check the endpoints and whether a router is running there"
            ) from error
        ports = listening_ports() - others
        defer_accept(ports)
        # Not for TLS: each connection closed during its handshake blocks Zenoh 1.10 for 0.1 s, and the handshake has a
        # time limit of its own. Not for Unix sockets, which unauthenticated clients cannot open.
        guards = settings.listen and settings.certificates is None and ports
        self._connection_reaper = ConnectionReaper(ports, self._peer_addresses) if guards else None
        _warn_about_plain_text(settings.plain_endpoints)
        self._settings, self._lock, self._closed = settings, threading.Lock(), threading.Event()
        self._publishers: dict[tuple[str, bool], zenoh.Publisher] = {}
        self._declared: list[Any] = []
        self._declarations: list[Callable[[zenoh.Session], Any]] = []
        """What a new session declares again."""
        if settings.mode == "peer" and not settings.listen:
            # Without a reference: a transport without another reference can be freed.
            watched = weakref.ref(self), self._closed
            threading.Thread(target=_watch_for_suspensions, args=watched, daemon=True).start()

    def put(self, key: str, payload: bytes, *, never_drop: bool) -> None:  # noqa: D102
        import zenoh

        publisher = None
        try:
            publisher = self._publishers.get((key, never_drop)) or self._publisher(key, never_drop)
            publisher.put(payload, attachment=key_stamp(key))
        except zenoh.ZError as error:
            if not self._closed.is_set() and self._publishers.get((key, never_drop)) is not publisher:
                self.put(key, payload, never_drop=never_drop)  # its session was replaced meanwhile
                return
            raise BusError(f"{key}: could not be sent ({short_error_text(error)}); was the bus closed?") from error

    def _publisher(self, key: str, never_drop: bool) -> zenoh.Publisher:
        import zenoh

        control = zenoh.CongestionControl
        with self._lock:
            self._publishers[key, never_drop] = publisher = self._session.declare_publisher(
                key,
                encoding="application/msgpack",
                # A new action is worth more than an old one, so commands are dropped under congestion. Audit messages
                # wait.
                congestion_control=control.BLOCK if never_drop else control.DROP,
                # A queue per priority: a model file of megabytes in transfer must not delay an action.
                priority=zenoh.Priority.DATA_HIGH if never_drop else zenoh.Priority.REAL_TIME,
                # Zenoh may put messages that wait together into one batch. With many robots this saves 10 % of the
                # CPU time.
                express=False,
                reliability=zenoh.Reliability.RELIABLE,
            )
        return publisher

    def release(self, prefix: str) -> None:  # noqa: D102
        with self._lock:
            keys = [entry for entry in self._publishers if entry[0].startswith(prefix)]
            released = [self._publishers.pop(key) for key in keys]
        for publisher in released:
            publisher.undeclare()  # type: ignore[no-untyped-call]

    def _declare(self, declaration: Callable[[zenoh.Session], Any]) -> None:
        """Declares something in this session, and in each one that takes its place."""
        with self._lock:
            self._declarations.append(declaration)
            self._declared.append(declaration(self._session))

    def peers(self) -> frozenset[str]:
        """Returns the identifiers of the sessions that this one has a link to."""
        with self._lock:
            return frozenset(str(each) for each in self._session.info.peers_zid())

    def rejoin(self) -> None:
        """Replaces the session by a new one, which every peer links to."""
        import zenoh

        try:
            session = open_session(zenoh_session_configuration(self._settings.configuration()))
        except zenoh.ZError as error:
            # The old session retries the link to its router by itself.
            sentence = f"no new session could be opened ({short_error_text(error)})"
            log_event("bus.not_rejoined", sentence, level="warning")
            return
        with self._lock:
            old, self._session = self._session, session
            self._declared = [declaration(session) for declaration in self._declarations]
            self._publishers = {}
        close_session(old)
        if self._closed.is_set():
            close_session(session)

    def subscribe(self, key_expression: str, on_sample: OnSample) -> Subscription:  # noqa: D102
        subscription = _ZenohSubscription(key_expression, on_sample)
        self._declare(subscription.declare_in)
        return subscription

    def declare_alive(self, key: str) -> None:  # noqa: D102
        self._declare(lambda session: session.liveliness().declare_token(key))

    def alive(self, key_expression: str) -> list[str]:  # noqa: D102
        replies = self._session.liveliness().get(key_expression, timeout=_ALIVE_TIMEOUT_SECONDS)
        return sorted({str(reply.ok.key_expr) for reply in replies if reply.ok is not None})

    def answer(self, key_expression: str, on_question: OnQuestion) -> None:  # noqa: D102
        import zenoh

        def asked(query: zenoh.Query) -> None:
            with query:  # closes the query on every path; otherwise the asker would wait for its timeout
                try:
                    key, payload = str(query.key_expr), b"" if query.payload is None else query.payload.to_bytes()
                    if _misrouted(key, query.attachment):
                        return
                    answer = on_question(key, payload)
                    if answer is not None:
                        query.reply(query.key_expr, answer, attachment=key_stamp(key))
                except zenoh.ZError:
                    return  # the asker left, or this session is being closed
                except Exception as error:  # noqa: BLE001
                    # Zenoh would print the exception and continue, and the process would never answer again. The hook
                    # ends the process, so that its supervisor restarts it.
                    sys.excepthook(type(error), error, error.__traceback__)

        self._declare(lambda session: session.declare_queryable(key_expression, zenoh.handlers.Callback(asked)))

    def ask(self, key: str, payload: bytes, timeout: float) -> bytes | None:  # noqa: D102
        import zenoh

        try:
            replies = self._session.get(
                key,
                payload=payload,
                attachment=key_stamp(key),
                timeout=timeout,
                target=zenoh.QueryTarget.ALL,
                # Return the first answer immediately; Zenoh's default waits until all participants have answered.
                consolidation=zenoh.ConsolidationMode.NONE,
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
            except BusError:  # the session was closed meanwhile; same as no answer
                answer = None
            on_answer(answer)

        # Asked once per robot that joins, so a thread each is affordable. A daemon: it must not delay the exit.
        threading.Thread(target=ask, daemon=True).start()

    def members(self) -> list[tuple[str, str]]:
        """Returns (Zenoh id, common name of the certificate) of each linked session; without TLS the name is empty."""
        return [(str(link.zid), str(link.auth_identifier or "")) for link in self._session.info.links()]

    def name_of(self, session: str) -> str:
        """Returns the common name in the certificate of a linked session, by Zenoh id; empty if unknown."""
        return dict(self.members()).get(session, "")

    def cut_off(self, sessions: Collection[str]) -> int:
        """Closes the links of the sessions with these Zenoh ids; returns their number."""
        addresses = self._peer_addresses(sessions)
        return cut_off(addresses) if addresses else 0

    def _peer_addresses(self, sessions: Collection[str] | None = None) -> set[tuple[str, int]]:
        """Returns the remote addresses of all linked sessions, or of the given ones."""
        found = set()
        # Zenoh has no call to close one link, so the caller shuts down the socket with this remote address.
        for link in self._session.info.links():
            host, _, port = str(link.dst).partition("/")[2].partition("?")[0].partition("#")[0].rpartition(":")
            if port.isdecimal() and (sessions is None or str(link.zid) in sessions):
                found.add((host.strip("[]"), int(port)))
        return found

    def close(self) -> None:  # noqa: D102
        self._closed.set()
        # First: the reaper asks the session for its links.
        if self._connection_reaper is not None:
            self._connection_reaper.close()
        close_session(self._session)


def _watch_for_suspensions(transport: weakref.ref[ZenohTransport], closed: threading.Event) -> None:
    woke, used, busy_until, linked = time.monotonic(), time.process_time(), 0.0, frozenset[str]()
    while not closed.wait(_SUSPENSION_CHECK):
        known = transport()
        if known is None:
            return
        now = time.monotonic()
        passed, idle = now - woke, now - woke - (time.process_time() - used)
        if passed > _SUSPENSION_CHECK + _LATE_CHECK:
            busy_until = now + _BUSY_SECONDS
        try:
            peers = known.peers()
            suspended = passed > _LONGEST_SUSPENSION and idle > _LONGEST_IDLE
            if suspended or (linked - peers and now < busy_until):
                known.rejoin()
                peers = frozenset()
            linked = peers
        except Exception as error:  # noqa: BLE001
            # As in `answer`: a process that is joined in part would not be restarted.
            sys.excepthook(type(error), error, error.__traceback__)
        del known
        woke, used = time.monotonic(), time.process_time()


@final
class _ZenohSubscription(Subscription):
    """A subscription with a callback on Zenoh's thread, or with a ring buffer in Zenoh, outside Python.

    CPU time of the receiver per message, measured with 1000 messages a second in groups of 16: 125 us with callbacks,
    40 us with the ring buffer.
    """

    def __init__(self, key_expression: str, on_sample: OnSample) -> None:
        self._key_expression, self._on_sample = key_expression, on_sample
        self._session: Any = None
        self._callback_subscriber: Any = None
        self._ring_subscriber: Any = None
        self._lock = threading.Lock()

    def declare_in(self, session: zenoh.Session) -> _ZenohSubscription:
        """Receives from this session from now on, in the same way as from the one before."""
        with self._lock:
            self._session = session
            if self._ring_subscriber is None:
                self._callback_subscriber = self._declare_callback()
            else:
                self._ring_subscriber = self._declare_ring()
        return self

    def gather(self) -> None:
        with self._lock:
            if self._ring_subscriber is None:
                # Declare the new subscriber before the old one ends, so that no message is lost between the two. A
                # message that arrives twice replaces itself in the inbox.
                self._ring_subscriber = self._declare_ring()
                self._callback_subscriber.undeclare()

    def collect(self) -> None:
        ring = self._ring_subscriber
        if ring is not None:
            receive = ring.handler.try_recv
            # Bounded, so that a sender that is faster than this loop cannot keep it here forever.
            for _ in range(_MOST_GATHERED):
                sample = receive()
                if sample is None:
                    return
                self._received(sample)

    def pass_on(self) -> None:
        with self._lock:
            if self._ring_subscriber is not None:
                callback_subscriber = self._declare_callback()  # before the ring ends, as in gather
                self.collect()
                self._ring_subscriber.undeclare()
                self._callback_subscriber, self._ring_subscriber = callback_subscriber, None

    def _declare_ring(self) -> Any:
        import zenoh

        ring: Any = zenoh.handlers.RingChannel(_MOST_GATHERED)
        return self._session.declare_subscriber(self._key_expression, ring)

    def _declare_callback(self) -> Any:
        import zenoh

        # indirect=False calls on Zenoh's own thread; the default hands over to a Python thread, one wake-up more.
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
        except Exception as error:  # noqa: BLE001
            # As in `answer`: Zenoh would print the exception, and this process would receive nothing any more.
            sys.excepthook(type(error), error, error.__traceback__)


def _misrouted(key: str, attachment: zenoh.ZBytes | None) -> bool:
    """Whether a message was sent under another key than ``key``; if so, logs it."""
    if not is_misrouted(key, None if attachment is None else attachment.to_bytes()):
        return False
    log_event(
        "bus.misrouted",
        f"ignored a message under {readable(key)} that was sent under another key; this happens after a lost link",
        level="warning",
    )
    return True


def _warn_about_plain_text(endpoints: tuple[str, ...]) -> None:
    if endpoints:
        log_event(
            "bus.plain_text",
            f"the bus is plain text on {', '.join(endpoints)}: anyone on that network can read and command every "
            "robot; create certificates with 'safedpa certificates' and pass them with --certificates",
            level="warning",
        )
