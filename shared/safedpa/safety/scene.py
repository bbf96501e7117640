"""The barriers of what a robot perceives: obstacles, field, its own speed limits."""

from __future__ import annotations

from safedpa.bus import StateMessage
from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractBarrier
from safedpa.safety.car_barriers import car_barriers
from safedpa.safety.settings import FilterSettings

__all__ = ["SceneBarriers"]


class SceneBarriers:
    """Builds barriers from state messages, and keeps them while the scene stays as it is."""

    def __init__(self, settings: FilterSettings) -> None:
        self._settings = settings
        self._scene: tuple[object, ...] = ()
        self._barriers: tuple[AbstractBarrier, ...] = ()

    def of(self, state: StateMessage) -> tuple[AbstractBarrier, ...] | str:
        """The barriers around this robot, or a sentence about what cannot be a scene."""
        scene = (state.obstacles, state.field, state.footprint)
        if scene != self._scene:
            try:
                self._barriers = tuple(car_barriers(self._settings, state.footprint, state.obstacles, state.field))
            except InputError as error:
                return f"scene ({error})"
            self._scene = scene
        return self._barriers
