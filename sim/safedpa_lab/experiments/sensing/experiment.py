"""Drives with a laser as the only sensor, compared with the same drives with perfect knowledge.

A collision counts as the car's if the car moved (``IS_STATIONARY`` or faster). Contacts with a standing car are counted
separately.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import asdict, dataclass
from math import inf, pi
from pathlib import Path
from typing import Any

import numpy as np

from safedpa.adaptation import AdaptationNode
from safedpa.bus import AbstractNode
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa.perception import PerceptionNode, PerceptionSettings, SourceSettings
from safedpa.policy import PolicyNode
from safedpa.robots.car.dynamics.limits import IS_STATIONARY
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.common.drives import PERIOD, shipped_nodes
from safedpa_lab.experiments.common.seeds import seeds_of
from safedpa_lab.experiments.common.statistics import clopper_pearson_interval, ratio_interval
from safedpa_lab.experiments.common.workers import driven
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent, with_options
from safedpa_lab.experiments.report import interval, markdown_table, page, percent
from safedpa_lab.experiments.sensing.nodes import (
    CollisionMonitor,
    NoFilter,
    ReportsAllButWhoHides,
    ReportsEverything,
    TimeToCollision,
)
from safedpa_lab.experiments.sensing.scenes import PEOPLE, SCENES, scene_and_people
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.car.loads import LOADS as TOWED
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.sensing import LaserSettings, Person, StepsOut
from safedpa_sim.sensing.other_sources import KNOWN_SOURCES, make_sources
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors

GUARDS = ("safedpa", "reported", "reported-but-hiding", "monitor", "monitor-2s", "time-to-collision", "nothing")
"""The guard between policy and car: the filter with the laser; the filter with perfect knowledge; with
everything but who hides, who may be wherever the laser does not look; nav2's collision monitor by its defaults and with
more time; the F1TENTH course's brake; no one. The last four hear the same scans."""
LOADS = ("none", *TOWED)
ALL = "all"
"""Scene or load of a row about all of them."""
POLICIES = ("way_seeker", "goal_seeker")
"""One that gets the same surroundings as the filter, and one that ignores them."""


@dataclass(frozen=True)
class Drive:
    """One drive; speeds in m/s."""

    scene: str
    seed: int
    seconds: float
    coming: float
    """Speed that perception assumes for hidden objects."""
    guard: str = GUARDS[0]
    load: str = LOADS[0]
    policy: str = POLICIES[1]
    walking: float = 1.5
    """Speed of the people, at most."""
    noise: float = 0.02
    """m; of each range."""
    latency: float = 0.05
    """s from a scan until it is published."""
    field_of_view: float = 2.0 * pi
    """rad"""
    people: int = PEOPLE
    """Number of people in the scene "people"."""
    source: str = KNOWN_SOURCES[0]
    """The only kind of sensor; noise, latency and field of view are those of a laser."""
    fastest: float = 1.5
    restless: float = 10.0
    memory: float = 30.0
    """Settings of perception: m/s and s."""
    sees_load: bool = True
    """Whether rays hit the load; otherwise the sensor looks over it."""


def repeating(names: Sequence[str]) -> dict[str, SourceSettings]:
    """Returns the settings of sensors: all but a laser measure in coarse steps, and repeat while the robot stands."""
    return {name: SourceSettings(repeats=True) for name in names if name != KNOWN_SOURCES[0]}


def _nodes(
    wanted: Drive, model: PhysicsModel, scene: Scene, people: Sequence[Person], sensors: Sequence[str]
) -> list[AbstractNode]:
    """In the order of the data flow; ``sensors`` are names."""
    policy = PolicyNode(model, wanted.policy)
    peers: dict[str, Callable[[], AbstractNode]] = {
        "monitor": CollisionMonitor,
        "monitor-2s": lambda: CollisionMonitor(2.0, 3),
        "time-to-collision": TimeToCollision,
        "nothing": NoFilter,
    }
    settings = PerceptionSettings(
        coming=wanted.coming, fastest=wanted.fastest, restless=wanted.restless, memory=wanted.memory,
        sources=repeating(sensors),
    )  # fmt: skip
    if wanted.guard in peers:  # a controller that looks around sees the same behind each of them
        eyes = [PerceptionNode(settings)] if wanted.policy == POLICIES[0] else []
        return [AdaptationNode(model), *eyes, policy, peers[wanted.guard]()]
    reported: dict[str, Callable[[], AbstractNode]] = {
        "reported": lambda: ReportsEverything(scene, people),
        "reported-but-hiding": lambda: ReportsAllButWhoHides(scene, people, settings),
    }
    looks = [reported[wanted.guard]() if wanted.guard in reported else PerceptionNode(settings)]
    return shipped_nodes(model, settings_named("car"), *looks, policy)


