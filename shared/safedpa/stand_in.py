"""What stands in for a robot of one's own while there is no real one: its true motion and its surroundings."""

from __future__ import annotations

from abc import ABC, abstractmethod

from safedpa.errors import InputError

__all__ = ["AbstractStandIn", "world_number"]

Numbers = tuple[float, ...]


class AbstractStandIn(ABC):
    """The truth, as far as it is simulated. No model of the library need know it: that is what a diagnosis is for."""

    goals_reached: int = 0

    @property
    @abstractmethod
    def values(self) -> Numbers:
        """(states,) now, in the order of the robot's system."""

    @property
    def goal(self) -> Numbers:
        """Where it shall go; empty without one."""
        return ()

    @property
    def obstacles(self) -> tuple[Numbers, ...]:
        """What it perceives: x, y, radius in m each."""
        return ()

    @property
    def field(self) -> Numbers:
        """(4,) lowest x, highest x, lowest y, highest y in m, where it may be; empty without one."""
        return ()

    @property
    def footprint(self) -> Numbers:
        """(3,) how far it reaches behind and ahead of its reference point, and its radius in m; empty: not told."""
        return ()

    @abstractmethod
    def advance(self, action: Numbers, seconds: float) -> None:
        """Moves on by ``seconds`` under ``action`` (actions,); counts goals, and chooses the next."""

    @abstractmethod
    def contact(self) -> str:
        """What it touches now and must not; empty: nothing."""

    @abstractmethod
    def watchdog_action(self) -> Numbers:
        """(actions,) what the robot does by itself when no one tells it anything."""


def world_number(text: str) -> tuple[str, float]:
    """``wind=0.8`` as (name, number). Raises InputError for anything else."""
    name, found, number = text.partition("=")
    try:
        value = float(number)
    except ValueError:
        value = float("nan")
    if not found or not name.isidentifier() or not abs(value) < float("inf"):
        raise InputError(f"--world {text}: wanted NAME=NUMBER, such as wind=0.8")
    return name, value
