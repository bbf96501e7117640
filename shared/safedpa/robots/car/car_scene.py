"""The barriers of what a car perceives: obstacles, field and speed limits, and what it tows in reverse."""

from __future__ import annotations

from typing import final

from safedpa.bus import StateMessage
from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractStack, Barriers, RememberingStack
from safedpa.safety.car_barriers import car_barriers
from safedpa.safety.car_stack import stacked
from safedpa.safety.reversed_way import ReversedWay
from safedpa.safety.scene import MOST_OBSTACLES, AbstractScene
from safedpa.safety.settings import FilterSettings

__all__ = ["CarScene"]


@final
class CarScene(AbstractScene):
    """Keeps the barriers while the scene stays as it is.

    Of a car that tows something the barriers are others with every state: ``way`` tells how far it was driven
    backwards.
    """

    quick = True

    def __init__(self, settings: FilterSettings) -> None:
        self._settings, self.way = settings, ReversedWay()
        self._scene: tuple[object, ...] = ()
        self._barriers: AbstractStack = Barriers(())

    def of(self, state: StateMessage) -> AbstractStack | str:  # noqa: D102
        self.way.follow(state)
        towing = (self.way.way, state.values) if state.towed else ()
        scene = (state.obstacles, state.field, state.footprint, state.corridor, state.towed, towing)
        if scene != self._scene:
            try:
                self._barriers = self._built(state)
            except InputError as error:
                return f"scene ({error})"
            self._scene = scene
        return self._barriers

    def remember(self, former: AbstractScene) -> None:
        """How far it was driven backwards, which decides where the load may stand."""
        if isinstance(former, CarScene):
            self.way = former.way

    def _built(self, state: StateMessage) -> AbstractStack:
        if state.corridor:  # a car must not get rid of its obstacles by naming a corridor
            raise InputError(
                "corridor: got one of a robot that drives between obstacles; wanted these, and no corridor"
            )
        if len(state.obstacles) > MOST_OBSTACLES:
            raise InputError(
                f"obstacles: got {len(state.obstacles)}, wanted at most {MOST_OBSTACLES}; send the nearest"
            )
        towed = self.way.reach(state, self._settings.braking)
        found = car_barriers(self._settings, state.footprint, state.obstacles, state.field, towed)
        return RememberingStack(stacked(found))
