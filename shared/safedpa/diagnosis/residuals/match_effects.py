"""The named before the anonymous: a formula is compared with every candidate, refused ones too.

A candidate that unseen blocks cannot tell from the formula with certainty says the same in the words of physics. It is
named then ("likely, not proven"), and the formula is not shown.
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

__all__ = ["LibraryMatcher"]

_LOOKED_AT = 6
"""Candidates, those with the lowest loss first."""
_FAVOURED = 1.5
"""Standard errors of gain of a candidate that may stand for a formula."""


@dataclass
class LibraryMatcher:
    """Asked for a name of what a formula or a function of one variable says; remembers what it answered."""

    search: SearchState
    library: Sequence[AbstractEffect]
    heldout: Heldout
    found: list[JudgedTrial] = field(default_factory=list)
    _trials: list[EffectTrial] | None = None

    def of_formula(self, formula: EffectTrial) -> bool:
        """Whether a candidate says what a formula, or a place, fitted like an effect, says."""
        shooting = self.search.shooting
        same = [
            trial
            for trial in self._every()
            if block_gain(trial, formula, shooting) < SIMPLER
            or (explanation_correlation(trial, formula) > ALIKE and block_gain(trial, formula, shooting) < SURE)
        ]
        return self._reported(same, "no formula and no place says more")

    def of_function(self, left: FloatArray, scale: FloatArray) -> bool:
        """Whether a candidate takes as much off unseen blocks as a function of one variable.

        ``left`` (windows,): squares of unseen windows in units of ``scale`` (states,) that the function leaves.
        """
        same = []
        for trial in self._every():
            own = (trial.heldout / scale**2).sum(axis=1)
            if _sure(own - left, self.search.shooting.block) < SIMPLER:
                same.append(trial)
        return self._reported(same, "no function of one variable says more")

    def _every(self) -> list[EffectTrial]:
        """Candidates of the last stage on top of the present model, those that unseen blocks favour."""
        if self._trials is None:
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
        return sorted(singles, key=lambda item: item.trial.loss)[:_LOOKED_AT]

    def _fitted(self, item: JudgedTrial) -> EffectTrial:
        effect = next(own for own in self.library if own.name == item.trial.effects[0])
        settings = item.trial.fit.model.settings
        known = {p.name: settings[f"{effect.name}.{p.name}"].value for p in effect.parameters}
        start = with_effect_at(self.search.current.fit.model, effect, known)
        return fit_trial(self.search.current, [effect], self.search.shooting, [start])

    def _reported(self, same: Sequence[EffectTrial], why: str) -> bool:
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


def _sure(difference: FloatArray, block: np.ndarray[tuple[int, ...], np.dtype[np.int64]]) -> float:
    """Mean of the blocks' sums of a difference (windows,), in its standard errors."""
    sums = np.bincount(block, difference)[np.unique(block)]
    return float(sums.sum() / max(float(sums.std(ddof=1)) * np.sqrt(len(sums)), 1e-300)) if len(sums) > 1 else 0.0
