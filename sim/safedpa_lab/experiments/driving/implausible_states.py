"""Drives of five robots whose measured state fails: is the robot stopped in time, for the right reason, unhurt?

Each drive is a simulated robot in lockstep with the real nodes; only its state messages are wrong. Healthy drives with
loads, slip, wind, noise and lost states count the false stops, and the progress against a filter without the checks.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass
from math import hypot, inf
from typing import Any, Final

import numpy as np

from safedpa.bus import AbstractNode
from safedpa.errors import InputError
from safedpa.safety.session.state_limits import SHIPPED_LIMITS
from safedpa_lab.experiments.common.seeds import seeds_for
from safedpa_lab.experiments.common.workers import each_result
from safedpa_lab.experiments.driving.gateway_drive import drive_by_gateway
from safedpa_lab.experiments.driving.state_faults import FAULTS, ROBOTS, FaultyState, StateFault, drive_directly
from safedpa_lab.experiments.record import Options, ReportProgress, Result, silent
from safedpa_lab.experiments.report import markdown_table
from safedpa_sim.closed_loop import Tick, drive
from safedpa_sim.robots.robot import SimulatedRobot

_CONTACT_SPEED: Final = 0.05
"""m/s below which a contact does no harm."""
_SOON: Final = 0.3
"""s from the fault to the stop, or else"""
_NEAR: Final = 0.1
"""m (rad for a pendulum) that the robot moves meanwhile."""
_ROUNDING: Final = 1e-6
_LOST_SHARE: Final = 0.3
KNOWN_FAULTS: Final = {
    each.name: each for each in (*FAULTS, *(StateFault("lost", seconds) for seconds in (0.25, 1.0, 5.0)))
}
HEALTHY: Final = StateFault("none")


@dataclass(frozen=True)
class StateDrive:
    """One drive of a robot in one of its worlds."""

    robot: str
    world: str
    seed: int
    seconds: float
    fault: StateFault
    lost_share: float = 0.0
    checked: bool = True
    """Whether the session compares the state with its prediction."""
    noise: float = 1.0
    late: float = 0.0
    """Time [s] by which commands act later than the filter knows, for a robot that can be simulated so."""
    gateway: bool = False
    """Whether its messages go through the ROS gateway."""
    missed: float = 0.0
    """Mean number of pauses per second in which no node gets a state, of 1 to 20 periods each."""

    def simulated(self) -> SimulatedRobot:
        """The simulated robot."""
        kind = ROBOTS[self.robot]
        if self.late and kind.make_late is not None:
            return kind.make_late(self.world, self.seed, self.late)
        return kind.make(self.world, self.seed)

    def missed_ticks(self, period: float) -> set[int]:
        """The ticks without nodes."""
        if not self.missed:
            return set()
        draw, ticks = np.random.default_rng([self.seed, 17]), round(self.seconds / period)
        begins = np.flatnonzero(draw.uniform(size=ticks) < self.missed * period)
        return {tick for begin in begins for tick in range(begin, begin + int(draw.integers(1, 21)))}


def run_state_drive(wanted: StateDrive) -> dict[str, Any]:
    """Drives it; the same drive gives the same numbers."""
    kind = ROBOTS[wanted.robot]
    truth = wanted.simulated()
    source = FaultyState(truth, kind.system, wanted.fault, wanted.seed, wanted.noise, wanted.lost_share)
    places = [index for index, each in enumerate(kind.system.state) if each.unit == "m"] or [0]
    speeds = [index for index, each in enumerate(kind.system.state) if each.unit in ("m/s", "rad/s")][: len(places)]
    way, stopped, began, latest, hits = 0.0, "", -1.0, "", list[float]()
    before, contacts, at_stop = truth.values, len(truth.collisions), (inf, inf)
    since, touched = 0.0, False
    nodes, count = kind.nodes(SHIPPED_LIMITS if wanted.checked else None), round(wanted.seconds / truth.period)
    for tick in _ticks(wanted, source, nodes, count):
        speed = hypot(*(before[index] for index in speeds))
        step = hypot(*(truth.values[index] - before[index] for index in places))
        way += step
        before = truth.values
        if source.is_faulty_at(tick.state.tick) and began < 0.0:
            began, since = tick.state.robot_time, 0.0
        since += step if began >= 0.0 else 0.0
        if len(truth.collisions) > contacts:
            contacts = len(truth.collisions)
            if speed > _CONTACT_SPEED:
                hits.append(round(speed, 3))
        latest = tick.verdict.sentence
        if not stopped and "implausible" in latest:
            stopped = latest.partition("implausible, ")[2] or latest
            touched = contacts > 0
            at_stop = tick.state.robot_time - began, since
    return {
        **asdict(wanted),
        "hits": hits,
        "stopped": stopped[:160],
        "touched_before": touched,
        "after_seconds": at_stop[0],
        "after_way": at_stop[1],
        "goals": truth.goals_reached,
        "way": way,
        "hours": wanted.seconds / 3600.0,
    }


def _ticks(wanted: StateDrive, source: FaultyState, nodes: list[AbstractNode], count: int) -> Iterator[Tick]:
    """Drives it through the gateway, the services' bus, or the nodes alone."""
    kind = ROBOTS[wanted.robot]
    if wanted.gateway:
        return drive_by_gateway(source, kind.ros, kind.model, kind.settings, nodes, count)
    # A bus carries no lost state, and a node waits for late inputs when the robot is not in lockstep.
    missed = wanted.missed_ticks(source.robot.period)
    if wanted.lost_share or missed or wanted.fault.kind in ("lost", "clock"):
        return drive_directly(source, nodes, count, missed.__contains__)
    return drive(source, nodes, count)


