"""Unmodelled structure: whether the residual depends on a measured variable, and a formula for it.

A region of the floor is tried first, then a short formula by sparse regression, then a dependence on one variable. Each
has to predict unseen blocks. A named effect is preferred to an anonymous formula: if unseen blocks cannot clearly
distinguish a candidate, also a refused one, from the formula, the candidate is reported ("likely, not proven").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.comparison.where import POSITION
from safedpa.diagnosis.fit.least_squares import fit
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import (
    EffectTrial,
    block_gain,
    explained_by,
    explanation_correlation,
    fit_trial,
    trial_of,
    with_effect_at,
)
from safedpa.diagnosis.report_schema import Dependence, FormulaTerm, Profile, Unexplained
from safedpa.diagnosis.residuals.dependence import (
    Dependences,
    dependences_of,
    map_of,
    profile_of,
    rate_states,
    rate_unit_of,
    remaining_rates,
)
from safedpa.diagnosis.residuals.weak_sindy import TIME, SelectedTerms, Term, is_significant, selected_terms
from safedpa.diagnosis.search.acceptance import ALIKE, SAME_SHAPE, SIMPLER, SURE
from safedpa.diagnosis.search.regions import RegionFit, best_region
from safedpa.diagnosis.search.search_state import JudgedTrial, SearchState
from safedpa.effects.effect import Context, Named, RateEffect, Stage
from safedpa.effects.parameter import Parameter
from safedpa.operations import NUMPY


@final
class Formula(RateEffect):
    """d(state)/dt += coefficient term, for several terms; coefficients are ``c0``, ``c1`` and so on."""

    name = "formula"
    robot = "any"
    stage = Stage.MOTION
    equation = "d(state)/dt += sum of coefficient term"
    signature = "whatever fits"
    source = "sparse regression; see weak_sindy"

    def __init__(self, terms: Sequence[tuple[str, Term]], sizes: Sequence[float], robot: str, units: str) -> None:
        self.terms = tuple(terms)
        self.robot = robot  # type: ignore[misc]
        # The fitted size is the typical one, which scales difference steps and the prior of the refit.
        self.parameters = tuple(  # type: ignore[misc]
            Parameter(f"c{index}", units, -1e6, 1e6, max(abs(size), 1e-9)) for index, size in enumerate(sizes)
        )

    def modify(self, rates: Named, parameters: Named, context: Context) -> Named:  # noqa: D102
        named = {**context.state, **context.action, TIME: context.time}
        changed = dict(rates)
        for index, (state, term) in enumerate(self.terms):
            changed[state] = changed[state] + parameters[f"c{index}"] * term.value(named, context.operations)
        return changed


# Share of the squares of the residual (noise included) that a dependence has to explain: in long recordings smaller
# ones are significant too, but they do not matter for predictions.
_MIN_SHARE = 0.03
# Standard deviations from 0 for a coefficient to stay: hundreds of terms were compared, so 2 would not mean much.
_MIN_COEFFICIENT = 4.0
# The same share for a region: lower, because a region contains few windows.
_MIN_REGION_SHARE = 0.02
# Windows below which no formula is looked for: with hundreds of terms some would fit by chance.
_MIN_WINDOWS = 40
# Deviations that a value needs to be quoted in the sentence of a finding: a reader takes a quoted value as a fact.
_QUOTED = 2.0
# Rows about a knot whose value is quoted: fewer make its deviation unreliable.
_MIN_ROWS = 20
# Standard errors by which a formula has to be better than the effects found, to replace them: as many as an effect
# needs to be accepted.
_LEAD = 3.0
# Decrease of the log held-out residual (mean over the states) that a formula needs as well: effects have a physical
# meaning, so they are preferred unless a formula is clearly better.
_MIN_DECREASE = 0.03
# The same for a formula with fewer parameters, which is less likely to fit by chance.
_MIN_DECREASE_IF_SIMPLER = 0.01


def find_unexplained_structure(
    trial: EffectTrial, shooting: Shooting, region_fit: RegionFit | None, names: LibraryMatcher | None = None
) -> Unexplained | None:
    """Returns the structure of the residual; None if unseen blocks confirm none.

    Also returns None if ``names`` finds an effect that explains the same.
    """
    # From the most to the least specific: a region looks like a formula in x and y, a formula like a dependence.
    region_fit = region_fit or best_region(trial, shooting)
    if region_fit is not None and region_fit.share > _MIN_REGION_SHARE and _is_certain(region_fit, shooting):
        named = names is not None and names.of_formula(region_fit.trial)
        return None if named else _region_result(region_fit, trial, shooting)
    if len(shooting.windows) < _MIN_WINDOWS:
        return None
    dependences = dependences_of(trial, shooting)
    fitted = _find_formula(trial, shooting)
    if fitted is not None and not _better_as_function(dependences, fitted[1]):
        named = names is not None and names.of_formula(fitted[1])
        return None if named else _formula_result(*fitted, trial, dependences, shooting)
    return _dependence_result(trial, dependences, shooting, names)


def alternative_formula(search: SearchState, names: LibraryMatcher | None = None) -> Unexplained | None:
    """Returns a formula with no more parameters that explains more than all effects found; None if there is none.

    Some effects only resemble the cause: a drag that grows with the cube of the speed looks like quadratic drag. Such
    effects are then withdrawn: they become suspected, and the search is reset to its first model.
    """
    shooting, found = search.shooting, search.current
    if not search.added or len(shooting.windows) < _MIN_WINDOWS:
        return None
    first = search.first.fit
    # The first model in the windows of the final one, so that formula and effects are compared on the same data.
    null = trial_of(fit(first.model, first.paths, shooting, found.fit.scale, steps=2), shooting, (), None)
    most = len(found.fit.paths) - len(first.paths)
    formula = _find_formula(null, shooting, min(most, 4))
    if formula is None:
        return None
    selected, trial = formula
    min_decrease = _MIN_DECREASE if len(selected.terms) == most else _MIN_DECREASE_IF_SIMPLER
    if trial.loss > found.loss - min_decrease or block_gain(found, trial, shooting) < _LEAD:
        return None
    if all(term.text == f"sign({state})" for state, term in selected.terms) and _same_shape(found, trial, null):
        return None
    if names is not None and names.of_formula(trial):
        return None
    withdrawn = ", ".join(search.added)
    for index, item in enumerate(search.candidates):
        if item.decision == "accepted":
            reason = f"{item.reason}; but a formula with no more parameters explains more than {withdrawn}"
            search.candidates[index] = replace(item, decision="suspected", reason=reason)
    search.added, search.current, search.error = [], search.first, search.first_error
    return _formula_result(selected, trial, null, dependences_of(null, shooting), shooting)


def _same_shape(found: EffectTrial, formula: EffectTrial, null: EffectTrial) -> bool:
    """Returns whether a formula explains what the effects found explain; sign(speed) is dry friction."""
    again = explained_by(found.fit, null)
    size = float(np.sqrt((again**2).sum() * (formula.explained**2).sum()))
    return size > 0.0 and float((again * formula.explained).sum()) > SAME_SHAPE * size


def _region_result(region_fit: RegionFit, trial: EffectTrial, shooting: Shooting) -> Unexplained:
    rates = remaining_rates(trial, shooting)
    region = region_fit.region
    size, std = _deceleration(region_fit, shooting)
    terms = (FormulaTerm("speed", f"-sign(speed) where {region.where(region_fit.values)}", size, std, "m/s2"),)
    return Unexplained(
        depends_on=POSITION,
        expression=region_fit.expression,
        share=region_fit.share,
        kind="place",
        terms=terms,
        dependence=dependences_of(trial, shooting).found,
        map=map_of(*POSITION, "speed", rates, shooting),
    )


def _deceleration(region_fit: RegionFit, shooting: Shooting) -> tuple[float, float | None]:
    path = f"{region_fit.region.name}.deceleration"
    index = region_fit.trial.fit.paths.index(path)
    std = float(region_fit.trial.fit.deviations(shooting)[index])
    return region_fit.values["deceleration"], std if np.isfinite(std) else None


def _find_formula(trial: EffectTrial, shooting: Shooting, most: int = 4) -> tuple[SelectedTerms, EffectTrial] | None:
    """Returns the terms that are confirmed in nonlinear rollouts, and the model with them; None if none is."""
    selected = selected_terms(trial, shooting, rate_states(shooting.windows.system), most)
    # Regression is to first order: coefficients that vanish in the nonlinear refit are dropped, and the rest is
    # refitted.
    while selected is not None:
        fitted = _fit_formula(selected, trial, shooting)
        count = len(selected.terms)
        values, deviations = fitted.fit.values[-count:], fitted.fit.deviations(shooting)[-count:]
        sure = np.abs(values) > _MIN_COEFFICIENT * np.nan_to_num(deviations, nan=np.inf)
        if sure.all():
            return (selected, fitted) if fitted.loss < trial.loss else None
        if not sure.any():
            return None
        retained = tuple(item for item, keep in zip(selected.terms, sure, strict=True) if keep)
        selected = SelectedTerms(retained, values[sure], selected.alternatives if sure[0] else ())
    return None


def _fit_formula(selected: SelectedTerms, trial: EffectTrial, shooting: Shooting) -> EffectTrial:
    """Refines the formula's coefficients in nonlinear rollouts, together with all fitted parameters."""
    item = Formula(selected.terms, selected.coefficients.tolist(), shooting.windows.system.name, "")
    start = {p.name: float(value) for p, value in zip(item.parameters, selected.coefficients, strict=True)}
    paths = [*trial.fit.paths, *(f"{item.name}.{name}" for name in start)]
    found = fit(with_effect_at(trial.fit.model, item, start), paths, shooting, trial.fit.scale)
    return trial_of(found, shooting, (item.name,), trial)


