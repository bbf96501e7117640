"""Joint trials: combinations of effects that are fitted together from the first model, whatever each does alone.

A missing effect may destroy the fit of the base: without its friction, the inertia of a joint ends at its bound, and
next to that base friction looks negligible. So the base parameters are fitted together with the effects, and from
several starts: the given values, the refitted ones and the usual ones. The first fit uses the first part of each
window. It is nearly a regression of measured rates, which is almost linear in most parameters. Only then follow whole
windows, twice, because starts and weights depend on the model.

Combinations of effects that textbooks treat together follow from what the effects declare: their partners, or the
stage at which they apply.

Source: Ljung, System Identification, 2nd ed., 1999, section 10.5 (local minima and initial parameter values).
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import combinations

import numpy as np

from safedpa.diagnosis.fit.cross_validation import HeldoutError, error_with
from safedpa.diagnosis.fit.least_squares import fit, relinearized, with_values
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, best_start, initial_values, trial_of, with_effect_at
from safedpa.diagnosis.search.search_state import SearchState
from safedpa.dynamics import PhysicsModel
from safedpa.effects import AbstractEffect
from safedpa.effects.effect import Stage

# Stages whose effects are commonly present together, for effects that declare no partners.
_TEXTBOOK = (
    {Stage.RESISTANCE, Stage.WEIGHT},  # viscous or quadratic and Coulomb friction, gravity and friction
    {Stage.COMMAND_SCALE, Stage.COMMAND_LAG},
    {Stage.COMMAND_DELAY, Stage.COMMAND_LAG},
    {Stage.COMMAND_SCALE, Stage.COMMAND_STOPS},
)
# Starts of each effect: their product, for three starts of the base, is simulated once.
_STARTS = 4
# Rounds of fitting and updating starts and weights: the second moves parameters little.
_ROUNDS = 2


@dataclass(frozen=True)
class JointTrial:
    """Effects fitted together from the first model, in windows about the result."""

    trial: EffectTrial
    shooting: Shooting
    error: HeldoutError


def textbook_combinations(items: Sequence[AbstractEffect]) -> list[tuple[AbstractEffect, ...]]:
    """Returns the pairs that textbooks treat together: those that the effects declare, or by their stages."""
    return [pair for pair in combinations(items, 2) if _are_partners(*pair)]


def _are_partners(one: AbstractEffect, other: AbstractEffect) -> bool:
    if one.partners or other.partners:
        return one.name in other.partners or other.name in one.partners
    return {one.stage, other.stage} in _TEXTBOOK


def fit_jointly(search: SearchState, items: Sequence[AbstractEffect]) -> JointTrial:
    """Fits effects and the free parameters of the base together; see the module's text."""
    raw = search.measured
    starts = list(_starts(search, items))
    paths = [*search.first.fit.paths, *(f"{item.name}.{p.name}" for item in items for p in item.parameters)]
    short = raw.first_part()
    scale = np.maximum(short.residuals([starts[0]])[0].std(axis=(0, 1)), 1e-6)
    near = fit(best_start(starts, short, scale), paths, short, scale)
    found, shooting = fit(near.model, paths, raw, search.first.fit.scale), raw
    for _ in range(_ROUNDS):
        found, shooting = relinearized(found, shooting)
    trial = trial_of(found, shooting, tuple(item.name for item in items), None)
    return JointTrial(trial, shooting, error_with(found, shooting, search.heldout))


def _starts(search: SearchState, items: Sequence[AbstractEffect]) -> Iterator[PhysicsModel]:
    for base in _bases(search):
        models = [base]
        for item in items:
            values = initial_values(item)
            some = values[:: max(1, len(values) // _STARTS)]
            models = [with_effect_at(model, item, start) for model in models for start in some]
        yield from models


def _bases(search: SearchState) -> list[PhysicsModel]:
    """Returns the first model with its given, its refitted and its usual free parameters."""
    refitted, given = search.first.fit.model, search.given or search.first.fit.model
    free = list(search.first.fit.paths)
    if not free:
        return [refitted]
    usual = with_values(refitted, {path: refitted.parameters[path].typical for path in free})
    return [given, refitted, usual]
