"""What is not as it should be in a fleet, in words, and whether it is trouble or only worth a look."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from safedpa.bus.monitor.fleet_state import FleetOverview, RobotOverview, ServiceOverview

__all__ = ["Alert", "fleet_alerts", "robot_alerts"]

_SILENT_SECONDS = 1.5
"""Heartbeats come four times a second, the recorder's twice."""
_LATE_SHARE = 0.01
_MISSED_COVERAGE = 0.02
"""Less coverage than promised by so much: of 500 steps at 99 % chance alone brings 0.4 % (one standard deviation)."""
_WATCHED_STEPS = 500
"""Before so many steps the share says little."""
_LITTLE_ROOM_BYTES = 1 << 30
_LOOP = ("adaptation", "policy", "safety_filter")


@dataclass(frozen=True, slots=True)
class Alert:
    """One thing that is not as it should be."""

    level: Literal["trouble", "attention"]
    """``trouble``: not healthy; ``attention``: a person may want to look."""
    sentence: str
    robot: str = ""
    service: str = ""
    kind: str = ""
    """What concerns of several robots have in common, where their numbers differ."""
    size: float = 0.0
    """How bad it is among those of its kind."""


def robot_alerts(robot: RobotOverview, now: float) -> list[Alert]:
    """Everything about one robot at the time ``now`` [s], trouble first."""
    own = robot.health.get("robot")
    if own is not None and own[0].state == "braked" and robot.silent_for(now) > 0.5:
        return [Alert("attention", "ended in order", robot.name)]
    found = [*_about_driving(robot, now), *_about_services(robot, now), *_about_model(robot)]
    return sorted(found, key=lambda concern: concern.level != "trouble")


def fleet_alerts(fleet: FleetOverview) -> list[Alert]:
    """Everything about the fleet and each of its robots now, trouble first."""
    now = fleet.clock()
    found = [concern for robot in fleet.robots.values() for concern in robot_alerts(robot, now)]
    found += [concern for service in fleet.services.values() for concern in _about_process(service, now, fleet)]
    if fleet.robot not in ("*", *fleet.robots):
        found.append(Alert("trouble", "is not heard", fleet.robot))
    if not any(service.name == "recorder" for service in fleet.services.values()):
        found.append(Alert("attention", "no one records", service="recorder"))
    versions = sorted({known.health.software for known in fleet.services.values() if known.health.software})
    if len(versions) > 1:
        found.append(Alert("attention", f"processes of different versions: {', '.join(versions)}"))
    return sorted(found, key=lambda concern: (concern.level != "trouble", concern.robot))


def _about_driving(robot: RobotOverview, now: float) -> Iterator[Alert]:
    state, verdict, name = robot.state, robot.verdict, robot.name
    patience = _SILENT_SECONDS if state is None else max(_SILENT_SECONDS, 5.0 * state.period)
    if robot.silent_for(now) > patience:
        sentence = f"silent for {robot.silent_for(now):.0f} s"
        yield Alert("trouble", sentence, name, kind="silent", size=robot.silent_for(now))
        return
    if state is None or now - robot.state_at > patience:
        yield Alert("trouble", "alive, but it tells no state", name)
    if verdict is None or now - robot.verdict_at > patience:
        yield Alert("trouble", "no verdict: no one filters", name, "safety_filter")
    else:
        yield from _about_verdict(robot, now)
    late = robot.recent_ticks.share("watchdog", now)
    if late > 0.0:
        level: Literal["trouble", "attention"] = "trouble" if late > _LATE_SHARE else "attention"
        sentence = f"{100.0 * late:.1f} % of the last ticks were late: the robot braked by itself"
        yield Alert(level, sentence, name, kind="late", size=late)
    if state is not None and state.collisions:
        sentence = f"{state.collisions} collision{'s' if state.collisions > 1 else ''}"
        yield Alert("attention", sentence, name, kind="collisions", size=state.collisions)


