"""How long is waited here, as it was chosen: whoever changes a number changes its line, and thinks of who counts on it.

Ten times as long would pass every test that only waits until something has happened.
"""

from __future__ import annotations

from functools import reduce
from importlib import import_module
from typing import Any

import pytest

CHOSEN: tuple[tuple[str, str, float], ...] = (
    ("safedpa_services.dashboard.books", "SILENT_SECONDS", 1.0),
    ("safedpa_services.dashboard.books", "_REMEMBERED_TICKS", 8),
    ("safedpa_services.dashboard.dashboard", "_TURN_SECONDS", 0.05),
    ("safedpa_services.dashboard.dashboard", "_WAIT_SECONDS", 0.25),
    ("safedpa_services.dashboard.dashboard", "_HEARTBEAT_SECONDS", 0.25),
    ("safedpa_services.dashboard.dashboard", "_BATCH_SECONDS", 0.25),
    ("safedpa_services.dashboard.doors", "_SILENCE_SECONDS", 10.0),
    ("safedpa_services.dashboard.doors", "_HEAD_SECONDS", 10.0),
    ("safedpa_services.dashboard.fleet_view", "SHORTEST_INTERVAL", 0.05),
    ("safedpa_services.dashboard.fleet_view", "_BEHIND_SECONDS", 0.5),
    ("safedpa_services.dashboard.fleet_view", "_CAUGHT_UP_SECONDS", 0.1),
    ("safedpa_services.dashboard.fleet_view", "_CALM_SECONDS", 2.0),
    ("safedpa_services.dashboard.fleet_view", "KEYFRAME_SECONDS", 1.0),
    ("safedpa_services.dashboard.fleet_view", "_QUIET_SECONDS", 10.0),
    ("safedpa_services.dashboard.now_page", "_SILENT_SECONDS", 1.0),
    ("safedpa_services.dashboard.now_page", "_FIRST_SECONDS", 2.0),
    ("safedpa_services.dashboard.painter", "_FLUSH_SECONDS", 1.0),
    ("safedpa_services.dashboard.painter", "_BATCH_SECONDS", 0.4),
    ("safedpa_services.dashboard.painter", "_SHOWN_SECONDS", 20.0),
    ("safedpa_services.dashboard.robot_view", "_LONGEST_GAP_TICKS", 4),
)


@pytest.mark.parametrize(("module", "name", "chosen"), CHOSEN, ids=lambda value: str(value).rpartition(".")[2])
def test_what_is_waited_for_is_as_long_as_it_was_chosen(module: str, name: str, chosen: float) -> None:
    found: Any = import_module(module)
    assert reduce(getattr, name.split("."), found) == chosen
