"""Effects common to all robots of a fleet, which belong into the model, and the test of the corrected model."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from safedpa.dynamics import PhysicsModel, Setting
from safedpa.effects import effect
from safedpa.effects.parameter import Parameter
from safedpa.errors import SafedpaError
from safedpa.fleet.one_robot import Options, read_runs
from safedpa.fleet.outcome import EffectEvidence, RobotOutcome, neutral_of
from safedpa.fleet.pooled_evidence import Pooled, PooledEvidence, estimates, pooled_numbers, upper_tail
from safedpa.fleet.robots import RobotLogs
from safedpa.fleet.similar_robots import APART, connected_components, differ_significantly

# Minimum number of robots for statements about the whole fleet.
_FEWEST = 5
# Share of the robots in which an effect must be found to be common.
_NEARLY_ALL = 0.8
# Pooled evidence in standard errors from which an effect found in few robots is common. For 30 candidate effects the
# probability of a false one is 1 in 1000.
_TOGETHER = 4.0
# Maximum number of effects with pooled evidence that are tried on the robots.
_ALTERNATIVES = 5
# Significance level of the sign test that confirms the corrected model.
_SIGNIFICANCE = 0.01


@dataclass(frozen=True)
class FleetEffect:
    """An effect of the whole fleet."""

    effect: str
    numbers: Mapping[str, Pooled]
    notice: Mapping[str, EffectEvidence]
    """Evidence of each robot, by name."""
    found_in: int
    of: int
    together: float | None
    """Pooled evidence in standard errors, if only the pooled robots show the effect; None if it was found in robots."""
    rivals: tuple[str, ...]
    differs: bool
    """Whether its value differs between robots, so that it is a free parameter of the model."""


@dataclass(frozen=True)
class CorrectionTask:
    """A test of the corrected model on one robot, with the values of the other robots as settings by effect."""

    robot: RobotLogs
    options: Options
    settings: Mapping[str, Mapping[str, Setting]]


@dataclass(frozen=True)
class Confirmation:
    """Result of the test of a corrected model, by held-out errors with values from the other robots."""

    robots: int
    better: int
    before: float
    after: float
    """Medians."""
    fall: float = 0.0
    """Mean over the robots of log(before / after)."""

    @property
    def holds(self) -> bool:
        """Whether significantly more robots are predicted better than worse (sign test)."""
        return self.robots > 0 and _coin(self.better, self.robots) < _SIGNIFICANCE and self.fall > 0


def common_effects(outcomes: Sequence[RobotOutcome], robot: str) -> list[FleetEffect]:
    """Returns effects found in nearly all judged robots, the most frequent first."""
    judged = [item for item in outcomes if item.judged]
    if len(judged) < _FEWEST:
        return []
    votes = Counter(item.effect for outcome in judged for item in outcome.found)
    found = [_strong(name, count, judged, robot) for name, count in votes.items() if _many(count, judged)]
    return sorted(found, key=lambda item: -item.found_in)


def together_effects(outcomes: Sequence[RobotOutcome], evidence: Sequence[PooledEvidence]) -> list[FleetEffect]:
    """Returns effects with evidence only over all robots together, the strongest first.

    Usually at most one of them is present. They resemble each other, so a test on the robots decides, not their order.
    """
    judged = [item for item in outcomes if item.judged]
    if len(judged) < _FEWEST:
        return []
    votes = Counter(item.effect for outcome in judged for item in outcome.found)
    showing = [item for item in evidence if _shows(item, judged)][:_ALTERNATIVES]
    found = []
    for item in showing:
        notice = estimates(item.effect, judged)
        rivals = tuple(other.effect for other in showing if other is not item)
        numbers = pooled_numbers(list(notice.values()))
        found.append(
            FleetEffect(item.effect, numbers, notice, votes[item.effect], len(judged), item.score, rivals, False)
        )
    return found


def _many(count: int, judged: Sequence[RobotOutcome]) -> bool:
    return count >= max(_FEWEST, _NEARLY_ALL * len(judged))


def _shows(item: PooledEvidence, judged: Sequence[RobotOutcome]) -> bool:
    """Whether the pooled evidence of an effect is sufficient, and most robots contribute to it."""
    # A few robots with strong evidence are a group of their own and not the fleet.
    return item.score > _TOGETHER and item.robots >= _NEARLY_ALL * len(judged) and item.favourable > 0.6 * item.robots


def _strong(name: str, count: int, judged: Sequence[RobotOutcome], robot: str) -> FleetEffect:
    of_this = [(outcome, tuple(item for item in outcome.found if item.effect == name)) for outcome in judged]
    own = [replace(outcome, found=found) for outcome, found in of_this if found]
    largest = max(connected_components(own, lambda one, other: differ_significantly(one, other, robot)), key=len)
    notice = {outcome.name: outcome.found[0] for outcome in own}
    numbers = pooled_numbers([outcome.found[0] for outcome in largest])
    wide = any(_wide(robot, name, parameter, item) for parameter, item in numbers.items())
    rivals = tuple(sorted(set.intersection(*(set(item.equals) for item in notice.values()))))
    return FleetEffect(name, numbers, notice, count, len(judged), None, rivals, wide or not _many(len(largest), judged))


def _wide(robot: str, effect: str, parameter: str, item: Pooled) -> bool:
    change = abs(item.mean - (neutral_of(robot, effect, parameter) or 0.0))
    return item.spread > 0.5 * APART * change


def corrected_settings(robot: str, common: Sequence[FleetEffect], without: str = "") -> dict[str, dict[str, Setting]]:
    """Returns the fleet's values by effect, without those of the robot ``without``; free if they differ."""
    found = {}
    for item in common:
        notice = [tried for name, tried in item.notice.items() if name != without]
        numbers = item.numbers if not without else pooled_numbers(notice)
        found[item.effect] = {
            parameter.name: _setting(parameter, numbers[parameter.name].mean, item.differs)
            for parameter in effect(robot, item.effect).parameters
        }
    return found


