"""The gain of a complete model: one filter, three models, the same scenes with a hidden effect.

The filter gets the incomplete model, the one that diagnosis made of it from training drives, and an oracle that knows
the hidden effect. Each has a margin of its own, calibrated on the same drives at the same coverage.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any, Final

import numpy as np

from safedpa.calibration.from_runs import calibration_from_runs
from safedpa.diagnosis.diagnose import diagnose
from safedpa.dynamics import PhysicsModel, Setting, parse_model, write_model
from safedpa.effects import effect
from safedpa.records.run import Run, Stretch
from safedpa.robots.car.dynamics.kinematic_bicycle import KinematicBicycle
from safedpa.safety import FilterSettings
from safedpa.safety.defaults import settings_named
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa_lab.experiments.common.drives import PERIOD, counted, shipped_nodes
from safedpa_lab.experiments.common.seeds import seeds_of
from safedpa_lab.experiments.common.statistics import share_95
from safedpa_lab.experiments.common.workers import each_result
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent, with_options
from safedpa_lab.experiments.report import markdown_table
from safedpa_lab.hidden.towing import drive_in
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.loads import load_named
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.robots.car.world import CarWorld

_OPEN: Final = (-200.0, 200.0, -200.0, 200.0)
"""m; the field of the training drives."""


@dataclass(frozen=True)
class Hidden:
    """What acts on the car, and the effect of the library that says so."""

    effect: str
    parameters: dict[str, float]
    load: str = "none"
    steering_offset: float = 0.0
    """rad"""
    delay: int = 0
    """Periods by which every command comes late."""


HIDDEN: Final[dict[str, Hidden]] = {
    "steering_offset": Hidden("steering_offset", {"angle": 0.12}, steering_offset=0.12),
    "actuator_delay": Hidden("actuator_delay", {"seconds": 0.2}, delay=4),
    "chair": Hidden("towed_load", {"mass_ratio": 0.8, "deceleration": 1.5}, load="chair"),
}
"""By name: a bent linkage, a slow link, a chair of which the model knows nothing."""


class _HiddenWorld(CarWorld):
    """The car's world, with delayed commands and misaligned wheels."""

    def __init__(self, hidden: Hidden, *scene: Any) -> None:
        super().__init__(*scene)
        self._offset = hidden.steering_offset
        self._sent = deque([(0.0, 0.0)] * hidden.delay)

    def advance(self, target_speed: float, steer: float, seconds: float) -> None:
        """Holds for ``seconds`` the command that was sent ``delay`` calls ago, the wheels ``offset`` next to it."""
        self._sent.append((target_speed, steer))
        speed, angle = self._sent.popleft()
        super().advance(speed, angle + self._offset, seconds)


def hidden_robot(hidden: Hidden, scene: Scene) -> CarRobot:
    """The robot in a scene, with what is hidden in it."""
    robot = CarRobot(scene, PERIOD)
    robot.world = _HiddenWorld(hidden, scene.start, scene.field, scene.obstacles, scene.load)
    return robot


def incomplete_model() -> PhysicsModel:
    """The car's designer's model, without anything that is hidden."""
    values = {"wheelbase": 0.32, "speed_gain": 5.0, "acceleration_limit": 4.5}
    return PhysicsModel(KinematicBicycle(), (), {f"base.{name}": Setting(v) for name, v in values.items()}, PERIOD)


def oracle_model(hidden: Hidden) -> PhysicsModel:
    """The incomplete model with the hidden effect and its true numbers."""
    own = {name: Setting(value) for name, value in hidden.parameters.items()}
    return incomplete_model().with_effect(effect("car", hidden.effect), own)


def training_runs(hidden: Hidden, seed: int, count: int, seconds: float) -> list[Run]:
    """Drives about an open field, as an engineer makes them to see what a car does."""
    rows = round(seconds / PERIOD)
    runs = []
    for number in range(count):
        random = np.random.default_rng([seed, number, 5])
        start = (0.0, 0.0, float(random.uniform(-3.0, 3.0)))
        world = _HiddenWorld(hidden, start, _OPEN, (), load_named(hidden.load))
        states, actions = drive_in(world, random, rows, PERIOD)
        t = np.arange(rows, dtype=np.float64) * PERIOD
        runs.append(Run(f"drive {number + 1}", incomplete_model().system, t, states, actions, (Stretch(0, rows),)))
    return runs


MODELS = ("incomplete", "diagnosed", "oracle")
_TRAINING_SEED = 7000
_DATE = "2024-01-01"
"""Date of calibrations that are not kept."""


@dataclass(frozen=True)
class SafetyPays:
    """The experiment: what is hidden, which scenes, how much training data."""

    hidden: tuple[str, ...] = tuple(HIDDEN)
    seeds: tuple[int, ...] = tuple(range(40))
    seconds: float = 20.0
    """Of driving in each episode."""
    drives: int = 4
    drive_seconds: float = 30.0
    coverage: float = 0.99
    processes: int = 2


