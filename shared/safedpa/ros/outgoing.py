"""Builds the fields of ROS messages: odometry, transforms, diagnostics of verdicts, and path markers."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from safedpa.bus.messages.messages import ScanMessage, VerdictMessage

Head = Mapping[str, Any]
OK, WARN, ERROR = 0, 1, 2
_LEVELS = {"passed": OK, "corrected": OK, "relaxed": WARN, "stopped": WARN, "disabled": WARN}
"""Level of ``diagnostic_msgs/DiagnosticStatus`` by status of a verdict; ERROR for any other status."""


def quaternion_of(yaw: float) -> dict[str, float]:
    """Quaternion of a rotation about the vertical axis [rad]."""
    return {"z": math.sin(yaw / 2.0), "w": math.cos(yaw / 2.0)}


def odometry_of(
    head: Head, body: str, x: float, y: float, yaw: float, speed: float, yaw_rate: float, aside: float = 0.0
) -> dict[str, Any]:
    """``nav_msgs/Odometry``: pose in the header's frame, velocity in frame ``body``; covariances stay zero."""
    return {
        "header": head,
        "child_frame_id": body,
        "pose": {"pose": {"position": {"x": x, "y": y}, "orientation": quaternion_of(yaw)}},
        "twist": {"twist": {"linear": {"x": speed, "y": aside}, "angular": {"z": yaw_rate}}},
    }


def transform_of(head: Head, body: str, x: float, y: float, yaw: float) -> dict[str, Any]:
    """``geometry_msgs/TransformStamped`` of a pose."""
    return {
        "header": head,
        "child_frame_id": body,
        "transform": {"translation": {"x": x, "y": y}, "rotation": quaternion_of(yaw)},
    }


def laser_scan_of(head: Head, scan: ScanMessage) -> dict[str, Any]:
    """``sensor_msgs/LaserScan`` (ROS REP 117): NaN where nothing was measured, inf without a return."""
    ranges = [math.nan if one < 0.0 else math.inf if one >= scan.farthest else one for one in scan.ranges]
    return {
        "header": head,
        "angle_min": scan.first_angle,
        "angle_max": scan.first_angle + scan.angle_step * (len(ranges) - 1),
        "angle_increment": scan.angle_step,
        "range_min": scan.nearest,
        "range_max": scan.farthest,
        "ranges": ranges,
    }


def level_of(status: str) -> int:
    """Level of a verdict's status in ``diagnostic_msgs``."""
    return _LEVELS.get(status, ERROR)


def diagnostics_of(head: Head, robot: str, verdict: VerdictMessage) -> dict[str, Any]:
    """``diagnostic_msgs/DiagnosticArray`` of a verdict."""
    values = {
        "status": verdict.status,
        "h_now": f"{verdict.h_now:.6g}",
        "h_next": f"{verdict.h_next:.6g}",
        "slack": f"{verdict.slack:.6g}",
        "margin": f"{verdict.margin:.6g}",
        "active": ", ".join(verdict.active),
        "solver": verdict.solver,
        "microseconds": f"{verdict.microseconds:.0f}",
        "tick": str(verdict.tick),
    }
    status = {
        "level": level_of(verdict.status),
        "name": f"{robot}: safety filter",
        "message": verdict.sentence,
        "hardware_id": robot,
        "values": [{"key": key, "value": value} for key, value in values.items()],
    }
    return {"header": head, "status": [status]}


def gateway_diagnostics(head: Head, robot: str, why: str, facts: Mapping[str, str]) -> dict[str, Any]:
    """``diagnostic_msgs/DiagnosticArray`` of the gateway; ``why`` is its reason to brake, empty if it does not."""
    status = {
        "level": ERROR if why else OK,
        "name": f"{robot}: gateway",
        "message": f"the gateway brakes: {why}" if why else "the filter drives",
        "hardware_id": robot,
        "values": [{"key": key, "value": value} for key, value in facts.items()],
    }
    return {"header": head, "status": [status]}


def path_marker(head: Head, places: Sequence[tuple[float, float]]) -> dict[str, Any]:
    """``visualization_msgs/Marker``: a line through positions [m] in the header's frame."""
    return {
        "header": head,
        "ns": "predicted",
        "type": 4,  # a line
        "pose": {"orientation": {"w": 1.0}},
        "scale": {"x": 0.02},
        "color": {"r": 0.2, "g": 0.5, "b": 0.9, "a": 1.0},
        "points": [{"x": x, "y": y} for x, y in places],
    }
