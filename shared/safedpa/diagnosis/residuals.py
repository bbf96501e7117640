"""Residuals: what the measured rates have and the model's have not, against state and action."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from safedpa.diagnosis.rollout_error import prediction_errors
from safedpa.diagnosis.windows import Floats, Rows, Windows

__all__ = ["Residuals", "residuals"]

SHORT = 0.2
"""s; long enough that noise of the measurement averages out, short enough that errors do not mix."""


@dataclass(frozen=True)
class Residuals:
    """rates (windows, states): (measured - predicted) / seconds, in the state's unit per second.

    ``values`` (windows, variables) are the measured states, then the actions, at the windows' starts.
    """

    seconds: float
    rates: Floats
    values: Floats


def residuals(windows: Windows, rows: Sequence[Rows], predicted: Floats) -> Residuals:
    """From predictions (len(rows), windows, states) at the rows: those that come nearest to 0.2 s after the start."""
    seconds = np.array([np.median(windows.clock[at] - windows.clock[windows.start]) for at in rows])
    index = int(np.argmin(np.abs(seconds - SHORT)))
    at = rows[index]
    elapsed = windows.clock[at] - windows.clock[windows.start]
    rates = -prediction_errors(windows, at, predicted[index]) / elapsed[:, None]
    values = np.concatenate([windows.states[windows.start], windows.actions[windows.start]], axis=1)
    return Residuals(float(seconds[index]), rates, values)