def _setting(parameter: Parameter, value: float, free: bool) -> Setting:
    return Setting(float(f"{min(max(value, parameter.low), parameter.high):.6g}"), free=free)


def corrected_model(given: PhysicsModel, settings: Mapping[str, Mapping[str, Setting]]) -> PhysicsModel:
    """Returns the model with additional effects."""
    model = given
    for name, own in settings.items():
        model = model.with_effect(effect(given.system.name, name), dict(own))
    return model


def corrected_error(task: CorrectionTask) -> tuple[str, float]:
    """Returns the robot's name and its held-out error with the corrected model; NaN if its data cannot be read."""
    from safedpa.diagnosis.fit.cross_validation import error_with
    from safedpa.diagnosis.fit.data_checks import data_at_horizon, displayed_windows, prepare_runs
    from safedpa.diagnosis.search.initial_model import initial_search
    from safedpa.dynamics import load_model

    model = corrected_model(load_model(task.options.model), task.settings)
    try:
        runs, _ = read_runs(model, task.robot, task.options)
        usable = prepare_runs(model, runs)
        evidence = data_at_horizon(usable.runs, usable.seconds)
        shown = displayed_windows(usable.runs, task.options.horizon, evidence)
        found = initial_search(model, evidence.shooting, evidence.heldout)
    except SafedpaError:
        return task.robot.name, math.nan
    return task.robot.name, error_with(found.current.fit, found.shooting, shown).value


def confirm_correction(before: Mapping[str, float], after: Mapping[str, float]) -> Confirmation:
    """Compares the errors by robot with and without the correction."""
    both = [(before[name], after[name]) for name in before if name in after]
    known = [pair for pair in both if all(math.isfinite(error) and error > 0 for error in pair)]
    if not known:
        return Confirmation(0, 0, math.nan, math.nan)
    old, new = np.array(known).T
    medians = float(np.median(old)), float(np.median(new))
    return Confirmation(len(known), int((new < old).sum()), *medians, float(np.log(old / new).mean()))


def _coin(hits: int, trials: int) -> float:
    """Returns P(at least ``hits`` heads in ``trials``), exact up to 50 trials, else by the normal approximation."""
    if trials <= 50:
        return float(sum(math.comb(trials, k) for k in range(hits, trials + 1)) / 2**trials)
    return upper_tail((hits - 0.5 - 0.5 * trials) / math.sqrt(0.25 * trials))
