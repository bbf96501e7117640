"""The barriers of sensed surroundings for any planar robot, from its ``PlanarBody``.

A disc matters if an action of this tick may bring its h below what the constraint requires. In one period h falls at
most by F = |change of position| + rise of (D + growth + w T), at the state after any corner of the action bounds,
enlarged by ``_ENLARGED``; with dead time for as many periods as pass until then.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import product
from math import ceil, hypot, inf, isfinite
from typing import Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus import StateMessage, SurroundingsMessage
from safedpa.dynamics import AbstractDynamics
from safedpa.errors import InputError
from safedpa.safety.barriers.base import AbstractBarrier
from safedpa.safety.barriers.disc_selection import fastest_of
from safedpa.safety.barriers.planar_body import IS_STATIONARY, BodyPart, PlanarBody, SensedMovers, SensedPoints
from safedpa.safety.barriers.sensed_selection import Vicinity, remark_about, select_movers, select_points
from safedpa.safety.settings import FilterSettings

__all__ = ["PlanarSensing"]

_ENLARGED: Final = 1.25
_WIDENED: Final = 2.0
"""Factor of the margin, because an online margin may increase before the decision."""
_MOST_ACTIONS: Final = 6
"""Largest number of actions whose corners are tried; with more of them every disc counts as near."""


@final
class PlanarSensing:
    """Builds the barriers of sensed surroundings for robots with this body, model and settings.

    Raises InputError if the body names a state that the model does not have.
    """

    def __init__(self, body: PlanarBody, model: AbstractDynamics, settings: FilterSettings) -> None:
        self._body, self._model, self._settings = body, model, settings
        self._states = model.system.state_names
        index = {name: place for place, name in enumerate(self._states)}
        body.form(self._states, ())
        self._position = [index[name] for name in body.pose[:2]]
        self._begins = tuple(self._states[:3]) == body.pose
        """Whether the state begins with the pose, as perception assumes without a pose in the message."""
        self._velocity = [index[name] for name in body.velocity]
        self._turn = index[body.turn_rate] if body.turn_rate else -1
        bounds = list(zip(settings.action_low, settings.action_high, strict=True))
        self._corners = [np.array(corner) for corner in product(*bounds)] if len(bounds) <= _MOST_ACTIONS else []
        self._latent: FloatArray | None = None
        self.yields_to = ""
        """As ``AbstractScene.yields_to``."""
        self.remark = ""
        """As ``AbstractScene.remark``."""

    def learn(self, latent: FloatArray | None) -> None:
        """Sets the newest latent (latents,)."""
        self._latent = latent

    def barriers(
        self, state: StateMessage, seen: SurroundingsMessage, epsilon: Mapping[str, float] | None, late: float
    ) -> list[AbstractBarrier]:
        """Returns the barriers of the discs that matter. Raises InputError for invalid rows or an unknown body."""
        body = self._body
        if not state.pose and not self._begins:
            raise InputError(f"state: got no pose, wanted one, since its values are {', '.join(self._states)}")
        parts = body.parts_of(state.footprint)
        still = SensedPoints((), body, parts, self._states)
        movers = SensedMovers((), (), body, parts, self._states)
        fastest = fastest_of(seen.movers, seen.hidden)
        margins = {**self._settings.epsilon, **(epsilon or {})}
        common = margins.get("default", 0.0)
        points_near = self._vicinity(state, parts, margins.get(still.kind, common), late, 0.0, self._settings.eta)
        movers_near = self._vicinity(state, parts, margins.get(movers.kind, common), late, fastest, 1.0)
        chosen = select_points(still, seen.points, body.clearance, points_near)
        shared = (*movers.shared[:6], 0.0, *movers.shared[7:])  # without creeping
        stands = bool(movers_near.values) and self._speed(state.values) <= IS_STATIONARY
        moving = select_movers(
            movers.with_shared(shared), seen.movers, seen.hidden, body.clearance, state.period, movers_near, stands
        )
        self.yields_to, self.remark = moving.yields_to, remark_about(chosen.left_out, moving.left_out)
        return [still.with_items(chosen.discs, chosen.names), movers.with_items(moving.discs, moving.names)]

    def _speed(self, values: Sequence[float]) -> float:
        if not self._velocity:
            return self._body.largest_speed
        return hypot(*(values[place] for place in self._velocity))

    def _spent(self, values: Sequence[float], arm: float, fastest: float) -> float:
        """Returns D + growth + w T [m] at a state: by how much h is below the distance from the standing body."""
        body, speed = self._body, self._speed(values)
        turned = abs(values[self._turn]) if self._turn >= 0 else 0.0
        if body.track:
            # Of the faster wheel: the sum of both bounds contains the body's.
            speed += 0.5 * body.track * turned
        way = self._distance(speed)
        angle = 2.0 * way / body.track if body.track and turned else turned * body.turning
        return way + (arm + way) * angle + fastest * body.seconds(speed)

    def _distance(self, speed: float) -> float:
        deceleration, gain = self._body.deceleration, self._body.gain
        corner = deceleration / gain
        if speed <= corner:
            return speed / gain
        return corner / gain + (speed * speed - corner * corner) / (2.0 * deceleration)

    def _vicinity(
        self, state: StateMessage, parts: Sequence[BodyPart], epsilon: float, late: float, fastest: float, eta: float
    ) -> Vicinity:
        """Returns where discs of speed up to ``fastest`` [m/s] matter; everywhere if the state is unknown."""
        values = state.values
        if len(values) != len(self._states) or not all(map(isfinite, values)):
            return Vicinity()
        arm, reach = max(part.arm for part in parts), max(part.reach for part in parts)
        now = self._spent(values, arm, fastest)
        start, after = np.array(values), [tuple(values)]
        fall = 0.0 if self._corners else inf
        for corner in self._corners:
            end = np.asarray(self._model.step(start, corner, self._latent), dtype=np.float64)
            if not np.isfinite(end).all():
                return Vicinity()
            after.append(tuple(end.tolist()))
            moved = hypot(*(float(end[place] - start[place]) for place in self._position))
            fall = max(fall, moved + max(self._spent(after[-1], arm, fastest) - now, 0.0))
        fall *= _ENLARGED
        # Each further period may be faster than the one before by as much as the first.
        late_falls = sum(fall * (1.0 + later) for later in range(ceil(late / self._model.period)))
        limit = late_falls + (fall * (1.0 + ceil(late / self._model.period)) + _WIDENED * epsilon) / eta
        x, y = (values[place] for place in self._position)
        return Vicinity(x, y, limit + reach + now, limit, tuple(values), tuple(after), 0.0)
