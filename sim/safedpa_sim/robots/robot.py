"""What every simulated robot on the bus has in common."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Protocol

from safedpa.bus.messages import ActionMessage, StateMessage
from safedpa_sim.robots.guard import ActionGuard

__all__ = ["SimulatedRobot"]


class SimulatedRobot(Protocol):
    """What the loop turns and the account tells of."""

    period: float
    lockstep: bool
    tick: int
    goals_reached: int
    watchdog_ticks: int
    guard: ActionGuard

    @property
    def about(self) -> dict[str, Any]:
        """What was asked for: seed, load, wind; for the account."""

    @property
    def at_rest(self) -> bool:
        """Whether nothing is gained by waiting longer for the watchdog at the end of a run."""

    @property
    def collisions(self) -> Sequence[Any]:
        """Every collision or violation so far, each a dataclass."""

    @property
    def trajectory_hash(self) -> str:
        """SHA-256 over all states so far."""

    def state_message(self) -> StateMessage:
        """The state of this tick."""

    def receive(self, message: ActionMessage) -> str | None:
        """Accepts the action for this tick (None), or says why not."""

    def advance(self) -> None:
        """One period under the accepted action, or under the watchdog's when none was accepted."""
