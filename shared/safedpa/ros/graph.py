"""Wire format of rmw_zenoh: topic keys, liveliness tokens of nodes and endpoints, and message attachments.

    data       DOMAIN/TOPIC/PACKAGE::msg::dds_::TYPE_/HASH
    token      @ros2_lv/DOMAIN/SESSION/NODE/ENTITY/KIND/ENCLAVE/NAMESPACE/NODE_NAME[/TOPIC/TYPE/HASH/QOS]
    attachment int64 sequence number, int64 time of the source [ns], one byte 16, 16 bytes of the sender id

Within a part of a token, ``/`` is written ``%``. Humble writes ``TypeHashNotSupported`` in place of the hash
(github.com/ros2/rmw_zenoh, docs/developers/design.md).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from safedpa.ros.definitions import plain_type

NO_HASH = "TypeHashNotSupported"
PUBLISHER, SUBSCRIBER = "MP", "MS"
QOS = "::,10:,:,:,,"
"""The default of ROS: reliable, volatile, keep last 10."""
_SPACE = "@ros2_lv"
_ATTACHMENT = struct.Struct("<qqB16s")


def dds_type(name: str) -> str:
    """Converts ``nav_msgs/msg/Odometry`` to ``nav_msgs::msg::dds_::Odometry_``."""
    package, kind, plain = plain_type(name).split("/")
    return f"{package}::{kind}::dds_::{plain}_"


def data_key(domain: int, topic: str, type_name: str, type_hash: str) -> str:
    """Key of the messages of a topic; the hash ``*`` matches any definition."""
    return f"{domain}/{topic.strip('/')}/{dds_type(type_name)}/{type_hash}"


@dataclass(frozen=True)
class Attachment:
    """Attachment of a message. It is mandatory: a receiver of rmw_zenoh terminates if it cannot read it."""

    sequence: int
    time: int
    """Send time, ns since 1970 by the sender's clock."""
    sender: bytes
    """Sender id of 16 bytes, the same for all messages of one publisher."""

    def packed(self) -> bytes:
        """Encodes to 33 bytes."""
        return _ATTACHMENT.pack(self.sequence, self.time, 16, self.sender)

    @staticmethod
    def unpacked(data: bytes) -> Attachment | None:
        """Decodes an attachment; None if it is invalid."""
        if len(data) != _ATTACHMENT.size or data[16] != 16:
            return None
        sequence, time, _, sender = _ATTACHMENT.unpack(data)
        return Attachment(sequence, time, sender)


@dataclass(frozen=True)
class Endpoint:
    """A publisher or subscriber, as described by its liveliness token."""

    domain: int
    session: str
    node: str
    """Namespace and name of the node."""
    kind: str
    """PUBLISHER or SUBSCRIBER."""
    topic: str
    type: str
    hash: str
    qos: str = QOS
    node_number: str = "0"
    number: str = "1"

    def token(self) -> str:
        """Key of the liveliness token."""
        namespace, _, name = self.node.rpartition("/")
        parts = (_SPACE, self.domain, self.session, self.node_number, self.number, self.kind, "%", _escape(namespace))
        return "/".join(
            map(str, (*parts, _escape(name), _escape(self.topic), dds_type(self.type), self.hash, self.qos))
        )

    @staticmethod
    def of(token: str) -> Endpoint | None:
        """Parses a token; None for tokens of nodes and services, and for invalid ones."""
        parts = token.split("/")
        if len(parts) != 13 or parts[0] != _SPACE or parts[5] not in (PUBLISHER, SUBSCRIBER):
            return None
        if not parts[1].isdecimal() or not parts[1].isascii() or len(parts[1]) > 4:
            return None
        node = f"{_unescape(parts[7])}/{_unescape(parts[8])}".replace("//", "/")
        kind, type_hash = plain_type(parts[10]), parts[11]
        return Endpoint(
            int(parts[1]), parts[2], node, parts[5], _unescape(parts[9]), kind, type_hash, parts[12], *parts[3:5]
        )


def node_token(endpoint: Endpoint) -> str:
    """Token of the node of an endpoint."""
    parts = endpoint.token().split("/")[:9]
    return "/".join([*parts[:4], parts[3], "NN", *parts[6:]])


def _escape(part: str) -> str:
    return part.replace("/", "%") or "%"


def _unescape(part: str) -> str:
    return part.replace("%", "/")
