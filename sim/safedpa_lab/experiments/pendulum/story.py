"""The whole story on a second robot: recorded swings, compare, diagnose, add; and is the pendulum safer for it?

A pendulum carries half a kilogram or rubs in its hinge, and no model knows. The filter keeps it within 45 degrees under
torques at random, in winds that it has to find out about, with the shipped model, with the one that diagnosis made of
it, and with an oracle. Each model has a margin of its own, calibrated on the same swings at the same coverage; the
shipped model runs again with the diagnosed one's margin, to show what the larger one is needed for.
"""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Final, final

import numpy as np

from safedpa.adaptation import AdaptationNode, HistoryEstimator, LatentEstimator
from safedpa.arrays import FloatArray
from safedpa.bus import AbstractNode
from safedpa.calibration.from_runs import calibration_from_runs
from safedpa.diagnosis.diagnose import add_effect, diagnose
from safedpa.dynamics import LearnedBase, PhysicsModel, Setting, load_model, parse_model, write_model
from safedpa.effects import effect
from safedpa.errors import InputError
from safedpa.policy import PolicyNode
from safedpa.progress import progress
from safedpa.records.run import Run, Stretch
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import settings_named
from safedpa.safety.margins.calibration import MarginCalibration
from safedpa_lab.experiments.common.statistics import wilson_interval
from safedpa_lab.experiments.common.workers import Workers
from safedpa_lab.experiments.diagnosis.diagnosing import alongside_the_truth
from safedpa_lab.experiments.diagnosis.real_logs_data import PENDULUM, mapped_runs, paths_of
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.experiments.report import markdown_table
from safedpa_sim.closed_loop import drive
from safedpa_sim.pendulum.task import BALANCING
from safedpa_sim.robots import PendulumRobot, task_named, wind_towards
from safedpa_sim.robots.pendulum.world import PendulumParameters, PendulumWorld

PERIOD: Final = 0.01
"""s"""
_SWUNG_TORQUE: Final = 10.0
"""N m; the motor's."""
_SWUNG_HELD: Final = (5, 40)
"""Periods for which a torque is held."""


@dataclass(frozen=True)
class HiddenPendulum:
    """The robot's own numbers, and the effects of the library that say so."""

    parameters: PendulumParameters
    effects: Mapping[str, Mapping[str, float]]


HIDDEN: Final = {
    "payload": HiddenPendulum(PendulumParameters(payload=0.5), {"tip_mass": {"mass": 0.5}}),
    "dry friction": HiddenPendulum(PendulumParameters(dry_friction=1.5), {"coulomb_friction": {"torque": 1.5}}),
    "both": HiddenPendulum(
        PendulumParameters(payload=0.5, dry_friction=1.5),
        {"tip_mass": {"mass": 0.5}, "coulomb_friction": {"torque": 1.5}},
    ),
}
"""By name: half a kilogram more on one, a hinge that rubs."""


def oracle_model(hidden: HiddenPendulum) -> PhysicsModel:
    """The shipped model, its wind free, with what is hidden added to it."""
    model = load_model("pendulum")
    for name, values in hidden.effects.items():
        model = model.with_effect(effect("pendulum", name), {key: Setting(value) for key, value in values.items()})
    return model


def swings_all_around(
    hidden: HiddenPendulum, wind: tuple[float, float], seed: int, count: int, seconds: float
) -> list[Run]:
    """Runs as an engineer makes them to see what a pendulum does: torques at random, each held for a while.

    ``wind`` [m/s] along x and y blows through all of them.
    """
    rows, system = round(seconds / PERIOD), load_model("pendulum").system
    runs = []
    for number in range(count):
        random = np.random.default_rng([seed, number, 6])
        world = PendulumWorld(float(random.uniform(-np.pi, np.pi)), wind, hidden.parameters)
        states, torques = swing_at_random(world, random, rows, _SWUNG_TORQUE, _SWUNG_HELD)
        t = np.arange(rows, dtype=np.float64) * PERIOD
        runs.append(Run(f"swing {number + 1}", system, t, states, torques, (Stretch(0, rows),)))
    return runs


