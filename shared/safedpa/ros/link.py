"""A session with a ROS 2 robot over Zenoh, without ROS: subscribes to topics, publishes, and lists endpoints.

There are two forms: ``rmw_zenoh`` (ROS 2 nodes on Zenoh) and ``bridge`` (zenoh-bridge-ros2dds with nodes on DDS: plain
keys, no attachments, no tokens of ROS).
"""

from __future__ import annotations

import secrets
import threading
import time
from collections.abc import Callable, Iterable
from itertools import count
from typing import Any, Literal, final

from safedpa.bus.transport.zenoh import close_session, open_session, zenoh_session_configuration
from safedpa.errors import BusError, InputError
from safedpa.ros.encoding import encode, hash_of
from safedpa.ros.graph import PUBLISHER, QOS, Attachment, Endpoint, data_key, node_token

Form = Literal["rmw_zenoh", "bridge"]
FORMS: tuple[Form, ...] = ("rmw_zenoh", "bridge")
_QUERY_SECONDS = 2.0
_CONNECT_MILLISECONDS = 5000
_MAX_TOKENS = 10_000
"""Largest number of tokens that are kept."""

Heard = Callable[[bytes, "Attachment | None"], None]
"""Callback for each message, on the network thread: its bytes and its attachment."""


@final
class RosLink:
    """Connects to the robot's Zenoh router as a client; raises BusError if no router answers."""

    def __init__(self, endpoint: str, domain: int = 0, form: Form = "rmw_zenoh", node: str = "/safedpa") -> None:
        import zenoh

        settings = {
            "mode": "client",
            "connect/endpoints": [endpoint],
            "connect/timeout_ms": _CONNECT_MILLISECONDS,
            "connect/exit_on_failure": True,
            "scouting/multicast/enabled": False,
            "scouting/gossip/enabled": False,
            "timestamping/enabled": True,
            "transport/shared_memory/enabled": False,
        }
        try:
            configuration = zenoh_session_configuration(settings)
        except zenoh.ZError as error:
            raise InputError(f"{endpoint}: is not an endpoint; wanted one such as tcp/robot:7447") from error
        try:
            self._session = open_session(configuration)
        except zenoh.ZError as error:
            raise BusError(
                f"{endpoint}: no Zenoh router answers ({str(error).split(' at ')[0][:80]}); wanted that of the robot: "
                "ros2 run rmw_zenoh_cpp rmw_zenohd, or zenoh-bridge-ros2dds"
            ) from error
        self.domain, self.form, self.node = domain, form, node
        self._declared: list[Any] = []
        self._lock = threading.Lock()
        self._seen: dict[str, Endpoint] | None = None

    @property
    def session(self) -> str:
        """Name of this session in tokens."""
        return str(self._session.info.zid())

    def endpoints(self) -> list[Endpoint]:
        """Queries every publisher and subscriber of the domain, sorted by topic."""
        replies = self._session.liveliness().get(f"@ros2_lv/{self.domain}/**", timeout=_QUERY_SECONDS)
        tokens = {str(reply.ok.key_expr) for reply in replies if reply.ok is not None}
        found = [endpoint for endpoint in map(Endpoint.of, tokens) if endpoint is not None]
        return sorted(found, key=lambda one: (one.topic, one.kind, one.node, one.session, one.number))

    def others_on(self, topic: str, kind: str) -> list[Endpoint]:
        """Queries the endpoints of a topic in other sessions."""
        return self._others(self.endpoints(), topic, kind)

    def _others(self, endpoints: Iterable[Endpoint], topic: str, kind: str) -> list[Endpoint]:
        own, wanted = self.session, f"/{topic.strip('/')}"
        return [one for one in endpoints if one.topic == wanted and one.kind == kind and one.session != own]

    def watched(self, topic: str, kind: str) -> list[Endpoint]:
        """Like ``others_on``, but from the tokens received so far; does not block."""
        if self._seen is None:
            self._watch()
        with self._lock:
            seen = list((self._seen or {}).values())
        return self._others(seen, topic, kind)

    def _watch(self) -> None:
        import zenoh

        self._seen = {}

        def on_token(sample: zenoh.Sample) -> None:
            token = str(sample.key_expr)
            endpoint = Endpoint.of(token)
            with self._lock:
                if self._seen is None or endpoint is None:
                    return
                if sample.kind == zenoh.SampleKind.DELETE:
                    self._seen.pop(token, None)
                elif len(self._seen) < _MAX_TOKENS:
                    self._seen[token] = endpoint

        key = f"@ros2_lv/{self.domain}/**"
        callback = zenoh.handlers.Callback(on_token, indirect=False)
        self._declared.append(self._session.liveliness().declare_subscriber(key, callback, history=True))

    def hear(self, topic: str, type_name: str, heard: Heard, *, late: bool = False) -> None:
        """Calls ``heard`` for each message of a topic, whatever type hash its sender uses.

        ``late``: also for the last messages that its senders have stored (ROS: transient local, as ``/tf_static`` is).
        """
        self._subscribe(data_key(self.domain, topic, type_name, "*"), topic, heard, overhear=False, late=late)

    def overhear(self, topic: str, heard: Heard) -> None:
        """Calls ``heard`` for messages of any type that other sessions send on a topic, with or without a token."""
        self._subscribe(f"{self.domain}/{topic.strip('/')}/*/*", topic, heard, overhear=True)

    def _subscribe(self, key: str, topic: str, heard: Heard, *, overhear: bool, late: bool = False) -> None:
        import zenoh
        import zenoh.ext

        def on_sample(sample: zenoh.Sample) -> None:
            attachment = None if sample.attachment is None else Attachment.unpacked(sample.attachment.to_bytes())
            heard(sample.payload.to_bytes(), attachment)

        key = topic.strip("/") if self.form == "bridge" else key
        if late:
            history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
            callback = zenoh.handlers.Callback(on_sample, indirect=False)
            self._declared.append(zenoh.ext.declare_advanced_subscriber(self._session, key, callback, history=history))
            return
        self._declared.append(
            self._session.declare_subscriber(
                key,
                zenoh.handlers.Callback(on_sample, indirect=False),
                allowed_origin=zenoh.Locality.REMOTE if overhear else None,
            )
        )

    def publisher(self, topic: str, type_name: str, type_hash: str = "", qos: str = QOS) -> RosPublisher:
        """Creates a publisher with its token; ``type_hash`` is that of the subscribers, by default that of the type."""
        return RosPublisher(self, self._session, topic, type_name, type_hash or hash_of(type_name), qos)

    def next_number(self) -> int:
        """Number for the next entity of this session."""
        return len(self._declared) + 1

    def hold(self, thing: Any) -> None:
        """Keeps a declaration alive until the session ends."""
        self._declared.append(thing)

    def close(self) -> None:
        """Closes the session and its tokens."""
        close_session(self._session)

    def __enter__(self) -> RosLink:
        """Returns the link."""
        return self

    def __exit__(self, *_error: object) -> None:
        """Closes the session."""
        self.close()


