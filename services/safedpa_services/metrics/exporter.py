"""The page that Prometheus scrapes: metric families from the state of a fleet.

The main thread updates the state from the bus; the web server's thread reads it for each scrape, under a lock.
"""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

from safedpa.bus import VerdictMessage
from safedpa.bus.monitor import FleetOverview, RobotOverview, ServiceOverview, robot_alerts

if TYPE_CHECKING:
    from prometheus_client import Histogram, Metric

_TURN_SECONDS = 0.25


class Exporter:
    """Serves ``http://ADDRESS:PORT/metrics`` from its construction on; ``port`` is the port in use."""

    def __init__(self, fleet: FleetOverview, address: str, port: int) -> None:
        from prometheus_client import CollectorRegistry, make_asgi_app

        from safedpa_services.web.server import PageServer

        self._fleet = fleet
        self._collector = FleetCollector(fleet)
        registry = CollectorRegistry()
        registry.register(self._collector)
        self._server = PageServer(make_asgi_app(registry), address, port, f"--bind {address}, --port")
        self.port = self._server.port
        self._turns = 0

    def run(self, stopped: Callable[[], bool]) -> None:
        """Listens to the fleet and serves until ``stopped``."""
        try:
            while not stopped():
                self.turn()
        finally:
            self._server.close()

    def turn(self) -> None:
        """Processes the messages of a quarter of a second, then sends a heartbeat."""
        self._collector.listen(_TURN_SECONDS)
        self._turns += 1
        self._fleet.bus.report_health(
            "metrics", state="running", detail=f"port {self.port}", steps=self._turns, refused=self._fleet.refused
        )


LATENCY_BUCKETS = (0.001, 0.002, 0.003, 0.005, 0.0075, 0.01, 0.015, 0.02, 0.03, 0.045, 0.1, 0.5)
"""s; 0.045 s is the deadline of a robot at 20 Hz, 0.009 s that of one at 100 Hz."""
STEP_BUCKETS = (0.00005, 0.0001, 0.0002, 0.0005, 0.001, 0.002, 0.005, 0.01, 0.02, 0.05, 0.1)
"""s."""


@dataclass(frozen=True)
class Family:
    """One metric."""

    kind: Literal["counter", "gauge", "histogram"]
    meaning: str
    labels: tuple[str, ...]


_ROBOT = ("robot",)
_SERVICE = ("service", "pid")

FAMILIES: dict[str, Family] = {
    "safedpa_missing": Family(
        "gauge", "1 while a member of the roster is silent and not dismissed, else 0.", ("kind", "name")
    ),
    "safedpa_silent_seconds": Family("gauge", "Time since a member of the roster was heard.", ("kind", "name")),
    "safedpa_incidents_total": Family(
        "counter", "Silences that are over, and restarts, of a member of the roster.", ("kind", "name")
    ),
    "safedpa_robot_up": Family("gauge", "1 while the robot sends states, 0 after 1.5 s of silence.", _ROBOT),
    "safedpa_robot_healthy": Family("gauge", "1 unless safedpa status reports trouble with the robot.", _ROBOT),
    "safedpa_ticks_total": Family("counter", "Ticks received from the robot.", _ROBOT),
    "safedpa_late_ticks_total": Family(
        "counter", "Ticks without an action in time, in which the robot braked.", _ROBOT
    ),
    "safedpa_verdicts_total": Family("counter", "Verdicts of the safety filter, by status.", ("robot", "status")),
    "safedpa_collisions_total": Family("counter", "Collisions since the robot's start, as reported by it.", _ROBOT),
    "safedpa_goals_total": Family("counter", "Goals reached since the robot's start.", _ROBOT),
    "safedpa_sense_to_act_seconds": Family(
        "histogram", "From publishing a state to accepting its action, by the robot's own clock.", _ROBOT
    ),
    "safedpa_message_age_seconds": Family(
        "gauge",
        "Time since the measurement that the newest message of the topic is about. Values that are older than 1 s are "
        "left out.",
        ("robot", "topic"),
    ),
    "safedpa_barrier_value": Family(
        "gauge", "Smallest barrier value h at the measured state; below 0: outside the safe set.", _ROBOT
    ),
    "safedpa_margin": Family("gauge", "Largest epsilon by which the barrier condition is tightened.", _ROBOT),
    "safedpa_margin_coverage": Family("gauge", "Fraction of the last 500 steps in which the margin held.", _ROBOT),
    "safedpa_margin_coverage_promised": Family(
        "gauge", "Fraction of steps that the margin was calibrated for.", _ROBOT
    ),
    "safedpa_model_error": Family("gauge", "Open-loop prediction error over one second, from the diagnosis.", _ROBOT),
    "safedpa_model_error_band": Family("gauge", "Upper edge of the error's learned band; 0 while learning.", _ROBOT),
    "safedpa_diagnosis_stage": Family("gauge", "1 for the stage of the diagnosis, by name.", ("robot", "stage")),
    "safedpa_findings_total": Family(
        "counter", "Findings since the diagnosis first received a state of the robot.", _ROBOT
    ),
    "safedpa_service_processes": Family(
        "gauge", "Processes of the service that send heartbeats and do not report a failure.", ("service",)
    ),
    "safedpa_service_info": Family("gauge", "Always 1; the label has the version.", (*_SERVICE, "version")),
    "safedpa_service_robots": Family("gauge", "Robots that the process serves.", _SERVICE),
    "safedpa_heartbeat_age_seconds": Family("gauge", "Time since the newest heartbeat.", _SERVICE),
    "safedpa_steps_total": Family("counter", "Steps of the process; of the recorder, messages written.", _SERVICE),
    "safedpa_step_seconds": Family(
        "histogram", "Time of the last step before each heartbeat; four heartbeats per second.", ("service",)
    ),
    "safedpa_stale_steps_total": Family("counter", "Steps with a missing or outdated input.", _SERVICE),
    "safedpa_refused_messages_total": Family("counter", "Refused messages; of the router, denied ones.", _SERVICE),
    "safedpa_recorder_acknowledged_total": Family("counter", "Messages that are on disk.", ("pid",)),
    "safedpa_recorder_free_bytes": Family("gauge", "Free disk space where the recorder writes.", ("pid",)),
    "safedpa_unreadable_messages_total": Family("counter", "Payloads that could not be decoded by the exporter.", ()),
}
"""Metric families by name, in the order of the page."""


