"""The margin of each filter of the point robot: the same rule, on as many drives, behind its own filter.

An error is the least h over hazards that the filter's model predicts for the next period, less the least h that the
filter itself finds there one period later, by what it believes then: a latent that moves the barrier counts as well.
Moments of drives near hazards are where models are asked what would come next.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import Any, Final, final

import numpy as np
from numpy.typing import NDArray

from safedpa.adaptation.batch_history_estimator import BatchHistoryEstimator
from safedpa.arrays import FloatArray
from safedpa.errors import InputError
from safedpa.networks import Weights
from safedpa.safety.barriers.stopping import Motion
from safedpa.safety.margins.conformal import margins_over_drives, smallest_sample
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.point.beliefs import LearnedBelief, from_task_action
from safedpa_lab.point.drivers import ShieldedDriver, Wheel, driver_of, windy_task
from safedpa_lab.point.methods import Method
from safedpa_lab.point.shield import Shield, shield_of
from safedpa_sim.point.body import POINT_BODY
from safedpa_sim.point.filtering import ACTION_SCALE, SimulatedPointModel, minimum_barrier
from safedpa_sim.point.policy_task import LARGEST_FORCE
from safedpa_sim.point.simulation import LARGEST_TURN, centre_state
from safedpa_sim.point.task import PointTask

_HELD: Final = 25
"""Periods for which a nominal action is held: redrawn in each period it would lead nowhere."""


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
            parts.append(now.of(np.flatnonzero((room > 0.0) & (room < NEAR))))
    return Moments(*(np.concatenate([getattr(part, name) for part in parts]) for name in Moments.__dataclass_fields__))


COVERAGE: Final = 0.99
NEAR: Final = 0.1
"""m of h below which an error counts: elsewhere the filter lets everything pass."""
_SKIPPED: Final = 100
"""Calibration seeds that other experiments may have."""
_TRUTH: Final = "oracle"


@final
@dataclass(frozen=True)
class Calibration:
    """What margins are measured on; plain values, so that they can be kept in a file. Raises InputError for fewer
    drives than the coverage needs."""

    filters: str
    """Of ``FILTERS``, with commas between."""
    models: str
    drives: int
    steps: int
    """Of each drive."""
    force: float = LARGEST_FORCE
    """N, towards directions at random."""

    def __post_init__(self) -> None:
        if self.drives < smallest_sample(COVERAGE):
            raise InputError(f"--drives: got {self.drives}, wanted {smallest_sample(COVERAGE)} or more")


def measured_margins(asked: Calibration) -> dict[str, Any]:
    """``margins``: by filter, its margin [m], of a step of a drive that is not known, of the stated coverage.

    In two rounds, since errors depend on where the filter lets the robot go: drives of SafeDPA's policy behind the
    filter that knows the wind make a first margin; other drives behind the filter itself with that margin make the one
    that counts. Each round has as many drives for every filter, on seeds for calibration.
    """
    seeds = list(seeds_for("calibration", 2, _SKIPPED))
    models, filters = Path(asked.models), asked.filters.split(",")
    reported = _errors(_windy(asked, seeds[0]), models, _TRUTH, 0.0, filters, asked.steps)
    found = {}
    for name in filters:
        first = max(0.0, margins_over_drives(reported[name], COVERAGE)[0])
        task = _windy(asked, seeds[1])
        own = _errors(task, models, name, first, (name,), asked.steps)[name]
        found[name] = {**_row(own), "first": first, "seeds": seeds, "steps": asked.steps}
    return {**{item.name: getattr(asked, item.name) for item in fields(asked)}, "margins": found}


def _row(errors: list[FloatArray]) -> dict[str, Any]:
    epsilon, of_a_drive = margins_over_drives(errors, COVERAGE)
    every = np.concatenate(errors)
    return {
        "epsilon": max(0.0, epsilon),
        "of_a_drive": of_a_drive,
        "coverage": COVERAGE,
        "drives": len(errors),
        "transitions": len(every),
        "median_error": float(np.median(np.abs(every))),
        "largest_error": float(every.max()),
    }


def _windy(asked: Calibration, seed: int) -> PointTask:
    towards = np.random.default_rng([seed, 61]).uniform(0.0, 2.0 * np.pi, asked.drives)
    return windy_task(towards, asked.force, seed)


def _errors(
    task: PointTask, models: Path, before: str, epsilon: float, filters: Sequence[str], steps: int
) -> dict[str, list[FloatArray]]:
    """By filter, the errors [m] near hazards along each drive behind the filter ``before``."""
    driver = driver_of(Method("", "", filter=before), task, Wheel(models, margins={before: epsilon}))
    assert isinstance(driver, ShieldedDriver)
    watched = {}
    for name in filters:
        own = driver.shield if name == before else shield_of(name, task, epsilon=epsilon, folder=models)
        watched[name] = _Watched(own, task)
    for _ in range(steps):
        for one in watched.values():
            one.look()
        action = driver.act()
        for one in watched.values():
            one.acted(from_task_action(np.asarray(action, dtype=np.float64)), own=one.shield is driver.shield)
        task.advance(action)
    return {name: one.by_drive() for name, one in watched.items()}


@final
class _Watched:
    """What one filter's model predicted, and what the filter then found."""

    def __init__(self, shield: Shield, task: PointTask) -> None:
        self.shield, self._task = shield, task
        self._errors: list[FloatArray] = []
        self._predicted: FloatArray | None = None
        self._room: FloatArray = np.full(task.count, np.inf)

    def look(self) -> None:
        """The robots are seen; the error of what was predicted of them."""
        believed = self._believed = self.shield.believes(self._task)
        room = minimum_barrier(centre_state(self._task.simulation), self._task.layout.hazards, believed.motion)
        if self._predicted is not None:
            near = (self._room > 0.0) & (self._room < NEAR)
            self._errors.append(np.where(near, self._predicted - room, np.nan))
        self._room = room

    def acted(self, action: FloatArray, own: bool) -> None:
        """Actions (robots, 2) in [-1, 1]; ``own``: the filter's, which knows of them."""
        if not own:
            self.shield.acted(action)
        following = self._believed.next_state(action)
        self._predicted = minimum_barrier(following, self._task.layout.hazards, self._believed.motion)

    def by_drive(self) -> list[FloatArray]:
        """(steps near hazards,) of each drive; of one that had none, one error that no margin misses."""
        columns = (column[np.isfinite(column)] for column in np.array(self._errors).T)
        return [column if len(column) else np.full(1, -NEAR) for column in columns]


def one_step_errors(weights: Weights, moments: Moments) -> FloatArray:
    """(n,) h(predicted) - h(measured) [m] one period later, least over hazards, by f, g and the latents of phi."""
    believed = LearnedBelief(weights).predict(moments.state, moments.latent)
    predicted = believed.next_state(moments.action)
    errors: FloatArray = minimum_barrier(predicted, moments.hazards, believed.motion) - minimum_barrier(
        moments.following, moments.hazards, believed.motion
    )
    return errors
