"""What actions change in h, from its slopes over the state: d(h)/d(a) = p'g, in plain numbers."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["chain_rule"]


def chain_rule(slopes: Sequence[Sequence[float]], g: list[list[float]]) -> list[list[float]]:
    """p'g (rows, actions) of slopes p (rows, states), g (states, actions). Raises ValueError where they do not fit."""
    states = len(g)
    found: list[list[float]] = []
    for p in slopes:
        if len(p) != states:
            raise ValueError(f"h has slopes of {len(p)} states, the model of {states}")
        row = [0.0] * len(g[0])
        for state in range(states):
            slope: float = p[state]
            entries = g[state]
            for column in range(len(row)):
                row[column] += slope * entries[column]
        found.append(row)
    return found
