"""The barriers of what a car perceives: obstacles, field and speed limits, and what it tows in reverse."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf, isfinite
from typing import final

import numpy as np
from numpy.typing import NDArray

import safedpa.robots.car.written_barriers  # noqa: F401  now: it takes as long as a tick, and would be the first one's
from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.errors import InputError
from safedpa.operations import FLOATS
from safedpa.robots.car.barriers.moving_obstacles import MovingObstacleBarrier
from safedpa.robots.car.barriers.obstacles import car_barriers, with_towed_load
from safedpa.robots.car.barriers.reverse_odometer import ReverseOdometer
from safedpa.robots.car.dynamics.limits import IS_STATIONARY, ORDINARY, PerformanceLimits
from safedpa.robots.car.dynamics.throttle import BrakingByThrottle
from safedpa.robots.car.scenes.sensed import reversal_braking, sensed_barriers
from safedpa.runtime.scene import MOST_OBSTACLES, AbstractScene
from safedpa.safety.barriers.base import AbstractBarrierSet, Barriers, CachingBarrierSet
from safedpa.safety.barriers.stack import CompiledBarrierSet, make_barrier_set
from safedpa.safety.settings import FilterSettings

__all__ = ["CarScene"]

_PATIENCE = 0.2
"""s longer than braking takes from full speed."""


@final
class CarScene(AbstractScene):
    """Keeps the barriers while the scene stays as it is.

    Of a car that tows something the barriers are others with every state: ``way`` tells how far it was driven
    backwards. ``braking``: the backup of a car that does not brake by itself; None: the resting action brakes it, and
    among what its sensors see a speed command the other way round (``CounterBraking``). ``quick``: how quick its model
    is.
    """

    quick = True

    def __init__(
        self, settings: FilterSettings, braking: BrakingByThrottle | None = None, quick: PerformanceLimits = ORDINARY
    ) -> None:
        self._settings, self._quick, self.way = settings, quick, ReverseOdometer()
        self._braking, self._sensed = braking, 0.0
        self._counter = reversal_braking(settings, servo=braking is None)
        self.backup = braking or self._brake
        fastest = max(abs(settings.barrier("speed_low")), abs(settings.barrier("speed_high")))
        self._against = 0.0
        self._longest = _PATIENCE + float(self._counter.seconds(fastest, self._counter.numbers, FLOATS))
        self._seen = (-1, -1)
        self._scene: tuple[object, ...] = ()
        self._load: tuple[object, ...] = ()
        """What the barriers are made for: all that stays, and where the load is."""
        self._barriers: AbstractBarrierSet = Barriers(())
        self._stack: AbstractBarrierSet = self._barriers

    def _brake(self, state: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """The resting action, and among what sensors see, where someone may come, the harder one.

        Not for longer than braking takes: a car whose speed is told wrongly would be driven backwards.
        """
        if not self._sensed or self._against > self._longest:
            return self._settings.resting_action
        return self._counter.action(state, self._sensed)

    def _watch(self, state: StateMessage) -> None:
        """For how long it has been commanded against the motion that is told, or no one knows how it was.

        Only a car that is told to move as it was commanded is known to be told truly, so nothing else ends the count. A
        slow one is driven the other way half as fast at most, and comes to rest late: its seconds count half.
        """
        self._sensed = state.period if state.sources else 0.0
        epoch, tick = self._seen
        passed = state.period * max(state.tick - tick, 1) if state.epoch == epoch else state.period
        if state.epoch != epoch:
            self._against = 0.0
        if len(state.values) != len(MovingObstacleBarrier.reads) or not isfinite(state.values[3]):
            return
        speed = state.values[3]
        along = state.applied[0] * speed if state.applied else -inf
        if along < 0.0:
            self._against += passed if abs(speed) > IS_STATIONARY else 0.5 * passed
        elif along > 0.0 and abs(speed) > IS_STATIONARY:
            self._against = 0.0

    def follow(self, state: StateMessage) -> None:  # noqa: D102
        self.way.follow(state)
        if (state.epoch, state.tick) == self._seen:
            return
        self._watch(state)
        if self._braking is not None:
            self._braking.follow(state.values, state.period)
        self._seen = state.epoch, state.tick

    def of(self, state: StateMessage) -> AbstractBarrierSet | str:  # noqa: D102
        self.follow(state)
        load = (self.way.way, state.values) if state.towed else ()
        scene = (state.obstacles, state.field, state.footprint, state.corridor, state.towed)
        if load != self._load or scene != self._scene:
            try:
                self._stack = self._moved(state) if scene == self._scene else self._built(state)
            except InputError as error:
                return f"scene ({error})"
            self._barriers = CachingBarrierSet(self._stack)
            self._scene, self._load = scene, load
        return self._barriers

    def learn(self, latent: NDArray[np.float64] | None) -> None:  # noqa: D102
        if self._braking is not None:
            self._braking.learn(latent)

    def around(  # noqa: D102
        self,
        state: StateMessage,
        seen: SurroundingsMessage,
        epsilon: Mapping[str, float] | None = None,
        late: float = 0.0,
    ) -> AbstractBarrierSet | str:
        self.follow(state)
        if state.obstacles or state.corridor:
            return "surroundings (obstacles or a corridor are told next to sources; wanted one or the other)"
        try:
            towed = self.way.reach(state)
            found = sensed_barriers(self._settings, self._counter, state, seen, towed, epsilon, late, self._quick)
            self.yields_to, self.remark = found.yields_to, found.left_out
            return found.barriers
        except InputError as error:
            return f"surroundings ({error})"

    def remember(self, former: AbstractScene) -> None:
        """How far it was driven backwards, which decides where the load may stand, how fast it was, and for how long
        it has been commanded against that."""
        if isinstance(former, CarScene):
            self.way, self._seen, self._against = former.way, former._seen, former._against
            if self._braking is not None and former._braking is not None:
                self._braking.remember(former._braking)

    def _built(self, state: StateMessage) -> AbstractBarrierSet:
        if state.corridor:  # a car must not get rid of its obstacles by naming a corridor
            raise InputError(
                "corridor: got one of a robot that drives between obstacles; wanted these, and no corridor"
            )
        if len(state.obstacles) > MOST_OBSTACLES:
            raise InputError(
                f"obstacles: got {len(state.obstacles)}, wanted at most {MOST_OBSTACLES}; send the nearest"
            )
        towed = self.way.reach(state)
        return make_barrier_set(car_barriers(self._settings, state.footprint, state.obstacles, state.field, towed))

    def _moved(self, state: StateMessage) -> AbstractBarrierSet:
        """Those of the last tick, with the load where it is now: the lengths stay, so that it is there or it is not."""
        towed, stack = self.way.reach(state), self._stack
        if towed is None or not isinstance(stack, CompiledBarrierSet):
            return stack
        return CompiledBarrierSet(with_towed_load(stack.equations, towed), stack)
