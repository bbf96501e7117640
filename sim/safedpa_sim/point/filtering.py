"""The safety filter for batches of point robots: ``BatchFilter`` with the barriers of the stopping manoeuvre.

A model predicts f + g a and the motion parameters of the manoeuvre. Actions are in [-1, 1], scaled by the body's
limits: a thrust of 0.015 N and a turn rate of 3 rad/s.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Final, Protocol, final

import numpy as np

from safedpa.arrays import BoolArray, FloatArray
from safedpa.robots.point.system import POINT
from safedpa.safety.barriers.stopping import Motion, StoppingBarrier, stopping_action
from safedpa.safety.batch.barriers import BatchStopping
from safedpa.safety.batch.filter import STATUSES, BatchFilter
from safedpa.safety.defaults import settings_named
from safedpa.safety.verdict import Status
from safedpa_sim.point.body import CONTROL_SECONDS, POINT_BODY
from safedpa_sim.point.layout import HAZARD_RADIUS
from safedpa_sim.point.simulation import LARGEST_TURN, PointSimulation, controls_of

ETA: Final = 0.5
"""eta of the filter in simulation; the robot on the bus uses a more conservative value."""
_PLAIN: Final = [STATUSES.index(status) for status in (Status.passed, Status.corrected)]


@final
@dataclass(frozen=True)
class FilteredActions:
    """Filtered actions (robots, 2) in [-1, 1], and for each robot whether the action was corrected, and whether a
    constraint was relaxed because not all could be satisfied."""

    action: FloatArray
    corrected: BoolArray
    relaxed: BoolArray


@final
class PointFilter:
    """The batched filter with margin ``epsilon`` [m]; actions are in [-1, 1], as in ``PointPrediction``."""

    def __init__(self, epsilon: float) -> None:
        settings = settings_named("point")
        own = replace(settings, eta=ETA, epsilon={"obstacle": epsilon}, action_low=(-1.0, -1.0), action_high=(1.0, 1.0))
        self._filter = BatchFilter(POINT, own)

    def decide(
        self, state: FloatArray, nominal: FloatArray, hazards: FloatArray, believed: PointPrediction
    ) -> FilteredActions:
        """Returns safe actions for states (robots, 5) and nominal actions (robots, 2) among hazards (robots, m, 2)."""
        around = around_hazards(hazards, believed.motion)

        def stopping(robot: int) -> FloatArray:
            motion = believed.motion.of(robot)
            end = StoppingBarrier(around.hazards[robot], motion).best_end(state[robot])
            thrust, turn = stopping_action(state[robot].reshape(5, 1), motion, np.array([end]))
            return np.array([thrust[0], turn[0]]) / believed.scale

        affine = believed.drift, believed.gain
        found = self._filter.decide(state, nominal, barriers=around, affine=affine, backup=stopping)
        changed = np.any(found.action != nominal, axis=1)
        return FilteredActions(found.action, changed, ~np.isin(found.status, _PLAIN))


def around_hazards(hazards: FloatArray, motion: Motion) -> BatchStopping:
    """Returns the barriers of robots among hazards (robots, m, 2)."""
    radii = np.full((*hazards.shape[:2], 1), HAZARD_RADIUS)
    return BatchStopping(np.concatenate((hazards, radii), axis=2), motion)


def minimum_barrier(state: FloatArray, hazards: FloatArray, motion: Motion) -> FloatArray:
    """Returns the minimum of h over hazards (n, m, 2), shape (n,) [m], at states (n, 5) for the modelled ``motion``."""
    least: FloatArray = around_hazards(hazards, motion).h(state).min(axis=1)
    return least


ACTION_SCALE: Final = np.array([POINT_BODY.largest_thrust, LARGEST_TURN])
"""N and rad/s per unit of action."""
TASK_TURN: Final = float(controls_of(ACTION_SCALE[np.newaxis])[1, 0])
"""The task's action for the fastest turn; larger ones turn no faster."""


def to_task_action(action: FloatArray) -> FloatArray:
    """Converts actions (robots, 2) of this module to those of ``PointTask``."""
    scaled: FloatArray = action * np.array([1.0, TASK_TURN])
    return scaled


@final
@dataclass(frozen=True)
class PointPrediction:
    """A model's prediction at the current states: x[t+1] = drift + gain a, and the motion when stopping."""

    drift: FloatArray
    """(robots, 5)."""
    gain: FloatArray
    """(robots, 5, 2) over actions in [-1, 1]."""
    motion: Motion
    scale: FloatArray
    """(2,): thrust acceleration [m/s2] and turn rate [rad/s] per unit of action."""

    def next_state(self, action: FloatArray) -> FloatArray:
        """Returns states (robots, 5) after actions (robots, 2)."""
        following: FloatArray = self.drift + np.einsum("rsa,ra->rs", self.gain, action)
        return following


class AbstractPointModel(Protocol):
    """The interface of a model that the filter uses."""

    def predict(self, state: FloatArray, latent: FloatArray) -> PointPrediction:
        """Predicts for states (robots, 5) and latents (robots, latents), which a model without a latent ignores."""


@final
class SimulatedPointModel:
    """The physics of the simulated robots themselves; with ``wind`` false, everything but the wind.

    v' = E v + A (wind + thrust (cos, sin) + drag c turn (-sin, cos)),  E = exp(-drag dt), A = (1 - E) / drag, because
    the drag acts at the geometric centre, c behind the centre of mass.
    """

    def __init__(self, simulation: PointSimulation, *, wind: bool = True) -> None:
        self._simulation, self._wind = simulation, wind

    def predict(self, state: FloatArray, latent: FloatArray) -> PointPrediction:  # noqa: D102
        del latent
        body, simulation = self._simulation.body, self._simulation
        wind = simulation.force / body.mass * self._wind
        drag = (body.slide_damping + simulation.extra_damping) / body.mass
        strongest = body.largest_thrust / body.mass * simulation.strength
        motion = Motion(wind, drag, strongest, LARGEST_TURN, body.centre_ahead)
        drift, gain = _affine(state, motion)
        return PointPrediction(drift, gain, motion, np.array([float(strongest.mean()), LARGEST_TURN]))


def _affine(state: FloatArray, motion: Motion) -> tuple[FloatArray, FloatArray]:
    """Returns drift (robots, 5) and gain (robots, 5, 2) of one period of the point mass."""
    drag, seconds = motion.drag, CONTROL_SECONDS
    retained = np.exp(-drag * seconds)
    gained = (1.0 - retained) / drag
    moved = (seconds - gained) / drag
    velocity = state[:, 3:].T
    drift = state.copy()
    drift[:, :2] += (gained * velocity + moved * motion.wind).T
    drift[:, 3:] = (retained * velocity + gained * motion.wind).T
    heading = np.stack((np.cos(state[:, 2]), np.sin(state[:, 2])))
    aside = np.stack((-heading[1], heading[0]))
    swing = drag * motion.ahead * motion.fastest
    gain = np.zeros((len(state), 5, 2))
    gain[:, :2, 0], gain[:, 3:, 0] = (motion.strongest * moved * heading).T, (motion.strongest * gained * heading).T
    gain[:, :2, 1], gain[:, 3:, 1] = (swing * moved * aside).T, (swing * gained * aside).T
    gain[:, 2, 1] = seconds * motion.fastest
    return drift, gain
