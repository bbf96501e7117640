"""A model with its calibrated margin, and the checks before the filter uses one."""

from __future__ import annotations

from dataclasses import dataclass

from safedpa.bus import ModelMessage
from safedpa.dynamics import PhysicsModel
from safedpa.dynamics.model_offer import offered_model
from safedpa.errors import InputError
from safedpa.safety.checks.compatibility import check_margins
from safedpa.safety.defaults import margin_for
from safedpa.safety.margins.calibration import MarginCalibration, margin_from_text
from safedpa.safety.settings import FilterSettings

# Date of margins that were not calibrated.
_NEVER = "never"


@dataclass(frozen=True)
class CalibratedModel:
    """A model with the margin for it."""

    model: PhysicsModel
    fingerprint: str
    calibration: MarginCalibration
    """The kind of margin that the settings choose: conformal, by the theorem, or a fixed value."""

    def margin_over(self, period: float, settings: FilterSettings) -> tuple[MarginCalibration, float]:
        """Returns the margins for steps of ``period`` [s], and the ratio of that step to the longest calibrated one."""
        # A fixed value from the settings belongs to no period and is not scaled.
        if isinstance(settings.margin, str) and self.calibration.date != _NEVER:
            return self.calibration.for_period(period, self.model.period)
        return self.calibration, 1.0


def uncalibrated(settings: FilterSettings, fingerprint: str) -> MarginCalibration:
    """Returns the margins of the settings, which are not calibrated."""
    return MarginCalibration(dict(settings.epsilon), 0.99, 1, _NEVER, fingerprint)


def checked_calibration(calibration: MarginCalibration, own: str, settings: FilterSettings) -> MarginCalibration:
    """Returns the calibration that the settings choose. Raises InputError if it is not for the model ``own``."""
    if calibration.fingerprint != own:
        raise InputError(
            f"margin: calibrated for model {calibration.fingerprint}, the filter has {own}; "
            "calibrate it again with 'safedpa calibrate'"
        )
    check_margins(calibration.epsilon, ())
    return calibration.select(settings.margin)


def accept_offer(offer: ModelMessage, current: CalibratedModel, settings: FilterSettings) -> CalibratedModel:
    """Returns the offered model and its margin.

    Raises InputError if they do not fit each other, the robot or the filter, or if the margin has a lower coverage than
    the active one.
    """
    model = offered_model(offer, current.model)
    own = offer.fingerprint
    sent = margin_from_text(offer.margin) if offer.margin else margin_for(model)
    if sent is None and current.calibration.date != _NEVER:
        raise InputError("margin: missing, but the active model's is calibrated; calibrate one for the offered model")
    # A model change must not weaken the guarantee without anyone noticing: coverage and kinds may only grow.
    calibration = checked_calibration(sent or uncalibrated(settings, own), own, settings)
    if calibration.coverage < current.calibration.coverage:
        raise InputError(
            f"margin: covers {calibration.coverage:g} of the steps, the active one {current.calibration.coverage:g}; "
            "calibrate it for the same coverage"
        )
    missing = set(current.calibration.epsilon) - set(calibration.epsilon)
    if missing:
        raise InputError(f"margin: missing for {', '.join(sorted(missing))}, which the active one has; calibrate it")
    return CalibratedModel(model, own, calibration)
