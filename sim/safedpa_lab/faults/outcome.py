"""What came of one fault, and of all of them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

__all__ = ["Campaign", "Outcome", "joined"]


@dataclass(frozen=True)
class Outcome:
    """What one fault did, from its beginning to a second after the loop drove again."""

    name: str
    sentence: str
    held: bool
    """Whether every invariant held."""
    broken: tuple[str, ...]
    """Those that did not, in words."""
    speed: float
    """m/s when it struck."""
    collisions: int
    stale_actions: int
    """Applied, and older than allowed or of another state."""
    periods: int
    watchdog: int
    """Periods in which the robot braked by itself."""
    fallbacks: int
    """Periods in which the filter braked for want of an input."""
    recovery_seconds: float | None
    """From the recovery until the loop drove again; 0 when it had never stopped, None when it did not."""
    whole_seconds: float | None
    """From the recovery until every process had reported its health again; None when one did not."""
    states_not_recorded: int
    verdicts_not_recorded: int
    """Of those that were heard on the bus."""


@dataclass(frozen=True)
class Campaign:
    """What came of all faults."""

    outcomes: tuple[Outcome, ...]
    periods: int
    """Lived by all robots, between the faults as well."""
    collisions: int
    """In all of them."""
    stale_actions: int
    """In all of them."""
    acknowledged: int
    """Messages that the recorders said were on the disk."""
    recorded: int
    """Messages that can be read from the recordings; fewer than acknowledged would be a broken promise."""

    @property
    def held(self) -> bool:
        """Whether every invariant held in every fault and between them, and no acknowledged message was lost."""
        safe = self.collisions == 0 and self.stale_actions == 0
        return safe and all(outcome.held for outcome in self.outcomes) and self.recorded >= self.acknowledged


def joined(parts: Sequence[Campaign]) -> Campaign:
    """What came of several fleets, one after another."""
    return Campaign(
        outcomes=tuple(outcome for part in parts for outcome in part.outcomes),
        periods=sum(part.periods for part in parts),
        collisions=sum(part.collisions for part in parts),
        stale_actions=sum(part.stale_actions for part in parts),
        acknowledged=sum(part.acknowledged for part in parts),
        recorded=sum(part.recorded for part in parts),
    )
