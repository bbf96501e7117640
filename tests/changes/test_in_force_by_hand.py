"""From which tick on a new model is in force, told tick by tick while the services change to it."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import pytest


@pytest.fixture
def fleet(fleet_of: Any, tmp_path: Path) -> Any:
    """A tick old, and drag may be accepted."""
    fleet = fleet_of(tmp_path)
    fleet.turn()
    fleet.propose("drag")
    return fleet


def test_the_old_model_is_in_force_until_the_tick_that_was_told_and_the_new_one_from_it_on(fleet: Any) -> None:
    fleet.ask("accept", "drag")
    said = {}
    for _ in range(20):
        fleet.turn()
        said[fleet.tick] = fleet.ask("status").fingerprint
    (told,) = [message.from_tick for message in fleet.spoken if message.step == "take"]
    assert min(said) < told < max(said)
    assert said == {tick: "first" if tick < told else "print drag" for tick in said}


def test_a_robot_that_begins_anew_before_that_tick_has_the_new_model_from_its_first_tick_on(fleet: Any) -> None:
    """Its ticks count from 0 again: the tick that was told is of the drive before."""
    fleet.ask("accept", "drag")
    while not [message for message in fleet.spoken if message.step == "take"]:
        fleet.turn()
    assert fleet.ask("status").fingerprint == "first"
    fleet.restart_robot()
    fleet.turn()
    assert (fleet.tick, fleet.ask("status").fingerprint) == (1, "print drag")
