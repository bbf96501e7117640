"""The table of topics: key, message type, writer, maximum age and delivery of each.

Services, recorder, dashboard, access control and the generated documentation all read this table.

A stamp, the hash of the key, is attached to each message; by it receivers reject messages delivered under a wrong key.
On a link, Zenoh replaces keys by numeric ids, which both ends agree on again when the link is re-established. Messages
that were queued meanwhile are decoded with the new ids: after a lost link, Zenoh 1.10.2 delivered messages under other
keys of the session (reproduced by ``deploy/zenoh_mixed_keys.py``). A robot's state could be taken for another robot's.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
from hashlib import blake2b
from typing import Literal

from safedpa.bus.messages.messages import (
    ActionMessage,
    AskedMessage,
    FindingMessage,
    HealthMessage,
    LatentMessage,
    Message,
    ModelMessage,
    NominalMessage,
    RosterMessage,
    ScanMessage,
    SetupMessage,
    StateMessage,
    SurroundingsMessage,
    TakeoverMessage,
    VerdictMessage,
)
from safedpa.errors import InputError, did_you_mean
from safedpa.limits import readable

Delivery = Literal["latest", "all"]

BUNDLE = "+"
"""Placeholder for the robot in the key of a bundle, which contains messages about many robots; not a valid name."""

NO_ROBOT = "-"
"""Placeholder for the robot in the keys of a service that serves the whole fleet, or no robot."""

# Limit for messages that contain a model file or the report of a search. They are sent a few times an hour.
_DOCUMENT_BYTES = 4 * 1024 * 1024


@dataclass(frozen=True, eq=False)
class Topic:
    """One topic of the bus."""

    name: str
    message: type[Message]
    writer: str
    """The only service that may send it; ``*``: every service under its own name."""
    delivery: Delivery
    """``latest``: a newer message replaces an unread one (commands); ``all``: no message is dropped (audit)."""
    largest_age_ticks: int
    """Consumers treat the message as stale if it is older than this many ticks of the robot."""
    largest_bytes: int = 65536
    """Larger messages are rejected before they are parsed. Typical messages have a few hundred bytes."""

    bundles: bool = False
    """Whether messages about different robots may be sent as one bundle."""

    @property
    def per_service(self) -> bool:
        """Whether every service writes it under its own name, which is then the last part of the key."""
        return self.writer == "*"


# Topics of the control loop have a maximum age of 0 ticks: a decision uses the inputs of its own tick, or treats them
# as stale. Scans, heartbeats and findings are not tied to a tick; 40 ticks are 2 s at 20 Hz.
# "latest" for what is useless once a newer one exists; "all" for what must appear in a recording.
STATE = Topic("state", StateMessage, "robot", "latest", 0, bundles=True)
SCAN = Topic("scan", ScanMessage, "robot", "all", 40)
SURROUNDINGS = Topic("surroundings", SurroundingsMessage, "perception", "latest", 0)
LATENT = Topic("latent", LatentMessage, "adaptation", "latest", 0, bundles=True)
NOMINAL = Topic("nominal", NominalMessage, "policy", "latest", 0, bundles=True)
ACTION = Topic("action", ActionMessage, "safety_filter", "latest", 0, bundles=True)
VERDICT = Topic("verdict", VerdictMessage, "safety_filter", "all", 0, bundles=True)
HEALTH = Topic("health", HealthMessage, "*", "latest", 40, bundles=True)
FINDING = Topic("finding", FindingMessage, "diagnosis", "all", 40, _DOCUMENT_BYTES)
MODEL = Topic("model", ModelMessage, "diagnosis", "all", 0, _DOCUMENT_BYTES)
TAKEOVER = Topic("takeover", TakeoverMessage, "*", "all", 0)
ASKED = Topic("asked", AskedMessage, "diagnosis", "all", 0)
SETUP = Topic("setup", SetupMessage, "*", "all", 0, _DOCUMENT_BYTES)
ROSTER = Topic("roster", RosterMessage, "operator", "all", 40)

TOPICS: dict[str, Topic] = {topic.name: topic for topic in tuple(vars().values()) if isinstance(topic, Topic)}
"""Every topic, by name."""


LONGEST_NAME = 128
"""Maximum length of the name of a fleet, robot or service."""


# Every published message needs its key. The limit keeps memory bounded when names come from the network; 1000 robots
# on 8 topics fit.
@lru_cache(maxsize=8192)
def key_of(fleet: str, robot: str, topic: Topic, service: str = "") -> str:
    """Returns the key ``safedpa/{fleet}/{robot}/{topic}``, followed by ``/{service}`` for topics of every service.

    ``*`` as robot or service matches all of them. Raises InputError for names that are not valid in a key.
    """
    names = (fleet, robot, service) if topic.per_service else (fleet, robot)
    for name in names:
        if name != "*":
            _check_name(name)
    key = f"safedpa/{fleet}/{robot}/{topic.name}"
    return f"{key}/{service}" if topic.per_service else key


def _check_name(name: str) -> None:
    # Zenoh gives these characters a meaning in key expressions and selectors; keys that begin with @ are its own
    # administration space.
    if not name or set(name) & set("/*$#?") or name.startswith("@"):
        raise InputError(
            f"name '{readable(name)}': it is empty or contains one of / * $ # ? @; use letters, digits, '-', '_' or '.'"
        )
    # Names end up in logs, file names and on terminals, where a control character could hide or fake text.
    if len(name) > LONGEST_NAME or not name.isprintable():
        raise InputError(
            f"name '{readable(name)}': it has an unprintable character or more than {LONGEST_NAME} characters; "
            "use letters, digits, '-', '_' or '.'"
        )


@lru_cache(maxsize=8192)
def topic_of(key: str) -> tuple[str, str, Topic]:
    """Returns (fleet, robot, topic) of the key of a received message.

    Raises InputError if the key does not belong to this project or does not name exactly one robot: wildcards are
    rejected, and so is a single message under the key of a bundle.
    """
    parts = key.split("/")
    if len(parts) not in (4, 5) or parts[0] != "safedpa":
        raise InputError(f"key '{readable(key)}': wanted safedpa/FLEET/ROBOT/TOPIC")
    if parts[3] not in TOPICS:
        raise InputError(f"key '{readable(key)}': {did_you_mean(readable(parts[3], 40), TOPICS)}")
    topic = TOPICS[parts[3]]
    if (len(parts) == 5) is not topic.per_service:
        raise InputError(
            f"key '{readable(key)}': wanted {'a service' if topic.per_service else 'nothing'} after '{topic.name}'"
        )
    for name in (parts[1], parts[2], *parts[4:]):
        _check_name(name)
    if parts[2] == BUNDLE:
        raise InputError(f"key '{readable(key)}': wanted a bundle of messages")
    return parts[1], parts[2], topic


STAMP_BYTES = 8
"""Size of a stamp: large enough that two keys of a fleet do not collide by chance, small overhead per message."""


# Every message sent or received needs one; 1000 robots on 16 keys fit.
@lru_cache(maxsize=16_384)
def key_stamp(key: str) -> bytes:
    """Returns the stamp attached to messages under ``key``: BLAKE2b of the key in UTF-8, 8 bytes."""
    return blake2b(key.encode(), digest_size=STAMP_BYTES).digest()


def is_misrouted(key: str, stamp: bytes | None) -> bool:
    """Whether a message received under ``key`` was sent under another key. A message without a stamp is accepted."""
    # The stamp detects transport errors, not forgery, which the router's access control prevents. Programs in other
    # languages need not send it.
    return stamp is not None and stamp != key_stamp(key)