def _better_as_function(dependences: Dependences, formula: EffectTrial) -> bool:
    """Returns whether a function of the best variable reduces unseen squares clearly more than the formula."""
    best = dependences.found[0]
    remaining = dependences.unseen[best.variable, best.state]
    squares = (formula.heldout / dependences.scale**2).sum(axis=1)
    fewer = float(remaining.sum()) < (1.0 - _MIN_SHARE) * float(squares.sum())
    return fewer and dependences.problem.block_gain(squares, remaining) > _LEAD


def _formula_result(
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
            dependences, first, state, _formula_at(dependences.knots[first], first, state, selected, values), shooting
        ),
        map=map_of(first, second, state, remaining_rates(trial, shooting), shooting),
    )


def _formula_at(
    knots: FloatArray, variable: str, state: str, selected: SelectedTerms, values: FloatArray
) -> list[float] | None:
    """Returns the formula for one rate at the knots of a variable; None if it depends on other variables too."""
    state_terms = [(term, value) for (name, term), value in zip(selected.terms, values, strict=True) if name == state]
    if any(set(term.variables) - {variable} for term, _ in state_terms):
        return None
    sums = sum(value * term.value({variable: knots}, NUMPY) for term, value in state_terms)
    return [float(value) for value in np.broadcast_to(sums, knots.shape)]


