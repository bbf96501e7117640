"""How long is waited here, as it was chosen: whoever changes a number changes its line, and thinks of who counts on it.

Ten times as long would pass every test that only waits until something has happened.
"""

from __future__ import annotations

from functools import reduce
from importlib import import_module
from typing import Any

import pytest

CHOSEN: tuple[tuple[str, str, float], ...] = (
    ("safedpa_services.supervisor.supervisor", "_HUNG_SECONDS", 10.0),
    ("safedpa_services.supervisor.view", "_SILENT_SECONDS", 1.0),
    ("safedpa_services.command_line.bus_options", "_ANSWER_SECONDS", 2.0),
    ("safedpa_services.command_line.change_requests", "_TIMEOUT_SECONDS", 2.0),
    ("safedpa_services.command_line.change_requests", "_LONGEST_CHANGE_SECONDS", 120.0),
    ("safedpa_services.command_line.change_requests", "_LOOK_SECONDS", 0.1),
    ("safedpa_services.command_line.change_requests", "_SILENCE_SECONDS", 10.0),
    ("safedpa_services.command_line.screenshot", "_TIMEOUT_SECONDS", 20.0),
    ("safedpa_services.command_line.screenshot", "_PAINT_SECONDS", 1.0),
    ("safedpa_services.command_line.status", "_REDRAW_SECONDS", 0.5),
    ("safedpa_services.command_line.stop_orders", "_LONGEST_BRAKING_SECONDS", 6.0),
    ("safedpa_services.command_line.stop_orders", "_LOOK_SECONDS", 0.1),
    ("safedpa_services.diagnosis.process_worker", "_LONGEST_SECONDS", 600.0),
    ("safedpa_services.metrics.exporter", "_TURN_SECONDS", 0.25),
    ("safedpa_services.metrics.exporter", "_SILENT_SECONDS", 1.5),
    ("safedpa_services.metrics.exporter", "_GONE_SECONDS", 30.0),
    ("safedpa_services.recorder.recorder", "_SYNC_SECONDS", 0.5),
    ("safedpa_services.recorder.recorder", "_TURN_SECONDS", 0.05),
    ("safedpa_services.recorder.recorder", "_SETUP_SECONDS", 5.0),
    ("safedpa_services.recorder.recorder", "_RETRY_SECONDS", 5.0),
    ("safedpa_services.router.pulse", "_LOOK_SECONDS", 0.25),
    ("safedpa_services.router.refusals", "_PAUSE_SECONDS", 0.02),
    ("safedpa_services.router.refusals", "_TOLD_SECONDS", 1.0),
    ("safedpa_services.router.router", "_HEARTBEAT_SECONDS", 0.25),
    ("safedpa_services.serving", "_SWITCH_SECONDS", 0.0005),
    ("safedpa_services.supervisor.child", "_FIRST_PAUSE_SECONDS", 0.1),
    ("safedpa_services.supervisor.child", "_LONGEST_PAUSE_SECONDS", 5.0),
    ("safedpa_services.supervisor.child", "_HEALTHY_SECONDS", 10.0),
    ("safedpa_services.supervisor.screen", "_REDRAW_SECONDS", 0.25),
    ("safedpa_services.supervisor.screen", "_PROBE_SECONDS", 0.05),
    ("safedpa_services.supervisor.story", "_ASK_SECONDS", 2.0),
    ("safedpa_services.supervisor.supervisor", "_READY_SECONDS", 30.0),
    ("safedpa_services.supervisor.supervisor", "_STARTING_SECONDS", 120.0),
    ("safedpa_services.supervisor.supervisor", "_TURN_SECONDS", 0.05),
    ("safedpa_services.supervisor.supervisor", "_ROBOT_PATIENCE_SECONDS", 8.0),
    ("safedpa_services.supervisor.supervisor", "_BRAKING_SECONDS", 5.0),
    ("safedpa_services.supervisor.supervisor", "_OTHERS_PATIENCE_SECONDS", 5.0),
    ("safedpa_services.supervisor.supervisor", "_SERVICE_PATIENCE_SECONDS", 6.0),
    ("safedpa_services.supervisor.warnings", "_LOOK_SECONDS", 0.5),
    ("safedpa_services.supervisor.warnings", "_LEAST_SECONDS", 5.0),
    ("safedpa_services.supervisor.watch", "_ORDER_SECONDS", 2.0),
    ("safedpa_services.trying", "_TICKS", 12),
)


@pytest.mark.parametrize(("module", "name", "chosen"), CHOSEN, ids=lambda value: str(value).rpartition(".")[2])
def test_what_is_waited_for_is_as_long_as_it_was_chosen(module: str, name: str, chosen: float) -> None:
    found: Any = import_module(module)
    assert reduce(getattr, name.split("."), found) == chosen
