"""The demonstration where it ends before anything was driven."""

from __future__ import annotations

from typing import Any

import pytest

from safedpa.errors import SafedpaError
from safedpa_services.command_line.demo import _Demonstration


def test_one_that_ended_before_its_robot_was_started_has_nothing_to_report() -> None:
    plan: Any = None
    stop: Any = None
    with pytest.raises(SafedpaError, match="ended before the robot was started; nothing was driven"):
        _Demonstration(plan, stop, {"seed": 1, "picture": None}).result({"changed": 0})
