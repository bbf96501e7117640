"""Names on the wire of rmw_zenoh: keys of topics, liveliness tokens of who is there, attachments of messages.

    data       DOMAIN/TOPIC/PACKAGE::msg::dds_::TYPE_/HASH
    token      @ros2_lv/DOMAIN/SESSION/NODE/ENTITY/KIND/ENCLAVE/NAMESPACE/NODE_NAME[/TOPIC/TYPE/HASH/QOS]
    attachment int64 sequence number, int64 time of the source [ns], one byte 16, 16 bytes of the sender's id

In a token ``/`` within a part is ``%``. Humble writes ``TypeHashNotSupported`` where later ones write the hash
(github.com/ros2/rmw_zenoh, docs/design.md).
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from safedpa.ros.definitions import plain_type

__all__ = ["NO_HASH", "PUBLISHER", "QOS", "SUBSCRIBER", "Attachment", "Endpoint", "data_key", "dds_type", "node_token"]

NO_HASH = "TypeHashNotSupported"
PUBLISHER, SUBSCRIBER = "MP", "MS"
QOS = "::,10:,:,:,,"
"""Reliable, volatile, the last ten: what ROS takes where no one says otherwise."""
_SPACE = "@ros2_lv"
_ATTACHMENT = struct.Struct("<qqB16s")


def dds_type(name: str) -> str:
    """``nav_msgs/msg/Odometry`` as ``nav_msgs::msg::dds_::Odometry_``."""
    package, kind, plain = plain_type(name).split("/")
    return f"{package}::{kind}::dds_::{plain}_"


def data_key(domain: int, topic: str, type_name: str, type_hash: str) -> str:
    """The key of a topic's messages; ``*`` as hash: of whatever definition."""
    return f"{domain}/{topic.strip('/')}/{dds_type(type_name)}/{type_hash}"


@dataclass(frozen=True)
class Attachment:
    """What stands next to a message; a receiver of rmw_zenoh that cannot read it ends its process."""

    sequence: int
    time: int
    """ns since 1970, by the sender's clock."""
    sender: bytes
    """16 bytes, the same for every message of one publisher."""

    def packed(self) -> bytes:
        """33 bytes."""
        return _ATTACHMENT.pack(self.sequence, self.time, 16, self.sender)

    @staticmethod
    def unpacked(data: bytes) -> Attachment | None:
        """None for what is none."""
        if len(data) != _ATTACHMENT.size or data[16] != 16:
            return None
        sequence, time, _, sender = _ATTACHMENT.unpack(data)
        return Attachment(sequence, time, sender)


@dataclass(frozen=True)
class Endpoint:
    """A publisher or subscriber that a liveliness token tells of."""

    domain: int
    session: str
    node: str
    """Its namespace and name."""
    kind: str
    """PUBLISHER or SUBSCRIBER."""
    topic: str
    type: str
    hash: str
    qos: str = QOS
    node_number: str = "0"
    number: str = "1"

    def token(self) -> str:
        """The key of its token."""
        namespace, _, name = self.node.rpartition("/")
        parts = (_SPACE, self.domain, self.session, self.node_number, self.number, self.kind, "%", _packed(namespace))
        return "/".join(
            map(str, (*parts, _packed(name), _packed(self.topic), dds_type(self.type), self.hash, self.qos))
        )

    @staticmethod
    def of(token: str) -> Endpoint | None:
        """What a token tells; None of nodes, services, and what is no token."""
        parts = token.split("/")
        if len(parts) != 13 or parts[0] != _SPACE or parts[5] not in (PUBLISHER, SUBSCRIBER):
            return None
        if not parts[1].isdecimal() or not parts[1].isascii() or len(parts[1]) > 4:
            return None
        node = f"{_opened(parts[7])}/{_opened(parts[8])}".replace("//", "/")
        kind, type_hash = plain_type(parts[10]), parts[11]
        return Endpoint(
            int(parts[1]), parts[2], node, parts[5], _opened(parts[9]), kind, type_hash, parts[12], *parts[3:5]
        )


def node_token(endpoint: Endpoint) -> str:
    """The token of the node to which an endpoint belongs."""
    parts = endpoint.token().split("/")[:9]
    return "/".join([*parts[:4], parts[3], "NN", *parts[6:]])


def _packed(part: str) -> str:
    return part.replace("/", "%") or "%"


def _opened(part: str) -> str:
    return part.replace("%", "/")