def implausible_states(
    robots: Sequence[str],
    seeds: Sequence[int],
    seconds: float,
    healthy: int,
    processes: int = 1,
    on_drive: ReportProgress = silent,
    *,
    faults: Sequence[StateFault] = tuple(KNOWN_FAULTS.values()),
    gateway: bool = False,
) -> dict[str, Any]:
    """One row per robot and fault; one per robot for healthy drives and for lost states, if any.

    Raises InputError for a robot without a ROS interface, ``gateway`` given.
    """
    if gateway and (without := [name for name in robots if not ROBOTS[name].ros]):
        raise InputError(f"--robot {without[0]}: it has no ROS interface, and the gateway needs one")
    wanted = [
        StateDrive(name, kind.worlds[index % len(kind.worlds)], seed, seconds, fault, gateway=gateway)
        for name in robots
        for kind in [ROBOTS[name]]
        for fault in faults
        for index, seed in enumerate(seeds)
    ]
    wanted += [
        StateDrive(name, kind.worlds[index % len(kind.worlds)], seed, seconds, HEALTHY, lost, checked, gateway=gateway)
        for name in robots
        for kind in [ROBOTS[name]]
        for index, seed in enumerate(seeds_for("evaluation", healthy, 40_000) if healthy else ())
        for lost, checked in ((0.0, False), (0.0, True), (_LOST_SHARE, True))
    ]
    found = each_result(run_state_drive, wanted, processes, on_drive)
    rows = [
        _fault_row(
            name, fault, gateway, [one for one in found if (one["robot"], one["fault"]) == (name, asdict(fault))]
        )
        for name in robots
        for fault in faults
    ]
    return {
        "seeds": [seeds[0], seeds[-1]],
        "seconds": seconds,
        "gateway": gateway,
        "rows": rows,
        "healthy": [_healthy_row(name, [one for one in found if one["robot"] == name]) for name in robots if healthy],
    }


def right_reasons(fault: StateFault, *, gateway: bool) -> tuple[str, ...]:
    """Parts of the reasons that are right for a fault.

    Behind the gateway, a robot with a fast clock moves further in each of the gateway's periods than it can.
    """
    return (*fault.reasons, "jumped") if gateway and fault.kind == "clock" and fault.size > 1.0 else fault.reasons


