"""Alerts: sentences about problems in a fleet, with a level."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Literal

from safedpa.bus.monitor.fleet_state import FleetOverview, RobotOverview, ServiceOverview
from safedpa.bus.monitor.roster import SILENT_SECONDS, SUPERVISOR, Member

# Share of late ticks from which an alert is trouble: one in a hundred, 0.2 per second at 20 Hz.
_LATE_SHARE = 0.01
# Deficit from the promised coverage that counts: five standard deviations. Over 500 steps at 99 %, one is 0.4 %.
_MISSED_COVERAGE = 0.02
# With fewer steps the measured coverage is too uncertain.
_WATCHED_STEPS = 500
_LOW_DISK_BYTES = 1 << 30
_LOOP = ("adaptation", "policy", "safety_filter")
_TWICE = "twice: "
"""Begins the router's report of certificates that two processes use."""


@dataclass(frozen=True, slots=True)
class Alert:
    """One problem."""

    level: Literal["trouble", "attention"]
    """``trouble``: not healthy; ``attention``: worth a look."""
    sentence: str
    robot: str = ""
    service: str = ""
    kind: str = ""
    """Groups equal alerts of several robots whose sentences differ only in a number; empty: grouped by sentence."""
    size: float = 0.0
    """Severity among the alerts of one kind."""


def robot_alerts(robot: RobotOverview, now: float) -> list[Alert]:
    """Returns all alerts about one robot at time ``now`` [s], trouble first."""
    # The silence of a robot that was shut down properly is not trouble.
    if robot.ended_in_order and robot.silent_for(now) > 0.5:
        return [Alert("attention", "was shut down", robot.name)]
    found, finding = [*_about_driving(robot, now), *_about_services(robot, now)], robot.finding
    if finding is not None and finding.stage not in ("learning", "watching"):
        found.append(Alert("attention", f"{finding.stage}: {finding.sentence}", robot.name, "diagnosis"))
    return sorted(found, key=lambda alert: alert.level != "trouble")


def fleet_alerts(fleet: FleetOverview) -> list[Alert]:
    """Returns all alerts about the fleet and its robots now, trouble first."""
    now = fleet.clock()
    # Services may still report a robot that was dismissed.
    expected = [robot for robot in fleet.robots.values() if not fleet.roster.is_dismissed("robot", robot.name)]
    found = [alert for robot in expected for alert in robot_alerts(robot, now)]
    found += [alert for service in fleet.services.values() for alert in _about_process(service, now, fleet)]
    found = [*_about_roster(fleet, found, now), *found]
    if fleet.robot not in ("*", *fleet.robots) and fleet.robot not in {alert.robot for alert in found}:
        found.append(Alert("trouble", "sends nothing", fleet.robot))
    if not any(service.name == "recorder" for service in fleet.services.values()):
        found.append(Alert("attention", "no recorder is running", service="recorder"))
    # Different versions may read each other's messages, but not decide identically: a mistake after an update.
    versions = sorted({known.health.software for known in fleet.services.values() if known.health.software})
    if len(versions) > 1:
        found.append(Alert("attention", f"processes of different versions: {', '.join(versions)}"))
    return sorted(found, key=lambda alert: (alert.level != "trouble", alert.robot))


def _about_roster(fleet: FleetOverview, known: list[Alert], now: float) -> Iterator[Alert]:
    """Reports members who are missing, unless an alert about them says so already, and who was dismissed."""
    if fleet.is_unsupervised:
        yield Alert("trouble", "no supervisor: nothing restarts a process that ends", service=SUPERVISOR)
    reported = {(alert.robot, alert.service) for alert in known if alert.level == "trouble"}
    for member in fleet.roster.members.values():
        robot = member.name if member.kind == "robot" else ""
        if robot and fleet.robot not in ("*", robot):
            continue
        if member.dismissed_by:
            yield Alert("attention", f"{member.label}: dismissed by {member.dismissed_by}", robot)
        elif member.kind == SUPERVISOR and member.is_missing(now):
            sentence = f"supervisor: silent for {member.silent_for(now):.0f} s; nothing restarts a process that ends"
            yield Alert("trouble", sentence, service=SUPERVISOR)
        elif not _is_reported(member, reported) and (member.given_up or member.is_missing(now)):
            name = "" if robot else f"{member.name}: "
            yield Alert("trouble", name + member.sentence(now), robot, "" if robot else member.name)


def _is_reported(member: Member, reported: set[tuple[str, str]]) -> bool:
    if member.kind == "robot":
        return any(robot == member.name for robot, _ in reported)
    return any(service == member.name for _, service in reported)


