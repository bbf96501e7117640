"""Drives of other robots with a laser as their only sensor, among boxes or pillars, walls and people.

All arms have the same scenes, controllers and sensors. A contact counts if the robot moves (``IS_STATIONARY``).
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from math import hypot
from pathlib import Path
from typing import Any, Final

import numpy as np

from safedpa.adaptation import AdaptationNode
from safedpa.bus import AbstractNode
from safedpa.dynamics import load_model, load_user_file_everywhere
from safedpa.errors import InputError
from safedpa.perception import PerceptionNode, PerceptionSettings
from safedpa.policy import PolicyNode
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.barriers.planar_body import IS_STATIONARY
from safedpa.safety.defaults import margin_for
from safedpa.stand_in import AbstractStandIn
from safedpa.systems.robots import Robot, robot_named
from safedpa_lab.experiments.common.seeds import seeds_of
from safedpa_lab.experiments.common.statistics import ratio_interval
from safedpa_lab.experiments.common.workers import driven
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent, with_options
from safedpa_lab.experiments.report import interval, markdown_table, page
from safedpa_lab.experiments.sensing.experiment import at_most_95, repeating
from safedpa_lab.experiments.sensing.nodes import ReportsEverything, edge_points
from safedpa_lab.experiments.sensing.zoned import ZonedPolicy, converted, face_of
from safedpa_sim.closed_loop import drive
from safedpa_sim.robots.stand_in_robot import StandInRobot
from safedpa_sim.sensing import LaserSettings
from safedpa_sim.sensing.other_sources import KNOWN_SOURCES, make_sources
from safedpa_sim.sensing.people import walkers_in
from safedpa_sim.sensing.stand_in_sensors import StandInSensors

_EXAMPLES: Final = Path(__file__).resolve().parents[4] / "docs" / "examples"
ROBOTS: Final[Mapping[str, Path | None]] = {
    "differential_drive": None,
    "drone": _EXAMPLES / "drone" / "drone.py",
    "omni": Path(__file__).with_name("omni.py"),
}
"""By name, the file that declares each robot; None: it ships."""
ARMS: Final = ("safedpa", "reported")
"""What the filter knows: what the laser sees, or everything."""
_APART: Final = 0.03
"""m between the points of an edge at which contacts are looked for."""
_NO_WAY: Final = 0.3
"""m; a robot that drives less has not moved."""


@dataclass(frozen=True)
class PlanarDrive:
    """One drive."""

    robot: str
    seed: int
    seconds: float
    people: int
    arm: str = ARMS[0]
    coming: float = 1.5
    """m/s; speed that perception assumes for hidden people."""
    source: str = "laser"
    """The only kind of sensor, of ``KNOWN_SOURCES``."""
    monitor: str = ""
    """File with the parameters of Nav2's collision monitor, whose zones limit the nominal action; empty: none."""


def _declared(name: str) -> Robot:
    path = ROBOTS[name]
    if path is not None:
        if not path.exists():
            raise InputError(f"--robot {name}: got no {path}; run it in a checkout of the project")
        load_user_file_everywhere(path)
    return robot_named(name)