def _fault_row(robot: str, fault: StateFault, gateway: bool, drives: Sequence[dict[str, Any]]) -> dict[str, Any]:
    stopped = [one for one in drives if one["stopped"]]
    reasons = right_reasons(fault, gateway=gateway)
    right = [one for one in stopped if any(part in one["stopped"] for part in reasons)]
    soon = [one for one in right if one["after_seconds"] <= _SOON + _ROUNDING or one["after_way"] <= _NEAR]
    return {
        "robot": robot,
        "fault": fault.name,
        "drives": len(drives),
        "hit": sum(bool(one["hits"]) for one in drives),
        "worst_speed": max((max(one["hits"], default=0.0) for one in drives), default=0.0),
        "stopped": len(stopped),
        "right_reason": len(right),
        "in_time": len(soon),
        "latest_seconds": max((one["after_seconds"] for one in right), default=0.0),
        "longest_way": max((one["after_way"] for one in right), default=0.0),
        "wrong_reasons": sorted({one["stopped"] for one in stopped if one not in right})[:3],
    }


def _healthy_row(robot: str, drives: Sequence[dict[str, Any]]) -> dict[str, Any]:
    healthy = [one for one in drives if one["fault"]["kind"] == "none"]
    off, on, lossy = (
        [one for one in healthy if (one["checked"], one["lost_share"]) == which]
        for which in ((False, 0.0), (True, 0.0), (True, _LOST_SHARE))
    )
    stopped = [one for one in (*on, *lossy) if one["stopped"] and not one["touched_before"]]
    return {
        "robot": robot,
        "drives": len(on),
        "hours": sum(one["hours"] for one in (*on, *lossy)),
        "false_stops": len(stopped),
        "reasons": sorted({one["stopped"] for one in stopped})[:5],
        "hit": sum(bool(one["hits"]) for one in (*on, *lossy)),
        "goals": [sum(one["goals"] for one in each) for each in (off, on, lossy)],
        "way": [round(sum(one["way"] for one in each), 2) for each in (off, on, lossy)],
    }


def run(options: Options, report_progress: ReportProgress) -> Result:
    """Runs ``safedpa experiment implausible-states``."""
    seeds = seeds_for("evaluation", options["drives"], options["first_seed"])
    gateway = options["gateway"]
    found = implausible_states(
        options["robots"] or tuple(name for name, kind in ROBOTS.items() if kind.ros or not gateway),
        seeds,
        options["seconds"],
        0 if options["faults"] else options["healthy"],
        options["processes"],
        report_progress,
        faults=[KNOWN_FAULTS[name] for name in options["faults"] or KNOWN_FAULTS],
        gateway=gateway,
    )
    return {"experiment": "implausible-states", **found}


def report(result: Result) -> str:
    """One row per robot and fault, and one per robot for healthy drives."""
    faults = markdown_table(
        "robot | fault | drives | hit above 0.05 m/s | stopped | right reason | in 0.3 s or 0.1 m | latest [s] | way",
        (
            f"{row['robot']} | {row['fault']} | {row['drives']} | {row['hit']} | {row['stopped']} "
            f"| {row['right_reason']} | {row['in_time']} | {row['latest_seconds']:.2f} | {row['longest_way']:.2f}"
            for row in result["rows"]
        ),
        above=f"Seeds {result['seeds'][0]} to {result['seeds'][1]}, {result['seconds']:g} s each"
        f"{', through the ROS gateway' if result['gateway'] else ''}.",
    )
    healthy = markdown_table(
        "robot | healthy hours | false stops | hit | goals before | checked | lossy | way [m] before | checked | lossy",
        (
            f"{row['robot']} | {row['hours']:.2f} | {row['false_stops']} | {row['hit']} "
            f"| {' | '.join(map(str, row['goals']))} | {' | '.join(f'{way:.1f}' for way in row['way'])}"
            for row in result["healthy"]
        ),
        above="Healthy drives with loads, slip, wind and noise; lossy: 30 % of the states lost.",
    )
    return f"{faults}\n{healthy}" if result["healthy"] else faults