def _about_driving(robot: RobotOverview, now: float) -> Iterator[Alert]:
    state, verdict, name = robot.state, robot.verdict, robot.name
    timeout = SILENT_SECONDS if state is None else max(SILENT_SECONDS, 5.0 * state.period)
    # Everything else would follow from the silence and hide it.
    if robot.silent_for(now) > timeout:
        sentence = f"silent for {robot.silent_for(now):.0f} s"
        yield Alert("trouble", sentence, name, kind="silent", size=robot.silent_for(now))
        return
    if state is None or now - robot.state_at > timeout:
        yield Alert("trouble", "alive, but sends no state", name)
    if verdict is None or now - robot.verdict_at > timeout:
        yield Alert("trouble", _why_no_verdict(robot, now, timeout), name, "safety_filter")
    else:
        yield from _about_verdict(robot, now)
    late = robot.recent_ticks.share("watchdog", now)
    if late > 0.0:
        level: Literal["trouble", "attention"] = "trouble" if late > _LATE_SHARE else "attention"
        sentence = f"{100.0 * late:.1f} % of the last ticks were late: the robot's watchdog braked"
        yield Alert(level, sentence, name, kind="late", size=late)
    if state is not None and state.collisions:
        sentence = f"{state.collisions} collision{'s' if state.collisions > 1 else ''}"
        yield Alert("attention", sentence, name, kind="collisions", size=state.collisions)


def _why_no_verdict(robot: RobotOverview, now: float, timeout: float) -> str:
    heard = robot.health.get("safety_filter")
    if heard is None or now - heard[1] > SILENT_SECONDS:
        return "no verdict: the robot has no safety filter"
    if robot.state is None or now - robot.state_at > timeout:
        return "no verdict: the filter gets no state"
    return "no verdict, although the filter gets states"


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
        sentence = f"stationary for {verdict.stationary_for:.0f} s, {verdict.stationary_reason}"
        yield Alert("attention", sentence, name, "safety_filter", "stationary", verdict.stationary_for)
    for status in ("fallback", "violated", "relaxed"):
        share = robot.recent_verdicts.share(status, now)
        # During a fallback, which is reported above, the shares only repeat it.
        if share > 0.0 and verdict.status != "fallback":
            sentence = f"{100.0 * share:.1f} % of the last verdicts {status}"
            yield Alert("attention", sentence, name, "safety_filter", status, share)
    if verdict.tick >= _WATCHED_STEPS and 0.0 <= verdict.coverage < verdict.promised - _MISSED_COVERAGE:
        reported, wanted = 100.0 * verdict.coverage, 100.0 * verdict.promised
        sentence = f"the margin held in {reported:.1f} % of the steps, promised {wanted:.1f} %"
        yield Alert("attention", sentence, name, kind="coverage", size=wanted - reported)


def _about_services(robot: RobotOverview, now: float) -> Iterator[Alert]:
    # A gateway may forward the nominal actions of the robot's own policy, which sends no heartbeat. A policy on a
    # supervisor's roster is expected all the same.
    gateway = robot.health.get("robot")
    is_ros = gateway is not None and bool(gateway[0].commands)
    has_nominal = is_ros and robot.verdict is not None and bool(robot.verdict.nominal)
    for service in _LOOP:
        heard = robot.health.get(service)
        if heard is None and service == "policy" and has_nominal:
            continue
        if heard is None:
            yield Alert("trouble", f"{service}: no heartbeat", robot.name, service)
        elif now - heard[1] > SILENT_SECONDS:
            sentence = f"{service}: silent for {now - heard[1]:.0f} s"
            yield Alert("trouble", sentence, robot.name, service, f"{service} silent", now - heard[1])
        elif heard[0].state == "failing":
            yield Alert("trouble", f"{service}: failing, {heard[0].detail}", robot.name, service)
    models = {service: robot.health[service][0].model for service in _LOOP if service in robot.health}
    if len({model for model in models.values() if model}) > 1:
        reported = ", ".join(f"{service} {model}" for service, model in models.items())
        yield Alert("trouble", f"services use different models: {reported}", robot.name)


def _about_process(service: ServiceOverview, now: float, fleet: FleetOverview) -> Iterator[Alert]:
    # Services of the loop are reported per robot, in `_about_services`.
    name, health, reported = service.name, service.health, service.name not in _LOOP
    if service.age(now) > SILENT_SECONDS:
        if reported and not fleet.replaced(service) and not fleet.roster.is_dismissed("service", name):
            # A drive without a recording cannot be examined later; other processes are often stopped on purpose.
            level: Literal["trouble", "attention"] = "trouble" if name == "recorder" else "attention"
            yield Alert(level, f"{name}: silent for {service.age(now):.0f} s", service=name)
    elif reported and service.failing:
        yield Alert("trouble", f"{name}: failing, {service.detail}", service=name)
    elif name == "recorder" and 0 < health.free_bytes < _LOW_DISK_BYTES:
        yield Alert("attention", f"recorder: {health.free_bytes / 1e6:.0f} MB of disk left", service=name)
    elif name == "router" and service.detail.startswith(_TWICE):
        names = service.detail.removeprefix(_TWICE)
        sentence = f"two processes use the certificate of {names}: the later is cut off each second; end one of them"
        yield Alert("attention", sentence, service=name)
    elif name == "router" and service.refused:
        yield Alert("attention", f"router: {service.refused} messages refused or denied", service=name)
