"""The product's diagnosis on files, and an oracle: the same fit with the true effects."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from types import MappingProxyType
from typing import Any

import numpy as np

from safedpa.diagnosis.diagnose import diagnose
from safedpa.diagnosis.fit.cross_validation import error_with, heldout_of
from safedpa.diagnosis.fit.least_squares import fit
from safedpa.diagnosis.fit.multiple_shooting import shooting_of
from safedpa.diagnosis.fit.trial import fit_trial, trial_of, with_effect_at
from safedpa.diagnosis.report_schema import Report, as_document
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.effects import AbstractEffect, Where, conditioned, effect
from safedpa.effects.law import law_of
from safedpa.records import load_run
from safedpa.records.run import Run

HORIZON = 1.0
"""s, as the command has it."""
_EDGE = 0.05
"""Resolution of the conditions that the oracle gets, in the variable's unit."""


def diagnosed(model: Path, runs: Sequence[Path]) -> dict[str, Any]:
    """What ``safedpa diagnose`` writes into report.json for these files."""
    return as_document(diagnose(*_loaded(model, runs), HORIZON))


def oracle_error(
    model: Path,
    runs: Sequence[Path],
    effects: Mapping[str, Mapping[str, float]],
    laws: Mapping[str, str] = MappingProxyType({}),
) -> float:
    """The held-out error of the model with the named effects, fitted by the same fitter on the same windows.

    Effects with a law are fitted from their true ``effects`` numbers: a grid knows nothing of laws.
    """
    given, recorded = _loaded(model, runs)
    heldout, shooting = heldout_of(recorded, HORIZON), shooting_of(recorded, HORIZON)
    free = list(given.latent_names)
    shooting = shooting.around(given)
    scale = np.maximum(shooting.residuals([given])[0].std(axis=(0, 1)), 1e-6)
    base = trial_of(fit(given, free, shooting, scale), shooting, (), None)
    items = [_with_law(given, name, laws.get(name)) for name in effects]
    trial = fit_trial(base, items, shooting, [_begun(base.fit.model, items, effects)] if laws else None)
    again = shooting.around(trial.fit.model)
    best = fit(trial.fit.model, trial.fit.paths, again, trial.fit.scale)
    return error_with(best, again, heldout).value


def _with_law(model: PhysicsModel, name: str, law: str | None) -> AbstractEffect:
    item = effect(model.system.name, name)
    if law is None:
        return item
    key, phrase = law.split(" ", 1)
    return conditioned(item, law_of(key, phrase, _EDGE if key == Where.key else None, name), model.system)


def _begun(
    model: PhysicsModel, items: Sequence[AbstractEffect], effects: Mapping[str, Mapping[str, float]]
) -> PhysicsModel:
    for item in items:
        model = with_effect_at(model, item, dict(effects[item.name]))
    return model


def _loaded(model: Path, runs: Sequence[Path]) -> tuple[PhysicsModel, list[Run]]:
    given = load_model(model)
    return given, [load_run(path, given.system) for path in runs]


def alongside_the_truth(report: Report, effects: Mapping[str, Mapping[str, float]]) -> dict[str, Any]:
    """What was hidden, and what diagnosis said: what it added, every number, the held-out error of each stage."""
    return {
        "true": {name: dict(values) for name, values in effects.items()},
        "added": list(report.added),
        "values": {
            path: {"value": value.value, "std": value.std, "unit": value.unit}
            for path, value in report.parameters.items()
        },
        "error": [stage.heldout_error for stage in report.stages],
    }
