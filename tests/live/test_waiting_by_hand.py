"""How long is waited here, as it was chosen: whoever changes a number changes its line, and thinks of who counts on it.

Ten times as long would pass every test that only waits until something has happened.
"""

from __future__ import annotations

from functools import reduce
from importlib import import_module
from typing import Any

import pytest

CHOSEN: tuple[tuple[str, str, float], ...] = (
    ("safedpa.live.finding", "_TOLD_SECONDS", 60.0),
    ("safedpa.live.under_way", "_SETTLE_TICKS", 10),
    ("safedpa.live.watch", "_COVERED_SECONDS", 20.0),
)


@pytest.mark.parametrize(("module", "name", "chosen"), CHOSEN, ids=lambda value: str(value).rpartition(".")[2])
def test_what_is_waited_for_is_as_long_as_it_was_chosen(module: str, name: str, chosen: float) -> None:
    found: Any = import_module(module)
    assert reduce(getattr, name.split("."), found) == chosen
