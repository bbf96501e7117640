"""A request to the diagnosis and its answer, as they are told to the recorder."""

from __future__ import annotations

import time

from safedpa.bus.messages import AskedMessage
from safedpa.bus.requests import Answer, Request

__all__ = ["asked_message"]


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
