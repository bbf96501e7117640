"""What remains: whether it depends on anything that was measured, and a formula for it that is no named effect.

The windows' pushes are averaged in bins of one variable without the fold that is predicted; where that predicts the
fold's own pushes, the rest has structure. The formula is the best single term of a small list, by the same rule.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from safedpa.diagnosis.patch import Patch, best_patch
from safedpa.diagnosis.pushes import pushes_of
from safedpa.diagnosis.report import Unexplained
from safedpa.diagnosis.shooting import Shooting
from safedpa.diagnosis.trial import Trial
from safedpa.diagnosis.where import PLACE
from safedpa.diagnosis.windows import Floats, Rows

__all__ = ["remaining"]

_SURE = 5.0
"""Standard errors on unseen blocks; several variables and states are looked at."""
_SHARE = 0.06
"""Of the pushes' squares."""
_BINS = 7

_TERMS: tuple[tuple[str, Callable[[Floats], Floats]], ...] = (
    ("1", np.ones_like),
    ("{0}", lambda v: v),
    ("{0}^2", lambda v: v**2),
    ("{0} |{0}|", lambda v: v * np.abs(v)),
    ("{0}^3", lambda v: v**3),
    ("sign({0})", np.sign),
    ("sin({0})", np.sin),
    ("cos({0})", np.cos),
)


@dataclass(frozen=True)
class _Dependence:
    variable: str
    state: str
    share: float
    sure: float
    values: Floats
    pushes: Floats


def remaining(trial: Trial, shooting: Shooting, patch: Patch | None) -> Unexplained | None:
    """The structure of what remains, or None where unseen blocks confirm none."""
    place = patch or best_patch(trial, shooting)
    if place is not None and place.share > 0.02:
        return Unexplained(PLACE, place.expression, place.share)
    system = shooting.windows.system
    states = tuple(name for name in system.state_names if name not in PLACE)[-2:]
    if len(shooting.windows) < 40:
        return None
    pushes = pushes_of(trial, shooting, states)
    spread = 6.0 * np.median(np.abs(pushes), axis=0) + 1e-12
    pushes = np.clip(pushes, -spread, spread)
    found = []
    for name, values in _variables(shooting).items():
        for index, state in enumerate(states):
            share, sure = _explained(values, pushes[:, index], shooting)
            if share > _SHARE and sure > _SURE:
                found.append(_Dependence(name, state, share, sure, values, pushes[:, index]))
    if not found:
        return None
    best = max(found, key=lambda item: item.share)
    close = [item.variable for item in sorted(found, key=lambda i: -i.share) if item.share > 0.7 * best.share]
    return Unexplained(tuple(dict.fromkeys(close)), _formula(best, shooting), best.share)


def _variables(shooting: Shooting) -> dict[str, Floats]:
    """What a push may depend on, by name, each (windows,)."""
    windows, middle = shooting.windows, shooting.measured.shape[1] // 2
    found: dict[str, Floats] = {}
    for index, variable in enumerate(windows.system.state):
        if variable.name not in PLACE:
            values = shooting.measured[:, middle, index]
            found[variable.name] = (values + np.pi) % (2 * np.pi) - np.pi if variable.angle else values
    for index, variable in enumerate(windows.system.action):
        sums = np.concatenate([[0.0], np.cumsum(windows.actions[:, index])])
        found[variable.name] = (sums[windows.end] - sums[windows.start]) / windows.steps
    found["time"] = windows.time[windows.start]
    return found


def _explained(values: Floats, pushes: Floats, shooting: Shooting) -> tuple[float, float]:
    """(share of the squares, standard errors over blocks) by bin means of the other folds."""
    edges = np.unique(np.quantile(values, np.linspace(0, 1, _BINS + 1)[1:-1]))
    if not np.ptp(values) > 1e-9:
        return 0.0, 0.0
    which = np.searchsorted(edges, values)
    predicted = np.zeros_like(pushes)
    for fold in np.unique(shooting.fold):
        used = shooting.fold != fold
        counts = np.bincount(which[used], minlength=_BINS)
        means = np.bincount(which[used], pushes[used], minlength=_BINS) / (counts + 2.0)
        predicted[~used] = means[which[~used]]
    gain = pushes**2 - (pushes - predicted) ** 2
    return float(gain.sum() / max((pushes**2).sum(), 1e-300)), _sure(gain, shooting.block)


def _sure(gain: Floats, block: Rows) -> float:
    sums = np.zeros(int(block.max()) + 1)
    np.add.at(sums, block, gain)
    sums = sums[np.unique(block)]
    return float(sums.sum() / max(float(sums.std(ddof=1)) * np.sqrt(len(sums)), 1e-300)) if len(sums) > 7 else 0.0


def _formula(found: _Dependence, shooting: Shooting) -> str:
    """The term whose fit without a fold predicts that fold best."""
    best, text = np.inf, ""
    for label, term in _TERMS:
        column = term(found.values)
        error = 0.0
        for fold in np.unique(shooting.fold):
            used = shooting.fold != fold
            slope = float(column[used] @ found.pushes[used]) / max(float(column[used] @ column[used]), 1e-300)
            error += float(((found.pushes[~used] - slope * column[~used]) ** 2).sum())
        if error < best:
            slope = float(column @ found.pushes) / max(float(column @ column), 1e-300)
            term_text = label.format(found.variable)
            best, text = error, f"d({found.state})/dt += {slope:.3g}" + ("" if term_text == "1" else f" {term_text}")
    return text
