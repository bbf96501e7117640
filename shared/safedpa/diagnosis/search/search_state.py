"""What a search knows: its windows, its present model, what it tried and what it decided."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

from safedpa.diagnosis.fit.cross_validation import HeldoutError
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial
from safedpa.diagnosis.search.regions import RegionFit
from safedpa.effects import AbstractEffect

__all__ = ["JudgedTrial", "SearchState", "given_effect_names", "known_effects"]


@dataclass(frozen=True)
class JudgedTrial:
    """A trial with its verdict."""

    stage: int
    trial: EffectTrial
    gain: float
    """Standard errors on unseen blocks."""
    error: HeldoutError | None
    decision: str
    reason: str
    equals: tuple[str, ...]
    before: float = float("nan")
    """Held-out error of the model that it was tried next to."""

    @property
    def fall(self) -> float | None:
        """Share that it takes off the held-out error; None where that was not worked out."""
        return None if self.error is None or not self.before > 0 else 1.0 - self.error.value / self.before


@dataclass
class SearchState:
    """What was found, and everything that was tried on the way."""

    shooting: Shooting
    current: EffectTrial
    error: HeldoutError
    first: EffectTrial
    first_error: HeldoutError
    candidates: list[JudgedTrial] = field(default_factory=list)
    added: list[str] = field(default_factory=list)
    patch: RegionFit | None = None
    rivals: dict[str, list[str]] = field(default_factory=dict)
    """For each accepted effect the others of its stage, the best first."""
    without: dict[str, tuple[EffectTrial, HeldoutError]] = field(default_factory=dict)
    """For each accepted effect the model of all others, fitted, where there are two or more."""
    refits: dict[tuple[AbstractEffect, ...], EffectTrial] = field(default_factory=dict, init=False)
    """Models with other effects than the present one, fitted from its numbers."""
    refits_of: EffectTrial | None = field(default=None, init=False)
    """The model from whose numbers they were."""

    def take(self, other: SearchState) -> None:
        """Goes on from where another search is."""
        for name in ("shooting", "current", "error", "candidates", "added", "patch", "rivals", "without"):
            setattr(self, name, getattr(other, name))


def given_effect_names(search: SearchState) -> set[str]:
    """Effects that the given model has."""
    return {item.name for item in search.first.fit.model.effects}


def known_effects(search: SearchState, library: Sequence[AbstractEffect]) -> dict[str, AbstractEffect]:
    """Effects by name: those of the present model with their laws, the others plain."""
    return {item.name: item for item in (*library, *search.current.fit.model.effects)}
