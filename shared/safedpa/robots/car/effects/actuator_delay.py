"""Commands that all arrive late: a slow link."""

from __future__ import annotations

from typing import final

from safedpa.effects.action_delay import ActionDelay

__all__ = ["ActuatorDelay"]


@final
class ActuatorDelay(ActionDelay):
    """felt action(t) = action(t - seconds), for drive and steer alike."""

    robot = "car"
    signature = (
        "residuals of acceleration and yaw rate after each change of command, both as if it had not been sent yet"
    )