def run_planar_drive(wanted: PlanarDrive) -> dict[str, Any]:
    """Drives it; the same drive gives the same numbers."""
    declared = _declared(wanted.robot)
    model, settings = load_model(str(declared.model)), declared.settings()
    names, body = declared.system.state_names, declared.planar_body(model, settings)
    yaw = names.index(body.pose[2]) if len(body.pose) == 3 else -1
    pose = (names.index(body.pose[0]), names.index(body.pose[1]), yaw)

    def sensors(stand_in: AbstractStandIn) -> StandInSensors:
        looks = make_sources(wanted.source, wanted.seed, LaserSettings(mount=(0.0, 0.0, 0.0)))
        polygons = getattr(stand_in, "polygons", ())
        empty = StandInSensors((), polygons=polygons, pose=pose)
        start = empty.pose(stand_in)[:2]
        people = walkers_in(empty.solid(stand_in), stand_in.field, start, wanted.people, wanted.seed)
        return StandInSensors(looks, people, polygons, pose, body.parts)

    robot = StandInRobot(declared, 1.0 / declared.rate, wanted.seed, sensors=sensors)
    assert robot.sensors is not None
    eyes = PerceptionNode(PerceptionSettings(coming=wanted.coming, sources=repeating(robot.sensors.names)))
    everything = ReportsEverything(robot.sensors.solid(robot.stand_in), robot.sensors.people)
    looks = eyes if wanted.arm == ARMS[0] else everything
    policy: AbstractNode = PolicyNode(model, declared.default_controller)
    if wanted.monitor:
        policy = ZonedPolicy(
            PolicyNode(model, declared.default_controller),
            face_of(declared),
            converted(Path(wanted.monitor), wanted.robot)[0],
        )
    nodes = [AdaptationNode(model), looks, policy, SafetyFilterNode(model, settings, margin_for(model))]
    contacts, statuses, way = _Contacts(robot), dict[str, int](), 0.0
    before = robot.sensors.pose(robot.stand_in)
    for tick in drive(robot, nodes, round(wanted.seconds * declared.rate)):
        now = robot.sensors.pose(robot.stand_in)
        step = hypot(now[0] - before[0], now[1] - before[1])
        way, before = way + step, now
        contacts.look(tick.state.robot_time, step * declared.rate)
        statuses[tick.verdict.status] = statuses.get(tick.verdict.status, 0) + 1
    return {
        **asdict(wanted),
        "moving": contacts.moving,
        "standing": contacts.standing,
        "goals": robot.goals_reached,
        "way": way,
        "statuses": statuses,
        "zones_acted": policy.acted if isinstance(policy, ZonedPolicy) else 0,
    }


class _Contacts:
    """Counts contacts of the body with everything; each counts once until it ends."""

    def __init__(self, robot: StandInRobot) -> None:
        assert robot.sensors is not None
        self._robot, self._sensors = robot, robot.sensors
        outline = self._sensors.solid(robot.stand_in)
        edges = [edge_points(edge, _APART, 0.0) for edge in outline.edges]
        self._points = np.vstack([np.empty((0, 3)), *([outline.discs] if len(outline.discs) else []), *edges])
        self._touched: set[str] = set()
        self.moving: list[str] = []
        self.standing = 0

    def look(self, time: float, speed: float) -> None:
        """Looks for contacts at ``time`` [s] and ``speed`` [m/s]."""
        stand_in = self._robot.stand_in
        x, y, _ = self._sensors.pose(stand_in)
        near = self._points[np.hypot(self._points[:, 0] - x, self._points[:, 1] - y) - self._points[:, 2] < 1.0]
        now = set()
        if any(self._sensors.gap_to(stand_in, px, py) < radius for px, py, radius in near.tolist()):
            now.add("obstacle")
        for index, person in enumerate(self._sensors.people):
            if self._sensors.gap_to(stand_in, *person.position) < person.radius:
                now.add(f"person {index}")
        for what in now:
            # A contact that began while it stood, and during which it starts to move, counts as one while moving.
            key = f"{what} moving" if speed >= IS_STATIONARY else what
            if key in self._touched or f"{what} moving" in self._touched:
                continue
            if speed >= IS_STATIONARY:
                self.moving.append(f"{what} at t={time:.2f} s, {speed:.2f} m/s")
            else:
                self.standing += 1
            self._touched.add(key)
        self._touched = {key for key in self._touched if key.removesuffix(" moving") in now}


def planar_experiment(
    seeds: Sequence[int],
    seconds: float,
    people: int,
    processes: int = 2,
    robots: Sequence[str] = tuple(ROBOTS),
    sources: Sequence[str] = KNOWN_SOURCES[:1],
    monitors: Sequence[Path] = (),
    on_drive: ReportProgress = silent,
    record: Path | None = None,
) -> dict[str, Any]:
    """Every robot with every seed and arm, with each kind of sensor, and behind the zones of each file of Nav2.

    Raises InputError if such a file cannot be converted, or for a robot that Twist does not drive.
    """
    differences: dict[str, list[str]] = {}
    for robot in robots if monitors else ():
        face_of(_declared(robot))
        differences |= {str(path): converted(path, robot)[1].differences for path in monitors}
    laser = KNOWN_SOURCES[0]
    arms = [*((ARMS[0], source, "") for source in sources), *((ARMS[0], laser, str(path)) for path in monitors)]
    arms.append((ARMS[1], laser, ""))
    kinds = [(robot, *arm) for robot in robots for arm in arms]
    wanted = [
        PlanarDrive(robot, seed, seconds, people, arm, source=source, monitor=monitor)
        for robot, arm, source, monitor in kinds
        for seed in seeds
    ]
    found = driven(run_planar_drive, wanted, processes, on_drive, record)
    by_kind = {kind: found[index * len(seeds) : (index + 1) * len(seeds)] for index, kind in enumerate(kinds)}
    rows = [
        _row(kind, drives, by_kind.get((kind[0], ARMS[0], laser, ""), []), seconds) for kind, drives in by_kind.items()
    ]
    chosen = {"seconds": seconds, "people": people, "seeds": list(seeds)}
    return {**chosen, "rows": rows, "differences": differences}


