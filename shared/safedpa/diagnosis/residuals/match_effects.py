"""Matches formulas with effects of the library: a named effect is preferred to an anonymous formula.

A formula is compared with every candidate, refused ones too. If unseen blocks cannot clearly distinguish a candidate
from the formula, the candidate is reported instead ("likely, not proven").
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.diagnosis.fit.cross_validation import Heldout, error_with
from safedpa.diagnosis.fit.trial import EffectTrial, block_gain, explanation_correlation, fit_trial, with_effect_at
from safedpa.diagnosis.search.acceptance import ALIKE, SIMPLER, SURE
from safedpa.diagnosis.search.search_state import JudgedTrial, SearchState
from safedpa.effects import AbstractEffect

# Candidates that are compared, those with the lowest loss first; each needs a fit.
_COMPARED = 6
# Standard errors of gain that a candidate needs to replace a formula: otherwise it explains nothing itself.
_FAVOURED = 1.5


@dataclass
class LibraryMatcher:
    """Finds effects that explain the same as a formula or a function of one variable; ``found`` collects them."""

    search: SearchState
    library: Sequence[AbstractEffect]
    heldout: Heldout
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
        effect = next(candidate for candidate in self.library if candidate.name == item.trial.effects[0])
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
                error = error_with(trial.fit, self.search.shooting, self.heldout)
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
