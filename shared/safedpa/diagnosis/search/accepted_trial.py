"""A trial becomes part of the model that a search goes on with."""

from __future__ import annotations

from safedpa.diagnosis.fit.cross_validation import Heldout, error_with
from safedpa.diagnosis.fit.least_squares import Fit, fit
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, trial_of
from safedpa.diagnosis.search.search_state import SearchState

__all__ = ["accept_trial", "relinearized_trial"]


def accept_trial(search: SearchState, best: EffectTrial, heldout: Heldout) -> None:
    """Adds the best trial and fits it to the end: the next stage's trials begin there, so its error counts for them."""
    search.added += [name for name in best.effects if name not in search.added]
    shooting, again = relinearized_trial(best, search.shooting)
    search.shooting, search.current = shooting, trial_of(again, shooting, (), None)
    search.error = error_with(again, shooting, heldout)


def relinearized_trial(trial: EffectTrial, shooting: Shooting) -> tuple[Shooting, Fit]:
    """A trial fitted again in windows whose starts and weights are those of its own model.

    The weights of the model before take what it lacks for hands that push, where that is much: a car that a load holds
    where the model drives on.
    """
    own = shooting.around(trial.fit.model)
    return own, fit(trial.fit.model, trial.fit.paths, own, trial.fit.scale)
