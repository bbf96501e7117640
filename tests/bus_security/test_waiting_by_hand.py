"""How long is waited here, as it was chosen: whoever changes a number changes its line, and thinks of who counts on it.

Ten times as long would pass every test that only waits until something has happened.
"""

from __future__ import annotations

from functools import reduce
from importlib import import_module
from typing import Any

import pytest

CHOSEN: tuple[tuple[str, str, float], ...] = (
    ("safedpa.bus.security.doorkeeper", "_SILENT_SECONDS", 250),
    ("safedpa.bus.security.doorkeeper", "_MOST_WAITING", 65535),
    ("safedpa.bus.security.doorkeeper", "_PATIENCE_SECONDS", 3.0),
    ("safedpa.bus.security.doorkeeper", "_HURRIED_SECONDS", 0.4),
    ("safedpa.bus.security.doorkeeper", "_SHORT_SECONDS", 0.1),
    ("safedpa.bus.security.doorkeeper", "_ROOM_SECONDS", 0.25),
    ("safedpa.bus.security.doorkeeper", "_LOOK_SECONDS", 0.1),
    ("safedpa.bus.security.doorkeeper", "_TOLD_SECONDS", 1.0),
)


@pytest.mark.parametrize(("module", "name", "chosen"), CHOSEN, ids=lambda value: str(value).rpartition(".")[2])
def test_what_is_waited_for_is_as_long_as_it_was_chosen(module: str, name: str, chosen: float) -> None:
    found: Any = import_module(module)
    assert reduce(getattr, name.split("."), found) == chosen
