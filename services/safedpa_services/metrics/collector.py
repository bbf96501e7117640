"""From what is known of a fleet to metric families; asked by the web server's thread, told by the listener's."""

from __future__ import annotations

import threading
import time
from collections import Counter
from collections.abc import Iterator
from typing import TYPE_CHECKING

from safedpa.bus.overview import FleetOverview, RobotOverview, ServiceOverview, concerns_of
from safedpa_services.metrics.families import FAMILIES, LATENCY_BUCKETS, STEP_BUCKETS
from safedpa_services.metrics.histogram import Histogram

if TYPE_CHECKING:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, HistogramMetricFamily

    AnyFamily = CounterMetricFamily | GaugeMetricFamily | HistogramMetricFamily

__all__ = ["FleetCollector"]

_SILENT_SECONDS = 1.5
_GONE_SECONDS = 30.0
"""A process that was silent for so long is told of no more; its successor has a number of its own."""
_STAGES = ("learning", "watching", "raised", "searching", "candidates", "nothing")
Sample = tuple[str, tuple[str, ...], float]
"""Name of the family, values of its labels, value."""


class FleetCollector:
    """A collector of ``prometheus_client``: ``listen`` in a loop, ``collect`` whenever somebody scrapes."""

    def __init__(self, fleet: FleetOverview) -> None:
        self._fleet, self._lock = fleet, threading.Lock()
        self._latencies: dict[str, Histogram] = {}
        self._steps: dict[str, Histogram] = {}
        self._seen: dict[tuple[str, int], float] = {}

    def listen(self, wait: float) -> None:
        """Takes in what is said within ``wait`` [s]."""
        time.sleep(wait)
        with self._lock:
            self._fleet.listen(0.0)
            self._fill_histograms()

    def collect(self) -> Iterator[AnyFamily]:
        """Every family, with the samples of now."""
        with self._lock:
            samples = list(self._samples())
            histograms = self._histograms()
        for name, family in FAMILIES.items():
            if family.kind == "histogram":
                yield _histogram_family(name, histograms[name])
            else:
                yield _family(name, [sample for sample in samples if sample[0] == name])

    def _fill_histograms(self) -> None:
        for robot in self._fleet.robots.values():
            told, robot.new_latencies = robot.new_latencies, []
            for latency in told:
                self._latencies.setdefault(robot.name, Histogram(LATENCY_BUCKETS)).add(latency)
        for which, service in self._fleet.services.items():
            if self._seen.get(which) != service.at:
                self._seen[which] = service.at
                seconds = 1e-6 * service.health.step_microseconds
                if seconds > 0.0:  # 0 tells that nothing was measured
                    self._steps.setdefault(service.name, Histogram(STEP_BUCKETS)).add(seconds)
        self._seen = {which: at for which, at in self._seen.items() if which in self._fleet.services}
        self._latencies = {name: kept for name, kept in self._latencies.items() if name in self._fleet.robots}

    def _histograms(self) -> dict[str, list[tuple[str, list[tuple[str, float]], float]]]:
        """By family: (label, buckets, sum)."""
        kept = {"safedpa_sense_to_act_seconds": self._latencies, "safedpa_step_seconds": self._steps}
        return {
            name: [(label, told.buckets(), told.sum) for label, told in sorted(table.items())]
            for name, table in kept.items()
        }

    def _samples(self) -> Iterator[Sample]:
        now = self._fleet.clock()
        for _, robot in sorted(self._fleet.robots.items()):
            yield from _of_robot(robot, now)
        alive = Counter(known.name for known in self._fleet.services.values() if _works(known, now))
        for name in sorted({known.name for known in self._fleet.services.values()}):
            yield "safedpa_service_processes", (name,), float(alive[name])
        for _, service in sorted(self._fleet.services.items()):
            if service.age(now) <= _GONE_SECONDS:
                yield from _of_service(service, now)
        yield "safedpa_unreadable_messages_total", (), float(self._fleet.refused)


def _of_robot(robot: RobotOverview, now: float) -> Iterator[Sample]:
    name = (robot.name,)
    trouble = any(concern.level == "trouble" for concern in concerns_of(robot, now))
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
        yield "safedpa_barrier_value", name, robot.verdict.h_now
        yield "safedpa_margin", name, robot.verdict.margin
        if robot.verdict.coverage >= 0.0:
            yield "safedpa_margin_coverage", name, robot.verdict.coverage
        if robot.verdict.promised >= 0.0:
            yield "safedpa_margin_coverage_promised", name, robot.verdict.promised
    yield from _of_finding(robot)


def _of_finding(robot: RobotOverview) -> Iterator[Sample]:
    finding = robot.finding
    if finding is None:
        return
    yield "safedpa_model_error", (robot.name,), finding.error
    yield "safedpa_model_error_band", (robot.name,), finding.band
    yield "safedpa_findings_total", (robot.name,), float(finding.number)
    for stage in _STAGES:
        yield "safedpa_diagnosis_stage", (robot.name, stage), float(stage == finding.stage)


def _works(service: ServiceOverview, now: float) -> bool:
    return service.age(now) <= _SILENT_SECONDS and not service.failing


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
        if health.free_bytes:
            yield "safedpa_recorder_free_bytes", (str(health.pid),), float(health.free_bytes)


def _family(name: str, samples: list[Sample]) -> AnyFamily:
    from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily

    described = FAMILIES[name]
    made = CounterMetricFamily if described.kind == "counter" else GaugeMetricFamily
    family = made(name, described.meaning, labels=described.labels)
    for _, labels, value in samples:
        family.add_metric(labels, value)
    return family


def _histogram_family(name: str, rows: list[tuple[str, list[tuple[str, float]], float]]) -> AnyFamily:
    from prometheus_client.core import HistogramMetricFamily

    family: HistogramMetricFamily = HistogramMetricFamily(name, FAMILIES[name].meaning, labels=FAMILIES[name].labels)
    for label, buckets, total in rows:
        family.add_metric([label], buckets, total)
    return family
