"""A model with the margin that belongs to it, as a filter holds it; checked before it is used."""

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

__all__ = ["CalibratedModel", "accept_offer", "checked_calibration", "uncalibrated"]


_NEVER = "never"
"""In place of the date of a calibration."""


@dataclass(frozen=True)
class CalibratedModel:
    """What the filter needs of a model."""

    model: PhysicsModel
    fingerprint: str
    calibration: MarginCalibration
    """As the settings choose it: conformal, by the theorem, or one number."""

    def margin_over(self, period: float, settings: FilterSettings) -> tuple[MarginCalibration, float]:
        """The margins for steps of ``period`` [s], and how many times as long as any calibrated on they are.

        A number that the settings name was calibrated on none, and stays.
        """
        if isinstance(settings.margin, str) and self.calibration.date != _NEVER:
            return self.calibration.over(period, self.model.period)
        return self.calibration, 1.0


def uncalibrated(settings: FilterSettings, fingerprint: str) -> MarginCalibration:
    """The margins of the settings, which no data stand behind."""
    return MarginCalibration(dict(settings.epsilon), 0.99, 1, _NEVER, fingerprint)


def checked_calibration(calibration: MarginCalibration, own: str, settings: FilterSettings) -> MarginCalibration:
    """The calibration as the settings choose it. Raises InputError when it belongs to another model than ``own``."""
    if calibration.fingerprint != own:
        raise InputError(
            f"margin: calibrated for model {calibration.fingerprint}, the filter has {own}; "
            "calibrate it again with 'safedpa calibrate'"
        )
    check_margins(calibration.epsilon, ())
    return calibration.chosen(settings.margin)


def accept_offer(offer: ModelMessage, current: CalibratedModel, settings: FilterSettings) -> CalibratedModel:
    """The offered model and its margin. Raises InputError when they do not fit each other, the robot or the filter.

    A margin that promises less than the one in force is refused: a change must not take safety away unseen.
    """
    model = offered_model(offer, current.model)
    own = offer.fingerprint
    sent = margin_from_text(offer.margin) if offer.margin else margin_for(model)
    if sent is None and current.calibration.date != _NEVER:
        raise InputError("margin: got none, the one in force was calibrated; calibrate one for the offered model too")
    calibration = checked_calibration(sent or uncalibrated(settings, own), own, settings)
    if calibration.coverage < current.calibration.coverage:
        raise InputError(
            f"margin: covers {calibration.coverage:g} of the steps, the one in force {current.calibration.coverage:g}; "
            "calibrate it for as many"
        )
    missing = set(current.calibration.epsilon) - set(calibration.epsilon)
    if missing:
        raise InputError(f"margin: none for {', '.join(sorted(missing))}, the one in force has it; calibrate it too")
    return CalibratedModel(model, own, calibration)
