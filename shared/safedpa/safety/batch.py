"""The safety filter for many cars at once, for simulation, training and evaluation.

Every robot gets what ``SafetyFilter.decide`` would give it alone, to 1e-6: networks, barriers and the quadratic program
run over arrays with the robots first. Whatever is out of the ordinary (an input that is not plausible, a program that
needs slack, conditions that cannot all be kept, an h below 0) is left to the filter of one robot itself, so that the
ladder of fallbacks exists once. The services keep one step per robot: there its numbers must not depend on its
neighbours.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, final

import numpy as np
from numpy.typing import ArrayLike, NDArray

from safedpa.dynamics import PhysicsModel
from safedpa.errors import InputError
from safedpa.robot import robot_like
from safedpa.safety.batch_barriers import ManyScenes
from safedpa.safety.batch_search import ManyConditions, ManyOutcomes, ManyPredictions, search_by_many
from safedpa.safety.inputs import Plausible
from safedpa.safety.safety_filter import SafetyFilter
from safedpa.safety.settings import FilterSettings
from safedpa.safety.verdict import Status

__all__ = ["STATUSES", "BatchFilter", "ManyVerdicts"]

Values = NDArray[np.float64]
Flags = NDArray[np.bool_]

STATUSES = tuple(Status)
"""By their number in ``ManyVerdicts.status``."""


@final
@dataclass(frozen=True, eq=False)
class ManyVerdicts:
    """What ``Verdict`` says of one decision, for many; all (robots,) but for ``action`` (robots, 2)."""

    action: Values
    status: NDArray[np.int8]
    """Index into ``STATUSES``."""
    slack: Values
    h_now: Values
    h_next: Values
    alone: Flags
    """Whom the filter of one robot answered."""

    def count(self, status: Status) -> int:
        """How many robots have that status."""
        return int(np.count_nonzero(self.status == STATUSES.index(status)))


@final
class BatchFilter:
    """``decide`` for cars that share a model and settings. Raises InputError for a model of another robot."""

    def __init__(self, model: PhysicsModel, settings: FilterSettings | None = None) -> None:
        self.model, self.settings = model, settings or FilterSettings()
        actions = len(self.settings.action_low)
        robot = robot_like(model.system)
        if robot is None or not robot.in_batches or actions != 2:
            raise InputError(
                f"model: got a '{model.system.name}' and {actions} actions, wanted a car and 2; filter it one by one"
            )
        if model.timed:
            raise InputError(
                "model: depends on the time since the start, which a batch does not have; filter one by one"
            )
        self._one = SafetyFilter.for_model(model, self.settings)

    def decide(
        self,
        state: ArrayLike,
        wish: ArrayLike,
        latent: ArrayLike | None = None,
        *,
        obstacles: ArrayLike,
        footprint: ArrayLike,
        field: ArrayLike | None = None,
        epsilon: Mapping[str, Any] | None = None,
    ) -> ManyVerdicts:
        """Verdicts for states (robots, 4), wishes (robots, 2), latents (robots, latents).

        ``obstacles`` (robots, m, 3), padded far away where a robot has fewer; ``footprint`` (3,) or (robots, 3);
        ``field`` (4,) or (robots, 4); ``epsilon`` by kind of barrier: a number, or (robots,). Numbers that cannot be
        believed end in the fallback of their own robot; raises InputError for wrong shapes and scenes that are none.
        """
        states, wishes = np.asarray(state, dtype=np.float64), np.asarray(wish, dtype=np.float64)
        robots = len(states)
        latents = None if latent is None else np.asarray(latent, dtype=np.float64)
        _check("state", states, (robots, 4))
        _check("wish", wishes, (robots, 2))
        if latents is not None:
            _check("latent", latents, (robots, len(self.model.latent_names)))
        scenes = ManyScenes.of(self.settings, robots, obstacles, footprint, field)
        margins = {kind: np.broadcast_to(value, robots) for kind, value in (epsilon or {}).items()}
        verdicts = self._blank(robots)
        ordinary = np.flatnonzero(self._ordinary(states, wishes, latents, margins))
        if len(ordinary):
            known = None if latents is None else latents[ordinary]
            own = {kind: value[ordinary] for kind, value in margins.items()}
            with np.errstate(all="ignore"):  # numbers beyond all bounds are left to the filter of one robot
                self._together(
                    verdicts, ordinary, states[ordinary], wishes[ordinary], known, scenes.only(ordinary), own
                )
        for robot in np.flatnonzero(verdicts.alone).tolist():
            self._alone(verdicts, robot, states, wishes, latents, scenes, margins)
        return verdicts

    def _blank(self, robots: int) -> ManyVerdicts:
        slack, h_now, h_next = np.zeros((3, robots))
        status, alone = np.zeros(robots, dtype=np.int8), np.ones(robots, dtype=bool)
        return ManyVerdicts(np.zeros((robots, 2)), status, slack, h_now, h_next, alone)

    def _ordinary(self, state: Values, wish: Values, latent: Values | None, margins: Mapping[str, Values]) -> Flags:
        """Robots (robots,) whose inputs the filter of one robot would believe."""
        tools = self._one.tools
        believed = np.full(len(state), self.settings.enabled)
        for numbers, plausible in ((state, tools.state_range), (wish, tools.wish_range), (latent, tools.latent_range)):
            if numbers is not None:
                believed &= _within(numbers, plausible)
            elif plausible is not None and len(plausible.names) > 0:
                believed[:] = False
        for value in margins.values():
            believed &= np.isfinite(value) & (value >= 0.0)
        return believed

    def _together(
        self,
        verdicts: ManyVerdicts,
        which: NDArray[np.intp],
        state: Values,
        wish: Values,
        latent: Values | None,
        scenes: ManyScenes,
        margins: Mapping[str, Values],
    ) -> None:
        """The verdicts of robots whose conditions can be kept; the others stay alone."""
        settings = self.settings
        h_now = scenes.values(state)
        epsilon = self._epsilon(scenes, len(state), margins)
        required, scale = (1.0 - settings.eta) * h_now + epsilon, np.maximum(np.abs(h_now), epsilon)
        conditions = ManyConditions(settings, scenes, ManyPredictions(self.model, state, latent), required, scale)
        within = np.minimum(np.maximum(wish, settings.low), settings.high)
        outcome = conditions.outcome(np.where(within == wish, wish, within))
        safe = (h_now >= 0.0).all(axis=1)
        kept = safe & conditions.kept(outcome)
        status = np.where((within == wish).all(axis=1), STATUSES.index(Status.passed), STATUSES.index(Status.corrected))
        known = np.isfinite(h_now).all(axis=1) & np.isfinite(outcome.h_next).all(axis=1)
        wrong = np.flatnonzero(known & safe & ~kept)
        if len(wrong):
            own = conditions.only(wrong)
            found, certain = search_by_many(own, wish[wrong], outcome.only(wrong))
            good = certain & own.kept(found)
            outcome.put(wrong[good], found.only(good))
            kept[wrong[good]] = True
            status[wrong] = STATUSES.index(Status.corrected)
        self._write(verdicts, which, known & kept, status, h_now, outcome)

    def _write(
        self,
        verdicts: ManyVerdicts,
        which: NDArray[np.intp],
        answered: Flags,
        status: NDArray[np.intp],
        h_now: Values,
        outcome: ManyOutcomes,
    ) -> None:
        robots = which[answered]
        verdicts.action[robots] = outcome.action[answered]
        verdicts.status[robots] = status[answered]
        verdicts.h_now[robots] = h_now.min(axis=1)[answered]
        verdicts.h_next[robots] = outcome.h_next.min(axis=1)[answered]
        verdicts.alone[robots] = False

    def _epsilon(self, scenes: ManyScenes, robots: int, margins: Mapping[str, Values]) -> Values:
        """(robots, rows)."""
        table: dict[str, Any] = {**self.settings.epsilon, **margins}
        otherwise = table.get("default", 0.0)
        return np.stack([np.broadcast_to(table.get(kind, otherwise), robots) for kind in scenes.kinds], axis=1)

    def _alone(
        self,
        verdicts: ManyVerdicts,
        robot: int,
        state: Values,
        wish: Values,
        latent: Values | None,
        scenes: ManyScenes,
        margins: Mapping[str, Values],
    ) -> None:
        own = None if latent is None else latent[robot]
        epsilon = {kind: float(value[robot]) for kind, value in margins.items()}
        found = self._one.decide(state[robot], wish[robot], own, barriers=scenes.one(robot), epsilon=epsilon)
        verdicts.action[robot], verdicts.status[robot] = found.action, STATUSES.index(found.status)
        verdicts.slack[robot], verdicts.h_now[robot], verdicts.h_next[robot] = found.slack, found.h_now, found.h_next


def _within(numbers: Values, plausible: Plausible | None) -> Flags:
    """Rows (robots,) that are finite and within the range."""
    believed = np.isfinite(numbers)
    if plausible is not None and len(plausible.names) > 0:
        believed &= (numbers >= plausible.low) & (numbers <= plausible.high)
    return np.asarray(believed.all(axis=1))


def _check(what: str, numbers: Values, shape: tuple[int, ...]) -> None:
    if numbers.shape != shape:
        raise InputError(f"{what}: got shape {numbers.shape}, wanted {shape}, the robots first")