def run_drive(wanted: Drive) -> dict[str, Any]:
    """Drives it; the same drive gives the same numbers."""
    model = load_model("car")
    scene, people = scene_and_people(wanted.scene, wanted.seed, wanted.load, wanted.walking, wanted.people)
    laser = LaserSettings(noise=wanted.noise, latency=wanted.latency, field_of_view=wanted.field_of_view)
    sensors = SimulatedSensors(make_sources(wanted.source, wanted.seed, laser), people, sees_load=wanted.sees_load)
    robot = CarRobot(scene, sensor_inputs=sensors)
    nodes = _nodes(wanted, model, scene, people, sensors.names)
    way, microseconds, nominal_way, retained = 0.0, [], 0.0, 0.0
    for tick in drive(robot, nodes, round(wanted.seconds / PERIOD)):
        if tick.verdict.nominal:
            nominal_way += abs(tick.verdict.nominal[0])
            retained += min(
                max(tick.verdict.action[0] * np.sign(tick.verdict.nominal[0]), 0.0), abs(tick.verdict.nominal[0])
            )
        way += abs(tick.state.values[3]) * PERIOD
        microseconds.append(tick.verdict.microseconds)
    moving = [hit for hit in robot.collisions if hit.speed >= IS_STATIONARY]
    return {
        **asdict(wanted),
        "moving": [str(hit) for hit in moving],
        "run_into": sum(hit.towards < IS_STATIONARY for hit in moving),
        "standing": len(robot.collisions) - len(moving),
        "stepped_out": any(isinstance(person, StepsOut) and person.stepped for person in people),
        "goals": robot.goals_reached,
        "way": way,
        "retained": retained / max(nominal_way, 1e-9),
        "microseconds": float(np.median(microseconds)),
        "trajectory": robot.trajectory_hash,
    }


def sensing_experiment(
    seeds: Sequence[int],
    seconds: float,
    coming: float,
    processes: int = 2,
    guards: Sequence[str] = GUARDS,
    on_drive: ReportProgress = silent,
    scenes: Sequence[str] = SCENES,
    loads: Sequence[str] = LOADS[:1],
    policy: str = POLICIES[0],
    record: Path | None = None,
    people: int = PEOPLE,
    source: str = KNOWN_SOURCES[0],
) -> dict[str, Any]:
    """Every scene with every seed and load behind each guard; one row for each scene and guard.

    Drives that ``record`` holds are not driven again, and those that are driven are added to it, a line each. Raises
    InputError where it holds something else, or drives by other code.
    """
    kinds = [(scene, guard) for scene in scenes for guard in guards]
    wanted = [
        Drive(scene, seed, seconds, coming, guard, load, policy, people=people, source=source)
        for scene, guard in kinds
        for seed in seeds
        for load in loads
    ]
    found = driven(run_drive, wanted, processes, on_drive, record)
    by_kind = {kind: [one for one in found if (one["scene"], one["guard"]) == kind] for kind in kinds}
    by_load = []
    for (scene, guard), drives in by_kind.items():
        for load in loads:
            goals = [one["goals"] for one in drives if one["load"] == load]
            row = {"scene": scene, "guard": guard, "load": load, "drives": len(goals)}
            by_load.append({**row, "goals_a_minute": 60.0 * sum(goals) / (seconds * len(goals))})
    chosen = {"seconds": seconds, "coming": coming, "seeds": list(seeds), "loads": list(loads), "policy": policy}
    rows = [row_of(kind, drives, by_kind.get((kind[0], "reported"), []), seconds) for kind, drives in by_kind.items()]
    return {
        **chosen,
        "people": people,
        "source": source,
        "rows": rows,
        "by_load": by_load,
        "shares": goal_shares(found),
    }


def at_most_95(hits: int, trials: int) -> float:
    """One-sided 95 % upper bound of the share hits / trials. Source: Clopper and Pearson, Biometrika 26 (1934) 404."""
    from scipy.stats import beta

    return 1.0 if hits == trials else float(beta.ppf(0.95, hits + 1, trials - hits))


