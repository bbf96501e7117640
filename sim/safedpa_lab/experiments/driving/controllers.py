"""Comparison of the controllers: the same scenes, filter and model; goals reached and computing time."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from safedpa.bus import Inputs, Outputs, StateMessage
from safedpa.dynamics import LearnedBase, PhysicsModel, load_model
from safedpa.policy import PolicyNode
from safedpa.safety import FilterSettings
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.common.drives import LOADS, PERIOD, Outcome, counted, shipped_nodes
from safedpa_lab.experiments.common.seeds import seeds_of
from safedpa_lab.experiments.common.statistics import share_95
from safedpa_lab.experiments.record import Options, ReportProgress, Result
from safedpa_lab.experiments.report import markdown_table
from safedpa_lab.provenance.record import write_result
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene


@dataclass(frozen=True)
class TimedDrive:
    """The result of one drive."""

    outcome: Outcome
    milliseconds: tuple[float, ...]
    """Time of one core per nominal action, independent of the load of the machine."""


def controllers_experiment(
    model: PhysicsModel,
    settings: FilterSettings,
    controllers: Sequence[str],
    seeds: Iterable[int],
    seconds: float,
    on_scene: Callable[[int, int, dict[str, Any]], None] = lambda _done, _all, _result: None,
) -> dict[str, Any]:
    """One row for each load and controller; scenes without a collision as a share with its 95 % Wilson interval.

    ``on_scene`` gets how many seeds are done, how many there are, and the result so far: a long run can be ended early.
    """
    chosen = tuple(seeds)
    drives: dict[tuple[str, str], list[TimedDrive]] = {(load, name): [] for load in LOADS for name in controllers}
    for done, seed in enumerate(chosen, start=1):
        for (load, name), retained in drives.items():
            retained.append(timed_drive(model, settings, name, load, seed, seconds))
        on_scene(done, len(chosen), _result(drives, chosen[:done], seconds))
    return _result(drives, chosen, seconds)


def timed_drive(
    model: PhysicsModel, settings: FilterSettings, controller: str, load: str, seed: int, seconds: float
) -> TimedDrive:
    """One scene, driven through the real nodes in lockstep. Raises InputError for a controller that does not exist."""
    policy = _Stopwatch(model, controller)
    robot = CarRobot(Scene.random(seed, load), PERIOD)
    ticks = drive(robot, shipped_nodes(model, settings, policy.node), round(seconds / PERIOD))
    return TimedDrive(counted(robot, ticks), tuple(policy.milliseconds))


class _Stopwatch:
    """A policy node whose steps are timed."""

    def __init__(self, model: PhysicsModel, controller: str) -> None:
        self.node = PolicyNode(model, controller=controller)
        self.milliseconds: list[float] = []
        self._step = self.node.step
        self.node.step = self._timed  # type: ignore[method-assign]

    def _timed(self, robot: str, state: StateMessage, inputs: Inputs) -> Outputs:
        start = time.thread_time()
        found = self._step(robot, state, inputs)
        self.milliseconds.append(1e3 * (time.thread_time() - start))
        return found


def _result(drives: dict[tuple[str, str], list[TimedDrive]], seeds: Sequence[int], seconds: float) -> dict[str, Any]:
    rows = [{"load": load, "controller": name, **_summary(retained)} for (load, name), retained in drives.items()]
    return {"experiment": "controllers", "seeds": list(seeds), "seconds": seconds, "rows": rows}


def _summary(drives: Sequence[TimedDrive]) -> dict[str, Any]:
    outcomes = [item.outcome for item in drives]
    spent = np.concatenate([item.milliseconds for item in drives])
    return {
        "drives": len(drives),
        "goals": sum(item.goals for item in outcomes),
        "drives_with_a_goal": sum(item.goals > 0 for item in outcomes),
        "collisions": sum(item.collisions for item in outcomes),
        "safe_share_95": share_95(sum(item.collisions == 0 for item in outcomes), len(drives)),
        "changed_share": round(sum(item.changed for item in outcomes) / sum(item.ticks for item in outcomes), 4),
        "milliseconds_p50": round(float(np.percentile(spent, 50)), 2),
        "milliseconds_p99": round(float(np.percentile(spent, 99)), 2),
    }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment controllers``; the result so far is written after each scene."""
    model = load_model(options["model"])
    learned = isinstance(model.base, LearnedBase) and model.base.weights.has("policy")
    controllers = options["controllers"] or ("goal_seeker", "planner", *(("learned",) if learned else ()))

    def keep(done: int, count: int, so_far: dict[str, Any]) -> None:
        report_progress(done, count)
        if options["out"]:
            write_result(options["out"], so_far)

    settings = settings_named(options["settings"])
    return controllers_experiment(model, settings, controllers, seeds_of(options), options["seconds"], keep)


def report(result: Result) -> str:
    """One row per load and controller."""
    return markdown_table(
        "load | controller | goals | drives with a goal | collisions | changed actions | ms p50 | ms p99",
        (
            f"{row['load']} | {row['controller']} | {row['goals']} | {row['drives_with_a_goal']}/{row['drives']} "
            f"| {row['collisions']} | {100 * row['changed_share']:.0f} % | {row['milliseconds_p50']:.2f} "
            f"| {row['milliseconds_p99']:.2f}"
            for row in result["rows"]
        ),
        above=f"{len(result['seeds'])} scenes per load, {result['seconds']:g} s each.",
    )
