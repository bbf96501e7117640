"""Which requests to change a model are refused, and with which reason."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Final

from safedpa.bus import Request
from safedpa.errors import did_you_mean

__all__ = ["REQUESTS", "refusal_of"]

REQUESTS: Final = ("accept", "reject", "roll_back", "status")
"""What may be asked."""


def refusal_of(
    request: Request,
    *,
    in_force: str,
    under_way: str,
    finding: int,
    candidates: Sequence[str],
    versions: int,
    alive: bool,
) -> str:
    """Why a request is refused; empty when it is not.

    ``in_force`` is the model's fingerprint, ``under_way`` the change that is being made, ``finding`` the newest one
    with its ``candidates``, ``versions`` how many were agreed on, ``alive`` whether the robot was heard.
    """
    if request.do not in REQUESTS:
        return f"'{request.do}': {did_you_mean(request.do, REQUESTS)}"
    if request.do == "status":
        return ""
    if under_way:
        return f"{under_way} is under way; ask again when it is done"
    if not alive:
        return "the robot was not heard yet; start it first"
    return _about_model(request, in_force, versions) or _about_candidate(request, finding, candidates)


def _about_model(request: Request, in_force: str, versions: int) -> str:
    if request.model != in_force:
        seen = f"you saw {request.model}" if request.model else "you name none"
        return f"the model in force is {in_force}, {seen}; look at it again first"
    if request.do == "roll_back" and versions < 2:
        return "this is the model that the robot began with; there is none to go back to"
    return ""


def _about_candidate(request: Request, finding: int, candidates: Sequence[str]) -> str:
    if request.do == "roll_back":
        return ""
    if request.finding != finding:
        return f"the newest finding has number {finding}, you name {request.finding}; look at it again first"
    if request.effect not in candidates:
        known = did_you_mean(request.effect, candidates) if candidates else "nothing is proposed now"
        return f"effect '{request.effect}' is no candidate; {known}"
    return ""
