"""The pendulum's scene: the barrier of the corridor that its angle must not leave."""

from __future__ import annotations

from typing import final

from safedpa.bus import StateMessage
from safedpa.errors import InputError
from safedpa.runtime.scene import AbstractScene
from safedpa.safety.barriers.base import AbstractBarrierSet, Barriers
from safedpa.safety.barriers.limits import CorridorBarrier
from safedpa.safety.barriers.stack import make_barrier_set
from safedpa.safety.settings import FilterSettings

_STATES = 2


@final
class PendulumScene(AbstractScene):
    """The barrier of the corridor, cached until the corridor changes; the resting torque cannot stop a pendulum."""

    can_stop = False
    quick = True

    def __init__(self, settings: FilterSettings) -> None:
        self._settings = settings
        self._corridor: tuple[float, ...] = ()
        self._barriers: AbstractBarrierSet = Barriers(())
        # Records the equation now, so that the first tick is not delayed.
        make_barrier_set((CorridorBarrier(-1.0, 1.0, 1.0),)).scalar_rows(_STATES)

    def of(self, state: StateMessage) -> AbstractBarrierSet | str:  # noqa: D102
        if state.obstacles or state.field or state.footprint or state.towed:
            return "scene (corridor: got obstacles, a field or a footprint of a robot that does not drive; wanted none)"
        if len(state.corridor) != 2:
            return f"scene (corridor: got {len(state.corridor)} numbers, wanted 2: lower and upper edge)"
        if state.corridor != self._corridor:
            low, high = state.corridor
            try:
                self._barriers = make_barrier_set(
                    (CorridorBarrier(low, high, self._settings.barrier("corridor_seconds")),)
                )
            except InputError as error:
                return f"scene ({error})"
            self._corridor = state.corridor
        return self._barriers
