"""When a trial is accepted, which others the data cannot tell from it, and the sentences that say why."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from safedpa.compare.actuators import late_commands
from safedpa.diagnosis.fit.heldout import HeldoutError
from safedpa.diagnosis.fit.shooting import Shooting
from safedpa.diagnosis.fit.trial import Trial, block_gain, likeness
from safedpa.diagnosis.search.progress import Judged, Search
from safedpa.diagnosis.search.second_opinion import CLEAR_FALL, MUCH

__all__ = [
    "ALIKE", "FALL", "LIKELY", "LITTLE_FALL", "MOST_MISSING", "SAME", "SIMPLER", "SURE", "VERY_SURE", "Stage",
    "farthest", "feigned_lateness", "inside", "judged", "likely", "passes", "plainest", "preferred", "with_reason",
]  # fmt: skip

SURE = 3.0
"""Standard errors of gain on unseen blocks that an addition needs, together with FALL."""
VERY_SURE = 4.5
"""Standard errors that do with LITTLE_FALL."""
FALL = 0.03
"""Share by which the held-out rollout error has to fall."""
LITTLE_FALL = 0.004
LIKELY = 1.5
"""Standard errors that do with FALL where the filter along whole recordings is certain: it knows lasting disturbances,
so it sees what grows over a run, where blocks are too unlike each other to agree."""
MOST_MISSING = 0.5
"""Held-out rollout error, in units of the change over the horizon, from which most of the physics is missing."""
SAME = 1.0
"""Standard errors within which two candidates cannot be told apart."""
SIMPLER = 2.0
"""Standard errors within which the candidate with fewer parameters is preferred."""
ALIKE = 0.9
"""Correlation of what two candidates explain from which they count as alike, within SIMPLER."""
SAME_SHAPE = 0.985
"""Correlation from which they count as alike within SURE."""
ONE = 0.002
"""Share of the squares of what one explains up to which two candidates differ in nothing."""


@dataclass(frozen=True)
class Stage:
    """All trials of one stage, best first, with their gains and held-out errors by effects."""

    number: int
    trials: list[Trial]
    gains: dict[tuple[str, ...], float]
    errors: dict[tuple[str, ...], HeldoutError]
    row: float = 0.0
    """s between two rows."""
    doubted: frozenset[tuple[str, ...]] = frozenset()
    """Trials that passed, but that the filter along whole recordings does not confirm."""

    def passes(self, trial: Trial, before: HeldoutError) -> bool:
        """Whether a trial is to be added by unseen blocks alone."""
        error = self.errors.get(trial.effects)
        return passes(self.gains[trial.effects], error, before) and not feigned_lateness(trial, error, before, self.row)


def passes(gain: float, error: HeldoutError | None, before: HeldoutError) -> bool:
    """Enough standard errors on unseen blocks, and enough off the held-out rollout error."""
    if error is None or not before.value > 0:
        return False
    fall = 1.0 - error.value / before.value
    return (gain > SURE and fall > FALL) or (gain > VERY_SURE and fall > LITTLE_FALL)


def feigned_lateness(trial: Trial, error: HeldoutError | None, before: HeldoutError, row: float) -> bool:
    """Whether a trial makes later what is late already, or late by less than a row, without a clear fall of the error.

    A lag is a delay to first order: the second one of a command corrects the shape of the first, which no actuator has
    exactly. And what happens within a ``row`` [s] may be the servo's own way to answer, inside its loop.
    """
    if len(trial.effects) == 1 and error is not None and error.value < (1.0 - CLEAR_FALL) * before.value:
        return False  # in a pair the other one may take it off
    model = trial.fit.model
    names = model.system.action_names
    own = [late_commands(item, names) for item in model.effects if item.name in trial.effects]
    others = [late_commands(item, names) for item in model.effects if item.name not in trial.effects]
    if any(not one.isdisjoint(other) for one in own for other in others):
        return True
    late = [item for item in model.effects if item.name in trial.effects and late_commands(item, names)]
    seconds = [model.settings[f"{item.name}.{p.name}"].value for item in late for p in item.parameters if p.unit == "s"]
    return any(value < row for value in seconds)


def likely(trial: Trial, stage: Stage, before: HeldoutError) -> bool:
    """Whether unseen blocks favour a trial enough to ask the filter along whole recordings, which may be certain."""
    gain, error = stage.gains[trial.effects], stage.errors.get(trial.effects)
    enough = error is not None and gain > LIKELY and error.value < (1.0 - FALL) * before.value
    return enough and not feigned_lateness(trial, error, before, stage.row)


def preferred(trials: Sequence[Trial], search: Search) -> Trial | None:
    """The best trial, or the simplest of those that cannot be told from it with certainty."""
    shooting = search.shooting
    better = [trial for trial in trials if trial.loss < search.current.loss and inside(trial, search)]
    if not better:
        return None
    close = [trial for trial in better[:8] if block_gain(trial, better[0], shooting) < SIMPLER]
    close = close or better[:1]
    fewest = min(len(trial.fit.paths) for trial in close)
    return next(trial for trial in close if len(trial.fit.paths) == fewest)


def farthest(passing: Sequence[Trial], stage: Stage, before: HeldoutError) -> list[Trial]:
    """While much is missing, the trial that takes far more off the held-out error than the best in the windows first.

    Windows weigh each state by its noise, so a small fault of the steer may lead there while the speed is all
    wrong.
    """
    if before.value <= MUCH or len(passing) < 2:
        return list(passing)
    least = min(passing, key=lambda trial: stage.errors[trial.effects].value)
    apart = stage.errors[passing[0].effects].value - stage.errors[least.effects].value
    if apart <= CLEAR_FALL * before.value:
        return list(passing)
    return [least, *(trial for trial in passing if trial is not least)]


def plainest(trial: Trial, trials: Sequence[Trial], search: Search) -> Trial:
    """Of all trials that explain the very same as one, itself or the one with the fewest numbers.

    A free gain of the base makes a towed load's mass one with its own size: what is left is a rolling resistance. What
    blocks say of the two is rounding, and beside a number that nothing shows no other one's size is told.
    """
    fewer = [other for other in trials if len(other.fit.paths) < len(trial.fit.paths) and inside(other, search)]
    same = [other for other in fewer if other.loss < search.current.loss and _one(trial, other)]
    return min(same, key=lambda other: len(other.fit.paths), default=trial)


def inside(trial: Trial, search: Search) -> bool:
    """Whether none of its own parameters was pushed to a bound: what fits only there is something else.

    While MOST_MISSING, a bound is no proof of that: the next effects move the number back inside.
    """
    return search.error.value > MOST_MISSING or bool(trial.fit.free[len(search.current.fit.paths) :].all())


def judged(search: Search, stage: Stage, trial: Trial, best: Trial | None, passed: bool) -> Judged:
    """The verdict on one trial of a stage, ``best`` being what is added if it ``passed``."""
    gain, error = stage.gains[trial.effects], stage.errors.get(trial.effects)
    before, taken = search.error.value, _taken_up(trial, search.current)
    if taken:
        return Judged(stage.number, trial, gain, error, "rejected", f"the free {taken} does the same", (taken,), before)
    equals = _equals(trial, stage.trials[:10], search.shooting, search.current) if gain > 1.5 else ()
    decision, reason = _decision(search, stage, trial, best, passed, equals)
    return Judged(stage.number, trial, gain, error, decision, reason, equals, before)


def _decision(
    search: Search, stage: Stage, trial: Trial, best: Trial | None, passed: bool, equals: tuple[str, ...]
) -> tuple[str, str]:
    gain, error = stage.gains[trial.effects], stage.errors.get(trial.effects)
    seconds = search.shooting.windows.horizon
    change = "" if error is None else 100 * (error.value / search.error.value - 1)
    fall = "" if error is None else f"; the held-out error after {seconds:.3g} s changes by {change:+.1f} %"
    sentence = f"gain on unseen blocks {gain:.1f} standard errors{fall}"
    if trial is best and passed:
        return "accepted", sentence
    if trial is best and search.patch is not None:
        return "suspected", f"{sentence}; but a place explains more"
    if trial.effects in stage.doubted:
        return "suspected", f"{sentence}; but a filter that knows lasting pushes does not confirm it"
    if passed and best is not None:
        behind = block_gain(trial, best, search.shooting)
        suspected = best.name in equals or (gain > SURE and behind < SIMPLER)
        reason = f"{sentence}; {behind:.1f} standard errors behind {best.name}"
        return ("suspected" if suspected else "rejected"), reason
    if gain > SURE:
        return "suspected", f"{sentence}: too little to be worth it"
    return "rejected", sentence


def with_reason(item: Judged, decision: str, reason: str) -> Judged:
    """The same trial, decided anew."""
    return replace(item, decision=decision, reason=f"{item.reason}; {reason}")


def _equals(trial: Trial, trials: Sequence[Trial], shooting: Shooting, null: Trial) -> tuple[str, ...]:
    """Names of the other trials that unseen blocks cannot tell from this one."""
    found = []
    for other in trials:
        if other is trial or other.loss >= null.loss or set(other.effects) & set(trial.effects):
            continue
        apart = abs(block_gain(other, trial, shooting))
        alike = likeness(other, trial)
        equal = (apart < SAME and alike > 0.5) or (apart < SIMPLER and alike > ALIKE) or _one(trial, other)
        if equal or (apart < SURE and alike > SAME_SHAPE):
            found.append(other.name)
    return tuple(found)


def _one(trial: Trial, other: Trial) -> bool:
    """Whether both explain the very same, size and all: then one has a number that nothing here shows."""
    size = float(min((trial.explained**2).sum(), (other.explained**2).sum()))
    return float(((trial.explained - other.explained) ** 2).sum()) < ONE * size


def _taken_up(trial: Trial, null: Trial) -> str:
    """The free parameter that already does what the effect would, empty where there is none."""
    count = len(null.fit.paths)
    if not count or len(trial.effects) > 1:
        return ""
    flat = trial.fit.columns.reshape(-1, trial.fit.columns.shape[-1])
    known, new = flat[:, :count], flat[:, count:]
    size = float((new**2).sum())
    if not size > 0:
        return ""
    alike = np.abs(known.T @ new) / np.sqrt((known**2).sum(axis=0)[:, None] * (new**2).sum(axis=0) + 1e-30)
    solved = np.linalg.lstsq(known, new, rcond=1e-9)[0]
    left = float(((new - known @ solved) ** 2).sum()) / size
    return null.fit.paths[int(alike.max(axis=1).argmax())] if left < 0.002 else ""