@final
class RosPublisher:
    """Publishes on one topic; adds the attachment of rmw_zenoh, or none for a bridge."""

    def __init__(self, link: RosLink, session: Any, topic: str, type_name: str, type_hash: str, qos: str) -> None:
        import zenoh

        self.type, self._form, self._numbers = type_name, link.form, count(1)
        self._sender = secrets.token_bytes(16)
        plain = topic.strip("/") if link.form == "bridge" else data_key(link.domain, topic, type_name, type_hash)
        self._publisher = session.declare_publisher(
            plain,
            encoding="application/cdr",
            congestion_control=zenoh.CongestionControl.DROP,
            priority=zenoh.Priority.REAL_TIME,
            express=True,
        )
        link.hold(self._publisher)
        if link.form == "rmw_zenoh":
            number = str(link.next_number())
            wanted = f"/{topic.strip('/')}"
            me = Endpoint(
                link.domain, link.session, link.node, PUBLISHER, wanted, type_name, type_hash, qos, "0", number
            )
            for token in (node_token(me), me.token()):
                link.hold(session.liveliness().declare_token(token))

    def put(self, values: Any) -> None:
        """Sends a message, from any thread; raises InputError for a field that the type does not have."""
        number = next(self._numbers)
        attachment = Attachment(number, time.time_ns(), self._sender).packed() if self._form == "rmw_zenoh" else None
        self._publisher.put(encode(self.type, values), attachment=attachment)
