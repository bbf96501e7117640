"""What remains: whether it depends on anything that was measured, and a formula for it that is no named effect.

A place comes first, then the short formula that sparse regression finds, then the bare dependence on a variable. Each
has to predict unseen blocks.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.where import PLACE
from safedpa.diagnosis.fit.least_squares import fit
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, block_gain, trial_of, with_effect_at
from safedpa.diagnosis.report_schema import Dependence, FormulaTerm, Profile, Unexplained
from safedpa.diagnosis.residuals.dependence import Dependences, dependences_of, profile_of
from safedpa.diagnosis.residuals.rates import map_of, rate_states, rate_unit_of, remaining_rates
from safedpa.diagnosis.residuals.weak_sindy import SelectedTerms, is_significant, selected_terms
from safedpa.diagnosis.search.regions import RegionFit, best_region
from safedpa.operations import NUMPY

if TYPE_CHECKING:
    from safedpa.diagnosis.residuals.match_effects import LibraryMatcher
    from safedpa.diagnosis.search.forward_selection import SearchState
from typing import final

from safedpa.diagnosis.residuals.weak_sindy import TIME, Term
from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter

__all__ = ["Formula", "alternative_formula", "find_unexplained_structure", "peak_of"]


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


_SHARE = 0.03
"""Of the squares of the residual, noise included."""
_LASTING = 4.0
"""Standard deviations from 0 of a coefficient that stays."""
_PLACE_SHARE = 0.02
_FEWEST = 40
"""Windows."""
_HEADLINE = 2.0
"""Of its own deviations that a number needs to be told by itself."""
_FEWEST_ROWS = 20
"""About a knot whose value is told by itself."""
_AHEAD = 3.0
"""Standard errors by which a formula has to be better than the effects that were found, to take their place."""
_LITTLE = 0.03
"""Fall of the logarithm of the held-out residual, mean over the states, that is worth it."""
_LITTLE_WITH_FEWER = 0.01
"""The same where the formula has fewer numbers."""


def find_unexplained_structure(
    trial: EffectTrial, shooting: Shooting, patch: RegionFit | None, names: LibraryMatcher | None = None
) -> Unexplained | None:
    """The structure of what remains, or None where unseen blocks confirm none.

    Neither is there where ``names`` have an effect that says the same.
    """
    place = patch or best_region(trial, shooting)
    if place is not None and place.share > _PLACE_SHARE and _certain(place, shooting):
        named = names is not None and names.of_formula(place.trial)
        return None if named else _of_place(place, trial, shooting)
    if len(shooting.windows) < _FEWEST:
        return None
    dependences = dependences_of(trial, shooting)
    fitted = _formula(trial, shooting)
    if fitted is not None and not _better_as_function(dependences, fitted[1]):
        named = names is not None and names.of_formula(fitted[1])
        return None if named else _of_formula(*fitted, trial, dependences, shooting)
    return _of_dependence(trial, dependences, shooting, names)


def alternative_formula(search: SearchState, names: LibraryMatcher | None = None) -> Unexplained | None:
    """A formula of at most as many numbers that explains more than all effects that were found; None otherwise.

    Effects that only resemble what acts (a drag that grows with the cube of the speed looks like quadratic drag) are
    then taken back: they become suspected, and the search stands where it began.
    """
    shooting, found = search.shooting, search.current
    if not search.added or len(shooting.windows) < _FEWEST:
        return None
    first = search.first.fit
    null = trial_of(fit(first.model, first.paths, shooting, found.fit.scale, steps=2), shooting, (), None)
    most = len(found.fit.paths) - len(first.paths)
    formula = _formula(null, shooting, min(most, 4))
    if formula is None:
        return None
    selected, trial = formula
    little = _LITTLE if len(selected.terms) == most else _LITTLE_WITH_FEWER
    if trial.loss > found.loss - little or block_gain(found, trial, shooting) < _AHEAD:
        return None
    if names is not None and names.of_formula(trial):
        return None
    taken_back = ", ".join(search.added)
    for index, item in enumerate(search.candidates):
        if item.decision == "accepted":
            reason = f"{item.reason}; but a formula of no more numbers explains more than {taken_back}"
            search.candidates[index] = replace(item, decision="suspected", reason=reason)
    search.added, search.current, search.error = [], search.first, search.first_error
    return _of_formula(selected, trial, null, dependences_of(null, shooting), shooting)


def _of_place(place: RegionFit, trial: EffectTrial, shooting: Shooting) -> Unexplained:
    rates = remaining_rates(trial, shooting)
    name = place.place
    terms = (FormulaTerm("speed", f"-sign(speed) where {name.where(place.values)}", *_size(place, shooting), "m/s2"),)
    return Unexplained(
        depends_on=PLACE,
        expression=place.expression,
        share=place.share,
        kind="place",
        terms=terms,
        dependence=dependences_of(trial, shooting).found,
        map=map_of(*PLACE, "speed", rates, shooting),
    )


def _size(place: RegionFit, shooting: Shooting) -> tuple[float, float | None]:
    path = f"{place.place.name}.deceleration"
    index = place.trial.fit.paths.index(path)
    std = float(place.trial.fit.deviations(shooting)[index])
    return place.values["deceleration"], std if np.isfinite(std) else None


def _formula(trial: EffectTrial, shooting: Shooting, most: int = 4) -> tuple[SelectedTerms, EffectTrial] | None:
    """The terms that hold in the nonlinear rollouts too, and the model with them; None where none does."""
    selected = selected_terms(trial, shooting, rate_states(shooting.windows.system), most)
    while selected is not None:
        fitted = _fitted(selected, trial, shooting)
        count = len(selected.terms)
        values, deviations = fitted.fit.values[-count:], fitted.fit.deviations(shooting)[-count:]
        sure = np.abs(values) > _LASTING * np.nan_to_num(deviations, nan=np.inf)
        if sure.all():
            return (selected, fitted) if fitted.loss < trial.loss else None
        if not sure.any():
            return None
        retained = tuple(item for item, keep in zip(selected.terms, sure, strict=True) if keep)
        selected = SelectedTerms(retained, values[sure], selected.alternatives if sure[0] else ())
    return None


def _fitted(selected: SelectedTerms, trial: EffectTrial, shooting: Shooting) -> EffectTrial:
    """The formula's coefficients refined in the nonlinear rollouts, next to everything that is fitted."""
    item = Formula(selected.terms, selected.coefficients.tolist(), shooting.windows.system.name, "")
    start = {p.name: float(value) for p, value in zip(item.parameters, selected.coefficients, strict=True)}
    paths = [*trial.fit.paths, *(f"{item.name}.{name}" for name in start)]
    found = fit(with_effect_at(trial.fit.model, item, start), paths, shooting, trial.fit.scale)
    return trial_of(found, shooting, (item.name,), trial)


