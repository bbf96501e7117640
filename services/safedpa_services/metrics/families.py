"""Every metric, by name: its type, its labels and what it means. Units are Prometheus's base units: seconds, bytes."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal

__all__ = ["FAMILIES", "LATENCY_BUCKETS", "STEP_BUCKETS", "Family"]

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
    "safedpa_robot_up": Family(
        "gauge", "1 while the robot is heard, 0 when it was silent for more than 1.5 s.", _ROBOT
    ),
    "safedpa_robot_healthy": Family("gauge", "1 unless safedpa status tells of trouble with the robot.", _ROBOT),
    "safedpa_ticks_total": Family("counter", "Ticks heard of the robot.", _ROBOT),
    "safedpa_late_ticks_total": Family("counter", "Ticks for which no action came in time: the robot braked.", _ROBOT),
    "safedpa_verdicts_total": Family("counter", "Verdicts of the safety filter, by status.", ("robot", "status")),
    "safedpa_collisions_total": Family("counter", "Contacts since the robot's start, as it tells them.", _ROBOT),
    "safedpa_goals_total": Family("counter", "Goals reached since the robot's start.", _ROBOT),
    "safedpa_sense_to_act_seconds": Family(
        "histogram", "From publishing a state to accepting its action, by the robot's own clock.", _ROBOT
    ),
    "safedpa_message_age_seconds": Family(
        "gauge", "Since the newest message of the topic came to this exporter.", ("robot", "topic")
    ),
    "safedpa_barrier_value": Family(
        "gauge", "Smallest barrier value h at the measured state; below 0: outside the safe set.", _ROBOT
    ),
    "safedpa_margin": Family("gauge", "Largest epsilon by which the barrier condition is tightened.", _ROBOT),
    "safedpa_margin_coverage": Family("gauge", "Share of the last 500 steps in which the margin held.", _ROBOT),
    "safedpa_margin_coverage_promised": Family("gauge", "Share of the steps that it was calibrated for.", _ROBOT),
    "safedpa_model_error": Family("gauge", "Open-loop error over one second that the diagnosis tells.", _ROBOT),
    "safedpa_model_error_band": Family("gauge", "Upper edge of that error's learned band; 0 while learning.", _ROBOT),
    "safedpa_diagnosis_stage": Family("gauge", "1 for the stage of the diagnosis, by name.", ("robot", "stage")),
    "safedpa_findings_total": Family("counter", "Findings since the diagnosis met the robot.", _ROBOT),
    "safedpa_service_processes": Family(
        "gauge", "Processes of the service whose heartbeats come and tell no failure.", ("service",)
    ),
    "safedpa_service_info": Family("gauge", "Always 1; the labels tell the version.", (*_SERVICE, "version")),
    "safedpa_service_robots": Family("gauge", "Robots that the process serves.", _SERVICE),
    "safedpa_heartbeat_age_seconds": Family("gauge", "Since the newest heartbeat.", _SERVICE),
    "safedpa_steps_total": Family("counter", "Steps of the process; of the recorder, messages written.", _SERVICE),
    "safedpa_step_seconds": Family(
        "histogram", "Time of a step, of the last one before each heartbeat, four a second.", ("service",)
    ),
    "safedpa_stale_steps_total": Family("counter", "Steps without some input: missing or too old.", _SERVICE),
    "safedpa_refused_messages_total": Family("counter", "Refused messages; of the router, denials.", _SERVICE),
    "safedpa_recorder_acknowledged_total": Family("counter", "Messages known to be on disk.", ("pid",)),
    "safedpa_recorder_free_bytes": Family("gauge", "Room left where the recorder writes.", ("pid",)),
    "safedpa_unreadable_messages_total": Family("counter", "What came to this exporter and was no message.", ()),
}
"""By name, in the order in which they are told."""
