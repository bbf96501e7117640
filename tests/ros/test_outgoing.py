"""ROS messages have what the drive has: each number in its field, and nothing else."""

import math
from typing import Any

import pytest
from tests.messages import stamp

from safedpa.bus.messages.messages import ScanMessage, VerdictMessage
from safedpa.ros.outgoing import (
    diagnostics_of,
    gateway_diagnostics,
    laser_scan_of,
    level_of,
    odometry_of,
    path_marker,
    transform_of,
)

HEAD: dict[str, Any] = {"frame_id": "odom"}


def test_odometry_and_transform() -> None:
    assert odometry_of(HEAD, "base", 1.0, 2.0, math.pi, 0.5, 0.25, 0.125) == {
        "header": HEAD,
        "child_frame_id": "base",
        "pose": {
            "pose": {
                "position": {"x": 1.0, "y": 2.0},
                "orientation": pytest.approx({"z": 1.0, "w": 0.0}),
            }
        },
        "twist": {"twist": {"linear": {"x": 0.5, "y": 0.125}, "angular": {"z": 0.25}}},
    }
    assert transform_of(HEAD, "base", 1.0, 2.0, 0.0) == {
        "header": HEAD,
        "child_frame_id": "base",
        "transform": {"translation": {"x": 1.0, "y": 2.0}, "rotation": {"z": 0.0, "w": 1.0}},
    }


def test_scan() -> None:
    scan = ScanMessage(
        **stamp(3), number=0, source="laser", mount=(0.0, 0.0, 0.0), first_angle=-1.0, angle_step=0.5, nearest=0.1,
        farthest=8.0, ranges=(1.0, -1.0, 8.0),
    )  # fmt: skip
    found = laser_scan_of(HEAD, scan)
    ranges = found.pop("ranges")
    assert ranges[0] == 1.0
    assert math.isnan(ranges[1])
    assert ranges[2] == math.inf
    assert found == {
        "header": HEAD, "angle_min": -1.0, "angle_max": 0.0, "angle_increment": 0.5, "range_min": 0.1, "range_max": 8.0
    }  # fmt: skip


def test_diagnostics() -> None:
    verdict = VerdictMessage(
        **stamp(7), status="relaxed", sentence="why", action=(0.1,), nominal=(0.2,), slack=0.5, active=("a", "b"),
        h_now=0.25, h_next=-0.125, margin=0.01, solver="exact", microseconds=31.6,
    )  # fmt: skip
    (status,) = diagnostics_of(HEAD, "r1", verdict)["status"]
    values = {pair["key"]: pair["value"] for pair in status.pop("values")}
    assert status == {"level": level_of("relaxed"), "name": "r1: safety filter", "message": "why", "hardware_id": "r1"}
    assert values == {
        "status": "relaxed", "h_now": "0.25", "h_next": "-0.125", "slack": "0.5", "margin": "0.01", "active": "a, b",
        "solver": "exact", "microseconds": "32", "tick": "7",
    }  # fmt: skip


@pytest.mark.parametrize(("why", "level", "message"), [("", 0, "the filter drives"), ("x", 2, "the gateway brakes: x")])
def test_diagnostics_of_the_gateway(why: str, level: int, message: str) -> None:
    assert gateway_diagnostics(HEAD, "r1", why, {"age": "0.1"}) == {
        "header": HEAD,
        "status": [
            {
                "level": level,
                "name": "r1: gateway",
                "message": message,
                "hardware_id": "r1",
                "values": [{"key": "age", "value": "0.1"}],
            }
        ],
    }


def test_marker() -> None:
    found = path_marker(HEAD, [(1.0, 2.0), (3.0, 4.0)])
    assert found["points"] == [{"x": 1.0, "y": 2.0}, {"x": 3.0, "y": 4.0}]
    assert (found["header"], found["type"], found["ns"]) == (HEAD, 4, "predicted")
    assert found["pose"] == {"orientation": {"w": 1.0}}
    assert found["color"]["a"] == 1.0
    assert found["scale"]["x"] > 0.0
