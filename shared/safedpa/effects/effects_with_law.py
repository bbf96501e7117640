"""Effects with a law: the same equation, its numbers those that hold here and now.

A condition or a number that varies wraps an effect of the library; the name stays. What acts on rates is wrapped as it
is. What acts on commands and remembers nothing (gains, offsets, dead zones, stops) acts, with a law, on the command
that the mechanics feel, after every delay and lag, for there state and time are known. Lags, delays and sensors have no
law: what they would remember, or how the measured state would be undone, is not defined.
"""

from __future__ import annotations

from typing import Any, final

from safedpa.effects.effect import (
    AbstractEffect,
    CommandEffect,
    Context,
    FeltEffect,
    Named,
    RateEffect,
    Stage,
)
from safedpa.effects.law import TIME, Law
from safedpa.errors import ModelFileError
from safedpa.systems import System

__all__ = ["Conditioned", "ConditionedCommand", "ConditionedRate", "conditioned", "law_behind", "may_have_law", "plain"]


class Conditioned(AbstractEffect):
    """What both kinds share; two of them are equal where effect, law and system are."""

    inner: AbstractEffect
    law: Law

    def __init__(self, inner: AbstractEffect, law: Law, system: System) -> None:
        law.check(inner, system)
        self.inner, self.law, self.known = inner, law, system
        self.name: str = inner.name  # type: ignore[misc]
        self.robot: str = inner.robot  # type: ignore[misc]
        self.stage: Stage = inner.stage  # type: ignore[misc]
        self.equation: str = f"{inner.equation}; {law.key} {law.phrase}"  # type: ignore[misc]
        self.parameters = (*inner.parameters, *law.parameters(inner, system))  # type: ignore[misc]
        self.signature: str = inner.signature  # type: ignore[misc]
        self.source: str = inner.source  # type: ignore[misc]
        self.timed: bool = inner.timed or TIME in law.variables  # type: ignore[misc]
        self.needs = inner.needs  # type: ignore[misc]
        self.mirrored = inner.mirrored  # type: ignore[misc]

    def __eq__(self, other: object) -> bool:
        return isinstance(other, Conditioned) and self._key() == other._key()

    def __hash__(self) -> int:
        return hash(self._key())

    def _key(self) -> tuple[Any, ...]:
        return type(self), type(self.inner), self.inner.name, self.law, self.known


@final
class ConditionedRate(Conditioned, RateEffect):
    """A law on an effect on rates."""

    inner: RateEffect

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        return self.inner.modify(rates, self.law.numbers(self.inner, parameters, context), context)


@final
class ConditionedCommand(Conditioned, FeltEffect):
    """A law on an effect on commands that remembers nothing."""

    inner: CommandEffect

    def feel(self, parameters: Named, context: Context) -> Named:  # noqa: D102
        own = self.law.numbers(self.inner, parameters, context)
        return self.inner.transform(context.action, None, own, context.period, context.operations)[0]


def may_have_law(item: AbstractEffect, system: System) -> bool:
    """Whether an effect acts on rates, or on commands without remembering any."""
    if isinstance(item, CommandEffect):
        return item.initial_memory(dict.fromkeys(system.action_names, 0.0)) is None
    return isinstance(item, RateEffect) and not isinstance(item, Conditioned)


def conditioned(item: AbstractEffect, law: Law, system: System) -> ConditionedRate | ConditionedCommand:
    """The effect with a law. Raises ModelFileError where effect, law and system do not fit each other."""
    if not may_have_law(item, system):
        raise ModelFileError(
            f"effect '{item.name}': got '{law.key}', but what remembers commands or changes the sensor cannot depend "
            "on where and when; leave it out"
        )
    if isinstance(item, CommandEffect):
        return ConditionedCommand(item, law, system)
    assert isinstance(item, RateEffect)
    return ConditionedRate(item, law, system)


def plain(item: AbstractEffect) -> AbstractEffect:
    """The effect without its law."""
    return item.inner if isinstance(item, Conditioned) else item


def law_behind(item: AbstractEffect) -> Law | None:
    """The law of an effect, None of a plain one."""
    return item.law if isinstance(item, Conditioned) else None
