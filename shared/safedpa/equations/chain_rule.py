"""The chain rule d(h)/d(a) = p'g, with p the slopes of h over the state, on Python floats."""

from __future__ import annotations

from collections.abc import Sequence


def chain_rule(slopes: Sequence[Sequence[float]], g: list[list[float]]) -> list[list[float]]:
    """Returns p'g (rows, actions) for p (rows, states), g (states, actions). Raises ValueError for other shapes."""
    states, actions = len(g), len(g[0]) if g else 0
    found: list[list[float]] = []
    for p in slopes:
        if len(p) != states:
            raise ValueError(f"h has slopes of {len(p)} states, the model of {states}")
        row = [0.0] * actions
        # no sum(): from Python 3.12 on it rounds otherwise than C
        for entry, column in zip(p, g, strict=True):
            for action in range(actions):
                row[action] += entry * column[action]
        found.append(row)
    return found
