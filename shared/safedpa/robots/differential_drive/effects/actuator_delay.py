"""Commands that all arrive late: a slow link."""

from __future__ import annotations

from typing import final

from safedpa.effects.action_delay import ActionDelay

__all__ = ["ActuatorDelay"]


@final
class ActuatorDelay(ActionDelay):
    """felt action(t) = action(t - seconds), for speed and turn rate alike."""

    robot = "differential_drive"
    signature = "after each change of command speed and turn rate go on for a while as if nothing had been sent"