_SILENT_SECONDS = 1.5
_STALE_SECONDS = 1.0
"""Age of a verdict, or three periods of a slow robot, beyond which its values are left out."""
_STALE_FINDING_SECONDS = 5.0
"""The same of a finding, which arrives once a second of robot time."""
_GONE_SECONDS = 30.0
"""A process that was silent this long is left out; its successor has another process id."""
_STAGES = ("learning", "watching", "raised", "searching", "candidates", "nothing")
Sample = tuple[str, tuple[str, ...], float]
"""Name of the family, values of its labels, value."""


class FleetCollector:
    """A collector of ``prometheus_client``: call ``listen`` in a loop; each scrape calls ``collect``."""

    def __init__(self, fleet: FleetOverview) -> None:
        self._fleet, self._lock = fleet, threading.Lock()
        self._latencies = _histogram("safedpa_sense_to_act_seconds", LATENCY_BUCKETS)
        self._measured: set[str] = set()
        """Robots with latencies."""
        self._steps = _histogram("safedpa_step_seconds", STEP_BUCKETS)
        self._seen: dict[tuple[str, int], float] = {}

    def listen(self, wait: float) -> None:
        """Processes the messages that arrive within ``wait`` [s]."""
        time.sleep(wait)
        with self._lock:
            self._fleet.listen(0.0)
            self._fill_histograms()

    def collect(self) -> Iterator[Metric]:
        """Yields all families with their current samples."""
        with self._lock:
            samples = list(self._samples())
            histograms = {metric.name: metric for part in (self._latencies, self._steps) for metric in part.collect()}
        for metric in histograms.values():  # without their times of creation, which no rule asks for
            metric.samples = [sample for sample in metric.samples if not sample.name.endswith("_created")]
        for name in FAMILIES:
            yield histograms.get(name) or _family(name, [sample for sample in samples if sample[0] == name])

    def _fill_histograms(self) -> None:
        for robot in self._fleet.robots.values():
            latencies, robot.new_latencies = robot.new_latencies, []
            for latency in latencies:
                self._measured.add(robot.name)
                self._latencies.labels(robot.name).observe(latency)
        for name in self._measured - self._fleet.robots.keys():
            self._measured.remove(name)
            self._latencies.remove(name)
        for which, service in self._fleet.services.items():
            if self._seen.get(which) != service.at:
                self._seen[which] = service.at
                seconds = 1e-6 * service.health.step_microseconds
                if seconds > 0.0:  # 0: not measured
                    self._steps.labels(service.name).observe(seconds)
        self._seen = {which: at for which, at in self._seen.items() if which in self._fleet.services}

    def _samples(self) -> Iterator[Sample]:
        now = self._fleet.clock()
        yield from _of_roster(self._fleet, now)
        roster = self._fleet.roster
        for name, robot in sorted(self._fleet.robots.items()):
            if roster.is_dismissed("robot", name):
                continue
            yield from _of_robot(robot, now, self._fleet)
        for name in roster.expected("robot").keys() - self._fleet.robots.keys():
            if roster.is_dismissed("robot", name):
                continue
            yield "safedpa_robot_up", (name,), 0.0
            yield "safedpa_robot_healthy", (name,), 0.0
        processes = self._fleet.services.values()
        alive = Counter(known.name for known in processes if known.age(now) <= _SILENT_SECONDS and not known.failing)
        for name in sorted({known.name for known in processes} | self._fleet.roster.expected("service").keys()):
            yield "safedpa_service_processes", (name,), float(alive[name])
        for _, service in sorted(self._fleet.services.items()):
            if service.age(now) <= _GONE_SECONDS:
                yield from _of_service(service, now)
        yield "safedpa_unreadable_messages_total", (), float(self._fleet.refused)


