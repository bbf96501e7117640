"""Several cars on one field, each with a laser alone and a filter of its own: who touches whom, and what is reached.

A contact of two cars counts once. A car moves in it if either was at ``IS_STATIONARY`` or faster. Cars that all keep
passive safety have no such contact, because each stops before it can be touched.
"""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, replace
from itertools import combinations
from math import atan2, cos, hypot, sin
from typing import Any, Final, final

import numpy as np

from safedpa.adaptation import AdaptationNode
from safedpa.arrays import FloatArray
from safedpa.bus import AbstractNode
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.errors import InputError
from safedpa.perception import PerceptionNode, PerceptionSettings
from safedpa.policy import PolicyNode
from safedpa.robots.car.dynamics.limits import IS_STATIONARY
from safedpa.safety.defaults import settings_named
from safedpa_lab.experiments.common.drives import PERIOD, shipped_nodes
from safedpa_lab.experiments.common.seeds import seeds_of
from safedpa_lab.experiments.common.statistics import clopper_pearson_interval
from safedpa_lab.experiments.common.workers import each_result
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent, with_options
from safedpa_lab.experiments.report import markdown_table, page, percent
from safedpa_lab.experiments.sensing.nodes import NoFilter, ReportsEverything
from safedpa_sim.closed_loop import drive_together
from safedpa_sim.robots.car.robot import CarRobot
from safedpa_sim.robots.car.scene import Scene
from safedpa_sim.robots.car.shared_field import SharedField
from safedpa_sim.sensing import Laser, LaserSettings
from safedpa_sim.sensing.sensor_inputs import SimulatedSensors
from safedpa_sim.sensing.shapes import Point

MOST_ROBOTS: Final = 8
LASER: Final = LaserSettings(rays=720)
"""Half a degree from ray to ray: cars are slimmer than people, and with twice that too few rays pass the middle of a
cell 3 m away to show that none is there."""
_SLIMMEST: Final = 0.12
"""m; the discs in a car are slimmer than a person, half as wide as it."""
_APART: Final = 1.5
"""m at least between the rear axles of two cars that begin: their loads do not touch either."""
_TRIES: Final = 400


def meeting_scenes(seed: int, robots: int, load: str = "none") -> tuple[Scene, ...]:
    """One scene a car on the field of ``Scene.random``, whose start and goals the first car has.

    Raises InputError for fewer than 2 or more than 8 cars, and where there is no room for so many.
    """
    if not 2 <= robots <= MOST_ROBOTS:
        raise InputError(f"robots: got {robots}, wanted 2 to {MOST_ROBOTS} on one field")
    scenes, draw = [Scene.random(seed, load)], np.random.default_rng([seed, 31])
    for _ in range(_TRIES):
        if len(scenes) == robots:
            return tuple(scenes)
        x, y, yaw = scenes[0].drawn_start(draw)
        if all(hypot(x - one.start[0], y - one.start[1]) > _APART for one in scenes):
            scenes.append(replace(scenes[0], seed=1000 * seed + len(scenes), start=(x, y, yaw)))
    raise InputError(f"robots: got {robots}, and the field of seed {seed} has room for {len(scenes)}; choose fewer")


def meeting_field(seed: int, robots: int, load: str = "none") -> SharedField:
    """The cars of these scenes, each with its own laser noise."""
    scenes = meeting_scenes(seed, robots, load)
    return SharedField([CarRobot(one, sensor_inputs=SimulatedSensors((Laser(LASER, one.seed),))) for one in scenes])


@final
@dataclass(frozen=True)
class Piece:
    """A disc that covers a piece of a car or its load, and goes where that goes."""

    robot: CarRobot
    along: float
    """m of its middle ahead of the rear axle's middle, or of the load's."""
    radius: float
    of_load: bool = False

    @property
    def position(self) -> Point:
        """x, y [m] now."""
        towed = self.robot.world.towed
        x, y, yaw = towed.pose[:3] if self.of_load and towed else self.robot.values[:3]
        return x + self.along * cos(yaw), y + self.along * sin(yaw)


def pieces_of(robot: CarRobot) -> tuple[Piece, ...]:
    """Three discs that hold all of a car, and one that holds its load."""
    car, load = robot.world.parameters, robot.scene.load
    third = (car.rear + car.front) / 3
    pieces = [Piece(robot, -car.rear + (k + 0.5) * third, hypot(third, car.width) / 2) for k in range(3)]
    return (*pieces, *([] if load is None else [Piece(robot, 0.0, load.side / 2**0.5, of_load=True)]))


