"""Which container an address belongs to, asked of the container engine's own name service."""

from __future__ import annotations

import re
import socket
import struct

ENGINE = ("127.0.0.11", 53)
_LARGEST_ANSWER = 512


def container_at(address: str, server: tuple[str, int] = ENGINE, seconds: float = 2.0) -> str:
    """The name of the container that has an IPv4 address, such as ``fleet_robot_3.fleet_bus``.

    The question goes to the engine's own server, since the system's resolver would answer from /etc/hosts, where
    nothing but the container's identifier stands. Raises OSError when no one answers or no name is known.
    """
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as question:
        question.settimeout(seconds)
        question.connect(server)
        question.send(pointer_question(address))
        return name_in(question.recv(_LARGEST_ANSWER))


def number_in(name: str) -> int:
    """The number at the end of a container's name such as ``fleet_robot_3.fleet_bus`` or ``fleet-robot-3``.

    Raises ValueError when there is none.
    """
    found = re.search(r"[_-](\d+)$", name.split(".", maxsplit=1)[0])
    if found is None:
        raise ValueError(f"container '{name}': got no number at the end of its name, wanted one such as fleet_robot_3")
    return int(found[1])


def pointer_question(address: str) -> bytes:
    """The question for the name of an IPv4 address, as RFC 1035 writes it (type PTR, class IN)."""
    labels = [*reversed(address.split(".")), "in-addr", "arpa"]
    name = b"".join(bytes([len(label)]) + label.encode() for label in labels) + b"\0"
    return struct.pack(">6H", 1, 0x0100, 1, 0, 0, 0) + name + struct.pack(">2H", 12, 1)


def name_in(answer: bytes) -> str:
    """The first name that such an answer gives. Raises OSError when it gives none."""
    if struct.unpack_from(">H", answer, 6)[0] == 0:
        raise OSError("the name service knows no name of this address")
    start = answer.index(b"\0", 12) + 5  # behind the question, which is repeated
    start = start + 2 if answer[start] >= 0xC0 else answer.index(b"\0", start) + 1
    labels, place = [], start + 10
    while answer[place]:
        labels.append(answer[place + 1 : place + 1 + answer[place]].decode())
        place += 1 + answer[place]
    return ".".join(labels)
