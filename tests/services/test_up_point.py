"""The point robot's loop as the user starts it: goals among hazards, with a force that no model knows."""

import pytest
from tests.services.drives import drive


@pytest.mark.long
@pytest.mark.processes
def test_the_point_robot_reaches_goals_and_enters_no_hazard(tmp_path):
    wind = ("--robot", "point", "--force", "0.008", "--wind-direction", "135", "--seed", "3")
    summary = drive(tmp_path, *wind, "--seconds", "6")
    assert summary["ticks"] == 300
    assert summary["collisions"] == summary["watchdog_ticks"] == 0
    assert summary["goals_reached"] >= 1
    assert "fallback" not in summary["verdicts"]
