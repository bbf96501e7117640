"""The whole story on a third robot: logs, compare, diagnose, add; and is the point robot safer for it?

A force pushes and the slides drag, and no model has either. The filter keeps robots out of hazards under random nominal
actions with the shipped model, the one that the diagnosis corrected, and the true one.
"""

from __future__ import annotations

import time
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Final, final

import numpy as np

from safedpa.diagnosis.diagnose import diagnose
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError, did_you_mean
from safedpa.records.run import Run, Stretch
from safedpa_lab.experiments.common.statistics import wilson_interval
from safedpa_lab.experiments.diagnosis.diagnosing import alongside_the_truth
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.experiments.report import markdown_table
from safedpa_lab.point.beliefs import ModelBelief
from safedpa_lab.point.shield import EPSILON, Shield
from safedpa_sim.point.body import CONTROL_SECONDS, POINT_BODY
from safedpa_sim.point.filtering import ACTION_SCALE, SimulatedPointModel
from safedpa_sim.point.simulation import PointSimulation, centre_state, controls_of
from safedpa_sim.point.task import PointTask

_LOGGED_HELD: Final = 25
"""Periods for which an action is held."""
_NOISE: Final = np.array([0.001, 0.001, 0.002, 0.005, 0.005])
"""m, rad, m/s; standard deviations of what the sensors add."""


@final
@dataclass(frozen=True)
class HiddenPoint:
    """A robot as it is, and what the library calls it; the shipped model knows its mass alone."""

    force: tuple[float, float]
    """N, constant in the world."""
    effects: Mapping[str, Mapping[str, float]]


_SLOPE: Final = (-0.0042, 0.0042)
HIDDEN: Final = {
    "force and drag": HiddenPoint(
        force=_SLOPE,
        effects={
            "constant_force": {"ax": _SLOPE[0] / POINT_BODY.mass, "ay": _SLOPE[1] / POINT_BODY.mass},
            "viscous_drag": {"coefficient": POINT_BODY.slide_damping / POINT_BODY.mass},
        },
    )
}
"""By name: 0.006 N towards 135 degrees, as on a sloping table, and the damping of the slides."""


def hide(hidden: HiddenPoint, simulation: PointSimulation) -> None:
    """Makes all robots of a simulation like this."""
    simulation.force[:] = np.array(hidden.force)[:, np.newaxis]


def point_logs(hidden: HiddenPoint, seed: int, count: int, seconds: float) -> list[Run]:
    """Runs in open space under thrust and turn at random, each held for half a second, read by noisy sensors."""
    random, rows = np.random.default_rng([seed, 47]), round(seconds / CONTROL_SECONDS)
    simulation = PointSimulation(count)
    hide(hidden, simulation)
    simulation.pose[2] = random.uniform(-np.pi, np.pi, count)
    states, actions = np.empty((rows, count, 5)), np.empty((rows, count, 2))
    for row in range(rows):
        if row % _LOGGED_HELD == 0:
            action = random.uniform(-0.8, 0.8, (count, 2)) * ACTION_SCALE
        states[row], actions[row] = centre_state(simulation), action
        simulation.advance(controls_of(action))
    seen = np.asarray(states + random.normal(0.0, 1.0, states.shape) * _NOISE, dtype=np.float64)
    t = CONTROL_SECONDS * np.arange(rows, dtype=np.float64)
    system = load_model("point").system
    return [
        Run(f"log {index + 1}", system, t, seen[:, index], actions[:, index], (Stretch(0, rows),))
        for index in range(count)
    ]


_HORIZON: Final = 0.5
"""s; over which predictions are compared."""
_HELD: Final = 50
"""Periods for which a nominal action is held."""


@final
@dataclass(frozen=True)
class PointStory:
    """What is to be run. Raises InputError for numbers that make no experiment."""

    hidden: tuple[str, ...] = tuple(HIDDEN)
    robots: int = 128
    seconds: float = 10.0
    """Of each episode."""
    logs: int = 3
    log_seconds: float = 15.0
    seed: int = 0

    def __post_init__(self) -> None:
        for name in self.hidden:
            if name not in HIDDEN:
                raise InputError(f"--hidden: got '{name}'; {did_you_mean(name, HIDDEN)}")
        for name, low in (("robots", 1), ("seconds", 0.1), ("logs", 2), ("log_seconds", 4.0)):
            if getattr(self, name) < low:
                raise InputError(f"--{name.replace('_', '-')}: got {getattr(self, name)}, wanted {low} or more")