def swing_at_random(
    world: PendulumWorld, random: np.random.Generator, rows: int, largest: float, held: tuple[int, int]
) -> tuple[FloatArray, FloatArray]:
    """States (rows, 2) [rad, rad/s] and the torques (rows, 1) that follow them, uniform within +- ``largest`` [N m].

    Each is held for a number of periods that lies within ``held``, its upper end not included.
    """
    states, torques = np.empty((rows, 2)), np.empty((rows, 1))
    left, torque = 0, 0.0
    for row in range(rows):
        if left == 0:
            left, torque = int(random.integers(*held)), float(random.uniform(-largest, largest))
        left -= 1
        states[row], torques[row] = (world.angle, world.rate), torque
        world.advance(torque, PERIOD)
    return states, torques


_SETTINGS = "pendulum"
_HORIZON = 0.3
"""s; over which predictions are compared."""
_DAY = (2.0, 60.0)
"""m/s and degrees; the wind of the day on which the swings for the diagnosis were recorded."""
_SEED = 7000
"""Of the swings for the diagnosis; those for the margins have the next one."""
_DATE = "2024-01-01"
"""Date of calibrations that are not kept."""


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


def pendulum_story(story: PendulumStory, report_progress: ReportProgress = silent) -> dict[str, Any]:
    """For each hidden effect the diagnosis, and one row per model: safety, margin, room."""
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
    given["shipped, margin of the diagnosed"] = (shipped, replace(same, fingerprint=given["shipped"][1].fingerprint))
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
    nodes: list[AbstractNode] = [AdaptationNode(model), PolicyNode(model, controller="random"), keeper]
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


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment pendulum-story``."""
    names = ("directions", "episodes", "seconds", "seed", "learned", "processes")
    story = PendulumStory(hidden=options["hidden"] or tuple(HIDDEN), **{name: options[name] for name in names})
    cases = None if options["data"] is None else PayloadCases(options["data"], processes=options["processes"])
    result = {"date": time.strftime("%Y-%m-%d"), **pendulum_story(story, report_progress)}
    if cases is not None:
        with progress("payloads") as report_payloads:
            result["payloads"] = payload_cases(cases, report_payloads)
    return result


_PAYLOAD_HORIZON = 0.4
"""s"""
_TORQUE = 2.5
"""N m; about what the real motor gives."""
_HELD = (10, 60)
"""Periods for which a torque is held."""
_NOISE = (0.002, 0.01)
"""rad and rad/s; standard deviations of what the sensors add."""


@final
@dataclass(frozen=True)
class PayloadCases:
    """What is to be run. Raises InputError where there is no log of the real pendulum under ``data``."""

    data: Path
    masses: tuple[float, ...] = (0.05, 0.1, 0.2, 0.4)
    """kg"""
    seeds: tuple[int, ...] = (0, 1, 2)
    runs: int = 3
    seconds: float = 20.0
    processes: int = 2

    def __post_init__(self) -> None:
        if not paths_of(self.data, PENDULUM):
            raise InputError(f"--data {self.data}: got no {PENDULUM} under it, wanted logs of DFKI's pendulum")


def identified_pendulum(data: Path) -> PhysicsModel:
    """The real pendulum as its logs tell it: what diagnosis made of the shipped model, nothing of it free any more."""
    model = load_model("dfki_pendulum")
    found = diagnose(
        model, mapped_runs(paths_of(data, PENDULUM), model, "dfki_pendulum_columns"), _PAYLOAD_HORIZON
    ).models[-1]
    return found.with_settings({path: Setting(item.value) for path, item in found.settings.items()})


def payload_cases(cases: PayloadCases, report_progress: ReportProgress = silent) -> dict[str, Any]:
    """The identified numbers; for each payload and seed what was named first, the mass and its deviation; how many."""
    identified = identified_pendulum(cases.data)
    text = write_model(identified)
    work = [(text, mass, seed, cases.runs, cases.seconds) for mass in (0.0, *cases.masses) for seed in cases.seeds]
    rows = []
    with Workers(cases.processes) as workers:
        for row in workers.map(diagnosed_payload, work):
            rows.append(row)
            report_progress(len(rows), len(work))
    loaded = [row for row in rows if row["mass"] > 0.0]
    return {
        "identified": {path: item.value for path, item in identified.settings.items()},
        "rows": rows,
        "first": sum(row["first"] == "tip_mass" for row in loaded),
        "within_two_deviations": sum(bool(row["within"]) for row in loaded),
        "cases": len(loaded),
        "false_alarms": sum(row["added"] != [] for row in rows if row["mass"] == 0.0),
    }


def diagnosed_payload(work: tuple[str, float, int, int, float]) -> dict[str, Any]:
    """One case: what diagnosis says of (identified model as TOML, payload [kg], seed, logs, seconds of each)."""
    text, mass, seed, count, seconds = work
    model = parse_model(text)
    found = diagnose(model, _logs(model, mass, seed, count, seconds), _PAYLOAD_HORIZON)
    value = found.parameters.get("tip_mass.mass")
    off = None if value is None or value.std is None else abs(value.value - mass) / value.std
    return {
        "mass": mass,
        "seed": seed,
        "added": list(found.added),
        "first": found.added[0] if found.added else "",
        "value": None if value is None else value.value,
        "std": None if value is None else value.std,
        "within": off is not None and off <= 2.0,
        "error": [stage.heldout_error for stage in found.stages],
    }


def _logs(model: PhysicsModel, mass: float, seed: int, count: int, seconds: float) -> Sequence[Run]:
    """Logs of the user's robot: torques at random from hanging, each held for a while, read by noisy sensors."""
    value = {path: item.value for path, item in model.settings.items()}
    body = PendulumParameters(
        length=value["base.length"],
        mass=value["base.mass"],
        friction=value.get("viscous_friction.coefficient", 0.0),
        drag=0.0,
        payload=mass,
        dry_friction=value.get("coulomb_friction.torque", 0.0),
    )
    rows, runs = round(seconds / PERIOD), []
    for number in range(count):
        random = np.random.default_rng([seed, number, 8])
        world = PendulumWorld(np.pi, parameters=body)
        states, torques = swing_at_random(world, random, rows, _TORQUE, _HELD)
        seen = states + random.normal(0.0, _NOISE, states.shape)
        t = np.arange(rows, dtype=np.float64) * PERIOD
        runs.append(Run(f"log {number + 1}", model.system, t, seen, torques, (Stretch(0, rows),)))
    return runs


