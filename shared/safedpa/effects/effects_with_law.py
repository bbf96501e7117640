"""Effects with a law: the same equation, with parameters that depend on state, action and time.

A law wraps an effect of the library and keeps its name. An effect on rates is wrapped as it is. An effect on commands
without memory (gain, offset, dead zone, limit) acts on the felt command, after every delay and lag, where state and
time are known. Effects with memory and sensor effects cannot have a law: their memory, or the inverse of the
measurement, would not be defined.
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


class Conditioned(AbstractEffect):
    """Base of both kinds; two are equal if their effects, laws and systems are."""

    inner: AbstractEffect
    law: Law

    def __init__(self, inner: AbstractEffect, law: Law, system: System) -> None:
        law.check(inner, system)
        # class attributes of an effect, here of the instance: what reads effects need not know of laws
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
    """A law on an effect on commands without memory."""

    inner: CommandEffect

    def feel(self, parameters: Named, context: Context) -> Named:  # noqa: D102
        own = self.law.numbers(self.inner, parameters, context)
        # None: may_have_law() admits no command effect with memory
        return self.inner.transform(context.action, None, own, context.period, context.operations)[0]


def may_have_law(item: AbstractEffect, system: System) -> bool:
    """Returns whether an effect acts on rates, or on commands without memory."""
    if isinstance(item, CommandEffect):
        return item.initial_memory(dict.fromkeys(system.action_names, 0.0)) is None
    return isinstance(item, RateEffect) and not isinstance(item, Conditioned)


def conditioned(item: AbstractEffect, law: Law, system: System) -> ConditionedRate | ConditionedCommand:
    """Returns the effect with a law. Raises ModelFileError if effect, law and system do not fit."""
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
    """Returns the effect without its law."""
    return item.inner if isinstance(item, Conditioned) else item


def law_behind(item: AbstractEffect) -> Law | None:
    """Returns the law of an effect, or None."""
    return item.law if isinstance(item, Conditioned) else None