def _better_as_function(dependences: Dependences, formula: EffectTrial) -> bool:
    """Whether any function of the best variable takes clearly more off unseen blocks than the formula."""
    best = dependences.found[0]
    left = dependences.unseen[best.variable, best.state]
    own = (formula.heldout / dependences.scale**2).sum(axis=1)
    fewer = float(left.sum()) < (1.0 - _SHARE) * float(own.sum())
    return fewer and dependences.problem.sure(own, left) > _AHEAD


def _of_formula(
    selected: SelectedTerms, fitted: EffectTrial, trial: EffectTrial, dependences: Dependences, shooting: Shooting
) -> Unexplained:
    system = shooting.windows.system
    count = len(selected.terms)
    values, deviations = fitted.fit.values[-count:], fitted.fit.deviations(shooting)[-count:]
    terms = []
    for (state, term), value, std in zip(selected.terms, values, deviations, strict=True):
        unit = _unit(rate_unit_of(system, state), term.units)
        terms.append(FormulaTerm(state, term.text, float(value), float(std), unit))
    variables = tuple(dict.fromkeys(name for _, term in selected.terms for name in term.variables))
    state = selected.terms[0][0]
    first, second = _axes(variables, state, dependences.found)
    return Unexplained(
        depends_on=variables,
        expression=_text(terms),
        share=_share(trial, fitted),
        kind="formula",
        terms=tuple(terms),
        alternatives=selected.alternatives,
        dependence=dependences.found,
        profile=profile_of(
            dependences, first, state, _at(dependences.knots[first], first, state, selected, values), shooting
        ),
        map=map_of(first, second, state, remaining_rates(trial, shooting), shooting),
    )


