"""Sums whose public experiment takes minutes to reach them."""

from types import SimpleNamespace
from typing import Any

import pytest

from safedpa_lab.experiments.common.statistics import wilson_interval
from safedpa_lab.experiments.hostile.fuzz import DrivenLoop
from safedpa_lab.experiments.pendulum.story import _row


@pytest.mark.parametrize("rooms", [(0.2, -0.1, 0.0, 0.4), (-0.3,), (0.1, 0.2)])
def test_episodes_of_the_pendulum_are_safe_within_its_corridor(rooms: tuple[float, ...]) -> None:
    model: Any = SimpleNamespace(effects=[SimpleNamespace(name="tip_mass")])
    margin: Any = SimpleNamespace(epsilon={"corridor": 0.05})
    outcomes = [{"room": room, "reach": 1.0, "corrected": 0.5, "relaxed": 0.25} for room in rooms]
    row = _row((model, margin), outcomes)
    safe = sum(room >= 0.0 for room in rooms)
    assert (row["episodes"], row["safe"], row["least_room"]) == (len(rooms), safe, min(rooms))
    assert row["interval_safe"] == list(wilson_interval(safe, len(rooms)))
    assert (row["corrected"], row["reach"], row["margin"], row["relaxed"]) == (0.5, 1.0, 0.05, 0.25)


def test_messages_that_no_service_took_are_those_of_all_services() -> None:
    loop = object.__new__(DrivenLoop)
    loop._services = [SimpleNamespace(_unserved=SimpleNamespace(refused=n)) for n in (2, 0, 5)]  # type: ignore[misc]
    assert loop.refused == 7