def goal_shares(found: Sequence[Mapping[str, Any]]) -> list[dict[str, Any]]:
    """Goals of the filter with the laser as a share of those behind each other guard, on the same drives.

    A row for each scene, load and guard, and for all loads and all scenes together ("all"). ``contacts`` are the drives
    behind the other guard in which the car moved into something.
    """
    scenes, loads = (list(dict.fromkeys(one[key] for one in found)) for key in ("scene", "load"))
    groups = [(scene, load) for scene in scenes for load in loads]
    groups += [(scene, ALL) for scene in scenes if len(loads) > 1]
    groups += [(ALL, ALL)] if len(scenes) > 1 else []
    rows = []
    for scene, load in groups:
        drives = [one for one in found if scene in (one["scene"], ALL) and load in (one["load"], ALL)]
        own = [one for one in drives if one["guard"] == GUARDS[0]]
        for guard in dict.fromkeys(one["guard"] for one in drives if own and one["guard"] != GUARDS[0]):
            others = {(one["scene"], one["load"], one["seed"]): one for one in drives if one["guard"] == guard}
            pairs = [(one, others[one["scene"], one["load"], one["seed"]]) for one in own]
            mine, theirs = (np.array([float(one["goals"]) for one in side]) for side in zip(*pairs, strict=True))
            row = {"scene": scene, "load": load, "guard": guard, "drives": len(pairs)}
            row |= {"goals": float(theirs.sum()), "contacts": sum(bool(other["moving"]) for _, other in pairs)}
            rows.append({**row, "share": ratio_interval(mine, theirs) if theirs.sum() else None})
    return rows


