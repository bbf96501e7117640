"""How long is waited here, as it was chosen: whoever changes a number changes its line, and thinks of who counts on it.

Ten times as long would pass every test that only waits until something has happened.
"""

from __future__ import annotations

from functools import reduce
from importlib import import_module
from typing import Any

import pytest

CHOSEN: tuple[tuple[str, str, float], ...] = (
    ("safedpa.safety.filtered_robot", "_LATENT_PATIENCE", 1.0),
    ("safedpa.safety.found_delay", "_SECONDS", 2.0),
    ("safedpa.safety.standstill", "TOLD_SECONDS", 5.0),
    ("safedpa.safety.standstill", "DEAD_BAND_SECONDS", 0.5),
    ("safedpa.safety.stopping_barrier", "STEP_SECONDS", 0.04),
    ("safedpa.safety.stopping_barrier", "STOP_SECONDS", 0.15),
    ("safedpa.safety.trail", "LONGEST_AGE", 1.0),
    ("safedpa.safety.way_out", "_PATIENCE", 0.5),
)


@pytest.mark.parametrize(("module", "name", "chosen"), CHOSEN, ids=lambda value: str(value).rpartition(".")[2])
def test_what_is_waited_for_is_as_long_as_it_was_chosen(module: str, name: str, chosen: float) -> None:
    found: Any = import_module(module)
    assert reduce(getattr, name.split("."), found) == chosen