def _is_certain(region_fit: RegionFit, shooting: Shooting) -> bool:
    """Returns whether the resistance of a region is more than two of its deviations."""
    size, std = _deceleration(region_fit, shooting)
    return std is not None and abs(size) > _QUOTED * std


def _dependence_result(
    trial: EffectTrial, dependences: Dependences, shooting: Shooting, names: LibraryMatcher | None
) -> Unexplained | None:
    """Returns a variable of which some function predicts unseen blocks, although no short formula does."""
    significant = [
        item
        for item in dependences.found
        if item.share > _MIN_SHARE and is_significant(item.standard_errors, item.share)
    ]
    if not significant:
        return None
    best = significant[0]
    close = tuple(dict.fromkeys(item.variable for item in significant if item.share > 0.7 * best.share))
    first, second = _axes(close, best.state, dependences.found)
    profile = profile_of(dependences, first, best.state, None, shooting)
    peak = peak_of(profile)
    if peak is None:
        return None
    if names is not None and names.of_function(dependences.unseen[best.variable, best.state], dependences.scale):
        return None
    # The sentence quotes the largest value, because a function without a formula has no other summary.
    unit = "" if profile.unit == "1" else f" {profile.unit}"
    return Unexplained(
        depends_on=close,
        expression=f"d({best.state})/dt += a function of {first} without a short formula; its largest value is "
        f"{profile.values[peak]:.2g} +- {profile.errors[peak]:.1g} {profile.rate_unit} at {first} "
        f"{profile.knots[peak]:.2g}{unit}",
        share=best.share,
        kind="dependence",
        dependence=dependences.found,
        profile=profile,
        map=map_of(first, second, best.state, remaining_rates(trial, shooting), shooting),
    )


def peak_of(profile: Profile) -> int | None:
    """Returns the knot with the largest value that exceeds two deviations and has enough rows; None if none does."""
    values, errors = np.array(profile.values), np.array(profile.errors)
    sure = (np.abs(values) > _QUOTED * errors) & (np.array(profile.rows) >= _MIN_ROWS)
    return int(np.argmax(np.where(sure, np.abs(values), -1.0))) if sure.any() else None


def _axes(variables: Sequence[str], state: str, dependence: Sequence[Dependence]) -> tuple[str, str]:
    """Returns two variables for a profile and a map: those of the formula first, then those with the largest share."""
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
        state_terms = [item for item in terms if item.state == state]
        right = " ".join(
            f"{'-' if item.coefficient < 0 else '+'} {abs(item.coefficient):.3g}"
            + ("" if item.term == "1" else f" {item.term}")
            for item in state_terms
        )
        sign, right = (
            ("-", right[2:]) if len(state_terms) == 1 and right.startswith("- ") else ("+", right.removeprefix("+ "))
        )
        parts.append(f"d({state})/dt {sign}= {right}")
    return "; ".join(parts)


