"""How the service calibrates the filter's margin for a model that it offers."""

from __future__ import annotations

from safedpa.adaptation import HistoryEstimator, LatentEstimator
from safedpa.diagnosis.live.work import Calibrate
from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.records.run import Run
from safedpa.safety.live_margin import live_margin
from safedpa.safety.shipped import settings_named

__all__ = ["calibrate_with"]


def calibrate_with(settings: str) -> Calibrate:
    """Calibration for the filter's settings (a file or a name), the latent estimated along as the adaptation does."""

    def calibrate(model: PhysicsModel, run: Run, footprint: tuple[float, ...]) -> str:
        learned = isinstance(model.base, LearnedBase) and model.base.weights.has("phi")
        estimator = HistoryEstimator if learned else LatentEstimator
        along = (lambda: estimator(model)) if model.latent_names else None
        return live_margin(model, settings_named(settings), run, footprint, along)

    return calibrate
