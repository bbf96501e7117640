"""What is tried where no single effect passes: two at once, the same question at other horizons, one step further.

**Pairs**: those that promise most to first order are fitted.

**Other horizons**: a candidate that unseen blocks favour, but not surely enough, is fitted and judged again in windows
of half the length, of a fifth, and of twice as much. To be asked several times asks for more each time (Bonferroni):
passing at one of four horizons with 3.4 standard errors is as rare as passing at one with 3.

**One step further** than unseen blocks allow, where much is missing still. Logs that are unlike each other (each at a
throttle of its own) tell several effects together, while each by itself, fitted without one of the logs, predicts that
one hardly better. A search that stops there stops by chance: 2.96 standard errors, where 3 are asked for. So the trial
that takes most off the error is added for once, the search goes on from there, and what it arrives at has to pass as a
whole.

Source: Dunn, Journal of the American Statistical Association 56, 1961 (several comparisons); Miller, Subset Selection
in Regression, 2nd ed., 2002, ch. 3 (sequential replacement finds what forward steps miss).
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.diagnosis.fit.cross_validation import Heldout, error_with
from safedpa.diagnosis.fit.horizon import HorizonData
from safedpa.diagnosis.fit.least_squares import fit
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, block_gain, fit_trial, initial_values, trial_of, with_effect_at
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
from safedpa.diagnosis.search.accepted_trial import accept_trial
from safedpa.diagnosis.search.backward_revision import refit_effects
from safedpa.diagnosis.search.search_state import JudgedTrial, SearchState, known_effects
from safedpa.effects import AbstractEffect

__all__ = ["PassingCandidate", "fit_pairs", "improves_clearly", "look_one_step_ahead", "passing_at_other_horizon"]

_PAIRS = 5
"""Pairs that are fitted at one stage."""
_SURE = 3.4
"""Standard errors at another horizon."""
_OPEN = 1.0
"""Standard errors at the search's own horizon without which nothing is asked again."""
_ASKED = 3
"""Candidates."""
_WHY = "by itself too little, but with what was found after it"


def fit_pairs(
    null: EffectTrial, trials: Sequence[EffectTrial], rest: Sequence[AbstractEffect], shooting: Shooting
) -> list[EffectTrial]:
    """The pairs that promise most to first order, fitted."""
    if len(rest) < 2:
        return []
    columns, owners = _displacements(null, rest, shooting)
    order = _promising(null, columns, owners)
    singles = {trial.effects[0]: trial for trial in trials}
    found = []
    for one, other in order[:_PAIRS]:
        trial = fit_trial(null, [rest[one], rest[other]], shooting)
        if trial.loss < min(singles[rest[one].name].loss, singles[rest[other].name].loss):
            found.append(trial)
    return found


def _displacements(
    null: EffectTrial, rest: Sequence[AbstractEffect], shooting: Shooting
) -> tuple[FloatArray, list[int]]:
    """What each effect at each of its starts changes in the residual: columns (numbers, all starts), and owners."""
    columns, owners = [], []
    for index, item in enumerate(rest):
        models = [with_effect_at(null.fit.model, item, values) for values in initial_values(item)]
        residuals = shooting.residuals([null.fit.model]) if not models else shooting.residuals(models)
        stacked = np.moveaxis(residuals, 0, -1)
        reduced = shooting.eliminated(stacked, null.fit.scale).reshape(-1, len(models))
        columns.append(reduced - null.fit.residual.reshape(-1, 1))
        owners += [index] * len(models)
    return np.concatenate(columns, axis=1).astype(np.float32), owners


def _promising(null: EffectTrial, columns: Any, owners: list[int]) -> list[tuple[int, int]]:
    """Pairs of effects, the one whose best two columns take most squares off the residual first."""
    target: Any = np.asarray(null.fit.residual.reshape(-1), dtype=np.float32)
    if null.fit.columns.shape[-1]:
        known, _ = np.linalg.qr(null.fit.columns.reshape(len(target), -1).astype(np.float32))
        columns, target = columns - known @ (known.T @ columns), target - known @ (known.T @ target)
    columns = columns / (np.linalg.norm(columns, axis=0) + 1e-6)
    slope, gram = -(columns.T @ target), columns.T @ columns
    share = np.maximum(1.0 - gram**2, 1e-3)
    both = (slope[:, None] ** 2 + slope[None] ** 2 - 2 * gram * slope[:, None] * slope[None]) / share
    owner = np.array(owners)
    gains: dict[tuple[int, int], float] = {}
    for one, other in combinations(range(int(owner.max()) + 1), 2):
        part = both[np.ix_(owner == one, owner == other)]
        gains[one, other] = float(part.max())
    return sorted(gains, key=lambda pair: -gains[pair])


