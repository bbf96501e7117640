"""Rotates f and g of one robot from its own frame to the world's, on Python floats."""

from __future__ import annotations

__all__ = ["turn_rows", "world_row"]


def turn_rows(rows: list[float], x: int, y: int, width: int, cosine: float, sine: float) -> None:
    """Rotates ``width`` vectors in place; their entries are at ``x``, ``x`` + 1, ... and ``y``, ``y`` + 1, ..."""
    for _ in range(width):
        along, across = rows[x], rows[y]
        rows[x] = cosine * along - sine * across
        rows[y] = sine * along + cosine * across
        x += 1
        y += 1


def world_row(rows: list[float], width: int) -> list[float]:
    """Returns f, then g row by row, from rows of ``width`` values (f, g) for each entry of the state."""
    states = len(rows) // width
    row: list[float] = []
    for entry in range(states):
        row.append(rows[entry * width])
    for entry in range(states):
        for place in range(entry * width + 1, (entry + 1) * width):
            row.append(rows[place])
    return row
