"""The one table of topics: key, message, writer, how old it may be, how it is delivered, whether it is recorded.

Code, staleness checks, recorder, dashboard and docs read this table; a test says that they agree.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

from safedpa.bus.messages import (
    ActionMessage,
    HealthMessage,
    LatentMessage,
    Message,
    StateMessage,
    VerdictMessage,
    WishMessage,
)
from safedpa.errors import InputError, did_you_mean

__all__ = ["ACTION", "HEALTH", "LATENT", "STATE", "TOPICS", "VERDICT", "WISH", "Topic", "key_of", "topic_of"]

Delivery = Literal["latest", "all"]


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


STATE = Topic("state", StateMessage, "robot", "latest", 0)
LATENT = Topic("latent", LatentMessage, "adaptation", "latest", 0)
WISH = Topic("wish", WishMessage, "policy", "latest", 0)
ACTION = Topic("action", ActionMessage, "safety_filter", "latest", 0)
VERDICT = Topic("verdict", VerdictMessage, "safety_filter", "all", 0)
HEALTH = Topic("health", HealthMessage, "*", "latest", 40)

TOPICS: dict[str, Topic] = {topic.name: topic for topic in (STATE, LATENT, WISH, ACTION, VERDICT, HEALTH)}
"""Every topic, by name."""


def key_of(fleet: str, robot: str, topic: Topic, service: str = "") -> str:
    """The key expression ``safedpa/{fleet}/{robot}/{topic}``, with ``/{service}`` behind health.

    ``*`` as robot or service means every one. Raises InputError for names that the bus cannot carry.
    """
    for name in (fleet, robot, service):
        if name != "*" and (set(name) & set("/*$#?") or name.startswith("@")):
            raise InputError(f"name '{name}': got one of / * $ # ? @, wanted letters, digits, '-', '_' or '.'")
    if not fleet or not robot:
        raise InputError("fleet and robot: got an empty name, wanted letters, digits, '-', '_' or '.'")
    key = f"safedpa/{fleet}/{robot}/{topic.name}"
    return f"{key}/{service}" if topic is HEALTH else key


def topic_of(key: str) -> tuple[str, str, Topic]:
    """(fleet, robot, topic) of a key.

    Raises InputError when the key is not one of this project's.
    """
    parts = key.split("/")
    if len(parts) < 4 or parts[0] != "safedpa":
        raise InputError(f"key '{key}': wanted safedpa/FLEET/ROBOT/TOPIC")
    if parts[3] not in TOPICS:
        raise InputError(f"key '{key}': {did_you_mean(parts[3], TOPICS)}")
    return parts[1], parts[2], TOPICS[parts[3]]
