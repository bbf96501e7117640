"""The bus: one table of topics, typed messages, transport over Zenoh or in memory, and the loop of every service."""

from safedpa.bus.bus import Bus, Inbox, Received, Refused
from safedpa.bus.codec import decode, encode
from safedpa.bus.memory_transport import MemoryBroker, MemoryTransport
from safedpa.bus.messages import (
    ActionMessage,
    HealthMessage,
    LatentMessage,
    Message,
    StateMessage,
    VerdictMessage,
    WishMessage,
)
from safedpa.bus.node import AbstractNode, Inputs, Outputs, Stale
from safedpa.bus.service import NO_ROBOT, ServiceLoop
from safedpa.bus.topics import ACTION, HEALTH, LATENT, STATE, TOPICS, VERDICT, WISH, Topic, key_of, topic_of
from safedpa.bus.transport import AbstractTransport
from safedpa.bus.zenoh_transport import ZenohSettings, ZenohTransport

__all__ = [
    "ACTION",
    "HEALTH",
    "LATENT",
    "NO_ROBOT",
    "STATE",
    "TOPICS",
    "VERDICT",
    "WISH",
    "AbstractNode",
    "AbstractTransport",
    "ActionMessage",
    "Bus",
    "HealthMessage",
    "Inbox",
    "Inputs",
    "LatentMessage",
    "MemoryBroker",
    "MemoryTransport",
    "Message",
    "Outputs",
    "Received",
    "Refused",
    "ServiceLoop",
    "Stale",
    "StateMessage",
    "Topic",
    "VerdictMessage",
    "WishMessage",
    "ZenohSettings",
    "ZenohTransport",
    "decode",
    "encode",
    "key_of",
    "topic_of",
]
