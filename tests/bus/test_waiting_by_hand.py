"""How long is waited here, as it was chosen: whoever changes a number changes its line, and thinks of who counts on it.

Ten times as long would pass every test that only waits until something has happened.
"""

from __future__ import annotations

import ast
from functools import reduce
from importlib import import_module
from pathlib import Path
from typing import Any

import pytest

CHOSEN: tuple[tuple[str, str, float], ...] = (
    ("safedpa.bus.loop.service", "_HEARTBEAT_SECONDS", 0.25),
    ("safedpa.bus.loop.turning", "_LONGEST_WAIT_SECONDS", 0.25),
    ("safedpa.bus.loop.turning", "_LONGEST_END_SECONDS", 5.0),
    ("safedpa.bus.loop.turning", "_END_TURN_SECONDS", 0.05),
    ("safedpa.bus.log", "_LEAST_SECONDS", 1.0),
    ("safedpa.bus.loop.apart", "_PROCESSOR_SECONDS", 5),
    ("safedpa.bus.loop.apart", "_LONGEST_SECONDS", 20.0),
    ("safedpa.bus.loop.greeting", "_PATIENCE_SECONDS", 0.3),
    ("safedpa.bus.loop.service", "_SILENCE_SECONDS", 0.3),
    ("safedpa.bus.loop.service", "_FORGET_SECONDS", 30.0),
    ("safedpa.bus.loop.turning", "_SHORTEST_SECONDS", 0.001),
    ("safedpa.bus.loop.turning", "LONGEST_HOLD_SECONDS", 0.005),
    ("safedpa.bus.overview.concerns", "_SILENT_SECONDS", 1.5),
    ("safedpa.bus.overview.fleet", "_FORGET_SECONDS", 300.0),
    ("safedpa.bus.overview.fleet", "_LEFT_SECONDS", 5.0),
    ("safedpa.bus.overview.fleet", "_SILENT_SECONDS", 1.5),
    ("safedpa.bus.overview.recent", "RECENT_SECONDS", 10.0),
    ("safedpa.bus.overview.recent", "_SLICE_SECONDS", 0.5),
    ("safedpa.bus.overview.service", "_SAMPLE_SECONDS", 0.25),
    ("safedpa.bus.transport.bus", "_CLAIM_POLL_SECONDS", 0.05),
    ("safedpa.bus.transport.bus", "_CLAIM_SETTLE_SECONDS", 5.0),
    ("safedpa.bus.transport.zenoh_transport", "_ACCEPT_MILLISECONDS", 1000),
    ("safedpa.bus.transport.zenoh_transport", "_ALIVE_TIMEOUT_SECONDS", 1.0),
    ("safedpa.bus.transport.zenoh_transport", "ZenohSettings.patience", 10.0),
    ("safedpa.bus.wire.setup", "SETUP_SECONDS", 5.0),
)


@pytest.mark.parametrize(("module", "name", "chosen"), CHOSEN, ids=lambda value: str(value).rpartition(".")[2])
def test_what_is_waited_for_is_as_long_as_it_was_chosen(module: str, name: str, chosen: float) -> None:
    found: Any = import_module(module)
    assert reduce(getattr, name.split("."), found) == chosen


def test_links_are_given_up_as_soon_as_it_was_chosen() -> None:
    """As the file says it: while tests run, a link is given up later."""
    written = ast.parse(Path(str(import_module("safedpa.bus.transport.zenoh_transport").__file__)).read_text("utf-8"))
    found = {
        ast.unparse(node.targets[0]): ast.literal_eval(node.value)
        for node in written.body
        if isinstance(node, ast.Assign) and "LEASE" in ast.unparse(node.targets[0])
    }
    assert found == {"_LEASE_MILLISECONDS": 500, "_LEASE_ON_ONE_MACHINE_MILLISECONDS": 2000}