@dataclass(frozen=True)
class _Episode:
    hidden: str
    name: str
    seed: int
    seconds: float
    model: str
    """As TOML."""
    calibration: str
    """As TOML."""


def safety_pays(experiment: SafetyPays, report_progress: ReportProgress = silent) -> dict[str, Any]:
    """One row for each hidden effect and model: safe episodes with 95 % interval, margin, interventions, goals."""
    settings = settings_named("car")
    everything = len(experiment.hidden) * (1 + len(MODELS) * len(experiment.seeds))
    done, prepared = 0, {}
    for hidden in experiment.hidden:
        prepared[hidden] = _models(hidden, experiment, settings)
        done += 1
        report_progress(done, everything)
    episodes = [
        _Episode(hidden, name, seed, experiment.seconds, write_model(model), margin.write())
        for hidden, models in prepared.items()
        for name, (model, margin) in models.items()
        for seed in experiment.seeds
    ]
    outcomes = each_result(
        _run, episodes, experiment.processes, lambda driven, _: report_progress(done + driven, everything)
    )
    rows = [
        _row(
            hidden, name, *prepared[hidden][name], [o for o in outcomes if (o["hidden"], o["model"]) == (hidden, name)]
        )
        for hidden in experiment.hidden
        for name in MODELS
    ]
    return {**asdict(experiment), "rows": rows}


def _models(
    name: str, experiment: SafetyPays, settings: FilterSettings
) -> dict[str, tuple[PhysicsModel, MarginCalibration]]:
    """The three models with their margins, all from the same drives."""
    hidden = HIDDEN[name]
    runs = training_runs(hidden, _TRAINING_SEED, experiment.drives, experiment.drive_seconds)
    incomplete = incomplete_model()
    models = dict(zip(MODELS, (incomplete, diagnose(incomplete, runs).models[-1], oracle_model(hidden)), strict=True))
    return {
        key: (model, calibration_from_runs(model, settings, runs, experiment.coverage, _DATE))
        for key, model in models.items()
    }


def _run(episode: _Episode) -> dict[str, Any]:
    """Drives one episode; the same episode gives the same outcome."""
    hidden, model = HIDDEN[episode.hidden], parse_model(episode.model)
    calibration = MarginCalibration.parse(episode.calibration)
    nodes = shipped_nodes(model, settings_named("car"), margin=calibration)
    robot = hidden_robot(hidden, Scene.random(episode.seed, hidden.load))
    ticks, first = [], None
    for tick in drive(robot, nodes, round(episode.seconds / PERIOD)):
        ticks.append(tick)
        if first is None and robot.goals_reached:
            first = len(ticks) * PERIOD
    outcome = counted(robot, ticks)
    return {
        "hidden": episode.hidden,
        "model": episode.name,
        "first_goal": first,
        "changed": outcome.changed / len(ticks),
        **asdict(outcome),
    }


def _row(
    hidden: str, name: str, model: PhysicsModel, margin: MarginCalibration, outcomes: Sequence[dict[str, Any]]
) -> dict[str, Any]:
    safe = sum(item["collisions"] == 0 for item in outcomes)
    times = [item["first_goal"] for item in outcomes if item["first_goal"] is not None]
    return {
        "hidden": hidden,
        "model": name,
        "effects": [item.name for item in model.effects],
        "episodes": len(outcomes),
        "safe_episodes": safe,
        "safe_share_95": share_95(safe, len(outcomes)),
        "collisions": sum(item["collisions"] for item in outcomes),
        "below_zero": sum(item["least_h"] < 0.0 for item in outcomes),
        "epsilon": {kind: round(value, 5) for kind, value in margin.epsilon.items()},
        "intervention_share": round(float(np.mean([item["changed"] for item in outcomes])), 4),
        "goals": sum(item["goals"] for item in outcomes),
        "first_goal_median": None if not times else round(float(np.median(times)), 2),
        "first_goal_reached": len(times),
    }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment safety-pays``."""
    experiment = with_options(SafetyPays, options, seeds=tuple(seeds_of(options)))
    return {"experiment": "safety-pays", **safety_pays(experiment, report_progress)}


def report(result: Result) -> str:
    """One row per hidden effect and model."""

    def row(one: dict[str, Any]) -> str:
        low, high = one["safe_share_95"]
        first = "" if one["first_goal_median"] is None else f"{one['first_goal_median']:.1f}"
        return (
            f"{one['hidden']} | {one['model']} | {one['safe_episodes']}/{one['episodes']} "
            f"| {100 * low:.0f}-{100 * high:.0f} | {one['below_zero']} | {one['epsilon']['obstacle']:.3f} "
            f"| {100 * one['intervention_share']:.0f} % | {one['goals']} | {first}"
        )

    return markdown_table(
        "hidden | model | safe | 95 % | h below 0 | margin m | changed actions | goals | first goal s",
        map(row, result["rows"]),
        above=f"{len(result['seeds'])} scenes of {result['seconds']:g} s each.",
    )
