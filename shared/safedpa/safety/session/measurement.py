"""One measured state of a robot, as a session receives it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, final

__all__ = ["MeasuredState", "Measurement"]

Plain = tuple[float, ...]


class MeasuredState(Protocol):
    """The fields of a state that a session uses; the state messages of the bus have them as well."""

    @property
    def epoch(self) -> int:
        """Changes when the source of the state restarts."""

    @property
    def tick(self) -> int:
        """Number of the period, counted by the source."""

    @property
    def robot_time(self) -> float:
        """Time [s] of the measurement by the source's clock."""

    @property
    def values(self) -> Plain:
        """(states,) the measured state."""

    @property
    def applied(self) -> Plain:
        """(actions,) the action applied during the period that has just ended."""

    @property
    def applied_by(self) -> str:
        """``filter`` if ``applied`` is the action of the last decision."""

    @property
    def period(self) -> float:
        """Control period [s]."""

    @property
    def until_action(self) -> float:
        """Time [s] from the measurement until this tick's action acts."""

    @property
    def sources(self) -> tuple[str, ...]:
        """Sensors that observe the surroundings; empty if the barriers describe everything."""


@final
@dataclass(frozen=True)
class Measurement:
    """A measured state without a bus."""

    tick: int
    robot_time: float
    values: Plain
    applied: Plain
    applied_by: str
    period: float
    until_action: float = 0.0
    epoch: int = 0
    sources: tuple[str, ...] = ()