GUARDS: Final = ("safedpa", "reported", "nothing")
"""The filter with the laser; the filter with perfect knowledge; the same controller and perception as
the first, and no filter."""
_STUCK_SECONDS: Final = 8.0
"""At the end of a drive, in which neither of a stuck pair gets farther than ..."""
_STUCK_WAY: Final = 0.2
"""m, and both are no farther from each other than ..."""
_STUCK_NEAR: Final = 1.5
"""m. They face each other where each is within the half in front of the other."""


@final
@dataclass(frozen=True)
class Meeting:
    """One drive of several cars."""

    seed: int
    robots: int
    seconds: float
    fastest: float
    """m/s that perception assumes for moving and hidden objects."""
    guard: str = GUARDS[0]
    load: str = "none"


def _nodes(wanted: Meeting, model: PhysicsModel, field: SharedField, index: int) -> list[AbstractNode]:
    """Of one car, in the order of the data flow."""
    robot, fastest = field.robots[index], wanted.fastest
    settings = PerceptionSettings(fastest=fastest, coming=fastest, slimmest=_SLIMMEST)
    others = [piece for one in field.robots if one is not robot for piece in pieces_of(one)]
    perception: AbstractNode = PerceptionNode(settings)
    if wanted.guard == "reported":
        perception = ReportsEverything(robot.scene, others, settings)
    policy = PolicyNode(model, "way_seeker")
    if wanted.guard == "nothing":
        return [AdaptationNode(model), perception, policy, NoFilter()]
    return shipped_nodes(model, settings_named("car"), perception, policy)


def run_meeting(wanted: Meeting) -> dict[str, Any]:
    """Drives it; the same meeting gives the same numbers."""
    model, field = load_model("car"), meeting_field(wanted.seed, wanted.robots, wanted.load)
    nodes = [_nodes(wanted, model, field, index) for index in range(wanted.robots)]
    states = [
        [tick.state.values for tick in ticks] for ticks in drive_together(field, nodes, round(wanted.seconds / PERIOD))
    ]
    path = np.array(states)
    touches = [touch for touch in field.touches if max(touch.speeds) >= IS_STATIONARY]
    solid = [hit for index in range(wanted.robots) for hit in field.collisions(index) if hit.speed >= IS_STATIONARY]
    return {
        **asdict(wanted),
        "moving": [str(touch) for touch in touches],
        "into_standing": sum(min(touch.speeds) < IS_STATIONARY for touch in touches),
        "both_standing": len(field.touches) - len(touches),
        "solid": [str(hit) for hit in solid],
        "goals": [robot.goals_reached for robot in field.robots],
        "standing_share": float((np.abs(path[:, :, 3]) < IS_STATIONARY).mean()),
        "fastest_driven": float(np.abs(path[:, :, 3]).max()),
        "stuck": stuck_pairs(path),
        "trajectory": hashlib.sha256("".join(robot.trajectory_hash for robot in field.robots).encode()).hexdigest(),
    }


def stuck_pairs(path: FloatArray) -> list[dict[str, Any]]:
    """Who stood near each other to the end, from states (ticks, robots, 4): x, y [m], yaw [rad], speed [m/s].

    Of each pair: which two, and whether they face each other.
    """
    last = path[-min(round(_STUCK_SECONDS / PERIOD), len(path)) :]
    end = path[-1]
    still = np.hypot(*(last[:, :, :2] - end[:, :2]).transpose(2, 0, 1)).max(axis=0) < _STUCK_WAY
    pairs = []
    for one, other in combinations(range(len(end)), 2):
        way = end[other, :2] - end[one, :2]
        if still[one] and still[other] and hypot(*way) < _STUCK_NEAR:
            bearing = atan2(way[1], way[0])
            face = cos(bearing - end[one, 2]) > 0.0 and cos(bearing - end[other, 2]) < 0.0
            pairs.append({"robots": [one, other], "face": bool(face)})
    return pairs


def meeting_experiment(
    seeds: Sequence[int],
    robots: Sequence[int],
    seconds: float,
    fastest: float = 2.0,
    guards: Sequence[str] = GUARDS,
    loads: Sequence[str] = ("none",),
    processes: int = 2,
    on_drive: ReportProgress = silent,
) -> dict[str, Any]:
    """Every number of robots with every seed and load behind each guard; a row for each number and guard."""
    kinds = [(count, guard) for count in robots for guard in guards]
    wanted = [
        Meeting(seed, count, seconds, fastest, guard, load)
        for count, guard in kinds
        for seed in seeds
        for load in loads
    ]
    found = each_result(run_meeting, wanted, processes, on_drive)
    rows = [_row(*kind, [one for one in found if (one["robots"], one["guard"]) == kind], seconds) for kind in kinds]
    chosen = {"seconds": seconds, "fastest": fastest, "seeds": list(seeds), "loads": list(loads)}
    return {**chosen, "rows": rows, "drives": found}


