"""What the models that are compared make of many point robots: learned networks, by name, or a physics model.

Their stopping manoeuvre is what they say at six probe states.
"""

from __future__ import annotations

from pathlib import Path
from typing import Final, final

import numpy as np

from safedpa.arrays import FloatArray
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.dynamics.learned_base import LearnedBase
from safedpa.errors import InputError
from safedpa.networks import LearnedNetworks, Weights
from safedpa.safety.barriers.stopping import Motion
from safedpa_sim.point.body import CONTROL_SECONDS, POINT_BODY
from safedpa_sim.point.filtering import ACTION_SCALE, TASK_TURN, PointPrediction
from safedpa_sim.point.simulation import LARGEST_TURN


def weights_named(name: str, folder: Path = Path()) -> Weights:
    """The weights of ``point_<name>`` in the folder, or else of the one that ships. Raises InputError for none."""
    file = folder / f"point_{name}.toml"
    try:
        model = load_model(file if file.exists() else f"point_{name}")
    except InputError as error:
        raise InputError(f"{file}: {error}; train it with 'safedpa train point'") from error
    if not isinstance(model.base, LearnedBase):
        raise InputError(f"point_{name}: got a model without networks, wanted one of 'safedpa train point'")
    return model.base.weights


_HEADINGS: Final = 0.5 * np.pi * np.arange(4)
_FAST: Final = 1.0
"""m/s of the two states that show the drag."""
PROBES: Final = np.zeros((6, 5))
"""States at which a model shows how the robot moves: at rest with each heading, and along the heading to and fro."""
PROBES[:4, 2] = _HEADINGS
PROBES[4:, 3] = _FAST, -_FAST


def from_task_action(action: FloatArray) -> FloatArray:
    """Actions (robots, 2) of ``PointTask`` as those in [-1, 1]; a turn beyond the fastest is the fastest."""
    scaled: FloatArray = np.clip(np.asarray(action, dtype=np.float64) / np.array([1.0, TASK_TURN]), -1.0, 1.0)
    return scaled


@final
class LearnedBelief:
    """f, g of learned networks; the manoeuvre's motion is what they say at the probe states (see ``motion_of``)."""

    def __init__(self, weights: Weights) -> None:
        self.networks = LearnedNetworks(weights)
        self._latents = weights.description.latents
        self._alone = None if self._latents else self._motion(np.zeros((1, 0)))

    def predict(self, state: FloatArray, latent: FloatArray) -> PointPrediction:  # noqa: D102
        latent = latent if self._latents else np.zeros((len(state), 0))
        f, g = self.networks.increment(state, latent)
        motion = self._motion(latent) if self._alone is None else self._alone
        return PointPrediction(state + f, g * ACTION_SCALE, motion, scale_of(motion))

    def _motion(self, latent: FloatArray) -> Motion:
        f, g = self.networks.increment(np.broadcast_to(PROBES, (len(latent), *PROBES.shape)), latent[:, np.newaxis])
        return motion_of(f, g * ACTION_SCALE)


@final
class ModelBelief:
    """f, g of a physics model, as the car's filter takes them: from a file, a diagnosis, by hand."""

    def __init__(self, model: PhysicsModel) -> None:
        self._model = model
        f, g = self._increment(PROBES)
        self._motion = motion_of(f[np.newaxis], g[np.newaxis])

    def predict(self, state: FloatArray, latent: FloatArray) -> PointPrediction:  # noqa: D102
        del latent
        f, g = self._increment(state)
        return PointPrediction(state + f, g, self._motion, scale_of(self._motion))

    def _increment(self, state: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Increments without action (robots, 5), and their slopes over actions in [-1, 1] (robots, 5, 2)."""
        resting = self._after(state, np.zeros(2))
        slopes = []
        for action in ACTION_SCALE * np.eye(2):
            slopes.append(0.5 * (self._after(state, action) - self._after(state, -action)))
        return resting - state, np.stack(slopes, axis=-1)

    def _after(self, state: FloatArray, action: FloatArray) -> FloatArray:
        actions = np.broadcast_to(action, (len(state), 2))
        following: FloatArray = self._model.advance(state, actions, self._model.initial_memory(actions))[0]
        return following


def motion_of(f: FloatArray, g: FloatArray) -> Motion:
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


def scale_of(motion: Motion) -> FloatArray:
    """(2,) thrust acceleration [m/s2] and turn [rad/s] of the action 1."""
    return np.array([float(np.mean(motion.strongest)), LARGEST_TURN])
