"""What a model makes of many point robots at once: the filter's f + g a and how its stopping manoeuvre would go.

Actions here lie in [-1, 1]: a thrust of up to 0.015 N and a turn of up to 3 rad/s, the most that the body does.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, Protocol, final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import PhysicsModel
from safedpa.networks import LearnedNetworks, Weights
from safedpa.safety.stopping_barrier import Motion
from safedpa_sim.point.body import CONTROL_SECONDS, POINT_BODY
from safedpa_sim.point.body_steps import LARGEST_TURN, controls_of
from safedpa_sim.point.simulation import PointSimulation

__all__ = [
    "ACTION_SCALE",
    "PROBES",
    "Belief",
    "Believed",
    "LearnedBelief",
    "ModelBelief",
    "TrueBelief",
    "from_task_action",
    "motion_of",
    "to_task_action",
]

Floats = NDArray[np.float64]

ACTION_SCALE: Final = np.array([POINT_BODY.largest_thrust, LARGEST_TURN])
"""N and rad/s of the action 1."""
_TASK_TURN: Final = float(controls_of(ACTION_SCALE[np.newaxis])[1, 0])
"""The task's action for the fastest turn; what lies beyond turns no faster."""
_HEADINGS: Final = 0.5 * np.pi * np.arange(4)
_FAST: Final = 1.0
"""m/s of the two states that show the drag."""
PROBES: Final = np.zeros((6, 5))
"""States at which a model shows how the robot moves: at rest with each heading, and along the heading to and fro."""
PROBES[:4, 2] = _HEADINGS
PROBES[4:, 3] = _FAST, -_FAST


def to_task_action(action: Floats) -> Floats:
    """Actions (robots, 2) of this module as those of ``PointTask``."""
    scaled: Floats = action * np.array([1.0, _TASK_TURN])
    return scaled


def from_task_action(action: Floats) -> Floats:
    """Actions (robots, 2) of ``PointTask`` as those of this module; a turn beyond the fastest is the fastest."""
    scaled: Floats = np.clip(np.asarray(action, dtype=np.float64) / np.array([1.0, _TASK_TURN]), -1.0, 1.0)
    return scaled


@final
@dataclass(frozen=True)
class Believed:
    """What a model says at the present states: x[t+1] = drift + gain a, and how the manoeuvre would go."""

    drift: Floats
    """(robots, 5)."""
    gain: Floats
    """(robots, 5, 2) over actions in [-1, 1]."""
    motion: Motion
    scale: Floats
    """(2,) thrust acceleration [m/s2] and turn [rad/s] of the action 1."""

    def next_state(self, action: Floats) -> Floats:
        """(robots, 5) after actions (robots, 2)."""
        following: Floats = self.drift + np.einsum("rsa,ra->rs", self.gain, action)
        return following


class Belief(Protocol):
    """A model of the robots, as the filter asks for it."""

    def believed(self, state: Floats, latent: Floats) -> Believed:
        """For states (robots, 5) and latents (robots, latents); a model without a latent does not look at it."""


@final
class LearnedBelief:
    """f, g of learned networks; the manoeuvre's motion is what they say at the probe states (see ``motion_of``)."""

    def __init__(self, weights: Weights) -> None:
        self.networks = LearnedNetworks(weights)
        self._latents = weights.description.latents
        self._alone = None if self._latents else self._motion(np.zeros((1, 0)))

    def believed(self, state: Floats, latent: Floats) -> Believed:  # noqa: D102
        latent = latent if self._latents else np.zeros((len(state), 0))
        f, g = self.networks.increment(state, latent)
        motion = self._motion(latent) if self._alone is None else self._alone
        return Believed(state + f, g * ACTION_SCALE, motion, _scale(motion))

    def _motion(self, latent: Floats) -> Motion:
        f, g = self.networks.increment(np.broadcast_to(PROBES, (len(latent), *PROBES.shape)), latent[:, np.newaxis])
        return motion_of(f, g * ACTION_SCALE)