def _about_verdict(robot: RobotOverview, now: float) -> Iterator[Alert]:
    verdict, name = robot.verdict, robot.name
    assert verdict is not None
    if verdict.status == "disabled":
        yield Alert("trouble", "the filter is switched off", name, "safety_filter")
    elif verdict.status == "stopped":
        yield Alert("attention", verdict.sentence, name, "safety_filter")
    elif verdict.status == "fallback":
        yield Alert("trouble", verdict.sentence, name, "safety_filter")
    elif verdict.status == "violated" or verdict.h_now < 0.0:
        sentence = f"unsafe now: h {verdict.h_now:+.3f}"
        yield Alert("trouble", sentence, name, "safety_filter", "outside", -verdict.h_now)
    if robot.seen is not None:
        for wrong in robot.seen.problems:
            yield Alert("trouble", wrong, name, "perception")
        if robot.seen.ordered:
            yield Alert("attention", f"switched: {robot.seen.ordered}", name, "perception")
    if verdict.stationary_reason:
        sentence = f"stands for {verdict.stationary_for:.0f} s, {verdict.stationary_reason}"
        yield Alert("attention", sentence, name, "safety_filter", "stands", verdict.stationary_for)
    for status in ("fallback", "violated", "relaxed"):
        share = robot.recent_verdicts.share(status, now)
        if share > 0.0 and verdict.status != "fallback":
            sentence = f"{100.0 * share:.1f} % of the last verdicts {status}"
            yield Alert("attention", sentence, name, "safety_filter", status, share)
    if verdict.tick >= _WATCHED_STEPS and 0.0 <= verdict.coverage < verdict.promised - _MISSED_COVERAGE:
        reported, wanted = 100.0 * verdict.coverage, 100.0 * verdict.promised
        sentence = f"the margin held in {reported:.1f} % of the steps, promised {wanted:.1f} %"
        yield Alert("attention", sentence, name, kind="coverage", size=wanted - reported)


def _about_services(robot: RobotOverview, now: float) -> Iterator[Alert]:
    for service in _LOOP:
        heard = robot.health.get(service)
        if heard is None:
            yield Alert("trouble", f"{service}: no heartbeat", robot.name, service)
        elif now - heard[1] > _SILENT_SECONDS:
            sentence = f"{service}: silent for {now - heard[1]:.0f} s"
            yield Alert("trouble", sentence, robot.name, service, f"{service} silent", now - heard[1])
        elif heard[0].state == "failing":
            yield Alert("trouble", f"{service}: failing, {heard[0].detail}", robot.name, service)
    models = {service: robot.health[service][0].model for service in _LOOP if service in robot.health}
    if len({model for model in models.values() if model}) > 1:
        reported = ", ".join(f"{service} {model}" for service, model in models.items())
        yield Alert("trouble", f"not all use one model: {reported}", robot.name)


def _about_model(robot: RobotOverview) -> Iterator[Alert]:
    finding = robot.finding
    if finding is not None and finding.stage not in ("learning", "watching"):
        yield Alert("attention", f"{finding.stage}: {finding.sentence}", robot.name, "diagnosis")


def _about_process(service: ServiceOverview, now: float, fleet: FleetOverview) -> Iterator[Alert]:
    name, health, reported = service.name, service.health, service.name not in _LOOP
    if service.age(now) > _SILENT_SECONDS:
        if reported and not fleet.replaced(service):
            level: Literal["trouble", "attention"] = "trouble" if name == "recorder" else "attention"
            yield Alert(level, f"{name}: silent for {service.age(now):.0f} s", service=name)
    elif reported and service.failing:
        yield Alert("trouble", f"{name}: failing, {service.detail}", service=name)
    elif name == "recorder" and 0 < health.free_bytes < _LITTLE_ROOM_BYTES:
        yield Alert("attention", f"recorder: {health.free_bytes / 1e6:.0f} MB of disk left", service=name)
    elif name == "router" and service.refused:
        yield Alert("attention", f"router: {service.refused} refused or denied", service=name)
