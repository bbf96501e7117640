"""What the point's experiment counts of episodes, counted by hand."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa_lab.experiments.point_episodes import _account
from safedpa_lab.point.driven import Driven

STEPS = 100


def test_each_number_of_six_episodes_by_hand() -> None:
    """Two directions, three episodes each; within a hazard for 0, 5, 0 and 0, 0, 20 of 100 steps."""
    found = Driven(
        goals=np.array([0.0, 2.0, 1.0, 0.0, 0.0, 4.0]), reward=np.zeros(6),
        cost=np.array([0.0, 5.0, 0.0, 0.0, 0.0, 20.0]), least_room=np.array([0.4, -0.1, 0.2, 0.3, 0.5, -0.3]),
        first_goal=np.array([np.inf, 2.0, 4.0, np.inf, np.inf, 3.0]), corrected=0.25, relaxed=0.0,
        processor_seconds=0.6, shown=[],
    )  # fmt: skip
    row = _account(found, 2, STEPS)
    assert row["episodes"] == 6
    assert row["safe_episodes"] == 4
    assert row["unsafe_steps"] == 25
    assert row["reached"] == 3
    assert row["least_room"] == -0.3
    assert row["milliseconds_per_episode"] == 100.0
    assert row["microseconds_per_decision"] == 1000.0
    assert row["directions_safe_steps"] == pytest.approx([1 - 5 / 300, 1 - 20 / 300], abs=1e-5)
    assert row["directions_safe_episodes"] == pytest.approx([2 / 3, 2 / 3], abs=1e-5)
    assert row["directions_goals"] == pytest.approx([1.0, 4 / 3], abs=1e-5)
    for name, share in (("safe_episodes_interval", 4 / 6), ("reached_interval", 3 / 6)):
        low, high = row[name]
        assert low < share < high
    assert row["first_goal_median"] is None, "three of six never came there: the median is never"
