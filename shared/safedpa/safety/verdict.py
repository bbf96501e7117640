"""The result of the filter: an action, and what is known about it."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

__all__ = ["OUTSIDE_LIMITS", "TOO_LATE", "Status", "Verdict", "resting_verdict"]


@final
class Status(Enum):
    """How the action was chosen; each status has a ``sentence`` and a defined action.

    Example:

        >>> safedpa.Status.fallback.sentence
        'No decision could be computed; the backup action is taken.'
    """

    passed = "passed"
    corrected = "corrected"
    relaxed = "relaxed"
    violated = "violated"
    fallback = "fallback"
    disabled = "disabled"
    stopped = "stopped"

    @property
    def sentence(self) -> str:
        """The status as a sentence."""
        return _SENTENCES[self]


_SENTENCES = {
    Status.passed: "The nominal action satisfies every barrier condition and is handed on unchanged.",
    Status.corrected: "The nominal action was changed to the nearest action that satisfies every barrier condition.",
    Status.relaxed: "No action was found that satisfies every barrier condition; the least-violation one is taken.",
    Status.violated: "Unsafe now: some h is below 0; the action that raises the least h most is taken.",
    Status.fallback: "No decision could be computed; the backup action is taken.",
    Status.disabled: "The filter is switched off; the nominal action is handed on within the actuator limits.",
    Status.stopped: "The robot is to stop; no nominal action is handed on.",
}


OUTSIDE_LIMITS: Final = "The nominal action lay outside the actuator limits."
TOO_LATE: Final = "Some h falls below 0 before this action takes effect."
"""Reason of a verdict whose action satisfies every condition but comes too late."""
_ACTS_LATE: Final = "The action satisfies every barrier condition from the moment at which it acts."


@final
@dataclass(frozen=True, eq=False)
class Verdict:
    """One decision of the filter: the ``action`` (actions,) for the robot, its ``status``, and the ``reason``.

    ``slack``, ``h_now``, ``h_next`` and ``margin`` are in the unit of h; ``known`` says whether h could be computed.
    ``active`` names the barriers that bind, ``nominal`` is the nominal action (actions,) or None, ``solver`` the state
    of the QP solver, ``microseconds`` the duration. Every number in it is finite, whatever the inputs were.

    Example:

        >>> settings = safedpa.FilterSettings.for_robot("pendulum")
        >>> corridor = safedpa.CorridorBarrier(-0.3, 0.3, 0.25)
        >>> model = safedpa.load_model("pendulum")
        >>> safe = safedpa.SafetyFilter.for_model(model, settings, [corridor])
        >>> verdict = safe.decide([0.0, 0.0], [0.5], model.latent)
        >>> verdict.status.value, verdict.intervened, verdict.action.tolist()
        ('passed', False, [0.5])
    """

    action: NDArray[np.float64]
    """(actions,) the action for the robot; always within the actuator limits; read-only."""
    status: Status
    reason: str
    """One sentence about this decision: which input, which barrier, which of two actions."""
    slack: float
    """max_i max(0, (1 - eta) h_i(x) + epsilon_i - h_i(x+)) under ``action``, x+ by the model, in the units of the h_i;
    0 if all constraints hold up to rounding errors."""
    active: tuple[str, ...]
    """Names of the barriers whose constraint binds or is violated, the tightest first."""
    h_now: float
    """Smallest h_i at the state; 0 if unknown, see ``known``."""
    h_next: float
    """Smallest h_i that the model predicts one period ahead under ``action``; 0 if unknown."""
    margin: float
    """Largest epsilon_i in force."""
    solver: str
    """Status of the QP solver: ``solved``, ``not needed`` or why there is no solution."""
    microseconds: float
    """Duration of the decision."""
    nominal: NDArray[np.float64] | None
    """(actions,) the nominal action; None if it was missing or unusable."""
    known: bool
    """False if h_now and h_next could not be computed."""

    @classmethod
    def of(cls, fields: dict[str, Any]) -> Verdict:
        """Makes a verdict from a dictionary of all fields, which it keeps.

        Three times as fast as the constructor of a frozen dataclass, which sets one field after the other.
        """
        # Behind the frozen dataclass: nothing else has a reference to it yet.
        verdict = object.__new__(cls)
        object.__setattr__(verdict, "__dict__", fields)
        return verdict

    def __eq__(self, other: object) -> bool:
        """Whether two verdicts are the same but for the duration: repeated runs then give equal ``info``."""
        if not isinstance(other, Verdict):
            return NotImplemented
        return {**self.as_dict(), "microseconds": 0.0} == {**other.as_dict(), "microseconds": 0.0}

    def __hash__(self) -> int:
        """Of status, reason and action."""
        return hash((self.status, self.reason, self.action.tobytes()))

    @property
    def sentence(self) -> str:
        """Status and reason as text."""
        # Such an action does satisfy the conditions; what happens before it acts is another matter.
        status = _ACTS_LATE if self.reason.startswith(TOO_LATE) else self.status.sentence
        return f"{status} {self.reason}".strip()

    @property
    def intervened(self) -> bool:
        """Whether the action may differ from the nominal action because of safety."""
        # ``disabled`` and ``stopped`` are orders of a person, not decisions of the filter.
        return self.status in (Status.corrected, Status.relaxed, Status.violated, Status.fallback)

    def as_dict(self) -> dict[str, Any]:
        """The verdict as numbers, strings and lists: for JSON and logs."""
        return {
            "action": self.action.tolist(),
            "status": self.status.value,
            "sentence": self.sentence,
            "slack": self.slack,
            "active": list(self.active),
            "h_now": self.h_now,
            "h_next": self.h_next,
            "margin": self.margin,
            "solver": self.solver,
            "microseconds": self.microseconds,
            # None, not zeros: a missing nominal action must not look like a request to stop.
            "nominal": None if self.nominal is None else self.nominal.tolist(),
            "known": self.known,
        }


def resting_verdict(action: NDArray[np.float64], reason: str) -> Verdict:
    """The fallback when the filter could not be called at all: the resting action (actions,), with h unknown."""
    taken = action.copy()  # the caller's array must not become read-only
    taken.flags.writeable = False
    return Verdict(
        action=taken,
        status=Status.fallback,
        reason=f"Reason: {reason}.",
        slack=0.0,
        active=(),
        h_now=0.0,
        h_next=0.0,
        margin=0.0,
        solver="not run",
        microseconds=0.0,
        nominal=None,
        known=False,
    )
