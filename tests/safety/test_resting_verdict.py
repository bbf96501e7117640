"""What is told when nobody could even ask the filter."""

from __future__ import annotations

import numpy as np
import pytest

from safedpa.safety import Status
from safedpa.safety.verdict import resting_verdict


def test_it_rests_knows_nothing_and_says_why() -> None:
    rest = np.array([0.0, 0.1])
    verdict = resting_verdict(rest, "no state has the right length")
    assert verdict.status is Status.fallback
    assert verdict.intervened
    assert "Reason: no state has the right length." in verdict.sentence
    told = verdict.as_dict()
    assert told["action"] == [0.0, 0.1]
    assert {name: told[name] for name in ("slack", "h_now", "h_next", "margin", "microseconds")} == {
        "slack": 0.0, "h_now": 0.0, "h_next": 0.0, "margin": 0.0, "microseconds": 0.0,
    }  # fmt: skip
    assert (told["active"], told["wish"], told["known"], told["solver"]) == ([], None, False, "not run")


def test_its_action_is_a_copy() -> None:
    rest = np.zeros(2)
    verdict = resting_verdict(rest, "nobody is there")
    rest[0] = 9.0
    assert verdict.action.tolist() == [0.0, 0.0]
    with pytest.raises(ValueError, match="read-only"):
        verdict.action[0] = 1.0
