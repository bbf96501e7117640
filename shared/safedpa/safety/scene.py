"""The barriers of what a robot perceives: a car's obstacles, field and speed limits; a pendulum's corridor."""

from __future__ import annotations

from collections.abc import Callable
from typing import Final, TypeAlias, final

from safedpa.bus import StateMessage
from safedpa.errors import InputError
from safedpa.safety.barrier import AbstractStack, Barriers, RememberingStack
from safedpa.safety.car_barriers import car_barriers
from safedpa.safety.car_stack import stacked
from safedpa.safety.corridor_barrier import CorridorBarrier
from safedpa.safety.reversed_way import ReversedWay
from safedpa.safety.settings import FilterSettings
from safedpa.systems import CAR, PENDULUM, POINT, System

__all__ = ["SceneBarriers", "is_of"]

_MOST_OBSTACLES = 64
"""A decision about so many takes 5 ms at the worst; a thousand, all of them at hand, take three seconds, in
which the other robots of the fleet would get no action."""


def is_of(system: System, known: System) -> bool:
    """Whether a system has the states and actions of a known one, whatever its name: then barriers fit both."""
    return (system.state_names, system.action_names) == (known.state_names, known.action_names)


@final
class SceneBarriers:
    """Builds barriers from state messages, and keeps them while the scene stays as it is.

    A car tells of obstacles, a field and its footprint, a pendulum of its corridor. Which of them a robot is follows
    from its states and actions. Of a robot that tows something the barriers are others with every state: ``way`` tells
    how far it was driven backwards. Raises InputError for every other system: its barriers would have to be written
    first.
    """

    def __init__(self, settings: FilterSettings, system: System, way: ReversedWay | None = None) -> None:
        self._settings, self.way = settings, way or ReversedWay()
        self._build = _builder(system)
        self.stands = is_of(system, CAR)
        """Whether the backup action brings the robot to rest."""
        self._scene: tuple[object, ...] = ()
        self._barriers: AbstractStack = Barriers(())

    def of(self, state: StateMessage) -> AbstractStack | str:
        """The barriers around this robot, or a sentence about what cannot be a scene of it."""
        self.way.follow(state)
        towing = (self.way.way, state.values) if state.towed else ()
        scene = (state.obstacles, state.field, state.footprint, state.corridor, state.towed, towing)
        if scene != self._scene:
            try:
                self._barriers = self._build(state, self._settings, self.way)
            except InputError as error:
                return f"scene ({error})"
            self._scene = scene
        return self._barriers


def _of_car(state: StateMessage, settings: FilterSettings, way: ReversedWay) -> AbstractStack:
    if state.corridor:  # a car must not get rid of its obstacles by naming a corridor
        raise InputError("corridor: got one of a robot that drives between obstacles; wanted these, and no corridor")
    if len(state.obstacles) > _MOST_OBSTACLES:
        raise InputError(f"obstacles: got {len(state.obstacles)}, wanted at most {_MOST_OBSTACLES}; send the nearest")
    towed = way.reach(state, settings.braking)
    found = car_barriers(settings, state.footprint, state.obstacles, state.field, towed)
    return RememberingStack(stacked(found))


def _of_pendulum(state: StateMessage, settings: FilterSettings, way: ReversedWay) -> AbstractStack:
    if state.obstacles or state.field or state.footprint or state.towed:
        raise InputError("corridor: got obstacles, a field or a footprint of a robot that does not drive; wanted none")
    if len(state.corridor) != 2:
        raise InputError(f"corridor: got {len(state.corridor)} numbers, wanted 2: lower and upper edge")
    low, high = state.corridor
    return Barriers((CorridorBarrier(low, high, settings.corridor_seconds),))


_Builder: TypeAlias = Callable[[StateMessage, FilterSettings, ReversedWay], AbstractStack]
_BUILDERS: Final[tuple[tuple[System, _Builder], ...]] = ((CAR, _of_car), (PENDULUM, _of_pendulum))


def _builder(system: System) -> _Builder:
    for known, build in _BUILDERS:
        if is_of(system, known):
            return build
    told = "; ".join(f"{', '.join(item.state_names)} with {', '.join(item.action_names)}" for item in _DRIVEN)
    raise InputError(
        f"model: of the system '{system.name}', {', '.join(system.state_names)} with "
        f"{', '.join(system.action_names) or 'no action'}; the service has barriers for {told}; filter others with the "
        "library, which takes barriers of your own"
    )


_DRIVEN: Final = (CAR, PENDULUM, POINT)
