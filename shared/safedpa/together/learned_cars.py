"""Adaptation, policy and safety filter of a thousand cars: one product of matrices per layer instead of a thousand.

What a service does for one robot after the other, ``CarsTogether`` does for all in one pass. It is meant for robots
that tick together: a simulation, a study of many scenes, a fleet whose states are collected. The services do not use
it: their robots are due one a millisecond, and a recorded run must repeat bit for bit, whoever else was due.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import NamedTuple, final

import numpy as np
from numpy.typing import NDArray

from safedpa.dynamics import LearnedBase, PhysicsModel
from safedpa.errors import InputError
from safedpa.policy import LearnedPolicy
from safedpa.policy.backing_off_together import BackingOffTogether
from safedpa.robots.car.observation import FAR_AWAY, OBSTACLES, observe
from safedpa.safety.batch import BatchFilter, ManyVerdicts
from safedpa.safety.settings import FilterSettings
from safedpa.together.histories import HistoriesTogether

__all__ = ["CarsTogether", "Surroundings"]

Values = NDArray[np.float64]


class Surroundings(NamedTuple):
    """What the cars perceive, in m: as ``observe`` describes it.

    Goal (cars, 2), obstacles (cars, m, 3), field (cars, 4), footprint (cars, 3).
    """

    goal: Values
    obstacles: Values
    field: Values
    footprint: Values


@final
class CarsTogether:
    """The loop of the services for cars with a learned model that holds f, g, phi and a policy.

    ``epsilon`` is the margin of each kind of barrier, as ``BatchFilter.decide`` takes it. Raises InputError for a model
    that lacks one of the networks.
    """

    def __init__(
        self, model: PhysicsModel, settings: FilterSettings, cars: int, epsilon: Mapping[str, float] | None = None
    ) -> None:
        if not isinstance(model.base, LearnedBase):
            raise InputError("model: got physics, wanted learned networks")
        self._adaptation = HistoriesTogether(model, cars)
        self._policy = LearnedPolicy(model.base.weights)
        self._headway = BackingOffTogether(cars)
        self._filter = BatchFilter(model, settings)
        self._epsilon = None if epsilon is None else dict(epsilon)

    def step(self, now: float, state: Values, applied: Values, around: Surroundings) -> ManyVerdicts:
        """Verdicts, with the actions (cars, 2), at robot time ``now`` [s].

        State (cars, 4), and the action (cars, 2) in force over the period that ended now.
        """
        latent = self._adaptation.latents(state, applied)
        wish = self.wishes(now, state, applied, latent, around)
        return self._filter.decide(
            state,
            wish,
            latent,
            obstacles=around.obstacles,
            footprint=around.footprint,
            field=around.field,
            epsilon=self._epsilon,
        )

    def wishes(self, now: float, state: Values, applied: Values, latent: Values, around: Surroundings) -> Values:
        """What the policies wish for, shape (cars, 2)."""
        obstacles = _enough(around.obstacles)
        seen = observe(state, applied, around.goal, obstacles, around.field, around.footprint, latent)
        return self._headway.wishes(now, state, around.goal, np.asarray(self._policy.act(seen), dtype=np.float64))


def _enough(obstacles: Values) -> Values:
    """At least as many obstacles as a policy is told of, the further ones far away."""
    missing = max(OBSTACLES - obstacles.shape[1], 0)
    rest = np.broadcast_to(np.array(FAR_AWAY), (len(obstacles), missing, 3))
    return np.concatenate([obstacles, rest], axis=1) if missing else obstacles
