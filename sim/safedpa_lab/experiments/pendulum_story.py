"""The whole story on a second robot: recorded swings, compare, diagnose, add; and is the pendulum safer for it?

A pendulum carries half a kilogram or rubs in its hinge, and no model knows. The filter keeps it within 45 degrees under
torques at random, in winds that it has to find out about, with the shipped model, with the one that diagnosis made of
it, and with an oracle. Each model has a margin of its own, calibrated on the same swings at the same coverage; the
shipped model runs again with the diagnosed one's margin, to show what the larger one is needed for.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, final

import numpy as np

from safedpa.adaptation import AdaptationNode, HistoryEstimator, LatentEstimator
from safedpa.calibration.from_runs import calibration_from_runs
from safedpa.diagnosis.diagnose import add_effect, diagnose
from safedpa.dynamics import LearnedBase, PhysicsModel, load_model, parse_model, write_model
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa.records.run import Run
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import settings_named
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa_lab.experiments.car_workers import Workers
from safedpa_lab.experiments.diagnosing import alongside_the_truth
from safedpa_lab.experiments.statistics import wilson_interval
from safedpa_lab.pendulum.hidden import HIDDEN, PERIOD, oracle_model, swings_all_around
from safedpa_sim.closed_loop import drive
from safedpa_sim.pendulum.task import BALANCING
from safedpa_sim.robots import PendulumRobot, task_named, wind_towards

__all__ = ["PendulumStory", "pendulum_story"]

ReportProgress = Callable[[int, int], None]
_SETTINGS = "pendulum"
_HORIZON = 0.3
"""s; over which predictions are compared."""
_DAY = (2.0, 60.0)
"""m/s and degrees; the wind of the day on which the swings for the diagnosis were recorded."""
_SEED = 7000
"""Of the swings for the diagnosis; those for the margins have the next one."""
_DATE = "2024-01-01"
"""Of calibrations that live as long as the experiment."""


@final
@dataclass(frozen=True)
class PendulumStory:
    """What is to be run. Raises InputError for numbers that make no experiment."""

    hidden: tuple[str, ...] = tuple(HIDDEN)
    directions: int = 12
    episodes: int = 2
    seconds: float = 3.0
    """Of each episode."""
    wind: float = 3.5
    """m/s; against more the motor does not hold the payload at 45 degrees."""
    swings: int = 3
    swing_seconds: float = 12.0
    coverage: float = 0.99
    learned: bool = False
    """With the learned model as well, and the effect added to it."""
    seed: int = 0
    processes: int = 2

    def __post_init__(self) -> None:
        for name, low in (("directions", 1), ("episodes", 1), ("seconds", 0.1), ("swings", 1), ("swing_seconds", 4.0)):
            if getattr(self, name) < low:
                raise InputError(f"--{name.replace('_', '-')}: got {getattr(self, name)}, wanted {low} or more")


@final
@dataclass(frozen=True)
class _Episode:
    hidden: str
    model: str
    """As TOML."""
    folder: Path
    """Of its weights, where it has some."""
    calibration: str
    """As TOML."""
    wind: tuple[float, float]
    seed: int
    ticks: int


def pendulum_story(story: PendulumStory, report_progress: ReportProgress = lambda _done, _all: None) -> dict[str, Any]:
    """For each hidden thing what diagnosis said of it, and one row for each model: safety, margin, room."""
    everything, reported = len(story.hidden) * 2, 0
    cases: dict[str, Any] = {}
    with Workers(story.processes) as workers:
        for hidden in story.hidden:
            prepared, notice = _prepared(hidden, story)
            report_progress(reported := reported + 1, everything)
            episodes = [
                (name, episode) for name, given in prepared.items() for episode in _episodes(hidden, given, story)
            ]
            outcomes = list(workers.map(_run, [episode for _, episode in episodes]))
            rows = {
                name: _row(
                    prepared[name], [out for (own, _), out in zip(episodes, outcomes, strict=True) if own == name]
                )
                for name in prepared
            }
            cases[hidden] = {**notice, "rows": rows}
            report_progress(reported := reported + 1, everything)
    asked = {name: getattr(story, name) for name in ("directions", "episodes", "seconds", "wind", "seed", "coverage")}
    return {**asked, "cases": cases}


def _prepared(
    name: str, story: PendulumStory
) -> tuple[dict[str, tuple[PhysicsModel, MarginCalibration]], dict[str, Any]]:
    """The models with their margins, and what comparison and diagnosis said."""
    hidden, shipped = HIDDEN[name], load_model("pendulum")
    runs = swings_all_around(hidden, wind_towards(*_DAY), _SEED, story.swings, story.swing_seconds)
    found = diagnose(shipped, runs, _HORIZON)
    models = {"shipped": shipped, "diagnosed": _forgetting(found.models[-1], shipped), "oracle": oracle_model(hidden)}
    if story.learned:
        models["learned"] = load_model("pendulum_learned")
        models["learned, added"] = _added(models["learned"], found.added, runs)
    calibrating = [
        run
        for number in range(8)
        for run in swings_all_around(hidden, wind_towards(story.wind, 45.0 * number), _SEED + 1 + number, 1, 4.0)
    ]
    given = {key: (model, _margin(model, calibrating, story.coverage)) for key, model in models.items()}
    same = given["diagnosed"][1]
    given["shipped, margin of the diagnosed"] = (shipped, _belonging(same, given["shipped"][1]))
    return given, alongside_the_truth(found, hidden.effects)


def _forgetting(corrected: PhysicsModel, shipped: PhysicsModel) -> PhysicsModel:
    """The corrected model with the wind of the shipped one: tomorrow's is not that of the recording."""
    unknown = {path: item for path, item in shipped.settings.items() if item.free}
    return corrected.with_settings({**corrected.settings, **unknown})


