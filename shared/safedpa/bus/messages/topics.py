"""The one table of topics: key, message, writer, how old it may be, how it is delivered, whether it is recorded.

Code, staleness checks, recorder, dashboard and docs read this table; a test says that they agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache
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
    ScanMessage,
    SetupMessage,
    StateMessage,
    SurroundingsMessage,
    TakeoverMessage,
    VerdictMessage,
)
from safedpa.errors import InputError, did_you_mean
from safedpa.limits import readable

__all__ = [
    "ACTION",
    "ASKED",
    "BUNDLE",
    "FINDING",
    "HEALTH",
    "LATENT",
    "MODEL",
    "NOMINAL",
    "SCAN",
    "SETUP",
    "STATE",
    "SURROUNDINGS",
    "TAKEOVER",
    "TOPICS",
    "VERDICT",
    "Topic",
    "key_of",
    "topic_of",
]

Delivery = Literal["latest", "all"]

BUNDLE = "+"
"""Stands for the robot in the key of a bundle, which holds messages about many; no robot can have this name."""

_DOCUMENT_BYTES = 4 * 1024 * 1024
"""Reports of a search and model files travel in messages, a few times in an hour."""


@dataclass(frozen=True, eq=False)
class Topic:
    """One kind of message on the bus."""

    name: str
    message: type[Message]
    writer: str
    """The only service that may send it; ``*``: every service under its own name."""
    delivery: Delivery
    """``latest``: a newer one replaces an unread one (commands); ``all``: nothing is dropped (audit)."""
    largest_age_ticks: int
    """A consumer treats it as stale when it is older than this many ticks of the robot."""
    largest_bytes: int = 65536
    """A message of a few hundred bytes that is larger than this is refused before it is parsed."""

    bundles: bool = False
    """Whether several messages of it, about different robots, may travel as one."""

    @property
    def per_service(self) -> bool:
        """Whether every service writes it under its own name, which then stands at the end of the key."""
        return self.writer == "*"


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

TOPICS: dict[str, Topic] = {
    topic.name: topic
    for topic in (
        STATE,
        SCAN,
        SURROUNDINGS,
        LATENT,
        NOMINAL,
        ACTION,
        VERDICT,
        HEALTH,
        FINDING,
        MODEL,
        TAKEOVER,
        ASKED,
        SETUP,
    )
}
"""Every topic, by name."""


LONGEST_NAME = 128
"""Letters of a fleet's, a robot's or a service's name."""


@lru_cache(maxsize=8192)
def key_of(fleet: str, robot: str, topic: Topic, service: str = "") -> str:
    """The key expression ``safedpa/{fleet}/{robot}/{topic}``, with ``/{service}`` behind health and takeover.

    ``*`` as robot or service means every one. Raises InputError for names that the bus cannot carry.
    """
    names = (fleet, robot, service) if topic.per_service else (fleet, robot)
    for name in names:
        if name != "*":
            _check_name(name)
    key = f"safedpa/{fleet}/{robot}/{topic.name}"
    return f"{key}/{service}" if topic.per_service else key


def _check_name(name: str) -> None:
    if not name or set(name) & set("/*$#?") or name.startswith("@"):
        raise InputError(
            f"name '{readable(name)}': got nothing, or one of / * $ # ? @; wanted letters, digits, '-', '_' or '.'"
        )
    if len(name) > LONGEST_NAME or not name.isprintable():
        raise InputError(
            f"name '{readable(name)}': got a character that is not printed, or more than {LONGEST_NAME}; wanted "
            "letters, digits, '-', '_' or '.'"
        )


@lru_cache(maxsize=8192)
def topic_of(key: str) -> tuple[str, str, Topic]:
    """(fleet, robot, topic) of a key under which a message was sent.

    Raises InputError when the key is not one of this project's, or names more than one robot: anyone who sends under a
    wildcard speaks for no one, and what comes under a bundle's key and is none, neither.
    """
    parts = key.split("/")
    if len(parts) not in (4, 5) or parts[0] != "safedpa":
        raise InputError(f"key '{readable(key)}': wanted safedpa/FLEET/ROBOT/TOPIC")
    if parts[3] not in TOPICS:
        raise InputError(f"key '{readable(key)}': {did_you_mean(readable(parts[3], 40), TOPICS)}")
    topic = TOPICS[parts[3]]
    if (len(parts) == 5) is not topic.per_service:
        raise InputError(
            f"key '{readable(key)}': wanted {'a service' if topic.per_service else 'nothing'} behind '{topic.name}'"
        )
    for name in (parts[1], parts[2], *parts[4:]):
        _check_name(name)
    if parts[2] == BUNDLE:
        raise InputError(f"key '{readable(key)}': got no bundle of messages there, wanted one")
    return parts[1], parts[2], topic