_COLOURS = {"shipped": "#7A8590", "shipped, margin of the diagnosed": "#DCE1E6", "oracle": "#222222"}
_DIAGNOSED, _LEARNED = "#0072B2", "#E69F00"


def story_markdown(result: dict[str, Any]) -> str:
    """For each hidden thing a sentence and a table; then the user's payloads, where they were run."""
    parts = [
        f"{result['directions']} wind directions x {result['episodes']} episodes of {result['seconds']:g} s, "
        f"{result['wind']:g} m/s, seed {result['seed']}, {result['date']}.\n"
    ]
    parts += [_case(name, case) for name, case in result["cases"].items()]
    if "payloads" in result:
        parts.append(_payloads(result["payloads"]))
    return "\n".join(parts)


def _case(name: str, case: dict[str, Any]) -> str:
    true = ", ".join(f"{effect} {value:g}" for effect, entries in case["true"].items() for value in entries.values())
    found = ", ".join(_value(case["values"], effect) for effect in case["added"]) or "nothing"
    error = " to ".join(f"{value:.3g}" for value in (case["error"][0], case["error"][-1]))
    rows = []
    for title, row in case["rows"].items():
        low, high = row["interval_safe"]
        rows.append(
            f"{title} | {1000 * row['margin']:.1f} | {row['safe']}/{row['episodes']} "
            f"| {100 * low:.0f} to {100 * high:.0f} % | {np.degrees(row['least_room']):.1f} "
            f"| {np.degrees(row['reach']):.1f} | {100 * row['corrected']:.0f} %"
        )
    return (
        markdown_table(
            "model | margin [mrad] | safe | 95 % interval | least room [deg] | uses of 45 degrees | corrected",
            rows,
            above=f"**{name}** (in truth {true}): added {found}; held-out error {error}.",
        )
        + "\n"
    )