def _row(robots: int, guard: str, drives: Sequence[dict[str, Any]], seconds: float) -> dict[str, Any]:
    hit = sum(bool(one["moving"]) for one in drives)
    minutes = len(drives) * robots * seconds / 60.0
    return {
        "robots": robots,
        "guard": guard,
        "drives": len(drives),
        "drives_in_which_a_moving_car_touched_another": hit,
        "share_95": clopper_pearson_interval(hit, len(drives)),
        "contacts_in_which_a_car_moved": sum(len(one["moving"]) for one in drives),
        "of_them_with_a_standing_car": sum(one["into_standing"] for one in drives),
        "contacts_of_standing_cars": sum(one["both_standing"] for one in drives),
        "moved_into_what_is_at_rest": sum(len(one["solid"]) for one in drives),
        "which": [
            f"seed {one['seed']}, load {one['load']}: {what}"
            for one in drives
            for what in (*one["moving"], *one["solid"])
        ],
        "goals_a_minute_and_robot": sum(sum(one["goals"]) for one in drives) / minutes,
        "robots_without_a_goal": sum(goals == 0 for one in drives for goals in one["goals"]),
        "share_of_time_standing": float(np.mean([one["standing_share"] for one in drives])),
        "stuck_pairs": sum(len(one["stuck"]) for one in drives),
        "stuck_face_to_face": sum(pair["face"] for one in drives for pair in one["stuck"]),
        "fastest_driven": max(one["fastest_driven"] for one in drives),
    }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment meeting``. Raises InputError for a number of cars or a speed out of range."""
    for count in options["robots"]:
        if not 2 <= count <= MOST_ROBOTS:
            raise InputError(f"--robots: got {count}, wanted 2 to {MOST_ROBOTS}")
    if not 0.1 <= options["fastest"] <= 20.0:
        raise InputError(f"--fastest: got {options['fastest']}, wanted 0.1 to 20 m/s")
    known = {"seeds": seeds_of(options), "robots": options["robots"] or (2, 4, 8), "on_drive": report_progress}
    found = with_options(meeting_experiment, options, **known)
    return {"experiment": "meeting", **found}


_GUARDS = {
    "safedpa": "this filter, laser alone",
    "reported": "this filter, perfect knowledge",
    "nothing": "no filter, the same controller",
}


def page_of(result: Mapping[str, Any]) -> str:
    """Markdown with a table of all rows, and the command that made it."""
    seeds, rows = result["seeds"], result["rows"]
    hit = [f"- {row['robots']} cars, {row['guard']}: {what}" for row in rows for what in row["which"]]
    return page(
        "Several cars on one field",
        f"Seeds {seeds[0]} to {seeds[-1]}, loads {', '.join(result['loads'])}, {result['seconds']:g} s each, 8 m by 8 "
        f"m with six pillars; reckoned with for all that moves: {result['fastest']:g} m/s. A contact of two cars "
        "counts once; a car moves at 0.1 m/s or more. Stuck: neither of two cars within 1.5 m of each other got 0.2 m "
        "farther in the last 8 s.",
        result,
        markdown_table(
            "cars | behind | drives | with a contact in which a car moved | 95 % of it | such contacts, of them with a "
            "standing car | contacts of standing cars | moved into pillar or wall | goals a minute and car | cars "
            "without a goal | share of time standing | pairs stuck, of them face to face",
            (_line(row) for row in rows),
        ),
        *(("Which:", "\n".join(hit)) if hit else ()),
    )


def _line(row: Mapping[str, Any]) -> str:
    return (
        f"{row['robots']} | {_GUARDS[row['guard']]} | {row['drives']} "
        f"| {row['drives_in_which_a_moving_car_touched_another']} | {percent(row['share_95'])} "
        f"| {row['contacts_in_which_a_car_moved']}, {row['of_them_with_a_standing_car']} "
        f"| {row['contacts_of_standing_cars']} | {row['moved_into_what_is_at_rest']} "
        f"| {row['goals_a_minute_and_robot']:.1f} | {row['robots_without_a_goal']} of {row['drives'] * row['robots']} "
        f"| {row['share_of_time_standing']:.2f} | {row['stuck_pairs']}, {row['stuck_face_to_face']}"
    )
