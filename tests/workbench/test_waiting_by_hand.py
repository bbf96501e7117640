"""How long is waited here, as it was chosen: whoever changes a number changes its line, and thinks of who counts on it.

Ten times as long would pass every test that only waits until something has happened.
"""

from __future__ import annotations

from functools import reduce
from importlib import import_module
from typing import Any

import pytest

CHOSEN: tuple[tuple[str, str, float], ...] = (
    ("safedpa_services.workbench.browser", "_SECONDS", 5.0),
    ("safedpa_services.workbench.live_link", "_PATIENCE", 2.0),
    ("safedpa_services.workbench.live_page", "_PICTURE_SECONDS", 0.4),
    ("safedpa_services.workbench.live_page", "_STATUS_SECONDS", 1.5),
    ("safedpa_services.workbench.live_page", "_END_SECONDS", 10.0),
    ("safedpa_services.workbench.live_panels", "_SECONDS", 5),
    ("safedpa_services.workbench.pictures", "_PATIENCE", 300000),
    ("safedpa_services.workbench.rerun_view", "_SECONDS", 20.0),
    ("safedpa_services.workbench.server", "_LISTEN_SECONDS", 0.1),
    ("safedpa_services.workbench.server", "_LAST_WORD_SECONDS", 4.0),
    ("safedpa_services.workbench.server", "_RECONNECT_SECONDS", 30.0),
)


@pytest.mark.parametrize(("module", "name", "chosen"), CHOSEN, ids=lambda value: str(value).rpartition(".")[2])
def test_what_is_waited_for_is_as_long_as_it_was_chosen(module: str, name: str, chosen: float) -> None:
    found: Any = import_module(module)
    assert reduce(getattr, name.split("."), found) == chosen
