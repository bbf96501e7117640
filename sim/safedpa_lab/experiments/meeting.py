"""Several cars on one field, each with a laser alone and a filter of its own: who touches whom, and what is reached.

A contact of two cars counts once. It is one in which a car moves where either was at ``IS_STATIONARY`` or faster: among cars
that all keep passive safety there is none, since anyone who can be touched stands before.
"""

from __future__ import annotations

import hashlib
import multiprocessing
from collections.abc import Callable, Sequence
from concurrent.futures import ProcessPoolExecutor
from dataclasses import asdict, dataclass
from itertools import combinations
from math import atan2, cos, hypot
from typing import Any, Final, final

import numpy as np

from safedpa.adaptation import AdaptationNode
from safedpa.arrays import FloatArray
from safedpa.bus import AbstractNode
from safedpa.dynamics import PhysicsModel, load_model
from safedpa.perception import PerceptionNode, PerceptionSettings
from safedpa.policy import PolicyNode
from safedpa.robots.car.dynamics.limits import IS_STATIONARY
from safedpa.runtime.node import SafetyFilterNode
from safedpa.safety.defaults import margin_for, settings_named
from safedpa_lab.experiments.meeting_scenes import meeting_field, pieces_of
from safedpa_lab.experiments.sensing_peers import NoFilter
from safedpa_lab.experiments.sensing_reported import ReportsEverything
from safedpa_lab.experiments.statistics import clopper_pearson_interval
from safedpa_sim.closed_loop import drive_together
from safedpa_sim.robots.shared_field import SharedField

__all__ = ["GUARDS", "Meeting", "meeting_experiment", "run_meeting", "stuck_pairs"]

GUARDS: Final = ("safedpa", "reported", "nothing")
"""The filter with the laser alone; the filter that is told where everything is; the same controller and perception as
the first, and no filter."""
_PERIOD: Final = 0.05
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
    """m/s that perception reckons with for whatever moves or hides."""
    guard: str = GUARDS[0]
    load: str = "none"


def _settings(fastest: float) -> PerceptionSettings:
    """For cars: the discs in one are slimmer than a person, half as wide as it."""
    return PerceptionSettings(fastest=fastest, coming=fastest, slimmest=0.12)


def _nodes(wanted: Meeting, model: PhysicsModel, field: SharedField, index: int) -> list[AbstractNode]:
    """Of one car, in the order of the data flow."""
    settings, robot = _settings(wanted.fastest), field.robots[index]
    others = [piece for one in field.robots if one is not robot for piece in pieces_of(one)]
    perception: AbstractNode = PerceptionNode(settings)
    if wanted.guard == "reported":
        perception = ReportsEverything(robot.scene, others, settings)
    guard: AbstractNode = NoFilter()
    if wanted.guard != "nothing":
        guard = SafetyFilterNode(model, settings_named("car"), margin_for(model))
    return [AdaptationNode(model), perception, PolicyNode(model, "way_seeker"), guard]


def run_meeting(wanted: Meeting) -> dict[str, Any]:
    """Drives it; the same meeting gives the same numbers."""
    model, field = load_model("car"), meeting_field(wanted.seed, wanted.robots, wanted.load)
    nodes = [_nodes(wanted, model, field, index) for index in range(wanted.robots)]
    states = [
        [tick.state.values for tick in ticks] for ticks in drive_together(field, nodes, round(wanted.seconds / _PERIOD))
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
    last = path[-min(round(_STUCK_SECONDS / _PERIOD), len(path)) :]
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
    on_drive: Callable[[int, int], None] = lambda _done, _all: None,
) -> dict[str, Any]:
    """Every number of robots with every seed and load behind each guard; a row for each number and guard."""
    kinds = [(count, guard) for count in robots for guard in guards]
    wanted = [
        Meeting(seed, count, seconds, fastest, guard, load)
        for count, guard in kinds
        for seed in seeds
        for load in loads
    ]
    found: list[dict[str, Any]] = []
    with ProcessPoolExecutor(processes, mp_context=multiprocessing.get_context("spawn")) as pool:
        for outcome in pool.map(run_meeting, wanted):
            found.append(outcome)
            on_drive(len(found), len(wanted))
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
