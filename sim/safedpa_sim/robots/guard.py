"""The robot's check of action messages before it applies them."""

from __future__ import annotations

import math
from collections import Counter

from safedpa.bus.messages.messages import ActionMessage

_TOLERANCE = 1e-9
"""Tolerance for rounding errors at an actuator limit."""


class ActionGuard:
    """Accepts at most one action per tick; it must belong to this tick's state and be within the actuator limits.

    Actions are never clipped or corrected: an invalid one is refused with a reason and counted.
    """

    def __init__(self, epoch: int, low: tuple[float, ...], high: tuple[float, ...]) -> None:
        self.epoch = epoch
        self.low = low
        self.high = high
        self.tick = 0
        self.refusals: Counter[str] = Counter()
        """Number of refused messages by reason."""
        self._accepted: tuple[float, ...] | None = None

    @property
    def accepted(self) -> tuple[float, ...] | None:
        """The accepted action of this tick; None if there is none yet."""
        return self._accepted

    def begin(self, tick: int) -> None:
        """Starts a new period and discards the action accepted before."""
        self.tick = tick
        self._accepted = None

    def offer(self, message: ActionMessage) -> str | None:
        """Returns None if the action is accepted, otherwise the reason for the refusal."""
        reason = self._reason(message)
        if reason is None:
            self._accepted = tuple(float(value) for value in message.values)
        else:
            self.refusals[reason] += 1
        return reason

    def withdraw(self, reason: str) -> None:
        """Withdraws the action accepted for this tick and counts the reason."""
        self._accepted = None
        self.refusals[reason] += 1

    def refuse(self, reason: str) -> None:
        """Counts the refusal of a message that could not be decoded."""
        self.refusals[reason] += 1

    def _reason(self, message: ActionMessage) -> str | None:
        if message.epoch != self.epoch:
            return "wrong epoch"
        if message.tick != self.tick:
            return "late" if message.tick < self.tick else "from the future"
        if self._accepted is not None:
            return "repeated"
        return self._fault(message.values)

    def _fault(self, values: tuple[float, ...]) -> str | None:
        if len(values) != len(self.low):
            return "wrong length"
        if not all(math.isfinite(value) for value in values):
            return "not finite"
        for value, low, high in zip(values, self.low, self.high, strict=True):
            if not low - _TOLERANCE <= value <= high + _TOLERANCE:
                return "out of range"
        return None
