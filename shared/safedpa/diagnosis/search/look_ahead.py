"""One step further than unseen blocks allow, where much is missing still and no single step passes.

Logs that are unlike each other (each at a throttle of its own) tell several effects together, while each by itself,
fitted without one of the logs, predicts that one hardly better. A search that stops there stops by chance: 2.96
standard errors, where 3 are asked for. So the trial that takes most off the error is added for once, the search goes on
from there, and what it arrives at has to pass as a whole.

Source: Miller, Subset Selection in Regression, 2nd ed., 2002, ch. 3 (sequential replacement finds what forward steps
miss).
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from safedpa.diagnosis.fit.heldout import Heldout
from safedpa.diagnosis.fit.trial import block_gain
from safedpa.diagnosis.search.acceptance import accept
from safedpa.diagnosis.search.judgement import FALL, LIKELY, SURE, feigned_lateness, inside, plainest, with_reason
from safedpa.diagnosis.search.progress import Judged, Search, known_effects
from safedpa.diagnosis.search.revision import refit
from safedpa.diagnosis.search.second_opinion import CLEAR_FALL
from safedpa.effects import AbstractEffect

__all__ = ["one_step_ahead", "worth_it"]

_WHY = "by itself too little, but with what was found after it"


def one_step_ahead(search: Search, heldout: Heldout) -> Search | None:
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
    plain = plainest(best.trial, trials, search)
    best = next(item for item in search.candidates if item.stage == last and item.trial is plain)
    known = [with_reason(item, "accepted", _WHY) if item is best else item for item in search.candidates]
    ahead = replace(search, candidates=known, added=list(search.added), rivals=dict(search.rivals))
    singles = [item.trial.effects[0] for item in likely if len(item.trial.effects) == 1]
    for name in best.trial.effects:
        ahead.rivals[name] = [other for other in singles if other not in best.trial.effects]
    accept(ahead, best.trial, heldout)
    return ahead


def _likely(item: Judged, search: Search) -> bool:
    """Whether unseen blocks favour a trial beside the present model, and it takes something off the error."""
    if item.before != search.error.value:
        return False  # tried beside a model that went on since: it lacks what was added
    if item.decision == "accepted" or item.error is None or not inside(item.trial, search):
        return False
    row = float(np.median(search.shooting.windows.period))
    late = feigned_lateness(item.trial, item.error, search.error, row)
    return item.gain > LIKELY and (item.fall or 0.0) > FALL and not late


def worth_it(search: Search, ahead: Search, library: Sequence[AbstractEffect]) -> bool:
    """Whether what the step led to predicts unseen blocks surely better, and takes CLEAR_FALL off the error."""
    if not ahead.error.value < (1.0 - CLEAR_FALL) * search.error.value:
        return False
    by_name = known_effects(ahead, library)
    without = refit(ahead, [by_name[name] for name in search.added])
    return block_gain(without, ahead.current, ahead.shooting) > SURE
