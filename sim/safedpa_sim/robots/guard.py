"""The robot's last gate: which action messages it accepts."""

from __future__ import annotations

import math
from collections import Counter

from safedpa.bus.messages.messages import ActionMessage

__all__ = ["ActionGuard"]

_TOLERANCE = 1e-9
"""How far beyond an actuator limit a number may lie: rounding, no more."""


class ActionGuard:
    """Accepts at most one action a tick, and only one that was computed from this tick's state and is within limits.

    Nothing is clipped or repaired: what is not right is refused, with the reason, and counted.
    """

    def __init__(self, epoch: int, low: tuple[float, ...], high: tuple[float, ...]) -> None:
        self.epoch = epoch
        self.low = low
        self.high = high
        self.tick = 0
        self.refusals: Counter[str] = Counter()
        """How many messages were refused, by reason."""
        self._accepted: tuple[float, ...] | None = None

    @property
    def accepted(self) -> tuple[float, ...] | None:
        """The action of this tick; None while there is none."""
        return self._accepted

    def begin(self, tick: int) -> None:
        """A new period: whatever was accepted before is over."""
        self.tick = tick
        self._accepted = None

    def offer(self, message: ActionMessage) -> str | None:
        """Takes the action, or says why not; None means accepted."""
        reason = self._reason(message)
        if reason is None:
            self._accepted = tuple(float(value) for value in message.values)
        else:
            self.refusals[reason] += 1
        return reason

    def withdraw(self, reason: str) -> None:
        """Takes back what was accepted for this tick, and counts why."""
        self._accepted = None
        self.refusals[reason] += 1

    def refuse(self, reason: str) -> None:
        """Counts what did not even become a message."""
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
