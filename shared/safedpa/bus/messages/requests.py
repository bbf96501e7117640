"""Requests to services and their answers, sent as queries instead of topics.

People, web pages and services send requests to the diagnosis, the safety filter and perception.
"""

from __future__ import annotations

from dataclasses import dataclass

from safedpa.bus.messages.messages import AskedMessage, Count, header
from safedpa.bus.messages.topics import STATE, key_of
from safedpa.errors import InputError

# Each kind of request has a key of its own, because the router grants access by key and cannot look into a payload.
REQUEST = "request"
"""Last part of the key for requests to the diagnosis that may change a model."""
STATUS = "status"
"""Last part of the key for ``status`` requests to the diagnosis; services may send these, but change nothing."""
ORDER = "order"
"""Last part of the key for orders to the safety filter: ``stop``, ``go`` or ``status``."""
CONFIRM = "confirm"
"""Last part of the key under which a robot confirms its own state to the safety filter; ``confirm`` alone."""
SENSE = "sense"
"""Last part of the key for requests to perception, which switch sources and zones: ``switch`` or ``status``."""
AGREED = "agreed"
"""Last part of the key under which services ask each other for the agreed model while no diagnosis is running."""
LEASE = "lease"
"""Last part of the key under which instances of the safety filter ask the router which of them may send."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """A request to a service about one robot."""

    do: str
    """To the diagnosis ``accept``, ``reject``, ``roll_back`` or ``status``; to the safety filter ``stop``, ``go``,
    ``confirm`` or ``status``; to perception ``switch`` or ``status``."""
    effect: str = ""
    """Name of the candidate to accept or reject."""
    model: str = ""
    """Fingerprint of the model that was active for the requester; a change is refused if another one is active now."""
    finding: Count = 0
    """Number of the finding that proposed the candidate."""
    who: str = ""
    """Name of the requester, for the recording."""
    switches: tuple[str, ...] = ()
    """To perception: ``source NAME=on``, ``zone NAME=off``; either all of them are switched or none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """Result of a request, and the model that is active for the robot."""

    ok: bool
    sentence: str
    """What will be done, or why the request is refused."""
    change: Count = 0
    """Number of the change that this answer is about, or of the last one."""
    fingerprint: str = ""
    """Fingerprint of the active model; empty if the robot is unknown."""
    document: str = ""
    """To ``status``: text of the active model's file."""
    margin: str = ""
    """To ``status``: the filter's margin for it as JSON; empty: the margin shipped with this model, or none."""
    pending: str = ""
    """``preparing``, ``offer`` or ``take`` while a change is pending, else empty."""
    pending_fingerprint: str = ""
    """Fingerprint of the pending model."""
    pending_document: str = ""
    """Text of the pending model's file."""
    pending_margin: str = ""
    """Margin of the pending model."""
    epoch: Count = 0
    """With a pending ``take``: the robot's epoch at the decision."""
    from_tick: Count = 0
    """With a pending ``take``: the tick of that epoch from which the pending model is active."""
    finding: Count = 0
    """Number of the newest finding; 0: none yet."""
    candidates: tuple[str, ...] = ()
    """Effects that can be accepted now, best first."""
    foreseen: tuple[str, ...] = ()
    """To ``status``: the expected effect of accepting each candidate on the filter's margin; empty: not known yet."""
    earlier: Count = 0
    """Number of earlier models to which one can roll back."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LeaseRequest:
    """An instance asks for the lease of its service, or renews it."""

    holder: str
    """Identifier of the instance."""
    carried: str = ""
    """From the holder: what the next holder has to know, such as stop orders."""
    releases: bool = False
    """The holder ends and gives the lease back."""


@dataclass(frozen=True, slots=True, kw_only=True)
class LeaseAnswer:
    """The router's answer: whether the instance holds the lease, for a fixed time from its question on."""

    granted: bool
    term: Count
    """Counts the holders since the router's start."""
    wait: float = 0.0
    """Seconds until the lease of the present holder ends."""
    carried: str = ""
    """What the last holder wanted carried on."""


def request_key(fleet: str, robot: str, name: str = REQUEST) -> str:
    """Returns the key expression ``safedpa/{fleet}/{robot}/{name}``; ``*`` as robot matches every robot.

    Raises InputError for names that are not valid in a key.
    """
    # Built from a topic's key so that the same rules for names apply.
    return key_of(fleet, robot, STATE).removesuffix(STATE.name) + name


def robot_of_request(key: str) -> str:
    """Returns the robot that a request is about. Raises InputError unless the key names exactly one robot."""
    parts = key.split("/")
    # A wildcard would let one query address every robot of the fleet.
    if len(parts) != 4 or parts[3] not in (REQUEST, STATUS, ORDER, CONFIRM, SENSE, AGREED, LEASE) or "*" in key:
        raise InputError(f"key '{key}': wanted safedpa/FLEET/ROBOT/{REQUEST}")
    return parts[2]


def asked_message(request: Request | None, answer: Answer) -> AskedMessage:
    """Returns the audit message about a request, or about a payload that was not a request (None).

    It belongs to no tick; only its publish time is set.
    """
    asked = request or Request(do="")
    return AskedMessage(
        **header(),
        do=asked.do,
        ok=answer.ok,
        sentence=answer.sentence,
        effect=asked.effect,
        model=asked.model,
        finding=asked.finding,
        who=asked.who,
        change=answer.change,
    )