@dataclass(frozen=True)
class PassingCandidate:
    """A candidate that passes at another horizon."""

    trial: EffectTrial
    seconds: float
    gain: float
    """Standard errors there."""
    fall: float
    """Share of the held-out error there."""

    @property
    def reason(self) -> str:
        """As a candidate's reason says it."""
        return f"over {self.seconds:.3g} s the gain is {self.gain:.1f} standard errors, the error falls {self.fall:.0%}"


def passing_at_other_horizon(
    search: SearchState,
    stage: SearchStage,
    library: Sequence[AbstractEffect],
    alongside: Callable[[], Iterable[HorizonData]],
) -> PassingCandidate | None:
    """The candidate of a stage in which none passed that another horizon confirms most; None where none does."""
    open_ones = _open(search, stage)
    if not open_ones:
        return None
    by_name = {item.name: item for item in library}
    best: PassingCandidate | None = None
    for evidence in alongside():
        null = _null(search, evidence)
        for trial in open_ones:
            found = _judged(trial, null, evidence, [by_name[name] for name in trial.effects])
            if found.gain > _SURE and found.fall > FALL and (best is None or found.gain > best.gain):
                best = found
    return best if best is not None and filter_agrees(best.trial, search) else None


def _open(search: SearchState, stage: SearchStage) -> list[EffectTrial]:
    """Candidates that gain something and take something off the error, those that take most first."""
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
    return sorted(found, key=lambda trial: stage.errors[trial.effects].value)[:_ASKED]


def _null(search: SearchState, evidence: HorizonData) -> tuple[EffectTrial, HorizonData]:
    """The present model fitted in other windows."""
    now = search.current.fit
    shooting = evidence.shooting.around(now.model)
    again = fit(now.model, now.paths, shooting, now.scale)
    return trial_of(again, shooting, (), None), HorizonData(evidence.seconds, shooting, evidence.heldout)


def _judged(
    trial: EffectTrial, null: tuple[EffectTrial, HorizonData], evidence: HorizonData, items: Sequence[AbstractEffect]
) -> PassingCandidate:
    one, there = null
    model = one.fit.model
    for item in items:
        own = {p.name: trial.fit.model.settings[f"{item.name}.{p.name}"] for p in item.parameters}
        model = model.with_effect(item, own)
    other = fit_trial(one, items, there.shooting, [model])
    before = error_with(one.fit, there.shooting, there.heldout).value
    after = error_with(other.fit, there.shooting, there.heldout).value
    fall = 1.0 - after / before if before > 0 else 0.0
    return PassingCandidate(trial, evidence.seconds, block_gain(one, other, there.shooting), fall)


def look_one_step_ahead(search: SearchState, heldout: Heldout) -> SearchState | None:
    """The search with the likeliest trial of its last stage added, which did not pass; None where there is none.

    None also where a place on the floor explains more than the best trial: it is told instead; and of one recording,
    which is unlike none: there what does not pass is too little to tell.
    """
    if search.patch is not None or len(search.shooting.windows.names) < 2:
        return None
    last = max((item.stage for item in search.candidates), default=0)
    likely = [item for item in search.candidates if item.stage == last and _likely(item, search)]
    if not likely:
        return None
    best = max(likely, key=lambda item: item.fall or 0.0)
    trials = [item.trial for item in search.candidates if item.stage == last]
    plain = fewest_parameters(best.trial, trials, search)
    best = next(item for item in search.candidates if item.stage == last and item.trial is plain)
    known = [with_reason(item, "accepted", _WHY) if item is best else item for item in search.candidates]
    ahead = replace(search, candidates=known, added=list(search.added), rivals=dict(search.rivals))
    singles = [item.trial.effects[0] for item in likely if len(item.trial.effects) == 1]
    for name in best.trial.effects:
        ahead.rivals[name] = [other for other in singles if other not in best.trial.effects]
    accept_trial(ahead, best.trial, heldout)
    return ahead


def _likely(item: JudgedTrial, search: SearchState) -> bool:
    """Whether unseen blocks favour a trial next to the present model, and it takes something off the error."""
    if item.before != search.error.value:
        return False  # tried next to a model that went on since: it lacks what was added
    if item.decision == "accepted" or item.error is None or not within_bounds(item.trial, search):
        return False
    row = float(np.median(search.shooting.windows.period))
    late = is_spurious_delay(item.trial, item.error, search.error, row)
    return item.gain > LIKELY and (item.fall or 0.0) > FALL and not late


def improves_clearly(search: SearchState, ahead: SearchState, library: Sequence[AbstractEffect]) -> bool:
    """Whether what the step led to predicts unseen blocks surely better, and takes CLEAR_FALL off the error."""
    if not ahead.error.value < (1.0 - CLEAR_FALL) * search.error.value:
        return False
    by_name = known_effects(ahead, library)
    without = refit_effects(ahead, [by_name[name] for name in search.added])
    return block_gain(without, ahead.current, ahead.shooting) > SURE
