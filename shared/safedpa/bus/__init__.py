"""The bus: one table of topics, typed messages, transport over Zenoh or in memory, and the loop of every service."""

from safedpa.bus.bus import Bus, Inbox, Received, Refused
from safedpa.bus.codec import decode, encode
from safedpa.bus.memory_transport import MemoryBroker, MemoryTransport
from safedpa.bus.messages import (
    ActionMessage,
    FindingMessage,
    HealthMessage,
    LatentMessage,
    Message,
    ModelMessage,
    StateMessage,
    TakeoverMessage,
    VerdictMessage,
    WishMessage,
)
from safedpa.bus.node import AbstractNode, Inputs, Outputs, Stale
from safedpa.bus.requests import Answer, Request, request_key
from safedpa.bus.service import NO_ROBOT, ServiceLoop
from safedpa.bus.topics import (
    ACTION,
    FINDING,
    HEALTH,
    LATENT,
    MODEL,
    STATE,
    TAKEOVER,
    TOPICS,
    VERDICT,
    WISH,
    Topic,
    key_of,
    topic_of,
)
from safedpa.bus.transport import AbstractTransport
from safedpa.bus.zenoh_transport import ZenohSettings, ZenohTransport

__all__ = [
    "ACTION",
    "FINDING",
    "HEALTH",
    "LATENT",
    "MODEL",
    "NO_ROBOT",
    "STATE",
    "TAKEOVER",
    "TOPICS",
    "VERDICT",
    "WISH",
    "AbstractNode",
    "AbstractTransport",
    "ActionMessage",
    "Answer",
    "Bus",
    "FindingMessage",
    "HealthMessage",
    "Inbox",
    "Inputs",
    "LatentMessage",
    "MemoryBroker",
    "MemoryTransport",
    "Message",
    "ModelMessage",
    "Outputs",
    "Received",
    "Refused",
    "Request",
    "ServiceLoop",
    "Stale",
    "StateMessage",
    "TakeoverMessage",
    "Topic",
    "VerdictMessage",
    "WishMessage",
    "ZenohSettings",
    "ZenohTransport",
    "decode",
    "encode",
    "key_of",
    "request_key",
    "topic_of",
]
