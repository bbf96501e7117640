"""The car's scene: barriers from each state message, from known obstacles or from perceived surroundings."""

from __future__ import annotations

from collections.abc import Mapping
from math import inf, isfinite
from typing import final

import numpy as np
from numpy.typing import NDArray

from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.errors import InputError
from safedpa.operations import FLOATS
from safedpa.robots.car import shipped_rows
from safedpa.robots.car.barriers.moving_obstacles import MovingObstacleBarrier
from safedpa.robots.car.barriers.obstacles import car_barriers, with_towed_load
from safedpa.robots.car.barriers.reverse_odometer import ReverseOdometer
from safedpa.robots.car.dynamics.limits import IS_STATIONARY, ORDINARY, PerformanceLimits
from safedpa.robots.car.dynamics.throttle import BrakingByThrottle
from safedpa.robots.car.scenes.sensed import reversal_braking, sensed_barriers
from safedpa.runtime.scene import MOST_OBSTACLES, AbstractScene
from safedpa.safety.barriers.base import AbstractBarrierSet, Barriers, CachingBarrierSet
from safedpa.safety.barriers.disc_selection import load_selection
from safedpa.safety.barriers.equation import rows_of
from safedpa.safety.barriers.stack import CompiledBarrierSet, make_barrier_set
from safedpa.safety.settings import FilterSettings

_PATIENCE = 0.2
"""s; the harder brake may act this much longer than braking from full speed takes."""


@final
class CarScene(AbstractScene):
    """The barriers of a car; they are cached while the scene does not change.

    With a towed load the barriers depend on the state, because ``way`` tracks how far the car was driven backwards.
    ``braking`` is the backup controller of a car with a throttle. With None, the backup is the resting action, or, in
    perceived surroundings, ``ReversalBraking``. ``quick`` holds the performance limits of the car's model.
    """

    quick = True
    senses = True

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
        """Cache keys of the barriers: the scene, and the position of the load."""
        self._barriers: AbstractBarrierSet = Barriers(())
        self._stack: AbstractBarrierSet = self._barriers

    def prepare(self) -> None:  # noqa: D102
        for pattern in shipped_rows.patterns():
            rows_of(pattern, shipped_rows.STATES).prepare()
        load_selection()

    def _brake(self, state: NDArray[np.float64] | None) -> NDArray[np.float64]:
        """Returns the resting action; in perceived surroundings, where movers are possible, the harder brake.

        The harder brake is limited to the time that braking takes; otherwise a car with a faulty speed sensor would be
        driven backwards.
        """
        if not self._sensed or self._against > self._longest:
            return self._settings.resting_action
        return self._counter.action(state, self._sensed)

    def _watch(self, state: StateMessage) -> None:
        """Updates ``_against``: how long the car has been commanded against its reported motion.

        Only motion in the commanded direction shows that the reported speed is right, so nothing else resets the time.
        Below ``IS_STATIONARY`` the command is weaker and braking takes longer, so this time counts half.
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
            return "surroundings (obstacles or a corridor are reported next to sensor sources; wanted one of them)"
        try:
            towed = self.way.reach(state)
            found = sensed_barriers(self._settings, self._counter, state, seen, towed, epsilon, late, self._quick)
            self.yields_to, self.remark = found.yields_to, found.left_out
            return found.barriers
        except InputError as error:
            return f"surroundings ({error})"

    def remember(self, former: AbstractScene) -> None:
        """Takes over the reverse odometer, which determines where the load may be, and the state of the brakes."""
        if isinstance(former, CarScene):
            self.way, self._seen, self._against = former.way, former._seen, former._against
            if self._braking is not None and former._braking is not None:
                self._braking.remember(former._braking)

    def _built(self, state: StateMessage) -> AbstractBarrierSet:
        if state.corridor:  # a message must not disable the obstacles by reporting a corridor
            raise InputError("corridor: got one from a robot with obstacles; wanted obstacles and no corridor")
        if len(state.obstacles) > MOST_OBSTACLES:
            raise InputError(
                f"obstacles: got {len(state.obstacles)}, wanted at most {MOST_OBSTACLES}; send the nearest"
            )
        towed = self.way.reach(state)
        return make_barrier_set(car_barriers(self._settings, state.footprint, state.obstacles, state.field, towed))

    def _moved(self, state: StateMessage) -> AbstractBarrierSet:
        """Returns the last tick's barriers with the current position of the load; hitching changes the scene."""
        towed, stack = self.way.reach(state), self._stack
        if towed is None or not isinstance(stack, CompiledBarrierSet):
            return stack
        return CompiledBarrierSet(with_towed_load(stack.equations, towed), stack)