def _at(
    knots: FloatArray, variable: str, state: str, selected: SelectedTerms, values: FloatArray
) -> list[float] | None:
    """The formula for one rate at the knots of a variable; None where it depends on others as well."""
    own = [(term, value) for (name, term), value in zip(selected.terms, values, strict=True) if name == state]
    if any(set(term.variables) - {variable} for term, _ in own):
        return None
    sums = sum(value * term.value({variable: knots}, NUMPY) for term, value in own)
    return [float(value) for value in np.broadcast_to(sums, knots.shape)]


def _certain(place: RegionFit, shooting: Shooting) -> bool:
    """Whether the resistance of a place is more than two of its own deviations."""
    size, std = _size(place, shooting)
    return std is not None and abs(size) > _HEADLINE * std


def _of_dependence(
    trial: EffectTrial, dependences: Dependences, shooting: Shooting, names: LibraryMatcher | None
) -> Unexplained | None:
    """A variable of which some function predicts unseen blocks, though no short formula does."""
    sure = [
        item for item in dependences.found if item.share > _SHARE and is_significant(item.standard_errors, item.share)
    ]
    if not sure:
        return None
    best = sure[0]
    close = tuple(dict.fromkeys(item.variable for item in sure if item.share > 0.7 * best.share))
    first, second = _axes(close, best.state, dependences.found)
    profile = profile_of(dependences, first, best.state, None, shooting)
    peak = peak_of(profile)
    if peak is None:
        return None
    if names is not None and names.of_function(dependences.unseen[best.variable, best.state], dependences.scale):
        return None
    unit = "" if profile.unit == "1" else f" {profile.unit}"
    return Unexplained(
        depends_on=close,
        expression=f"d({best.state})/dt += a function of {first} that no short formula gives; it is largest, "
        f"{profile.values[peak]:.2g} +- {profile.errors[peak]:.1g} {profile.rate_unit}, at {first} "
        f"{profile.knots[peak]:.2g}{unit}",
        share=best.share,
        kind="dependence",
        dependence=dependences.found,
        profile=profile,
        map=map_of(first, second, best.state, remaining_rates(trial, shooting), shooting),
    )


def peak_of(profile: Profile) -> int | None:
    """The knot with the largest value that is more than two of its own deviations, and about which there are rows."""
    values, errors = np.array(profile.values), np.array(profile.errors)
    sure = (np.abs(values) > _HEADLINE * errors) & (np.array(profile.rows) >= _FEWEST_ROWS)
    return int(np.argmax(np.where(sure, np.abs(values), -1.0))) if sure.any() else None


def _axes(variables: Sequence[str], state: str, dependence: Sequence[Dependence]) -> tuple[str, str]:
    """Two different variables for a profile and a map: the formula's first, then those that tell most."""
    order = [item.variable for item in dependence if item.state == state]
    ranked = sorted((name for name in variables if name in order), key=order.index)
    first, second, *_ = dict.fromkeys([*ranked, *order])
    return first, second


def _share(before: EffectTrial, after: EffectTrial) -> float:
    ratio: FloatArray = after.heldout.sum(axis=0) / before.heldout.sum(axis=0)
    return float(1.0 - ratio.mean())


def _text(terms: Sequence[FormulaTerm]) -> str:
    parts = []
    for state in dict.fromkeys(item.state for item in terms):
        own = [item for item in terms if item.state == state]
        right = " ".join(
            f"{'-' if item.coefficient < 0 else '+'} {abs(item.coefficient):.3g}"
            + ("" if item.term == "1" else f" {item.term}")
            for item in own
        )
        sign, right = ("-", right[2:]) if len(own) == 1 and right.startswith("- ") else ("+", right.removeprefix("+ "))
        parts.append(f"d({state})/dt {sign}= {right}")
    return "; ".join(parts)


def _unit(rate: str, over: Sequence[str]) -> str:
    """The unit of a coefficient: that of the rate over those of the term."""
    if not over:
        return rate
    powers = {unit: over.count(unit) for unit in dict.fromkeys(over)}
    return f"{rate} / " + " / ".join(f"({unit})" + (f"^{n}" if n > 1 else "") for unit, n in powers.items())
