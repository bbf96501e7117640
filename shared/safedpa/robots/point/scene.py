"""The barriers of the point robot, and its backup: the stopping manoeuvre in the current wind.

The parameters of the manoeuvre are identified from any model by probing it at a few states:

    at rest, heading 0, 90, 180, 270 degrees:  wind = mean change of velocity without thrust / A
                                               strongest = mean derivative over the thrust, along the heading / A
    heading 0, at 1 and -1 m/s along it:       exp(-drag period) - 1 = half the difference of the changes

with A = (1 - exp(-drag period)) / drag, the change of velocity per acceleration in one period.
"""

from __future__ import annotations

from typing import Any, Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.bus import StateMessage
from safedpa.dynamics import AbstractDynamics
from safedpa.errors import InputError
from safedpa.runtime.scene import MOST_OBSTACLES, AbstractScene
from safedpa.safety.barriers.base import AbstractBarrierSet, Barriers, CachingBarrierSet
from safedpa.safety.barriers.stopping import Motion, StoppingBarrier, nearer_end, stop_seconds, stopping_action
from safedpa.safety.settings import FilterSettings

_HEADINGS: Final = 0.5 * np.pi * np.arange(4)
_LEAST_SLOPE, _MOST_SLOPE = 1e-6, 0.5
"""Bounds of the share of the speed lost to drag in a period; identified values are clipped to them."""


def motion_of(model: AbstractDynamics, latent: FloatArray | None, settings: FilterSettings, period: float) -> Motion:
    """Identifies wind, drag and thrust of the manoeuvre from a model of x, y, yaw, vx, vy under thrust and turn.

    Raises InputError when the thrust does not accelerate along the heading.
    """
    probes = np.zeros((6, 5))
    probes[:4, 2] = _HEADINGS
    probes[4:, 3] = 1.0, -1.0
    pairs = [model.affine(probe, latent, around=np.zeros(2)) for probe in probes]
    drift = np.array([np.asarray(f) for f, _ in pairs]) - probes
    slope = min(max(-0.5 * float(drift[4, 3] - drift[5, 3]), _LEAST_SLOPE), _MOST_SLOPE)
    drag = -np.log1p(-slope) / period
    gained = slope / drag
    heading = np.stack((np.cos(_HEADINGS), np.sin(_HEADINGS)), axis=1)
    gain = np.array([np.asarray(g)[3:, 0] for _, g in pairs[:4]])
    along = float(np.mean(np.sum(gain * heading, axis=1))) / gained
    if not along > 0.0:
        raise InputError(f"model: got {along} m/s2 along the heading for a newton of thrust, wanted more than 0")
    strongest = along * min(settings.action_high[0], -settings.action_low[0])
    fastest = min(settings.action_high[1], -settings.action_low[1])
    return Motion(drift[:4, 3:].mean(axis=0) / gained, drag, strongest, fastest)


@final
class PointScene(AbstractScene):
    """Builds the barriers from a state message and the newest latent; ``backup`` stops the robot in that wind."""

    def __init__(self, model: AbstractDynamics, settings: FilterSettings) -> None:
        self.backup = self._stopping
        self._model, self._settings = model, settings
        self._latent: FloatArray | None = None
        self._motion: Motion | None = None
        self._barrier: StoppingBarrier | None = None

    def learn(self, latent: FloatArray | None) -> None:  # noqa: D102
        self._latent = latent

    def of(self, state: StateMessage) -> AbstractBarrierSet | str:  # noqa: D102
        try:
            return self._built(state)
        except InputError as error:
            self._barrier = None
            return f"scene ({error})"

    def _stopping(self, state: FloatArray | None) -> FloatArray:
        """Returns the manoeuvre's (thrust [N], turn [rad/s]) at ``state``, the resting action at an unknown one."""
        motion, barrier = self._motion, self._barrier
        if state is None or motion is None:
            return self._settings.resting_action
        end = nearer_end(state, motion) if barrier is None else barrier.best_end(state)
        seconds = stop_seconds(float(motion.drag), self._model.period)
        thrust, turn = stopping_action(np.reshape(state, (5, 1)), motion, np.array([end]), seconds)
        scale = self._settings.action_high[0] / float(motion.strongest)
        return np.array([scale * float(thrust[0]), float(turn[0])])

    def _built(self, state: StateMessage) -> AbstractBarrierSet:
        if state.corridor or state.field or state.footprint:
            raise InputError("got a corridor, a field or a footprint, wanted hazards only")
        if len(state.obstacles) > MOST_OBSTACLES:
            raise InputError(
                f"obstacles: got {len(state.obstacles)}, wanted at most {MOST_OBSTACLES}; send the nearest"
            )
        rows: list[Any] = [list(row) for row in state.obstacles]
        for row in rows:
            if len(row) != 3 or not np.all(np.isfinite(row)) or row[2] < 0.0:
                raise InputError(f"obstacles: got {row}, wanted x, y and a radius of 0 or more, finite")
        self._motion = motion_of(self._model, self._latent, self._settings, state.period)
        if not rows:
            self._barrier = None
            return Barriers(())
        grown = np.array(rows, dtype=np.float64) + np.array([0.0, 0.0, self._settings.barrier("clearance")])
        self._barrier = StoppingBarrier(grown, self._motion)
        return CachingBarrierSet(Barriers((self._barrier,)))
