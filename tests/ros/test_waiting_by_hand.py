"""How long is waited here, as it was chosen: whoever changes a number changes its line, and thinks of who counts on it.

Ten times as long would pass every test that only waits until something has happened.
"""

from __future__ import annotations

from functools import reduce
from importlib import import_module
from typing import Any

import pytest

CHOSEN: tuple[tuple[str, str, float], ...] = (
    ("safedpa_services.ros_gateway.__main__", "_DRIVER_SECONDS", 10.0),
    ("safedpa_services.ros_gateway.alone", "_ALONE_SECONDS", 1.0),
    ("safedpa_services.ros_gateway.gateway", "_DEADLINE_SHARE", 0.9),
    ("safedpa_services.ros_gateway.gateway", "_LARGEST_AGE_PERIODS", 2.0),
    ("safedpa_services.ros_gateway.gateway", "_HEARTBEAT_SECONDS", 0.25),
    ("safedpa_services.ros_gateway.overheard", "_SILENT_SECONDS", 1.0),
    ("safedpa_services.ros_gateway.overheard", "_ANSWER_SECONDS", 0.001),
    ("safedpa_services.ros_gateway.robot_file", "Odometry.largest_age", 0.1),
    ("safedpa_services.ros_gateway.robot_file", "Wish.largest_age", 0.5),
    ("safedpa_services.ros_gateway.robot_file", "Localisation.largest_age", 1.0),
    ("safedpa_services.ros_gateway.scanner", "_MOST_WAITING", 8),
    ("safedpa_services.ros_gateway.voice", "_MARKER_SECONDS", 0.1),
)


@pytest.mark.parametrize(("module", "name", "chosen"), CHOSEN, ids=lambda value: str(value).rpartition(".")[2])
def test_what_is_waited_for_is_as_long_as_it_was_chosen(module: str, name: str, chosen: float) -> None:
    found: Any = import_module(module)
    assert reduce(getattr, name.split("."), found) == chosen
