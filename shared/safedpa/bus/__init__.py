"""The bus: one table of topics, typed messages, transport over Zenoh or in memory, and the loop of every service."""

from safedpa.bus.bus import Bus
from safedpa.bus.codec import decode, encode
from safedpa.bus.inbox import Inbox, Received, Refused
from safedpa.bus.memory_transport import MemoryBroker, MemoryTransport
from safedpa.bus.messages import (
    ActionMessage,
    AskedMessage,
    ComputedMessage,
    FindingMessage,
    HealthMessage,
    LatentMessage,
    Message,
    ModelMessage,
    SetupMessage,
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
    ASKED,
    FINDING,
    HEALTH,
    LATENT,
    MODEL,
    SETUP,
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
    "ASKED",
    "FINDING",
    "HEALTH",
    "LATENT",
    "MODEL",
    "NO_ROBOT",
    "SETUP",
    "STATE",
    "TAKEOVER",
    "TOPICS",
    "VERDICT",
    "WISH",
    "AbstractNode",
    "AbstractTransport",
    "ActionMessage",
    "Answer",
    "AskedMessage",
    "Bus",
    "ComputedMessage",
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
    "SetupMessage",
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