def _value(values: dict[str, Any], effect: str) -> str:
    own = [item for path, item in values.items() if path.startswith(f"{effect}.")]
    return f"{effect} " + ", ".join(f"{item['value']:.3f} +- {item['std'] or 0.0:.3f} {item['unit']}" for item in own)


def _payloads(found: dict[str, Any]) -> str:
    rows = []
    for row in found["rows"]:
        mass = "" if row["value"] is None else f"{row['value']:.4f} +- {row['std'] or 0.0:.4f}"
        error = " to ".join(f"{value:.4f}" for value in dict.fromkeys((row["error"][0], row["error"][-1])))
        rows.append(f"{row['mass']:g} | {row['seed']} | {', '.join(row['added'])} | {mass} | {error}")
    return (
        markdown_table(
            "payload [kg] | seed | added | mass [kg] | held-out error",
            rows,
            above=f"A user's pendulum, identified from the real logs (mass {found['identified']['base.mass']:.3f} kg): "
            f"`tip_mass` named first in {found['first']} of {found['cases']} cases, within two deviations in "
            f"{found['within_two_deviations']}; without a payload something was added in {found['false_alarms']}.",
        )
        + "\n"
    )


def write_figure(result: dict[str, Any], out: Path) -> None:
    """``pendulum_story.png`` in the folder ``out``: the margins, and how much of the 45 degrees is used."""
    from safedpa_lab.experiments.common.figures import bare, figure, heading

    cases = result["cases"]
    names = list(next(iter(cases.values()))["rows"])
    width = 0.8 / len(names)
    with figure(out / "pendulum_story.png", 3.4) as drawn:
        panels = drawn.subplots(1, 2)
        for number, name in enumerate(names):
            at = np.arange(len(cases)) + (number - 0.5 * (len(names) - 1)) * width
            colour = _COLOURS.get(name, _LEARNED if name.startswith("learned") else _DIAGNOSED)
            rows = [case["rows"][name] for case in cases.values()]
            hatch = "//" if name == "learned" else None
            look: dict[str, Any] = {"color": colour, "hatch": hatch, "edgecolor": "white", "linewidth": 0.5}
            panels[0].bar(at, [1000 * row["margin"] for row in rows], width, label=name, **look)
            panels[1].bar(at, [np.degrees(row["reach"]) for row in rows], width, **look)
            for place, row in zip(at, rows, strict=True):
                if row["safe"] < row["episodes"]:
                    missed = f"{row['episodes'] - row['safe']} left"
                    panels[1].text(place, np.degrees(row["reach"]), missed, fontsize=6, rotation=90, ha="center")
        for axes, title in zip(panels, ("margin [mrad]", "95 % quantile of the tilt [deg]"), strict=True):
            axes.set_xticks(range(len(cases)), list(cases))
            axes.set_title(title, fontsize=9)
            bare(axes)
        panels[1].set_ylim(25, 47)
        panels[1].axhline(45.0, color="#D55E00", linewidth=1.0)
        drawn.legend(loc="outside lower center", ncols=len(names), fontsize=6.5, frameon=False)
        heading(drawn, "What knowing the missing effect is worth: a smaller margin, more of the 45 degrees")