@final
class ModelBelief:
    """f, g of a physics model, as the car's filter takes them: from a file, a diagnosis, by hand."""

    def __init__(self, model: PhysicsModel) -> None:
        self._model = model
        f, g = self._increment(PROBES)
        self._motion = motion_of(f[np.newaxis], g[np.newaxis])

    def believed(self, state: Floats, latent: Floats) -> Believed:  # noqa: D102
        del latent
        f, g = self._increment(state)
        return Believed(state + f, g, self._motion, _scale(self._motion))

    def _increment(self, state: Floats) -> tuple[Floats, Floats]:
        """Increments without action (robots, 5), and their slopes over actions in [-1, 1] (robots, 5, 2)."""
        resting = self._after(state, np.zeros(2))
        slopes = []
        for action in ACTION_SCALE * np.eye(2):
            slopes.append(0.5 * (self._after(state, action) - self._after(state, -action)))
        return resting - state, np.stack(slopes, axis=-1)

    def _after(self, state: Floats, action: Floats) -> Floats:
        actions = np.broadcast_to(action, (len(state), 2))
        following: Floats = self._model.advance(state, actions, self._model.initial_memory(actions))[0]
        return following


def motion_of(f: Floats, g: Floats) -> Motion:
    """The manoeuvre's motion from f (robots, 6, 5) and g (robots, 6, 5, 2) at the six probe states ``PROBES``:

        at rest, heading 0, 90, 180, 270 degrees:  wind = mean of f_v / A,  strongest = mean of g_v / A
        heading 0, along it at 1 and -1 m/s:       exp(-drag dt) - 1 = half the difference of f_v

    with A = (1 - exp(-drag dt)) / drag: what a period makes of an acceleration.
    """
    slope = np.clip(0.5 * (f[:, 4, 3] - f[:, 5, 3]) / _FAST, -0.5, -1e-6)
    drag = -np.log1p(slope) / CONTROL_SECONDS
    gained = -slope / drag
    wind = f[:, :4, 3:].mean(axis=1).T / gained
    heading = np.stack((np.cos(_HEADINGS), np.sin(_HEADINGS)), axis=1)
    strongest = np.einsum("rhv,hv->r", g[:, :4, 3:, 0], heading) / 4.0 / gained
    if len(f) == 1:
        return Motion(wind[:, 0], float(drag[0]), float(strongest[0]), LARGEST_TURN, POINT_BODY.centre_ahead)
    return Motion(wind, drag, strongest, LARGEST_TURN, POINT_BODY.centre_ahead)


def _scale(motion: Motion) -> Floats:
    return np.array([float(np.mean(motion.strongest)), LARGEST_TURN])


@final
class TrueBelief:
    """The physics of the simulated robots themselves, told to the filter; without ``wind``, all of it but the wind.

    v' = E v + A (wind + thrust (cos, sin) + drag c turn (-sin, cos)),  E = exp(-drag dt), A = (1 - E) / drag, since the
    drag acts at the middle, c behind the centre of mass.
    """

    def __init__(self, simulation: PointSimulation, *, wind: bool = True) -> None:
        self._simulation, self._wind = simulation, wind

    def believed(self, state: Floats, latent: Floats) -> Believed:  # noqa: D102
        del latent
        body, simulation = self._simulation.body, self._simulation
        wind = simulation.force / body.mass * self._wind
        drag = (body.slide_damping + simulation.extra_damping) / body.mass
        strongest = body.largest_thrust / body.mass * simulation.strength
        motion = Motion(wind, drag, strongest, LARGEST_TURN, body.centre_ahead)
        drift, gain = _affine(state, motion)
        return Believed(drift, gain, motion, np.array([float(strongest.mean()), LARGEST_TURN]))


def _affine(state: Floats, motion: Motion) -> tuple[Floats, Floats]:
    """(drift (robots, 5), gain (robots, 5, 2)) of one period of the point mass."""
    drag, seconds = motion.drag, CONTROL_SECONDS
    kept = np.exp(-drag * seconds)
    gained = (1.0 - kept) / drag
    moved = (seconds - gained) / drag
    velocity = state[:, 3:].T
    drift = state.copy()
    drift[:, :2] += (gained * velocity + moved * motion.wind).T
    drift[:, 3:] = (kept * velocity + gained * motion.wind).T
    heading = np.stack((np.cos(state[:, 2]), np.sin(state[:, 2])))
    aside = np.stack((-heading[1], heading[0]))
    swing = drag * motion.ahead * motion.fastest
    gain = np.zeros((len(state), 5, 2))
    gain[:, :2, 0], gain[:, 3:, 0] = (motion.strongest * moved * heading).T, (motion.strongest * gained * heading).T
    gain[:, :2, 1], gain[:, 3:, 1] = (swing * moved * aside).T, (swing * gained * aside).T
    gain[:, 2, 1] = seconds * motion.fastest
    return drift, gain
