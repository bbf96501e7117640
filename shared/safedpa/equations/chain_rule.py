"""What actions change in h, from its slopes over the state: d(h)/d(a) = p'g, in plain numbers."""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["chain_rule"]


def chain_rule(slopes: Sequence[Sequence[float]], g: list[list[float]]) -> list[list[float]]:
    """p'g (rows, actions) of slopes p (rows, states), g (states, actions). Raises ValueError where they do not fit."""
    states, actions = len(g), len(g[0]) if g else 0
    found: list[list[float]] = []
    for p in slopes:
        if len(p) != states:
            raise ValueError(f"h has slopes of {len(p)} states, the model of {states}")
        entries: list[float] = list(p)
        row: list[float] = []
        for column in range(actions):
            total = 0.0
            for state in range(states):
                total += entries[state] * g[state][column]
            row.append(total)
        found.append(row)
    return found
