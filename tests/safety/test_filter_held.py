"""A robot without a stand whose wish is missing: the barriers are kept, and the verdict says what came out."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.safety import FilterSettings, FunctionBarrier, SafetyFilter, Status

SETTINGS = FilterSettings(
    action_low=(-1.0,), action_high=(1.0,), backup_action=(0.5,), eta=0.5, epsilon={"default": 0.0}
)
SAFE = SafetyFilter(lambda x: (x - 0.1, np.eye(1)), [FunctionBarrier(lambda x: x[0])], SETTINGS)
"""It drifts down by 0.1 a tick; h is the height; the backup goes up."""


@pytest.mark.parametrize(
    ("height", "action", "status"),
    [
        (3.0, 0.5, Status.corrected),  # the resting action passes, but nobody wished it
        (0.05, 0.5, Status.corrected),
        (-3.0, 1.0, Status.violated),
    ],
)
def test_the_resting_action_stands_in_for_the_wish(height: float, action: float, status: Status) -> None:
    verdict = SAFE.hold("the wish is stale", np.array([height]))
    assert verdict.status is status
    assert verdict.action[0] == pytest.approx(action, abs=0.01)
    assert verdict.wish is None
    assert verdict.reason.endswith("The wish is stale: the resting action stood in for it.")
    assert verdict.known


def test_with_anything_else_amiss_it_is_the_fallback() -> None:
    verdict = SAFE.hold("the wish is stale", np.array([np.nan]))
    assert verdict.status is Status.fallback
    assert verdict.wish is None
    assert "stood in" not in verdict.reason
    assert "state" in verdict.reason