def row_of(
    kind: tuple[str, str], drives: list[dict[str, Any]], reported: list[dict[str, Any]], seconds: float
) -> dict[str, Any]:
    """The row of a scene and guard; ``reported``: the same drives with perfect knowledge, in the same order."""
    hit = sum(bool(one["moving"]) for one in drives)
    goals = np.array([float(one["goals"]) for one in drives])
    others = np.array([float(one["goals"]) for one in reported])
    return {
        "scene": kind[0],
        "guard": kind[1],
        "drives": len(drives),
        "drives_in_which_the_car_moved_into_something": hit,
        "share_95": clopper_pearson_interval(hit, len(drives)),
        "at_most_95": at_most_95(hit, len(drives)),
        "which": [f"seed {one['seed']}, load {one['load']}: {what}" for one in drives for what in one["moving"]],
        "of_them_it_did_not_drive_towards": sum(one["run_into"] for one in drives),
        "touched_while_it_stood": sum(one["standing"] for one in drives),
        "drives_in_which_somebody_stepped_out": sum(one["stepped_out"] for one in drives),
        "goals_a_minute": 60.0 * float(goals.sum()) / (seconds * len(drives)),
        "goals_beside_perfect_knowledge": ratio_interval(goals, others) if others.sum() > 0.0 else None,
        "share_of_nominal_speed": float(np.mean([one["retained"] for one in drives])),
        "metres_a_minute": 60.0 * sum(one["way"] for one in drives) / (seconds * len(drives)),
        "median_microseconds": float(np.median([one["microseconds"] for one in drives])),
    }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment sensing``. Raises InputError for an assumed speed of hidden people beyond 1.5 m/s."""
    if not 0.0 <= options["coming"] <= 1.5:
        raise InputError(f"--coming: got {options['coming']}, wanted 0 to 1.5 m/s")
    wanted = {"reported": options["perfect_knowledge"], "reported-but-hiding": options["hiding"]}
    others = [guard for guard in GUARDS[1:] if wanted.get(guard, options["peers"])]
    known = {"seeds": seeds_of(options), "guards": (GUARDS[0], *others), "on_drive": report_progress}
    found = with_options(sensing_experiment, options, **known)
    return {"experiment": "sensing", **found}


_GUARDS = {
    "safedpa": "this filter, its sensors alone",
    "reported": "this filter, perfect knowledge",
    "reported-but-hiding": "this filter, knowing all but hidden people",
    "monitor": "nav2's collision monitor, its defaults (1.2 s, 6 points)",
    "monitor-2s": "the same with 2 s, 3 points",
    "time-to-collision": "time to collision below 0.8 s (F1TENTH course)",
    "nothing": "nothing",
}


def page_of(result: Mapping[str, Any]) -> str:
    """Markdown with a table of all rows, and the command that made it."""
    seeds, rows = result["seeds"], result["rows"]
    lines = [f"{row['scene']} | {_GUARDS[row['guard']]} | {row['drives']} | {counted_cells(row)}" for row in rows]
    elsewhere = sum(row["of_them_it_did_not_drive_towards"] for row in rows)
    hit = [f"- {row['scene']}, {row['guard']}: {what}" for row in rows for what in row["which"]]
    towards = "car or load did not drive towards it, at less than 0.1 m/s: it came to them"
    return page(
        f"Drives with {result.get('source', 'laser')} as the only sensor",
        f"Seeds {seeds[0]} to {seeds[-1]}, loads {', '.join(result['loads'])}, {result['seconds']:g} s each, "
        f"controller {result.get('policy', 'goal_seeker')}, {result.get('people', PEOPLE)} people in the scene "
        "'people'. A collision is the car's where it was at 0.1 m/s or more. 'At most' is the one-sided bound at 95 %.",
        result,
        markdown_table(f"scene | behind | drives | {COUNTED}", lines),
        *_by_load(result.get("by_load", ()), result["loads"]),
        *_share_table(result.get("shares", ())),
        *((f"Into what (in {elsewhere} of these {towards}):", "\n".join(hit)) if hit else ()),
    )


COUNTED = (
    "car moved into something | 95 % of it | at most | touched while it stood | goals a minute "
    "| of those with perfect knowledge | m a minute"
)
"""Head of the columns of ``counted_cells``."""


def counted_cells(row: Mapping[str, Any], least: float = -inf) -> str:
    """Contacts, goals and way of a row as cells; ``least`` clips the interval of the ratio of goals."""
    alongside = row["goals_beside_perfect_knowledge"]
    return (
        f"{row['drives_in_which_the_car_moved_into_something']} | {percent(row['share_95'])} "
        f"| {100.0 * at_most_95(row['drives_in_which_the_car_moved_into_something'], row['drives']):.1f} % "
        f"| {row['touched_while_it_stood']} | {row['goals_a_minute']:.1f} "
        f"| {'' if alongside is None else interval(alongside, digits=2, least=least)} | {row['metres_a_minute']:.0f}"
    )


def _by_load(found: Sequence[Mapping[str, Any]], loads: Sequence[str]) -> tuple[str, ...]:
    """A table of the goals with each load, where there are several."""
    if len(loads) < 2 or not found:
        return ()
    goals = {(one["scene"], one["guard"], one["load"]): f"{one['goals_a_minute']:.1f}" for one in found}
    kinds = dict.fromkeys((one["scene"], one["guard"]) for one in found)
    rows = (f"{kind[0]} | {_GUARDS[kind[1]]} | {' | '.join(goals[(*kind, load)] for load in loads)}" for kind in kinds)
    return "Goals a minute by load:", markdown_table(f"scene | behind | {' | '.join(loads)}", rows)


def _share_table(shares: Sequence[Mapping[str, Any]]) -> tuple[str, ...]:
    """A table of the goals as a share of those behind others, and which peer without contact reaches most."""
    rows = [
        f"{row['scene']} | {row['load']} | {_GUARDS[row['guard']]} | {row['contacts']} of {row['drives']} "
        f"| {'' if row['share'] is None else interval(row['share'], digits=2)}"
        for row in shares
    ]
    if not rows:
        return ()
    whole = (shares[-1]["scene"], shares[-1]["load"])
    peers = [row for row in shares if (row["scene"], row["load"]) == whole and not row["guard"].startswith("reported")]
    clean = [row for row in peers if not row["contacts"] and row["share"] is not None]
    best = max(clean, key=lambda row: row["goals"], default=None)
    sentence = "Of the others without a contact, none reached a goal."
    if best is not None:
        sentence = (
            f"Of the others without a contact, most goals: {_GUARDS[best['guard']]}; "
            f"this filter reaches {interval(best['share'], digits=2)} of them."
        )
    head = "scene | load | other guard | its drives with a contact | goals of this filter as a share of its goals"
    return "Goals on the same drives:", markdown_table(head, rows), *((sentence,) if peers else ())
