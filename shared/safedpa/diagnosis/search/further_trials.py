"""Further trials, for a stage at which no single effect passes.

**Pairs**: the pairs that promise most to first order are fitted.

**Other horizons**: a candidate that unseen blocks favour, but not clearly enough, is fitted and judged again in windows
of 0.5, 0.2 and 2 times the length. Several tests require a higher threshold each (Bonferroni): passing at one of four
horizons with 3.4 standard errors is as rare as passing at one with 3.

**Timing**: before an effect is accepted, commands that change between the rows of the log are its rival.

**One step ahead**, while much is missing. Recordings that differ from each other (each at one throttle) identify
several effects together. A single effect, fitted without one of the recordings, hardly improves the prediction of that
one. A search that stops there stops by chance, for example at 2.96 standard errors where 3 are required. So the trial
that reduces the error most is added provisionally and the search continues. Its result has to pass as a whole.

Source: several comparisons as in Dunn, Journal of the American Statistical Association 56, 1961.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.diagnosis.fit.cross_validation import error_with
from safedpa.diagnosis.fit.data_checks import HorizonData
from safedpa.diagnosis.fit.least_squares import fit, relinearized
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import (
    EffectTrial,
    block_gain,
    fit_trial,
    fit_trials,
    initial_values,
    trial_of,
    with_effect_at,
)
from safedpa.diagnosis.search.acceptance import (
    CLEAR_FALL,
    FALL,
    LIKELY,
    SURE,
    SearchStage,
    fewest_parameters,
    filter_agrees,
    is_spurious_delay,
    with_reason,
    within_bounds,
)
from safedpa.diagnosis.search.backward_revision import refit_effects
from safedpa.diagnosis.search.search_state import JudgedTrial, SearchState, accept_trial, known_effects
from safedpa.effects import AbstractEffect

OtherHorizons = Callable[[], Iterable[HorizonData]]
"""Computes the same recordings at other horizons; called only if one horizon leaves a question open."""
# Pairs that are fitted at one stage; the order to first order is reliable enough for the best to be among five.
_FITTED_PAIRS = 5
# Rare effects that are fitted from the first model.
_FITTED_RARE = 4
# Standard errors required at another horizon: Bonferroni's correction of 3 for four tests.
_SURE = 3.4
# Standard errors at the search's own horizon below which other horizons are not tried: there is no question open.
_OPEN = 1.0
# Candidates that are tried at other horizons: each needs several fits.
_OPEN_CANDIDATES = 3
# Ratio of held-out errors below which an effect explains more than the time of the commands could.
_MOST_BY_TIMING = 0.5
_REASON = "alone too small a gain, but accepted together with the effects found after it"


def fit_pairs(
    null: EffectTrial, trials: Sequence[EffectTrial], available: Sequence[AbstractEffect], shooting: Shooting
) -> list[EffectTrial]:
    """Fits the pairs that promise most to first order; returns those better than both of their effects alone."""
    if len(available) < 2:
        return []
    columns, owners = _displacements(null, available, shooting)
    order = _ranked_pairs(null, columns, owners)
    singles = {trial.effects[0]: trial for trial in trials}
    found = []
    for one, other in order[:_FITTED_PAIRS]:
        trial = fit_trial(null, [available[one], available[other]], shooting)
        # A pair no better than one of its effects alone only adds parameters.
        if trial.loss < min(singles[available[one].name].loss, singles[available[other].name].loss):
            found.append(trial)
    return found


def promising_pairs(search: SearchState) -> list[tuple[AbstractEffect, ...]]:
    """Returns the pairs of effects that promise most to first order about the current model of a search."""
    available = search.available
    columns, owners = _displacements(search.current, available, search.shooting)
    order = _ranked_pairs(search.current, columns, owners)[:_FITTED_PAIRS]
    return [(available[one], available[other]) for one, other in order]


def rare_effects(search: SearchState) -> list[tuple[AbstractEffect, ...]]:
    """Returns the rare effects one by one, those that reduce the residual of the first model most first."""
    trials = fit_trials(search.current, [item for item in search.available if item.rare], search.shooting, {})
    by_name = {item.name: item for item in search.library}
    return [(by_name[trial.effects[0]],) for trial in trials[:_FITTED_RARE]]


def _displacements(
    null: EffectTrial, available: Sequence[AbstractEffect], shooting: Shooting
) -> tuple[FloatArray, list[int]]:
    """Returns the change of the residual by each effect at each of its starts (n, all starts), and effect indices."""
    columns, owners = [], []
    for index, item in enumerate(available):
        models = [with_effect_at(null.fit.model, item, values) for values in initial_values(item)]
        residuals = shooting.residuals([null.fit.model]) if not models else shooting.residuals(models)
        stacked = np.moveaxis(residuals, 0, -1)
        reduced = shooting.eliminated(stacked, null.fit.scale).reshape(-1, len(models))
        columns.append(reduced - null.fit.residual.reshape(-1, 1))
        owners += [index] * len(models)
    # Single precision halves the memory of what is the largest array of a search; only the order of the pairs depends
    # on it.
    return np.concatenate(columns, axis=1).astype(np.float32), owners


def _ranked_pairs(null: EffectTrial, columns: Any, owners: list[int]) -> list[tuple[int, int]]:
    """Returns pairs of effects, ordered by how many squares of the residual their best two columns explain."""
    target: Any = np.asarray(null.fit.residual.reshape(-1), dtype=np.float32)
    if null.fit.columns.shape[-1]:
        # Free parameters are projected out first: what they can explain is no gain of a pair.
        known, _ = np.linalg.qr(null.fit.columns.reshape(len(target), -1).astype(np.float32))
        columns, target = columns - known @ (known.T @ columns), target - known @ (known.T @ target)
    columns = columns / (np.linalg.norm(columns, axis=0) + 1e-6)
    correlation, gram = -(columns.T @ target), columns.T @ columns
    # Two-column least squares in closed form. The floor keeps nearly parallel columns from promising anything.
    share = np.maximum(1.0 - gram**2, 1e-3)
    both = correlation[:, None] ** 2 + correlation[None] ** 2 - 2 * gram * correlation[:, None] * correlation[None]
    both /= share
    owner = np.array(owners)
    gains: dict[tuple[int, int], float] = {}
    for one, other in combinations(range(int(owner.max()) + 1), 2):
        part = both[np.ix_(owner == one, owner == other)]
        gains[one, other] = float(part.max())
    return sorted(gains, key=lambda pair: -gains[pair])


@dataclass(frozen=True)
class PassingCandidate:
    """A candidate that was accepted at another horizon."""

    trial: EffectTrial
    seconds: float
    gain: float
    """Gain at that horizon, in standard errors."""
    fall: float
    """Relative reduction of the held-out error at that horizon."""

    @property
    def reason(self) -> str:
        """Text for the reason of the candidate."""
        return f"over {self.seconds:.3g} s the gain is {self.gain:.1f} standard errors, the error falls {self.fall:.0%}"


def passing_at_other_horizon(
    search: SearchState,
    stage: SearchStage,
    library: Sequence[AbstractEffect],
    other_horizons: OtherHorizons,
) -> PassingCandidate | None:
    """Returns the candidate that another horizon confirms most clearly; None if no horizon confirms one."""
    open_ones = _open_candidates(search, stage)
    if not open_ones:
        return None
    by_name = {item.name: item for item in library}
    best: PassingCandidate | None = None
    for recorded in other_horizons():
        evidence = recorded.with_commands(between_rows=search.between_rows)
        again, shooting = relinearized(search.current.fit, evidence.shooting)
        null, data = trial_of(again, shooting, (), None), replace(evidence, shooting=shooting)
        for trial in open_ones:
            found = _fit_at_horizon(trial, null, data, [by_name[name] for name in trial.effects])
            if found.gain > _SURE and found.fall > FALL and (best is None or found.gain > best.gain):
                best = found
    return best if best is not None and filter_agrees(best.trial, search) else None


def _open_candidates(search: SearchState, stage: SearchStage) -> list[EffectTrial]:
    """Returns candidates with some gain and some reduction of the error, those with the largest reduction first."""
    before = search.error.value
    found = [
        trial
        for trial in stage.trials
        if trial.effects in stage.errors
        and trial.effects not in stage.doubted
        and stage.gains[trial.effects] > _OPEN
        and stage.errors[trial.effects].value < (1.0 - FALL) * before
        and not is_spurious_delay(trial, stage.errors[trial.effects], search.error, stage.row)
        and within_bounds(trial, search)
    ]
    return sorted(found, key=lambda trial: stage.errors[trial.effects].value)[:_OPEN_CANDIDATES]


def _fit_at_horizon(
    trial: EffectTrial, null: EffectTrial, data: HorizonData, items: Sequence[AbstractEffect]
) -> PassingCandidate:
    """Fits a candidate at another horizon and computes its gain and its reduction of the held-out error."""
    model = null.fit.model
    for item in items:
        settings = {p.name: trial.fit.model.settings[f"{item.name}.{p.name}"] for p in item.parameters}
        model = model.with_effect(item, settings)
    extended = fit_trial(null, items, data.shooting, [model])
    before = error_with(null.fit, data.shooting, data.heldout).value
    after = error_with(extended.fit, data.shooting, data.heldout).value
    fall = 1.0 - after / before if before > 0 else 0.0
    return PassingCandidate(trial, data.seconds, block_gain(null, extended, data.shooting), fall)


def timing_explains_more(null: SearchState, search: SearchState) -> bool:
    """Returns whether commands that change at another time explain more than what was added to ``null``, with nothing.

    A log has the command of each row. Whether it changed with the row or before is no effect of the robot, but half a
    period too late looks like too little damping.
    """
    # Half a period explains no such fall.
    if not null.shooting.windows.system.action or search.error.value < _MOST_BY_TIMING * null.error.value:
        return False
    plain, other = search.shooting, search.shooting.with_commands(between_rows=not search.between_rows)
    before, rival = (
        trial_of(fit(null.current.fit.model, null.current.fit.paths, windows, scale, steps=2), windows, (), None)
        for windows, scale in ((plain, null.current.fit.scale), (other, null.current.fit.scale))
    )
    # It takes no parameter, so being as good as an effect that passes is enough.
    return block_gain(before, rival, plain) > LIKELY and block_gain(search.current, rival, plain) > 0.0


def look_one_step_ahead(search: SearchState) -> SearchState | None:
    """Returns the search with the likeliest trial of its last stage added although it did not pass; None without one.

    Also returns None if a region of the floor explains more than the best trial, because the region is reported
    instead. With a single recording nothing can differ between recordings, so a trial that does not pass is simply too
    weak.
    """
    if search.region is not None or len(search.shooting.windows.names) < 2:
        return None
    last = max((item.stage for item in search.candidates), default=0)
    likely = [item for item in search.candidates if item.stage == last and _is_likely(item, search)]
    if not likely:
        return None
    best = max(likely, key=lambda item: item.fall or 0.0)
    trials = [item.trial for item in search.candidates if item.stage == last]
    plain = fewest_parameters(best.trial, trials, search)
    best = next(item for item in search.candidates if item.stage == last and item.trial is plain)
    known = [with_reason(item, "accepted", _REASON) if item is best else item for item in search.candidates]
    ahead = replace(search.copy(), candidates=known)
    singles = [item.trial.effects[0] for item in likely if len(item.trial.effects) == 1]
    for name in best.trial.effects:
        ahead.rivals[name] = [other for other in singles if other not in best.trial.effects]
    accept_trial(ahead, best.trial)
    return ahead


def _is_likely(item: JudgedTrial, search: SearchState) -> bool:
    """Returns whether unseen blocks favour a trial over the current model and it reduces the error."""
    # The trial belongs to an earlier model and lacks the effects added since.
    if item.before != search.error.value:
        return False
    if item.decision == "accepted" or item.error is None or not within_bounds(item.trial, search):
        return False
    row = float(np.median(search.shooting.windows.period))
    spurious = is_spurious_delay(item.trial, item.error, search.error, row)
    return item.gain > LIKELY and (item.fall or 0.0) > FALL and not spurious


def improves_clearly(search: SearchState, ahead: SearchState) -> bool:
    """Returns whether the step's result predicts unseen blocks clearly better and reduces the error by CLEAR_FALL."""
    if not ahead.error.value < (1.0 - CLEAR_FALL) * search.error.value:
        return False
    by_name = known_effects(ahead)
    without = refit_effects(ahead, [by_name[name] for name in search.added])
    return block_gain(without, ahead.current, ahead.shooting) > SURE