def _unit(rate: str, over: Sequence[str]) -> str:
    """Returns the unit of a coefficient: that of the rate divided by those of the term."""
    if not over:
        return rate
    powers = {unit: over.count(unit) for unit in dict.fromkeys(over)}
    return f"{rate} / " + " / ".join(f"({unit})" + (f"^{n}" if n > 1 else "") for unit, n in powers.items())


# Candidates that are compared, those with the lowest loss first; each needs a fit.
_COMPARED = 6
# Standard errors of gain that a candidate needs to replace a formula: otherwise it explains nothing itself.
_FAVOURED = 1.5


@dataclass
class LibraryMatcher:
    """Finds effects that explain the same as a formula or a function of one variable; ``found`` collects them."""

    search: SearchState
    found: list[JudgedTrial] = field(default_factory=list)
    _trials: list[EffectTrial] | None = None

    def of_formula(self, formula: EffectTrial) -> bool:
        """Returns whether a candidate explains the same as a formula or a region that was fitted like an effect."""
        shooting = self.search.shooting
        same = [
            trial
            for trial in self._favoured_trials()
            # Thresholds as for equivalent trials: a formula must be clearly better to be preferred to an effect.
            if block_gain(trial, formula, shooting) < SIMPLER
            or (explanation_correlation(trial, formula) > ALIKE and block_gain(trial, formula, shooting) < SURE)
        ]
        return self._record(same, "no formula and no region explains more")

    def of_function(self, remaining: FloatArray, scale: FloatArray) -> bool:
        """Returns whether a candidate reduces the squares of unseen blocks as much as a function of one variable.

        ``remaining`` (windows,): squares of unseen windows with the function, in units of ``scale`` (states,).
        """
        same = []
        for trial in self._favoured_trials():
            squares = (trial.heldout / scale**2).sum(axis=1)
            if _block_statistic(squares - remaining, self.search.shooting.block) < SIMPLER:
                same.append(trial)
        return self._record(same, "no function of one variable explains more")

    def _favoured_trials(self) -> list[EffectTrial]:
        """Returns candidates of the last stage, fitted on top of the current model, that unseen blocks favour."""
        if self._trials is None:  # computed once: of_formula and of_function share them
            null, shooting = self.search.current, self.search.shooting
            fitted = [self._fitted(item) for item in self._singles()]
            self._trials = [trial for trial in fitted if block_gain(null, trial, shooting) > _FAVOURED]
        return self._trials

    def _singles(self) -> list[JudgedTrial]:
        last = max((item.stage for item in self.search.candidates), default=0)
        have = {item.name for item in self.search.current.fit.model.effects}
        singles = [
            item
            for item in self.search.candidates
            if item.stage == last and len(item.trial.effects) == 1 and item.trial.effects[0] not in have
        ]
        return sorted(singles, key=lambda item: item.trial.loss)[:_COMPARED]

    def _fitted(self, item: JudgedTrial) -> EffectTrial:
        effect = next(candidate for candidate in self.search.library if candidate.name == item.trial.effects[0])
        settings = item.trial.fit.model.settings
        known = {p.name: settings[f"{effect.name}.{p.name}"].value for p in effect.parameters}
        # Refitted on top of the current model: the candidate's trial may lack effects accepted since.
        start = with_effect_at(self.search.current.fit.model, effect, known)
        return fit_trial(self.search.current, [effect], self.search.shooting, [start])

    def _record(self, same: Sequence[EffectTrial], why: str) -> bool:
        """Adds the matching trials to ``found``; returns whether there is one."""
        for trial in sorted(same, key=lambda trial: trial.loss):
            if trial.effects not in {item.trial.effects for item in self.found}:
                gain = block_gain(self.search.current, trial, self.search.shooting)
                error = self.search.error_of(trial.fit)
                reason = f"gain on unseen blocks {gain:.1f} standard errors; likely, not proven: {why}"
                last = max((item.stage for item in self.search.candidates), default=0)
                self.found.append(
                    JudgedTrial(last, trial, gain, error, "suspected", reason, (), self.search.error.value)
                )
        return bool(same)


def _block_statistic(difference: FloatArray, block: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> float:
    """Returns the mean over the blocks of a difference (windows,), in its standard errors."""
    sums = np.bincount(block, difference)[np.unique(block)]
    return float(sums.sum() / max(float(sums.std(ddof=1)) * np.sqrt(len(sums)), 1e-300)) if len(sums) > 1 else 0.0
