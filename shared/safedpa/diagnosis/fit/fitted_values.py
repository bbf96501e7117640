"""The fitted numbers of a trial, as a report states them."""

from __future__ import annotations

import numpy as np

from safedpa.diagnosis.document import Value
from safedpa.diagnosis.fit.shooting import Shooting
from safedpa.diagnosis.fit.trial import Trial

__all__ = ["values_of"]


def values_of(trial: Trial, shooting: Shooting) -> dict[str, Value]:
    """The fitted numbers of a trial by path."""
    model, deviations = trial.fit.model, trial.fit.deviations(shooting)
    found = {}
    for path, value, std in zip(trial.fit.paths, trial.fit.values, deviations, strict=True):
        spread = float(std) if np.isfinite(std) else None
        found[path] = Value(float(value), spread, model.parameters[path].unit)
    return found
