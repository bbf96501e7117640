"""A margin calibration as it travels on the bus: JSON text."""

from __future__ import annotations

import json
from dataclasses import asdict

from safedpa.errors import InputError
from safedpa.limits import parse_json
from safedpa.safety.calibration import MarginCalibration

__all__ = ["margin_from_text", "margin_text"]


def margin_text(calibration: MarginCalibration) -> str:
    """The JSON text that ``margin_from_text`` reads back."""
    return json.dumps(asdict(calibration), sort_keys=True)


def margin_from_text(text: str) -> MarginCalibration:
    """The calibration that a JSON text holds. Raises InputError naming what is wrong."""
    try:
        return MarginCalibration(**parse_json(text))
    except (ValueError, TypeError, InputError) as error:
        raise InputError(f"margin: {error}; wanted a calibration as JSON text") from error
