"""The numbers that ``safedpa status`` shows, as one document of plain values; the table is drawn from it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

from safedpa.bus.overview import Concern, FleetOverview, RobotOverview, ServiceOverview, concerns_of, fleet_concerns

__all__ = ["document_of"]

_LEVELS = ("trouble", "attention", "well")


def document_of(fleet: FleetOverview) -> dict[str, Any]:
    """Robots and processes, the worst first, and what is not as it should be; ``healthy`` is false with any trouble."""
    now = fleet.clock()
    concerns = fleet_concerns(fleet)
    robots = [_robot(robot, now) for robot in fleet.robots.values()]
    robots.sort(key=lambda row: (_LEVELS.index(row["health"]), -row["late"], -row["fallback"], row["robot"]))
    services = [_service(known, concerns, now) for known in fleet.services.values() if not fleet.replaced(known)]
    services.sort(key=lambda row: (_LEVELS.index(row["health"]), row["service"], row["pid"]))
    return {
        "fleet": fleet.bus.fleet,
        "healthy": not fleet.nobody and all(concern.level != "trouble" for concern in concerns),
        "listened": round(now - fleet.since, 3),
        "robots": robots,
        "services": services,
        "concerns": [_concern(concern) for concern in concerns],
        "unreadable": fleet.refused,
    }


def _concern(concern: Concern) -> dict[str, Any]:
    return {
        "level": concern.level,
        "robot": concern.robot,
        "service": concern.service,
        "sentence": concern.sentence,
        "kind": concern.kind or concern.sentence,
        "size": concern.size,
    }


def _level(concerns: Sequence[Concern]) -> str:
    levels = {concern.level for concern in concerns}
    return next((level for level in _LEVELS if level in levels), "well")


def _robot(robot: RobotOverview, now: float) -> dict[str, Any]:
    state, verdict = robot.state, robot.verdict
    p50, p99 = robot.latency(0.5), robot.latency(0.99)
    row: dict[str, Any] = {
        "robot": robot.name,
        "health": _level(concerns_of(robot, now)),
        "verdict": verdict.status if verdict else "",
        "h": verdict.h_now if verdict else None,
        "margin": verdict.margin if verdict else None,
        "coverage": verdict.coverage if verdict and verdict.coverage >= 0.0 else None,
        "promised": verdict.promised if verdict and verdict.promised >= 0.0 else None,
        "rate": round(robot.recent_ticks.rate(now), 2),
        "wanted_rate": round(1.0 / state.period, 2) if state else None,
        "lockstep": state.lockstep if state else None,
        "time": state.robot_time if state else None,
        "goals": state.goals_reached if state else None,
        "collisions": state.collisions if state else None,
        "age": round(robot.silent_for(now), 3),
        "late": robot.recent_ticks.share("watchdog", now),
        "sense_to_act_p50": p50,
        "sense_to_act_p99": p99,
        "sources": robot.sources(),
        "diagnosis": robot.finding.stage if robot.finding else "",
        "models": {name: message.model for name, (message, _) in sorted(robot.health.items()) if message.model},
    }
    shares = robot.recent_verdicts.counts(now)
    total = shares.total() or 1
    named = ("passed", "corrected", "relaxed", "violated", "fallback", "stopped", "disabled")
    return {**row, **{status: shares[status] / total for status in named}}


def _service(service: ServiceOverview, concerns: Sequence[Concern], now: float) -> dict[str, Any]:
    health = service.health
    own = [concern for concern in concerns if concern.service == service.name and concern.robot in service.robots]
    own += [concern for concern in concerns if concern.service == service.name and not concern.robot]
    silent = service.age(now) > 1.5
    level = _level(own) if own or not silent else "attention"
    return {
        "service": service.name,
        "health": level,
        "state": "silent" if silent else service.state,
        "pid": service.pid,
        "robots": len(service.robots),
        "steps": service.steps,
        "steps_per_second": round(service.steps_per_second(), 2),
        "step_microseconds": health.step_microseconds,
        "stale": service.stale,
        "refused": service.refused,
        "age": round(service.age(now), 3),
        "software": health.software,
        "acknowledged": health.acknowledged,
        "free_bytes": health.free_bytes,
        "detail": service.detail,
    }