def _added(model: PhysicsModel, effects: Sequence[str], runs: Sequence[Run]) -> PhysicsModel:
    for name in effects:
        model = add_effect(model, name, runs, _HORIZON).model
    return model


def _margin(model: PhysicsModel, runs: Sequence[Run], coverage: float) -> MarginCalibration:
    learned = isinstance(model.base, LearnedBase)
    estimator = HistoryEstimator if learned else LatentEstimator
    return calibration_from_runs(
        model, settings_named(_SETTINGS), runs, coverage, _DATE, estimator=lambda: estimator(model)
    )


def _belonging(margin: MarginCalibration, to: MarginCalibration) -> MarginCalibration:
    return replace(margin, fingerprint=to.fingerprint)


def _episodes(hidden: str, given: tuple[PhysicsModel, MarginCalibration], story: PendulumStory) -> list[_Episode]:
    model, margin = write_model(given[0]), given[1].write()
    base = given[0].base
    source = base.weights.source if isinstance(base, LearnedBase) else None
    return [
        _Episode(
            hidden,
            model,
            Path() if source is None else source.parent,
            margin,
            wind_towards(story.wind, 360.0 * number / story.directions),
            story.seed + index,
            round(story.seconds / PERIOD),
        )
        for number in range(story.directions)
        for index in range(story.episodes)
    ]


def _run(episode: _Episode) -> dict[str, Any]:
    """One episode behind the real nodes; the same episode gives the same outcome."""
    model, calibration = parse_model(episode.model, episode.folder), MarginCalibration.parse(episode.calibration)
    robot = PendulumRobot(task_named("balance"), episode.wind, episode.seed, HIDDEN[episode.hidden].parameters)
    keeper = SafetyFilterNode(model, settings_named(_SETTINGS), calibration)
    nodes = [AdaptationNode(model), PolicyNode(model, controller="random"), keeper]
    ticks = list(drive(robot, nodes, episode.ticks))
    angles = np.array([tick.state.values[0] for tick in ticks])
    return {
        "room": float(BALANCING[1] - np.abs(angles).max()),
        "reach": float(np.quantile(np.abs(angles), 0.95)),
        "corrected": float(np.mean([tick.verdict.status != "passed" for tick in ticks])),
        "relaxed": float(np.mean([tick.verdict.status in ("relaxed", "violated", "fallback") for tick in ticks])),
    }


def _row(given: tuple[PhysicsModel, MarginCalibration], outcomes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    rooms = np.array([item["room"] for item in outcomes])
    safe = int((rooms >= 0.0).sum())
    return {
        "effects": [item.name for item in given[0].effects],
        "margin": given[1].epsilon["corridor"],
        "episodes": len(rooms),
        "safe": safe,
        "interval_safe": list(wilson_interval(safe, len(rooms))),
        "least_room": float(rooms.min()),
        "median_room": float(np.median(rooms)),
        "reach": float(np.mean([item["reach"] for item in outcomes])),
        "corrected": float(np.mean([item["corrected"] for item in outcomes])),
        "relaxed": float(np.mean([item["relaxed"] for item in outcomes])),
    }
