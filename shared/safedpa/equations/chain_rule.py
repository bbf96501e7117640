"""The chain rule d(h)/d(a) = p'g, with p the slopes of h over the state, on Python floats."""

from __future__ import annotations

from collections.abc import Sequence


def chain_rule(slopes: Sequence[Sequence[float]], g: list[list[float]]) -> list[list[float]]:
    """Returns p'g (rows, actions) for p (rows, states), g (states, actions). Raises ValueError for other shapes."""
    states, actions = len(g), len(g[0]) if g else 0
    if states == 4 and actions == 2:
        return _of_a_car(slopes, g)
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


def _of_a_car(slopes: Sequence[Sequence[float]], g: list[list[float]]) -> list[list[float]]:
    """The same sums in the same order for four states and two actions, unrolled: compiled, values stay in registers."""
    (a0, b0), (a1, b1), (a2, b2), (a3, b3) = _pair(g[0]), _pair(g[1]), _pair(g[2]), _pair(g[3])
    found: list[list[float]] = []
    for p in slopes:
        if len(p) != 4:
            raise ValueError(f"h has slopes of {len(p)} states, the model of 4")
        p0: float = p[0]
        p1: float = p[1]
        p2: float = p[2]
        p3: float = p[3]
        # 0.0 + as in the general loop: it turns -0.0 into 0.0
        found.append([0.0 + p0 * a0 + p1 * a1 + p2 * a2 + p3 * a3, 0.0 + p0 * b0 + p1 * b1 + p2 * b2 + p3 * b3])
    return found


def _pair(row: list[float]) -> tuple[float, float]:
    return row[0], row[1]
