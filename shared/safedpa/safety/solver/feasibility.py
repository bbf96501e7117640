"""The action with the most room in every constraint: feasible wherever the linearised constraints can be satisfied.

The quadratic program pays a finite price for slack. Where rows are nearly parallel, their multipliers exceed any price,
and its solution violates a constraint although some action satisfies all. The linear program

    max over a, t of t   subject to   residual_i(a) / scale_i >= t for every row,   low <= a <= high

has no price: t > 0 if and only if an action satisfies every linearised constraint with room.
"""

from __future__ import annotations

from collections.abc import Sequence
from math import nan
from typing import Final, Protocol

from safedpa.safety.errors import NotFiniteError
from safedpa.safety.solver.constraints import ActionCandidate, Constraints
from safedpa.safety.solver.qp_scaling import Side, clip_to_bounds

__all__ = ["most_feasible"]

_ROUNDS: Final = 3
"""Linearisations: for a model that is affine in the action the first is exact."""


class _MaxMin(Protocol):
    """What the search needs of ``MaxMinProgram``."""

    def solve(
        self, gradients: Sequence[Sequence[float]], offsets: Sequence[float], levels: Sequence[float]
    ) -> list[float] | None:
        """u (actions,) that maximises the smallest free row."""


def most_feasible(
    constraints: Constraints, sides: tuple[Side, ...], maximin_lp: _MaxMin, about: ActionCandidate
) -> ActionCandidate:
    """The candidate with the largest smallest scaled residual; ``about``, where it begins, if none is better."""
    best = about
    for _ in range(_ROUNDS):
        if best.is_feasible or not best.is_finite:
            break
        try:
            rows = constraints.linearize(best).all(len(best.residual))
        except NotFiniteError:  # no derivatives there
            break
        gradients: list[list[float]] = []
        offsets: list[float] = []
        for index, row in enumerate(rows):
            scale, offset = constraints.scales[index], best.residual[index]
            for column, (low, _, _) in enumerate(sides):
                offset -= row[column] * (best.action[column] - low)
            gradients.append([row[column] * width / scale for column, (_, _, width) in enumerate(sides)])
            offsets.append(offset / scale)
        u = maximin_lp.solve(gradients, offsets, [nan] * len(rows))
        if u is None:
            break
        action = [low + width * share for (low, _, width), share in zip(sides, u, strict=True)]
        found = constraints.evaluate(clip_to_bounds(action, sides))
        if not found.is_feasible and constraints.min_scaled_residual(found) <= constraints.min_scaled_residual(best):
            break
        best = found
    return best
