"""Moments of drives near hazards, with what was lived through before: where models are asked what would come next."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.adaptation.batch_history_estimator import BatchHistoryEstimator
from safedpa.arrays import FloatArray
from safedpa.networks import Weights
from safedpa.safety.barriers.stopping import Motion
from safedpa_lab.point.beliefs import from_task_action
from safedpa_lab.point.shield import Shield
from safedpa_sim.point.body import POINT_BODY
from safedpa_sim.point.body_steps import LARGEST_TURN, centre_state
from safedpa_sim.point.filtering import minimum_barrier
from safedpa_sim.point.point_model import ACTION_SCALE, SimulatedPointModel
from safedpa_sim.point.task import PointTask

__all__ = ["Moments", "drawn_moments"]


_HELD: Final = 25
"""Periods for which a nominal action is held: redrawn in each period it would lead nowhere."""
_NEAR: Final = 0.1
"""m of h below which a moment counts as near a hazard."""


@final
@dataclass(frozen=True)
class Moments:
    """n robots: how they are, in which wind, and what they did then; transitions of one period each."""

    state: FloatArray
    """(n, 5), centre of mass."""
    rate: FloatArray
    """(n,) rad/s, the yaw rate on top."""
    latent: FloatArray
    """(n, latents), of the history up to then."""
    wind: FloatArray
    """(n, 2) m/s2."""
    hazards: FloatArray
    """(n, hazards, 2)."""
    action: FloatArray
    """(n, 2) in [-1, 1]: what was done."""
    following: FloatArray
    """(n, 5): what came of it."""

    def motion(self) -> Motion:
        """The true one."""
        body = POINT_BODY
        drag, strongest = body.slide_damping / body.mass, body.largest_thrust / body.mass
        return Motion(self.wind.T, drag, strongest, LARGEST_TURN, body.centre_ahead)

    def of(self, which: NDArray[np.intp]) -> Moments:
        """Those of the given indices; an index may come again."""
        return Moments(*(getattr(self, name)[which] for name in Moments.__dataclass_fields__))


def drawn_moments(
    weights: Weights, *, robots: int, steps: int, seed: int, force: float, direction: float | None = None
) -> Moments:
    """Every tenth period of drives under nominal actions at random, where 0 < h < 0.1 m and the history is full.

    The filter knows the wind, of ``force`` [N] towards ``direction`` [rad] or all around, and keeps the robots near
    hazards without entering them; phi of ``weights`` looks on.
    """
    task, random = PointTask(robots, seed, largest_force=0.0), np.random.default_rng([seed, 31])
    towards = random.uniform(0.0, 2.0 * np.pi, robots) if direction is None else np.full(robots, direction)
    simulation = task.simulation
    simulation.force[:] = force * np.stack((np.cos(towards), np.sin(towards)))
    adaptation = BatchHistoryEstimator(weights, robots)
    shield, parts = Shield(robots, SimulatedPointModel(simulation), None), []
    for step in range(steps):
        if step % _HELD == 0:
            nominal = random.uniform(-1.0, 1.0, (robots, 2))
        state, rate = centre_state(simulation), simulation.velocity[2].copy()
        latent = adaptation.see(state).copy()
        chosen = shield.act(task, nominal)
        action = from_task_action(chosen.action)
        adaptation.acted(action * ACTION_SCALE)
        task.advance(chosen.action)
        if step >= weights.description.history and step % 10 == 0:
            wind = simulation.force.T / simulation.body.mass
            hazards = task.layout.hazards.copy()
            now = Moments(state, rate, latent, wind, hazards, action, centre_state(simulation))
            room = minimum_barrier(state, hazards, now.motion())
            parts.append(now.of(np.flatnonzero((room > 0.0) & (room < _NEAR))))
    return Moments(*(np.concatenate([getattr(part, name) for part in parts]) for name in Moments.__dataclass_fields__))
