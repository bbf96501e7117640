"""Which action drives a car: its name differs between a speed servo and a throttle."""

from __future__ import annotations

from safedpa.effects.effect import Named

__all__ = ["drive_of"]


def drive_of(action: Named) -> str:
    """The name of the action that drives the car: ``target_speed`` or ``throttle``."""
    return "throttle" if "throttle" in action else "target_speed"
