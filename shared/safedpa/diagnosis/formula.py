"""A formula as an effect, so that it is simulated, fitted and judged like one; it is not one, and has no name."""

from __future__ import annotations

from collections.abc import Sequence
from typing import final

from safedpa.diagnosis.terms import TIME, Term
from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["Formula"]


@final
class Formula(RateEffect):
    """d(state)/dt += coefficient term, for several terms; coefficients are ``c0``, ``c1`` and so on."""

    name = "formula"
    robot = "any"
    stage = Stage.MOTION
    equation = "d(state)/dt += sum of coefficient term"
    signature = "whatever fits"
    source = "sparse regression; see weak_form"

    def __init__(self, terms: Sequence[tuple[str, Term]], sizes: Sequence[float], robot: str, units: str) -> None:
        self.terms = tuple(terms)
        self.robot = robot  # type: ignore[misc]
        self.parameters = tuple(  # type: ignore[misc]
            Parameter(f"c{index}", units, -1e6, 1e6, max(abs(size), 1e-9)) for index, size in enumerate(sizes)
        )

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        named = {**context.state, **context.action, TIME: context.time}
        changed = dict(rates)
        for index, (state, term) in enumerate(self.terms):
            changed[state] = changed[state] + parameters[f"c{index}"] * term.value(named, context.operations)
        return changed
