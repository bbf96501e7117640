"""The interface of a simulated robot, which replaces the real one: its true motion and its surroundings."""

from __future__ import annotations

from abc import ABC, abstractmethod

from safedpa.errors import InputError

__all__ = ["AbstractStandIn", "world_number"]

Numbers = tuple[float, ...]


class AbstractStandIn(ABC):
    """A simulated robot. Its dynamics may differ from every model in the library, for the diagnosis to find."""

    goals_reached: int = 0

    @property
    @abstractmethod
    def values(self) -> Numbers:
        """The current state (states,) in the order of the robot's system."""

    @property
    def goal(self) -> Numbers:
        """The current goal; empty without one."""
        return ()

    @property
    def obstacles(self) -> tuple[Numbers, ...]:
        """The perceived obstacles: x, y and radius in m."""
        return ()

    @property
    def field(self) -> Numbers:
        """(4,) minimum x, maximum x, minimum y, maximum y of the permitted area in m; empty without one."""
        return ()

    @property
    def footprint(self) -> Numbers:
        """(3,) extent behind and ahead of the reference point, and radius in m; empty if unknown."""
        return ()

    @abstractmethod
    def advance(self, action: Numbers, seconds: float) -> None:
        """Simulates ``seconds`` with ``action`` (actions,); counts reached goals and chooses the next one."""

    @abstractmethod
    def contact(self) -> str:
        """Returns the name of an object in forbidden contact with the robot; empty without contact."""

    @abstractmethod
    def watchdog_action(self) -> Numbers:
        """Returns the action (actions,) of the robot's watchdog when no action arrives."""


def world_number(text: str) -> tuple[str, float]:
    """Parses ``wind=0.8`` into (name, value). Raises InputError for anything else."""
    name, found, number = text.partition("=")
    try:
        value = float(number)
    except ValueError:
        value = float("nan")
    if not found or not name.isidentifier() or not abs(value) < float("inf"):
        raise InputError(f"--world {text}: wanted NAME=NUMBER, such as wind=0.8")
    return name, value
