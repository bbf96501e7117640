"""Commands that all arrive late: a slow link."""

from __future__ import annotations

from typing import final

from safedpa.effects.action_delay import ActionDelay

__all__ = ["ActuatorDelay"]


@final
class ActuatorDelay(ActionDelay):
    """felt action(t) = action(t - seconds), for thrust and turn alike."""

    robot = "point"
    signature = (
        "residuals of acceleration and turn rate after each change of command, both as if it had not been sent yet"
    )