def point_story(story: PointStory, report_progress: ReportProgress = silent) -> dict[str, Any]:
    """For each hidden effect the diagnosis, and one row per model: safety and room."""
    cases: dict[str, Any] = {}
    for number, name in enumerate(story.hidden):
        hidden = HIDDEN[name]
        given = load_model("point")
        found = diagnose(given, point_logs(hidden, story.seed, story.logs, story.log_seconds), _HORIZON)
        models = {"shipped": given, "diagnosed": found.models[-1]}
        cases[name] = {
            **alongside_the_truth(found, hidden.effects),
            "rows": {
                **{title: _row(hidden, model, story) for title, model in models.items()},
                "oracle": _row(hidden, None, story),
            },
        }
        report_progress(number + 1, len(story.hidden))
    asked = {name: getattr(story, name) for name in ("robots", "seconds", "logs", "log_seconds", "seed")}
    return {**asked, "epsilon": EPSILON, "cases": cases}


def _row(hidden: HiddenPoint, model: PhysicsModel | None, story: PointStory) -> dict[str, Any]:
    """One episode of each robot; the same layouts and requests every model, nothing: the truth."""
    task, random = PointTask(story.robots, story.seed), np.random.default_rng([story.seed, 53])
    hide(hidden, task.simulation)
    shield = Shield(story.robots, SimulatedPointModel(task.simulation) if model is None else ModelBelief(model), None)
    cost, room, corrected = np.zeros(story.robots), task.hazard_distance(), 0.0
    steps = round(story.seconds / 0.02)
    for step in range(steps):
        if step % _HELD == 0:
            nominal = random.uniform((0.0, -0.5), (1.0, 0.5), (story.robots, 2))
        chosen = shield.act(task, nominal)
        cost += task.advance(chosen.action).cost
        room = np.minimum(room, task.hazard_distance())
        corrected += float(chosen.corrected.mean()) / steps
    safe = int((cost == 0.0).sum())
    return {
        "episodes": story.robots,
        "safe": safe,
        "interval_safe": list(wilson_interval(safe, story.robots)),
        "unsafe_steps": float(cost.mean()),
        "least_room": float(room.min()),
        "corrected": corrected,
    }


def point_story_markdown(result: dict[str, Any]) -> str:
    """For each hidden thing a sentence and a table."""
    head = f"{result['robots']} robots x {result['seconds']:g} s, seed {result['seed']}, {result['date']}.\n"
    return "\n".join([head, *(_case(name, case) for name, case in result["cases"].items())])


def _case(name: str, case: dict[str, Any]) -> str:
    true = ", ".join(
        f"{effect} {', '.join(f'{value:.3g}' for value in entries.values())}"
        for effect, entries in case["true"].items()
    )
    found = ", ".join(
        f"{path} {value['value']:.3f} +- {value['std'] or 0.0:.3f} {value['unit']}"
        for path, value in case["values"].items()
        if path.split(".")[0] in case["added"]
    )
    rows = []
    for title, row in case["rows"].items():
        low, high = row["interval_safe"]
        rows.append(
            f"{title} | {row['safe']}/{row['episodes']} | {100 * low:.0f} to {100 * high:.0f} % "
            f"| {row['unsafe_steps']:.1f} | {100 * row['least_room']:.1f} | {100 * row['corrected']:.0f} %"
        )
    return (
        markdown_table(
            "model | safe | 95 % interval | unsafe steps an episode | least room [cm] | corrected",
            rows,
            above=f"**{name}** (in truth {true}): added {found or 'nothing'}; held-out error {case['error'][0]:.3g} to "
            f"{case['error'][-1]:.3g}.",
        )
        + "\n"
    )


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment point-story``."""
    asked = {name: options[name] for name in ("robots", "seconds", "seed")}
    story = PointStory(hidden=options["hidden"] or tuple(HIDDEN), **asked)
    return {"date": time.strftime("%Y-%m-%d"), **point_story(story, report_progress)}
