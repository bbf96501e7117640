"""What the engineer takes away: the model with its final numbers, and the filter's margin for it."""

from __future__ import annotations

import datetime
import pickle
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import Path

from safedpa.diagnosis.stepwise import Step, with_final
from safedpa.dynamics import LearnedBase, PhysicsModel, save_model
from safedpa.errors import InputError
from safedpa.records.run import Run
from safedpa.safety.run_calibration import calibration_from_runs
from safedpa.safety.shipped import settings_named

__all__ = ["STEPS", "saved"]

STEPS = (
    (0.0, "Saving: fits the final numbers along whole recordings"),
    (0.7, "Saving: writes model.toml"),
    (0.8, "Saving: calibrates the filter's margin on the recordings"),
)
"""From which share on what is done."""
_COVERAGE = 0.99
"""Share of steps that the margin covers."""


def saved(step: bytes, runs: Sequence[Run], given: PhysicsModel, folder: Path, tell: Callable[[float], None]) -> str:
    """Writes model.toml, and margin.toml for a car that the filter can drive; says what was written.

    Added parameters are fixed, those that the given file calls free stay free. Raises InputError where the folder
    cannot be written to.
    """
    before: Step = pickle.loads(step)
    final = with_final(before) if before.search.added or before.model.latent_names else before
    tell(0.7)
    model = _as_given(final.model, given)
    try:
        folder.mkdir(parents=True, exist_ok=True)
        save_model(model, folder / "model.toml")
        tell(0.8)
        margin = _margin(model, runs, folder / "margin.toml")
    except OSError as error:
        raise InputError(
            f"{folder}: cannot be written to ({error.strerror}); choose another folder with --out"
        ) from error
    also = f" and margin.toml: safedpa up --model {folder / 'model.toml'} --margin {margin}" if margin else ""
    return f"Held-out error {final.error.value:.3g}. Written: {folder / 'model.toml'}{also}"


def _as_given(model: PhysicsModel, given: PhysicsModel) -> PhysicsModel:
    free = set(given.latent_names)
    return model.with_settings({path: replace(item, free=path in free) for path, item in model.settings.items()})


def _margin(model: PhysicsModel, runs: Sequence[Run], path: Path) -> Path | None:
    """Writes the margin; None for a robot that the filter does not drive, or too few transitions at its period."""
    path.unlink(missing_ok=True)  # of an earlier model
    if isinstance(model.base, LearnedBase) or model.system.action_names != ("target_speed", "steer"):
        return None
    try:
        today = datetime.date.today().isoformat()
        calibration = calibration_from_runs(model, settings_named("car"), runs, _COVERAGE, today)
    except InputError:  # the filter's settings stand in for it
        return None
    calibration.save(path)
    return path
