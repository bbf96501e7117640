"""What a person, a page or a service asks of the diagnosis, and what it answers; carried by queries, not by topics."""

from __future__ import annotations

import time
from dataclasses import dataclass

from safedpa.bus.messages.messages import AskedMessage, Count
from safedpa.bus.messages.topics import STATE, key_of
from safedpa.errors import InputError

__all__ = [
    "AGREED",
    "ORDER",
    "REQUEST",
    "SENSE",
    "STATUS",
    "Answer",
    "Request",
    "asked_message",
    "request_key",
    "robot_of_request",
]

REQUEST = "request"
"""Last part of the key under which the diagnosis is asked to change a model, or about it."""
STATUS = "status"
"""The same, but only ``status`` may be asked: the services of the loop may ask what is, and change nothing."""
ORDER = "order"
"""The same of the safety filter, which is told to stop robots or to let them drive: ``stop``, ``go`` or ``status``."""
SENSE = "sense"
"""The same of perception, which is told to switch sources and zones: ``switch`` or ``status``."""
AGREED = "agreed"
"""Last part of the key under which services tell each other what they agreed on, while no diagnosis is there."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Request:
    """A question to the diagnosis about one robot."""

    do: str
    """``accept``, ``reject``, ``roll_back`` or ``status``; of the safety filter ``stop``, ``go`` or ``status``; of
    perception ``switch`` or ``status``."""
    effect: str = ""
    """Name of the candidate to accept or reject."""
    model: str = ""
    """Fingerprint of the model that the asker saw in force; a change is refused when it is not that one any more."""
    finding: Count = 0
    """Number of the finding whose candidate it is."""
    who: str = ""
    """Who asks, for the recording."""
    switches: tuple[str, ...] = ()
    """Of perception: ``source NAME=on``, ``zone NAME=off``; all of them or none."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Answer:
    """What came of a request, and which model is in force."""

    ok: bool
    sentence: str
    """What is done, or why it is refused."""
    change: Count = 0
    """Number of the change that this is about, or of the last one."""
    fingerprint: str = ""
    """Of the model in force; empty when the robot is not known."""
    document: str = ""
    """To ``status``: file of the model in force."""
    margin: str = ""
    """To ``status``: the filter's margin for it, as JSON text; empty: the shipped one of this model, or none."""
    pending: str = ""
    """``preparing``, ``offer`` or ``take`` while a change is under way, else empty."""
    pending_fingerprint: str = ""
    """Of the model that is being offered or taken."""
    pending_document: str = ""
    """Its file."""
    pending_margin: str = ""
    """Its margin."""
    epoch: Count = 0
    """With a pending ``take``: the robot's epoch at the decision."""
    from_tick: Count = 0
    """With a pending ``take``: the tick of that epoch from which the pending model is in force."""
    finding: Count = 0
    """Number of the newest finding; 0 while there was none."""
    candidates: tuple[str, ...] = ()
    """Effects that can be accepted now, best first."""
    foreseen: tuple[str, ...] = ()
    """To ``status``: what accepting each candidate would do to the filter's margin, in words; empty: not known yet."""
    earlier: Count = 0
    """How many models there are to roll back to."""


def request_key(fleet: str, robot: str, name: str = REQUEST) -> str:
    """The key expression ``safedpa/{fleet}/{robot}/request`` (or ``agreed``); ``*`` as robot: every one.

    Raises InputError for names that the bus cannot carry.
    """
    return key_of(fleet, robot, STATE).removesuffix(STATE.name) + name


def robot_of_request(key: str) -> str:
    """The robot that a request is about. Raises InputError when the key names none, or more than one."""
    parts = key.split("/")
    if len(parts) != 4 or parts[3] not in (REQUEST, STATUS, ORDER, SENSE, AGREED) or "*" in key:
        raise InputError(f"key '{key}': wanted safedpa/FLEET/ROBOT/{REQUEST}")
    return parts[2]


def asked_message(request: Request | None, answer: Answer) -> AskedMessage:
    """The message about a request, None where it was none. It belongs to no tick: its stamp has the time alone."""
    return AskedMessage(
        epoch=0,
        tick=0,
        robot_time=0.0,
        publish_time=time.time(),
        do="" if request is None else request.do,
        ok=answer.ok,
        sentence=answer.sentence,
        effect="" if request is None else request.effect,
        model="" if request is None else request.model,
        finding=0 if request is None else request.finding,
        who="" if request is None else request.who,
        change=answer.change,
    )
