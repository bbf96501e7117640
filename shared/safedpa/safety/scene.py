"""The barriers of what a robot perceives: a car's obstacles, field and speed limits; a pendulum's corridor."""

from __future__ import annotations

from safedpa.bus import StateMessage
from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractStack, Barriers, RememberingStack
from safedpa.safety.car_barriers import car_barriers
from safedpa.safety.car_stack import stacked
from safedpa.safety.corridor_barrier import CorridorBarrier
from safedpa.safety.reversed_way import ReversedWay
from safedpa.safety.settings import FilterSettings

__all__ = ["SceneBarriers"]

_MOST_OBSTACLES = 64
"""A decision about so many takes 5 ms at the worst; a thousand, all of them at hand, take three seconds, in
which the other robots of the fleet would get no action."""


class SceneBarriers:
    """Builds barriers from state messages, and keeps them while the scene stays as it is.

    Of a robot that tows something they are others with every state: ``way`` tells how far it was driven backwards.
    """

    def __init__(self, settings: FilterSettings, way: ReversedWay | None = None) -> None:
        self._settings, self.way = settings, way or ReversedWay()
        self._scene: tuple[object, ...] = ()
        self._barriers: AbstractStack = Barriers(())

    def of(self, state: StateMessage) -> AbstractStack | str:
        """The barriers around this robot, or a sentence about what cannot be a scene.

        A robot with a corridor has that one barrier; every other one is a car and has to say what is around it.
        """
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

    def _built(self, state: StateMessage) -> AbstractStack:
        if not state.corridor:
            if len(state.obstacles) > _MOST_OBSTACLES:
                raise InputError(
                    f"obstacles: got {len(state.obstacles)}, wanted at most {_MOST_OBSTACLES}; send the nearest"
                )
            towed = self.way.reach(state, self._settings.braking)
            found = car_barriers(self._settings, state.footprint, state.obstacles, state.field, towed)
            return RememberingStack(stacked(found))
        if state.obstacles or state.field or state.footprint or state.towed:
            raise InputError("corridor: got one of a robot that drives between obstacles; wanted the one or the other")
        if len(state.values) != 2:  # a car must not get rid of its obstacles by naming a corridor
            raise InputError(
                f"corridor: got one and {len(state.values)} states, wanted a robot of angle and rate alone"
            )
        if len(state.corridor) != 2:
            raise InputError(f"corridor: got {len(state.corridor)} numbers, wanted 2: lower and upper edge")
        low, high = state.corridor
        return Barriers((CorridorBarrier(low, high, self._settings.corridor_seconds),))
