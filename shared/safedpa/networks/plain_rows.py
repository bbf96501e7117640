"""f and g of one robot as plain numbers, turned from the robot's own frame into the world's."""

from __future__ import annotations

__all__ = ["turn_rows", "world_row"]


def turn_rows(rows: list[float], x: int, y: int, width: int, cosine: float, sine: float) -> None:
    """Turns the vectors whose entries are ``width`` numbers each, from places ``x`` and ``y`` on, where they stand."""
    for _ in range(width):
        along, across = rows[x], rows[y]
        rows[x] = cosine * along - sine * across
        rows[y] = sine * along + cosine * across
        x += 1
        y += 1


def world_row(rows: list[float], width: int) -> list[float]:
    """From f and g of each entry of the state in turn, ``width`` numbers each: all of f, then g entry by entry."""
    states = len(rows) // width
    row: list[float] = []
    for entry in range(states):
        row.append(rows[entry * width])
    for entry in range(states):
        for place in range(entry * width + 1, (entry + 1) * width):
            row.append(rows[place])
    return row