def _row(
    kind: tuple[str, str, str, str],
    drives: Sequence[Mapping[str, Any]],
    laser: Sequence[Mapping[str, Any]],
    seconds: float,
) -> dict[str, Any]:
    """The row of a robot and arm; ``laser``: the same drives with a laser alone, in the same order."""
    hit, count = sum(bool(one["moving"]) for one in drives), len(drives)
    ticks = sum(sum(one["statuses"].values()) for one in drives)
    braked = sum(one["statuses"].get("fallback", 0) for one in drives)
    goals, others = (np.array([float(one["goals"]) for one in side]) for side in (drives, laser))
    return {
        **dict(zip(("robot", "arm", "source", "monitor"), kind, strict=True)),
        "drives": count,
        "drives_with_a_contact_while_it_moved": hit,
        "at_most_95": at_most_95(hit, count),
        "which": [f"seed {one['seed']}: {what}" for one in drives for what in one["moving"]],
        "touched_while_it_stood": sum(one["standing"] for one in drives),
        "goals_a_minute": 60.0 * float(goals.sum()) / (seconds * count),
        "share_of_goals_by_laser": ratio_interval(goals, others) if others.sum() else None,
        "metres_a_minute": 60.0 * sum(one["way"] for one in drives) / (seconds * count),
        "drives_without_movement": sum(one["way"] < _NO_WAY for one in drives),
        "share_of_fallback": braked / max(ticks, 1),
        "share_of_zones": sum(one["zones_acted"] for one in drives) / max(ticks, 1),
    }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment sensing-robots``."""
    known = {"seeds": seeds_of(options), "on_drive": report_progress}
    return {"experiment": "sensing-robots", **with_options(planar_experiment, options, **known)}


def page_of(result: Mapping[str, Any]) -> str:
    """Markdown with a table of all rows, and the command that made it."""
    seeds = result["seeds"]
    rows = [_cells(row) for row in result["rows"]]
    hit = [f"- {row['robot']}, {_knows(row)}: {what}" for row in result["rows"] for what in row["which"]]
    differences = [
        f"- {Path(path).name}: {sentence}"
        for path, several in result.get("differences", {}).items()
        for sentence in several
    ]
    return page(
        "Other robots with a laser",
        f"Seeds {seeds[0]} to {seeds[-1]}, {result['seconds']:g} s each, {result['people']} people. The bound is "
        "one-sided, with 95 % confidence. A contact counts where the robot was at 0.1 m/s or more. Not moved: less "
        f"than {_NO_WAY:g} m.",
        result,
        markdown_table(
            "robot | knows | drives | contacts while it moved | at most | touched while it stood | goals a minute "
            "| of those by laser | m a minute | drives not moved | fallback | a zone acts",
            rows,
        ),
        *(("Into what:", "\n".join(hit)) if hit else ()),
        *(("Different from Nav2:", "\n".join(differences)) if differences else ()),
    )


def _knows(row: Mapping[str, Any]) -> str:
    knows: str = row["source"] if row["arm"] == ARMS[0] else "everything"
    return f"{knows}, zones of {Path(row['monitor']).name}" if row["monitor"] else knows


def _cells(row: Mapping[str, Any]) -> str:
    share = row["share_of_goals_by_laser"]
    return (
        f"{row['robot']} | {_knows(row)} | {row['drives']} | {row['drives_with_a_contact_while_it_moved']} "
        f"| {100.0 * row['at_most_95']:.1f} % | {row['touched_while_it_stood']} | {row['goals_a_minute']:.1f} "
        f"| {'' if share is None else interval(share, digits=2)} | {row['metres_a_minute']:.0f} "
        f"| {row['drives_without_movement']} | {100.0 * row['share_of_fallback']:.1f} % "
        f"| {100.0 * row['share_of_zones']:.1f} %"
    )
