"""What may move, as far as it can have come by the time an action that is chosen now begins to act."""

from __future__ import annotations

from dataclasses import replace

from safedpa.bus import SurroundingsMessage

__all__ = ["moved_on"]

Rows = tuple[tuple[float, ...], ...]


def moved_on(seen: SurroundingsMessage, seconds: float) -> SurroundingsMessage:
    """What may move, wider by what it goes before an action that is chosen now begins to act."""
    if seconds <= 0.0:
        return seen
    movers, hidden = (tuple(_wider(row, width, seconds) for row in rows) for rows, width in _moving(seen))
    return replace(seen, movers=movers, hidden=hidden)


def _moving(seen: SurroundingsMessage) -> tuple[tuple[Rows, int], tuple[Rows, int]]:
    """Rows x, y, radius, ..., speed of what may move, with how many numbers each has to have."""
    return (seen.movers, 6), (seen.hidden, 4)


def _wider(row: tuple[float, ...], width: int, seconds: float) -> tuple[float, ...]:
    """Of a row of another width the scene says that it has one."""
    return row if len(row) != width else (*row[:2], row[2] + row[-1] * seconds, *row[3:])
