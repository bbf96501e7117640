"""Accepting a trial: it becomes part of the model with which the search continues."""

from __future__ import annotations

from safedpa.diagnosis.fit.cross_validation import Heldout, error_with
from safedpa.diagnosis.fit.least_squares import Fit, fit
from safedpa.diagnosis.fit.multiple_shooting import Shooting
from safedpa.diagnosis.fit.trial import EffectTrial, trial_of
from safedpa.diagnosis.search.search_state import SearchState

__all__ = ["accept_trial", "relinearized_trial"]


def accept_trial(search: SearchState, best: EffectTrial, heldout: Heldout) -> None:
    """Adds a trial to the search and fits it to convergence, because the next stage is compared with its error."""
    search.added += [name for name in best.effects if name not in search.added]
    shooting, again = relinearized_trial(best, search.shooting)
    search.shooting, search.current = shooting, trial_of(again, shooting, (), None)
    search.error = error_with(again, shooting, heldout)


def relinearized_trial(trial: EffectTrial, shooting: Shooting) -> tuple[Shooting, Fit]:
    """Fits a trial again in windows with the starts and weights of its own model.

    The weights of the previous model treat a large missing effect as a disturbance by a person: a car that a load holds
    back while the model drives on. Such windows are down-weighted although they show the effect best.
    """
    # The windows first: the fit minimises residuals with the weights that these give.
    relinearized = shooting.around(trial.fit.model)
    return relinearized, fit(trial.fit.model, trial.fit.paths, relinearized, trial.fit.scale)
