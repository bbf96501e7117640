"""The message bus: topics, typed messages, transports, and the loop that runs every service.

``messages`` has the message types, the table of topics and the codec; ``transport`` carries them over Zenoh or in
memory; ``service`` runs a node for any number of robots; ``security`` has roles, certificates and access control;
``monitor`` summarises a fleet for people and metrics; ``logging`` writes the structured event log.
Read ``messages/topics.py`` first, then ``transport/bus.py`` and ``service/service_loop.py``.
"""

from safedpa.bus.messages.codec import decode, encode
from safedpa.bus.messages.messages import (
    ActionMessage,
    AskedMessage,
    ComputedMessage,
    FindingMessage,
    HealthMessage,
    LatentMessage,
    Message,
    ModelMessage,
    NominalMessage,
    RosterEntry,
    RosterMessage,
    ScanMessage,
    SetupMessage,
    StateMessage,
    SurroundingsMessage,
    TakeoverMessage,
    VerdictMessage,
)
from safedpa.bus.messages.requests import Answer, Request, request_key
from safedpa.bus.messages.topics import (
    ACTION,
    ASKED,
    FINDING,
    HEALTH,
    LATENT,
    MODEL,
    NO_ROBOT,
    NOMINAL,
    ROSTER,
    SCAN,
    SETUP,
    STATE,
    SURROUNDINGS,
    TAKEOVER,
    TOPICS,
    VERDICT,
    Topic,
    key_of,
    topic_of,
)
from safedpa.bus.service.node import AbstractNode, Inputs, Outputs, Stale
from safedpa.bus.service.service_loop import ServiceLoop
from safedpa.bus.transport.base import AbstractTransport
from safedpa.bus.transport.bus import Bus
from safedpa.bus.transport.inbox import Inbox, ReceivedMessage, RejectedMessage
from safedpa.bus.transport.memory import MemoryBroker, MemoryTransport
from safedpa.bus.transport.zenoh import ZenohSettings, ZenohTransport

__all__ = [
    "ACTION",
    "ASKED",
    "FINDING",
    "HEALTH",
    "LATENT",
    "MODEL",
    "NOMINAL",
    "NO_ROBOT",
    "ROSTER",
    "SCAN",
    "SETUP",
    "STATE",
    "SURROUNDINGS",
    "TAKEOVER",
    "TOPICS",
    "VERDICT",
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
    "NominalMessage",
    "Outputs",
    "ReceivedMessage",
    "RejectedMessage",
    "Request",
    "RosterEntry",
    "RosterMessage",
    "ScanMessage",
    "ServiceLoop",
    "SetupMessage",
    "Stale",
    "StateMessage",
    "SurroundingsMessage",
    "TakeoverMessage",
    "Topic",
    "VerdictMessage",
    "ZenohSettings",
    "ZenohTransport",
    "decode",
    "encode",
    "key_of",
    "request_key",
    "topic_of",
]