def _of_roster(fleet: FleetOverview, now: float) -> Iterator[Sample]:
    for member in fleet.roster.members.values():
        which = (member.kind, member.label)
        yield "safedpa_missing", which, float(member.is_missing(now) or (member.given_up and not member.dismissed_by))
        yield "safedpa_silent_seconds", which, member.silent_for(now)
        yield "safedpa_incidents_total", which, float(fleet.roster.counts[member.kind, member.name])


def _of_robot(robot: RobotOverview, now: float, fleet: FleetOverview) -> Iterator[Sample]:
    name = (robot.name,)
    member = fleet.roster.members.get(("robot", robot.name))
    is_missing = member is not None and member.is_missing(now)
    trouble = is_missing or any(concern.level == "trouble" for concern in robot_alerts(robot, now))
    yield "safedpa_robot_up", name, float(robot.silent_for(now) <= _SILENT_SECONDS)
    yield "safedpa_robot_healthy", name, float(not trouble)
    yield "safedpa_ticks_total", name, float(robot.ticks)
    yield "safedpa_late_ticks_total", name, float(robot.late_ticks)
    for status, count in sorted(robot.verdicts.items()):
        yield "safedpa_verdicts_total", (robot.name, status), float(count)
    if robot.state is not None:
        yield "safedpa_collisions_total", name, float(robot.state.collisions)
        yield "safedpa_goals_total", name, float(robot.state.goals_reached)
        yield "safedpa_message_age_seconds", (robot.name, "state"), max(0.0, now - robot.state_at)
    if robot.verdict is not None:
        yield "safedpa_message_age_seconds", (robot.name, "verdict"), max(0.0, now - robot.verdict_at)
        if now - robot.verdict_at <= max(_STALE_SECONDS, 3.0 * (robot.state.period if robot.state else 0.0)):
            yield from _of_verdict(robot.name, robot.verdict)
    yield from _of_finding(robot, now)


def _of_verdict(name: str, verdict: VerdictMessage) -> Iterator[Sample]:
    """Yields the values of a verdict; of an old one nothing, so that Prometheus shows a gap instead of old values."""
    yield "safedpa_barrier_value", (name,), verdict.h_now
    yield "safedpa_margin", (name,), verdict.margin
    if verdict.coverage >= 0.0:
        yield "safedpa_margin_coverage", (name,), verdict.coverage
    if verdict.promised >= 0.0:
        yield "safedpa_margin_coverage_promised", (name,), verdict.promised


def _of_finding(robot: RobotOverview, now: float) -> Iterator[Sample]:
    finding = robot.finding
    if finding is None:
        return
    yield "safedpa_message_age_seconds", (robot.name, "finding"), max(0.0, now - robot.finding_at)
    yield "safedpa_findings_total", (robot.name,), float(finding.number)
    if now - robot.finding_at > _STALE_FINDING_SECONDS:
        return
    if finding.error > 0.0:  # 0: not measured yet
        yield "safedpa_model_error", (robot.name,), finding.error
    yield "safedpa_model_error_band", (robot.name,), finding.band
    for stage in _STAGES:
        yield "safedpa_diagnosis_stage", (robot.name, stage), float(stage == finding.stage)


def _of_service(service: ServiceOverview, now: float) -> Iterator[Sample]:
    health = service.health
    which = (service.name, str(health.pid))
    yield "safedpa_service_info", (*which, health.software), 1.0
    yield "safedpa_service_robots", which, float(len(service.robots))
    yield "safedpa_heartbeat_age_seconds", which, service.age(now)
    yield "safedpa_steps_total", which, float(service.steps)
    yield "safedpa_stale_steps_total", which, float(service.stale)
    yield "safedpa_refused_messages_total", which, float(service.refused)
    if service.name == "recorder":
        yield "safedpa_recorder_acknowledged_total", (str(health.pid),), float(health.acknowledged)
        if health.free_bytes and service.age(now) <= _SILENT_SECONDS:
            yield "safedpa_recorder_free_bytes", (str(health.pid),), float(health.free_bytes)


def _histogram(name: str, bounds: Sequence[float]) -> Histogram:
    from prometheus_client import Histogram

    return Histogram(name, FAMILIES[name].meaning, FAMILIES[name].labels, buckets=bounds, registry=None)


def _family(name: str, samples: list[Sample]) -> Metric:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    described = FAMILIES[name]
    kind = CounterMetricFamily if described.kind == "counter" else GaugeMetricFamily
    family = kind(name, described.meaning, labels=described.labels)
    for _, labels, value in samples:
        family.add_metric(labels, value)
    return family
